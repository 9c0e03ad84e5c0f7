"""One tar file of named members, of which every byte is accounted for.

The last member of an archive holds the SHA-256 of everything before it, and the one before that, the manifest, the
SHA-256 of every other member. Any tar program can unpack it.
"""

import hashlib
import io
import json
import tarfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from deepsimbad.errors import InvalidArchiveError

MANIFEST = "manifest.json"
_SEAL = "archive.sha256"
_SEAL_BYTES = 2 * tarfile.BLOCKSIZE + 2 * tarfile.BLOCKSIZE  # header, digest, and two empty blocks that end a tar file
_CHUNK_BYTES = 1024 * 1024


@dataclass(frozen=True)
class Member:
    """One file of an archive: its name there, its size and its SHA-256 in hex."""

    name: str
    bytes: int
    sha256: str


class ArchiveWriter:
    """Writes an archive into an open file, from its beginning.

    Args:
        stream: An empty file open for writing.
        on_bytes: Called with the number of bytes of every piece; what it raises (a cancel) ends the writing.
    """

    def __init__(self, stream: IO[bytes], on_bytes: Callable[[int], None] = lambda _: None) -> None:
        self._stream = stream
        self._on_bytes = on_bytes
        self._digest = hashlib.sha256()
        self.members: list[Member] = []

    def add(self, name: str, source: Path) -> Member:
        """Copy a file that does not change; raises OSError."""
        with source.open("rb") as stream:
            n_bytes = source.stat().st_size
            self._write(_header(name, n_bytes))
            digest = hashlib.sha256()
            left = n_bytes
            while left:
                piece = stream.read(min(_CHUNK_BYTES, left))
                if not piece:
                    raise OSError(f"{source.name} became shorter while it was read")
                digest.update(piece)
                self._write(piece)
                self._on_bytes(len(piece))
                left -= len(piece)
        self._write(_padding(n_bytes))
        member = Member(name, n_bytes, digest.hexdigest())
        self.members.append(member)
        return member

    def mark(self) -> tuple[int, int, Any]:
        """A place to which `rewind` can go back."""
        return self._stream.tell(), len(self.members), self._digest.copy()

    def rewind(self, mark: tuple[int, int, Any]) -> None:
        """Forget what was added since."""
        offset, n_members, digest = mark
        self._stream.seek(offset)
        self._stream.truncate()
        del self.members[n_members:]
        self._digest = digest.copy()

    def finish(self, about: dict[str, Any]) -> str:
        """Write the manifest, which holds `about` as well, and seal the archive; returns the SHA-256 of all of it."""
        manifest = json.dumps({**about, "files": [asdict(member) for member in self.members]}, indent=1).encode()
        self._write(_header(MANIFEST, len(manifest)) + manifest + _padding(len(manifest)))
        self._write(_seal(self._digest.hexdigest()))
        return self._digest.hexdigest()

    def _write(self, piece: bytes) -> None:
        self._digest.update(piece)
        self._stream.write(piece)


