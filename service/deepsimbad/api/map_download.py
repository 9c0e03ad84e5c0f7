"""Sending a sealed map file: the very bytes that were checked, whole or in part."""

import base64
import hashlib
import re
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import BinaryIO

from anyio import CancelScope
from anyio.to_thread import run_sync
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from deepsimbad.api.entity_tags import KEPT, names
from deepsimbad.errors import DamagedMapError
from deepsimbad.store.faults import storage_faults

MEDIA_TYPE = "application/vnd.sqlite3"
_CHUNK_BYTES = 256 * 1024
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


class MapFile:
    """A map file, open: what is sent is what was checked, even if the file is removed meanwhile.

    Args:
        stream: The open file.
        sha256: Of all of it, in hex.
        n_bytes: Its length.
    """

    def __init__(self, stream: BinaryIO, sha256: str, n_bytes: int) -> None:
        self._stream = stream
        self.sha256 = sha256
        self.n_bytes = n_bytes

    @classmethod
    def open(cls, path: Path, sha256: str) -> "MapFile":
        """Open a file and read it against its digest.

        Raises:
            DamagedMapError: It is missing, or not the one that was sealed.
            UnavailableError: The disk failed, ...
        """
        if not path.is_file():
            raise DamagedMapError(f"{path.name} is missing", file=path.name)
        with storage_faults(path, DamagedMapError):
            stream = path.open("rb")
            try:
                if hashlib.file_digest(stream, "sha256").hexdigest() != sha256:
                    raise DamagedMapError(
                        f"{path.name} is not the file that was sealed: its SHA-256 differs", file=path.name
                    )
                return cls(stream, sha256, stream.tell())
            except BaseException:
                stream.close()
                raise

    @property
    def etag(self) -> str:
        """What names these bytes."""
        return f'"sha256:{self.sha256}"'

    @property
    def digest(self) -> str:
        """The same as RFC 9530 writes it."""
        return f"sha-256=:{base64.b64encode(bytes.fromhex(self.sha256)).decode()}:"

    def read(self, start: int, stop: int) -> Iterator[bytes]:
        """Bytes from `start` up to `stop`, in pieces."""
        self._stream.seek(start)
        while start < stop:
            piece = self._stream.read(min(_CHUNK_BYTES, stop - start))
            if not piece:
                raise DamagedMapError("a map file became shorter while it was sent")
            start += len(piece)
            yield piece

    def close(self) -> None:
        """Let go of the file."""
        self._stream.close()


class _MapResponse(StreamingResponse):
    """Closes the file once the answer is sent, or its reader gone."""

    def __init__(self, file: MapFile, start: int, stop: int, status: int, headers: dict[str, str]) -> None:
        super().__init__(file.read(start, stop), status, headers, MEDIA_TYPE)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            with CancelScope(shield=True):
                await run_sync(self._file.close)


def map_response(file: MapFile, filename: str, headers: Headers) -> Response:
    """The answer to a request for a map file, which it closes.

    Args:
        file: The file.
        filename: What it is to be called.
        headers: The request's. One range of bytes is served; more than one, or what is no range, is answered whole.

    Raises:
        HTTPException: 416, a range that begins behind the end.
    """
    told = {
        "Accept-Ranges": "bytes",
        **KEPT,
        "ETag": file.etag,
        "Repr-Digest": file.digest,
        "Content-Disposition": f'attachment; filename="{filename}"',
    }
    if names(headers.get("if-none-match"), file.etag):
        file.close()
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers={**KEPT, "ETag": file.etag})
    part = None
    if headers.get("if-range") in {None, file.etag}:
        part = _part(headers.get("range"), file.n_bytes)
    if part is None:
        told["Content-Length"] = str(file.n_bytes)
        return _MapResponse(file, 0, file.n_bytes, HTTPStatus.OK, told)
    start, stop = part
    if start >= stop:
        file.close()
        raise HTTPException(
            HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
            f"the file has {file.n_bytes} bytes",
            {"Content-Range": f"bytes */{file.n_bytes}"},
        )
    told |= {"Content-Range": f"bytes {start}-{stop - 1}/{file.n_bytes}", "Content-Length": str(stop - start)}
    return _MapResponse(file, start, stop, HTTPStatus.PARTIAL_CONTENT, told)


def _part(wanted: str | None, n_bytes: int) -> tuple[int, int] | None:
    """First byte and the one behind the last of a Range header; None where the whole is to be sent."""
    match = _RANGE.fullmatch(wanted.replace(" ", "")) if wanted else None
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if not first:  # the last so many
        return max(n_bytes - int(last), 0), n_bytes
    if last and int(last) < int(first):
        return None
    return int(first), min(int(last) + 1, n_bytes) if last else n_bytes
