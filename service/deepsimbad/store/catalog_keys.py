"""API keys: as text `dsk_<key id>_<secret>`, and what the catalog says of them; of a secret only a digest is kept."""

import hashlib
import json
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Self

from sqlite_utils import Database

from deepsimbad.errors import InvalidInputError, UnknownKeyError
from deepsimbad.store.connection import OpenFile
from deepsimbad.store.layout import checked_name
from deepsimbad.store.records import KeyRecord, KeyScope, after, now

_PATTERN = re.compile(r"dsk_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
_KEY_ID = re.compile(r"[0-9a-f]{12}")
_MAX_NAME = 100
_SELECT = "SELECT key_id, name, scope, secret_sha256, domains, created_at, expires_at, revoked_at FROM api_key"


@dataclass(frozen=True)
class ApiKey:
    """A key as its holder has it; its id, twelve hexadecimal digits, may be shown and logged, its secret not."""

    key_id: str
    secret: str = field(repr=False)  # 256 random bits in 43 letters

    @classmethod
    def new(cls) -> Self:
        """A key that nobody has had before."""
        return cls(secrets.token_hex(6), secrets.token_urlsafe(32))

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """The key that a text is; None where it has not the form of one."""
        match = _PATTERN.fullmatch(text)
        return None if match is None else cls(*match.groups())

    @property
    def text(self) -> str:
        """What its holder sends."""
        return f"dsk_{self.key_id}_{self.secret}"

    @property
    def secret_sha256(self) -> str:
        """What is stored of the secret. It is random, so that a fast digest gives nothing away."""
        return hashlib.sha256(self.secret.encode()).hexdigest()


class KeyCatalog(OpenFile):
    """The keys. Rows are never deleted: whether a key was ever created decides whether the service runs open."""

    def create_key(
        self,
        scope: KeyScope,
        name: str = "",
        lifetime: timedelta | None = None,
        domains: Sequence[str] | None = None,
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
        listed = None if domains is None else json.dumps([checked_name(domain, "domain") for domain in domains])
        expires_at = None if lifetime is None else after(lifetime)
        key = ApiKey.new()
        row = {"key_id": key.key_id, "name": name, "scope": scope, "secret_sha256": key.secret_sha256}
        with self._writing() as db:
            db.table("api_key").insert({**row, "domains": listed, "created_at": now(), "expires_at": expires_at})
            return _get_key(db, key.key_id), key

    def keys(self) -> list[KeyRecord]:
        """Every API key that was ever created, revoked ones too, oldest first."""
        with self._reading() as db:
            return [_key(row) for row in db.execute(f"{_SELECT} ORDER BY rowid")]

    def revoke_key(self, key_id: str) -> KeyRecord:
        """Let a key open nothing any more; one that was revoked stays so since then. Raises UnknownKeyError."""
        with self._writing() as db:
            if _get_key(db, key_id).revoked_at is None:
                db.table("api_key").update(key_id, {"revoked_at": now()})
            return _get_key(db, key_id)


def _get_key(db: Database, key_id: str) -> KeyRecord:
    row = None
    if _KEY_ID.fullmatch(key_id):  # other text cannot be one, and need not be valid Unicode either
        row = db.execute(f"{_SELECT} WHERE key_id = ?", [key_id]).fetchone()
    if row is None:
        raise UnknownKeyError(f"there is no key {key_id!a}: `deepsimbad keys list` shows them")
    return _key(row)


def _key(row: tuple[Any, ...]) -> KeyRecord:
    key_id, name, scope, secret_sha256, domains, *times = row
    opened = None if domains is None else tuple(json.loads(domains))
    return KeyRecord(key_id, name, KeyScope(scope), secret_sha256, opened, *times)
