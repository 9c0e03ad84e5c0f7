"""The relevance of every map image to described views, and the shortlist of an answer (II-C, III)."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.composed import list_weights, unit_encodings
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import LiveStatistics, Query, Relevance
from deepsimbad.errors import InvalidInputError, InvalidMapConfigError

_BLOCK = 4096  # images whose sums stay in the first-level cache
_IMAGES_WORTH_A_THREAD = 250_000  # with fewer, waking a second core costs more than it saves
_SCAN_UP_TO = 64  # for a longer shortlist all values are sorted
_SCAN_BLOCK = 256  # values that are compared in one vectorised sweep


def relevances(map_: Map, query: Query, live: LiveStatistics | None = None) -> NDArray[np.float32]:
    """[n] float32, relevance of every map image, larger is better; 0 of a view that shows nothing. Of a batch [e, n].

    Args:
        live: A session's own statistics, in place of the map's; for a batch those of ranks alone, [e, r].

    Raises:
        InvalidInputError: The query lacks what the map's relevance compares.
    """
    if query.ranks.ndim == 1 and not query.is_informative:
        return np.zeros(map_.n_images, np.float32)
    return _RULES[map_.relevance](map_, query, live)


def _standardised(map_: Map, query: Query, live: LiveStatistics | None) -> NDArray[np.float32]:
    """[n] sum of -z over the list, so that a landmark counts by how unusually near it is; of a batch [e, n]."""
    statistics = live or map_.live_statistics
    if statistics is None:
        raise InvalidMapConfigError("the map has no landmark statistics")
    return _sum_listed_alike(map_, -statistics.ranks.view(query.ranks).z)


def _composed(map_: Map, query: Query, live: LiveStatistics | None) -> NDArray[np.float32]:
    """[n] cosine of a view with the weighted sum of every image's landmarks; of a batch [e, n]."""
    products = products_with_landmarks(map_, query, live)
    tables = list_weights(map_.list_length)[:, np.newaxis] * products[..., np.newaxis, :]
    sums = sum_listed(map_, tables)
    sums /= map_.lengths
    return sums


def products_with_landmarks(map_: Map, query: Query, live: LiveStatistics | None = None) -> NDArray[np.float32]:
    """[..., r] float32, products of a view's unit encoding with the landmarks: from its encoding, else estimated.

    Dissimilarities from on board are by the map's statistics, so a session standardises every landmark's product by its
    own views, and brings it back to the map's. Of ranks alone the normal scores stand in for products. Such estimates
    err for every landmark by itself, though they are products of one vector: that which fits them best gives them anew.

    Args:
        live: A session's own statistics; None: the map's.
    """
    map_statistics = map_.live_statistics
    if map_statistics is None or map_statistics.encodings is None or map_statistics.products is None:
        raise InvalidMapConfigError("the map does not know what is usual for encodings")
    statistics, products = live or map_statistics, query.products
    # By the map's statistics the dissimilarities are already those of the encoding.
    if query.encoding is not None and (live is not None or products is None):
        if query.encoding.shape[-1] != map_statistics.encodings.mean.size:
            d = map_statistics.encodings.mean.size
            raise InvalidInputError(f"an encoding of {query.encoding.shape[-1]} numbers; the map's have {d}")
        model = map_.landmark_model
        u = unit_encodings(query.encoding, statistics.encodings or map_statistics.encodings, model.get("projection"))
        return np.asarray(u @ model["prototypes"].T, np.float32)
    if products is None:
        z = -statistics.ranks.view(query.ranks).z
    elif live is None or live.products is None:
        return products
    else:
        z = (products - live.products.mean) / live.products.std
    estimates = (map_statistics.products.mean + map_statistics.products.std * z).astype(np.float32)
    vector = estimates @ map_.fit_to_landmarks
    return np.asarray(vector @ map_.landmark_model["prototypes"].T, np.float32)


def _rrf(map_: Map, query: Query, _: LiveStatistics | None) -> NDArray[np.float32]:
    """[n] inner product of reciprocal rank features, of the query's r ranks and the image's h; of a batch [e, n]."""
    reciprocal = 1.0 / np.arange(1, map_.list_length + 1)
    return sum_listed(map_, reciprocal[:, np.newaxis] * (1.0 / query.ranks.astype(np.float64))[..., np.newaxis, :])


def _bag_of_landmarks(map_: Map, query: Query, _: LiveStatistics | None) -> NDArray[np.float32]:
    """[n] number of landmarks that the h nearest of the view share with a map image's list; of a batch [e, n]."""
    return _sum_listed_alike(map_, query.ranks <= map_.list_length)


def _simbad(map_: Map, query: Query, _: LiveStatistics | None) -> NDArray[np.float32]:
    """[n] -L2 between h-hot dissimilarities, `|q - m|^2 = |q|^2 + sum over the list of (q_i - m_i)^2 - q_i^2`."""
    if query.dissimilarities is None or map_.values is None:
        raise InvalidInputError("a simbad map compares dissimilarities; ranks alone cannot answer it")
    if query.ranks.ndim > 1:  # one after the other: [e, h, n] numbers would be too many
        return np.stack([_simbad(map_, query.at(row), None) for row in range(len(query.ranks))])
    h_hot = np.where(query.ranks <= map_.list_length, query.dissimilarities, 0.0).astype(np.float64)
    values = h_hot[map_.lists]  # [h, n]
    squared_distances = np.square(h_hot).sum() + (np.square(values - map_.values) - np.square(values)).sum(axis=0)
    return np.asarray(-np.sqrt(np.maximum(squared_distances, 0.0)), np.float32)


