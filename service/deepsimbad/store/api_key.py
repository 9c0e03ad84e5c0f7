"""An API key as text: `dsk_<key id>_<secret>`, of which only a digest of the secret is ever stored."""

import hashlib
import re
import secrets
from dataclasses import dataclass
from typing import Self

_PATTERN = re.compile(r"dsk_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
_KEY_ID = re.compile(r"[0-9a-f]{12}")


@dataclass(frozen=True)
class ApiKey:
    """A key as its holder has it; `repr` does not show the secret.

    Attributes:
        key_id: Twelve hexadecimal digits; it may be shown and logged.
        secret: 256 random bits in 43 letters.
    """

    key_id: str
    secret: str

    @classmethod
    def new(cls) -> Self:
        """A key that nobody has had before."""
        return cls(secrets.token_hex(6), secrets.token_urlsafe(32))

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """The key that a text is; None where it has not the form of one."""
        found = _PATTERN.fullmatch(text)
        return None if found is None else cls(*found.groups())

    @property
    def text(self) -> str:
        """What its holder sends."""
        return f"dsk_{self.key_id}_{self.secret}"

    @property
    def secret_sha256(self) -> str:
        """What is stored of the secret. It is random, so that a fast digest gives nothing away."""
        return hashlib.sha256(self.secret.encode()).hexdigest()

    def __repr__(self) -> str:
        return f"ApiKey({self.key_id})"


def is_key_id(text: str) -> bool:
    """Whether a text has the form of a key's id."""
    return _KEY_ID.fullmatch(text) is not None
