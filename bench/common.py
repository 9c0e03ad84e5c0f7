"""What every measurement needs: the machine, medians, limits, the real recordings."""

import math
import os
import platform
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import perf_counter


def describe() -> str:
    """One line: processor, cores, memory, Python and the libraries that matter."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "opencv-python-headless"))
    today = datetime.now(UTC).date().isoformat()
    return (
        f"{_processor()}, {len(os.sched_getaffinity(0))} cores, {_memory_gib():.0f} GiB, "
        f"Python {platform.python_version()}, {libraries}; {today}"
    )


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


@dataclass(frozen=True)
class Timing:
    """Seconds of repeated runs of one thing."""

    seconds: tuple[float, ...]

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


def interleaved(runs: list[Callable[[], object]], repeats: int, warm_up: int = 1) -> list[Timing]:
    """Time several calls in turn, so that a machine that slows down slows all of them."""
    seconds: list[list[float]] = [[] for _ in runs]
    for repeat in range(warm_up + repeats):
        for kept, run in zip(seconds, runs, strict=True):
            began = perf_counter()
            run()
            spent = perf_counter() - began
            if repeat >= warm_up:
                kept.append(spent)
    return [Timing(tuple(kept)) for kept in seconds]


_PROJECT = Path(__file__).resolve().parent.parent
RESULTS = _PROJECT / "docs" / "results"


def real_recordings() -> Path:
    """The folder named by DEEPSIMBAD_REAL_DATA, else `../shared/data` beside the project.

    Raises:
        FileNotFoundError: There is none.
    """
    folder = Path(os.environ.get("DEEPSIMBAD_REAL_DATA", _PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise FileNotFoundError(f"no real recordings at {folder}: set DEEPSIMBAD_REAL_DATA to their folder")
    return folder


@dataclass(frozen=True)
class Limit:
    """A figure and what it may be at most.

    Attributes:
        what: Of which thing, with its unit.
        found: The figure.
        at_most: The limit.
    """

    what: str
    found: float
    at_most: float

    @property
    def is_kept(self) -> bool:
        """A figure that could not be taken keeps no limit."""
        return math.isfinite(self.found) and self.found <= self.at_most

    def __str__(self) -> str:
        return f"{self.what}: {self.found:.3g}, at most {self.at_most:g}"


def limit_table(limits: Sequence[Limit]) -> Iterator[str]:
    """Markdown lines."""
    yield "| limit | at most | found | |"
    yield "|---|---|---|---|"
    for limit in limits:
        verdict = "PASS" if limit.is_kept else "**over**"
        yield f"| {limit.what} | {limit.at_most:g} | {limit.found:.3g} | {verdict} |"


def breaches(limits: Sequence[Limit]) -> str | None:
    """What is over, on one line, for a command to end with; None where all is kept."""
    over = [str(limit) for limit in limits if not limit.is_kept]
    return f"over the limit: {'; '.join(over)}" if over else None
