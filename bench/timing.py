"""Medians, because machines are shared and noisy."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter


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
