"""Files of ready encodings [n, d], `.npy` or `.csv`, a row a frame in travel order."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import Frame, Recording, finite_number

ENCODING_SUFFIXES = frozenset({".npy", ".csv"})


def read_encodings(path: Path, spacing_m: float) -> Recording:
    """Read a file of ready encodings [n, d]; row i is `i * spacing_m` metres along the route.

    A csv is numbers between commas, semicolons (then with decimal commas too), tabs or blanks; one line of words at its
    top is taken for a header. Raises SourceError (not a table of finite numbers).
    """
    try:
        raw = _read_npy(path) if path.suffix.lower() == ".npy" else _read_csv(path)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
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
    frames = tuple(Frame(row, f"{path.stem}[{row}]", row * spacing_m) for row in range(len(encodings)))
    return Recording(path.stem, frames, encodings=encodings)


def _read_npy(path: Path) -> NDArray[np.generic]:
    try:
        with path.open("rb") as file:  # opened here, because numpy leaves a file open that turns out to be damaged
            raw = np.load(file, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SourceError(f"{path} is not a .npy of numbers: {error}") from error
    if not isinstance(raw, np.ndarray):
        raw.close()
        raise SourceError(f"{path} is an npz archive named .npy: save the one array with numpy.save")
    return raw


def _read_csv(path: Path) -> NDArray[np.generic]:
    """Line by line: what is wrong is then said with its line number."""
    rows: list[NDArray[np.float64]] = []
    try:
        lines = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not text: {error}") from error
    filled = [(number, line) for number, line in lines if line.strip()]
    for number, line in filled:
        separator = next((mark for mark in ";\t," if mark in line), None)  # None: blanks
        cells = line.split(separator) if separator == "," else line.replace(",", ".").split(separator)
        try:
            row = np.array(cells, dtype=np.float64)
        except ValueError as error:
            if number == filled[0][0] and all(finite_number(cell) is None for cell in cells):
                continue  # a header
            raise SourceError(f"{path}, line {number}: {error}") from error
        if rows and len(row) != len(rows[0]):
            raise SourceError(f"{path}, line {number}: {len(row)} values where the lines before have {len(rows[0])}")
        rows.append(row)
    if not rows:
        raise SourceError(f"{path} holds no encodings: expected one line of numbers for each frame")
    return np.stack(rows)
