"""A drive in order: what the belief makes of the last few views, beside sums of the same views' relevances.

The sums are SeqSLAM's, in fairness with the odometry that the belief gets: along the one diagonal that it says, or the
best of several speeds. All compare the same frames: a belief that begins so many views ago knows as little as a sum.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import moved_along
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig, LocalizerState
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.planners import CONSTANT
from deepsimbad.core.relevance import Query
from deepsimbad.errors import PastTheEndError

WINDOWS = (1, 2, 5, 10, 20)  # views
_MOST_WINDOWS = 500  # of each length; more would only take longer
_SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)  # times what odometry says
FILTER, SUM, SUM_ANY_SPEED, SUM_BRUTE_FORCE_U = "filter", "sum", "sum_any_speed", "sum_brute_force_u"


@dataclass(frozen=True)
class PassiveScores:
    """What was made of the last views, by how many they were."""

    by_window: dict[str, dict[int, RetrievalScores]]  # of the filter and of sums
    whole: RetrievalScores  # of the filter's belief after every view of the drive, from an unknown start

    def as_dict(self) -> dict[str, Any]:
        """The JSON form; percent."""
        return {
            "anr": self._by_window(lambda scores: scores.anr),
            "recall_at_1": self._by_window(lambda scores: scores.recall_at[1]),
            "n_queries": {str(n_views): scores.n_queries for n_views, scores in self.by_window[FILTER].items()},
            "whole_drive": {"anr": self.whole.anr, "recall_at_1": self.whole.recall_at[1]},
        }

    def _by_window(self, of: Callable[[RetrievalScores], float]) -> dict[str, dict[str, float]]:
        return {
            name: {str(n_views): of(scores) for n_views, scores in each.items()}
            for name, each in self.by_window.items()
        }


class _Sight(NamedTuple):
    at_m: float
    by_lists: NDArray[np.float32]  # [n] relevances
    by_all: NDArray[np.float32]  # [n] of the unit vectors that the lists stand for


def drive_in_order(
    map_: Map,
    views: Query,
    position_m: NDArray[np.float64],
    by_all: Iterable[NDArray[np.float32]],
    true_images: Sequence[NDArray[np.int64]],
    on_progress: Callable[[float], None],
) -> PassiveScores:
    """Drive along the test traverse with the localizer that ships, and with sums.

    Args:
        views: The described test frames, a batch.
        position_m: [m] theirs; how far they are apart is the odometry.
        by_all: [n] of every frame, relevances of whole unit vectors.
        true_images: For every test frame the map images that count as true.
    """
    localizer = ActiveLocalizer(map_, LocalizerConfig(planner=f"{CONSTANT}:{map_.actions_m[0]:g}"))
    scorers = {
        name: {n_views: RetrievalScorer() for n_views in WINDOWS}
        for name in (FILTER, SUM, SUM_ANY_SPEED, SUM_BRUTE_FORCE_U)
    }
    whole, state, begun = RetrievalScorer(), localizer.start(), dict[int, LocalizerState]()
    starts = set(np.linspace(0, len(true_images) - 1, min(len(true_images), _MOST_WINDOWS)).astype(int).tolist())
    seen, live = deque[_Sight](maxlen=WINDOWS[-1]), map_.live_statistics
    moved_m = np.diff(position_m, prepend=position_m[:1]).tolist()
    for frame, (truth, of_all) in enumerate(zip(true_images, by_all, strict=True)):
        view, move_m = views.at(frame), moved_m[frame]
        if frame in starts:
            begun[frame] = replace(localizer.start(), live=state.live)
        state = _stepped(localizer, state, view, move_m)
        whole.add(state.belief.mass, truth)
        live, _ = map_.after_view(live, view, move_m if frame else None)
        seen.append(_Sight(float(position_m[frame]), relevances(map_, view, live), of_all))
        begun = {
            start: _stepped(localizer, each, view, move_m)
            for start, each in begun.items()
            if frame - start < WINDOWS[-1]
        }
        for n_views in WINDOWS:
            if (window := begun.get(frame - n_views + 1)) is not None:
                last = list(seen)[-n_views:]
                scorers[FILTER][n_views].add(window.belief.mass, truth)
                scorers[SUM][n_views].add(_summed(map_, last, "by_lists", 1.0), truth)
                at_any = np.max([_summed(map_, last, "by_lists", speed) for speed in _SPEEDS], axis=0)
                scorers[SUM_ANY_SPEED][n_views].add(at_any, truth)
                scorers[SUM_BRUTE_FORCE_U][n_views].add(_summed(map_, last, "by_all", 1.0), truth)
        on_progress((frame + 1) / len(true_images))
    by_window = {name: {n_views: each.result() for n_views, each in of.items()} for name, of in scorers.items()}
    return PassiveScores(by_window, whole.result())


def _stepped(localizer: ActiveLocalizer, state: LocalizerState, view: Query, moved_m: float) -> LocalizerState:
    """After a view; a move that leads past the end is refused, and the belief stays.

    Sums take the odometry for exact, and so does the filter here.
    """
    try:
        return localizer.step(state, view, moved_m, action_std_m=0.0).state
    except PastTheEndError:
        return state


def _summed(map_: Map, last: Sequence[_Sight], which: str, speed: float) -> NDArray[np.float64]:
    """[n] relevances of the last views, each moved along to where the robot is now; the latest is last."""
    now_m, total = last[-1].at_m, np.zeros(map_.n_images)
    for sight in last:
        relevance = getattr(sight, which).astype(np.float64)
        total += moved_along(map_.route, relevance - relevance.mean(), speed * (now_m - sight.at_m))
    return total
