"""The process may open as many files as its connections need."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("resource")

TRY = """
import json, logging, resource, sys
from deepsimbad.api.open_files import allow_open_files
soft, hard, n_connections = map(int, sys.argv[1:])
resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
logging.basicConfig(format="%(message)s")
allow_open_files(n_connections)
print(json.dumps(resource.getrlimit(resource.RLIMIT_NOFILE)))
"""


@pytest.mark.parametrize(
    ("soft", "hard", "n_connections", "after", "warns"),
    [
        (200, 4000, 100, [612, 4000], False),
        (2000, 4000, 100, [2000, 4000], False),
        (200, 400, 100, [400, 400], True),
        (400, 400, 100, [400, 400], True),
    ],
)
def test_the_limit_is_raised_as_far_as_it_may(
    soft: int, hard: int, n_connections: int, after: list[int], warns: bool
) -> None:
    arguments = [str(number) for number in (soft, hard, n_connections)]
    ran = subprocess.run([sys.executable, "-c", TRY, *arguments], capture_output=True, text=True, check=True)
    assert json.loads(ran.stdout) == after
    assert ("ulimit -n" in ran.stderr) is warns
