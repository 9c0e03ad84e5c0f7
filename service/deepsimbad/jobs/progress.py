"""How long work tells what it is doing and learns that it should stop."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from deepsimbad.errors import CancelledError


@dataclass(frozen=True)
class ProgressState:
    """One moment of a job."""

    stage: str  # the stage under way
    progress: float  # share of all stages done, 0..1
    # Seconds that are probably left: of the stage under way by its own pace, of those after it by the pace of all; None
    # while too little is done to tell
    eta_s: float | None


class Progress:
    """Stages of known weight, reported as one share of the whole.

    Args:
        stages: Every stage in order, with its expected share of the time (any positive numbers).
        on_change: Called with each new state, at most every `interval_s` within a stage.
        is_cancelled: Asked at every report; work stops with CancelledError once it answers true.
        interval_s: Least seconds between two reports of one stage.
        clock: Seconds, monotonic.
    """

    def __init__(
        self,
        stages: Mapping[str, float],
        on_change: Callable[[ProgressState], None] | None = None,
        is_cancelled: Callable[[], bool] | None = None,
        *,
        interval_s: float = 0.2,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._weights = dict(stages)
        self._on_change = on_change
        self._is_cancelled = is_cancelled
        self._interval_s = interval_s
        self._clock = clock
        self._started_s = clock()
        self._reported_s = float("-inf")
        self._stage_began_s = self._started_s
        self._stage = ""

    def check(self) -> None:
        """Raise CancelledError if the work was cancelled; reports nothing."""
        if self._is_cancelled is not None and self._is_cancelled():
            raise CancelledError(f"cancelled while it was at: {self._stage}" if self._stage else "cancelled")

    def stage(self, name: str) -> None:
        """Begin a stage; those before it count as done."""
        if name not in self._weights:
            raise ValueError(f"stage {name!r} is not one of {list(self._weights)}")
        self._stage = name
        self._stage_began_s = self._clock()
        self._report(0.0, always=True)

    def update(self, share: float) -> None:
        """Report the share of the present stage that is done, 0..1.

        Raises:
            CancelledError: The work was cancelled.
        """
        self._report(share, always=False)

    def _report(self, share: float, *, always: bool) -> None:
        self.check()
        now_s = self._clock()
        if self._on_change is None or (not always and now_s - self._reported_s < self._interval_s):
            return
        self._reported_s = now_s
        names = list(self._weights)
        total = sum(self._weights.values())
        before = sum(self._weights[name] for name in names[: names.index(self._stage)]) / total
        weight = self._weights[self._stage] / total
        done = before + share * weight
        self._on_change(ProgressState(self._stage, done, self._eta_s(now_s, share, weight, done)))

    def _eta_s(self, now_s: float, share: float, weight: float, done: float) -> float | None:
        if done <= 0.01:
            return None
        pace_s = (now_s - self._started_s) / done
        # A stage may take a multiple of its expected share: its weight does not know how many episodes were asked for.
        if share > 0.01:
            of_stage_s = (now_s - self._stage_began_s) * (1 - share) / share
        else:
            of_stage_s = pace_s * weight * (1 - share)
        return of_stage_s + pace_s * max(0.0, 1 - done - weight * (1 - share))
