"""Building a map in memory: landmarks chosen, every training frame described (II-B, II-C)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.calibration import Calibration
from deepsimbad.core.landmark_selection import select_landmarks
from deepsimbad.core.off_route import OffRouteModel
from deepsimbad.core.relevance import Relevance, RetrievalMap
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.same_route import SameRoute, second_season
from deepsimbad.core.telling import telling_bits
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.encoded_traverse import route_of
from deepsimbad.store.frames import TraverseFrames
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.records import DomainRecord

_FRAMES_A_BLOCK = 1024


def choose_landmarks(
    candidates: NDArray[np.float32], n_landmarks: int, evaluator: Evaluator, on_progress: Callable[[float], None]
) -> LandmarkModel:
    """Select r of the landmark traverse's encodings and fit the evaluator's model to them.

    Args:
        candidates: [m, d] encodings.
        n_landmarks: r.
        evaluator: Fits the model.
        on_progress: Called with the share done; may raise to cancel.
    """
    return evaluator.fit_landmarks(candidates[select_landmarks(candidates, n_landmarks, on_progress)])


@dataclass(frozen=True)
class Described:
    """A described traverse.

    Attributes:
        built: The part of the map that retrieval reads.
        rehearsal: The map made without the second season's lists, for learning from that season as from one to come;
            None: as `built`.
        telling_bits: [n] float32, how telling every place is; None where no second season is known.
        off_route: How a robot off the route is known; None as well.
        same_route: Whether the second drive is of the same route; None where there is no second drive.
        second_dissimilarities: [m, r] float32 of the second drive, where they were computed: training wants them too.
    """

    built: RetrievalMap
    rehearsal: RetrievalMap | None = None
    telling_bits: NDArray[np.float32] | None = None
    off_route: OffRouteModel | None = None
    same_route: SameRoute | None = None
    second_dissimilarities: NDArray[np.float32] | None = None

    @property
    def is_of_two_drives(self) -> bool:
        """Whether the second drive is of the same route, so that a map may learn from it."""
        return self.same_route is not None and self.same_route.accepted


def describe(
    training: TraverseFrames,
    route: Route,
    evaluator: Evaluator,
    model: LandmarkModel,
    relevance: Relevance,
    list_length: int,
    second: TraverseFrames | None,
    same_route: bool | None,
    on_progress: Callable[[float], None],
) -> Described:
    """Describe every training frame by its landmarks, and learn from a second season where there is one.

    Args:
        training: The traverse that becomes the map.
        route: Its positions.
        evaluator: Measures dissimilarities.
        model: The landmarks.
        relevance: What the map is built for; only `calibrated` learns from a second season.
        list_length: h.
        second: Another drive, of the same route or not.
        same_route: Whether its positions are said to be comparable; None: where both drives know x, y.
        on_progress: Called with the share done; may raise to cancel.
    """
    own = dissimilarities_to(
        training.encodings, evaluator, model, lambda share: on_progress(share if second is None else share / 2)
    )
    season = found = None
    if second is not None:
        to_second = partial(dissimilarities_to, second.encodings, evaluator, model)
        described = partial(to_second, lambda share: on_progress(0.5 + share / 4))
        season, found = second_season(own, described, route, route_of(second), same_route)
    other = None if season is None else season.dissimilarities
    built = build_retrieval_map(relevance, own, list_length, training.encodings, season)
    if season is None or relevance is not Relevance.CALIBRATED:
        on_progress(1.0)
        return Described(built, same_route=found, second_dissimilarities=other)
    # Judged by lists that do not know the second season, as no list knows the season to come.
    unaware = build_retrieval_map(relevance, own, list_length)
    rehearsal = replace(unaware, calibration=_unaware(built, unaware))
    bits = telling_bits(rehearsal, season, route)
    on_progress(0.9)
    return Described(built, rehearsal, bits, OffRouteModel.learn(rehearsal, season, route), found, other)


def _unaware(built: RetrievalMap, unaware: RetrievalMap) -> Calibration:
    """The lists of one season with the trust in landmarks that two seasons taught."""
    if built.calibration is None or unaware.calibration is None:
        raise InvalidMapConfigError("only calibrated maps learn what is telling")
    return replace(unaware.calibration, correlation=built.calibration.correlation)


def dissimilarities_to(
    encodings: NDArray[np.float32], evaluator: Evaluator, model: LandmarkModel, on_progress: Callable[[float], None]
) -> NDArray[np.float32]:
    """[n, r] of frames to landmarks, block by block.

    Args:
        encodings: [n, d].
        evaluator: Measures them.
        model: The landmarks.
        on_progress: Called with the share done; may raise to cancel.
    """
    blocks = []
    for start in range(0, len(encodings), _FRAMES_A_BLOCK):
        blocks.append(evaluator.dissimilarities(encodings[start : start + _FRAMES_A_BLOCK], model))
        on_progress(min(1.0, (start + _FRAMES_A_BLOCK) / len(encodings)))
    return np.concatenate(blocks) if blocks else np.empty((0, 0), np.float32)


def map_contents(
    domain: DomainRecord,
    version: int,
    config: Mapping[str, Any],
    model: LandmarkModel,
    described: Described,
    route: Route,
) -> MapContents:
    """Everything a map file holds of a described traverse.

    Args:
        domain: Whose map it is.
        version: Its number.
        config: What was asked for; kept with the map.
        model: The landmarks.
        described: What retrieval and planning read.
        route: Where the map images are.
    """
    built, off_route = described.built, described.off_route
    statistics, calibration = built.statistics, built.calibration
    return MapContents(
        domain=domain.name,
        version=version,
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
        config={**config, "relevance": built.relevance.value, "n_landmarks": built.index.n_landmarks},
        evaluator=domain.evaluator,
        closed=domain.closed,
        actions_m=domain.actions_m,
        landmark_model=model,
        lists=built.index.lists,
        position_m=route.position_m,
        values=built.index.values,
        encodings=built.encodings,
        statistics=None if statistics is None else np.stack([statistics.mean, statistics.std]),
        loadings=None if statistics is None else statistics.loadings,
        correlation=None if calibration is None else calibration.correlation,
        listed_score=None if calibration is None else calibration.listed_score,
        telling_bits=described.telling_bits,
        off_route_model=None if off_route is None else np.array([off_route.slope, off_route.intercept]),
        x_m=route.x_m,
        y_m=route.y_m,
    )