def _brute_force(map_: Map, query: Query, _: LiveStatistics | None) -> NDArray[np.float32]:
    """[n] -L2 between encodings, by one matrix product; of a batch [e, n]."""
    encodings = map_.encodings
    if query.encoding is None or encodings is None:
        raise InvalidInputError("a brute_force map compares encodings; send an image or an encoding")
    queries = np.atleast_2d(query.encoding)
    if queries.shape[1:] != encodings.shape[1:]:
        raise InvalidInputError(f"an encoding of {queries.shape[1]} numbers; the map's have {encodings.shape[1]}")
    squares = np.einsum("nd,nd->n", encodings, encodings)
    query_squares = np.einsum("qd,qd->q", queries, queries)
    squared_distances = query_squares[:, np.newaxis] + squares - 2.0 * (queries @ encodings.T)
    distances = -np.sqrt(np.maximum(squared_distances, 0.0))
    return np.asarray(distances if query.encoding.ndim > 1 else distances[0], np.float32)


_RULES: dict[Relevance, Callable[[Map, Query, LiveStatistics | None], NDArray[np.float32]]] = {
    Relevance.STANDARDISED: _standardised,
    Relevance.COMPOSED: _composed,
    Relevance.RRF: _rrf,
    Relevance.BAG_OF_LANDMARKS: _bag_of_landmarks,
    Relevance.SIMBAD: _simbad,
    Relevance.BRUTE_FORCE: _brute_force,
}


def _sum_listed_alike(map_: Map, worth: NDArray[np.generic]) -> NDArray[np.float32]:
    """`sum_listed` of landmarks whose worth [..., r] is the same at every rank."""
    tables = np.empty((*worth.shape[:-1], map_.list_length, worth.shape[-1]), np.float32)
    tables[...] = worth[..., np.newaxis, :]
    return sum_listed(map_, tables)


def sum_listed(map_: Map, tables: NDArray[np.number]) -> NDArray[np.float32]:
    """[n] float32, sum over every map image's list of a view's worth of the landmark at each rank; of a batch [e, n].

    The paper's inverted index walks the posting lists of a view's landmarks. Since a view keeps all r ranks, every
    posting takes part in every query, so memory holds the same postings sorted by map image.

    Args:
        tables: [h, r], the worth of landmark i at rank j + 1; of a batch of views [e, h, r].
    """
    (h, n), r = map_.lists.shape, map_.n_landmarks
    if tables.shape[-2:] != (h, r):
        raise InvalidMapConfigError(f"tables have shape {tables.shape}, not [h, r]")
    worth = np.ascontiguousarray(tables, np.float32).reshape(-1, h, r)
    sums = np.empty((len(worth), n), np.float32)
    if len(worth) == 1 and n >= 2 * _IMAGES_WORTH_A_THREAD:
        half = n // 2
        second_half = _second_core().submit(_sum_listed, map_.lists[:, half:], worth, sums[:, half:])
        _sum_listed(map_.lists[:, :half], worth, sums[:, :half])
        second_half.result()
    else:
        _sum_listed(map_.lists, worth, sums)
    return sums.reshape(*tables.shape[:-2], n)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _sum_listed(lists: NDArray[np.uint16], tables: NDArray[np.float32], sums: NDArray[np.float32]) -> None:
    """`sums[e, m] = sum over j of tables[e, j, lists[j, m]]`, block by block."""
    list_length, n_images = lists.shape
    for view in range(len(tables)):
        for start in range(0, n_images, _BLOCK):
            stop = min(start + _BLOCK, n_images)
            block = sums[view, start:stop]
            table, row = tables[view, 0], lists[0, start:stop]
            for m in range(block.size):
                block[m] = table[row[m]]
            for j in range(1, list_length):
                table, row = tables[view, j], lists[j, start:stop]
                for m in range(block.size):
                    block[m] += table[row[m]]


@cache
def _second_core() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="index")


def shortlist(values: NDArray[np.floating], length: int) -> NDArray[np.int64]:
    """Ids [length, at most n] of the greatest values [n], best first, ties by id; of a batch [e, n] -> [e, length]."""
    if length > _SCAN_UP_TO:
        return np.argsort(-values, axis=-1, kind="stable")[..., :length].astype(np.int64)
    rows = np.ascontiguousarray(values).reshape(-1, values.shape[-1])
    best = _scan(rows, min(length, rows.shape[1]))
    return best if values.ndim > 1 else best[0]


@njit(cache=True, nogil=True)
def _count_above(block: NDArray[np.floating], threshold: float) -> int:
    """How many values are above the threshold; counting vectorises where an early exit would not."""
    count = 0
    for i in range(block.size):
        count += block[i] > threshold
    return count


@njit(cache=True, nogil=True)
def _scan(rows: NDArray[np.floating], length: int) -> NDArray[np.int64]:
    """[e, length] ids of the greatest values of rows [e, n], in one pass that skips blocks of lesser ones."""
    bests = np.empty((len(rows), length), np.int64)
    for view in range(len(rows)):
        values, best = rows[view], bests[view]
        n_kept = 0
        for start in range(0, values.size, _SCAN_BLOCK):
            block = values[start : start + _SCAN_BLOCK]
            if n_kept == length and _count_above(block, values[best[length - 1]]) == 0:
                continue
            for candidate in range(start, start + block.size):
                value = values[candidate]
                if n_kept == length and not value > values[best[length - 1]]:
                    continue
                rank = min(n_kept, length - 1)
                while rank > 0 and value > values[best[rank - 1]]:
                    best[rank] = best[rank - 1]
                    rank -= 1
                best[rank] = candidate
                n_kept = min(n_kept + 1, length)
    return bests
