"""Averaged normalised rank and recall, as in the paper's section III and design's section 4."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route


@dataclass(frozen=True)
class RetrievalScores:
    """What a set of queries scored.

    Attributes:
        anr: Averaged normalised rank in percent; 0 is perfect, 50 chance.
        recall_at: R@k in percent by k.
        n_queries: Queries scored.
        n_left_out: Queries without a true image among the map's.
        normalised_ranks: [n_queries] share of map images placed before the truth, 0..1, in query order.
    """

    anr: float
    recall_at: dict[int, float]
    n_queries: int
    n_left_out: int
    normalised_ranks: NDArray[np.float64]


def rank_of_truth(relevance: NDArray[np.floating], true_images: NDArray[np.int64]) -> float:
    """Rank, counted from 0, of the best-placed true image: images strictly better plus half the others tied.

    Args:
        relevance: [n], larger is better.
        true_images: At least one map image id.
    """
    best = relevance[true_images].max()
    n_better = np.count_nonzero(relevance > best)
    n_tied = np.count_nonzero(relevance == best)
    return n_better + 0.5 * (n_tied - 1)


class RetrievalScorer:
    """Collects queries one by one, so that no query x map matrix need exist."""

    def __init__(self, recall_ranks: Sequence[int] = (1, 5)) -> None:
        self._recall_ranks = tuple(recall_ranks)
        self._ranks: list[float] = []
        self._shares: list[float] = []
        self._n_left_out = 0

    def add(self, relevance: NDArray[np.floating], true_images: NDArray[np.int64]) -> float | None:
        """Score one query; returns its rank from 0, or None where the map holds no true image."""
        if true_images.size == 0:
            self._n_left_out += 1
            return None
        rank = rank_of_truth(relevance, true_images)
        self._ranks.append(rank)
        self._shares.append(rank / relevance.size)
        return rank

    def result(self) -> RetrievalScores:
        """The scores so far; NaN where no query was scored."""
        ranks, shares = np.array(self._ranks), np.array(self._shares)
        scored = ranks.size > 0
        return RetrievalScores(
            anr=float(100 * shares.mean()) if scored else float("nan"),
            recall_at={k: float(100 * (ranks < k).mean()) if scored else float("nan") for k in self._recall_ranks},
            n_queries=ranks.size,
            n_left_out=self._n_left_out,
            normalised_ranks=shares,
        )


def true_images_of(
    query: Route,
    map_route: Route,
    tolerance_m: float,
    max_heading_rad: float = np.pi / 2,
    frames: NDArray[np.int64] | None = None,
) -> list[NDArray[np.int64]]:
    """For every query frame, or for some of them, the map images within the tolerance.

    In the plane (x, y) where both routes know it; else along the route. A map image within the tolerance in the
    plane but driven in another direction shows something else, so heading, taken from the paths themselves, must
    agree within `max_heading_rad`.

    Returns:
        One int64 array of map image ids a query frame; empty where there is none.
    """
    if query.x_m is None or query.y_m is None or map_route.x_m is None or map_route.y_m is None:
        return [
            np.flatnonzero(np.abs(map_route.offset_m(map_route.position_m, at)) <= tolerance_m)
            for at in (query.position_m if frames is None else query.position_m[frames])
        ]
    query_heading, map_heading = _headings(query), _headings(map_route)
    found = []
    columns = np.stack([query.x_m, query.y_m, query_heading], axis=1)
    for x, y, heading in columns if frames is None else columns[frames]:
        near = np.hypot(map_route.x_m - x, map_route.y_m - y) <= tolerance_m
        turn = np.abs((map_heading - heading + np.pi) % (2 * np.pi) - np.pi)
        found.append(np.flatnonzero(near & ~(turn > max_heading_rad)))  # an unknown heading excludes nothing
    return found


def same_places(frames: Route, map_route: Route, tolerance_m: float = 2.0) -> NDArray[np.int64]:
    """Pairs (map image, frame) [k, 2] of the same place: for every frame the nearest of its true map images."""
    planes = (frames.x_m, frames.y_m, map_route.x_m, map_route.y_m)
    pairs = []
    for frame, near in enumerate(true_images_of(frames, map_route, tolerance_m)):
        if near.size == 0:
            continue
        if any(axis is None for axis in planes):
            apart = np.abs(map_route.offset_m(map_route.position_m[near], float(frames.position_m[frame])))
        else:
            x_m, y_m, map_x_m, map_y_m = (np.asarray(axis) for axis in planes)
            apart = np.hypot(map_x_m[near] - x_m[frame], map_y_m[near] - y_m[frame])
        pairs.append((int(near[np.argmin(apart)]), frame))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _headings(route: Route, over_m: float = 1.0) -> NDArray[np.float64]:
    """[n] direction of travel in the plane, from the chord over about a metre to either side; NaN if unknown."""
    before = np.searchsorted(route.position_m, route.position_m - over_m, side="left")
    after = np.searchsorted(route.position_m, route.position_m + over_m, side="right") - 1
    x, y = route.x_m, route.y_m
    if x is None or y is None:
        return np.full(route.n_images, np.nan)
    dx, dy = x[after] - x[before], y[after] - y[before]
    return np.where((dx == 0) & (dy == 0), np.nan, np.arctan2(dy, dx))
