"""What every measurement needs: its command, the machine, medians, limits, the page it writes."""

import math
import os
import platform
import statistics
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from subprocess import CalledProcessError
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.errors import DeepSimbadError, nearest_of
from deepsimbad_client.errors import DeepSimbadClientError

PROJECT = Path(__file__).resolve().parent.parent
RESULTS = PROJECT / "docs" / "results"
ACTIONS_M = tuple(float(metres) for metres in range(1, 11))


class Command(ArgumentParser):
    """A measurement's command line, whose `--help` prints the module's docstring."""

    def __init__(self, document: str | None) -> None:
        module = ".".join(Path(sys.argv[0]).resolve().relative_to(PROJECT).with_suffix("").parts)
        prog = f"python -m {module.removesuffix('.__main__')}"
        super().__init__(prog=prog, description=document, formatter_class=RawDescriptionHelpFormatter)

    def run(self, measure: Callable[[Namespace], object], words: Sequence[str] | None = None) -> None:
        """Measure what the words ask for, None: those of the command line.

        A file that is not there ends it with 2, an error of ours or of a command of ours with 1, in one line.
        """
        arguments = self.parse_args(words)
        try:
            measure(arguments)
        except OSError as error:
            self.exit(2, f"{self.prog}: {error}\n")
        except (DeepSimbadError, DeepSimbadClientError, CalledProcessError) as error:
            self.exit(1, f"{self.prog}: {error}\n")


def one_of(names: Collection[str]) -> Callable[[str], str]:
    """The type of arguments that are some of the names, perhaps none, which `choices` would refuse."""

    def checked(word: str) -> str:
        if word not in names:
            raise ArgumentTypeError(f"there is no {word!r}{nearest_of(word, names)}")
        return word

    return checked


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


def print_page(lines: Iterable[str], page: Path | None = None) -> None:
    """Print the lines as they come, then write them to a page where one is given."""
    page_lines = []
    for line in lines:
        print(line, flush=True)
        page_lines.append(line)
    if page is not None:
        page.write_text("\n".join(page_lines) + "\n", encoding="utf-8")
        print(f"written to {page}", file=sys.stderr)


@contextmanager
def work_folder(folder: Path | None = None) -> Iterator[Path]:
    """A folder to work in, made where it is not there; None: a temporary one."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as temporary:  # a fleet's processes may write on for a moment
        work = folder or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        yield work


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """A table, line by line, as its rows are measured."""
    yield from (f"| {' | '.join(head)} |", "|---" * len(head) + "|")
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


def scored(rows: Iterable[NDArray[np.floating]], truths: Iterable[NDArray[np.int64]]) -> RetrievalScores:
    """Scores of the relevances [n] to every view, whose true images these are."""
    scorer = RetrievalScorer()
    for row, true_images in zip(rows, truths, strict=True):
        scorer.add(row, true_images)
    return scorer.result()


def figures(scores: Sequence[RetrievalScores]) -> list[str]:
    """Mean ANR and R@1, and the worst ANR, in percent."""
    anr = [score.anr for score in scores]
    return [f"{np.mean(anr):.2f}", f"{np.mean([score.recall_at[1] for score in scores]):.1f}", f"{max(anr):.2f}"]


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
