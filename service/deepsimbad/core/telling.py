"""Which places are telling, and what a view from off the route looks like: learnt from landmark-to-training retrieval.

The landmark traverse stands for a live drive of another season. Where it saw a place of the map, the rank of that place
in its retrieval says how telling the place is; and the same view with the place's surroundings taken out of the map is
a view from somewhere that was never mapped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, RetrievalMap, relevances
from deepsimbad.core.retrieval import SecondSeason
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import LOG_LIKELIHOOD_WEIGHT

_SMOOTHED_OVER_M = 1.0  # one view is a noisy measurement of its place; neighbours show much the same
_SURROUNDINGS_M = 15.0  # taken out of the map to make a view one from off the route
_MAX_VIEWS = 4000  # enough for two numbers; a whole traverse would only take longer
_MAX_LOG_ODDS = 3.0  # of one view: none settles the question alone


LEFT_ROUTE_AT_START = 0.02  # before anything was seen
_LEAVES, _RETURNS = 0.01, 0.05  # probability of either between two views


@dataclass(frozen=True)
class OffRouteModel:
    """Log-odds of being off the route, linear in how well the best-explaining places explain the view.

    Attributes:
        slope, intercept: Log-odds = intercept + slope * evidence, at even prior odds.
    """

    slope: float
    intercept: float

    @classmethod
    def fit(cls, on_route: NDArray[np.float64], off_route: NDArray[np.float64]) -> "OffRouteModel":
        """Logistic regression between two samples of the evidence, by Newton's method with a light ridge."""
        evidence = np.r_[on_route, off_route]
        is_off = np.r_[np.zeros(on_route.size), np.ones(off_route.size)]
        centre, scale = evidence.mean(), max(float(evidence.std()), 1e-9)
        design = np.stack([np.ones(evidence.size), (evidence - centre) / scale], axis=1)
        weights = np.zeros(2)
        for _ in range(25):
            probability = 1 / (1 + np.exp(-design @ weights))
            curvature = probability * (1 - probability)
            hessian = (design * curvature[:, np.newaxis]).T @ design + 1e-3 * np.eye(2)
            weights = weights + np.linalg.solve(hessian, design.T @ (is_off - probability) - 1e-3 * weights)
        return cls(float(weights[1] / scale), float(weights[0] - weights[1] * centre / scale))

    def log_odds(self, relevance: NDArray[np.float32]) -> float:
        """What one view says, bounded."""
        return float(np.clip(self.intercept + self.slope * view_evidence(relevance), -_MAX_LOG_ODDS, _MAX_LOG_ODDS))


@dataclass(frozen=True)
class Telling:
    """What landmark-to-training retrieval taught of a map.

    Attributes:
        bits: [n] float32, by how many bits a view from every map image's place narrows the map down.
        off_route: How a view from off the route is known.
    """

    bits: NDArray[np.float32]
    off_route: OffRouteModel

    @classmethod
    def learn(cls, built: RetrievalMap, second: SecondSeason, route: Route) -> "Telling":
        """Retrieve the second season's views from the map.

        Args:
            built: The map.
            second: Its `places` hold at least one pair.
            route: Where the map images are.
        """
        step = -(-len(second.places) // _MAX_VIEWS)
        places = second.places[::step]
        bits, known, unknown = np.empty(len(places)), np.empty(len(places)), np.empty(len(places))
        for row, (image, frame) in enumerate(places):
            ranks = rank_landmarks(second.dissimilarities[frame])
            relevance = relevances(built, Query(ranks))
            bits[row] = np.log2(relevance.size / (1 + rank_of_truth(relevance, np.array([image]))))
            offset = np.abs(route.offset_m(route.position_m, float(route.position_m[image])))
            elsewhere = offset > min(_SURROUNDINGS_M, route.length_m / 4)
            known[row] = view_evidence(relevance)
            unknown[row] = view_evidence(relevance[elsewhere]) if elsewhere.any() else known[row]
        smoothed = _smooth(route, route.position_m[places[:, 0]], bits)
        return cls(smoothed.astype(np.float32), OffRouteModel.fit(known, unknown))


def off_route_probability(before: float, log_odds: float) -> float:
    """Probability of being off the route after a move and a view.

    Args:
        before: Probability before them.
        log_odds: What the view says, at even prior odds.
    """
    moved = before * (1 - _RETURNS) + (1 - before) * _LEAVES
    odds = moved / (1 - moved) * np.exp(log_odds)
    return float(odds / (1 + odds))


def view_evidence(relevance: NDArray[np.float32]) -> float:
    """Log of the mean likelihood of a view over the map: high where some place explains it well."""
    weighed = LOG_LIKELIHOOD_WEIGHT * relevance.astype(np.float64)
    highest = weighed.max()
    return float(highest + np.log(np.exp(weighed - highest).mean()))


def _smooth(route: Route, at_m: NDArray[np.float64], bits: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] local mean of measurements along the route; far from all of them their overall mean."""
    order = np.argsort(at_m, kind="stable")
    at_m, bits = at_m[order], bits[order]
    reach = 3 * _SMOOTHED_OVER_M
    first = np.searchsorted(at_m, route.position_m - reach)
    stop = np.searchsorted(at_m, route.position_m + reach, side="right")
    smoothed = np.full(route.n_images, bits.mean())
    for image, (low, high) in enumerate(zip(first, stop, strict=True)):
        if high > low:
            near = np.exp(-0.5 * np.square((at_m[low:high] - route.position_m[image]) / _SMOOTHED_OVER_M))
            smoothed[image] = (near * bits[low:high]).sum() / near.sum()
    return smoothed


def bits_ahead(route: Route, bits: NDArray[np.float32], actions_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """[n, a] bits at the place where every move leads from every map image; the mean past the end of an open route."""
    ahead = np.empty((route.n_images, actions_m.size), np.float32)
    for place, action_m in enumerate(actions_m):
        position_m = route.position_m + action_m
        if route.closed and route.length_m > 0:
            position_m = route.start_m + (position_m - route.start_m) % route.length_m
        ahead[:, place] = bits[route.nearest_image(position_m)]
        if not route.closed:
            ahead[position_m > route.position_m[-1], place] = bits.mean()
    return ahead
