"""A catalog that several machines share: what is published to a map store, and what is followed of its log.

Every such catalog is a copy of the log as far as it was read, and changes shared domains by reading it alone.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from sqlite_utils import Database

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    DomainDiffersError,
    LostActivationError,
    NotFoundError,
    UnavailableError,
)
from deepsimbad.store import layout
from deepsimbad.store.backup import Inspection
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY, AnyVersion
from deepsimbad.store.connection import look_at, open_database
from deepsimbad.store.durable import empty_graves, storage_faults, sync
from deepsimbad.store.map_store import MapCache, MapStore
from deepsimbad.store.records import DomainRecord, MapRecord, MapState, current_moment, from_json, read_domains, to_json

T = TypeVar("T")
_State: TypeAlias = dict[str, Any] | None
_LEAST_BETWEEN_STATES = 256  # entries of the log; with many domains an eighth of their number
_ADMINISTRATOR = "administrator"  # among a domain's options


def open_catalog(
    data_dir: Path, map_store: str | None = None, cache_bytes: int | None = None, administrator: int | None = None
) -> Catalog:
    """The catalog of a data directory, as `Catalog.open`; a shared one where it follows a map store, once and for all.

    Args:
        map_store: URL of the store; None: the one that the data directory follows already, if any.
        cache_bytes: Most bytes of map files in the data directory that the store has too; None: any number.
        administrator: Which of several that administer has the data directory, noted there; None: what it notes.

    Raises:
        MissingPackageError, SettingsError: As `Objects.open`.
        ConflictError: The data directory follows another store.
        UnavailableError: A store that it does not follow yet cannot be reached.
    """
    followed_url = followed_store(data_dir)
    if map_store is None and followed_url is None:
        return Catalog.open(data_dir)
    store = MapStore.open(map_store or str(followed_url))
    catalog = SharedCatalog.open(data_dir)
    try:
        catalog.begin_to_follow(store, cache_bytes, administrator, is_new=store.url != followed_url)
    except BaseException:
        catalog.close()
        raise
    return catalog


def followed_store(data_dir: Path) -> str | None:
    """The URL of the map store that a data directory follows, if any; raises DamagedFileError."""
    path = layout.catalog_path(data_dir)

    def read_url(db: Database) -> str | None:
        rows = db.execute("SELECT url FROM map_store").fetchall() if "map_store" in db.table_names() else []
        return rows[0][0] if rows else None

    if not path.exists():
        return None
    with storage_faults(path):
        return look_at(path, read_url)


def inspect_objects(data_dir: Path, on_progress: Callable[[float], None]) -> Inspection:
    """Read the objects of all maps of a data directory that its store has; raises as `open_catalog`, NotFoundError."""
    url, path = followed_store(data_dir), layout.catalog_path(data_dir)
    if url is None:
        raise NotFoundError(f"{data_dir} follows no map store: there are no objects to check")
    query = "SELECT DISTINCT sha256 FROM map WHERE shared AND removed_at IS NULL ORDER BY sha256"
    with storage_faults(path):
        digests = [digest for (digest,) in look_at(path, lambda db: db.execute(query).fetchall())]
    return Inspection(len(digests), tuple(MapStore.open(url).inspect(digests, on_progress)))


class SharedCatalog(Catalog):
    """A catalog that publishes what is changed through it, and follows what others publish.

    A change is tried in a transaction that is undone, which tells what the domain would be; the map's object is made
    durable, then the log's next entry is written, then it is read as by everybody else. A crash between two of these
    leaves an object that nothing names, or an entry that the next look reads. Changes raise UnavailableError as
    `MapStore` does, beside what `Catalog` names.
    """

    store: MapStore
    _cache: MapCache
    is_shared = True
    administrator: int = 0
    """Which of several that administer has the data directory; it is kept with the domains that are made here."""

    def __init__(self, data_dir: Path, db: Database) -> None:
        super().__init__(data_dir, db)
        self._transaction: Database | None = None
        self._is_trying = False

    def begin_to_follow(
        self, store: MapStore, cache_bytes: int | None, administrator: int | None, *, is_new: bool
    ) -> None:
        """Take up a store; raises as `open_catalog`."""
        files = partial(layout.domains_folder(self.data_dir).glob, "*/maps/*.sqlite")
        self.store, self._cache = store, MapCache(store, files, self._may_go, cache_bytes)
        if is_new:
            self._note_store(store)
        with self._reading() as db:
            self.administrator = int(db.execute("SELECT administrator FROM map_store").fetchone()[0])
        if administrator not in {None, self.administrator}:  # nothing is written at most starts: the disk may be full
            with self._writing() as db:
                db.execute("UPDATE map_store SET administrator = ?", [administrator])
            self.administrator = administrator

    def _note_store(self, store: MapStore) -> None:
        store_id = store.store_id()
        with self._writing() as db:
            for url, followed_id in db.execute("SELECT url, store_id FROM map_store").fetchall():
                if followed_id != store_id:
                    raise ConflictError(
                        f"{self.data_dir} follows the map store {url}: export its maps and import them into a new data "
                        f"directory to publish them to {store.url}",
                        map_store=url,
                    )
            insert = "INSERT OR IGNORE INTO map_store (id, url, store_id, position) VALUES (1, ?, ?, 0)"
            db.execute(insert, [store.url, store_id])
            db.execute("UPDATE map_store SET url = ?", [store.url])

    # Following

    def follow(self) -> list[str]:
        """As `Catalog.follow`, by reading on in the log.

        Raises:
            DomainDiffersError: A domain that was published has the name of another that was made here.
            DamagedFileError, UnavailableError: As `MapStore`.
        """
        changed_domains = self._begin_with_state() if self._position() == 0 else []
        for number, entry in self.store.entries(self._position()):
            changed_domains += self._apply(number, entry)
        return changed_domains

    def _position(self) -> int:
        with self._reading() as db:
            return int(db.execute("SELECT position FROM map_store").fetchone()[0])

    def _begin_with_state(self) -> list[str]:
        state = self.store.state()
        if state is None:
            return []
        with self._writing() as db:
            for name, domain_state in state["domains"].items():
                self._take_over(db, name, domain_state)
            db.execute("UPDATE map_store SET position = ?", [state["position"]])
        sync(layout.domains_folder(self.data_dir))
        return list(state["domains"])

    def _apply(self, position: int, entry: Mapping[str, Any]) -> list[str]:
        with self._writing() as db:
            if db.execute("SELECT position FROM map_store").fetchone()[0] != position - 1:
                return []  # another process was faster
            try:
                name = str(entry["domain"])
                if entry["state"] is None:
                    db.execute("DELETE FROM domain WHERE name = ?", [name])
                    db.execute("INSERT OR IGNORE INTO doomed_folder VALUES (?)", [name])
                else:
                    self._take_over(db, name, entry["state"])
            except (KeyError, TypeError) as error:  # as of a newer release on another machine
                raise DamagedFileError(
                    f"entry {position} of the map store's log is not of this release, which cannot go on: {error}"
                ) from error
            db.execute("UPDATE map_store SET position = ?", [position])
        with self._writing() as db:
            self._finish_deletion(db, name)
        empty_graves(layout.domains_folder(self.data_dir))
        return [name]

    def _take_over(self, db: Database, name: str, state: Mapping[str, Any]) -> None:
        """Let a domain be what the log says; raises DomainDiffersError where another of its name was made here."""
        configuration = {key: state[key] for key in ("evaluator", "closed", "actions_m")}
        for record in read_domains(db, name):
            if to_json(record.configuration) != to_json(configuration):
                raise DomainDiffersError(
                    f"domain {name} of {self.data_dir} has another configuration than that of the map store: delete "
                    "one of the two first",
                    present=record.configuration,
                )
        self._finish_deletion(db, name)
        db.execute(
            """
            INSERT INTO domain (name, evaluator, closed, actions_m, created_at, options, shared)
            VALUES (?, ?, ?, ?, ?, ?, 1)
            ON CONFLICT (name) DO UPDATE SET created_at = excluded.created_at, options = excluded.options, shared = 1
            """,
            [
                name,
                to_json(state["evaluator"]),
                int(state["closed"]),
                to_json(state["actions_m"]),
                state["created_at"],
                to_json(state["options"]),
            ],
        )
        layout.traverses_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
        layout.maps_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
        for earlier_map in state.get("earlier_maps", ()):  # sessions may live on them, and be rolled back to
            self._take_over_map(db, name, **earlier_map)
            db.execute(
                """
                UPDATE map SET state = 'retired', retired_at = ?
                WHERE domain = ? AND version = ? AND state = 'sealed'
                """,
                [current_moment(), name, earlier_map["version"]],
            )
        if state["map"] is not None:
            self._take_over_map(db, name, **state["map"])
            super().activate(name, state["map"]["version"], ANY)

    def _take_over_map(
        self,
        db: Database,
        name: str,
        version: int,
        created_at: str,
        sha256: str,
        file_bytes: int,
        config: Mapping[str, Any],
        metrics: Mapping[str, Any],
    ) -> None:
        """Note a version of the store's; one of the same number that was made here meanwhile is renumbered."""
        key = [name, version]
        own_row = db.execute("SELECT sha256, state FROM map WHERE domain = ? AND version = ?", key).fetchone()
        db.execute("UPDATE domain SET next_version = max(next_version, ?) WHERE name = ?", [version + 1, name])
        if own_row is not None and own_row[0] != sha256 and own_row[1] == MapState.BUILDING:
            db.execute("DELETE FROM map WHERE domain = ? AND version = ?", key)  # who builds it is told at the end
        elif own_row is not None and own_row[0] != sha256:
            (free_version,) = db.execute("SELECT next_version FROM domain WHERE name = ?", [name]).fetchone()
            moved_path = self.map_path(name, free_version)
            moved_path.unlink(missing_ok=True)
            with suppress(FileNotFoundError):  # damaged before: what it was called makes no difference
                os.link(self.map_path(name, version), moved_path)
            state = MapState.RETIRED if own_row[1] == MapState.ACTIVE else own_row[1]
            db.execute(
                "UPDATE map SET version = ?, state = ? WHERE domain = ? AND version = ?", [free_version, state, *key]
            )
            db.execute("UPDATE domain SET next_version = ? WHERE name = ?", [free_version + 1, name])
        db.execute(
            """
            INSERT INTO map (domain, version, state, created_at, sha256, file_bytes, config, metrics, shared)
            VALUES (?, ?, 'sealed', ?, ?, ?, ?, ?, 1)
            ON CONFLICT (domain, version) DO UPDATE SET shared = 1, removed_at = NULL
            """,
            [name, version, created_at, sha256, file_bytes, to_json(config), to_json(metrics)],
        )

    def map_anywhere(self, domain: str, version: int) -> MapRecord:
        """As `map`; for one that is unknown here the log is read."""
        try:
            return self.map(domain, version)
        except NotFoundError:
            self.follow()
            return self.map(domain, version)

    # Publishing

    def catch_up(self) -> None:
        """Follow, then publish the domains that the store does not know: made before it was followed, or cut short."""
        self.follow()
        with self._reading() as db:
            names = [name for (name,) in db.execute("SELECT name FROM domain WHERE shared = 0 ORDER BY name")]
        for name in names:
            self._publish(name, partial(self._keep_administrator, name))

    def create_domain(
        self,
        name: str,
        evaluator: dict[str, Any],
        closed: bool,
        actions_m: Sequence[float],
        max_domains: int | None = None,
    ) -> tuple[DomainRecord, bool]:
        """As `Catalog.create_domain`."""
        create = super().create_domain

        def change() -> bool:
            _, is_new = create(name, evaluator, closed, actions_m, max_domains)
            if is_new:
                self._keep_administrator(name)
            return is_new

        is_new = self._publish(name, change)
        return self.domain(name), is_new

    def _keep_administrator(self, name: str) -> None:
        """Within a change: note with a domain which administrator made it, unless that is the first."""
        if self.administrator > 0:
            super().set_options(name, {_ADMINISTRATOR: self.administrator})

    def administrator_of(self, name: str) -> int:
        """Which of several that administer has made a domain; raises UnknownDomainError."""
        return int(self.domain(name).options.get(_ADMINISTRATOR, 0))

    def set_options(self, name: str, options: Mapping[str, Any]) -> DomainRecord:
        """As `Catalog.set_options`."""
        change = super().set_options
        self._publish(name, lambda: change(name, options))
        return self.domain(name)

    def delete_domain(self, name: str, *, only_empty: bool = False) -> None:
        """As `Catalog.delete_domain`, on every node."""
        delete = super().delete_domain
        with self._reading() as db:
            is_shared = _is_shared_domain(db, name)
        if is_shared:
            self._publish(name, lambda: delete(name, only_empty=only_empty))
        else:
            delete(name, only_empty=only_empty)

    def activate(self, domain: str, version: int, expected: int | AnyVersion | None) -> MapRecord:
        """As `Catalog.activate`, on every node; LostActivationError too where another published the number first."""
        swap, digest = super().activate, self.map_anywhere(domain, version).sha256

        def change() -> None:
            if swap(domain, version, expected).sha256 != digest:
                raise LostActivationError(
                    f"another node made a map {version} of domain {domain} meanwhile: what was map {version} here has "
                    "another number now",
                    active=version,
                    expected=None if expected is ANY else expected,
                )

        self._publish(domain, change)
        return self.map(domain, version)

    def _publish(self, name: str, change: Callable[[], T]) -> T:
        """Make a change of a domain on every node, unless nothing changes; answers what `change` did when tried."""
        while True:
            self.follow()
            old_state, new_state, position, answer = self._try_change(name, change)
            if old_state == new_state:
                return answer
            if (
                new_state is not None
                and new_state["map"] is not None
                and (old_state is None or old_state["map"] != new_state["map"])
            ):
                map_ = new_state["map"]
                self.store.put_map(self.map_path(name, map_["version"]), map_["sha256"], map_["file_bytes"])
            entry = {"domain": name, "state": new_state, "at": current_moment()}
            if self.store.append(position + 1, entry):
                break
        self._apply(position + 1, entry)
        with suppress(UnavailableError):  # the change is published; the log holds all that the state would
            self._write_state(position + 1)
        return answer

    def _try_change(self, name: str, change: Callable[[], T]) -> tuple[_State, _State, int, T]:
        """A domain's state in the log and after a change, the log's last number, what `change` answered; all undone."""
        with suppress(_UndoneError), self._writing() as db:
            old_state = _state_of(db, name) if _is_shared_domain(db, name) else None
            position = int(db.execute("SELECT position FROM map_store").fetchone()[0])
            self._is_trying = True
            try:
                answer = change()
            finally:
                self._is_trying = False
            outcome = old_state, _state_of(db, name), position, answer
            raise _UndoneError
        return outcome

    @contextmanager
    def _writing(self) -> Iterator[Database]:
        """One transaction; what is written inside another one belongs to that."""
        with self._lock:
            if self._transaction is not None:
                yield self._transaction
                return
            with super()._writing() as db:
                self._transaction = db
                try:
                    yield db
                finally:
                    self._transaction = None

    def _finish_deletion(self, db: Database, name: str) -> None:
        if not self._is_trying:  # a folder that was buried would not come back
            super()._finish_deletion(db, name)

    def _write_state(self, position: int) -> None:
        """Write all domains as one object now and then, so that it costs little an entry."""
        path, interval = layout.catalog_path(self.data_dir), _LEAST_BETWEEN_STATES
        with open_database(path, read_only=True) as db, db.atomic():  # robots' answers need the other connections
            names = [name for (name,) in db.execute("SELECT name FROM domain WHERE shared")]
            while interval < len(names) // 8:
                interval *= 2
            if position % interval:
                return
            (position,) = db.execute("SELECT position FROM map_store").fetchone()
            states = {
                name: {**(_state_of(db, name) or {}), "earlier_maps": _maps(db, name, "retired")} for name in names
            }
            state = {"position": position, "domains": states}
        self.store.put_state(state)

    # Files

    def map_file(self, domain: str, version: int) -> Path:
        """As `Catalog.map_file`; a shared map that is missing or damaged here is fetched, once however many ask."""
        record, path = self.map(domain, version), self.map_path(domain, version)
        with self._cache.fetch_lock(path):
            try:
                super().map_file(domain, version)
            except DamagedMapError:
                if record.sha256 is None or not self._is_shared(domain, version):
                    raise
                self._cache.fetch(path, record.sha256, record.file_bytes or 0)
        return path

    def has_file(self, domain: str, version: int) -> bool:
        """As `Catalog.has_file`, here or in the store."""
        return super().has_file(domain, version) or self._is_shared(domain, version)

    def _is_shared(self, domain: str, version: int) -> bool:
        with self._reading() as db:
            rows = db.execute(
                "SELECT 1 FROM map WHERE domain = ? AND version = ? AND shared AND removed_at IS NULL",
                [domain, version],
            )
            return rows.fetchone() is not None

    def _may_go(self, path: Path) -> bool:
        """Whether a map's file can be fetched again and is not in use."""
        domain, version = path.parent.parent.name, int(path.stem)
        if not self._is_shared(domain, version):
            return False
        return not self.is_in_use(domain, version, self.map(domain, version).sha256 or "")


class _UndoneError(Exception):
    """Ends a transaction that was only tried."""


def _is_shared_domain(db: Database, name: str) -> bool:
    return db.execute("SELECT 1 FROM domain WHERE name = ? AND shared", [name]).fetchone() is not None


def _state_of(db: Database, name: str) -> _State:
    """A domain as the log holds it; None where there is none."""
    for record in read_domains(db, name):
        return {
            **record.configuration,
            "options": record.options,
            "created_at": record.created_at,
            "map": next(iter(_maps(db, name, "active")), None),
        }
    return None


def _maps(db: Database, name: str, state: str) -> list[dict[str, Any]]:
    """A domain's versions in a state as the log holds them: the active one, or shared ones that have their files."""
    rows = db.query(
        """
        SELECT version, created_at, sha256, file_bytes, config, metrics FROM map
        WHERE domain = ? AND state = ? AND removed_at IS NULL AND (shared OR state = 'active') ORDER BY version
        """,
        [name, state],
    )
    return [{**row, "config": from_json(row["config"]), "metrics": from_json(row["metrics"])} for row in rows]
