"""`python -m bench.load`, and `make load`: the report of one run under load."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.common import describe
from bench.load.drivers import N_IMAGES, SESSION_LENGTH
from bench.load.trial import N_ROBOTS, Load, load


def report(found: Load, observe_every_s: float) -> Iterator[str]:
    """Markdown lines."""
    spent_ms = 1000 * np.array(found.observation_s)
    yield "# An hour under load" if found.seconds >= 3600 else f"# {found.seconds / 60:.1f} minutes under load"
    yield ""
    yield f"Made by `make load`: {N_ROBOTS} robots with an observation every {observe_every_s:g} s each, sessions of"
    yield f"{SESSION_LENGTH} views whose true positions are fed back, on a domain of {N_IMAGES:,} map images that is"
    yield "remapped, rolled back and forward all the while, with traverses coming and going."
    yield ""
    yield f"Machine: {describe()}; robots, remaps and service share it."
    yield ""
    yield "| | |"
    yield "|---|---|"
    yield f"| minutes | {found.seconds / 60:.1f} |"
    yield f"| requests answered as they should be | {found.n_requests:,} |"
    yield f"| errors | {len(found.errors)} |"
    yield f"| remaps, activations of another version | {found.n_remaps}, {found.n_rollbacks} |"
    yield (
        f"| an observation, durable | median {np.median(spent_ms):.1f} ms, 99 % within "
        f"{np.quantile(spent_ms, 0.99):.1f} ms, longest {spent_ms.max():.0f} ms |"
    )
    yield ""
    yield "The service's process, medians over the quarters of the run:"
    yield ""
    yield "| quarter | resident memory, MB | file handles | threads |"
    yield "|---|---|---|---|"
    for number in range(4):
        part = found.quarter(number)
        yield f"| {number + 1} | {part.rss_mb:.0f} | {part.n_handles} | {part.n_threads} |"
    for error in found.errors:
        yield f"\n    {error}"


def main() -> None:
    """Run once and print the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--observe-every", type=float, default=1.0, metavar="SECONDS")
    parser.add_argument("--remap-every", type=float, default=60.0, metavar="SECONDS")
    parser.add_argument("--out", type=Path, help="write the report here as well")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = load(
            Path(folder) / "data",
            60 * given.minutes,
            given.observe_every,
            given.remap_every,
            on_sample=lambda now: print(
                f"\r{now.at_s / 60:.1f} min, {now.rss_mb:.0f} MB, {now.n_handles} handles ",
                end="",
                file=sys.stderr,
                flush=True,
            ),
        )
    text = "\n".join(report(found, given.observe_every)) + "\n"
    print(file=sys.stderr)
    print(text, end="")
    if given.out is not None:
        given.out.write_text(text, encoding="utf-8")
    sys.exit(1 if found.errors else 0)


if __name__ == "__main__":
    main()
