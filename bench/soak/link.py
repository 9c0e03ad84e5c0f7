"""One kept connection to a service that may die at any moment."""

import http.client
import json
from collections.abc import Mapping
from typing import Any, Self
from urllib.parse import urlsplit

JSON = {"Content-Type": "application/json"}


class GoneError(Exception):
    """The service died before it answered: what was asked may have happened or not."""


class RefusedError(Exception):
    """The service answered with an error.

    Attributes:
        status: The HTTP status.
        problem: The problem document.
    """

    def __init__(self, what: str, status: int, problem: dict[str, Any]) -> None:
        super().__init__(f"{what}: {status} {problem}")
        self.status = status
        self.problem = problem


class Link:
    """Bare HTTP/1.1, so that the sender costs the machine as little as may be and repeats nothing by itself.

    Args:
        url: Of the service.
    """

    def __init__(self, url: str) -> None:
        self._connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=60)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._connection.close()

    def ask(
        self, method: str, path: str, body: bytes | Mapping[str, Any] = b"", headers: Mapping[str, str] | None = None
    ) -> Any:
        """Send one request; returns the parsed JSON, the bytes of any other answer, None for an empty one.

        Raises:
            GoneError: No whole answer came.
            RefusedError: The answer was an error.
        """
        sent = dict(headers or {})
        if isinstance(body, Mapping):
            body, sent = json.dumps(body).encode(), {**JSON, **sent}
        try:
            self._connection.request(method, path, body, sent)
            response = self._connection.getresponse()
            answer = response.read()
        except (OSError, http.client.HTTPException) as error:
            self._connection.close()
            raise GoneError(f"{method} {path}: {error!r}") from error
        is_json = (response.getheader("Content-Type") or "").partition(";")[0].endswith("json")
        if response.status >= http.client.BAD_REQUEST:
            problem = json.loads(answer) if is_json else {"body": repr(answer[:200])}
            raise RefusedError(f"{method} {path}", response.status, problem)
        return json.loads(answer) if is_json and answer else answer or None
