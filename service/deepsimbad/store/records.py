"""What the catalog knows of a domain, a map version, a job and an API key."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class MapState(StrEnum):
    """The life of a map version (design: remapping)."""

    BUILDING = "building"
    SEALED = "sealed"
    ACTIVE = "active"
    RETIRED = "retired"


class JobState(StrEnum):
    """The life of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        """Whether nothing follows."""
        return self in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED)


class KeyScope(StrEnum):
    """What an API key opens; `admin` includes `localize`."""

    LOCALIZE = "localize"
    ADMIN = "admin"

    def includes(self, needed: "KeyScope") -> bool:
        """Whether a key of this scope may do what needs the other."""
        return self is KeyScope.ADMIN or self is needed


@dataclass(frozen=True)
class DomainRecord:
    """One domain.

    Attributes:
        name: Matches `layout.NAME_PATTERN`.
        evaluator: The evaluator's configuration, as it was given.
        closed: Whether the route is a loop.
        actions_m: The moves a robot may be asked to make, in metres.
        active_version: The map version that serves, if any.
        created_at: ISO 8601, UTC.
    """

    name: str
    evaluator: dict[str, Any]
    closed: bool
    actions_m: tuple[float, ...]
    active_version: int | None
    created_at: str


@dataclass(frozen=True)
class MapRecord:
    """One map version of a domain; `sha256` and `file_bytes` are None while it is being built.

    Times are ISO 8601 in UTC: when it last began to serve, last ceased to, and when its file was removed.
    """

    version: int
    state: MapState
    created_at: str
    sha256: str | None
    file_bytes: int | None
    config: dict[str, Any]
    metrics: dict[str, Any]
    activated_at: str | None
    retired_at: str | None
    removed_at: str | None


@dataclass(frozen=True)
class KeptMap:
    """A sealed map version that still has its file; `retired_at` as in `MapRecord`."""

    domain: str
    version: int
    state: MapState
    retired_at: str | None


@dataclass(frozen=True)
class JobRecord:
    """One job; times are ISO 8601 in UTC, `progress` runs from 0 to 1.

    `n_starts` counts how often work on it began, but for the starts that an orderly stop of the service ended.
    """

    job_id: str
    domain: str
    kind: str
    config: dict[str, Any]
    state: JobState
    stage: str | None
    progress: float
    eta_s: float | None
    result: dict[str, Any] | None
    error: dict[str, Any] | None
    created_at: str
    started_at: str | None
    finished_at: str | None
    n_starts: int


@dataclass(frozen=True)
class KeyRecord:
    """One API key, without its secret.

    Attributes:
        key_id: Twelve hexadecimal digits, a part of the key.
        name: What its maker calls it; may be empty.
        scope: What it opens.
        secret_sha256: Digest of the secret, hexadecimal.
        created_at: ISO 8601, UTC, as the other times.
        expires_at: From when on it opens nothing; None: never.
        revoked_at: Since when it opens nothing; None: it was not revoked.
    """

    key_id: str
    name: str
    scope: KeyScope
    secret_sha256: str
    created_at: str
    expires_at: str | None
    revoked_at: str | None

    def is_usable(self, at: str) -> bool:
        """Whether it opens anything at a time (as `documents.now` writes it)."""
        return self.revoked_at is None and (self.expires_at is None or at < self.expires_at)
