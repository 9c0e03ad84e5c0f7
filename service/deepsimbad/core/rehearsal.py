"""What a map expects of views to come (ours), rehearsed on another season of its route or guessed from itself.

And how surely a place is recognised: the chance that one view there is placed rightly. A view of a place as it is in
the map, were seasons as alike as they usually are, has some of its likelihood there: that is known of every map. Where
a second season of the route is known, its views are looked up too, and counted.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import moved_along
from deepsimbad.core.descriptor import normal_scores, rank_landmarks
from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance

SEASONS_ALIKE = 0.6  # correlation of a landmark's scores in two seasons: what development recordings show on average
_SURE = np.pi / np.sqrt(6 * (1 - SEASONS_ALIKE**2))  # a softmax at this scale is the best of scores with noise
_SMOOTHED_OVER_M = 1.0  # one view is a noisy measurement of its place; neighbours show much the same
_MAX_VIEWS = 20_000  # more would only take longer
_LIKELIHOOD_VIEWS = 400
_NEAR_M = 2.0  # views of places no farther apart are of one place
WITHIN_M = 5.0  # a view is placed rightly so near to its place: as `confident` takes one
_LEAST_SCALE, _MOST_SCALE = 2.0, 60.0
_DISTINCT_PLACES, _WHOLE_PLACES = 5000, 1000  # more would only take longer, most of all by whole encodings
_AT_ONCE = 256
_REPEATED_VIEWS = 150
_NEAR_LAG = 0.5  # of a lag: how far off it a pair of views may be
_OWN_PLACE_M = 4.0


def rehearsed(map_: Map, own: NDArray[np.float32], season: SecondSeason | None) -> dict[str, Any]:
    """The named arrays that say how views err: `novelty`, `repeated`, and `likelihood_scale` of a second season.

    Args:
        map_: Its lists must not know the second season, as no list knows the season to come.
        own: [n, r] dissimilarities of the map images themselves.
        season: None: there is no other.
    """
    longest_m = float(np.abs(map_.actions_m).max(initial=1.0))
    scores = _scores(map_, own)
    repeated = repeated_after(map_, own)
    if season is None:
        novelty = novelty_curve(map_.position_m, scores - scores.mean(axis=0), longest_m)
        return {"novelty": novelty, "repeated": repeated}
    images, frames = season.places.T
    difference = _scores(map_, season.dissimilarities[frames]) - scores[images]
    arrays: dict[str, Any] = {
        "novelty": novelty_curve(map_.position_m[images], difference - difference.mean(axis=0), longest_m),
        "repeated": repeated,
    }
    if map_.relevance is Relevance.COMPOSED:
        arrays["likelihood_scale"] = np.array([likelihood_scale(map_, season)])
    return arrays


@dataclass(frozen=True)
class OwnViews:
    """What views that are like a map's places themselves would tell, were seasons as alike as they usually are."""

    images: NDArray[np.int64]  # [k] some of the map's, in order
    bits: NDArray[np.float64]  # [k] by which they make the surroundings of their place likelier than the map
    found: NDArray[np.float64]  # [k] share of the likelihood within 5 m of their place


