"""A damaged log is seen before SQLite forgets what is in it; a log that a crash cut short is none."""

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.errors import DamagedFileError
from deepsimbad.store.write_ahead_log import check_log

N_ROWS = 20
PAGE = 1024
FRAME = 24 + PAGE
WRITER = """
import os, sqlite3, sys
db = sqlite3.connect(sys.argv[1], isolation_level=None)
db.execute("PRAGMA journal_mode = WAL")
db.execute("CREATE TABLE more (body)")
print("writing", flush=True)
while True:
    db.execute("INSERT INTO more VALUES (?)", [os.urandom(20_000)])
"""


@pytest.fixture
def written(tmp_path: Path) -> Iterator[sqlite3.Connection]:
    """An open file whose log holds twenty transactions of one to five pages."""
    with closing(sqlite3.connect(tmp_path / "live.sqlite", isolation_level=None)) as db:
        db.execute(f"PRAGMA page_size = {PAGE}")
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("CREATE TABLE t (body)")
        for row in range(N_ROWS):
            db.execute("INSERT INTO t VALUES (?)", [bytes([row]) * (1 + 200 * row)])
        yield db


def died(tmp_path: Path, log: bytes) -> Path:
    """The file as a crash leaves it, with this log beside it."""
    copy = tmp_path / "died.sqlite"
    shutil.copy(tmp_path / "live.sqlite", copy)
    copy.with_name("died.sqlite-shm").unlink(missing_ok=True)
    copy.with_name("died.sqlite-wal").write_bytes(log)
    return copy


def rows_sqlite_finds(path: Path) -> int:
    with closing(sqlite3.connect(path)) as db:
        try:
            return int(db.execute("SELECT count(*) FROM t").fetchone()[0])
        except sqlite3.OperationalError:
            return -1


def test_every_flipped_byte_that_would_lose_a_row_is_seen(written: sqlite3.Connection, tmp_path: Path) -> None:
    whole = (tmp_path / "live.sqlite-wal").read_bytes()
    n_frames, rest = divmod(len(whole) - 32, FRAME)
    assert rest == 0
    assert n_frames > N_ROWS
    check_log(died(tmp_path, whole))
    rng = np.random.default_rng(0)
    last = 32 + (n_frames - 1) * FRAME
    places = [*range(0, 32, 5), *range(last, last + 24, 4), len(whole) - 1, *rng.integers(32, len(whole), 12).tolist()]
    for place in places:
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(8)
        path = died(tmp_path, bytes(flipped))
        before = path.read_bytes()
        with pytest.raises(DamagedFileError, match=r"died\.sqlite-wal is damaged at byte \d+") as caught:
            check_log(path)
        assert caught.value.hints["byte"] <= place
        assert path.read_bytes() == before
        assert path.with_name("died.sqlite-wal").read_bytes() == bytes(flipped), "nothing is changed"
        assert rows_sqlite_finds(path) < N_ROWS, f"SQLite would have forgotten rows: byte {place}"


def test_a_log_cut_short_anywhere_is_what_a_crash_leaves(written: sqlite3.Connection, tmp_path: Path) -> None:
    whole = (tmp_path / "live.sqlite-wal").read_bytes()
    for length in (*range(40), *range(32, len(whole), 501), 32 + 3 * FRAME + 24):
        check_log(died(tmp_path, whole[:length]))


def test_an_old_log_that_is_written_over_is_whole(written: sqlite3.Connection, tmp_path: Path) -> None:
    live = tmp_path / "live.sqlite"
    n_bytes = (tmp_path / "live.sqlite-wal").stat().st_size
    written.execute("PRAGMA wal_checkpoint")
    for row in range(5):
        written.execute("INSERT INTO t VALUES (?)", [bytes([row])])
        check_log(live)
    log = (tmp_path / "live.sqlite-wal").read_bytes()
    assert len(log) == n_bytes, "the frames of before are still behind the new ones"
    n_new = 5 * 2
    torn = log[: 32 + n_new * FRAME - 100] + bytes(100) + log[32 + n_new * FRAME :]
    check_log(died(tmp_path, torn[: 32 + n_new * FRAME] + log[32 + n_new * FRAME :]))
    flipped = bytearray(log)
    flipped[32 + FRAME + 500] ^= 4
    with pytest.raises(DamagedFileError):
        check_log(died(tmp_path, bytes(flipped)))


def test_a_power_cut_inside_a_commit_is_no_damage(written: sqlite3.Connection, tmp_path: Path) -> None:
    """The system writes the pages of an unfinished transaction out in any order, its last one perhaps first."""
    written.execute("PRAGMA wal_checkpoint")
    written.execute("INSERT INTO t VALUES ('acknowledged')")
    log = tmp_path / "live.sqlite-wal"
    before = log.read_bytes()
    written.execute("INSERT INTO t VALUES (?)", [bytes(5 * PAGE)])
    after = log.read_bytes()
    changed = [at for at in range(32, len(after), FRAME) if before[at : at + FRAME] != after[at : at + FRAME]]
    assert len(changed) > 3, "the slots of an older generation were written over"
    for missing in changed[:-1]:
        for first, last in ((missing, missing + FRAME), (missing - 100, missing + FRAME - 100)):
            if first < changed[0]:
                continue
            torn = after[:first] + before[first:last] + after[last:]
            path = died(tmp_path, torn)
            check_log(path)
            assert rows_sqlite_finds(path) == N_ROWS + 1, "what was acknowledged is there"
    written.execute("INSERT INTO t VALUES ('acknowledged too')")
    whole = log.read_bytes()
    lost = whole[: changed[0]] + before[changed[0] : changed[0] + FRAME] + whole[changed[0] + FRAME :]
    with pytest.raises(DamagedFileError):  # only the last transaction can be one that was never acknowledged
        check_log(died(tmp_path, lost))


def test_what_was_rolled_back_is_no_damage(written: sqlite3.Connection, tmp_path: Path) -> None:
    written.execute("PRAGMA cache_size = 5")
    written.execute("BEGIN")
    n_bytes = (tmp_path / "live.sqlite-wal").stat().st_size
    for _ in range(50):
        written.execute("INSERT INTO t VALUES (?)", [bytes(3000)])
    assert (tmp_path / "live.sqlite-wal").stat().st_size > n_bytes, "it went to the log before its commit"
    check_log(tmp_path / "live.sqlite")
    written.execute("ROLLBACK")
    check_log(tmp_path / "live.sqlite")
    written.execute("INSERT INTO t VALUES (?)", [b"after"])
    check_log(tmp_path / "live.sqlite")


def test_a_writer_at_work_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "busy.sqlite"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "writing\n"
            for _ in range(200):
                check_log(path)
        finally:
            writer.kill()
    check_log(path)


def test_no_log_is_fine(tmp_path: Path) -> None:
    check_log(tmp_path / "nothing.sqlite")
