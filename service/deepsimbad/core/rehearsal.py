"""What a map expects of views to come (ours), rehearsed on another season of its route or guessed from itself.

And how surely a place is recognised: the chance that one view there is placed rightly. Every map tells it of views of
its own places, were seasons as alike as they usually are: the share of their likelihood near their place. Where a
second season of the route is known, its views are looked up too, and those placed rightly are counted.
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

SEASONS_ALIKE = 0.6  # correlation of a landmark's scores in two seasons, as development recordings have it on average
_SURE = np.pi / np.sqrt(6 * (1 - SEASONS_ALIKE**2))  # the best scale of a softmax of scores with noise
_SMOOTHED_OVER_M = 1.0  # one view is a noisy measurement of its place; neighbours show much the same
_MAX_VIEWS = 20_000  # more would only take longer
_LIKELIHOOD_VIEWS = 400
_NEAR_M = 2.0  # places no farther apart count as one
WITHIN_M = 5.0  # a view is placed rightly no farther from its place, as `confident` takes it
_LEAST_SCALE, _MOST_SCALE = 2.0, 60.0
_DISTINCT_PLACES, _WHOLE_PLACES = 5000, 1000  # more would only take longer, most of all by whole encodings
_AT_ONCE = 256
_REPEATED_VIEWS = 150
_NEAR_LAG = 0.5  # of a lag, by which the distance of a pair of views may differ from it
_OWN_PLACE_M = 4.0


def rehearsed(map_: Map, dissimilarities: NDArray[np.float32], season: SecondSeason | None) -> dict[str, Any]:
    """The named arrays that say how views err: `novelty`, `repeated`, and `likelihood_scale` of a second season.

    Args:
        map_: Its lists must not know the second season, as no list knows the season to come.
        dissimilarities: [n, r] of the map images themselves.
        season: The second season; None: there is none.
    """
    longest_m = float(np.abs(map_.actions_m).max(initial=1.0))
    scores = _scores(map_, dissimilarities)
    repeated = repeated_after(map_, dissimilarities)
    if season is None:
        novelty = novelty_curve(map_.position_m, scores - scores.mean(axis=0), longest_m)
        return {"novelty": novelty, "repeated": repeated}
    images, frames = season.places.T
    difference = _scores(map_, season.dissimilarities[frames]) - scores[images]
    arrays: dict[str, Any] = {
        "novelty": novelty_curve(map_.position_m[images], difference - difference.mean(axis=0), longest_m),
        "repeated": repeated,
    }
    if map_.relevance.traits.compares_unit_vectors:
        arrays["likelihood_scale"] = np.array([likelihood_scale(map_, season)])
    return arrays


@dataclass(frozen=True)
class OwnViews:
    """What views of the map's own places would tell, were seasons as alike as they usually are."""

    images: NDArray[np.int64]  # [k] some of the map's images, ascending
    bits: NDArray[np.float64]  # [k] by which each makes the surroundings of its place likelier than the map on average
    near_shares: NDArray[np.float64]  # [k] share of each view's likelihood within 5 m of its place


def own_views(map_: Map, places: NDArray[np.float32]) -> OwnViews:
    """Look up a map's own places in it.

    Args:
        map_: As it will serve. For `near_shares` relevances are scaled by each view's own standard deviation, but
            those of `composed`, whose scale is of this camera.
        places: [n, r] dissimilarities of what its lists stand for.
    """
    traits, route = map_.relevance.traits, map_.route
    n_most = _DISTINCT_PLACES if traits.is_listed else _WHOLE_PLACES
    images = np.linspace(0, map_.n_images - 1, min(map_.n_images, n_most)).astype(np.int64)
    views = SecondSeason(places, np.stack([images, images], axis=1), map_.encodings)
    bits, near_shares = np.empty((2, images.size))
    for start in range(0, images.size, _AT_ONCE):
        block = slice(start, start + _AT_ONCE)
        relevance = relevances(map_, views.views(images[block])).astype(np.float64)
        ahead = SEASONS_ALIKE * (relevance - relevance.max(axis=1, keepdims=True))
        likelihood = np.exp(map_.log_likelihood_scale * ahead)
        apart_m = np.abs(route.offset_m(route.position_m[np.newaxis], route.position_m[images[block], np.newaxis]))
        is_near = apart_m <= _NEAR_M
        near = (likelihood * is_near).sum(axis=1) / is_near.sum(axis=1)
        bits[block] = np.log2(near / likelihood.mean(axis=1) + 1e-300)
        if not traits.compares_unit_vectors:
            likelihood = np.exp(_SURE * ahead / np.maximum(relevance.std(axis=1, keepdims=True), 1e-9))
        near_shares[block] = (likelihood * (apart_m <= WITHIN_M)).sum(axis=1) / likelihood.sum(axis=1)
    return OwnViews(images, bits, near_shares)


