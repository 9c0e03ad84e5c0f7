"""JSON columns and times, one way for every table."""

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

from deepsimbad.errors import DamagedFileError, InvalidInputError

_Record = TypeVar("_Record")


def to_json(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """The one text of a JSON value: sorted keys, no spaces, no NaN, so that equal values are equal texts.

    Raises:
        InvalidInputError: The value has no JSON form.
    """
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(f"not a JSON value: {error}") from error
    return text


def from_json(text: str) -> Any:
    """The value of a JSON column; raises ValueError on damage."""
    return json.loads(text)


def row_reader(read: Callable[[tuple[Any, ...]], _Record]) -> Callable[[tuple[Any, ...]], _Record]:
    """Let a function that makes a record of a row raise DamagedFileError where the row cannot be one."""

    @functools.wraps(read)
    def read_or_refuse(row: tuple[Any, ...]) -> _Record:
        try:
            return read(row)
        except (TypeError, ValueError, RecursionError) as error:
            raise DamagedFileError(f"the catalog is damaged: a row cannot be read: {error}") from error

    return read_or_refuse


def now() -> str:
    """The present moment in UTC as ISO 8601, to the millisecond; texts sort as times do."""
    return _text(datetime.now(UTC))


def now_behind(latest: str | None) -> str:
    """The present moment, or one just behind another where the clock does not show a later one."""
    moment = datetime.now(UTC)
    if latest is None or _text(moment) > latest:
        return _text(moment)
    return _text(datetime.fromisoformat(latest) + timedelta(milliseconds=1))


def after(wait: timedelta) -> str:
    """The moment that follows now by `wait`, as `now` writes it; raises InvalidInputError past the year 9999."""
    try:
        return _text(datetime.now(UTC) + wait)
    except OverflowError as error:
        raise InvalidInputError("a time past the year 9999 cannot be kept") from error


def _text(moment: datetime) -> str:
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
