"""The frames of a traverse as arrays, and what is checked before they are stored."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidEncodingError, InvalidInputError, InvalidRouteError

UNKNOWN_TIMESTAMP = -1
MAX_FRAME_INDEX = 2**53
MAX_POSITION_M = 1e9  # either way; 25 times round the earth, and squares and spans are far from overflow
_ROWS_AT_ONCE = 1024


@dataclass(frozen=True)
class TraverseFrames:
    """Frames of one traverse, in index order when read.

    Attributes:
        index: Place in the whole recording, [n] int64, distinct, from 0.
        position_m: Route position, [n] float64, at most MAX_POSITION_M either way; need not increase here.
        timestamp_us: [n] int64, microseconds, -1 where unknown.
        x_m: East, [n] float64, at most MAX_POSITION_M either way, NaN where unknown.
        y_m: North, likewise.
        encodings: [n, d] float32, finite.
        weights_sha256: Of the network that encoded images among them; None where none did, or nobody knows.
    """

    index: NDArray[np.int64]
    position_m: NDArray[np.float64]
    timestamp_us: NDArray[np.int64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    encodings: NDArray[np.float32]
    weights_sha256: str | None = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name."""
        return {name: value for name, value in self.__dict__.items() if isinstance(value, np.ndarray)}

    @property
    def n_frames(self) -> int:
        """n."""
        return int(self.index.shape[0])

    def checked(self) -> "TraverseFrames":
        """The same frames with exact dtypes, fit to be stored.

        Raises:
            InvalidInputError: Shapes differ, an index is out of range or there twice, a place is too far away.
            InvalidRouteError: A position is NaN or too far away.
            InvalidEncodingError: An encoding is empty or not finite.
        """
        encodings = np.asarray(self.encodings, np.float32)
        if encodings.ndim != 2 or encodings.shape[1] == 0:
            raise InvalidEncodingError(f"encodings have shape {encodings.shape}, not [n, d]")
        frames = TraverseFrames(
            index=_integers(self.index, "index"),
            position_m=_reals(self.position_m, "position_m"),
            timestamp_us=_integers(self.timestamp_us, "timestamp_us"),
            x_m=_reals(self.x_m, "x_m"),
            y_m=_reals(self.y_m, "y_m"),
            encodings=encodings,
            weights_sha256=self.weights_sha256,
        )
        n = encodings.shape[0]
        for name in ("index", "position_m", "timestamp_us", "x_m", "y_m"):
            shape = getattr(frames, name).shape
            if shape != (n,):
                raise InvalidInputError(f"{name} has shape {shape}; there are {n} encodings")
        frames._check_values()
        return frames

    def _check_values(self) -> None:
        out_of_range = (self.index < 0) | (self.index > MAX_FRAME_INDEX)
        if out_of_range.any():
            raise InvalidInputError(f"frame indices count from 0; {self.index[out_of_range][0]} is none")
        values, counts = np.unique(self.index, return_counts=True)
        if (counts > 1).any():
            raise InvalidInputError(f"frame index {values[counts > 1][0]} is there twice in one batch")
        bad = ~np.isfinite(self.position_m)
        if bad.any():
            raise InvalidRouteError(f"position_m of frame {self.index[bad][0]} is not a finite number")
        _check_near("position_m", self.position_m, self.index, InvalidRouteError)
        if (self.timestamp_us < UNKNOWN_TIMESTAMP).any():
            raise InvalidInputError("timestamp_us counts from 0; -1 stands for unknown")
        for name, values_m in (("x_m", self.x_m), ("y_m", self.y_m)):
            if np.isinf(values_m).any():
                raise InvalidInputError(f"{name} is infinite; NaN stands for unknown")
            _check_near(name, values_m, self.index, InvalidInputError)
        for start in range(0, self.n_frames, _ROWS_AT_ONCE):  # no mask as large as the batch
            finite = np.isfinite(self.encodings[start : start + _ROWS_AT_ONCE]).all(axis=1)
            if not finite.all():
                frame = self.index[start + int(np.argmin(finite))]
                raise InvalidEncodingError(f"the encoding of frame {frame} holds NaN or infinity")


def _check_near(
    name: str, values_m: NDArray[np.float64], index: NDArray[np.int64], error: type[InvalidInputError]
) -> None:
    far = np.abs(values_m) > MAX_POSITION_M  # not NaN
    if far.any():
        raise error(f"{name} of frame {index[far][0]} is {values_m[far][0]:g} m: {MAX_POSITION_M:g} m is the most")


def _integers(values: NDArray[np.int64], name: str) -> NDArray[np.int64]:
    array = np.asarray(values)
    if array.dtype.kind not in "iu" and array.size:
        raise InvalidInputError(f"{name} holds {array.dtype}, not whole numbers")
    return array.astype(np.int64, copy=False)


def _reals(values: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf" and array.size:
        raise InvalidInputError(f"{name} holds {array.dtype}, not numbers")
    return array.astype(np.float64, copy=False) + 0.0  # SQLite does not keep the sign of -0.0
