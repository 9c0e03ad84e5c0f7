"""A landmark model as it travels to a robot that ranks landmarks itself: named arrays, and a digest that names them.

The digest is of what ranks follow from, so two maps with the same landmarks have the same one whatever else differs.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidArchiveError

_ABOUT = ("evaluator", "map_version", "n_landmarks", "weights_sha256")
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a zip's earliest time: the same model is the same bytes whenever it is written


@dataclass(frozen=True)
class PortableLandmarks:
    """A map's landmark model and what a robot must know to rank by it.

    Attributes:
        model: The evaluator's named arrays.
        n_landmarks: r.
        map_version: Of the map they come from.
        evaluator: The evaluator's configuration.
        weights_sha256: Of the weights that the map's images were encoded by; "" where nobody knows or there are none.
    """

    model: Mapping[str, NDArray[np.generic]]
    n_landmarks: int
    map_version: int
    evaluator: Mapping[str, Any]
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
