"""`positions.csv`: where the images beside it were taken.

A header and one line for each image, cells between commas, or semicolons or tabs (then 0,5 is a half). The columns are
these, in any order; others are ignored, and so is a # before the first:

    name          the image's file name: folders before it, letter case and its ending do not matter; without this
                  column (and without `index`) the lines go with the images in name order and there must be as many
    index         instead of a name: the image's place in name order, from 0
    position_m    metres along the route; without it the distance along x_m, y_m is taken
    x_m, y_m      ground coordinates in metres; or latitude, longitude in degrees (lat, lon), which become UTM
    timestamp_us  Unix microseconds; seconds, milli- and nanoseconds are told by their magnitude, or by the column's
                  name (timestamp_s, timestamp_ms, timestamp_ns); dates such as 2012-01-22T08:30:00Z do as well
    heading_rad   turning from x towards y

Without a header it may hold just positions, one number a line, or `name,position_m`, or `name,x_m,y_m`. Images that
are not listed, lines whose image does not exist, and images whose place is empty or NaN are left out and counted.
"""

import csv
import dataclasses
import math
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.frames import MAX_POSITION_M
from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import NO_IMAGE, Frame, finite_number
from deepsimbad_client.recordings.gps import GPS_DEADBAND_M, utm, zone_remarks
from deepsimbad_client.recordings.names import UNITS, UNKNOWN, Finder, times_us
from deepsimbad_client.recordings.placing import UNPLACED, Placement, place_on_track
from deepsimbad_client.recordings.track import DEADBAND_M, track_of

CLOCKS_APART_S = 0.5

POSITIONS_FILE = "positions.csv"

_SPELLINGS = {
    "name": ("name", "file", "filename", "file_name", "image"),
    "index": ("index", "frame"),
    "position_m": ("position_m", "route_position_m", "position"),
    "x_m": ("x_m", "x"),
    "y_m": ("y_m", "y"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng"),
    "heading_rad": ("heading_rad", "yaw"),
    "timestamp": (
        "timestamp",
        "time",
        "stamp",
        "utime",
        *(f"{word}_{unit}" for word in ("timestamp", "time") for unit in UNITS),
    ),
}
_COLUMN_OF = {spelling: column for column, spellings in _SPELLINGS.items() for spelling in spellings}
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]+,[0-9]+")
_PLANES = ({"x_m", "y_m"}, {"latitude", "longitude"})
_WITHOUT_HEADER = {
    (1, False): ["position_m"],
    (2, True): ["name", "position_m"],
    (3, True): ["name", "x_m", "y_m"],
}  # by the number of cells in a line, and whether the first is a word


@dataclass(frozen=True)
class _Table:
    """The content of the file, a row for each line."""

    path: Path
    columns: Sequence[str | None]  # the meaning of each column; None: ignored
    time_unit: str | None  # by the name of the column of times
    lines: Sequence[tuple[int, list[str]]]  # (number in the file, cells)

    def location(self, row: int) -> str:
        """The file and line of a row, for errors."""
        return f"{self.path}, line {self.lines[row][0]}"

    def cells(self, column: str) -> list[str] | None:
        """The cells of a column; None: there is no such column."""
        if column not in self.columns:
            return None
        index = self.columns.index(column)
        return [line[index] for _, line in self.lines]

    def numbers(self, column: str) -> list[float | None]:
        """A column of numbers, None where a cell is empty or unknown. Raises SourceError (a cell is no number).

        Numbers beyond `MAX_POSITION_M` count as unknown too.
        """
        values: list[float | None] = []
        for row, cell in enumerate(self.cells(column) or [""] * len(self.lines)):
            value = finite_number(cell)
            if value is None and cell.lower() not in UNKNOWN:
                raise SourceError(f"{self.location(row)}: {column} is {cell!r}, not a number such as 1234.5")
            values.append(None if value is None or abs(value) > MAX_POSITION_M else value)
        return values

    def times_us(self) -> tuple[list[int | None], list[str]]:
        """The times in microseconds, and remarks on them. Raises SourceError."""
        cells = self.cells("timestamp")
        if cells is None:
            return [None] * len(self.lines), []
        times, unit = times_us(cells, self.time_unit, [self.location(row) for row in range(len(self.lines))])
        differs = unit is not None and unit != self.time_unit
        return times, [f"times in {self.path.name} are taken for {unit}"] if differs else []


