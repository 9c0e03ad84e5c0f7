"""From drives to a map: landmarks chosen, every training frame described, a second season learnt from (II-B, II-C)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import build_map
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive, SameRoute, second_season
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.map import Map
from deepsimbad.core.off_route import OffRouteModel
from deepsimbad.core.planners import telling_bits
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.evaluators.base import Evaluator, LandmarkModel

_FRAMES_A_BLOCK = 1024


def choose_landmarks(
    candidates: NDArray[np.float32], n_landmarks: int, evaluator: Evaluator, on_progress: Callable[[float], None]
) -> LandmarkModel:
    """Select r of the landmark traverse's encodings and fit the evaluator's model to them.

    Args:
        candidates: [m, d] encodings.
    """
    return evaluator.fit_landmarks(candidates[select_landmarks(candidates, n_landmarks, on_progress)])


def measured(
    drive: Drive, evaluator: Evaluator, model: LandmarkModel, on_progress: Callable[[float], None] = lambda _: None
) -> Drive:
    """The drive with its frames' dissimilarities to the landmarks, measured block by block."""
    blocks = []
    for start in range(0, drive.n_frames, _FRAMES_A_BLOCK):
        blocks.append(evaluator.dissimilarities(drive.encodings[start : start + _FRAMES_A_BLOCK], model))
        on_progress(min(1.0, (start + _FRAMES_A_BLOCK) / drive.n_frames))
    return replace(drive, dissimilarities=np.concatenate(blocks) if blocks else np.empty((0, 0), np.float32))


def views_of(drive: Drive) -> Query:
    """A measured drive's frames as live views, a batch."""
    if drive.dissimilarities is None:
        raise ValueError("the drive is not measured")
    return Query(rank_landmarks(drive.dissimilarities), drive.dissimilarities, drive.encodings)


@dataclass(frozen=True)
class Built:
    """A described traverse."""

    map: Map  # as it will serve, but for its experience database
    rehearsal: Map  # the map made without the second season's lists, for learning from that season as from one to come
    # The second drive, measured, where it is of the same route; None: nothing can be learnt from it
    second: Drive | None = None
    same_route: SameRoute | None = None  # whether it is, and why not; None where there is no second drive


def build(
    training: Drive,
    second: Drive | None,
    same_route: bool | None,
    evaluator: Evaluator,
    model: LandmarkModel,
    relevance: Relevance,
    list_length: int,
    actions_m: tuple[float, ...],
    closed: bool,
    on_progress: Callable[[float], None],
) -> Built:
    """Describe every training frame by its landmarks, and learn from a second season where there is one.

    Args:
        same_route: Whether its positions are said to be comparable; None: where both drives know x, y.
        relevance: What the map is built for; only `calibrated` learns from a second season.
    """
    own = measured(training, evaluator, model, lambda share: on_progress(share if second is None else share / 2))
    season = verdict = other = None
    if second is not None:

        def measure(drive: Drive) -> Drive:
            return measured(drive, evaluator, model, lambda share: on_progress(0.5 + share / 4))

        season, other, verdict = second_season(own, closed, second, same_route, measure)
    parts: dict[str, Any] = {"landmark_model": model, "actions_m": np.array(sorted(actions_m))}
    map_ = replace(build_map(relevance, own, list_length, closed, season), **parts)
    if season is None or relevance is not Relevance.CALIBRATED:
        on_progress(1.0)
        return Built(map_, map_, other, verdict)
    # Judged by lists that do not know the second season, as no list knows the season to come; with the trust in
    # landmarks that two seasons taught.
    unaware = replace(build_map(relevance, own, list_length, closed), **parts)
    rehearsal = replace(unaware, correlation=map_.correlation)
    bits = telling_bits(rehearsal, season)
    on_progress(0.9)
    off_route = OffRouteModel.learn(rehearsal, season)
    on_progress(1.0)
    model_array = None if off_route is None else np.array([off_route.slope, off_route.intercept])
    return Built(replace(map_, telling_bits=bits, off_route_model=model_array), rehearsal, other, verdict)
