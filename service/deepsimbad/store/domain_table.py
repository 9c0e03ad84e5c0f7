"""The catalog's statements on domains. Every function stands inside a transaction of its caller."""

from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import DomainDiffersError, TooManyDomainsError, UnknownDomainError
from deepsimbad.store.documents import from_json, now, row_reader, to_json
from deepsimbad.store.layout import is_name
from deepsimbad.store.records import DomainRecord

_SELECT = """
    SELECT domain.name, evaluator, closed, actions_m, active.version, domain.created_at
    FROM domain LEFT JOIN map AS active ON active.domain = domain.name AND active.state = 'active'
"""


@row_reader
def _record(row: tuple[Any, ...]) -> DomainRecord:
    name, evaluator, closed, actions_m, active_version, created_at = row
    return DomainRecord(
        name, from_json(evaluator), bool(closed), tuple(from_json(actions_m)), active_version, created_at
    )


def find(db: Database, name: str) -> DomainRecord | None:
    """The domain of that name, if there is one."""
    if not is_name(name):  # such a name cannot exist, and need not be valid Unicode either
        return None
    row = db.execute(f"{_SELECT} WHERE domain.name = ?", [name]).fetchone()
    return None if row is None else _record(row)


def get(db: Database, name: str) -> DomainRecord:
    """The domain of that name; raises UnknownDomainError."""
    record = find(db, name)
    if record is None:
        known = [row[0] for row in db.execute("SELECT name FROM domain ORDER BY name LIMIT 20")]
        raise UnknownDomainError(f"there is no domain {name!a}", known=known)
    return record


def all_domains(db: Database) -> list[DomainRecord]:
    """Every domain by name."""
    return [_record(row) for row in db.execute(f"{_SELECT} ORDER BY domain.name")]


def check_room(db: Database, name: str, max_domains: int) -> None:
    """Refuse a name that would be one domain too many; raises TooManyDomainsError."""
    (n_domains,) = db.execute("SELECT count(*) FROM domain").fetchone()
    if n_domains >= max_domains and find(db, name) is None:
        raise TooManyDomainsError(
            f"there are {n_domains} domains, as many as may be: delete one, or raise the setting max_domains",
            max_domains=max_domains,
        )


def insert(
    db: Database, name: str, evaluator: dict[str, Any], closed: bool, actions_m: tuple[float, ...]
) -> tuple[DomainRecord, bool]:
    """Insert a domain, or find that it exists just so; raises DomainDiffersError where it exists otherwise."""
    present = find(db, name)
    if present is None:
        db.execute(
            "INSERT INTO domain (name, evaluator, closed, actions_m, created_at) VALUES (?, ?, ?, ?, ?)",
            [name, to_json(evaluator), int(closed), to_json(actions_m), now()],
        )
        return get(db, name), True
    asked = (to_json(evaluator), closed, to_json(actions_m))
    if asked != (to_json(present.evaluator), present.closed, to_json(present.actions_m)):
        raise DomainDiffersError(
            f"domain {name} exists with another configuration: delete it first, or choose another name",
            present={
                "evaluator": present.evaluator,
                "closed": present.closed,
                "actions_m": list(present.actions_m),
            },
        )
    return present, False


def doom(db: Database, name: str) -> None:
    """Delete the domain's rows and note that its folder is still to be removed."""
    db.execute("DELETE FROM domain WHERE name = ?", [name])
    db.execute("INSERT OR IGNORE INTO doomed_folder (domain) VALUES (?)", [name])


def doomed(db: Database) -> list[str]:
    """The deleted domains whose folders may still be there."""
    return [row[0] for row in db.execute("SELECT domain FROM doomed_folder ORDER BY domain")]


def forget_doomed(db: Database, name: str) -> None:
    """Note that the folder of a deleted domain is gone."""
    db.execute("DELETE FROM doomed_folder WHERE domain = ?", [name])
