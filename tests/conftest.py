"""Fixtures shared by every test."""

import fcntl
import logging
import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from deepsimbad_campus.writer import write_campus

# Compilation on a first call is no slowness of the code under test, and a run is the same everywhere.
settings.register_profile("project", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("project")

# Whoever runs the tests may have settings of their own; these are for the processes that tests start.
for name in [name for name in os.environ if name.startswith("DEEPSIMBAD_") and name != "DEEPSIMBAD_REAL_DATA"]:
    del os.environ[name]
os.environ["DEEPSIMBAD_JOB_PRIORITY"] = (
    "normal"  # tests keep every core busy: an idle-class job would wait for them all
)
os.environ["GOMP_SPINCOUNT"] = "1000"  # every core is busy: threads that spin would keep each other waiting
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


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Path:
    """36 frames of a campus in all seasons, in NCLT's layout: rendered once for all test processes, never changed."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with (shared / "campus.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        write_campus(shared / "campus", n_frames=36)  # what is there already is left as it is
    return shared / "campus"


@pytest.fixture
def _logging_as_before():
    """For tests that configure logging as a service does."""
    loggers = [logging.getLogger(name) for name in (None, "deepsimbad", "uvicorn", "uvicorn.error", "uvicorn.access")]
    levels, handlers = [logger.level for logger in loggers], logging.getLogger().handlers[:]
    yield
    logging.getLogger().handlers[:] = handlers
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One process more than cores: many tests wait for a service that they have begun."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first, so that no process is left alone with one at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
