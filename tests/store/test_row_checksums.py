"""Every flipped bit that changes what a catalog or a sessions file says is seen."""

import random
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.file_checks import catalog_problems, sessions_problems
from deepsimbad.store.records import KeyScope
from deepsimbad.store.row_checksums import RowChecksums, verify_rows
from deepsimbad.store.session_records import ClockRecord, ObservedRow, PriorRow, SessionRecord, StateSnapshot
from deepsimbad.store.sessions import SessionStore

N_FLIPS = 250


def fill_catalog(data_dir: Path) -> Path:
    with Catalog.open(data_dir) as catalog:
        for number in range(6):
            name = f"campus-{number}"
            catalog.create_domain(name, {"kind": "feature_l2", "extractor": "none"}, False, [1, 2, 3])
            job = catalog.create_job(name, "remap", {"training_traverse": "summer", "n_landmarks": 500})
            catalog.update_job(job.job_id, state="succeeded", result={"map_version": 1, "metrics": {"anr": 3.25}})
            version = catalog.begin_map(name, {"n_landmarks": 500})
            catalog.map_path(name, version).write_bytes(b"x")
            catalog.seal_map(name, version, "0" * 64, 1, {"anr": 2.5})
            catalog.activate(name, version, None)
        catalog.create_key(KeyScope.ADMIN, "operator", None)
    return data_dir / "catalog.sqlite"


def fill_sessions(data_dir: Path) -> Path:
    rng = np.random.default_rng(0)
    with SessionStore.open(data_dir) as store:
        for name in ("a" * 32, "b" * 32):
            record = SessionRecord(0, name, "campus", 1, "0" * 64, {"seed": 1}, 0.0, 9e9, 0, None)
            number = store.create(record).result().number
            for sequence in range(1, 20):
                ranks = rng.permutation(200).astype(np.float32) + 1
                snapshot = StateSnapshot(sequence - 1, {"mass": rng.random(300)}) if sequence % 8 == 0 else None
                store.append(number, ObservedRow(sequence, 9e9, 1.5, None, ranks), 0.0, snapshot).result()
            store.append(number, PriorRow(20, 9e9, 10.0, 2.0), 1.0).result()
            store.save_true_positions(number, rng.random(19), 2.0).result()
        store.note_clock(ClockRecord("boot", 1.0, 2.0)).result()
    return data_dir / "sessions.sqlite"


def said(path: Path) -> Any:
    """Everything that the file's tables hold (not when a migration ran); None where that cannot be read."""
    try:
        with closing(sqlite3.connect(f"{path.as_uri()}?immutable=1", uri=True)) as db:
            ours = "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE '%sqlite%'"
            tables = [name for (name,) in db.execute(ours)]
            return [(name, db.execute(f'SELECT * FROM "{name}" ORDER BY rowid').fetchall()) for name in tables]
    except (sqlite3.Error, UnicodeDecodeError):
        return None


@pytest.mark.parametrize(
    ("fill", "problems"),
    [(fill_catalog, catalog_problems), (fill_sessions, sessions_problems)],
    ids=["catalog", "sessions"],
)
def test_no_flipped_bit_is_believed(
    fill: Callable[[Path], Path], problems: Callable[[Path], list[str]], tmp_path: Path
) -> None:
    path = fill(tmp_path)
    whole, truth = path.read_bytes(), said(path)
    assert problems(path) == []
    chance = random.Random(1)
    n_seen = 0
    for _ in range(N_FLIPS):
        flipped = bytearray(whole)
        flipped[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        path.write_bytes(flipped)
        if problems(path):
            n_seen += 1
        else:
            assert said(path) == truth, "a change that nobody notices"
    assert n_seen > 10


@pytest.fixture
def sessions(tmp_path: Path) -> Path:
    return fill_sessions(tmp_path)


def spoil(path: Path, statement: str) -> None:
    """Change a row behind the back of the checksums."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        assert db.execute(statement).rowcount > 0


def test_a_catalog_with_a_changed_row_is_not_opened(tmp_path: Path) -> None:
    path = fill_catalog(tmp_path)
    spoil(path, "UPDATE map SET sha256 = replace(sha256, '0', '1') WHERE domain = 'campus-3'")
    with pytest.raises(DamagedFileError, match=r"catalog\.sqlite is damaged: a row of map"):
        Catalog.open(tmp_path)


def test_one_damaged_session_does_not_take_the_others_with_it(sessions: Path) -> None:
    spoil(sessions, "UPDATE journal SET action_m = 1.25 WHERE session = 1 AND sequence = 18")
    spoil(sessions, "UPDATE snapshot SET body = zeroblob(length(body)) WHERE session = 2")
    with SessionStore.open(sessions.parent) as store:
        first, second = store.living()
        with pytest.raises(DamagedFileError, match="a row of journal"):
            store.history(first.number, 20)
        with pytest.raises(DamagedFileError, match="a row of snapshot"):
            store.history(second.number, 20)
        assert len(store.journal(second.number)) == 20
        store.append(second.number, PriorRow(21, 9e9, 0.0, 1.0), 3.0).result()


@pytest.mark.parametrize(
    ("statement", "read"),
    [
        ("UPDATE session SET map_version = 2", lambda store: store.living()),
        ("UPDATE session SET map_version = 2", lambda store: store.find("a" * 32)),
        ("UPDATE clock SET seen_at = 1e300", lambda store: store.clock()),
        ("UPDATE true_positions SET received_at = 3", lambda store: store.true_positions(1)),
    ],
)
def test_every_row_is_checked_when_it_is_read(
    sessions: Path, statement: str, read: Callable[[SessionStore], object]
) -> None:
    spoil(sessions, statement)
    with SessionStore.open(sessions.parent) as store, pytest.raises(DamagedFileError):
        read(store)


def test_a_lost_row_is_seen(sessions: Path) -> None:
    spoil(sessions, "DELETE FROM journal WHERE session = 1 AND sequence = 5")
    assert sessions_problems(sessions) == [f"the journal of session {'a' * 32} has a gap"]


def test_rows_of_an_older_release_are_believed_until_they_are_filled_in() -> None:
    with Database(sqlite3.connect(":memory:", isolation_level=None)) as db:
        db.execute("CREATE TABLE job (a, checksum INTEGER)")
        db.execute("INSERT INTO job (a) VALUES (1)")
        checksums = RowChecksums(db, ["job"])
        verify_rows(db, ["job"], "it")
        checksums.fill_if_new()
        verify_rows(db, ["job"], "it")
        db.execute("INSERT INTO job (a) VALUES (2.5), ('x'), (x'00'), (NULL)")
        checksums.note()
        assert all(row[0] is not None for row in db.execute("SELECT checksum FROM job"))
        verify_rows(db, ["job"], "it")
        db.execute("UPDATE job SET a = 3 WHERE a = 1")
        with pytest.raises(DamagedFileError, match="it is damaged"):
            verify_rows(db, ["job"], "it")
        checksums.note()
        verify_rows(db, ["job"], "it")
        db.execute("UPDATE job SET checksum = NULL WHERE a = 3")
        checksums.fill_if_new()
        with pytest.raises(DamagedFileError, match="it is damaged"):
            verify_rows(db, ["job"], "it")
        db.execute("DELETE FROM job WHERE a = 3")
        db.execute("ALTER TABLE job ADD COLUMN b")
        verify_rows(db, ["job"], "it")