def positions_file(folder: Path) -> Path | None:
    """A folder's `positions.csv`, in any letter case but small letters preferred; None: there is none."""
    tables = [path for path in folder.iterdir() if path.name.lower() == POSITIONS_FILE and path.is_file()]
    return max(tables, default=None)  # small letters come after capital ones


def read_positions(path: Path, names: Sequence[str], name_times_us: Sequence[int | None]) -> Placement:
    """Images as `positions.csv` states them; `names` are in order, and `name_times_us` the times in these names.

    The frames are still to be placed. Lines without names, of another number than the images, are interpolated at the
    times of the images. Raises SourceError.
    """
    table = _read(path)
    times, remarks = table.times_us()
    plane = [table.numbers(column) for column in ("x_m", "y_m")]
    deadband_m = DEADBAND_M
    if "latitude" in table.columns and "x_m" not in table.columns:
        degrees = [np.array(table.numbers(column), np.float64) for column in ("latitude", "longitude")]  # None: NaN
        _check_degrees(path, *degrees)
        plane = [[None if math.isnan(metres) else metres for metres in axis.tolist()] for axis in utm(*degrees)]
        deadband_m = GPS_DEADBAND_M
        remarks += zone_remarks(*degrees)
    places = zip(table.numbers("position_m"), *plane, table.numbers("heading_rad"), times, strict=True)
    rows = [
        Frame(row, "", UNPLACED if position_m is None else position_m, time_us, x_m, y_m, heading_rad)
        for row, (position_m, x_m, y_m, heading_rad, time_us) in enumerate(places)
    ]
    if not {"name", "index"} & set(table.columns) and len(rows) != len(names):
        if "timestamp" in table.columns and "position_m" not in table.columns and None not in name_times_us:
            return _interpolate(rows, names, name_times_us, path, deadband_m)
        raise SourceError(f"{path} has {len(rows)} lines for {len(names)} images: add a column `name`")
    row_of, without_image = _rows_by_name(table, names)
    if not row_of:
        raise SourceError(f"{path} names none of the {len(names)} images beside it")
    image_times = [(name, time_us) for name, time_us in zip(names, name_times_us, strict=True) if name in row_of]
    frames = [
        dataclasses.replace(
            rows[row_of[name]], name=name, timestamp_us=time_us if times[row_of[name]] is None else times[row_of[name]]
        )
        for name, time_us in image_times
    ]
    left_out_names = {
        f"not in {path.name}": [name for name in names if name not in row_of],
        f"in {path.name}{NO_IMAGE}": without_image,
    }
    return Placement(
        frames,
        {reason: image_names for reason, image_names in left_out_names.items() if image_names},
        remarks + _clock_remarks(image_times, frames),
        deadband_m,
    )


def _check_degrees(path: Path, latitude: NDArray[np.float64], longitude: NDArray[np.float64]) -> None:
    """Raise SourceError if no place of [n], NaN where unknown, lies within the earth's degrees."""
    is_known = np.isfinite(latitude) & np.isfinite(longitude)
    if is_known.any() and not (is_known & (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)).any():
        first = int(np.argmax(is_known))
        raise SourceError(
            f"{path}: latitude {latitude[first]:g}, longitude {longitude[first]:g} is no place in degrees, which are "
            "within 90 and 180: are they changed over, or of another unit?"
        )


def _clock_remarks(image_times: Sequence[tuple[str, int | None]], frames: Sequence[Frame]) -> list[str]:
    """A remark where the times in the names differ from those in the table; empty where they agree."""
    differences_s = [
        (frame.timestamp_us - time_us) / 1e6
        for (_, time_us), frame in zip(image_times, frames, strict=True)
        if time_us is not None and frame.timestamp_us is not None
    ]
    if not differences_s or max(map(abs, differences_s)) < CLOCKS_APART_S:
        return []
    return [
        f"the table's times differ from those of the names by {differences_s[0]:+.3f} s at the first frame and "
        f"{differences_s[-1]:+.3f} s at the last: the table's are taken"
    ]


