"""The download of a sealed map: written beside its file, resumed after a break, checked before it takes its name."""

import hashlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import httpx2

from deepsimbad_client.errors import DamagedDownloadError, InvalidArgumentError, UnexpectedAnswerError
from deepsimbad_client.http import Call, raise_for_problem
from deepsimbad_client.http.wire import Wire

PART, BEYOND_THE_END = 206, 416
_ETAG = re.compile(r'"sha256:([0-9a-f]{64})"')
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(?:\d+|\*)")

OnBytes = Callable[[int, int | None], None]  # (bytes that have come, bytes in all or None where that is unknown)


@dataclass(frozen=True)
class MapFile:
    """A downloaded map."""

    path: Path
    sha256: str  # equal to the one that the service named
    file_bytes: int


async def download(wire: Wire, call: Call, path: Path, on_progress: OnBytes) -> MapFile:
    """Fetch the file that `call` asks for; a try that brings some bytes starts the count of tries anew.

    The bytes that have come wait in `<name>.<sha256>.part`: the name tells a later try, in this process or another,
    which file they begin. Raises InvalidArgumentError, TransportError, ApiError, UnexpectedAnswerError,
    DamagedDownloadError.
    """
    if path.is_dir() or not path.parent.is_dir():
        raise InvalidArgumentError(f"{path} cannot be a file: it is a folder, or lies in one that is not there")
    attempts = wire.attempts(call)
    while True:
        part, headers, n_there = next(iter(_parts(path)), None), dict(call.headers), 0
        if part is not None and (n_there := part.stat().st_size):
            headers |= {"Range": f"bytes={n_there}-", "If-Range": f'"sha256:{part.suffixes[-2][1:]}"'}
        try:
            async with wire.link.stream(wire.request(replace(call, headers=headers))) as response:
                if response.is_success:
                    part = await _save(wire, response, path, on_progress)
                    break
                if part is not None and response.status_code == BEYOND_THE_END:
                    part.unlink()
                    continue
                wait_s = attempts.after_answer(response)
                if wait_s is None:
                    raise_for_problem(response)
        except httpx2.RequestError as error:
            if sum(part.stat().st_size for part in _parts(path)) > n_there:
                attempts = wire.attempts(call)
            wait_s = attempts.after_failure(error)
        await wire.link.sleep(wait_s or 0.0)
    return await wire.link.aside(lambda: _finish(call, part, path))


async def _save(wire: Wire, response: httpx2.Response, path: Path, on_progress: OnBytes) -> Path:
    """Add an answer's content to the part file that it belongs to, whose path is returned."""
    etag = _ETAG.search(response.headers.get("etag", ""))
    if etag is None:
        raise UnexpectedAnswerError(f"{response.request.url} does not name the sha256 of the file: is this a map?")
    part, n_there = path.with_name(f"{path.name}.{etag[1]}.part"), 0
    if response.status_code == PART:
        stretch = _CONTENT_RANGE.fullmatch(response.headers.get("content-range", ""))
        if stretch is None or not part.is_file():
            raise UnexpectedAnswerError(f"{response.request.url} answered another part than was asked for")
        n_there = int(stretch[1])
    else:
        for earlier in _parts(path):
            earlier.unlink()
    length = response.headers.get("content-length", "")
    n_in_all = n_there + int(length) if length.isdecimal() else None
    with part.open("ab") as file:
        file.truncate(n_there)
        async for piece in wire.link.pieces(response):
            file.write(piece)
            n_there += len(piece)
            on_progress(n_there, n_in_all)
        file.flush()
        os.fsync(file.fileno())
    return part


def _finish(call: Call, part: Path, path: Path) -> MapFile:
    """Check the digest of a complete part file and rename it to `path`; raises DamagedDownloadError."""
    with part.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 != part.suffixes[-2][1:]:
        part.unlink()
        raise DamagedDownloadError(
            f"{call} was damaged on its way: it has sha256 {sha256}, and should have {part.suffixes[-2][1:]}; "
            "nothing was kept, try again"
        )
    part.replace(path)
    return MapFile(path, sha256, path.stat().st_size)


def _parts(path: Path) -> list[Path]:
    """The part files that earlier tries of `path` have left."""
    name = re.compile(re.escape(path.name) + r"\.[0-9a-f]{64}\.part")
    return [part for part in path.parent.iterdir() if name.fullmatch(part.name)]
