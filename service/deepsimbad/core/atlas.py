"""Which of many maps a view is of (ours), computed for all of them at once.

Beliefs on different maps cannot be compared: each says where on its own route a robot is, if it is there. They have a
common reference, by how much likelier a view is on a route than elsewhere,

    log evidence = A k (max_x r(x) - R) - B min(1, sqrt(d / 1000)) (s - S),

with r(x) the relevance of map image x (`composed`: a cosine), k its scale as a log-likelihood, and s how strange the
view, of d numbers, is to the route (`relevance.strangeness`). R and S are those of views that are as likely to be from
elsewhere, and A and B how much a difference from them tells; docs/results/many-domains.md says how they were learnt.

Every domain is as probable as every other before the view, because the question is which of these routes it is of, not
which of their metres or images; `elsewhere`, none of them, is then as probable as a robot is to be lost.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
from numba import njit, typed
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.belief.evidence import LOST_AT_START
from deepsimbad.core.composed import list_weights
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import FAR_STD, Query, strangeness
from deepsimbad.errors import InvalidMapConfigError

RELEVANCE_WEIGHT, USUAL_RELEVANCE = 0.74, 0.43  # A, R
STRANGENESS_WEIGHT, USUAL_STRANGENESS = 34.0, 0.16  # B, S
_SURE_NUMBERS = 1000.0  # length of an encoding from which on its strangeness counts in full
_BLOCK = 2048  # images whose sums stay in the first-level cache
_AT_ONCE = 64  # maps that a thread takes


def log_evidence(map_: Map, query: Query) -> float:
    """How much likelier a view is on a `composed` map's route than elsewhere, as a natural logarithm.

    It is 0 of a view that shows nothing; of one without its encoding relevance alone counts.

    Raises:
        InvalidMapConfigError: The map's relevances have no meaning beside another map's.
        InvalidInputError: The query lacks what they compare.
    """
    if not map_.relevance.traits.compares_unit_vectors:
        raise InvalidMapConfigError(f"relevances of {map_.relevance} mean nothing beside another map's")
    if not query.is_informative:
        return 0.0
    statistics, far_share = map_.live_statistics, None
    if query.encoding is not None and statistics is not None and statistics.encodings is not None:
        far_share = np.array([strangeness(query.encoding, statistics.encodings)])
    best_relevance = np.array([relevances(map_, query).max()], np.float64)
    d = 0 if query.encoding is None else query.encoding.size
    return float(_weighed(best_relevance, np.array([map_.log_likelihood_scale]), far_share, np.array([d]))[0])


def posterior(log_evidences: Mapping[str, float]) -> tuple[dict[str, float], float]:
    """The probability of each domain after a view, from its log evidence, and that of none of them.

    The evidence that several processes gathered from domains of their own is put together here, in one call.
    """
    n = len(log_evidences)
    prior = np.log([(1 - LOST_AT_START) / max(n, 1)] * n + [LOST_AT_START])
    logs = np.array([*log_evidences.values(), 0.0]) + prior
    weights = np.exp(logs - logs.max())
    *p_domains, p_elsewhere = (weights / weights.sum()).tolist()
    return dict(zip(log_evidences, p_domains, strict=True)), p_elsewhere


class Atlas:
    """Composed maps whose `log_evidence` of an encoding is computed together, the same but for rounding.

    Maps that make the same unit vectors of encodings and compare them with the same landmarks share that work.

    Args:
        maps: All `composed`, of encodings of one length d.
    """

    def __init__(self, maps: Sequence[Map]) -> None:
        self.maps = tuple(maps)
        self._scales = np.array([map_.log_likelihood_scale for map_ in maps])
        spaces: dict[int, list[tuple[int, tuple[NDArray[Any], ...]]]] = {}
        self._space_of = np.empty(len(maps), np.int64)
        distinct_spaces: list[tuple[NDArray[Any], ...]] = []
        for index, map_ in enumerate(maps):
            space = _space(map_)
            candidates = spaces.setdefault(hash(space[3].tobytes()), [])
            number = next((n for n, other in candidates if all(map(np.array_equal, space, other))), None)
            if number is None:
                number = len(distinct_spaces)
                candidates.append((number, space))
                distinct_spaces.append(space)
            self._space_of[index] = number
        self._spaces = tuple(_shelf(column) for column in zip(*distinct_spaces, strict=True))
        self._lists, self._lengths = _shelf([map_.lists for map_ in maps]), _shelf([map_.lengths for map_ in maps])
        self._n_landmarks = max(len(space[3]) for space in distinct_spaces)
        self._n_spaces = len(distinct_spaces)

    def log_evidences(self, encoding: NDArray[np.float32], pool: Executor | None = None) -> NDArray[np.float64]:
        """[m] log evidence of every map for one encoding [d]; by the pool's threads where there are many maps."""
        n = len(self.maps)
        products = np.empty((self._n_spaces, self._n_landmarks), np.float32)
        far_shares, best_relevances = np.empty(self._n_spaces), np.empty(n)
        deviations = np.empty((self._n_spaces, encoding.size), np.float32)
        encoding = np.ascontiguousarray(encoding, np.float32)
        weights = list_weights(max(map_.list_length for map_ in self.maps))

        def compare(start: int, stop: int) -> None:
            _compare(encoding, self._spaces, start, stop, deviations, products, far_shares)

        def find(start: int, stop: int) -> None:
            _find(self._lists, self._lengths, weights, self._space_of, products, start, stop, best_relevances)

        _in_blocks(self._n_spaces, compare, pool)
        _in_blocks(n, find, pool)
        return _weighed(best_relevances, self._scales, far_shares[self._space_of], np.full(n, encoding.size))


