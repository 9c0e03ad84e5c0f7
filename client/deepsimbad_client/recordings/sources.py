"""SOURCE: the one way to name a recording on a command line.

    nclt:ROOT/DATE        one date of the NCLT dataset (`nclt`)
    FOLDER                images in name order, with an optional positions.csv
    FILE.npy, FILE.csv    ready encodings [n, d], one row for each frame, in travel order

Each may end in #START:STOP or #START:STOP:STEP, Python's slice of its frames, which keep their places and positions.

In a folder, name order counts digits as numbers (2.png before 10.png); names padded with zeros sort as
usual. Folders inside and files whose name starts with a dot are not looked at.

`positions.csv` has a header and one line for each image. Columns, in any order, others are ignored:

    name          the image's file name, with or without its ending; without this column (and without `index`) the
                  lines go with the images in name order and there must be as many
    index         instead of a name: the image's place in name order, from 0
    position_m    metres along the route; without it the distance along x_m, y_m is taken
    x_m, y_m      ground coordinates in metres
    timestamp_us  Unix microseconds
    heading_rad   turning from x towards y

Without a header it may hold just positions, one number a line, or `name,position_m`, or `name,x_m,y_m`. Images that
are not listed and lines whose image does not exist are left out and counted.
"""

import csv
import math
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError
from deepsimbad_client.http import media_type_of
from deepsimbad_client.recordings import (
    IMAGE_SUFFIXES,
    EncodedImage,
    Frame,
    Recording,
    as_jpeg,
    decode,
    finite_number,
    is_larger,
    natural_order,
    read_file,
)
from deepsimbad_client.recordings.nclt import FRONT_CAMERA, arc_length_m, read_nclt

NCLT_PREFIX = "nclt:"
ENCODING_SUFFIXES = frozenset({".npy", ".csv"})

_SLICE = re.compile(r"\s*([+-]?\d+)?\s*:\s*([+-]?\d+)?\s*(?::\s*([+-]?\d+)?\s*)?")
POSITIONS_FILE = "positions.csv"

_SPELLINGS = {
    "name": ("name", "file", "filename", "file_name", "image"),
    "index": ("index", "frame"),
    "position_m": ("position_m", "route_position_m", "position"),
    "x_m": ("x_m", "x"),
    "y_m": ("y_m", "y"),
    "timestamp_us": ("timestamp_us", "utime"),
    "heading_rad": ("heading_rad", "yaw"),
}
_COLUMN_OF = {spelling: column for column, spellings in _SPELLINGS.items() for spelling in spellings}
_WITHOUT_HEADER = {
    (1, False): ["position_m"],
    (2, True): ["name", "position_m"],
    (3, True): ["name", "x_m", "y_m"],
}  # by how many cells a line has, and whether the first is a word

_Line = tuple[int, list[str]]  # its number in the file, its cells


