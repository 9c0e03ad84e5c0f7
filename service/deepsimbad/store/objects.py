"""Objects that several machines share, in S3, GCS, Azure or a folder, and the errors of a store that fails."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Self

from deepsimbad.errors import DeepSimbadError, MissingPackageError, SettingsError, UnavailableError
from deepsimbad.store.durable import sync

if TYPE_CHECKING:
    from obstore.store import ObjectStore

# Somebody waits for the answer, and the library itself would go on trying for three minutes.
_RETRIES = {"max_retries": 2, "retry_timeout": timedelta(seconds=10)}
_CLIENT = {
    "connect_timeout": timedelta(seconds=5),
    "read_timeout": timedelta(seconds=20),
    "timeout": timedelta(minutes=10),  # of a whole download
    "allow_http": True,  # where an endpoint's URL says so
}
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True)
class Entry:
    """An object as it is listed."""

    name: str
    n_bytes: int
    modified_s: float  # Unix time

    def is_copied(self, path: Path) -> bool:
        """Whether a file is its copy, as far as size and time tell."""
        try:
            status = path.stat()
        except OSError:
            return False
        return status.st_size == self.n_bytes and abs(status.st_mtime - self.modified_s) < 1


class Objects:
    """Named bytes in one place that many machines reach; usable from any thread.

    Every write is seen whole or not at all. Every method raises UnavailableError (`hints["reason"]`: `refused` where
    the credentials are, `no_bucket`, else `unreachable`), beside what it names itself.
    """

    def __init__(self, url: str, store: "ObjectStore") -> None:
        self.url = url
        self._store = store

    @classmethod
    def open(cls, url: str) -> Self:
        """The objects below a URL, as `s3://bucket/prefix`, `gs://`, `az://` or `file:///folder`, which is made.

        Credentials, regions and endpoints are the library's own variables of the environment (`AWS_...`); nothing is
        asked of the network yet.

        Raises:
            MissingPackageError: The library is not installed.
            SettingsError: It is no such URL, or what stands in the environment contradicts itself.
        """
        try:
            from obstore.exceptions import BaseError  # noqa: PLC0415 - an extra
            from obstore.store import from_url  # noqa: PLC0415
        except ImportError as error:
            raise MissingPackageError(
                "a map store needs a package that is not installed: pip install 'deep-simbad[objects]'",
                package="obstore",
            ) from error
        try:
            if url.startswith("file:"):
                return cls(url, from_url(url, mkdir=True))
            return cls(url, from_url(url, retry_config=_RETRIES, client_options=_CLIENT))  # type: ignore[call-overload]
        except (BaseError, OSError, TypeError, ValueError) as error:
            raise SettingsError(f"{url} cannot be a map store: {_first_line(error)}", setting="map_store") from error

    def create(self, name: str, content: bytes) -> bool:
        """Write an object unless there is one of that name; whether it was written. Of many at once one succeeds."""
        from obstore.exceptions import AlreadyExistsError  # noqa: PLC0415

        try:
            with self._faults(name):
                self._store.put(name, content, mode="create")
        except AlreadyExistsError:
            return False
        self._sync(name)
        return True

    def put(self, name: str, content: bytes | Path) -> None:
        """Write an object, of bytes or of a file, in the place of any that there is."""
        with self._faults(name):
            self._store.put(name, content)
        self._sync(name)

    def get(self, name: str) -> bytes | None:
        """An object whole; None: there is none."""
        try:
            with self._faults(name):
                return self._store.get(name).bytes().to_bytes()
        except FileNotFoundError:
            return None

    def stream(self, name: str) -> Iterator[bytes]:
        """An object in pieces, which may break off with an error; raises FileNotFoundError where there is none."""
        with self._faults(name):
            for piece in self._store.get(name).stream(_PIECE_BYTES):
                yield bytes(piece)

    def size(self, name: str) -> int | None:
        """The bytes of an object; None: there is none."""
        try:
            with self._faults(name):
                return self._store.head(name)["size"]
        except FileNotFoundError:
            return None

    def names(self, prefix: str, previous_name: str | None = None) -> Iterator[str]:
        """The names below a prefix (ending in `/`) that follow `previous_name`: a thousand a request, unordered."""
        return (entry.name for entry in self.entries(prefix, previous_name))

    def entries(self, prefix: str, previous_name: str | None = None) -> "Iterator[Entry]":
        """As `names`, with each object's size and time."""
        with self._faults(prefix):
            for page in self._store.list(prefix, offset=previous_name, chunk_size=1000):
                for attributes in page:
                    yield Entry(attributes["path"], attributes["size"], attributes["last_modified"].timestamp())

    def copy(self, name: str, target: Path) -> None:
        """Copy an object into a file of the same time, which is there whole or not at all; raises FileNotFoundError."""
        part = target.with_name(f".{target.name}.{os.getpid()}.part")
        with self._faults(name):
            download = self._store.get(name)
            part.write_bytes(download.bytes().to_bytes())
            modified_s = download.meta["last_modified"].timestamp()
        os.utime(part, (modified_s, modified_s))
        part.replace(target)

    def delete(self, name: str) -> None:
        """Remove an object, if there is one."""
        with suppress(FileNotFoundError), self._faults(name):
            self._store.delete(name)

    @contextmanager
    def _faults(self, name: str) -> Iterator[None]:
        """Name what the library raises; FileNotFoundError and AlreadyExistsError go on, as answers."""
        from obstore.exceptions import AlreadyExistsError, BaseError, PermissionDeniedError, UnauthenticatedError  # noqa: PLC0415

        try:
            yield
        except (AlreadyExistsError, DeepSimbadError):
            raise
        except (BaseError, OSError, NotImplementedError) as error:
            message = str(error)  # what lists and missing buckets answer has no class of its own
            if isinstance(error, (PermissionDeniedError, UnauthenticatedError)) or "403 Forbidden" in message:
                raise self._unavailable(name, "refused", "it refuses the credentials") from error
            if "NoSuchBucket" in message:
                raise self._unavailable(name, "no_bucket", "it has no such bucket") from error
            if isinstance(error, FileNotFoundError):
                raise
            raise self._unavailable(name, "unreachable", _first_line(error)) from error

    def _unavailable(self, name: str, reason: str, detail: str) -> UnavailableError:
        return UnavailableError(f"the map store {self.url} cannot be used: {detail}", reason=reason, object=name)

    def _sync(self, name: str) -> None:
        """Wait for the disk where the store is a folder, which the library does not."""
        folder = getattr(self._store, "prefix", None)
        if self.url.startswith("file:") and folder is not None:
            for path in (Path(folder) / name, (Path(folder) / name).parent):
                sync(path)


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0] or type(error).__name__