def own_views(map_: Map, places: NDArray[np.float32]) -> OwnViews:
    """Look up a map's own places in it.

    Args:
        map_: As it will serve. What is found counts relevances but `composed`'s, which alone are scaled to this
            camera, by each view's own standard deviation.
        places: [n, r] dissimilarities of what its lists stand for.
    """
    is_whole, route = map_.relevance is Relevance.BRUTE_FORCE, map_.route
    most = _WHOLE_PLACES if is_whole else _DISTINCT_PLACES
    images = np.linspace(0, map_.n_images - 1, min(map_.n_images, most)).astype(np.int64)
    views = SecondSeason(places, np.stack([images, images], axis=1), map_.encodings)
    bits, found = np.empty((2, images.size))
    for first in range(0, images.size, _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        relevance = relevances(map_, views.views(images[some])).astype(np.float64)
        ahead = SEASONS_ALIKE * (relevance - relevance.max(axis=1, keepdims=True))
        likelihood = np.exp(map_.log_likelihood_scale * ahead)
        apart_m = np.abs(route.offset_m(route.position_m[np.newaxis], route.position_m[images[some], np.newaxis]))
        is_near = apart_m <= _NEAR_M
        near = (likelihood * is_near).sum(axis=1) / is_near.sum(axis=1)
        bits[some] = np.log2(near / likelihood.mean(axis=1) + 1e-300)
        if map_.relevance is not Relevance.COMPOSED:
            likelihood = np.exp(_SURE * ahead / np.maximum(relevance.std(axis=1, keepdims=True), 1e-9))
        found[some] = (likelihood * (apart_m <= WITHIN_M)).sum(axis=1) / likelihood.sum(axis=1)
    return OwnViews(images, bits, found)


def view_bits(map_: Map, own: OwnViews, rehearsal: Map, season: SecondSeason | None) -> NDArray[np.float32]:
    """[n] bits that a view is expected to tell of its place, smoothed along the route.

    What the second season's views told, and how distinct the place is in the map alone, weigh alike.

    Args:
        rehearsal: The map whose lists do not know the second season.
        season: None: there is no other.
    """
    own_bits = np.interp(np.arange(map_.n_images), own.images, own.bits)
    distinct = smoothed(map_.position_m, map_.position_m, own_bits)
    if season is None:
        return distinct.astype(np.float32)
    seen = _seen_bits(rehearsal, season)
    both = _standardised(_standardised(seen) + _standardised(distinct))
    return np.asarray(seen.mean() + seen.std() * both, np.float32)


def likelihood_scale(map_: Map, season: SecondSeason) -> float:
    """The scale at which relevances make the season's true places likeliest, by the softmax over the map's images."""
    places = season.places[:: -(-len(season.places) // _LIKELIHOOD_VIEWS)]
    relevance = relevances(map_, season.views(places[:, 1])).astype(np.float64)

    def bits(scale: float) -> float:
        return float(
            np.mean([_bits(map_, scale * row, image) for row, image in zip(relevance, places[:, 0], strict=True)])
        )

    low, high = np.log(_LEAST_SCALE), np.log(_MOST_SCALE)
    for _ in range(12):  # golden section
        a, b = high - 0.618 * (high - low), low + 0.618 * (high - low)
        low, high = (low, b) if bits(np.exp(a)) > bits(np.exp(b)) else (a, high)
    return float(np.exp((low + high) / 2))


def novelty_curve(at_m: NDArray[np.float64], difference: NDArray[np.floating], longest_m: float) -> NDArray[np.float64]:
    """How much alike views 0, 1, 2.. m apart err, 1 to 0: autocorrelation of what two seasons differ in.

    Args:
        at_m: [k] route positions.
        difference: [k, r] of what was seen there, less its mean.
        longest_m: How far the curve goes at least.
    """
    order = np.argsort(at_m, kind="stable")
    at_m, difference = at_m[order], difference[order]
    lags_m = np.arange(int(np.ceil(longest_m)) + 1)
    unseen_m = lags_m.size + 6 * _SMOOTHED_OVER_M  # across a longer gap no two views are compared
    at_m = at_m[0] + np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(at_m), unseen_m))])
    grid_m = np.arange(at_m[0], at_m[-1] + 0.5)
    if grid_m.size <= lags_m.size:
        return np.exp(-lags_m / _SMOOTHED_OVER_M)
    smooth = smoothed(grid_m, at_m, difference)
    spectrum = np.square(np.abs(np.fft.rfft(smooth - smooth.mean(axis=0), 2 * grid_m.size, axis=0))).sum(axis=1)
    correlation = np.fft.irfft(spectrum)[: lags_m.size]
    if correlation[0] <= 0:
        return np.exp(-lags_m / _SMOOTHED_OVER_M)
    return np.minimum.accumulate(np.clip(correlation / correlation[0], 0.0, 1.0))


