"""What every measurement needs: the machine, medians, limits, the real recordings, the page it writes."""

import math
import os
import platform
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

PROJECT = Path(__file__).resolve().parent.parent
ACTIONS_M = tuple(float(metres) for metres in range(1, 11))


def machine() -> str:
    """One line: processor, cores, memory, Python and the libraries that matter."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "opencv-python-headless"))
    return (
        f"Machine: {(names or [platform.machine()])[0]}, {len(os.sched_getaffinity(0))} cores, {memory_gib:.0f} GiB, "
        f"Python {platform.python_version()}, {libraries}; {datetime.now(UTC).date().isoformat()}"
    )


def write_page(name: str, lines: Iterable[str]) -> None:
    """Print the lines as they come, then write them as a page of docs/results."""
    page_lines = []
    for line in lines:
        print(line, flush=True)
        page_lines.append(line)
    page = PROJECT / "docs" / "results" / name
    page.write_text("\n".join(page_lines) + "\n", encoding="utf-8")
    print(f"written to {page}", file=sys.stderr)


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """A table, line by line, as its rows are measured."""
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(map(str, row))} |"


@dataclass(frozen=True)
class Timing:
    """Seconds of repeated runs of one thing."""

    seconds: Sequence[float]

    @property
    def median_s(self) -> float:
        """The figure to quote."""
        return statistics.median(self.seconds)

    def __str__(self) -> str:
        low, high = min(self.seconds), max(self.seconds)
        return f"{duration(self.median_s)} ({duration(low)} .. {duration(high)}, {len(self.seconds)} runs)"


def duration(seconds: float) -> str:
    """A duration with three digits in the unit that suits it."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


def timed(run: Callable[[], object], repeats: int, warm_up: int = 2) -> Timing:
    """Time a call again and again."""
    return interleaved([run], repeats, warm_up)[0]


def interleaved(runs: Sequence[Callable[[], object]], repeats: int, warm_up: int = 1) -> list[Timing]:
    """Time several calls in turn, so that a machine that slows down slows all of them."""
    seconds = [[_seconds(run) for run in runs] for _ in range(warm_up + repeats)][warm_up:]
    return [Timing(column) for column in zip(*seconds, strict=True)]


def _seconds(run: Callable[[], object]) -> float:
    start_s = perf_counter()
    run()
    return perf_counter() - start_s


def real_recordings() -> Path:
    """The folder named by DEEPSIMBAD_REAL_DATA, else `../shared/data` beside the project.

    Raises:
        FileNotFoundError: There is none.
    """
    folder = Path(os.environ.get("DEEPSIMBAD_REAL_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise FileNotFoundError(f"no real recordings at {folder}: set DEEPSIMBAD_REAL_DATA to their folder")
    return folder


@dataclass(frozen=True)
class Limit:
    """A figure, with its unit in its name, and what it may be at most."""

    name: str
    figure: float
    at_most: float

    @property
    def is_kept(self) -> bool:
        """Whether the figure is within the limit; one that is not finite is not."""
        return math.isfinite(self.figure) and self.figure <= self.at_most

    def __str__(self) -> str:
        return f"{self.name}: {self.figure:.3g}, at most {self.at_most:g}"


def limit_table(limits: Sequence[Limit]) -> Iterator[str]:
    """Markdown lines."""
    verdicts = {True: "PASS", False: "**over**"}
    rows = [(limit.name, f"{limit.at_most:g}", f"{limit.figure:.3g}", verdicts[limit.is_kept]) for limit in limits]
    return markdown(("limit", "at most", "found", ""), rows)


def breaches(limits: Sequence[Limit]) -> str | None:
    """The limits that are not kept, on one line, for a command to end with; None where all are kept."""
    over = [str(limit) for limit in limits if not limit.is_kept]
    return f"over the limit: {'; '.join(over)}" if over else None
