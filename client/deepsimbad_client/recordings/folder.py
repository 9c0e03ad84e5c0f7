"""Recordings that are a folder of images, in name order, with an optional `positions.csv`.

Name order counts digits as numbers (2.png before 10.png); names padded with zeros sort as usual. Folders inside and
files whose name starts with a dot are not looked at.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deepsimbad_client.errors import SourceError
from deepsimbad_client.http.call import media_type_of
from deepsimbad_client.recordings.ground_truth import arc_length_m
from deepsimbad_client.recordings.images import (
    IMAGE_SUFFIXES,
    as_jpeg,
    as_png,
    decode,
    is_larger,
    natural_order,
    read_file,
)
from deepsimbad_client.recordings.recording import EncodedImage, Frame, Recording, finite_number

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


@dataclass(frozen=True, eq=False, kw_only=True)
class FolderRecording(Recording):
    """The images of a folder in name order.

    Attributes:
        folder: Where they are.
    """

    folder: Path

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame: a file no larger than asked goes as it is, a larger one as JPEG; see `Recording.image`.

        A format that cannot be posted (BMP, PGM, PPM) goes as PNG.
        """
        path = self.folder / frame.name
        body = read_file(path)
        image = decode(body, path)
        if is_larger(image, input_size):
            return as_jpeg(image, input_size)
        media_type = media_type_of(body)
        return as_png(image) if media_type is None else EncodedImage(body, media_type)


def read_folder(folder: Path, spacing_m: float) -> FolderRecording:
    """Open a folder of images; without a positions.csv frame i is `i * spacing_m` metres along the route.

    Raises SourceError: no images, or a positions.csv that cannot be understood; the message names the line.
    """
    try:
        names = sorted((path.name for path in folder.iterdir() if _is_image(path)), key=natural_order)
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    if not names:
        hint = f"; for NCLT write nclt:{folder}" if (folder / "lb3").is_dir() else ""
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){hint}")
    name, path = folder.resolve().name, folder / POSITIONS_FILE
    if not path.is_file():
        frames = tuple(Frame(i, file, i * spacing_m) for i, file in enumerate(names))
        return FolderRecording(name=name, folder=folder, frames=frames)
    values, n_without_image = _values_by_name(path, names)
    listed = [file for file in names if file in values]
    if not listed:
        raise SourceError(f"{path} names none of the {len(names)} images beside it")
    left_out = {
        "not in positions.csv": len(names) - len(listed),
        "in positions.csv without an image": n_without_image,
    }
    return FolderRecording(
        name=name,
        folder=folder,
        frames=_placed_frames(listed, [values[file] for file in listed]),
        left_out={reason: n for reason, n in left_out.items() if n},
    )


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and not path.is_dir()


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


def _values_by_name(path: Path, names: Sequence[str]) -> tuple[dict[str, dict[str, float]], int]:
    """Each line's numbers by the image's file name, and how many lines have no image."""
    columns, lines = _columns(path, _lines(path))
    if not {"name", "index"} & set(columns) and len(lines) != len(names):
        raise SourceError(f"{path} has {len(lines)} lines for {len(names)} images: add a column `name`")
    needed = {"position_m"} if "position_m" in columns else {"x_m", "y_m"}
    by_spelling = {Path(name).stem: name for name in names} | {name: name for name in names}
    by_index = dict(enumerate(names))
    values: dict[str, dict[str, float]] = {}
    line_of: dict[str, int] = {}
    n_without_image = 0
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
            n_without_image += 1
        elif name in values:
            raise SourceError(f"{where}: {name} stands in line {line_of[name]} already")
        else:
            values[name], line_of[name] = numbers, number
    return values, n_without_image


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
