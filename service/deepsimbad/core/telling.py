"""Which places are telling: learnt from landmark-to-training retrieval.

The landmark traverse stands for a live drive of another season. Where it saw a place of the map, the rank of that place
in its retrieval says how telling the place is.
"""

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, RetrievalMap, relevances
from deepsimbad.core.retrieval import SecondSeason
from deepsimbad.core.route import Route

_SMOOTHED_OVER_M = 1.0  # one view is a noisy measurement of its place; neighbours show much the same
_MAX_VIEWS = 20_000  # more would only take longer


def telling_bits(built: RetrievalMap, second: SecondSeason, route: Route) -> NDArray[np.float32]:
    """By how many bits a view from every map image's place narrows the map down.

    Args:
        built: The map.
        second: Its `places` hold at least one pair.
        route: Where the map images are.

    Returns:
        [n] float32.
    """
    step = -(-len(second.places) // _MAX_VIEWS)
    places = second.places[::step]
    bits = np.empty(len(places))
    for row, (image, frame) in enumerate(places):
        relevance = relevances(built, Query(rank_landmarks(second.dissimilarities[frame])))
        bits[row] = np.log2(relevance.size / (1 + rank_of_truth(relevance, np.array([image]))))
    return _smooth(route, route.position_m[places[:, 0]], bits).astype(np.float32)


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