def _interpolate(
    rows: Sequence[Frame], names: Sequence[str], times_us: Sequence[int | None], path: Path, deadband_m: float
) -> Placement:
    columns = np.array([[row.timestamp_us, row.x_m, row.y_m] for row in rows], np.float64).T  # None becomes NaN
    time_us, x_m, y_m = columns
    track = track_of(time_us, x_m, y_m, deadband_m=deadband_m)
    if track is None:
        raise SourceError(f"{path}: fewer than two lines hold a time and a place")
    images = [(name, time_us) for name, time_us in zip(names, times_us, strict=True) if time_us is not None]
    return place_on_track(track, images, str(path), together=True)


def _rows_by_name(table: _Table, names: Sequence[str]) -> tuple[dict[str, int], list[str]]:
    """The row of each image by name, and the spellings in rows whose image does not exist."""
    spellings, indices = table.cells("name"), table.cells("index")
    if indices is not None and spellings is None and {"1", str(len(names))} <= set(indices) and "0" not in indices:
        raise SourceError(f"{table.path}: the index counts from 1 to {len(names)}: count from 0, or name the images")
    finder, row_of = Finder(names), dict[str, int]()
    without_image: list[str] = []
    for row in range(len(table.lines)):
        if spellings is not None:
            spelling, name = spellings[row], finder.find(spellings[row])
        else:
            spelling = str(row) if indices is None else indices[row]
            if not (spelling.isascii() and spelling.isdigit()):
                raise SourceError(f"{table.location(row)}: the index {spelling!r} is not a whole number from 0")
            name = names[int(spelling)] if int(spelling) < len(names) else None
        if name is None:
            without_image.append(spelling)
        elif name in row_of:
            raise SourceError(f"{table.location(row)}: {name} stands in line {table.lines[row_of[name]][0]} already")
        else:
            row_of[name] = row
    return row_of, without_image


def _read(path: Path) -> _Table:
    """Read the file as a table; raises SourceError."""
    lines = _lines(path)
    first = lines[0][1]
    first[0] = first[0].lstrip("# ")
    columns = [_COLUMN_OF.get(cell.lower()) for cell in first]
    unit = None
    if any(columns):
        lines = lines[1:]
        if "timestamp" in columns:
            spelling = first[columns.index("timestamp")].lower()
            unit = (
                "us" if spelling == "utime" else next((unit for unit in UNITS if spelling.endswith(f"_{unit}")), None)
            )
    else:
        columns = list(_WITHOUT_HEADER.get((len(first), finite_number(first[0]) is None), []))
    if {"name", "index"} & set(columns):
        lines = [line for line in lines if any(line[1])]
    used_columns = [column for column in columns if column is not None]
    if len(set(used_columns)) != len(used_columns):
        raise SourceError(f"{path}: two columns mean the same: {', '.join(first)}")
    if "position_m" not in used_columns and not any(plane <= set(used_columns) for plane in _PLANES):
        raise SourceError(
            f"{path}: the first line must name the columns, among them position_m, or x_m and y_m, or latitude "
            f"and longitude (and, to name the images, name); it is: {','.join(first)}"
        )
    for number, cells in lines:
        if len(cells) < len(columns):
            raise SourceError(f"{path}, line {number}: {len(cells)} values where {len(columns)} are needed")
        if any(cells[len(first) :]):
            raise SourceError(
                f"{path}, line {number}: {len(cells)} values, and the first line has {len(first)}; where numbers have "
                "decimal commas, put semicolons between cells"
            )
    return _Table(path, columns, unit, lines)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        with path.open("rb") as file:
            encoding = "utf-16" if file.read(2) in {BOM_UTF16_LE, BOM_UTF16_BE} else "utf-8-sig"
        with path.open(encoding=encoding, newline="") as text:
            first = text.readline()
            text.seek(0)
            delimiter = max(",;\t", key=first.count)
            reader = csv.reader(text, delimiter=delimiter)
            lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if cells]
            if delimiter != ",":
                lines = [
                    (number, [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells])
                    for number, cells in lines
                ]
            while lines and not any(lines[-1][1]):
                lines.pop()
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"{path} is not a csv text, save it as CSV in UTF-8: {error}") from error
    if lines and any("\0" in cell for cell in lines[0][1]):
        raise SourceError(f"{path} is not a csv text: save it as CSV in UTF-8")
    if not lines:
        raise SourceError(f"{path} is empty: remove it, or give a position for each image")
    return lines
