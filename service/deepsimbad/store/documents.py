"""JSON columns and times, one way for every table."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from deepsimbad.errors import InvalidInputError


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


def now() -> str:
    """The present moment in UTC as ISO 8601, to the millisecond; texts sort as times do."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
