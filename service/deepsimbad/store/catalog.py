"""The catalog: which domains, map versions, jobs and keys there are, and which version serves."""

import hashlib
import json
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any, Self

from sqlite_utils import Database

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DomainDiffersError,
    InvalidInputError,
    TooManyDomainsError,
    TraverseInUseError,
    UnknownKeyError,
)
from deepsimbad.store import layout
from deepsimbad.store.catalog_jobs import JobCatalog
from deepsimbad.store.catalog_maps import MapCatalog
from deepsimbad.store.connection import open_working_file
from deepsimbad.store.durable import bury, empty_graves, make_data_dir, storage_faults, sync
from deepsimbad.store.records import (
    DomainRecord,
    KeyRecord,
    KeyScope,
    ListPage,
    current_moment,
    from_json,
    get_domain,
    moment_after,
    read_domains,
    to_json,
)
from deepsimbad_migrations.catalog.migrations import migrations

_KEY = re.compile(r"dsk_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
_KEY_ID = re.compile(r"[0-9a-f]{12}")
_MAX_NAME = 100  # of a key
_SELECT_KEY = "SELECT key_id, name, scope, secret_sha256, domains, created_at, expires_at, revoked_at FROM api_key"


@dataclass(frozen=True)
class ApiKey:
    """A key as its holder has it; its id, twelve hexadecimal digits, may be shown and logged, its secret not."""

    key_id: str
    secret: str = field(repr=False)  # 256 random bits in 43 letters

    @classmethod
    def new(cls) -> Self:
        """Make a key that nobody has had before."""
        return cls(secrets.token_hex(6), secrets.token_urlsafe(32))

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """Read a key's text; None where it has not the form of one."""
        match = _KEY.fullmatch(text)
        return None if match is None else cls(*match.groups())

    @property
    def text(self) -> str:
        """The text that its holder sends."""
        return f"dsk_{self.key_id}_{self.secret}"

    @property
    def secret_sha256(self) -> str:
        """What is stored of the secret. It is random, so that a fast digest gives nothing away."""
        return hashlib.sha256(self.secret.encode()).hexdigest()


class Catalog(MapCatalog, JobCatalog):
    """The one file that says what is true of a data directory; usable from any thread and several processes.

    Every change is one transaction: a crash at any moment leaves the state before it or after it. Every method raises
    UnavailableError (`hints["reason"]`: disk_full, read_only, busy, ...) or DamagedFileError where the file cannot be
    used, beside what it names itself.
    """

    is_shared = False  # whether other machines change it too, by a map store

    @classmethod
    def open(cls, data_dir: Path) -> Self:
        """Open the catalog of a data directory; makes both where they are missing."""
        path = layout.catalog_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path):
            domains = layout.domains_folder(data_dir)
            has_domains = domains.is_dir() and any(domains.iterdir())  # looked at before the file, which comes first
            if has_domains and not path.exists():
                raise DamagedFileError(
                    f"{path.name} is missing beside a folder of domains: put a copy of it back, or move that folder",
                    file=path.name,
                )
            db = open_working_file(path, migrations, create=not has_domains)
            sync(data_dir)
            return cls(data_dir, db)

    def follow(self) -> list[str]:
        """Take over what other machines have published, where it is shared; answers which domains changed."""
        return []

    def catch_up(self) -> None:
        """Follow, and publish what other machines do not know, where it is shared."""

    def create_domain(
        self,
        name: str,
        evaluator: dict[str, Any],
        closed: bool,
        actions_m: Sequence[float],
        max_domains: int | None = None,
    ) -> tuple[DomainRecord, bool]:
        """Make a domain, of at most `max_domains`; the same again changes nothing. Returns it and whether it is new.

        Raises:
            InvalidInputError: The name cannot be a name, or a value has no JSON form.
            DomainDiffersError: A domain of that name exists with another configuration.
            TooManyDomainsError: There are `max_domains` already, and it is none of them.
            ConflictError: Files that no domain owns lie where its files would.
        """
        folder = layout.domain_folder(self.data_dir, name)
        moves_m = [float(action) + 0.0 for action in actions_m]  # a zero has no sign
        configuration = to_json({"evaluator": evaluator, "closed": closed, "actions_m": moves_m})
        row = {"evaluator": to_json(evaluator), "closed": int(closed), "actions_m": to_json(moves_m)}
        with self._writing() as db:
            for record in read_domains(db, name):
                if to_json(record.configuration) != configuration:
                    raise DomainDiffersError(
                        f"domain {name} exists with another configuration: delete it first, or choose another name",
                        present=record.configuration,
                    )
                return record, False
            n_domains = db.table("domain").count
            if max_domains is not None and n_domains >= max_domains:
                raise TooManyDomainsError(
                    f"there are {n_domains} domains, as many as may be: delete one, or raise the setting max_domains",
                    max_domains=max_domains,
                )
            self._finish_deletion(db, name)
            if any(path.is_file() for path in folder.rglob("*")):
                raise ConflictError(
                    f"files of an unknown domain lie in {folder.parent.name}/{name}: move them away first"
                )
            db.table("domain").insert({"name": name, **row, "created_at": current_moment()})
            layout.traverses_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
            layout.maps_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
            for directory in (folder, folder.parent, self.data_dir):
                sync(directory)
            record = get_domain(db, name)
        empty_graves(folder.parent)
        return record, True

    def set_options(self, name: str, options: Mapping[str, Any]) -> DomainRecord:
        """Change what of a domain is shown and how; what is not named stays. Raises UnknownDomainError."""
        with self._writing() as db:
            record = get_domain(db, name)
            db.execute("UPDATE domain SET options = ? WHERE name = ?", [to_json({**record.options, **options}), name])
            return get_domain(db, name)

    def domain(self, name: str) -> DomainRecord:
        """One domain; raises UnknownDomainError."""
        with self._reading() as db:
            return get_domain(db, name)

    def domains(self) -> list[DomainRecord]:
        """Every domain by name."""
        with self._reading() as db:
            return read_domains(db)

    def domain_page(self, last_key: str | None, limit: int) -> ListPage[DomainRecord, str]:
        """A page of domains by name, behind the name `last_key`."""
        with self._reading() as db:
            records = read_domains(db, last_name=last_key or "", limit=limit + 1)
            return ListPage.of(((record.name, record) for record in records), limit)

    @property
    def n_domains(self) -> int:
        """How many domains there are."""
        with self._reading() as db:
            return int(db.table("domain").count)

    def domain_names(self) -> set[str]:
        """The names of every domain: a hundred thousand take some 50 ms, where `domains` takes seconds."""
        with self._reading() as db:
            return {name for (name,) in db.execute("SELECT name FROM domain")}

    def serving_domains(self) -> list[str]:
        """The domains that have an active map, those whose was activated last first."""
        with self._reading() as db:
            rows = db.execute("SELECT domain FROM map WHERE state = 'active' ORDER BY activated_at DESC, domain")
            return [domain for (domain,) in rows]

    def serving_versions(self, domains: Sequence[str]) -> dict[str, tuple[str, int]]:
        """When each of these domains was made, and its active version; those that have none are left out."""
        with self._reading() as db:
            rows = db.execute(
                """
                SELECT name, domain.created_at, version FROM json_each(?) JOIN domain ON name = value
                JOIN map ON map.domain = name AND state = 'active'
                """,
                [to_json(domains)],
            )
            return {name: (created_at, version) for name, created_at, version in rows}

    def evaluators(self) -> dict[str, dict[str, Any]]:
        """Every configuration of an evaluator that is in use, by the first domain that has it."""
        with self._reading() as db:
            rows = db.execute("SELECT min(name), evaluator FROM domain GROUP BY evaluator ORDER BY 1")
            return {name: from_json(evaluator) for name, evaluator in rows}

    def delete_domain(self, name: str, *, only_empty: bool = False) -> None:
        """Delete a domain with its jobs, maps and files, or leave it where it has maps or files and `only_empty`.

        Raises:
            UnknownDomainError: There is no such domain.
            TraverseInUseError: A job on it has not ended, or a living process builds a map of it.
        """
        with self._writing() as db:
            get_domain(db, name)
            files = (path for path in layout.domain_folder(self.data_dir, name).rglob("*") if path.is_file())
            if only_empty and (db.table("map").count_where("domain = ?", [name]) or any(files)):
                return
            n_jobs = db.table("job").count_where("domain = ? AND state IN ('queued', 'running')", [name])
            if n_jobs or self._is_built(name):
                raise TraverseInUseError(f"a job on domain {name} has not ended: cancel it or wait for its end")
            db.table("domain").delete(name)
            db.table("doomed_folder").insert({"domain": name}, ignore=True)
        with self._writing() as db:  # from here on a crash is finished at the next start
            self._finish_deletion(db, name)
        empty_graves(layout.domains_folder(self.data_dir))  # gigabytes take seconds, in which others may write

    def _finish_deletion(self, db: Database, name: str) -> None:
        if db.table("doomed_folder").count_where("domain = ?", [name]):
            bury(layout.domain_folder(self.data_dir, name))
            db.table("doomed_folder").delete(name)

    def discard_unfinished(self) -> list[str]:
        """Clear away what dead processes left: the service calls it once at its start, before any work.

        Maps that were being built are discarded, jobs that ran wait again (`waiting_jobs`), files of removed maps and
        folders of deleted domains go. Returns one line for each thing done, for the log.
        """
        lines = [*self.take_over_jobs(), *self.discard_abandoned_maps()]
        with self._writing() as db:
            removed_maps = db.execute("SELECT domain, version FROM map WHERE removed_at IS NOT NULL").fetchall()
            for domain, version in removed_maps:
                if self._unlink(domain, version):
                    lines.append(f"removed the file of the removed map {version} of domain {domain}")
            for (name,) in db.execute("SELECT domain FROM doomed_folder").fetchall():
                self._finish_deletion(db, name)
                lines.append(f"removed the folder of the deleted domain {name}")
        empty_graves(layout.domains_folder(self.data_dir))
        return lines

    # API keys. Rows are never deleted: whether a key was ever created decides whether the service runs open.

    def create_key(
        self, scope: KeyScope, name: str = "", lifetime: timedelta | None = None, domains: Sequence[str] | None = None
    ) -> tuple[KeyRecord, ApiKey]:
        """Make an API key; its secret is returned here and can never be had again.

        Where `lifetime` is None it does not expire, where `domains` is None it opens all; they need not exist yet.
        Raises InvalidInputError where the name, the lifetime or the domains cannot be kept.
        """
        if len(name) > _MAX_NAME or not name.isprintable():
            raise InvalidInputError(f"a key is named by at most {_MAX_NAME} printable letters")
        if lifetime is not None and lifetime <= timedelta(0):
            raise InvalidInputError("a key lives for more than no time at all")
        if domains is not None and scope is KeyScope.ADMIN:
            raise InvalidInputError("a key of scope admin opens every domain")
        domains_json = (
            None if domains is None else json.dumps([layout.checked_name(domain, "domain") for domain in domains])
        )
        expires_at = None if lifetime is None else moment_after(lifetime)
        key = ApiKey.new()
        row = {"key_id": key.key_id, "name": name, "scope": scope, "secret_sha256": key.secret_sha256}
        with self._writing() as db:
            db.table("api_key").insert(
                {**row, "domains": domains_json, "created_at": current_moment(), "expires_at": expires_at}
            )
            return _get_key(db, key.key_id), key

    def keys(self) -> list[KeyRecord]:
        """Every API key that was ever created, revoked ones too, oldest first."""
        with self._reading() as db:
            return [_key(row) for row in db.execute(f"{_SELECT_KEY} ORDER BY rowid")]

    def revoke_key(self, key_id: str) -> KeyRecord:
        """Let a key open nothing any more; one that was revoked stays so since then. Raises UnknownKeyError."""
        with self._writing() as db:
            if _get_key(db, key_id).revoked_at is None:
                db.table("api_key").update(key_id, {"revoked_at": current_moment()})
            return _get_key(db, key_id)


def _get_key(db: Database, key_id: str) -> KeyRecord:
    row = None
    if _KEY_ID.fullmatch(key_id):  # other text cannot be one, and need not be valid Unicode either
        row = db.execute(f"{_SELECT_KEY} WHERE key_id = ?", [key_id]).fetchone()
    if row is None:
        raise UnknownKeyError(f"there is no key {key_id!a}: `deepsimbad keys list` shows them")
    return _key(row)


def _key(row: tuple[Any, ...]) -> KeyRecord:
    key_id, name, scope, secret_sha256, domains, *times = row
    key_domains = None if domains is None else tuple(json.loads(domains))
    return KeyRecord(key_id, name, KeyScope(scope), secret_sha256, key_domains, *times)
