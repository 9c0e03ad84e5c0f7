"""What a map expects of views to come (ours), rehearsed on another season of its route or guessed from itself."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import normal_scores, rank_landmarks
from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.core.retrieval import relevances

DEFAULT_CORRELATION = 0.6  # between seasons, of a landmark's scores: what development recordings show on average
_SMOOTHED_OVER_M = 1.0  # one view is a noisy measurement of its place; neighbours show much the same
_MAX_VIEWS = 20_000  # more would only take longer
_LIKELIHOOD_VIEWS = 400
_NEAR_M = 2.0  # views of places no farther apart are of one place
_LEAST_SCALE, _MOST_SCALE = 2.0, 60.0
_GUESSED_PLACES, _GUESSES = 1000, 8
_SEED = 0x51BAD


def rehearsed(map_: Map, own: NDArray[np.float32], season: SecondSeason | None) -> dict[str, Any]:
    """The named arrays that say what views are worth: `likelihood_scale`, `novelty` and `view_bits`.

    Args:
        map_: Its lists must not know the second season, as no list knows the season to come.
        own: [n, r] dissimilarities of the map images themselves.
        season: None: there is no other.
    """
    longest_m = max(1.0, map_.longest_action_m)
    scores = _scores(map_, own)
    if season is None:
        curve = novelty_curve(map_.position_m, scores - scores.mean(axis=0), longest_m)
        return {"novelty": curve, "view_bits": _guessed_bits(map_, own, DEFAULT_CORRELATION).astype(np.float32)}
    images, frames = season.places.T
    other = _scores(map_, season.dissimilarities[frames])
    correlation = float(np.mean(_standardised(scores)[images] * _standardised(other)))
    difference = other - scores[images]
    curve = novelty_curve(map_.position_m[images], difference - difference.mean(axis=0), longest_m)
    guessed = _guessed_bits(map_, own, float(np.clip(correlation, 0.05, 0.95)))
    seen = _seen_bits(map_, season)
    both = _standardised(_standardised(seen) + 0.3 * _standardised(guessed))
    arrays: dict[str, Any] = {"novelty": curve, "view_bits": (seen.mean() + seen.std() * both).astype(np.float32)}
    if map_.relevance is Relevance.COMPOSED:
        arrays["likelihood_scale"] = np.array([likelihood_scale(map_, season)])
    return arrays


def likelihood_scale(map_: Map, season: SecondSeason) -> float:
    """The scale at which relevances make the season's true places likeliest, by the softmax over the map's images."""
    places = season.places[:: -(-len(season.places) // _LIKELIHOOD_VIEWS)]
    relevance = relevances(map_, season.views(places[:, 1])).astype(np.float64)
    route = map_.route
    near = np.abs(route.offset_m(route.position_m, route.position_m[places[:, :1]])) <= _NEAR_M

    def log_likelihood(scale: float) -> float:
        likelihood = np.exp(scale * (relevance - relevance.max(axis=1, keepdims=True)))
        return float(np.log((likelihood * near).sum(axis=1) / likelihood.sum(axis=1) + 1e-300).mean())

    low, high = np.log(_LEAST_SCALE), np.log(_MOST_SCALE)
    for _ in range(12):  # golden section
        a, b = high - 0.618 * (high - low), low + 0.618 * (high - low)
        low, high = (low, b) if log_likelihood(np.exp(a)) > log_likelihood(np.exp(b)) else (a, high)
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
    grid_m = np.arange(at_m[0], at_m[-1] + 0.5)
    if grid_m.size <= lags_m.size:
        return np.exp(-lags_m / _SMOOTHED_OVER_M)
    smoothed = _smooth_to(grid_m, at_m, difference)
    spectrum = np.square(np.abs(np.fft.rfft(smoothed - smoothed.mean(axis=0), 2 * grid_m.size, axis=0))).sum(axis=1)
    correlation = np.fft.irfft(spectrum)[: lags_m.size]
    if correlation[0] <= 0:
        return np.exp(-lags_m / _SMOOTHED_OVER_M)
    return np.minimum.accumulate(np.clip(correlation / correlation[0], 0.0, 1.0))


def _smooth_to(
    grid_m: NDArray[np.float64], at_m: NDArray[np.float64], values: NDArray[np.floating]
) -> NDArray[np.float64]:
    """[g, ...] local means of values measured at ascending positions; far from all of them their overall mean."""
    reach = 3 * _SMOOTHED_OVER_M
    first = np.searchsorted(at_m, grid_m - reach)
    stop = np.searchsorted(at_m, grid_m + reach, side="right")
    smoothed = np.empty((grid_m.size, *values.shape[1:]))
    smoothed[:] = values.mean(axis=0)
    for row, (low, high) in enumerate(zip(first, stop, strict=True)):
        if high > low:
            near = np.exp(-0.5 * np.square((at_m[low:high] - grid_m[row]) / _SMOOTHED_OVER_M))
            smoothed[row] = near @ values[low:high] / near.sum()
    return smoothed


def _scores(map_: Map, dissimilarities: NDArray[np.float32]) -> NDArray[np.floating]:
    """[n, r] of views, lowest is nearest: the dissimilarities where they are compared, else normal scores of ranks."""
    if map_.relevance is Relevance.COMPOSED:
        return dissimilarities
    return normal_scores(rank_landmarks(dissimilarities), map_.n_landmarks)


def _standardised(values: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-9), np.float64)


def _seen_bits(map_: Map, season: SecondSeason) -> NDArray[np.float64]:
    """[n] bits by which the second season's views narrowed the map down, smoothed along the route."""
    places = season.places[:: -(-len(season.places) // _MAX_VIEWS)]
    places = places[np.argsort(map_.position_m[places[:, 0]], kind="stable")]
    bits = np.array([_bits(map_, season.views(np.array([frame])), image) for image, frame in places])
    return _smooth_to(map_.position_m, map_.position_m[places[:, 0]], bits)


def _guessed_bits(map_: Map, own: NDArray[np.float32], correlation: float) -> NDArray[np.float64]:
    """[n] the same of views that are like a place as far as seasons are alike, and for the rest like any other."""
    n = map_.n_images
    images = np.linspace(0, n - 1, min(n, _GUESSED_PLACES)).astype(np.int64)
    rng = np.random.default_rng(_SEED)
    bits = np.zeros(images.size)
    composed = map_.relevance is Relevance.COMPOSED
    scores = _scores(map_, own)
    for row, image in enumerate(images):
        for other in rng.integers(0, n, _GUESSES):
            mixed = correlation * scores[image] + np.sqrt(1 - correlation**2) * scores[other]
            if composed:  # 2 - 2 p, mixed in p
                mixed += 2 * (1 - correlation - np.sqrt(1 - correlation**2))
                mixed = np.clip(mixed, 0, 4)
            mixed = mixed.astype(np.float32)
            bits[row] += _bits(map_, Query(rank_landmarks(mixed), mixed), image) / _GUESSES
    return _smooth_to(map_.position_m, map_.position_m[images], bits)


def _bits(map_: Map, view: Query, image: int) -> float:
    relevance = relevances(map_, view).reshape(-1)
    return float(np.log2(relevance.size / (1 + rank_of_truth(relevance, np.array([image])))))
