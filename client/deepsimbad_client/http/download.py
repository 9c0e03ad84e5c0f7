"""A sealed map on its way into a file: written beside it, resumed after a break, checked before it takes its name."""

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import httpx2

from deepsimbad_client.errors import (
    DamagedDownloadError,
    InvalidArgumentError,
    NotSavedError,
    UnexpectedAnswerError,
)
from deepsimbad_client.http.call import Call, raise_for_problem
from deepsimbad_client.http.retry import Attempts
from deepsimbad_client.http.wire import Wire

WHOLE, PART, BEYOND_THE_END = 200, 206, 416
_ETAG = re.compile(r'"sha256:([0-9a-f]{64})"')
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")
_READ_BYTES = 1 << 20


@dataclass(frozen=True)
class MapFile:
    """A map as it lies here.

    Attributes:
        path: The file.
        sha256: Its digest, which the service has named too.
        file_bytes: Its size.
    """

    path: Path
    sha256: str
    file_bytes: int


class MapDownload:
    """One file on its way.

    What has come waits in `<name>.<sha256>.part`: the name tells a later try, in this process or another, of which file
    it is the beginning.

    `call` asks for the file from its first byte on; `on_progress` is told of the bytes there and in all, where
    known. Raises InvalidArgumentError (no file can lie at that path).
    """

    def __init__(
        self, wire: Wire, call: Call, path: Path, on_progress: Callable[[int, int | None], None] | None
    ) -> None:
        if path.is_dir() or not path.parent.is_dir():
            raise InvalidArgumentError(f"{path} cannot be a file: it is a folder, or lies in one that is not there")
        self._wire = wire
        self._call = call
        self._path = path
        self._tell = on_progress
        self._n_received = 0
        self._sha256 = ""
        self._n_bytes = 0
        self._n_in_all: int | None = None
        self._hash = hashlib.sha256()

    async def run(self) -> MapFile:
        """Receive the file until all of it is there; as long as something comes now and then it never gives up.

        Raises TransportError, ApiError, UnexpectedAnswerError, DamagedDownloadError, NotSavedError.
        """
        attempts = self._wire.attempts(self._call)
        wait_s: float | None = 0.0
        while wait_s is not None:
            n_received = self._n_received
            try:
                wait_s = await self._receive(attempts)
            except httpx2.TransportError as error:
                if self._n_received > n_received:
                    attempts = self._wire.attempts(self._call)
                wait_s = attempts.after_failure(error)
            if wait_s is not None:
                await self._wire.link.sleep(wait_s)
        return await self._wire.link.aside(self._finish)

    async def _receive(self, attempts: Attempts) -> float | None:
        """Receive what comes; answers how long to wait before asking for more, None where nothing is missing."""
        link = self._wire.link
        async with link.stream(self._wire.request(self._asking())) as response:
            if response.status_code in {WHOLE, PART}:
                with self._saving():
                    part = await link.aside(lambda: self._part_for(response))
                try:
                    async for piece in link.pieces(response):
                        self._keep(piece, part)
                finally:
                    with self._saving():
                        part.close()
                return None
            if response.status_code == BEYOND_THE_END and self._forget_parts():
                return 0.0
            wait_s = attempts.after_answer(response)
            if wait_s is None:
                raise_for_problem(response)
            return wait_s

    def _asking(self) -> Call:
        """The call for what is still to come; the whole file, where it is another one by now."""
        for sha256, part in self._parts():
            if n_bytes := part.stat().st_size:
                headers = {"Range": f"bytes={n_bytes}-", "If-Range": f'"sha256:{sha256}"'}
                return replace(self._call, headers={**self._call.headers, **headers})
        return self._call

    def _part_for(self, response: httpx2.Response) -> IO[bytes]:
        """The file that an answer's content is to be added to; what is in it already counts towards the digest."""
        self._sha256 = _digest_of(response)
        part, first = self._part(self._sha256), 0
        if response.status_code == WHOLE:
            self._forget_parts()
            length = response.headers.get("content-length", "")
            self._n_in_all = int(length) if length.isdecimal() else None
        else:
            stretch = _CONTENT_RANGE.fullmatch(response.headers.get("content-range", ""))
            if stretch is None or not part.is_file():
                raise UnexpectedAnswerError(f"{response.request.url} answered another part than was asked for")
            first = int(stretch[1])
            self._n_in_all = None if stretch[2] == "*" else int(stretch[2])
        self._n_bytes, self._hash = first, hashlib.sha256()
        file = part.open("a+b")
        file.truncate(first)
        file.seek(0)
        while piece := file.read(_READ_BYTES):
            self._hash.update(piece)
        return file

    def _keep(self, piece: bytes, part: IO[bytes]) -> None:
        with self._saving():
            part.write(piece)
        self._hash.update(piece)
        self._n_bytes += len(piece)
        self._n_received += len(piece)
        if self._tell is not None:
            self._tell(self._n_bytes, self._n_in_all)

    def _finish(self) -> MapFile:
        """Check all that has come and let it take its name."""
        part = self._part(self._sha256)
        with self._saving():
            if self._hash.hexdigest() != self._sha256:
                part.unlink(missing_ok=True)
                raise DamagedDownloadError(
                    f"{self._call} was damaged on its way: it should have sha256 {self._sha256}, and has "
                    f"{self._hash.hexdigest()}; nothing was kept, try again"
                )
            with part.open("rb") as written:
                os.fsync(written.fileno())
            part.replace(self._path)
        return MapFile(self._path, self._sha256, self._n_bytes)

    def _part(self, sha256: str) -> Path:
        return self._path.with_name(f"{self._path.name}.{sha256}.part")

    def _parts(self) -> Iterator[tuple[str, Path]]:
        """What earlier tries have left: digest, file."""
        name = re.compile(re.escape(self._path.name) + r"\.([0-9a-f]{64})\.part")
        for path in self._path.parent.iterdir():
            if matched := name.fullmatch(path.name):
                yield matched[1], path

    def _forget_parts(self) -> bool:
        """Remove what earlier tries have left; False where there was nothing."""
        with self._saving():
            parts = [path for _, path in self._parts()]
            for path in parts:
                path.unlink(missing_ok=True)
        return bool(parts)

    @contextmanager
    def _saving(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise NotSavedError(f"{self._path} cannot be written: {error.strerror or error}") from error


def _digest_of(response: httpx2.Response) -> str:
    """The sha256 that an answer names, as hex."""
    etag = _ETAG.search(response.headers.get("etag", ""))
    if etag is None:
        raise UnexpectedAnswerError(f"{response.request.url} does not name the sha256 of the file: is this a map?")
    return etag[1]
