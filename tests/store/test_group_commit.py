"""Group commit: what is acknowledged is committed, in order, and one bad write harms no other."""

import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import wait
from pathlib import Path
from typing import Any

import pytest
from sqlite_utils import Database

from deepsimbad.errors import InvalidInputError, UnavailableError
from deepsimbad.store.connection import open_database, use_write_ahead_log
from deepsimbad.store.group_commit import MAX_BATCH, GroupCommit


class Written:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.db = open_database(path, create=True)
        use_write_ahead_log(self.db)
        self.db.execute("CREATE TABLE t (n INTEGER PRIMARY KEY)")
        self.batches: list[int] = []
        self.commits = GroupCommit(self.db, path, self.batches.append)

    def rows(self) -> list[int]:
        """As another connection sees them: what is not committed is not there."""
        with sqlite3.connect(self.path) as other:
            found = [n for (n,) in other.execute("SELECT n FROM t ORDER BY rowid")]
        other.close()
        return found


@pytest.fixture
def written(tmp_path: Path) -> Iterator[Written]:
    made = Written(tmp_path / "a.sqlite")
    yield made
    made.commits.close()
    made.db.close()


def insert(n: int) -> Callable[[Database], Any]:
    def run(db: Database) -> int:
        db.execute("INSERT INTO t (n) VALUES (?)", [n])
        return n

    return run


def test_an_answer_means_committed(written: Written) -> None:
    for n in range(20):
        assert written.commits.submit(insert(n)).result() == n
        assert n in written.rows()


def test_what_waits_is_committed_together_and_in_order(written: Written) -> None:
    hold = threading.Event()
    first = written.commits.submit(lambda db: hold.wait())
    while not first.running():
        pass
    order: list[int] = []

    def noted(n: int) -> Callable[[Database], Any]:
        def run(db: Database) -> None:
            order.append(n)
            db.execute("INSERT INTO t (n) VALUES (?)", [n])

        return run

    waiting = [written.commits.submit(noted(n)) for n in range(MAX_BATCH + 40)]
    assert not any(one.done() for one in waiting)
    assert written.rows() == []
    hold.set()
    wait(waiting)
    assert order == list(range(MAX_BATCH + 40))
    assert written.batches == [1, MAX_BATCH, 40]


def test_one_bad_write_fails_alone(written: Written) -> None:
    hold = threading.Event()
    written.commits.submit(lambda db: hold.wait())
    futures = [written.commits.submit(insert(n)) for n in (1, 2, 1, 3)]
    hold.set()
    wait(futures)
    assert [type(one.exception()) for one in futures] == [type(None), type(None), InvalidInputError, type(None)]
    assert written.rows() == [1, 2, 3]


def test_a_cancelled_write_does_not_stop_the_thread(written: Written) -> None:
    hold = threading.Event()
    written.commits.submit(lambda db: hold.wait())
    left = written.commits.submit(insert(5))
    assert left.cancel()
    after = written.commits.submit(insert(6))
    hold.set()
    assert after.result() == 6
    assert written.rows() == [5, 6]


def test_closing_commits_what_waits_and_takes_no_more(written: Written) -> None:
    futures = [written.commits.submit(insert(n)) for n in range(5)]
    written.commits.close()
    assert [one.result(0) for one in futures] == list(range(5))
    with pytest.raises(UnavailableError):
        written.commits.submit(insert(9))
    written.commits.close()
