"""Kills a child at its n-th step of storage, for every n, and lets a test check what each death has left.

For drivers that run in a process of their own, so that forking is sound. A step is one call that may change the disk: a
SQL statement, a rename, an unlink, a sync, ... seen by the interpreter's profile hook, not by stand-ins.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

FILE_STEPS = {"rename", "unlink", "rmtree", "fsync", "mkdir", "rmdir", "chmod", "flock", "open", "close"}
SQL_STEPS = {"execute", "executemany"}
PROJECT = Path(__file__).resolve().parents[1]

Words = list[str]  # that the child wrote before it died


def expect(is_true: bool, claim: str) -> None:
    if not is_true:
        raise SystemExit(f"broken: {claim}")


def _kill_at(fatal_step: int, steps: set[str]) -> Callable[[object, str, object], None]:
    n_steps = 0

    def hook(_frame: object, event: str, function: object) -> None:
        nonlocal n_steps
        if event == "c_call" and getattr(function, "__name__", "") in steps:
            n_steps += 1
            if n_steps == fatal_step:
                os.kill(os.getpid(), signal.SIGKILL)

    return hook


def _tell(pipe: int, word: str) -> None:
    os.write(pipe, f"{word} ".encode())


def kill_at_every_step(
    folder: Path,
    plans: Iterable[tuple[set[str], int]],
    prepare: Callable[[Path], object],
    run: Callable[[Path, Callable[[str], None]], object],
    check: Callable[[Path, Words], None],
    set_profile: Callable[[object], None] = sys.setprofile,
) -> None:
    """Print for each plan (kinds of steps, stride) how many steps there are; `run` gets a function to tell a word."""
    for steps, step_by in plans:
        fatal_step, has_survived = 1, False
        while not has_survived:
            data_dir = folder / "killed"
            prepare(data_dir)
            reader, writer = os.pipe()
            child = os.fork()
            if child == 0:
                set_profile(_kill_at(fatal_step, steps))
                run(data_dir, partial(_tell, writer))
                set_profile(None)
                os._exit(0)
            os.close(writer)
            _, status = os.waitpid(child, 0)
            words = os.read(reader, 1000).decode().split()
            os.close(reader)
            has_survived = not os.WIFSIGNALED(status)
            expect(status == (0 if has_survived else signal.SIGKILL), f"the child ended with {status} after {words}")
            try:
                check(data_dir, words)
            except BaseException as error:
                raise SystemExit(
                    f"killed at step {fatal_step} of {len(steps)} kinds after {words}: {error!r}"
                ) from error
            shutil.rmtree(data_dir)
            fatal_step += step_by
        print(fatal_step - step_by, end=" ", flush=True)


def steps_of(driver: str, *arguments: object) -> list[int]:
    """Run a driver, which must find nothing broken; returns how many steps of each plan it tried."""
    process = subprocess.run(
        [sys.executable, "-m", driver, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=PROJECT,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    assert process.returncode == 0, process.stderr
    return [int(word) for word in process.stdout.split()]
