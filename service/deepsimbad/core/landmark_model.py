"""Landmarks: the choice of candidates that are least like any other (II-B), and their model as bytes for robots.

A robot that ranks landmarks itself gets named arrays, and a digest of those that decide ranks: two maps with the same
landmarks have the same digest whatever else differs.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.errors import InvalidArchiveError, InvalidEncodingError, InvalidMapConfigError, TooFewCandidatesError

_BLOCK = 1536  # candidates a side of one block of products: 9 MB, and large enough for the full speed of BLAS
_METADATA = ("evaluator", "map_version", "n_landmarks", "weights_sha256")
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a zip's earliest time, so that a model is the same bytes whenever it is written


def select_landmarks(
    candidates: NDArray[np.float32], n_landmarks: int, on_progress: Callable[[float], None] | None = None
) -> NDArray[np.int64]:
    """[r] int64, those of candidates [n, d] that are farthest from their nearest other, best first, ties by index.

    Every pair is compared once, block by block, so memory holds no n x n matrix. Nearest neighbours are found in
    float32; their distances, which decide the order, are then computed again in float64.

    Raises:
        TooFewCandidatesError: n < r.
        InvalidEncodingError: NaN or infinity among the candidates.
    """
    n_candidates = candidates.shape[0]
    _check_number(n_candidates, n_landmarks)
    candidates = np.ascontiguousarray(candidates, np.float32)
    half_squares = 0.5 * np.einsum("nd,nd->n", candidates, candidates)
    if not np.isfinite(half_squares).all():
        raise InvalidEncodingError("an encoding of the landmark traverse holds NaN, infinity or huge numbers")
    if n_candidates == 1:
        return np.zeros(1, np.int64)
    neighbours = _nearest_neighbours(candidates, half_squares, on_progress or (lambda _: None))
    scores = _squared_distances(candidates, neighbours)
    return np.argsort(-scores, kind="stable")[:n_landmarks].astype(np.int64)


def farthest_first(u: NDArray[np.float32], n_landmarks: int) -> NDArray[np.int64]:
    """[r] int64, rows of unit vectors [n, k], each farthest from all before it, the first from the mean.

    Raises:
        TooFewCandidatesError: n < r.
    """
    _check_number(len(u), n_landmarks)
    ids = np.empty(n_landmarks, np.int64)
    ids[0] = np.argmin(u @ u.mean(axis=0))
    nearest = u @ u[ids[0]]
    nearest[ids[0]] = np.inf
    for rank in range(1, n_landmarks):
        ids[rank] = np.argmin(nearest)
        np.maximum(nearest, u @ u[ids[rank]], out=nearest)
        nearest[ids[rank]] = np.inf
    return ids


def fitting_number(n_landmarks: int | None, n_candidates: int, default: int) -> int:
    """r: `n_landmarks` where it is given, else the default or, of fewer candidates, all of them.

    Raises:
        TooFewCandidatesError: It is more than there are candidates.
    """
    if n_landmarks is None:
        return min(default, n_candidates)
    _check_number(n_candidates, n_landmarks)
    return n_landmarks


def _check_number(n_candidates: int, n_landmarks: int) -> None:
    if n_landmarks < 1:
        raise InvalidMapConfigError("n_landmarks must be at least 1", n_landmarks=n_landmarks)
    if n_candidates < n_landmarks:
        raise TooFewCandidatesError(
            f"{n_candidates} candidates for {n_landmarks} landmarks: {n_candidates} is the most that fit; ask for no "
            "more, or leave the number out, and as many are taken as fit",
            n_candidates=n_candidates,
            n_landmarks=n_landmarks,
        )


def _nearest_neighbours(
    candidates: NDArray[np.float32], half_squares: NDArray[np.float32], on_progress: Callable[[float], None]
) -> NDArray[np.int64]:
    """[n] index of each candidate's nearest other one; half a squared distance is |a|^2/2 + |b|^2/2 - a.b."""
    n_candidates = candidates.shape[0]
    nearest = np.zeros(n_candidates, np.int64)
    half_distances = np.full(n_candidates, np.inf, np.float32)
    starts = range(0, n_candidates, _BLOCK)
    n_blocks, n_done = len(starts) * (len(starts) + 1) // 2, 0
    for row in starts:
        for column in range(row, n_candidates, _BLOCK):
            rows, columns = candidates[row : row + _BLOCK], candidates[column : column + _BLOCK]
            _keep_nearest(rows @ columns.T, half_squares, row, column, nearest, half_distances)
            n_done += 1
            on_progress(n_done / n_blocks)
    return nearest