def repeated_after(map_: Map, own: NDArray[np.float32]) -> NDArray[np.float64]:
    """How much of what a view says of wrong places a view 0, 1, 2.. m before has said too, 1 to 0.

    Views of a route repeat themselves by as much as its scenes are long, whatever the season: so the map's own images
    tell, each but for its own place. It is the slope by which what was said, carried along by the move, predicts what
    is said; at 0 m as after 1.

    Args:
        map_: A view's relevances are compared with its lists.
        own: [n, r] dissimilarities of the map images themselves.
    """
    route, at_m = map_.route, map_.position_m
    n_lags = int(np.ceil(np.abs(map_.actions_m).max(initial=1.0)))
    images = np.linspace(0, map_.n_images - 1, min(map_.n_images, _REPEATED_VIEWS)).astype(np.int64)
    slopes = np.full(n_lags + 1, np.nan)
    said = _views_said(map_, own, images)
    for lag in range(1, n_lags + 1):
        later = route.nearest_image(route.wrapped(at_m[images] + lag))
        moved_m = route.offset_m(at_m[later], at_m[images])
        pairs = np.flatnonzero(np.abs(moved_m - lag) <= _NEAR_LAG * lag)
        says = _views_said(map_, own, later[pairs]) if pairs.size else ()
        product = square = 0.0
        for pair, now in zip(pairs, says, strict=True):
            before = moved_along(route, said[pair], float(moved_m[pair]))
            wrong = np.abs(route.offset_m(at_m, float(at_m[later[pair]]))) > _OWN_PLACE_M
            product += float(before[wrong] @ now[wrong])
            square += float(before[wrong] @ before[wrong])
        if square > 0:
            slopes[lag] = product / square
    lags, is_measured = np.arange(n_lags + 1), np.isfinite(slopes)
    if not is_measured.any():  # no two images are so near each other
        return np.exp(-lags / _SMOOTHED_OVER_M)
    slopes = np.interp(lags, lags[is_measured], slopes[is_measured])
    return np.minimum.accumulate(np.clip(slopes, 0.0, 1.0))


def _views_said(map_: Map, own: NDArray[np.float32], images: NDArray[np.int64]) -> NDArray[np.float64]:
    """[v, n] relevances of the map's own images, less their mean over the map."""
    views = SecondSeason(own, np.stack([images, images], axis=1))
    relevance = relevances(map_, views.views(images)).astype(np.float64)
    return np.asarray(relevance - relevance.mean(axis=1, keepdims=True))


def smoothed(
    grid_m: NDArray[np.float64],
    at_m: NDArray[np.float64],
    values: NDArray[np.floating],
    over_m: float = _SMOOTHED_OVER_M,
    mean_weight: float = 0.0,
) -> NDArray[np.float64]:
    """[g, ...] local means of values measured at ascending positions; far from all of them their overall mean.

    Args:
        over_m: How far away a value counts, as a standard deviation.
        mean_weight: Of the overall mean, which draws where few values are near, in values.
    """
    reach, mean = 3 * over_m, values.mean(axis=0)
    first = np.searchsorted(at_m, grid_m - reach)
    stop = np.searchsorted(at_m, grid_m + reach, side="right")
    means = np.empty((grid_m.size, *values.shape[1:]))
    means[:] = mean
    for row, (low, high) in enumerate(zip(first, stop, strict=True)):
        if high > low:
            near = np.exp(-0.5 * np.square((at_m[low:high] - grid_m[row]) / over_m))
            means[row] = (near @ values[low:high] + mean_weight * mean) / (near.sum() + mean_weight)
    return means


def _scores(map_: Map, dissimilarities: NDArray[np.float32]) -> NDArray[np.floating]:
    """[n, r] of views, lowest is nearest: the dissimilarities where they are compared, else normal scores of ranks."""
    if map_.relevance is Relevance.COMPOSED:
        return dissimilarities
    return normal_scores(rank_landmarks(dissimilarities), map_.n_landmarks)


