"""The contract tests of HTTP, unchanged, against a fleet: here those that tell most in a minute.

All of them: `TEST_FLEET=1 pytest tests/contract`.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="the extra `ray` is not installed", exc_type=ImportError)

ROOT = Path(__file__).parents[2]
FILES = ("lists", "truths", "localizations")


@pytest.mark.slow
def test_a_fleet_keeps_the_contract():
    files = [f"tests/contract/test_{name}.py" for name in FILES]
    # It is no part of this run.
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_XDIST_WORKER"}
    process = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *files],
        cwd=ROOT,
        env={**environment, "TEST_FLEET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stdout[-5000:]
    assert " passed" in process.stdout