def open_source(
    source: str, *, spacing_m: float = 1.0, camera: int = FRONT_CAMERA, undistortion: Path | None = None
) -> Recording:
    """Open a recording, see the top of this module; `spacing_m` stands between frames of unsaid places.

    `camera` is NCLT's, 0..5, and `undistortion` its table or the folder of them. Raises SourceError.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise SourceError(f"a spacing of {spacing_m} m: frames must be more than 0 m apart")
    place, part = split_slice(source)
    recording = _open_whole(place, spacing_m, camera, undistortion)
    return recording if part is None else recording.sliced(part)


def split_slice(source: str) -> tuple[str, slice | None]:
    """Split SOURCE into the recording and the slice of its frames; a `#` in a file's own name does no harm.

    Raises SourceError (what follows the `#` is neither a slice nor a file's).
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


@dataclass(frozen=True, eq=False, kw_only=True)
class FolderRecording(Recording):
    """The images of a folder in name order."""

    folder: Path

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame: a file no larger than asked goes as it is, a larger one as JPEG.

        A format that cannot be posted (BMP, PGM, PPM) goes as PNG.
        """
        path = self.folder / frame.name
        body = read_file(path)
        image = decode(body, path)
        if is_larger(image, input_size):
            return as_jpeg(image, input_size)
        media_type = media_type_of(body)
        if media_type is None:
            return EncodedImage(cv2.imencode(".png", image)[1].tobytes(), "image/png")
        return EncodedImage(body, media_type)


def read_folder(folder: Path, spacing_m: float) -> FolderRecording:
    """Open a folder of images; without a positions.csv frame i is `i * spacing_m` metres along the route.

    Raises SourceError: no images, or a positions.csv that cannot be understood; the message names the line.
    """
    try:
        paths = [path for path in folder.iterdir() if path.name[0] != "." and not path.is_dir()]
        names = sorted((path.name for path in paths if path.suffix.lower() in IMAGE_SUFFIXES), key=natural_order)
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    if not names:
        hint = f"; for NCLT write nclt:{folder}" if (folder / "lb3").is_dir() else ""
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){hint}")
    name, path = folder.resolve().name, folder / POSITIONS_FILE
    if not path.is_file():
        frames = tuple(Frame(i, file, i * spacing_m) for i, file in enumerate(names))
        return FolderRecording(name=name, folder=folder, frames=frames)
    values, without_image = _values_by_name(path, names)
    listed = [file for file in names if file in values]
    if not listed:
        raise SourceError(f"{path} names none of the {len(names)} images beside it")
    left_out = {
        "not in positions.csv": [file for file in names if file not in values],
        "in positions.csv without an image": without_image,
    }
    return FolderRecording(
        name=name,
        folder=folder,
        frames=_placed_frames(listed, [values[file] for file in listed]),
        left_out_names={reason: files for reason, files in left_out.items() if files},
    )


def _placed_frames(names: Sequence[str], lines: Sequence[Mapping[str, float]]) -> tuple[Frame, ...]:
    if "position_m" in lines[0]:
        positions = [line["position_m"] for line in lines]
    else:
        x_m, y_m = (np.array([line[axis] for line in lines], dtype=np.float64) for axis in ("x_m", "y_m"))
        positions = arc_length_m(x_m, y_m).tolist()
    return tuple(
        Frame(
            index,
            name,
            position_m,
            timestamp_us=int(line["timestamp_us"]) if "timestamp_us" in line else None,
            x_m=line.get("x_m"),
            y_m=line.get("y_m"),
            heading_rad=line.get("heading_rad"),
        )
        for index, (name, position_m, line) in enumerate(zip(names, positions, lines, strict=True))
    )


def _values_by_name(path: Path, names: Sequence[str]) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Each line's numbers by the image's file name, and what lines call images that are not there."""
    columns, lines = _columns(path, _lines(path))
    if not {"name", "index"} & set(columns) and len(lines) != len(names):
        raise SourceError(f"{path} has {len(lines)} lines for {len(names)} images: add a column `name`")
    needed = {"position_m"} if "position_m" in columns else {"x_m", "y_m"}
    by_spelling = {Path(name).stem: name for name in names} | {name: name for name in names}
    by_index = dict(enumerate(names))
    values: dict[str, dict[str, float]] = {}
    line_of: dict[str, int] = {}
    without_image: list[str] = []
    for place, (number, line) in enumerate(lines):
        where = f"{path}, line {number}"
        if len(line) < len(columns):
            raise SourceError(f"{where}: {len(line)} values where {len(columns)} are needed")
        cells = {column: cell for column, cell in zip(columns, line, strict=False) if column is not None}
        spelling, index = cells.pop("name", None), cells.pop("index", str(place))
        numbers = {column: value for column, cell in cells.items() if (value := finite_number(cell)) is not None}
        for column, cell in cells.items():
            if column not in numbers and (cell or column in needed):
                raise SourceError(f"{where}: {column} is {cell!r}, not a finite number")
        if spelling is None and not (index.isascii() and index.isdigit()):
            raise SourceError(f"{where}: the index {index!r} is not a whole number from 0")
        name = by_index.get(int(index)) if spelling is None else by_spelling.get(Path(spelling).name)
        if name is None:
            without_image.append(index if spelling is None else spelling)
        elif name in values:
            raise SourceError(f"{where}: {name} stands in line {line_of[name]} already")
        else:
            values[name], line_of[name] = numbers, number
    return values, without_image


def _lines(path: Path) -> list[_Line]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:
            reader = csv.reader(text)
            lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if any(cells)]
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"{path} is not a csv text: {error}") from error
    if not lines:
        raise SourceError(f"{path} is empty: remove it, or give a position for each image")
    return lines


def _columns(path: Path, lines: list[_Line]) -> tuple[list[str | None], list[_Line]]:
    """What each column is (None: ignored), and the lines without the header."""
    first = lines[0][1]
    columns = [_COLUMN_OF.get(cell.lower()) for cell in first]
    if any(columns):
        lines = lines[1:]
    else:
        columns = list(_WITHOUT_HEADER.get((len(first), finite_number(first[0]) is None), []))
    wanted = [column for column in columns if column is not None]
    if len(set(wanted)) != len(wanted):
        raise SourceError(f"{path}: two columns mean the same: {', '.join(first)}")
    if "position_m" not in wanted and not {"x_m", "y_m"} <= set(wanted):
        raise SourceError(
            f"{path}: the first line must name the columns, among them position_m, or x_m and y_m "
            f"(and, to name the images, name); it is: {','.join(first)}"
        )
    return columns, lines