def _standardised(values: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-9), np.float64)


def _seen_bits(map_: Map, season: SecondSeason) -> NDArray[np.float64]:
    """[n] bits that the second season's views told of their places, smoothed along the route."""
    places = season.places[:: -(-len(season.places) // _MAX_VIEWS)]
    places = places[np.argsort(map_.position_m[places[:, 0]], kind="stable")]
    scale = map_.log_likelihood_scale
    bits = [_bits(map_, scale * relevances(map_, season.views(frame)), image) for image, frame in places]
    return smoothed(map_.position_m, map_.position_m[places[:, 0]], np.array(bits))


def _bits(map_: Map, log_likelihood: NDArray[np.floating], image: int) -> float:
    """By how many bits a view makes the surroundings of its place likelier than the map on the whole."""
    likelihood = np.exp(log_likelihood - log_likelihood.max())
    route = map_.route
    near = np.abs(route.offset_m(route.position_m, float(route.position_m[image]))) <= _NEAR_M
    return float(np.log2(likelihood[near].mean() / likelihood.mean() + 1e-300))


_COVERAGE_OVER_M = 5.0  # a view is placed rightly or not: neighbours tell of how often
_PRIOR_VIEWS = 1.0  # weight of the route's mean where few views are near
_MOST_VIEWS = 5000  # more would only take longer
_LEAST_STRETCH_M = 2 * WITHIN_M
_BELOW_MEAN = 0.75  # a stretch stands out where its chance is less than so much of the route's mean


@dataclass(frozen=True)
class Stretch:
    """A part of the route where views are placed rightly less often than elsewhere."""

    first: int  # map image
    last: int
    worst: int
    chance: float  # mean over its images


def placed_rightly(rehearsal: Map, own: OwnViews, season: SecondSeason | None) -> NDArray[np.float32]:
    """[n] the chance, 0 to 1, that a single view from a map image's place is placed within 5 m of it.

    Args:
        rehearsal: The map whose lists do not know the second season.
        own: What its places' own views tell.
        season: None: there is no other.
    """
    expected = _along(rehearsal, own.images, own.found)
    if season is None:
        return expected.astype(np.float32)
    images, frames = season.places[:: -(-len(season.places) // _MOST_VIEWS)].T
    found, route = np.empty(images.size), rehearsal.route
    for first in range(0, images.size, _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        best = relevances(rehearsal, season.views(frames[some])).argmax(axis=1)
        found[some] = np.abs(route.offset_m(route.position_m[best], route.position_m[images[some]])) <= WITHIN_M
    counted = _along(rehearsal, images, found)
    return ((expected + counted) / 2).astype(np.float32)  # which of them orders places better no recording decided


def _along(map_: Map, images: NDArray[np.int64], found: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] share of views placed rightly, of views [k] from some images, smoothed along the route."""
    order = np.argsort(images, kind="stable")
    at_m = map_.position_m[images[order]]
    return smoothed(map_.position_m, at_m, found[order], _COVERAGE_OVER_M, _PRIOR_VIEWS)


def worst_stretches(position_m: NDArray[np.float64], chance: NDArray[np.floating]) -> list[Stretch]:
    """Where the chance [n], perhaps NaN, is well below the route's mean, worst first."""
    is_low = chance < _BELOW_MEAN * np.nanmean(chance)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_low, [False]]).astype(int)))
    stretches = []
    for first, stop in edges.reshape(-1, 2):
        if position_m[stop - 1] - position_m[first] >= _LEAST_STRETCH_M or stop - first == chance.size:
            some = chance[first:stop]
            stretches.append(Stretch(int(first), int(stop - 1), int(first + np.nanargmin(some)), float(some.mean())))
    return sorted(stretches, key=lambda stretch: stretch.chance)
