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
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.arc_length import arc_length_m
from deepsimbad_client.errors import SourceError
from deepsimbad_client.image_files import (
    IMAGE_SUFFIXES,
    as_jpeg,
    as_png,
    decode,
    is_larger,
    natural_order,
    read_file,
    sniff_media_type,
)
from deepsimbad_client.recording import EncodedImage, Frame

POSITIONS_FILE = "positions.csv"

_COLUMNS = {
    "name": ("name", "file", "filename", "file_name", "image"),
    "index": ("index", "frame"),
    "position_m": ("position_m", "route_position_m", "position"),
    "x_m": ("x_m", "x"),
    "y_m": ("y_m", "y"),
    "timestamp_us": ("timestamp_us", "utime"),
    "heading_rad": ("heading_rad", "yaw"),
}
_COLUMN_OF = {spelling: column for column, spellings in _COLUMNS.items() for spelling in spellings}


@dataclass(frozen=True, eq=False)
class FolderRecording:
    """The images of a folder; see `Recording`.

    Attributes:
        name: The folder's name.
        folder: Where the images are.
        frames: In name order.
        left_out: Reasons: "not in positions.csv", "in positions.csv without an image".
    """

    name: str
    folder: Path
    frames: Sequence[Frame]
    left_out: Mapping[str, int] = field(default_factory=dict)
    encodings: NDArray[np.float32] | None = None

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame: a file no larger than asked goes as it is, a larger one as JPEG; see `Recording.image`.

        A format that cannot be posted (BMP, PGM, PPM) goes as PNG.
        """
        path = self.folder / frame.name
        body = read_file(path)
        image = decode(body, path)
        if is_larger(image, input_size):
            return as_jpeg(image, input_size)
        media_type = sniff_media_type(body)
        return as_png(image) if media_type is None else EncodedImage(body, media_type)


def read_folder(folder: Path, spacing_m: float) -> FolderRecording:
    """Open a folder of images; without a positions.csv frame i is `i * spacing_m` metres along the route.

    Raises:
        SourceError: no images, or a positions.csv that cannot be understood; the message names the line.
    """
    try:
        found = [path.name for path in folder.iterdir() if _is_image(path)]
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    names = sorted(found, key=natural_order)
    if not names:
        hint = f"; for NCLT write nclt:{folder}" if (folder / "lb3").is_dir() else ""
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){hint}")
    name = folder.resolve().name
    if not (folder / POSITIONS_FILE).is_file():
        frames = tuple(Frame(index=i, name=file, position_m=i * spacing_m) for i, file in enumerate(names))
        return FolderRecording(name=name, folder=folder, frames=frames)
    listed, n_without_image = _PositionsFile(folder / POSITIONS_FILE).by_name(names)
    kept = [file for file in names if file in listed]
    if not kept:
        raise SourceError(f"{folder / POSITIONS_FILE} names none of the {len(names)} images beside it")
    left_out = {
        "not in positions.csv": len(names) - len(kept),
        "in positions.csv without an image": n_without_image,
    }
    return FolderRecording(
        name=name,
        folder=folder,
        frames=_placed_frames(kept, [listed[file] for file in kept]),
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
            index=index,
            name=name,
            position_m=position_m,
            timestamp_us=int(line["timestamp_us"]) if "timestamp_us" in line else None,
            x_m=line.get("x_m"),
            y_m=line.get("y_m"),
            heading_rad=line.get("heading_rad"),
        )
        for index, (name, position_m, line) in enumerate(zip(names, positions, lines, strict=True))
    )


class _PositionsFile:
    """positions.csv, line by line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open(encoding="utf-8-sig", newline="") as text:
                reader = csv.reader(text)
                self.lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if any(cells)]
        except OSError as error:
            raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
        except (UnicodeDecodeError, csv.Error) as error:
            raise SourceError(f"{path} is not a csv text: {error}") from error
        if not self.lines:
            raise SourceError(f"{path} is empty: remove it, or give a position for each image")
        self.columns = self._columns()

    def by_name(self, names: Sequence[str]) -> tuple[dict[str, dict[str, float]], int]:
        """Read each line's numbers by the image's file name, and count the lines without an image."""
        places = self._places(names)
        if places is None and len(self.lines) != len(names):
            raise SourceError(f"{self.path} has {len(self.lines)} lines for {len(names)} images: add a column `name`")
        listed: dict[str, dict[str, float]] = {}
        line_of: dict[str, int] = {}
        n_without_image = 0
        for at, (number, cells) in enumerate(self.lines):
            if len(cells) < len(self.columns):
                raise self._error(number, f"{len(cells)} values where {len(self.columns)} are needed")
            values = self._values(number, cells)
            name = names[at] if places is None else self._named(number, cells, places)
            if name is None:
                n_without_image += 1
                continue
            if name in listed:
                raise self._error(number, f"{name} stands in line {line_of[name]} already")
            listed[name], line_of[name] = values, number
        return listed, n_without_image

    def _columns(self) -> list[str | None]:
        """Find out what each column is; a header is removed from the lines."""
        first = self.lines[0][1]
        columns = [_COLUMN_OF.get(cell.lower()) for cell in first]
        if any(columns):
            del self.lines[0]
        else:
            named = _number(first[0]) is None
            plain = {(1, False): ["position_m"], (2, True): ["name", "position_m"], (3, True): ["name", "x_m", "y_m"]}
            columns = list(plain.get((len(first), named), []))
        known = [column for column in columns if column is not None]
        if len(set(known)) != len(known):
            raise SourceError(f"{self.path}: two columns mean the same: {', '.join(first)}")
        if "position_m" not in known and not {"x_m", "y_m"} <= set(known):
            raise SourceError(
                f"{self.path}: the first line must name the columns, among them position_m, or x_m and y_m "
                f"(and, to name the images, name); it is: {','.join(first)}"
            )
        return columns

    def _places(self, names: Sequence[str]) -> dict[str, str] | None:
        """How a line names its image: spelling -> file name; None: by its order."""
        if "name" in self.columns:
            stems = {Path(name).stem: name for name in names}
            return {**stems, **{name: name for name in names}}
        if "index" in self.columns:
            return {str(index): name for index, name in enumerate(names)}
        return None

    def _named(self, number: int, cells: Sequence[str], places: Mapping[str, str]) -> str | None:
        if "name" in self.columns:
            return places.get(Path(cells[self.columns.index("name")]).name)
        index = cells[self.columns.index("index")]
        if not (index.isascii() and index.isdigit()):
            raise self._error(number, f"the index {index!r} is not a whole number from 0")
        return places.get(str(int(index)))

    def _values(self, number: int, cells: Sequence[str]) -> dict[str, float]:
        values: dict[str, float] = {}
        for column, cell in zip(self.columns, cells, strict=False):
            if column is None or column in {"name", "index"}:
                continue
            value = _number(cell)
            if value is None and (cell or column in self._needed):
                raise self._error(number, f"{column} is {cell!r}, not a finite number")
            if value is not None:
                values[column] = value
        return values

    @property
    def _needed(self) -> frozenset[str]:
        return frozenset({"position_m"} if "position_m" in self.columns else {"x_m", "y_m"})

    def _error(self, number: int, what: str) -> SourceError:
        return SourceError(f"{self.path}, line {number}: {what}")


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
