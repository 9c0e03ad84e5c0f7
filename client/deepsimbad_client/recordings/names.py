"""Names and times of frames as recordings write them: their order, the file that one means, the unit of times."""

import re
import unicodedata
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import PureWindowsPath

from deepsimbad_client.errors import SourceError

UNITS = {"s": Decimal(10**6), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}  # in microseconds
FIRST_US, LAST_US = 631_152_000 * 10**6, 4_102_444_800 * 10**6  # 1990 to 2100: no two units overlap
UNKNOWN = frozenset({"", "-", "nan", "+nan", "-nan", "inf", "+inf", "-inf", "null", "none", "na", "n/a", "#n/a", "--"})
"""What tables write where nothing is known."""

_DIGITS = re.compile(r"([0-9]+)")
_DECIMALS = re.compile(r"((?:^-)?(?:(?<![0-9.])[0-9]*\.[0-9]+(?![0-9]|\.[0-9])|[0-9]+))")
_DECIMAL_COMMA = re.compile(r"(?<=[0-9]),(?=[0-9])")
_NUMBER = re.compile(r"-?[0-9]*\.?[0-9]+")
_STAMP = re.compile(r"(?<![0-9])([0-9]{10})_([0-9]{9})(?![0-9])")  # of ROS: seconds and nanoseconds
_HEXADECIMAL = re.compile(r"[0-9a-f]{2,}")
_DATE = re.compile(
    r"(?<![0-9])((?:19|20)[0-9]{2})[-_.]?([0-9]{2})[-_.]?([0-9]{2})[T _-]*([0-9]{2})[-_.:]?([0-9]{2})[-_.:]?([0-9]{2})"
)
_PART = re.compile(r"(part|chunk|split|chapter|clip|segment|seg)[-_ ]*[0-9]+[^a-z0-9]*", re.IGNORECASE)
_LONGEST_STEP = 100  # of a counter; larger ones are fractions


def in_order(names: Sequence[str]) -> list[str]:
    """File names with numbers in them as numbers: 2.png before 10.png, 1305031103.25.png before 1305031103.5.png.

    Commas between digits count as points. Where fractions of several lengths end in 0 they are counters (1.9 before
    1.10). Hexadecimal names of one length are in the order of their letters.
    """
    stems = [stem(name).lower() for name in names]
    if len(set(map(len, stems))) == 1 and all(map(_HEXADECIMAL.fullmatch, stems)) and not "".join(stems).isdigit():
        return sorted(names, key=lambda name: (name.lower(), name))
    fractions = [
        part.partition(".")[2] for name in names for part in _DECIMALS.split(_with_points(name))[1::2] if "." in part
    ]
    counters = len(set(map(len, fractions))) > 1 and any(re.fullmatch(r"[0-9]+0", fraction) for fraction in fractions)
    numbers = _DIGITS if counters else _DECIMALS

    def key(name: str) -> tuple[list[tuple[Decimal, str]], str]:
        parts = numbers.split(_with_points(name))
        return [(Decimal(part), "") if place % 2 else (_WORD, part) for place, part in enumerate(parts)], name

    return sorted(names, key=key)


_WORD = Decimal("-Infinity")


def stem(name: str) -> str:
    """A file's name without its ending; a number behind a dot is no ending."""
    base, _, ending = name.rpartition(".")
    return base if base and not ending.isdigit() else name


def _with_points(name: str) -> str:
    """A name's stem, with points for decimal commas, and seconds and nanoseconds as one number."""
    return _STAMP.sub(r"\1.\2", _DECIMAL_COMMA.sub(".", stem(name)))


def _number(name: str) -> Decimal | None:
    return Decimal(_with_points(name)) if _NUMBER.fullmatch(_with_points(name)) else None


def unit_of(time: Decimal) -> str | None:
    """The unit in which a number of time since 1970 lies between 1990 and 2100; None: in no unit."""
    return next((unit for unit, in_us in UNITS.items() if FIRST_US <= time * in_us < LAST_US), None)