class ArchiveReader:
    """Reads an archive that has been verified as a whole.

    Args:
        path: The file.
        stream: The same, open.
        is_known: Whether a member of that name may be there; every other is refused.
        on_bytes: Called with the number of bytes of every piece read.

    Raises:
        InvalidArchiveError: It is not an archive, or not one that was finished, or was changed since.
    """

    def __init__(
        self,
        path: Path,
        stream: IO[bytes],
        is_known: Callable[[str], bool],
        on_bytes: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._path = path
        self._stream = stream
        self._on_bytes = on_bytes
        self._verify()
        self._found = self._headers(is_known)
        self.about: dict[str, Any]
        self.members: tuple[Member, ...]
        self.about, self.members = self._manifest()

    def copy(self, member: Member, target: Path) -> None:
        """Copy a member into a new file and check it.

        Raises:
            InvalidArchiveError: It is not what the manifest says.
            OSError: The file cannot be written.
        """
        digest = hashlib.sha256()
        with target.open("xb") as into:
            for piece in self._pieces(self._found[member.name].offset_data, member.bytes):
                digest.update(piece)
                into.write(piece)
                self._on_bytes(len(piece))
        if digest.hexdigest() != member.sha256:
            raise self._wrong(f"{member.name} does not match its SHA-256")

    def _verify(self) -> None:
        n_bytes = self._stream.seek(0, io.SEEK_END) - _SEAL_BYTES
        if n_bytes <= 0:
            raise self._wrong("it is too short")
        digest = hashlib.sha256()
        for piece in self._pieces(0, n_bytes):
            digest.update(piece)
            self._on_bytes(len(piece))
        self._stream.seek(n_bytes)
        if self._stream.read() != _seal(digest.hexdigest()):
            raise self._wrong("it is no backup, was cut short or was changed: its SHA-256 differs")

    def _headers(self, is_known: Callable[[str], bool]) -> dict[str, tarfile.TarInfo]:
        found: dict[str, tarfile.TarInfo] = {}
        self._stream.seek(0)
        try:
            with tarfile.open(fileobj=self._stream, mode="r:") as tar:
                for info in tar:
                    if info.type != tarfile.REGTYPE or info.sparse is not None:  # no links, devices or folders
                        raise self._wrong(f"{info.name!a} is no plain file")
                    if info.name in found:
                        raise self._wrong(f"{info.name!a} is there twice")
                    if info.name not in {MANIFEST, _SEAL} and not is_known(info.name):
                        raise self._wrong(f"{info.name!a} has no place in it")
                    found[info.name] = info
        except (tarfile.TarError, OSError, ValueError) as error:
            raise self._wrong(f"it cannot be unpacked: {error}") from error
        return found

    def _manifest(self) -> tuple[dict[str, Any], tuple[Member, ...]]:
        try:
            info = self._found[MANIFEST]
            about = json.loads(b"".join(self._pieces(info.offset_data, info.size)))
            members = tuple(Member(str(one["name"]), int(one["bytes"]), str(one["sha256"])) for one in about["files"])
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise self._wrong("it has no manifest that can be read") from error
        sizes = {name: info.size for name, info in self._found.items() if name not in {MANIFEST, _SEAL}}
        if len(members) != len(sizes) or {member.name: member.bytes for member in members} != sizes:
            raise self._wrong("its manifest does not list what is in it")
        return about, members

    def _pieces(self, offset: int, n_bytes: int) -> Iterator[bytes]:
        self._stream.seek(offset)
        while n_bytes:
            piece = self._stream.read(min(_CHUNK_BYTES, n_bytes))
            if not piece:
                raise self._wrong("it was cut short")
            n_bytes -= len(piece)
            yield piece

    def _wrong(self, why: str) -> InvalidArchiveError:
        return InvalidArchiveError(f"{self._path} cannot be restored: {why}", file=str(self._path))


@contextmanager
def opened_archive(
    path: Path, is_known: Callable[[str], bool], on_bytes: Callable[[int], None] = lambda _: None
) -> Iterator[ArchiveReader]:
    """An archive, verified as a whole; raises as ArchiveReader does, and InvalidArchiveError where there is none."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise InvalidArchiveError(f"{path} cannot be read: {error.strerror}", file=str(path)) from error
    with stream:
        yield ArchiveReader(path, stream, is_known, on_bytes)


def _header(name: str, n_bytes: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = n_bytes, 0o600, int(time.time())
    return info.tobuf(tarfile.PAX_FORMAT)


def _padding(n_bytes: int) -> bytes:
    return bytes(-n_bytes % tarfile.BLOCKSIZE)


def _seal(digest: str) -> bytes:
    """The end of an archive, the same for the same digest."""
    info = tarfile.TarInfo(_SEAL)
    info.size, info.mode = len(digest), 0o600
    return (info.tobuf(tarfile.PAX_FORMAT) + digest.encode()).ljust(_SEAL_BYTES, b"\0")
