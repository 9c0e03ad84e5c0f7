"""Fixtures shared by every test."""

import fcntl
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from deepsimbad_campus import camera
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.http import local_server

from . import fork_server

# Compilation on a first call is no slowness of the code under test, and a run is the same everywhere.
settings.register_profile("project", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("project")

# Whoever runs the tests may have settings of their own; these are for the processes that tests start.
for name in [name for name in os.environ if name.startswith("DEEPSIMBAD_") and name != "DEEPSIMBAD_REAL_DATA"]:
    del os.environ[name]
os.environ["DEEPSIMBAD_JOB_PRIORITY"] = (
    "normal"  # tests keep every core busy: an idle-class job would wait for them all
)
# Every core is busy with a test of its own, and OpenBLAS's threads spin for 20 ms after each product.
threadpool_limits(1, user_api="blas")
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes that tests start, and of libraries that are loaded later
os.environ["GOMP_SPINCOUNT"] = "1000"  # threads of OpenMP that spin would keep each other waiting
os.environ.pop("COLUMNS", None)  # a parallel run sets one, too narrow for the tables that a pipe gets
# Without bytecode every process would compile the sources, and the asserts of all tests, anew: they begin many.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A run in the background of a script ignores Ctrl-C, and so would every process that the tests begin and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

PROJECT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings; the test is skipped, saying so, where it is absent."""
    folder = Path(os.environ.get("DEEPSIMBAD_REAL_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}: set DEEPSIMBAD_REAL_DATA to their folder")
    return folder


@contextmanager
def one_at_a_time(shared: Path, name: str) -> Iterator[None]:
    """A block that only one process at a time runs, among those that share the folder and the name."""
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """The folder of all test processes."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def rendered(shared) -> Path:
    """36 frames of a campus in all seasons, in NCLT's layout: rendered once for all test processes, never changed.

    Pictures are half as wide and tall as NCLT's, of which tests decode thousands.
    """
    with one_at_a_time(shared, "campus"), pytest.MonkeyPatch.context() as patched:
        patched.setattr(camera, "UPRIGHT_SIZE", tuple(pixels // 2 for pixels in camera.UPRIGHT_SIZE))
        write_campus(shared / "campus", n_frames=36)  # what is there already is left as it is
    return shared / "campus"


@cache
def _compile(shared: Path) -> None:
    """Compile the kernels once for all test processes: in a new checkout each would spend half a minute on it."""
    from deepsimbad.engine.localizer import warm_up  # noqa: PLC0415 - seconds that a single file may do without

    from .commands import run_command  # noqa: PLC0415

    with one_at_a_time(shared, "kernels"):
        if not (folder := shared / "kernels").exists():
            folder.mkdir()
            np.save(folder / "drive.npy", np.random.default_rng(0).normal(size=(60, 8)).astype(np.float32))
            warm_up()
            run_command(
                "deepsimbad map drive --landmarks drive.npy --training drive.npy --evaluator feature_l2:none", folder
            )


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Compile the kernels before any fixture of a test; tests of packaging bring their own and need not wait."""
    if "PYTEST_XDIST_WORKER" in os.environ and item.path.parent.name != "packaging":
        _compile(Path(item.config.option.basetemp).parent)


@pytest.fixture(scope="session", autouse=True)
def _forked() -> Iterator[None]:
    """Let services be forked rather than started anew."""
    with pytest.MonkeyPatch.context() as patched:
        forking = SimpleNamespace(**{**vars(subprocess), "Popen": fork_server.Popen})
        patched.setattr(local_server, "subprocess", forking)
        yield
    fork_server.SERVER.close()


@pytest.fixture
def _logging_as_before():
    """Restore the loggers after a test that configures logging as a service does."""
    loggers = [logging.getLogger(name) for name in (None, "deepsimbad", "uvicorn", "uvicorn.error", "uvicorn.access")]
    levels, handlers = [logger.level for logger in loggers], logging.getLogger().handlers[:]
    yield
    logging.getLogger().handlers[:] = handlers
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One process more than cores, since many tests wait for a service that they have started."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort files with slow tests first, so that no process is left alone with one at the end.

    Tests of packaging come before all: they have something to do while another process compiles the kernels.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, item.path.parent.name != "packaging"))
