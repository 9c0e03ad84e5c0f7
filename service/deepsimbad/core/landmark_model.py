"""Landmarks: the choice of candidates that are least like any other (II-B), and their model as it travels to robots.

A robot that ranks landmarks itself gets named arrays, and a digest that names them: of what ranks follow from, so two
maps with the same landmarks have the same one whatever else differs.
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
_ABOUT = ("evaluator", "map_version", "n_landmarks", "weights_sha256")
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a zip's earliest time: the same model is the same bytes whenever it is written


def select_landmarks(
    candidates: NDArray[np.float32], n_landmarks: int, on_progress: Callable[[float], None] | None = None
) -> NDArray[np.int64]:
    """[r] the candidates [n, d] farthest from their nearest other candidate, best first, ties by index.

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
    """[r] rows of unit vectors [n, k], each least like the nearest of those before it; the first least like the mean.

    Raises:
        TooFewCandidatesError: n < r.
    """
    _check_number(len(u), n_landmarks)
    ids = np.empty(n_landmarks, np.int64)
    ids[0] = np.argmin(u @ u.mean(axis=0))
    nearest = u @ u[ids[0]]
    nearest[ids[0]] = np.inf
    for place in range(1, n_landmarks):
        ids[place] = np.argmin(nearest)
        np.maximum(nearest, u @ u[ids[place]], out=nearest)
        nearest[ids[place]] = np.inf
    return ids


def fitting_number(asked: int | None, n_candidates: int, usual: int) -> int:
    """r: what is asked for, else what is usual or, of fewer candidates, all of them.

    Raises:
        TooFewCandidatesError: More are asked for than there are candidates.
    """
    if asked is None:
        return min(usual, n_candidates)
    _check_number(n_candidates, asked)
    return asked


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
    """[n] index of each candidate's nearest other one. Half squared distance = |a|^2/2 + |b|^2/2 - a.b."""
    n_candidates = candidates.shape[0]
    nearest = np.zeros(n_candidates, np.int64)
    least = np.full(n_candidates, np.inf, np.float32)
    starts = range(0, n_candidates, _BLOCK)
    n_blocks, n_done = len(starts) * (len(starts) + 1) // 2, 0
    for row in starts:
        for column in range(row, n_candidates, _BLOCK):
            rows, columns = candidates[row : row + _BLOCK], candidates[column : column + _BLOCK]
            _keep_nearest(rows @ columns.T, half_squares, row, column, nearest, least)
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
    least: NDArray[np.float32],
) -> None:
    """Take the block's distances into account for its rows and its columns alike."""
    n_rows, n_columns = products.shape
    for i in range(n_rows):
        a = row + i
        best, best_b = least[a], nearest[a]
        for j in range(n_columns):
            b = column + j
            if a == b:
                continue
            half_distance = half_squares[a] + half_squares[b] - products[i, j]
            if half_distance < best:
                best, best_b = half_distance, b
            if half_distance < least[b]:
                least[b] = half_distance
                nearest[b] = a
        if best < least[a]:
            least[a], nearest[a] = best, best_b


def _squared_distances(candidates: NDArray[np.float32], others: NDArray[np.int64]) -> NDArray[np.float64]:
    """[n] float64 squared distance of each candidate to the one named, a block at a time."""
    distances = np.empty(candidates.shape[0])
    for start in range(0, candidates.shape[0], _BLOCK):
        block = slice(start, start + _BLOCK)
        difference = candidates[block].astype(np.float64) - candidates[others[block]]
        distances[block] = np.einsum("nd,nd->n", difference, difference)
    return distances


@dataclass(frozen=True)
class PortableLandmarks:
    """A map's landmark model and what a robot must know to rank by it."""

    model: Mapping[str, NDArray[np.generic]]  # the evaluator's named arrays
    n_landmarks: int
    map_version: int  # of the map they come from
    evaluator: Mapping[str, Any]  # the evaluator's configuration
    # Of the weights that the map's images were encoded by; "" where nobody knows or there are none
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
    """A numpy npz of the model's arrays by name, and all else that is known as 0-d arrays, `evaluator` as JSON.

    No pickles; the same bytes every time.

    Raises:
        InvalidArchiveError: An array of the model bears the name of one of those.
    """
    if taken := set(_ABOUT) & portable.model.keys():
        raise InvalidArchiveError(f"a landmark model has arrays of reserved names: {', '.join(sorted(taken))}")
    about = {
        "evaluator": np.array(json.dumps(dict(portable.evaluator), sort_keys=True)),
        "map_version": np.array(portable.map_version, np.int64),
        "n_landmarks": np.array(portable.n_landmarks, np.int64),
        "weights_sha256": np.array(portable.weights_sha256),
    }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, array in sorted({**portable.model, **about}.items()):
            with archive.open(zipfile.ZipInfo(f"{name}.npy", _EPOCH), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, _little_endian(np.asarray(array)), allow_pickle=False)
    return packed.getvalue()


def unpack_landmarks(content: bytes) -> PortableLandmarks:
    """Back from `pack_landmarks`; the arrays are frozen.

    Raises:
        InvalidArchiveError: It is not what packing gives.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        evaluator, map_version, n_landmarks, weights_sha256 = (arrays.pop(name).item() for name in _ABOUT)
        configuration = dict(json.loads(evaluator))
    except (AttributeError, EOFError, KeyError, OSError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise InvalidArchiveError(f"not a landmark model: {error}") from error
    for array in arrays.values():
        array.setflags(write=False)
    return PortableLandmarks(arrays, n_landmarks, map_version, configuration, weights_sha256)


def _little_endian(array: NDArray[Any]) -> NDArray[Any]:
    return array.astype(array.dtype.newbyteorder("<"), copy=False)
