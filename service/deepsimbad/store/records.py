"""What the catalog knows of domains, map versions, jobs and API keys; how lists, JSON and times are written.

Times are ISO 8601 in UTC, to the millisecond; None: not yet, or never.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any, Generic, TypeVar

from sqlite_utils import Database

from deepsimbad.errors import InvalidInputError, UnknownDomainError, nearest_of
from deepsimbad.store.layout import is_name

Record = TypeVar("Record")
Key = TypeVar("Key", int, str)


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
        """Whether no other state follows."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


class KeyScope(StrEnum):
    """What an API key opens; `admin` includes `localize`."""

    LOCALIZE = "localize"
    ADMIN = "admin"

    def includes(self, scope: "KeyScope") -> bool:
        """Whether a key of this scope may do what `scope` may."""
        return self is KeyScope.ADMIN or self is scope


@dataclass(frozen=True)
class DomainRecord:
    """One domain: `evaluator` as it was given, `closed` where the route is a loop, `options` of what it shows."""

    name: str
    evaluator: dict[str, Any]
    closed: bool
    actions_m: tuple[float, ...]
    active_version: int | None
    created_at: str
    options: dict[str, Any]

    @property
    def configuration(self) -> dict[str, Any]:
        """What the domain was made with, which never changes."""
        return {"evaluator": self.evaluator, "closed": self.closed, "actions_m": list(self.actions_m)}


_SELECT_DOMAIN = """
    SELECT domain.name, evaluator, closed, actions_m, active.version, domain.created_at, options
    FROM domain LEFT JOIN map AS active ON active.domain = domain.name AND active.state = 'active'
"""


def read_domains(db: Database, name: str | None = None, last_name: str = "", limit: int = -1) -> list[DomainRecord]:
    """Domains in order of their names, at most `limit` behind `last_name`, or the one called `name` if there is one."""
    if name is not None and not is_name(name):  # such a name cannot exist, and need not be valid Unicode either
        return []
    condition, bound = ("> ?", last_name) if name is None else ("= ?", name)
    rows = db.execute(f"{_SELECT_DOMAIN} WHERE domain.name {condition} ORDER BY domain.name LIMIT ?", [bound, limit])
    return [
        DomainRecord(
            name,
            from_json(evaluator),
            bool(closed),
            tuple(from_json(actions_m)),
            version,
            created_at,
            from_json(options),
        )
        for name, evaluator, closed, actions_m, version, created_at, options in rows
    ]


def get_domain(db: Database, name: str) -> DomainRecord:
    """The domain of that name; raises UnknownDomainError."""
    for record in read_domains(db, name):
        return record
    names = [row[0] for row in db.execute("SELECT name FROM domain ORDER BY name LIMIT 20")]
    raise UnknownDomainError(f"there is no domain {name!a}{nearest_of(name, names)}", known=names)


@dataclass(frozen=True)
class MapRecord:
    """One map version of a domain; when it last began to serve, last ceased to, and when its file was removed."""

    domain: str
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
class JobRecord:
    """One job; `progress` runs from 0 to 1.

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
    """One API key, without its secret, of which it holds the SHA-256 in hex; `domains` None opens all."""

    key_id: str
    name: str
    scope: KeyScope
    secret_sha256: str
    domains: tuple[str, ...] | None
    created_at: str
    expires_at: str | None
    revoked_at: str | None

    def is_usable(self, moment: str) -> bool:
        """Whether it opens anything at a time (as `current_moment` writes it)."""
        return self.revoked_at is None and (self.expires_at is None or moment < self.expires_at)


@dataclass(frozen=True)
class ListPage(Generic[Record, Key]):
    """Some records in the list's order, and the key of the last of them where more follow.

    A page is found by the key of the record before it, never by a count: whatever is made or removed meanwhile, no
    record that stays is shown twice or left out.
    """

    records: tuple[Record, ...]
    last_key: Key | None

    @classmethod
    def of(cls, rows: Iterable[tuple[Key, Record]], limit: int) -> "ListPage[Record, Key]":
        """The first `limit` of `rows` as a page, where one more was asked for to tell whether more follow."""
        rows = list(rows)
        page = rows[:limit]
        return cls(tuple(record for _, record in page), page[-1][0] if len(rows) > limit else None)


def to_json(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """The one text of a JSON value, so that equal values are equal texts; raises InvalidInputError."""
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(f"not a JSON value: {error}") from error


def from_json(text: str | None) -> Any:
    """The value of a JSON column, None of an empty one; raises ValueError on damage."""
    return None if text is None else json.loads(text)


def current_moment(behind: str | None = None) -> str:
    """The present moment as text, which sorts as times do; later than `behind`, though the clock was set back."""
    moment = _text(datetime.now(UTC))
    if behind is None or moment > behind:
        return moment
    return _text(datetime.fromisoformat(behind) + timedelta(milliseconds=1))


def moment_after(wait: timedelta) -> str:
    """The moment `wait` from now, as `current_moment` writes it; raises InvalidInputError past the year 9999."""
    try:
        return _text(datetime.now(UTC) + wait)
    except OverflowError as error:
        raise InvalidInputError("a time past the year 9999 cannot be kept") from error


def _text(moment: datetime) -> str:
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
