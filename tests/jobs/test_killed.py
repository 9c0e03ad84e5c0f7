"""A job, or an import, whose process is killed is done by the next, once: from what is durable by itself."""

import pytest

from ..killing import steps_of

pytestmark = pytest.mark.slow


# Both kinds seal and activate alike: every file step of the one, every third of the other.
@pytest.mark.parametrize(("kind", "file_stride", "stride"), [("remap", 1, 17), ("experience", 3, 41)])
def test_killed_at_any_step_a_job_is_done_once(tmp_path, kind, file_stride, stride):
    n_file_steps, n_steps = steps_of("tests.jobs.kill_driver", tmp_path, kind, file_stride, stride)
    assert 20 < n_file_steps < n_steps


def test_an_import_that_is_killed_leaves_nothing_of_its_map(tmp_path):
    (n_steps,) = steps_of("tests.jobs.kill_driver", tmp_path, "import", 1, 0)
    assert n_steps > 4
