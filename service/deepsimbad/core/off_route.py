"""Whether the robot is on the route at all (ours), calibrated on walks of the landmark traverse.

A belief that follows a robot along the route predicts where the next view will fit; one that follows a robot elsewhere
predicts no better than chance. How much better the predicted places explain a view than the map does on the whole is
therefore the evidence. It compares a view with itself: a season that fits the map badly everywhere raises no alarm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief import GridFilter, motion_std_m
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import LOG_LIKELIHOOD_WEIGHT, Query, UpdateRule
from deepsimbad.core.retrieval import relevances
from deepsimbad.core.route import Route
from deepsimbad.errors import PastTheEndError

OFF_ROUTE_AT_START = 0.02  # before anything was seen
_LEAVES, _RETURNS = 0.01, 0.05  # probability of either between two views
_MAX_LOG_ODDS = 3.0  # of one view: none settles the question alone
_WALKS, _VIEWS, _STEP_M = 100, 10, 5.0  # of the calibration
_SURROUNDINGS_M = 15.0  # taken out of the map, beside the walk itself, to make it a walk off the route
_EXCLUDED = np.float32(-1e4)


@dataclass(frozen=True)
class OffRouteModel:
    """Log-odds of being off the route after one view: intercept + slope * agreement, at even prior odds."""

    slope: float
    intercept: float

    def after(self, before: float, agreement: float | None) -> float:
        """Probability of being off the route after a move and a view of some agreement; None: it shows nothing."""
        log_odds = 0.0
        if agreement is not None:
            log_odds = np.clip(self.intercept + self.slope * agreement, -_MAX_LOG_ODDS, _MAX_LOG_ODDS)
        moved = before * (1 - _RETURNS) + (1 - before) * _LEAVES
        odds = moved / (1 - moved) * np.exp(log_odds)
        return float(odds / (1 + odds))

    @classmethod
    def of(cls, map_: Map) -> "OffRouteModel | None":
        """What a map has learnt; None where it has not."""
        return None if map_.off_route_model is None else cls(*map_.off_route_model.tolist())

    @classmethod
    def fit(cls, on_route: NDArray[np.float64], off_route: NDArray[np.float64]) -> "OffRouteModel":
        """Logistic regression between two samples of agreements, by Newton's method with a light ridge."""
        agreement = np.r_[on_route, off_route]
        is_off = np.r_[np.zeros(on_route.size), np.ones(off_route.size)]
        centre, scale = agreement.mean(), max(float(agreement.std()), 1e-9)
        design = np.stack([np.ones(agreement.size), (agreement - centre) / scale], axis=1)
        weights = np.zeros(2)
        for _ in range(25):
            probability = 1 / (1 + np.exp(-design @ weights))
            curvature = probability * (1 - probability)
            hessian = (design * curvature[:, np.newaxis]).T @ design + 1e-3 * np.eye(2)
            weights = weights + np.linalg.solve(hessian, design.T @ (is_off - probability) - 1e-3 * weights)
        return cls(float(weights[1] / scale), float(weights[0] - weights[1] * centre / scale))

    @classmethod
    def learn(cls, map_: Map, second: SecondSeason) -> "OffRouteModel | None":
        """Walk the second season's frames over the map, and over the map without the places they walk through.

        The map's lists must not know the second season. None where the two share too short a stretch for a walk.
        """
        route = map_.route
        frames = _frames_by_distance(second.places, route)
        starts = np.arange(0, len(frames) - _VIEWS + 1)
        if starts.size == 0:
            return None
        chosen = starts[:: max(1, starts.size // _WALKS)]
        on_route: list[float] = []
        off_route: list[float] = []
        for start in chosen:
            images, walked = frames[start : start + _VIEWS].T
            ranks = rank_landmarks(second.dissimilarities[walked])
            reach = np.abs(route.position_m[:, np.newaxis] - route.position_m[images]).min(axis=1)
            elsewhere = reach > min(_SURROUNDINGS_M, route.length_m / 8)
            on_route += _agreements(map_, ranks, np.ones(route.n_images, bool))
            if elsewhere.sum() > route.n_images / 4:
                off_route += _agreements(map_, ranks, elsewhere)
        return cls.fit(np.array(on_route), np.array(off_route)) if off_route else None


def agreement_of(mass: NDArray[np.float64], relevance: NDArray[np.float32]) -> float:
    """How much better the places believed before a view, [n], explain it than the map does on the whole, in nats."""
    weighed = LOG_LIKELIHOOD_WEIGHT * relevance.astype(np.float64)
    likelihood = np.exp(weighed - weighed.max())
    believed = (mass * likelihood).sum()
    return float(np.log(max(believed, 1e-300)) - np.log(likelihood.mean()))


def _frames_by_distance(places: NDArray[np.int64], route: Route) -> NDArray[np.int64]:
    """Pairs (map image, frame) about a step apart along the route, in route order."""
    ordered = places[np.argsort(route.position_m[places[:, 0]], kind="stable")]
    position_m = route.position_m[ordered[:, 0]]
    stations = np.arange(position_m[0], position_m[-1] + 1e-9, _STEP_M)
    chosen = np.unique(np.minimum(np.searchsorted(position_m, stations), len(ordered) - 1))
    return np.asarray(ordered[chosen], np.int64)


def _agreements(map_: Map, ranks: NDArray[np.float32], mapped: NDArray[np.bool_]) -> list[float]:
    """The agreements of one walk's views behind the first, on the part of the map that counts as mapped."""
    route, live = map_.route, map_.landmark_statistics
    agreements: list[float] = []
    mass = np.where(mapped, route.cell_m, 0.0)
    belief = GridFilter(route, mass / mass.sum())
    for number, view in enumerate(ranks):
        live = live.observing(view) if live else None
        relevance = np.where(mapped, relevances(map_, Query(view), live), _EXCLUDED)
        if number > 0:
            try:
                predicted = belief.predicted(_STEP_M, motion_std_m(_STEP_M), number)
            except PastTheEndError:
                break
            inside = np.where(mapped, predicted.mass, 0.0)
            if inside.sum() <= 0:
                break
            belief = GridFilter(route, inside / inside.sum())
            agreements.append(agreement_of(belief.mass[mapped], relevance[mapped]))
        belief = belief.updated(relevance, UpdateRule.LOG_LIKELIHOOD, number)
    return agreements
