"""One kept connection to a service that may die at any moment."""

import http.client
import io
import json
import time
from collections.abc import Mapping
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np

JSON, BINARY = "application/json", "application/octet-stream"
NPZ = {"Content-Type": BINARY}


class GoneError(Exception):
    """The service died before it answered: what was asked may have happened or not."""


class RefusedError(Exception):
    """The service answered with an error.

    Attributes:
        status: The HTTP status.
        code: Of the problem document; empty where the answer was none.
    """

    def __init__(self, request: str, status: int, problem: dict[str, Any]) -> None:
        super().__init__(f"{request}: {status} {problem}")
        self.status = status
        self.code = str(problem.get("code", ""))


class Link:
    """Bare HTTP/1.1, so that the sender costs the machine as little as may be and repeats nothing by itself."""

    def __init__(self, url: str) -> None:
        self._connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=120)

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
        sent = {} if headers is None else dict(headers)
        if isinstance(body, Mapping):
            body, sent = json.dumps(body).encode(), {"Content-Type": JSON, **sent}
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

    def upload(
        self, domain: str, traverse: str, position_m: np.ndarray, encodings: np.ndarray, **more: np.ndarray
    ) -> None:
        """Make a traverse of frames 0, 1, ..., of which perhaps more is known."""
        path = f"/v1/admin/domains/{domain}/traverses"
        self.ask("POST", path, {"name": traverse})
        batch = packed(encodings=encodings, index=np.arange(len(encodings)), position_m=position_m, **more)
        self.ask("POST", f"{path}/{traverse}/frames", batch, NPZ)

    def remap(self, domain: str, config: Mapping[str, Any]) -> dict[str, Any]:
        """The job of a remap, succeeded; a RuntimeError where it did not."""
        job: dict[str, Any] = self.ask("POST", f"/v1/admin/domains/{domain}/remaps", config)
        while job["state"] in {"queued", "running"}:
            time.sleep(0.1)
            job = self.ask("GET", f"/v1/admin/jobs/{job['job_id']}")
        if job["state"] != "succeeded":
            raise RuntimeError(f"the remap failed: {job}")
        return job


def packed(**arrays: Any) -> bytes:
    """An npz file."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()
