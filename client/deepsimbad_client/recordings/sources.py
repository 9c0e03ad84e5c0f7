"""SOURCE: the one way to name a recording on a command line.

    nclt:ROOT/DATE        one date of the NCLT dataset (`nclt`)
    FOLDER                images in name order, with an optional positions.csv (`folder`)
    FILE.npy, FILE.csv    ready encodings [n, d], one row for each frame, in travel order

Each may end in #START:STOP or #START:STOP:STEP, Python's slice of its frames, which keep their places and positions.
"""

import math
import re
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.folder import read_folder
from deepsimbad_client.recordings.nclt import FRONT_CAMERA, read_nclt
from deepsimbad_client.recordings.recording import Frame, Recording, finite_number

NCLT_PREFIX = "nclt:"
ENCODING_SUFFIXES = frozenset({".npy", ".csv"})

_SLICE = re.compile(r"\s*([+-]?\d+)?\s*:\s*([+-]?\d+)?\s*(?::\s*([+-]?\d+)?\s*)?")


def open_source(
    source: str, *, spacing_m: float = 1.0, camera: int = FRONT_CAMERA, undistortion: Path | None = None
) -> Recording:
    """Open a recording.

    Args:
        source: See the top of this module.
        spacing_m: Metres between frames where the source does not say where they are.
        camera: NCLT's camera, 0..5.
        undistortion: NCLT's undistortion table or the folder of them; None: not undistorted.

    Raises SourceError: there is no such recording, or it cannot be used; the message says why.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise SourceError(f"a spacing of {spacing_m} m: frames must be more than 0 m apart")
    place, part = split_slice(source)
    recording = _open_whole(place, spacing_m, camera, undistortion)
    return recording if part is None else recording.sliced(part)


def split_slice(source: str) -> tuple[str, slice | None]:
    """Split SOURCE into the recording and the slice of its frames.

    A `#` in a file's own name does no harm: only an ending shaped like a slice is taken for one, and one that is
    not, where no such file exists either, is an error rather than silently the whole recording. Raises SourceError
    (what follows the `#` is neither).
    """
    place, mark, ending = source.rpartition("#")
    if not mark:
        return source, None
    match = _SLICE.fullmatch(ending)
    if match:
        return place, slice(*(None if number is None else int(number) for number in match.groups()))
    if Path(source.removeprefix(NCLT_PREFIX)).expanduser().exists():
        return source, None
    raise SourceError(f"{source}: a slice is #START:STOP or #START:STOP:STEP in whole frames, not #{ending}")


def _open_whole(place: str, spacing_m: float, camera: int, undistortion: Path | None) -> Recording:
    if place.startswith(NCLT_PREFIX):
        drive = Path(place.removeprefix(NCLT_PREFIX)).expanduser()
        if not drive.name or drive.name == "..":
            raise SourceError(f"{place}: expected nclt:ROOT/DATE, for example nclt:/data/nclt/2012-01-22")
        return read_nclt(drive.parent, drive.name, camera=camera, undistortion=undistortion)
    path = Path(place).expanduser()
    if not place or not path.exists():
        raise SourceError(
            f"no recording at {place!r}: expected nclt:ROOT/DATE, a folder of images, or encodings in a .npy or .csv"
        )
    if path.is_dir():
        return read_folder(path, spacing_m)
    if path.suffix.lower() in ENCODING_SUFFIXES:
        return read_encodings(path, spacing_m)
    raise SourceError(f"{path}: a file of ready encodings is a .npy or a .csv [n, d]; images are named by their folder")


def read_encodings(path: Path, spacing_m: float) -> Recording:
    """Read a file of ready encodings [n, d]; row i is `i * spacing_m` metres along the route.

    A csv is numbers between commas; one line of words at its top is taken for a header. Raises SourceError (not a
    table of finite numbers).
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
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not text: {error}") from error
    for number, line in enumerate(lines, 1):
        cells = line.split(",")
        if not line.strip() or (not rows and all(finite_number(cell) is None for cell in cells)):
            continue  # blank, or a header
        try:
            row = np.array(cells, dtype=np.float64)
        except ValueError as error:
            raise SourceError(f"{path}, line {number}: {error}") from error
        if rows and len(row) != len(rows[0]):
            raise SourceError(f"{path}, line {number}: {len(row)} values where the lines before have {len(rows[0])}")
        rows.append(row)
    if not rows:
        raise SourceError(f"{path} holds no encodings: expected one line of numbers for each frame")
    return np.stack(rows)
