"""What the catalog holds, counted for whoever watches the service. One look, inside a transaction of its caller."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError
from deepsimbad.store import domain_table
from deepsimbad.store.records import JobState

GATE_LOST = "gate_lost"  # sealed, but worse than the active map by more than its gate allowed


@dataclass(frozen=True)
class ServingMap:
    """The active map of a domain; `created_at` in seconds since 1970."""

    domain: str
    version: int
    created_at: float


@dataclass(frozen=True)
class LastRemap:
    """The remap of a domain that ended last: "succeeded", "gate_lost", "failed" or "cancelled", and when (s)."""

    domain: str
    outcome: str
    finished_at: float


@dataclass(frozen=True)
class Census:
    """All of it.

    Attributes:
        domains: By name.
        jobs: How many of every state; a state without any counts 0.
        serving: Of the domains that have an active map.
        remaps: Of the domains in which a remap has ended.
    """

    domains: Sequence[str]
    jobs: Mapping[JobState, int]
    serving: Sequence[ServingMap]
    remaps: Sequence[LastRemap]


def take(db: Database) -> Census:
    """Count; raises DamagedFileError where a row cannot be read."""
    try:
        return _take(db)
    except (TypeError, ValueError) as error:
        raise DamagedFileError(f"the catalog is damaged: a row cannot be read: {error}") from error


def _take(db: Database) -> Census:
    counted = dict(db.execute("SELECT state, count(*) FROM job GROUP BY state"))
    serving = db.execute("SELECT domain, version, created_at FROM map WHERE state = 'active' ORDER BY domain")
    # Of a query with one max(), SQLite takes the other columns from the row that has it. Remaps are done one after the
    # other as they came, so the last row ended last, whatever the clock was set to; one that was cancelled while it
    # waited, out of that order, tells of nothing that was done and counts only beside others such.
    remaps = db.execute(
        """
        SELECT domain,
               CASE WHEN state = 'succeeded' AND json_extract(result, '$.metrics.check.passed') = 0
                    THEN ? ELSE state END,
               finished_at, max(((n_starts > 0) << 62) | rowid)
        FROM job WHERE kind = 'remap' AND finished_at IS NOT NULL GROUP BY domain ORDER BY domain
        """,
        [GATE_LOST],
    )
    return Census(
        domains=[record.name for record in domain_table.all_domains(db)],
        jobs={state: counted.get(state.value, 0) for state in JobState},
        serving=[ServingMap(domain, version, _seconds(at)) for domain, version, at in serving],
        remaps=[LastRemap(domain, outcome, _seconds(at)) for domain, outcome, at, _ in remaps],
    )


def _seconds(iso: str) -> float:
    return datetime.fromisoformat(iso).timestamp()