def _weighed(
    best_relevances: NDArray[np.float64],
    scales: NDArray[np.float64],
    far_shares: NDArray[np.float64] | None,
    n_numbers: NDArray[np.integer[Any]],
) -> NDArray[np.float64]:
    """[m] log evidence by the formula of this module; without strangenesses by relevance alone."""
    logs = RELEVANCE_WEIGHT * scales * (best_relevances - USUAL_RELEVANCE)
    if far_shares is None:
        return logs
    certainty = np.minimum(1.0, np.sqrt(n_numbers / _SURE_NUMBERS))
    return np.asarray(logs - STRANGENESS_WEIGHT * certainty * (far_shares - USUAL_STRANGENESS))


def _space(map_: Map) -> tuple[NDArray[Any], ...]:
    """How a map compares an encoding: mean and std [d], projection [d, k] or [0, 0], landmarks [r, k]."""
    statistics = map_.live_statistics
    if statistics is None or statistics.encodings is None:
        raise InvalidMapConfigError("the map does not know what is usual for encodings")
    model = map_.landmark_model
    projection = model.get("projection", np.empty((0, 0), np.float32))
    prototypes = np.asarray(model["prototypes"], np.float32)
    return statistics.encodings.mean, statistics.encodings.std, np.asarray(projection, np.float32), prototypes


def _shelf(arrays: Sequence[NDArray[Any]]) -> Sequence[NDArray[Any]]:
    """Arrays of one type as a list for compiled code."""
    shelf: list[NDArray[Any]] = typed.List()
    for array in arrays:
        view = np.ascontiguousarray(array).view()
        view.setflags(write=False)
        shelf.append(view)
    return shelf


def _in_blocks(n: int, run: Callable[[int, int], None], pool: Executor | None) -> None:
    """Call `run(start, stop)` for 0..n, in blocks by the threads of a pool."""
    if pool is None or n <= _AT_ONCE:
        run(0, n)
        return
    starts = range(0, n, _AT_ONCE)
    for _ in pool.map(run, starts, (min(start + _AT_ONCE, n) for start in starts)):
        pass


