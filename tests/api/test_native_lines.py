"""What libraries print past Python becomes few lines of JSON; a crash still says where."""

import json
import subprocess
import sys
import textwrap

from deepsimbad.api.native_lines import LINES_A_MINUTE, Ration

BEGIN = """
import faulthandler, os, sys
from deepsimbad.api.logs import configure_logging
from deepsimbad.api.native_lines import native_lines_in_the_log
"""


def said(program: str) -> tuple[int, list[str]]:
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + textwrap.dedent(program)], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stderr.splitlines()


def test_a_flood_is_a_few_lines_and_a_number() -> None:
    code, lines = said("""
        with native_lines_in_the_log():
            configure_logging("INFO")
            for number in range(500):
                os.write(2, b"Corrupt JPEG data: %d\\xff\\n" % number)
            os.write(2, b"x" * 10_000)
        os.write(2, b"and as before\\n")
    """)
    assert code == 0
    assert lines.pop() == "and as before"
    logged = [json.loads(line) for line in lines]
    assert [line["message"] for line in logged] == ["a library said"] * LINES_A_MINUTE + ["libraries said more"]
    assert logged[0]["line"].startswith("Corrupt JPEG data: 0")
    assert {line["level"] for line in logged} == {"WARNING"}
    assert logged[-1]["n_lines"] >= 500 - LINES_A_MINUTE


def test_a_flood_that_nobody_can_read_keeps_nobody() -> None:
    code, lines = said("""
        import ctypes
        with native_lines_in_the_log():
            configure_logging("INFO")
            written = [ctypes.PyDLL(None).write(2, b"y" * 999 + b"\\n", 1000) for _ in range(10_000)]  # holds the lock
    """)
    assert code == 0
    assert len(lines) <= LINES_A_MINUTE + 1
    assert all(json.loads(line) for line in lines)


def test_a_crash_and_an_error_are_told_as_they_are() -> None:
    code, lines = said("""
        with native_lines_in_the_log():
            faulthandler._sigsegv()
    """)
    assert code < 0
    assert lines[0] == "Fatal Python error: Segmentation fault"
    code, lines = said("""
        with native_lines_in_the_log():
            raise RuntimeError("seen")
    """)
    assert code == 1
    assert lines[-1] == "RuntimeError: seen"


def test_where_standard_error_is_closed_nothing_breaks() -> None:
    done = subprocess.run(
        ["sh", "-c", '"$0" -c "$1" 2>&-', sys.executable, BEGIN + "with native_lines_in_the_log(): print('went on')"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "went on\n")


def test_every_minute_has_its_ration_and_what_was_left_out_is_told_at_its_end() -> None:
    now = 100.0
    ration = Ration(lambda: now)
    assert [ration.lets() for _ in range(LINES_A_MINUTE + 2)] == [True] * LINES_A_MINUTE + [False] * 2
    now += 20.0
    assert ration.tells_in_s == 40.0
    now += 45.0
    assert not ration.lets(), "first it is told how many were left out"
    assert ration.tells_in_s == 0.0
    assert ration.left_out() == 3
    assert ration.tells_in_s is None
    assert ration.lets()