@njit(cache=True, nogil=True)
def _keep_nearest(
    products: NDArray[np.float32],
    half_squares: NDArray[np.float32],
    row: int,
    column: int,
    nearest: NDArray[np.int64],
    half_distances: NDArray[np.float32],
) -> None:
    """Update the nearest candidates and their half squared distances [n], of a block's rows and columns."""
    n_rows, n_columns = products.shape
    for i in range(n_rows):
        a = row + i
        best, best_b = half_distances[a], nearest[a]
        for j in range(n_columns):
            b = column + j
            if a == b:
                continue
            half_distance = half_squares[a] + half_squares[b] - products[i, j]
            if half_distance < best:
                best, best_b = half_distance, b
            if half_distance < half_distances[b]:
                half_distances[b] = half_distance
                nearest[b] = a
        if best < half_distances[a]:
            half_distances[a], nearest[a] = best, best_b


def _squared_distances(candidates: NDArray[np.float32], neighbours: NDArray[np.int64]) -> NDArray[np.float64]:
    """[n] float64, squared distance of each candidate to its neighbour [n], a block at a time."""
    distances = np.empty(candidates.shape[0])
    for start in range(0, candidates.shape[0], _BLOCK):
        block = slice(start, start + _BLOCK)
        difference = candidates[block].astype(np.float64) - candidates[neighbours[block]]
        distances[block] = np.einsum("nd,nd->n", difference, difference)
    return distances


@dataclass(frozen=True)
class PortableLandmarks:
    """A map's landmark model, and what a robot must know to rank by it."""

    model: Mapping[str, NDArray[np.generic]]  # the evaluator's named arrays
    n_landmarks: int
    map_version: int  # of the map whose landmarks they are
    evaluator: Mapping[str, Any]  # the evaluator's configuration
    # Of the network's weights that the map's images were encoded by; "" where there are none, or unknown
    weights_sha256: str = ""


def landmark_model_digest(model: Mapping[str, NDArray[np.generic]]) -> str:
    """SHA-256 in hex over the arrays by name: names, types, shapes and numbers, little-endian."""
    digest = hashlib.sha256()
    for name in sorted(model):
        array = _little_endian(model[name])
        digest.update(json.dumps([name, array.dtype.str, list(array.shape)]).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def pack_landmarks(portable: PortableLandmarks) -> bytes:
    """A numpy npz of the model's arrays by name, and of the other fields as 0-d arrays, `evaluator` as JSON.

    It holds no pickles, and is the same bytes every time.

    Raises:
        InvalidArchiveError: An array of the model has the name of such a field.
    """
    if clashes := set(_METADATA) & portable.model.keys():
        raise InvalidArchiveError(f"a landmark model has arrays of reserved names: {', '.join(sorted(clashes))}")
    metadata = {
        "evaluator": np.array(json.dumps(dict(portable.evaluator), sort_keys=True)),
        "map_version": np.array(portable.map_version, np.int64),
        "n_landmarks": np.array(portable.n_landmarks, np.int64),
        "weights_sha256": np.array(portable.weights_sha256),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in sorted({**portable.model, **metadata}.items()):
            with archive.open(zipfile.ZipInfo(f"{name}.npy", _EPOCH), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, _little_endian(np.asarray(array)), allow_pickle=False)
    return buffer.getvalue()


def unpack_landmarks(content: bytes) -> PortableLandmarks:
    """The landmarks from the bytes of `pack_landmarks`; the arrays are frozen.

    Raises:
        InvalidArchiveError: The bytes are none of that.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        evaluator, map_version, n_landmarks, weights_sha256 = (arrays.pop(name).item() for name in _METADATA)
        configuration = dict(json.loads(evaluator))
    except (AttributeError, EOFError, KeyError, OSError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise InvalidArchiveError(f"not a landmark model: {error}") from error
    for array in arrays.values():
        array.setflags(write=False)
    return PortableLandmarks(arrays, n_landmarks, map_version, configuration, weights_sha256)


def _little_endian(array: NDArray[Any]) -> NDArray[Any]:
    return array.astype(array.dtype.newbyteorder("<"), copy=False)
