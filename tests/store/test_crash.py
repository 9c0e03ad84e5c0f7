import pytest

from ..killing import steps_of


@pytest.mark.slow
def test_killed_at_any_step_of_storage_nothing_is_half_done(tmp_path):
    n_file_steps, n_steps = steps_of("tests.store.crash_driver", tmp_path, 13)
    assert 40 < n_file_steps < n_steps
