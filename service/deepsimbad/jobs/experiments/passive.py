"""A drive in order: what the belief makes of the last few views, beside sums of the same views' relevances.

The sums are SeqSLAM's, with the odometry that the belief gets too: along the one diagonal that it gives, or the best of
several speeds. All use the same views: a belief that begins so many views ago knows as little as a sum.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import moved_along
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig, LocalizerState
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import Query

WINDOWS = (1, 2, 5, 10, 20)  # views
_MOST_WINDOWS = 500  # of each length; more would only take longer
_SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)  # times what odometry says
FILTER, SUM, SUM_ANY_SPEED, SUM_BRUTE_FORCE_U = "filter", "sum", "sum_any_speed", "sum_brute_force_u"


@dataclass(frozen=True)
class PassiveScores:
    """Scores of the filter and of sums by the number of the last views that they used."""

    by_window: dict[str, dict[int, RetrievalScores]]  # by method and number of views
    whole_drive: RetrievalScores  # of the filter's belief after every view of the drive, from an unknown start

    def as_dict(self) -> dict[str, Any]:
        """The JSON form; percent."""
        return {
            "anr": self._by_window(lambda scores: scores.anr),
            "recall_at_1": self._by_window(lambda scores: scores.recall_at[1]),
            "n_queries": {str(n_views): scores.n_queries for n_views, scores in self.by_window[FILTER].items()},
            "whole_drive": {"anr": self.whole_drive.anr, "recall_at_1": self.whole_drive.recall_at[1]},
        }

    def _by_window(self, figure: Callable[[RetrievalScores], float]) -> dict[str, dict[str, float]]:
        return {
            name: {str(n_views): figure(scores) for n_views, scores in window_scores.items()}
            for name, window_scores in self.by_window.items()
        }


class _ViewRelevances(NamedTuple):
    position_m: float
    list_relevances: NDArray[np.float32]  # [n] relevances
    all_relevances: NDArray[np.float32]  # [n] of the unit vectors that the lists stand for


def drive_in_order(
    map_: Map,
    views: Query,
    position_m: NDArray[np.float64],
    all_relevances: Iterable[NDArray[np.float32]],
    true_images: Sequence[NDArray[np.int64]],
    on_progress: Callable[[float], None],
) -> PassiveScores:
    """Drive along the test traverse with the localizer that ships, and with sums.

    Args:
        views: The described test frames, a batch.
        position_m: [m] positions of the test frames; their differences are the odometry.
        all_relevances: [n] of every frame, relevances of whole unit vectors.
        true_images: For every test frame the map images that count as true.
    """
    localizer = ActiveLocalizer(map_, LocalizerConfig())
    scorers = {
        name: {n_views: RetrievalScorer() for n_views in WINDOWS}
        for name in (FILTER, SUM, SUM_ANY_SPEED, SUM_BRUTE_FORCE_U)
    }
    drive_scorer, state, window_states = RetrievalScorer(), localizer.start(), dict[int, LocalizerState]()
    starts = set(np.linspace(0, len(true_images) - 1, min(len(true_images), _MOST_WINDOWS)).astype(int).tolist())
    last_views, live = deque[_ViewRelevances](maxlen=WINDOWS[-1]), map_.live_statistics
    moved_m = np.diff(position_m, prepend=position_m[:1]).tolist()
    for frame, (truth, frame_relevances) in enumerate(zip(true_images, all_relevances, strict=True)):
        view, move_m = views.at(frame), moved_m[frame]
        if frame in starts:
            window_states[frame] = localizer.restart(state)
        state = _step(localizer, state, view, move_m)
        drive_scorer.add(state.belief.mass, truth)
        live, _ = map_.after_view(live, view, move_m if frame else None)
        last_views.append(_ViewRelevances(float(position_m[frame]), relevances(map_, view, live), frame_relevances))
        window_states = {
            start: _step(localizer, window_state, view, move_m)
            for start, window_state in window_states.items()
            if frame - start < WINDOWS[-1]
        }
        for n_views in WINDOWS:
            if (window_state := window_states.get(frame - n_views + 1)) is not None:
                window_views = list(last_views)[-n_views:]
                scorers[FILTER][n_views].add(window_state.belief.mass, truth)
                scorers[SUM][n_views].add(_sum_views(map_, window_views, "list_relevances", 1.0), truth)
                best_sum = np.max(
                    [_sum_views(map_, window_views, "list_relevances", speed) for speed in _SPEEDS], axis=0
                )
                scorers[SUM_ANY_SPEED][n_views].add(best_sum, truth)
                scorers[SUM_BRUTE_FORCE_U][n_views].add(_sum_views(map_, window_views, "all_relevances", 1.0), truth)
        on_progress((frame + 1) / len(true_images))
    by_window = {
        name: {n_views: scorer.result() for n_views, scorer in window_scorers.items()}
        for name, window_scorers in scorers.items()
    }
    return PassiveScores(by_window, drive_scorer.result())


def _step(localizer: ActiveLocalizer, state: LocalizerState, view: Query, moved_m: float) -> LocalizerState:
    """The state after a view, by a filter that takes the odometry for exact, as sums do."""
    return localizer.observe_or_restart(state, view, moved_m, action_std_m=0.0)[0].state


def _sum_views(
    map_: Map, window_views: Sequence[_ViewRelevances], field_name: str, speed: float
) -> NDArray[np.float64]:
    """The sum [n] of relevances to the last views, latest last, each moved along to where the robot is now."""
    now_m, total = window_views[-1].position_m, np.zeros(map_.n_images)
    for window_view in window_views:
        relevance = getattr(window_view, field_name).astype(np.float64)
        total += moved_along(map_.route, relevance - relevance.mean(), speed * (now_m - window_view.position_m))
    return total