def times_us(cells: Sequence[str], unit: str | None, locations: Sequence[str]) -> tuple[list[int | None], str | None]:
    """Whole microseconds of the cells of a column, None where one says nothing; and the unit they are in.

    `unit` is what the column's name says; numbers that are times since 1970 in another unit are of that other one.
    `locations` name the cells in errors. Raises SourceError (no time, or of a unit that cannot be told).
    """
    numbers = [_time(cell, location) for cell, location in zip(cells, locations, strict=True)]
    timed_cells = [(number, location) for number, location in zip(numbers, locations, strict=True) if number]
    units = {unit_of(number): location for number, location in timed_cells}
    if len(units) > 1:
        units_text = "; ".join(f"{location} is in {unit_ or 'none'}" for unit_, location in units.items())
        raise SourceError(f"times of several units: {units_text}; write all of them in microseconds (timestamp_us)")
    unit = next(iter(units), None) or unit
    if unit is None and timed_cells:
        raise SourceError(
            f"{timed_cells[0][1]}: nobody can tell the unit of the time {timed_cells[0][0]}: name the column "
            "timestamp_s, timestamp_ms, timestamp_us or timestamp_ns"
        )
    if unit is None:
        return [None] * len(cells), None
    since_1970 = unit in units  # then 0 says that there is no time
    times: list[int | None] = []
    for number, location in zip(numbers, locations, strict=True):
        if number is not None and abs(number) * UNITS[unit] >= LAST_US:
            raise SourceError(f"{location}: {number} {unit} is no time, it is after the year 2100")
        times.append(None if number is None or (since_1970 and not number) else round(number * UNITS[unit]))
    return times, unit


def _time(cell: str, location: str) -> Decimal | None:
    if cell.lower() in UNKNOWN:
        return None
    with suppress(InvalidOperation):
        number = Decimal(cell)
        if not number.is_finite():
            raise SourceError(f"{location}: {cell!r} is not a time")
        return number
    try:
        date = datetime.fromisoformat(cell)
    except ValueError as error:
        raise SourceError(f"{location}: {cell!r} is not a time") from error
    return Decimal(round((date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() * 1e6)) / 10**6


def times_of(names: Sequence[str]) -> list[int] | None:
    """Unix microseconds of the names, if all end in a time since 1970 of one unit (s, ms, us or ns); else None."""
    tokens = [_DECIMALS.split(_with_points(name))[1::2] for name in names]
    numbers = [Decimal(parts[-1]) for parts in tokens if parts]
    units = {unit_of(number) for number in numbers}
    unit = units.pop() if len(units) == 1 and len(numbers) == len(names) else None
    return None if unit is None else [round(number * UNITS[unit]) for number in numbers]


def dates_in(names: Sequence[str]) -> list[datetime] | None:
    """The moments in the names, read as UTC, if all hold a date and a time of day; else None."""
    figures = [" ".join(match.groups()) for match in map(_DATE.search, names) if match]
    try:
        dates = [datetime.strptime(date, "%Y %m %d %H %M %S").replace(tzinfo=UTC) for date in figures]
    except ValueError:
        return None
    return dates if len(dates) == len(names) else None


def counted_anew(names: Sequence[str]) -> list[int]:
    """Indices where the last number in names begins anew behind another beginning, as in a_1_28, a_1_29, a_2_0, a_2_1.

    Empty where that number is a clock's, or the last digits of one number, or the names say that they are parts.
    """
    parts = [_DECIMALS.split(_with_points(name)) for name in names]
    if any(len(part) < 4 for part in parts):
        return []
    numbers = [Decimal(part[-2]) for part in parts]
    beginnings = ["".join(part[:-2]) for part in parts]
    places = [index for index, (left, right) in enumerate(pairwise(beginnings), 1) if left != right]
    steps = [right - left for left, right in pairwise(numbers)]
    is_clock = all(len(part[-2]) == len(part[-4]) == 2 and Decimal(part[-2]) < 60 for part in parts)
    is_digit = re.fullmatch(r"10*", str(max(numbers) + 1))
    is_part = all(map(_PART.search, beginnings)) or len(set(beginnings)) != len(places) + 1
    if is_clock or is_digit or is_part:
        return []
    counts = all(step <= 0 if index in places else 0 < step <= _LONGEST_STEP for index, step in enumerate(steps, 1))
    return places if counts else []


class Finder:
    """Finds the file that a spelling means: with or without folders of any system, ending and letter case."""

    def __init__(self, names: Sequence[str]) -> None:
        self._tables = [(key, _unambiguous(names, key)) for key in _KEYS]

    def find(self, spelling: str) -> str | None:
        """The file that `spelling` means; None: there is none, or several could be meant."""
        file_name = PureWindowsPath(spelling).name  # takes both separators
        return next((files[key(file_name)] for key, files in self._tables if key(file_name) in files), None)


def _fold(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


_KEYS: tuple[Callable[[str], Hashable], ...] = (lambda name: name, _fold, stem, lambda name: stem(_fold(name)), _number)


def _unambiguous(names: Sequence[str], key: Callable[[str], Hashable]) -> dict[Hashable, str]:
    files: dict[Hashable, list[str]] = {}
    for name in names:
        files.setdefault(key(PureWindowsPath(name).name), []).append(name)
    return {text: candidates[0] for text, candidates in files.items() if len(candidates) == 1 and text is not None}