@njit(cache=True, nogil=True, fastmath=SUMS)
def _compare(
    encoding: NDArray[np.float32],
    spaces: Sequence[Sequence[NDArray[Any]]],
    first: int,
    stop: int,
    deviations: NDArray[np.float32],
    products: NDArray[np.float32],
    far_shares: NDArray[np.float64],
) -> None:
    """Write an encoding's products [g, r] with landmarks and its strangeness [g], in spaces first..stop.

    The rules are those of `retrieval.products_with_landmarks` and `relevance.strangeness`, for many spaces at once.

    Args:
        encoding: [d].
        spaces: Means and stds [d], projections [d, k] or [0, 0] and landmarks [r, k] of every space.
        deviations: [g, d] room for an encoding in standard deviations.
    """
    means, stds, projections, prototypes = spaces
    for g in range(first, stop):
        mean, std, projection, landmarks, z = means[g], stds[g], projections[g], prototypes[g], deviations[g]
        n_far = 0
        for i in range(encoding.size):
            difference = encoding[i] - mean[i]
            n_far += abs(difference) > FAR_STD * std[i]
            z[i] = difference / std[i]
        far_shares[g] = n_far / encoding.size
        for i in range(encoding.size):
            if np.isnan(encoding[i]):
                z[i] = 0.0
        k = landmarks.shape[1]
        u = z
        if projection.shape[0] > 0:
            u = np.zeros(k, np.float32)
            for i in range(encoding.size):
                row, weight = projection[i], z[i]
                for j in range(k):
                    u[j] += weight * row[j]
        square = np.float32(0)
        for j in range(k):
            square += u[j] * u[j]
        length = max(np.sqrt(square), np.float32(1e-12))
        last = len(landmarks) - 1
        for r in range(0, last + 1, 4):  # four at a time; beyond the end the last one again
            at_b, at_c, at_d = min(r + 1, last), min(r + 2, last), min(r + 3, last)
            a, b, c, d = landmarks[r], landmarks[at_b], landmarks[at_c], landmarks[at_d]
            of_a = of_b = of_c = of_d = np.float32(0)
            for j in range(k):
                of_a += u[j] * a[j]
                of_b += u[j] * b[j]
                of_c += u[j] * c[j]
                of_d += u[j] * d[j]
            products[g, r], products[g, at_b] = of_a / length, of_b / length
            products[g, at_c], products[g, at_d] = of_c / length, of_d / length


@njit(cache=True, nogil=True, fastmath=SUMS | {"nnan", "nsz"})
def _find(
    all_lists: Sequence[NDArray[np.uint16]],
    all_lengths: Sequence[NDArray[np.float32]],
    weights: NDArray[np.float32],
    space_of: NDArray[np.int64],
    products: NDArray[np.float32],
    first: int,
    stop: int,
    best_relevances: NDArray[np.float64],
) -> None:
    """Write the greatest relevance [m] of maps first..stop, four list positions at a time, the last with the rest.

    The relevance is `retrieval.relevances` of `composed` maps, of lists [h, n] and lengths [n] of any sizes.

    Args:
        weights: [h] of list positions, of the longest lists.
        space_of: [m] the row of `products` [g, r] that is a map's.
    """
    n_places = -(-weights.size // 4) * 4
    tables = np.empty((n_places, products.shape[1]), np.float32)
    buffer = np.zeros(_BLOCK, np.float32)
    for number in range(first, stop):
        lists, lengths, product = all_lists[number], all_lengths[number], products[space_of[number]]
        h, n = lists.shape
        for j in range(h):
            for r in range(product.size):
                tables[j, r] = weights[j] * product[r]
        tables[h:] = 0  # positions beyond this map's lists weigh nothing
        best = np.float32(-np.inf)
        for start in range(0, n, _BLOCK):
            block = slice(start, min(start + _BLOCK, n))
            length, sums = lengths[block], buffer[: block.stop - start]
            sums[:] = 0
            for j in range(0, n_places, 4):
                a, b, c, d = tables[j], tables[j + 1], tables[j + 2], tables[j + 3]
                u, v = lists[min(j, h - 1), block], lists[min(j + 1, h - 1), block]
                x, y = lists[min(j + 2, h - 1), block], lists[min(j + 3, h - 1), block]
                if j + 4 < n_places:
                    for m in range(sums.size):
                        sums[m] += a[u[m]] + b[v[m]] + c[x[m]] + d[y[m]]
                else:
                    for m in range(sums.size):
                        relevance = (sums[m] + a[u[m]] + b[v[m]] + c[x[m]] + d[y[m]]) / length[m]
                        best = relevance if relevance > best else best
        best_relevances[number] = best
