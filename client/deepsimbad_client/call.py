"""One request of the contract, described without sending it."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

import httpx2

from deepsimbad_client.errors import InvalidArgumentError
from deepsimbad_client.retry import Repeat

T = TypeVar("T")

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class Call(Generic[T]):
    """What to send and how to read the answer.

    Attributes:
        method: The HTTP verb.
        path: Below the server's address, already quoted.
        parse: Reads a successful answer.
        params: The query, without the absent ones.
        headers: On top of the client's own.
        body: The content, if any.
        repeat: When it is safe to send again.
        gone_is_done: A 404 or 410 after a try whose answer was lost means that try did it (deletes).
    """

    method: str
    path: str
    parse: Callable[[httpx2.Response], T]
    params: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | None = None
    repeat: Repeat = Repeat.ALWAYS
    gone_is_done: bool = False

    def __str__(self) -> str:
        return f"{self.method} {self.path}"


def json_body(document: Mapping[str, Any]) -> bytes:
    """Encode a document; absent (None) values are left out.

    Raises:
        InvalidArgumentError: It holds NaN or something JSON cannot say.
    """
    given = {key: value for key, value in document.items() if value is not None}
    try:
        return json.dumps(given, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"cannot be sent as JSON: {error}") from error


JSON = {"Content-Type": "application/json"}


def query(**values: float | int | str | None) -> dict[str, str]:
    """The query part of an address: absent (None) values are left out, floats keep every digit."""
    return {key: str(value) for key, value in values.items() if value is not None}


def name_in_path(kind: str, name: str) -> str:
    """A name that may stand in an address.

    Raises:
        InvalidArgumentError: It is none, with what a name may hold.
    """
    if NAME.fullmatch(name) is None:
        raise InvalidArgumentError(
            f"{name!r} cannot name a {kind}: use 1 to 64 letters, digits, '.', '_' and '-', the first a letter or digit"
        )
    return quote(name, safe="")
