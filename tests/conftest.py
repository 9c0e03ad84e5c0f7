"""Fixtures shared by every test."""

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

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
