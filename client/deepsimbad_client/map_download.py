"""A sealed map on its way into a file: written beside it, resumed after a break, checked before it takes its name.

Nothing here sends: the blocking and the async transport ask for what is still to come and hand in what arrives.
"""

import hashlib
import os
import re
from base64 import b64decode
from binascii import Error as NotBase64
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import httpx2

from deepsimbad_client.call import Call
from deepsimbad_client.errors import (
    DamagedDownloadError,
    InvalidArgumentError,
    NotSavedError,
    TransportError,
    UnexpectedAnswerError,
)

WHOLE, PART, BEYOND_THE_END = 200, 206, 416
_ETAG = re.compile(r'"sha256:([0-9a-f]{64})"')
_REPR_DIGEST = re.compile(r"\bsha-256=:([A-Za-z0-9+/=]+):")
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

    Args:
        call: Asks for the file from its first byte on.
        path: Where it shall lie.
        on_progress: Told of the bytes there and the bytes in all (None: not known).

    Attributes:
        call: As given.
        n_received: Bytes that arrived through this object.

    Raises:
        InvalidArgumentError: No file can lie at that path.
    """

    def __init__(self, call: Call[None], path: Path, on_progress: Callable[[int, int | None], None] | None) -> None:
        if path.is_dir() or not path.parent.is_dir():
            raise InvalidArgumentError(f"{path} cannot be a file: it is a folder, or lies in one that is not there")
        self.call = call
        self.n_received = 0
        self._path = path
        self._tell = on_progress or _nobody
        self._sha256 = ""
        self._n_bytes = 0
        self._n_in_all: int | None = None
        self._hash = hashlib.sha256()
        self._file: IO[bytes] | None = None

    def asking(self) -> Call[None]:
        """The call for what is still to come; the whole file, where it is another one by now."""
        for sha256, part in self._parts():
            if n_bytes := part.stat().st_size:
                headers = {"Range": f"bytes={n_bytes}-", "If-Range": f'"sha256:{sha256}"'}
                return replace(self.call, headers={**self.call.headers, **headers})
        return self.call

    def begin(self, response: httpx2.Response) -> bool:
        """Make ready for the content of an answer; False where it holds nothing of the file.

        Raises:
            UnexpectedAnswerError: It is not an answer of a service that sends maps.
            NotSavedError: The file cannot be written.
        """
        if response.status_code not in {WHOLE, PART}:
            return False
        sha256 = _digest_of(response)
        with self._saving():
            if response.status_code == WHOLE:
                self._forget_parts()
                self._begin_at(sha256, 0)
                length = response.headers.get("content-length", "")
                self._n_in_all = int(length) if length.isdecimal() else None
            else:
                found = _CONTENT_RANGE.fullmatch(response.headers.get("content-range", ""))
                if found is None or not self._part(sha256).is_file():
                    raise UnexpectedAnswerError(f"{response.request.url} answered another part than was asked for")
                self._begin_at(sha256, int(found[1]))
                self._n_in_all = None if found[2] == "*" else int(found[2])
        return True

    def start_over(self) -> bool:
        """Forget what has come, after the service knew nothing of the rest; False where nothing had."""
        with self._saving():
            return self._forget_parts()

    def write(self, piece: bytes) -> None:
        """Keep what has arrived; raises NotSavedError."""
        if self._file is None:
            raise TransportError("content came before its answer")
        with self._saving():
            self._file.write(piece)
        self._hash.update(piece)
        self._n_bytes += len(piece)
        self.n_received += len(piece)
        self._tell(self._n_bytes, self._n_in_all)

    def pause(self) -> None:
        """Close the file; what has come stays for the next try."""
        if self._file is not None:
            file, self._file = self._file, None
            with self._saving():
                file.close()

    def finish(self) -> MapFile:
        """Check all that has come and let it take its name.

        Raises:
            DamagedDownloadError: It has another digest than the service named; it is removed.
            NotSavedError: The file cannot be written.
        """
        self.pause()
        part = self._part(self._sha256)
        with self._saving():
            if self._hash.hexdigest() != self._sha256:
                part.unlink(missing_ok=True)
                raise DamagedDownloadError(
                    f"{self.call} was damaged on its way: it should have sha256 {self._sha256}, and has "
                    f"{self._hash.hexdigest()}; nothing was kept, try again"
                )
            with part.open("rb") as written:
                os.fsync(written.fileno())
            part.replace(self._path)
        return MapFile(self._path, self._sha256, self._n_bytes)

    def _begin_at(self, sha256: str, n_bytes: int) -> None:
        """Open the part for what comes behind its first bytes, which count towards the digest."""
        self._sha256, self._n_bytes, self._hash = sha256, n_bytes, hashlib.sha256()
        self._file = self._part(sha256).open("a+b")
        self._file.truncate(n_bytes)
        self._file.seek(0)
        while piece := self._file.read(_READ_BYTES):
            self._hash.update(piece)

    def _part(self, sha256: str) -> Path:
        return self._path.with_name(f"{self._path.name}.{sha256}.part")

    def _parts(self) -> Iterator[tuple[str, Path]]:
        """What earlier tries have left: digest, file."""
        name = re.compile(re.escape(self._path.name) + r"\.([0-9a-f]{64})\.part")
        for path in self._path.parent.iterdir():
            found = name.fullmatch(path.name)
            if found is not None:
                yield found[1], path

    def _forget_parts(self) -> bool:
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


def _nobody(n_bytes: int, n_in_all: int | None) -> None:
    del n_bytes, n_in_all


def _digest_of(response: httpx2.Response) -> str:
    """The sha256 that an answer names, as hex."""
    etag = _ETAG.search(response.headers.get("etag", ""))
    if etag is not None:
        return etag[1]
    digest = _REPR_DIGEST.search(response.headers.get("repr-digest", ""))
    try:
        decoded = b64decode(digest[1], validate=True) if digest is not None else b""
    except NotBase64:
        decoded = b""
    if len(decoded) != hashlib.sha256().digest_size:
        raise UnexpectedAnswerError(f"{response.request.url} does not name the sha256 of the file: is this a map?")
    return decoded.hex()
