"""`python -m bench.soak`, and `make soak`: the report of one soak."""

import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.measurement import Command, Limit, breaches, limit_table, machine, markdown, print_page, work_folder
from bench.soak.trial import LONGEST_LIFE_S, Soak, soak

READY_WITHIN_S = 2.0


def limits(result: Soak) -> list[Limit]:
    """What must be kept: every single start, the longest too."""
    return [Limit("ready again after a kill, the longest start, seconds", max(result.ready_s), READY_WITHIN_S)]


def report(result: Soak) -> Iterator[str]:
    """Markdown lines."""
    ready, empty = np.array(result.ready_s), np.array(result.empty_ready_s)
    longest = int(ready.argmax())
    yield from ("# kill -9 under load", "")
    yield "Made by `make soak`: the service is killed at random moments while robots observe, begin and end sessions,"
    yield "traverses are uploaded and deleted, and maps are made, activated and rolled back; then everything that was"
    yield "acknowledged is looked for. A run that misses anything, or finds a damaged file, ends with an error instead."
    yield from ("", machine(), "")
    kills = (
        f"kills, each 0 to {LONGEST_LIFE_S:g} s after the service was ready: in turn at any time, during an upload, "
        "a remap, an activation, a rollback"
    )
    rows = {
        kills: len(result.ready_s),
        **{f"acknowledged writes: {actor.lower()}": f"{count:,}" for actor, count in result.n_acknowledged.items()},
        "acknowledged writes lost": 0,
        "damaged files (`deepsimbad check`, and bit by bit)": 0,
        "remaps that succeeded, many of them across kills": result.n_remaps,
        "remaps given up, and saying so, after three deaths under them": result.n_interrupted,
        "start of the process to `/readyz` 200, embedded extractor loaded": _spread(ready, "s"),
        "the same on an empty data directory, right before each of them": _spread(empty, "s"),
        "the one divided by the other, start by start": _spread(ready / empty, "times"),
        "right before the longest, on an empty data directory": f"{empty[longest]:.2f} s",
    }
    yield from markdown(("", ""), rows.items())
    yield ""
    yield "A machine that is busy slows both kinds of start; a ratio that grows is the service's own doing."
    yield ""
    yield from limit_table(limits(result))
    yield from ("", "What uploader and mapper were about when it died (robots observe all the time):", "")
    yield from markdown(("", "kills"), sorted(result.doing.items(), key=lambda item: -item[1]))


def _spread(figures: NDArray[np.float64], unit: str) -> str:
    return (
        f"median {np.median(figures):.2f} {unit}, 95 % within {np.quantile(figures, 0.95):.2f} {unit}, "
        f"longest {figures.max():.2f} {unit}"
    )


def measure(arguments: Namespace) -> None:
    """Run one soak and print its report; ends with 1 where a start took too long."""
    with work_folder() as folder:
        result = soak(
            folder / "data",
            arguments.kills,
            arguments.seed,
            lambda n_kills: print(f"\r{n_kills} of {arguments.kills} kills", end="", file=sys.stderr, flush=True),
        )
    print(file=sys.stderr)
    print_page(report(result), arguments.out)
    sys.exit(breaches(limits(result)))


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("--kills", type=int, default=200)
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--out", type=Path, help="write the report here as well")
    command.run(measure)
