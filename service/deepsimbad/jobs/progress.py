"""How work reports its progress and learns that it should stop."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from threading import Lock

from deepsimbad.errors import CancelledError
from deepsimbad.evaluators.compute import available_cores

_INTERVAL_S = 0.2  # least time between two reports of one stage


@dataclass(frozen=True)
class ProgressState:
    """How far a job is at one moment."""

    stage: str  # the stage under way
    progress: float  # share of all stages done, 0..1
    # Seconds that are probably left: of the stage under way by its own pace, of those after it by the pace of all; None
    # while too little is done to tell
    eta_s: float | None


class Progress:
    """Stages of known weight, reported as one share of the whole, and timed.

    Args:
        stages: Every stage in order, with its expected share of the time (any positive numbers).
        on_change: Called with each new state, now and then within a stage.
        is_cancelled: Asked at every report; work stops with CancelledError once it answers true.
        clock: Seconds, monotonic.
    """

    def __init__(
        self,
        stages: Mapping[str, float],
        on_change: Callable[[ProgressState], None] | None = None,
        is_cancelled: Callable[[], bool] = lambda: False,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._weights = dict(stages)
        self._on_change = on_change
        self._is_cancelled = is_cancelled
        self._clock = clock
        self._started_s = clock()
        self._reported_s = float("-inf")
        self._began_s: dict[str, float] = {}  # when each stage began, in order

    def check(self) -> None:
        """Raise CancelledError if the work was cancelled; reports nothing."""
        if self._is_cancelled():
            raise CancelledError(
                f"cancelled while it was at: {list(self._began_s)[-1]}" if self._began_s else "cancelled"
            )

    def stage(self, name: str) -> None:
        """Begin a stage; those before it count as done."""
        if name not in self._weights:
            raise ValueError(f"stage {name!r} is not one of {list(self._weights)}")
        self._began_s[name] = self._clock()
        self._reported_s = float("-inf")
        self.update(0.0)

    def update(self, share: float) -> None:
        """Report the share of the present stage that is done, 0..1. Raises CancelledError: the work was cancelled."""
        self.check()
        now_s = self._clock()
        if self._on_change is None or now_s - self._reported_s < _INTERVAL_S:
            return
        self._reported_s = now_s
        *_, (stage, began_s) = self._began_s.items()
        names = list(self._weights)
        total = sum(self._weights.values())
        finished_share = sum(self._weights[name] for name in names[: names.index(stage)]) / total
        weight = self._weights[stage] / total
        total_share = finished_share + share * weight
        eta_s = None
        if total_share > 0.01:
            pace_s = (now_s - self._started_s) / total_share
            # A stage may take a multiple of its expected share: its weight does not know how many episodes it has.
            stage_left_s = (now_s - began_s) * (1 - share) / share if share > 0.01 else pace_s * weight * (1 - share)
            eta_s = stage_left_s + pace_s * max(0.0, 1 - total_share - weight * (1 - share))
        self._on_change(ProgressState(stage, total_share, eta_s))

    def seconds(self, stages: Collection[str]) -> dict[str, float]:
        """The seconds that each of some stages took so far, by its name with underscores."""
        ends_s = zip(self._began_s.items(), [*list(self._began_s.values())[1:], self._clock()], strict=True)
        return {name.replace(" ", "_"): end_s - began_s for (name, began_s), end_s in ends_s if name in stages}


@dataclass
class Shares:
    """Pieces of work of known weight that several threads do, reported as one share."""

    tell: Callable[[str, float], None]  # takes the piece under way and the share done; may raise CancelledError
    weights: Mapping[str, float]
    _shares: dict[str, float] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def report(self, name: str) -> Callable[[float], None]:
        """A function that takes the share done of one piece."""

        def update(share: float) -> None:
            with self._lock:
                self._shares[name] = share
                weighted_share = sum(self.weights[piece] * piece_share for piece, piece_share in self._shares.items())
            self.tell(name, weighted_share / max(sum(self.weights.values()), 1e-9))

        return update


def in_threads(pieces: Sequence[Callable[[], None]]) -> None:
    """Do all pieces, as many at once as there are cores; the first error ends them, and is raised."""
    with ThreadPoolExecutor(available_cores()) as pool:
        futures = [pool.submit(piece) for piece in pieces]
        finished_futures, waiting_futures = wait(futures, return_when=FIRST_EXCEPTION)
        for future in waiting_futures:
            future.cancel()
        for future in finished_futures:
            future.result()