def view_bits(map_: Map, views: OwnViews, rehearsal: Map, season: SecondSeason | None) -> NDArray[np.float32]:
    """[n] float32, bits that a view is expected to tell of its place, smoothed along the route.

    What the second season's views told and what views of the map's own places would tell have equal weights.

    Args:
        views: Of the map's own places.
        rehearsal: The map whose lists do not know the second season.
        season: The second season; None: there is none.
    """
    own_bits = np.interp(np.arange(map_.n_images), views.images, views.bits)
    map_bits = smoothed(map_.position_m, map_.position_m, own_bits)
    if season is None:
        return map_bits.astype(np.float32)
    season_bits = _season_bits(rehearsal, season)
    scores = _standardised(_standardised(season_bits) + _standardised(map_bits))
    return np.asarray(season_bits.mean() + season_bits.std() * scores, np.float32)


def likelihood_scale(map_: Map, season: SecondSeason) -> float:
    """The scale of relevances at which a softmax over the map's images makes the season's true places likeliest."""
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
    """How alike views 0, 1, 2.. m apart err, 1 to 0: the autocorrelation of the difference between two seasons.

    Args:
        at_m: [k] route positions.
        difference: [k, r] between what the seasons saw there, less its mean.
        longest_m: How many metres the curve spans at least.
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


def repeated_after(map_: Map, dissimilarities: NDArray[np.float32]) -> NDArray[np.float64]:
    """How much of what a view says of wrong places a view 0, 1, 2.. m before it said too, 1 to 0.

    Views of a route repeat themselves over the length of its scenes, in whatever season, so that the map's own images
    show it at all places but their own. It is the slope by which the relevances of the first view, carried along by the
    move, predict those of the second; at 0 m that after 1 m stands in.

    Args:
        map_: Its own images are compared with its lists.
        dissimilarities: [n, r] of the map images themselves.
    """
    route, at_m = map_.route, map_.position_m
    n_lags = int(np.ceil(np.abs(map_.actions_m).max(initial=1.0)))
    images = np.linspace(0, map_.n_images - 1, min(map_.n_images, _REPEATED_VIEWS)).astype(np.int64)
    slopes = np.full(n_lags + 1, np.nan)
    first_relevances = _centred_relevances(map_, dissimilarities, images)
    for lag in range(1, n_lags + 1):
        later_images = route.nearest_image(route.wrapped(at_m[images] + lag))
        moved_m = route.offset_m(at_m[later_images], at_m[images])
        pairs = np.flatnonzero(np.abs(moved_m - lag) <= _NEAR_LAG * lag)
        later_relevances = _centred_relevances(map_, dissimilarities, later_images[pairs]) if pairs.size else ()
        product = square = 0.0
        for pair, later_relevance in zip(pairs, later_relevances, strict=True):
            carried_relevance = moved_along(route, first_relevances[pair], float(moved_m[pair]))
            is_wrong = np.abs(route.offset_m(at_m, float(at_m[later_images[pair]]))) > _OWN_PLACE_M
            product += float(carried_relevance[is_wrong] @ later_relevance[is_wrong])
            square += float(carried_relevance[is_wrong] @ carried_relevance[is_wrong])
        if square > 0:
            slopes[lag] = product / square
    lags, is_measured = np.arange(n_lags + 1), np.isfinite(slopes)
    if not is_measured.any():  # no two images are a lag apart
        return np.exp(-lags / _SMOOTHED_OVER_M)
    slopes = np.interp(lags, lags[is_measured], slopes[is_measured])
    return np.minimum.accumulate(np.clip(slopes, 0.0, 1.0))


def _centred_relevances(
    map_: Map, dissimilarities: NDArray[np.float32], images: NDArray[np.int64]
) -> NDArray[np.float64]:
    """[v, n] relevances of the map's own images [v] as views, less their mean over the map."""
    views = SecondSeason(dissimilarities, np.stack([images, images], axis=1))
    relevance = relevances(map_, views.views(images)).astype(np.float64)
    return np.asarray(relevance - relevance.mean(axis=1, keepdims=True))


def smoothed(
    grid_m: NDArray[np.float64],
    at_m: NDArray[np.float64],
    values: NDArray[np.floating],
    over_m: float = _SMOOTHED_OVER_M,
    mean_weight: float = 0.0,
) -> NDArray[np.float64]:
    """[g, ...] local means at `grid_m` [g] of values [k, ...] at ascending `at_m` [k]; far from all their overall mean.

    Args:
        over_m: Standard deviation of the distance over which a value counts.
        mean_weight: Weight of the overall mean beside near values, each of which weighs up to 1.
    """
    reach, mean = 3 * over_m, values.mean(axis=0)
    first = np.searchsorted(at_m, grid_m - reach)
    stop = np.searchsorted(at_m, grid_m + reach, side="right")
    means = np.empty((grid_m.size, *values.shape[1:]))
    means[:] = mean
    for row, (low, high) in enumerate(zip(first, stop, strict=True)):
        if high > low:
            weights = np.exp(-0.5 * np.square((at_m[low:high] - grid_m[row]) / over_m))
            means[row] = (weights @ values[low:high] + mean_weight * mean) / (weights.sum() + mean_weight)
    return means


