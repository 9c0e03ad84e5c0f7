"""Which map images are true for a test frame: the nearest, or those that a file of ground truth accepts."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.core.route import same_places
from deepsimbad.errors import InvalidSourceError

_MOSTLY = 0.5  # of a drive's frames


def nearest_images(test: Drive, training: Drive) -> NDArray[np.int64]:
    """[m] the map image nearest to every test frame: in the plane where both know it, else along the route."""
    route = training.route()
    images = route.nearest_image(test.position_m).astype(np.int64)
    pairs = same_places(test.route(), route, tolerance_m=np.inf)
    images[pairs[:, 1]] = pairs[:, 0]
    return images


def test_drive_warnings(test: Drive, **drives: Drive | None) -> list[str]:
    """A warning for every other drive, by its role, that most frames of the test drive are in."""
    digests = test.digests()
    return [
        f"test_drive_known: most frames of the test drive are in the {role} drive too, so that the figures flatter: "
        "what was learnt from is no test; give a drive of another day"
        for role, drive in drives.items()
        if drive is not None and np.isin(digests, drive.digests()).mean() > _MOSTLY
    ]


class _ArraysOnly(pickle.Unpickler):
    """Unpickles arrays and lists of numbers; a file that names anything else runs nothing."""

    HARMLESS = frozenset({"numpy ndarray", "numpy dtype"}) | {
        f"numpy.{core}.multiarray {name}" for core in ("core", "_core") for name in ("_reconstruct", "scalar")
    }

    def find_class(self, module: str, name: str) -> Any:
        if f"{module} {name}" not in self.HARMLESS:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return super().find_class(module, name)


def read_ground_truth(
    path: Path, test_index: NDArray[np.int64], training_index: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Read a `.npy` of accepted matches.

    Args:
        path: An array [q, 2] whose rows are (test frame, list of training frames), as VPR-Bench writes it; or [q]
            of lists, [q, k] of numbers padded with -1, or [q, n] of true and false (1 and 0) for every training
            frame, in test frame order.
        test_index: [m] places of the test frames in their recording.
        training_index: [n] the same of the training frames.

    Returns:
        For every test frame the map images, as places among the training frames; empty where none is accepted.

    Raises:
        InvalidSourceError: Not such a file.
    """
    rows = _load(path)
    try:
        if rows.dtype == object and rows.ndim == 2 and rows.shape[1] == 2:
            accepted_frames = {int(query): _frames(truth) for query, truth in rows}
        else:
            lists = map(np.flatnonzero, rows) if _says_which(rows) else rows
            accepted_frames = {query: _frames(truth) for query, truth in enumerate(lists)}
    except (TypeError, ValueError) as error:
        raise InvalidSourceError(f"{path} holds no lists of frame numbers: {error}") from error
    place_of = {int(index): place for place, index in enumerate(training_index)}
    return [
        np.array(sorted(place_of[t] for t in accepted_frames.get(int(index), ()) if t in place_of), np.int64)
        for index in test_index
    ]


def _says_which(rows: NDArray[Any]) -> bool:
    """Whether rows say of every frame if it is accepted: a list of more than two numbers names others than 0 and 1."""
    may_be = rows.ndim == 2 and (rows.dtype == bool or (rows.dtype.kind in "iuf" and rows.shape[1] > 2))
    return may_be and bool(np.isin(rows, (0, 1)).all())


def _frames(accepted: Any) -> list[int]:
    """Frame numbers as a list of ints; raises ValueError and TypeError."""
    frames = np.atleast_1d(accepted).tolist()
    if any(frame != int(frame) for frame in frames):
        raise ValueError(f"{frames} are no whole numbers")
    return [int(frame) for frame in frames]


def _load(path: Path) -> NDArray[Any]:
    try:
        with path.open("rb") as file:
            major, _ = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
            _, _, dtype = header(file)
            if dtype.hasobject:
                return np.asarray(_ArraysOnly(file).load())
            file.seek(0)
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    except OSError as error:
        raise InvalidSourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, pickle.UnpicklingError, AttributeError, IndexError) as error:
        raise InvalidSourceError(f"{path} is no ground truth file: {error}") from error
