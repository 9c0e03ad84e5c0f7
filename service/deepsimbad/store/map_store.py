"""What machines share of their maps, as objects: sealed files, and a log of what every domain is.

A store holds three kinds of objects. `maps/<sha256>.sqlite` are sealed maps, which never change. `log/<number>.json`
are numbered from 0 without gaps, and each holds what a domain is from there on, whole: its configuration and the map
that serves, or nothing of one that was deleted. To write the next number, which of many at once only one can, is the
one conditional write of an activation: every kind of store has it, where a folder cannot replace by ETag. The first
entry names the store. `state.json.gz` is all domains as of some entry, so that a new node need not read the log from
its beginning. Nothing is ever removed. `MapCache` keeps files of the maps on this machine.
"""

import gzip
import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self
from uuid import uuid4

from deepsimbad.errors import DamagedFileError, DamagedMapError, UnavailableError
from deepsimbad.store.backup import Finding
from deepsimbad.store.durable import verify
from deepsimbad.store.map_file import fetch
from deepsimbad.store.objects import Objects
from deepsimbad.store.records import to_json

_STATE = "state.json.gz"
_MOST_AT_ONCE = 32  # entries that are asked for together
_N_LOCKS = 16  # so many that two files which are fetched at once seldom share one


class MapStore:
    """Sealed maps and the log; usable from any thread.

    Every method raises UnavailableError as `Objects` does, and DamagedFileError where an object of the log cannot be
    read, beside what it names itself.
    """

    def __init__(self, objects: Objects) -> None:
        self.url = objects.url
        self._objects = objects

    @classmethod
    def open(cls, url: str) -> Self:
        """The map store at a URL; raises as `Objects.open`."""
        return cls(Objects.open(url))

    # The log

    def store_id(self) -> str:
        """The id of the store, which its log's first entry holds; that entry is written where there is none."""
        name = _entry_name(0)
        if (entry := self._objects.get(name)) is None:
            self._objects.create(name, to_json({"store_id": uuid4().hex}).encode())
            entry = self._objects.get(name) or b"{}"
        return str(_parse(entry, name).get("store_id"))

    def entries(self, position: int) -> Iterator[tuple[int, dict[str, Any]]]:
        """(number, entry) of the log's entries behind number `position`; one request where there is none yet.

        Raises UnavailableError: the entry at `position` is gone, and the log with it.
        """
        n_at_once = 1
        while True:
            names = [_entry_name(position + 1 + number) for number in range(n_at_once)]
            for name, content in zip(names, self._read(names), strict=True):
                if content is None:
                    self._check_is_there(position)
                    return
                position += 1
                yield position, _parse(content, name)
            n_at_once = min(2 * n_at_once, _MOST_AT_ONCE)

    def _read(self, names: Sequence[str]) -> list[bytes | None]:
        if len(names) == 1:
            return [self._objects.get(names[0])]
        with ThreadPoolExecutor(len(names)) as readers:
            return list(readers.map(self._objects.get, names))

    def _check_is_there(self, number: int) -> None:
        if self._objects.size(_entry_name(number)) is None:
            raise UnavailableError(
                f"the map store {self.url} has lost its log: entry {number}, which was read before, is gone",
                reason="lost_log",
            )

    def append(self, number: int, entry: Mapping[str, Any]) -> bool:
        """Write the log's next entry; False where another has written one of that number."""
        return self._objects.create(_entry_name(number), to_json(entry).encode())

    def state(self) -> dict[str, Any] | None:
        """All domains as of an entry, `{"position", "domains": {name: ...}}`; None: the log is short."""
        content = self._objects.get(_STATE)
        return None if content is None else _parse(content, _STATE)

    def put_state(self, state: Mapping[str, Any]) -> None:
        """Write what `state` reads; where two do so at once either may remain."""
        self._objects.put(_STATE, gzip.compress(to_json(state).encode()))

    # Maps

    def put_map(self, path: Path, sha256: str, n_bytes: int) -> None:
        """Make a sealed file an object, unless it is one.

        Raises DamagedMapError: the file is missing, or not the one that was sealed.
        """
        if self._objects.size(_map_name(sha256)) != n_bytes:
            verify(path, sha256)
            self._objects.put(_map_name(sha256), path)

    def map_pieces(self, sha256: str) -> Iterator[bytes]:
        """A sealed file in pieces, to be checked by who puts them together; raises DamagedMapError: there is none."""
        try:
            yield from self._objects.stream(_map_name(sha256))
        except FileNotFoundError as error:
            self._check_is_there(0)  # else all is gone, and no map damaged
            raise DamagedMapError(f"the map store {self.url} has no {_map_name(sha256)}", sha256=sha256) from error

    def inspect(self, digests: Sequence[str], on_progress: Callable[[float], None]) -> list[Finding]:
        """Read the objects of maps whole; answers what is wrong with them."""
        findings = []
        for n_read, sha256 in enumerate(digests, start=1):
            digest = hashlib.sha256()
            try:
                for piece in self.map_pieces(sha256):
                    digest.update(piece)
            except DamagedMapError:
                problem = "is missing"
            else:
                problem = "" if digest.hexdigest() == sha256 else "is another file: its SHA-256 differs"
            if problem:
                findings.append(Finding(f"{self.url}/{_map_name(sha256)}", problem))
            on_progress(n_read / len(digests))
        return findings


