"""Whether two drives saw one route, so that the map of one may learn from the other (ours).

Positions count from where a recording began: drives of two places have equal ones too. So the positions must be said to
be comparable, by x, y or in so many words, and then the views must agree at equal positions better than they do where
one drive is shifted against the other.

A route that changes slowly makes the test harder than it looks. Shifts by one station and by two are nearly one and the
same there, so that few of them are trials of their own, and two slow trends agree or disagree as a whole. So views are
compared with their surroundings, which takes trends out, and agreement is looked at by its frequency along the route.
Shifting one drive turns the phase of every frequency by its own angle: of drives that share nothing every phase is
equally likely, independently of the others, and at shift 0 of one route all are 0. The agreement at shift 0 is the sum
of the cosines of these phases, weighted by how strong each frequency is; over all shifts it has mean 0 and a variance
that the weights give.

The theory takes a route for a stationary process. Real scenery repeats: of two places of one railway some agree better
than chance allows, a little. So agreement must also be worth learning from.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import normal_scores, rank_landmarks
from deepsimbad.core.retrieval import SecondSeason
from deepsimbad.core.route import Route
from deepsimbad.core.statistics import LandmarkStatistics
from deepsimbad.core.true_images import same_places

SIGNIFICANCE = 0.002  # of the agreement at shift 0, up to which it counts as more than chance
LEAST_CORRELATION = (
    0.2  # mean, of scores at equal positions; where scenery repeats, chance goes far, but rarely this far
)
LEAST_PLACES = 30  # that both saw
_STATION_M = 1.0  # frames nearer together, as of a robot that stands, say nothing new
_FEWEST_STATIONS, _MOST_STATIONS = 64, 512  # a short route is cut finer, a long one coarser
_SURROUNDINGS = 16  # stations to either side
_LEAST_CYCLES = 1  # along the stretch that both saw: its mean tells nothing
_LEAST_SPREAD = 1e-9  # of similarities; below, one drive shows the same everywhere


@dataclass(frozen=True)
class SameRoute:
    """Whether a drive saw the mapped route.

    Attributes:
        accepted: It did: the map may learn from it.
        why: In a sentence, why it was not accepted; None where it was.
        n_pairs: Frames that have a map image at their position.
        correlation: Mean correlation of landmarks' scores at equal positions; None where nothing was compared.
        statistic: Agreement at equal positions, in standard deviations of the agreement over all shifts; None
            likewise.
        significance: Chance that drives of two routes agree so well or better; None likewise.
    """

    accepted: bool
    why: str | None
    n_pairs: int
    correlation: float | None = None
    statistic: float | None = None
    significance: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)


def second_season(
    own: NDArray[np.float32],
    other: Callable[[], NDArray[np.float32]],
    route: Route,
    other_route: Route,
    same_route: bool | None,
) -> tuple[SecondSeason | None, SameRoute]:
    """What a map can learn from another drive: something only where both drove one route.

    Args:
        own: [n, r] dissimilarities of the map images to the landmarks.
        other: Gives those of the other drive's frames, [m, r]; asked only where positions are comparable.
        route: Where the map images are.
        other_route: Where those frames are.
        same_route: Whether their positions are said to be comparable; None: where both know x, y.
    """
    if same_route is False:
        return None, SameRoute(False, "the two drives are said not to share their positions", 0)
    if same_route is None and not (_has_plane(route) and _has_plane(other_route)):
        return None, SameRoute(
            False, "without x, y of both drives nothing says that their positions are comparable; say same_route", 0
        )
    places, dissimilarities = same_places(other_route, route), other()
    found = judge(own, dissimilarities, places, route.position_m)
    return (SecondSeason(dissimilarities, places) if found.accepted else None), found


def judge(
    own: NDArray[np.float32], other: NDArray[np.float32], places: NDArray[np.int64], position_m: NDArray[np.float64]
) -> SameRoute:
    """Test whether drives with comparable positions saw one route.

    Args:
        own: [n, r] dissimilarities of the map images to the landmarks.
        other: [m, r] of the other drive's frames.
        places: [k, 2] (map image, frame) at equal positions.
        position_m: [n] of the map images.
    """
    stations = _stations(places, position_m)
    if len(stations) < LEAST_PLACES:
        few = f"the two drives share {len(stations)} places by their positions, and {LEAST_PLACES} are the least"
        return SameRoute(False, few, len(places))
    images, frames = stations.T
    scores, others = _scores(own[images]), _scores(other[frames])
    correlation = float((scores * others).mean())
    statistic = _agreement(_against_surroundings(scores), _against_surroundings(others))
    significance = NormalDist().cdf(-statistic)
    why: str | None = None
    if significance > SIGNIFICANCE:
        why = (
            "at equal positions the two drives agree no better than where one is shifted against the other "
            f"(significance {significance:.2g}, {SIGNIFICANCE:g} is asked for)"
        )
    elif correlation < LEAST_CORRELATION:
        why = (
            f"at equal positions the two drives agree too little to learn from (mean correlation {correlation:.2f}, "
            f"{LEAST_CORRELATION:g} is asked for)"
        )
    return SameRoute(why is None, why, len(places), correlation, statistic, significance)


def _has_plane(route: Route) -> bool:
    return route.x_m is not None and route.y_m is not None


def _stations(places: NDArray[np.int64], position_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """Pairs [s, 2] in route order, one of each stretch of equal length that has any."""
    ordered = places[np.argsort(position_m[places[:, 0]], kind="stable")]
    if len(ordered) == 0:
        return ordered
    at_m = position_m[ordered[:, 0]] - position_m[ordered[0, 0]]
    station_m = np.clip(_STATION_M, at_m[-1] / _MOST_STATIONS, at_m[-1] / _FEWEST_STATIONS)
    # What lies on a border belongs to the stretch behind it, however positions were rounded.
    stretch = np.floor(at_m / station_m * (1 + 1e-9)) if station_m > 0 else at_m
    return np.asarray(ordered[np.unique(stretch, return_index=True)[1]], np.int64)


def _scores(dissimilarities: NDArray[np.float32]) -> NDArray[np.float64]:
    """[s, r] standardised by what is usual over these stations."""
    ranks = rank_landmarks(dissimilarities)
    return LandmarkStatistics.of_map(ranks).standardise(ranks)


def _against_surroundings(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """[s, r] scores less their mean over the surroundings."""
    before = np.concatenate([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    station = np.arange(len(scores))
    first, stop = np.maximum(station - _SURROUNDINGS, 0), np.minimum(station + _SURROUNDINGS + 1, len(scores))
    return np.asarray(scores - (before[stop] - before[first]) / (stop - first)[:, np.newaxis])


def _agreement(own: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Agreement at shift 0 in standard deviations of that over all shifts.

    Args:
        own: [s, r] scores of one drive along the route.
        other: [s, r] of the other.
    """
    similarity = own @ other.T / own.shape[1]
    if similarity.std() < _LEAST_SPREAD:
        return 0.0
    # Ranked, a few places that are unlike all others (tunnels) count as any other places do.
    ranked = (_normal_ranks(similarity) + _normal_ranks(similarity.T).T) / 2
    spectrum = np.fft.fft2(ranked)
    power = np.square(np.abs(spectrum))
    cycles = np.arange(_LEAST_CYCLES, (len(ranked) + 1) // 2)
    # A drive's slow frequencies are its strongest, and those that noise and inexact positions spoil least, yet a few.
    # Divided by the square root of what they would have by chance, they lead without deciding alone.
    by_chance = power.sum(axis=1)[cycles] * power.sum(axis=0)[-cycles]
    cross = spectrum[cycles, -cycles] / np.sqrt(np.sqrt(np.maximum(by_chance, np.finfo(np.float64).tiny)))
    return float(cross.real.sum() / max(np.sqrt(np.square(np.abs(cross)).sum() / 2), np.finfo(np.float64).tiny))


def _normal_ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normal scores of every row's ranks."""
    return normal_scores(rank_landmarks(values), values.shape[1])
