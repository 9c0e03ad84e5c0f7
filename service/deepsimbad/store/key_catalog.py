"""What the catalog says of API keys."""

from datetime import timedelta

from deepsimbad.errors import InvalidInputError
from deepsimbad.store import key_table
from deepsimbad.store.api_key import ApiKey
from deepsimbad.store.catalog_file import CatalogFile
from deepsimbad.store.documents import after
from deepsimbad.store.records import KeyRecord, KeyScope

_MAX_KEY_NAME = 100


class KeyCatalog(CatalogFile):
    """The keys; of their secrets there are only digests."""

    def create_key(
        self, scope: KeyScope, name: str = "", lifetime: timedelta | None = None
    ) -> tuple[KeyRecord, ApiKey]:
        """Make an API key; its secret is returned here and can never be had again.

        Args:
            scope: What it opens.
            name: What to call it, at most 100 printable letters; may be empty.
            lifetime: From now on, above 0; None: it does not expire.

        Raises:
            InvalidInputError: The name or the lifetime cannot be kept.
        """
        if len(name) > _MAX_KEY_NAME or not name.isprintable():
            raise InvalidInputError(f"a key is named by at most {_MAX_KEY_NAME} printable letters")
        if lifetime is not None and lifetime <= timedelta(0):
            raise InvalidInputError("a key lives for more than no time at all")
        expires_at = None if lifetime is None else after(lifetime)
        key = ApiKey.new()
        with self._writing() as db:
            return key_table.insert(db, key, scope, name, expires_at), key

    def keys(self) -> list[KeyRecord]:
        """Every API key that was ever created, revoked ones too, oldest first."""
        with self._reading() as db:
            return key_table.all_keys(db)

    def revoke_key(self, key_id: str) -> KeyRecord:
        """Let a key open nothing any more; raises UnknownKeyError."""
        with self._writing() as db:
            return key_table.revoke(db, key_id)
