"""One kept connection to a service that may die at any moment."""

import io
import json
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from http.client import BAD_REQUEST
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
        code: Of the problem document; empty where the answer was no such document.
    """

    def __init__(self, request: str, status: int, problem: dict[str, Any]) -> None:
        super().__init__(f"{request}: {status} {problem}")
        self.status = status
        self.code = str(problem.get("code", ""))


class Link:
    """Bare HTTP/1.1, so that the sender costs the machine as little as may be and repeats nothing by itself."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._address, self._host = (parts.hostname or "", parts.port or 80), parts.netloc
        self._stream: Any = None  # of bytes, both ways; None: not connected

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._stream is not None:
            with suppress(OSError):  # what a service that died never took is written once more
                self._stream.close()
            self._stream = None

    def _exchange(self, request: bytes) -> tuple[int, dict[bytes, bytes], bytes]:
        """Status, headers and body of the answer; raises OSError or ValueError where none comes whole."""
        if self._stream is None:
            with socket.create_connection(self._address, timeout=120) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._stream = connection.makefile("rwb", buffering=1 << 16)
        stream = self._stream
        stream.write(request)
        stream.flush()
        status = int(stream.readline().split()[1])
        headers = {}
        for line in iter(stream.readline, b"\r\n"):
            if not line:
                raise ValueError("the answer ended early")
            name, _, value = line.partition(b": ")
            headers[name.lower()] = value.rstrip()
        body = stream.read(n_bytes := int(headers.get(b"content-length", 0)))
        if len(body) < n_bytes or b"transfer-encoding" in headers:
            raise ValueError("no whole answer of a length told before")
        if headers.get(b"connection") == b"close":
            self._close()
        return status, headers, body

    def ask(
        self, method: str, path: str, body: bytes | Mapping[str, Any] = b"", headers: Mapping[str, str] | None = None
    ) -> Any:
        """Send one request; returns the parsed JSON, the bytes of any other answer, None for an empty one.

        Raises:
            GoneError: No whole answer came.
            RefusedError: The answer was an error.
        """
        fields = {} if headers is None else dict(headers)
        if isinstance(body, Mapping):
            body, fields = json.dumps(body).encode(), {"Content-Type": JSON, **fields}
        lines = [f"{method} {path} HTTP/1.1", f"Host: {self._host}", f"Content-Length: {len(body)}"]
        lines += [f"{name}: {value}" for name, value in fields.items()]
        try:
            status, answer_headers, answer = self._exchange("\r\n".join([*lines, "", ""]).encode() + body)
        except (OSError, ValueError, IndexError) as error:
            self._close()
            raise GoneError(f"{method} {path}: {error!r}") from error
        is_json = answer_headers.get(b"content-type", b"").partition(b";")[0].endswith(b"json")
        if status >= BAD_REQUEST:
            problem = json.loads(answer) if is_json else {"body": repr(answer[:200])}
            raise RefusedError(f"{method} {path}", status, problem)
        return json.loads(answer) if is_json and answer else answer or None

    def upload(
        self, domain: str, traverse: str, position_m: np.ndarray, encodings: np.ndarray, **arrays: np.ndarray
    ) -> None:
        """Make a traverse of frames 0, 1, ...; `arrays` are further arrays of a batch, such as `x_m`."""
        path = f"/v1/admin/domains/{domain}/traverses"
        self.ask("POST", path, {"name": traverse})
        batch = packed(encodings=encodings, index=np.arange(len(encodings)), position_m=position_m, **arrays)
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
