"""The names of frames: in which order they come, which file a spelling means, and what times they tell."""

import re
import unicodedata
from collections.abc import Callable, Hashable, Sequence
from decimal import Decimal
from pathlib import PureWindowsPath

from deepsimbad_client.recordings.clock import UNITS, unit_of

_DIGITS = re.compile(r"([0-9]+)")
_DECIMALS = re.compile(r"((?:^-)?(?:(?<![0-9.])[0-9]*\.[0-9]+(?![0-9]|\.[0-9])|[0-9]+))")
_DECIMAL_COMMA = re.compile(r"(?<=[0-9]),(?=[0-9])")
_NUMBER = re.compile(r"-?[0-9]*\.?[0-9]+")


def in_order(names: Sequence[str]) -> list[str]:
    """File names with numbers in them as numbers: 2.png before 10.png, 1305031103.25.png before 1305031103.5.png.

    Commas between digits count as points. Where fractions of several lengths end in 0 they are counters (1.9 before
    1.10).
    """
    fractions = [
        part.partition(".")[2] for name in names for part in _DECIMALS.split(_pointed(name))[1::2] if "." in part
    ]
    counters = len(set(map(len, fractions))) > 1 and any(re.fullmatch(r"[0-9]+0", fraction) for fraction in fractions)
    numbers = _DIGITS if counters else _DECIMALS

    def key(name: str) -> tuple[list[tuple[Decimal, str]], str]:
        parts = numbers.split(_pointed(name))
        return [(Decimal(part), "") if place % 2 else (_WORD, part) for place, part in enumerate(parts)], name

    return sorted(names, key=key)


_WORD = Decimal("-Infinity")


def stem(name: str) -> str:
    """A file's name without its ending; what follows a dot and is a number is no ending."""
    before, _, ending = name.rpartition(".")
    return before if before and not ending.isdigit() else name


def _pointed(name: str) -> str:
    """A name's stem, with points for decimal commas."""
    return _DECIMAL_COMMA.sub(".", stem(name))


def _number(name: str) -> Decimal | None:
    return Decimal(_pointed(name)) if _NUMBER.fullmatch(_pointed(name)) else None


def times_of(names: Sequence[str]) -> list[int] | None:
    """Unix microseconds, where all names end in a time since 1970 of one unit (s, ms, us or ns); else None."""
    tokens = [_DECIMALS.split(_pointed(name))[1::2] for name in names]
    numbers = [Decimal(parts[-1]) for parts in tokens if parts]
    units = {unit_of(number) for number in numbers}
    unit = units.pop() if len(units) == 1 and len(numbers) == len(names) else None
    return None if unit is None else [round(number * UNITS[unit]) for number in numbers]


class Finder:
    """Which of some files a spelling means: with or without folders of any system, ending and letter case."""

    def __init__(self, names: Sequence[str]) -> None:
        self._tables = [(key, _unambiguous(names, key)) for key in _KEYS]

    def find(self, spelling: str) -> str | None:
        """The file; None: there is none, or several could be meant."""
        written = PureWindowsPath(spelling).name  # which takes both separators
        return next((files[key(written)] for key, files in self._tables if key(written) in files), None)


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


_KEYS: tuple[Callable[[str], Hashable], ...] = (
    lambda name: name,
    _folded,
    stem,
    lambda name: stem(_folded(name)),
    _number,
)


def _unambiguous(names: Sequence[str], key: Callable[[str], Hashable]) -> dict[Hashable, str]:
    files: dict[Hashable, list[str]] = {}
    for name in names:
        files.setdefault(key(PureWindowsPath(name).name), []).append(name)
    return {text: same[0] for text, same in files.items() if len(same) == 1 and text is not None}