class MapCache:
    """Files of a store's maps that lie here too, `most_bytes` of them (None: any number); the least recent go first.

    `files` lists the files of maps here, the store's and others; `may_go` says whether one can be fetched again and is
    not in use. Usable from any thread.
    """

    def __init__(
        self,
        store: MapStore,
        files: Callable[[], Iterable[Path]],
        may_go: Callable[[Path], bool],
        most_bytes: int | None,
    ) -> None:
        self._store, self._files, self._may_go, self._most_bytes = store, files, may_go, most_bytes
        self._fetch_locks = tuple(threading.Lock() for _ in range(_N_LOCKS))
        self._room_lock, self._n_fetching_bytes = threading.Lock(), 0

    @contextmanager
    def fetch_lock(self, path: Path) -> Iterator[None]:
        """Let one thread at a time look for a file, so that it is fetched once."""
        with self._fetch_locks[hash(path) % _N_LOCKS]:
            yield
            with suppress(OSError):  # a disk that may only be read
                os.utime(path)

    def fetch(self, path: Path, sha256: str, n_bytes: int) -> None:
        """Bring a map here; raises DamagedMapError, and UnavailableError too where there is no room."""
        with self._room_lock:
            if self._most_bytes is not None:
                self._make_room(self._n_fetching_bytes + n_bytes, self._most_bytes)
            self._n_fetching_bytes += n_bytes  # until they are a file there
        try:
            fetch(self._store.map_pieces(sha256), path, sha256)
        finally:
            with self._room_lock:
                self._n_fetching_bytes -= n_bytes

    def _make_room(self, n_bytes: int, most_bytes: int) -> None:
        files = []
        for path in self._files():
            with suppress(FileNotFoundError):
                files.append((path.stat().st_mtime_ns, path.stat().st_size, path))
        excess = sum(size for _, size, _ in files) + n_bytes - most_bytes
        for _, size, path in sorted(files):
            if excess <= 0:
                return
            if self._may_go(path):
                path.unlink(missing_ok=True)
                excess -= size
        if excess > 0:
            raise UnavailableError(
                f"{n_bytes} bytes of maps have no room beside the files that are in use: raise map_cache_disk_bytes, "
                f"which is {most_bytes}",
                reason="cache_full",
                map_cache_disk_bytes=most_bytes,
            )


def _map_name(sha256: str) -> str:
    return f"maps/{sha256}.sqlite"


def _entry_name(number: int) -> str:
    return f"log/{number:012d}.json"


def _parse(content: bytes, name: str) -> dict[str, Any]:
    try:
        return dict(json.loads(gzip.decompress(content) if name.endswith(".gz") else content))
    except (ValueError, TypeError, EOFError, OSError) as error:
        raise DamagedFileError(f"object {name} of the map store is damaged: {error}", file=name) from error
