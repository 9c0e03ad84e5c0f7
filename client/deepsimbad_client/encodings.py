"""Ready encodings: `.npy` or `.csv`, one row [d] for each frame, in travel order."""

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recording import EncodedImage, Frame

SUFFIXES = frozenset({".npy", ".csv"})


@dataclass(frozen=True, eq=False)
class EncodingRecording:
    """Rows of a file as frames, evenly spaced along the route; see `Recording`."""

    name: str
    frames: Sequence[Frame]
    encodings: NDArray[np.float32] | None  # [n, d]; never None here
    left_out: Mapping[str, int] = field(default_factory=dict)

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:  # noqa: ARG002
        """There are no images here.

        Raises:
            SourceError: always.
        """
        raise SourceError(f"{self.name} holds ready encodings, not images")


def read_encodings(path: Path, spacing_m: float) -> EncodingRecording:
    """Read a file of ready encodings [n, d]; row i is `i * spacing_m` metres along the route.

    A csv is numbers between commas; one line of words at its top is taken for a header.

    Raises:
        SourceError: not a table of finite numbers.
    """
    raw = _read_npy(path) if path.suffix.lower() == ".npy" else _read_csv(path)
    if raw.ndim != 2 or 0 in raw.shape:
        raise SourceError(f"{path}: encodings are [n, d], one row for each frame; this is {list(raw.shape)}")
    if raw.dtype.kind not in "fiu":
        raise SourceError(f"{path}: encodings are real numbers, not {raw.dtype}")
    with np.errstate(over="ignore"):  # what does not fit float32 becomes infinite and is named below
        encodings = np.ascontiguousarray(raw, dtype=np.float32)
    broken = np.flatnonzero(~np.isfinite(encodings).all(axis=1))
    if len(broken):
        raise SourceError(
            f"{path}: {len(broken)} rows hold NaN, infinity or values beyond float32, the first is row {broken[0]} "
            "(from 0)"
        )
    frames = tuple(
        Frame(index=row, name=f"{path.stem}[{row}]", position_m=row * spacing_m) for row in range(len(encodings))
    )
    return EncodingRecording(name=path.stem, frames=frames, encodings=encodings)


def _read_npy(path: Path) -> NDArray[np.generic]:
    try:
        # Opened here, because numpy leaves a file open that turns out to be damaged.
        with path.open("rb") as file:
            raw = np.load(file, allow_pickle=False)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SourceError(f"{path} is not a .npy of numbers: {error}") from error
    if not isinstance(raw, np.ndarray):
        raw.close()
        raise SourceError(f"{path} is an npz archive named .npy: save the one array with numpy.save")
    return raw


def _read_csv(path: Path) -> NDArray[np.generic]:
    """Parse line by line: what is wrong is then said with its line number."""
    rows: list[NDArray[np.float64]] = []
    try:
        with path.open(encoding="utf-8-sig") as lines:
            for number, line in enumerate(lines, 1):
                if not line.strip():
                    continue
                try:
                    row = np.array(line.split(","), dtype=np.float64)
                except ValueError as error:
                    if not rows and not any(_is_number(field) for field in line.split(",")):
                        continue  # a header
                    raise SourceError(f"{path}, line {number}: {error}") from error
                if rows and len(row) != len(rows[0]):
                    raise SourceError(
                        f"{path}, line {number}: {len(row)} values where the lines before have {len(rows[0])}"
                    )
                rows.append(row)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not text: {error}") from error
    if not rows:
        raise SourceError(f"{path} holds no encodings: expected one line of numbers for each frame")
    return np.stack(rows)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
