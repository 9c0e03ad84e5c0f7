"""A job whose process is killed is done by the next, once: from what is durable by itself."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

DRIVER = Path(__file__).with_name("kill_driver.py")


@pytest.mark.slow
# Both kinds seal and activate alike: every file step of the one, every third of the other.
@pytest.mark.parametrize(("kind", "file_stride", "stride"), [("remap", 1, 17), ("experience", 3, 41)])
def test_killed_at_any_step_a_job_is_done_once(tmp_path, kind, file_stride, stride):
    done = subprocess.run(
        [sys.executable, str(DRIVER), str(tmp_path), kind, str(file_stride), str(stride)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    n_file_steps, n_steps = map(int, done.stdout.split())
    assert n_file_steps > 20
    assert n_steps > n_file_steps