def _scores(map_: Map, dissimilarities: NDArray[np.float32]) -> NDArray[np.floating]:
    """[n, r] scores of views, lowest is nearest: dissimilarities where the map compares those, else normal scores."""
    if map_.relevance.traits.compares_dissimilarities:
        return dissimilarities
    return normal_scores(rank_landmarks(dissimilarities), map_.n_landmarks)


def _standardised(values: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-9), np.float64)


def _season_bits(map_: Map, season: SecondSeason) -> NDArray[np.float64]:
    """[n] bits that the second season's views told of their places, smoothed along the route."""
    places = season.places[:: -(-len(season.places) // _MAX_VIEWS)]
    places = places[np.argsort(map_.position_m[places[:, 0]], kind="stable")]
    scale = map_.log_likelihood_scale
    bits = [_bits(map_, scale * relevances(map_, season.views(frame)), image) for image, frame in places]
    return smoothed(map_.position_m, map_.position_m[places[:, 0]], np.array(bits))


def _bits(map_: Map, log_likelihood: NDArray[np.floating], image: int) -> float:
    """By how many bits a view makes the surroundings of its place likelier than the map on average."""
    likelihood = np.exp(log_likelihood - log_likelihood.max())
    route = map_.route
    near = np.abs(route.offset_m(route.position_m, float(route.position_m[image]))) <= _NEAR_M
    return float(np.log2(likelihood[near].mean() / likelihood.mean() + 1e-300))


_COVERAGE_OVER_M = 5.0  # rightly or not is one bit a view, so neighbours tell how often
_PRIOR_VIEWS = 1.0  # weight of the route's mean beside near views
_MOST_VIEWS = 5000  # more would only take longer
_LEAST_STRETCH_M = 2 * WITHIN_M
_BELOW_MEAN = 0.75  # share of the route's mean chance, below which a stretch stands out


@dataclass(frozen=True)
class Stretch:
    """A part of the route where views are placed rightly less often than elsewhere."""

    first: int  # map image
    last: int
    worst: int
    chance: float  # mean over its images


def placed_rightly(rehearsal: Map, views: OwnViews, season: SecondSeason | None) -> NDArray[np.float32]:
    """[n] the chance, 0 to 1, that a single view from a map image's place is placed within 5 m of it.

    Args:
        rehearsal: The map whose lists do not know the second season.
        views: Of the map's own places.
        season: The second season; None: there is none.
    """
    expected_shares = _share_by_image(rehearsal, views.images, views.near_shares)
    if season is None:
        return expected_shares.astype(np.float32)
    images, frames = season.places[:: -(-len(season.places) // _MOST_VIEWS)].T
    is_right, route = np.empty(images.size), rehearsal.route
    for start in range(0, images.size, _AT_ONCE):
        block = slice(start, start + _AT_ONCE)
        best = relevances(rehearsal, season.views(frames[block])).argmax(axis=1)
        is_right[block] = np.abs(route.offset_m(route.position_m[best], route.position_m[images[block]])) <= WITHIN_M
    counted_shares = _share_by_image(rehearsal, images, is_right)
    # Recordings did not show which of the two orders places better
    return ((expected_shares + counted_shares) / 2).astype(np.float32)


def _share_by_image(map_: Map, images: NDArray[np.int64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] shares of views placed rightly, from those [k] of some images, smoothed along the route."""
    order = np.argsort(images, kind="stable")
    at_m = map_.position_m[images[order]]
    return smoothed(map_.position_m, at_m, shares[order], _COVERAGE_OVER_M, _PRIOR_VIEWS)


def worst_stretches(position_m: NDArray[np.float64], chance: NDArray[np.floating]) -> list[Stretch]:
    """The stretches where the chance [n], NaN where unknown, is well below the route's mean, worst first."""
    is_low = chance < _BELOW_MEAN * np.nanmean(chance)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_low, [False]]).astype(int)))
    stretches = []
    for first, stop in edges.reshape(-1, 2):
        if position_m[stop - 1] - position_m[first] >= _LEAST_STRETCH_M or stop - first == chance.size:
            chances = chance[first:stop]
            stretches.append(
                Stretch(int(first), int(stop - 1), int(first + np.nanargmin(chances)), float(chances.mean()))
            )
    return sorted(stretches, key=lambda stretch: stretch.chance)
