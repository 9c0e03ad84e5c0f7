"""The file of live sessions: what is acknowledged is committed, in order, and one bad write harms no other."""

import asyncio
import sqlite3
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.errors import DamagedFileError, InvalidInputError, UnavailableError, UnknownSessionError
from deepsimbad.store.connection import MAX_BATCH
from deepsimbad.store.sessions import IdempotencyKey, ObservedRow, PriorRow, SessionRecord, SessionStore, StateSnapshot

RECORD = SessionRecord(0, "s1", "campus", 3, "f" * 64, {"filter": "grid", "seed": 2**53}, 100.0, 200.0, 0, None)
RANKS = np.array([1, 2.5, 2.5, 4], np.float32)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SessionStore]:
    with SessionStore.open(tmp_path) as new_store:
        yield new_store


@pytest.fixture
def number(store: SessionStore) -> int:
    """The number of a session of the store."""
    return store.create(RECORD).result().number


def begin(store: SessionStore, session_id: str, **changes: Any) -> int:
    """Begin another session and return its number."""
    return store.create(replace(RECORD, session_id=session_id, **changes)).result().number


def observed(sequence: int, **changes: object) -> ObservedRow:
    return replace(ObservedRow(sequence, 200.0 + sequence, 3.0, None, RANKS), **changes)  # type: ignore[arg-type]


def test_a_session_is_found_again_as_it_was(store: SessionStore, tmp_path: Path) -> None:
    session = store.create(RECORD).result()
    assert session == replace(RECORD, number=session.number)
    assert store.create(replace(RECORD, domain="another", config={}, expires_at=9.0)).result() == session, (
        "an id is taken once"
    )
    assert store.find("s1") == session
    store.append(session.number, observed(1), 101.0).result()
    store.append(session.number, PriorRow(2, 333.0, 1.0, 2.0), 102.0).result()
    assert store.living_sessions() == [replace(session, expires_at=333.0, n_events=2)]
    store.close()
    with SessionStore.open(tmp_path) as again:
        assert again.find("s1") == replace(session, expires_at=333.0, n_events=2)


def test_rows_come_back_bit_for_bit(store: SessionStore, number: int) -> None:
    rng = np.random.default_rng(0)
    row = observed(
        1,
        action_m=0.1 + 0.2,
        action_std_m=1e-300,
        dissimilarities=rng.normal(size=4).astype(np.float32),
        encoding=rng.normal(size=7).astype(np.float32),
        idempotency=IdempotencyKey("k", b"\x00\xff"),
    )
    store.append(number, row, 1.0).result()
    _, (stored,) = store.history(number, 1)
    assert isinstance(stored, ObservedRow)
    for name in ("ranks", "dissimilarities", "encoding"):
        assert getattr(stored, name).dtype == np.float32
        np.testing.assert_array_equal(getattr(stored, name), getattr(row, name))
    plain = {"ranks": RANKS, "dissimilarities": None, "encoding": None}
    assert str(replace(stored, **plain)) == str(replace(row, **plain))  # type: ignore[arg-type]


@pytest.mark.parametrize("n_landmarks", [1, 2, 500, 32_767, 32_768, 65_535])
def test_ranks_of_any_map_fit(store: SessionStore, number: int, n_landmarks: int) -> None:
    ranks = np.random.default_rng(1).permutation(n_landmarks).astype(np.float32) + 1
    ranks[: n_landmarks // 2] = (n_landmarks + 1) / 2
    store.append(number, observed(1, ranks=ranks), 1.0).result()
    (row,) = store.journal(number)
    np.testing.assert_array_equal(row.ranks, ranks)
    (n_bytes,) = store._db.execute("SELECT length(ranks) FROM journal").fetchone()
    assert n_bytes == n_landmarks * (2 if n_landmarks < 32_768 else 4)


def test_a_sequence_number_or_key_is_taken_once(store: SessionStore, number: int) -> None:
    idempotency_key = IdempotencyKey("k", b"d")
    store.append(number, observed(1, idempotency=idempotency_key), 1.0).result()
    with pytest.raises(InvalidInputError):
        store.append(number, observed(1), 1.0).result()
    with pytest.raises(InvalidInputError):
        store.append(number, observed(2, idempotency=idempotency_key), 1.0).result()
    assert store.find_observation(number, "k") == (1, b"d")
    assert store.find_observation(number, "other") is None
    other = begin(store, "s2")
    store.append(other, observed(1, idempotency=idempotency_key), 1.0).result()  # keys are a session's own
    assert len(store.history(number, 9)[1]) == 1


def test_history_begins_behind_the_snapshot(store: SessionStore, number: int) -> None:
    arrays = {"mass": np.array([0.1, 0.9]), "count": np.array(3), "none": np.zeros((0, 2), np.float32)}
    for sequence in range(1, 6):
        snapshot = StateSnapshot(sequence - 1, arrays) if sequence in {3, 5} else None
        store.append(number, observed(sequence), 1.0, snapshot).result()
    snapshot, rows = store.history(number, 5)
    assert snapshot is not None
    assert snapshot.sequence == 4
    assert [row.sequence for row in rows] == [5]
    for name, array in arrays.items():
        assert snapshot.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(snapshot.arrays[name], array)
    snapshot, rows = store.history(number, 4)  # a state from before the snapshot is session from the beginning
    assert snapshot is None
    assert [row.sequence for row in rows] == [1, 2, 3, 4]


def test_ended_sessions_are_remembered_until_they_are_purged(store: SessionStore) -> None:
    numbers = [begin(store, f"s{n}") for n in range(3)]
    for number in numbers:
        store.append(number, observed(1), 1.0).result()
    assert store.end(numbers[1], "expired", 200.5).result() is False  # it was observed since, and expires at 201
    assert store.end(numbers[0], "deleted", 1000.0).result() is True
    assert store.end(numbers[0], "expired", 1001.0).result() is False
    assert store.end(numbers[1], "expired", 2000.0).result() is True
    assert [session.session_id for session in store.living_sessions()] == ["s2"]
    assert store.find("s0").ending == "deleted"
    while store.purge(1500.0).result():
        pass
    with pytest.raises(UnknownSessionError):
        store.find("s0")
    assert store.history(numbers[0], 9) == (None, [])
    assert store.find("s1").ending == "expired"
    assert store.n_observations(numbers[1]) == 1  # its journal may still be learnt from


def test_a_long_journal_is_forgotten_in_pieces(
    store: SessionStore, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepsimbad.store.sessions.PURGED_AT_ONCE", 4)
    other = begin(store, "s2")
    for sequence in range(1, 11):
        for session in (number, other):
            store.append(session, observed(sequence), 1.0).result()
    store.end(number, "deleted", 5.0).result()
    left = []
    while store.purge(6.0).result():
        left.append(store.n_observations(number))
        assert store.find("s1").ending == "deleted"
    assert left == [6, 2]
    with pytest.raises(UnknownSessionError):
        store.find("s1")
    assert store.n_observations(other) == 10


def test_many_sessions_are_forgotten_in_pieces_however_little_each_saw(
    store: SessionStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepsimbad.store.sessions.PURGED_AT_ONCE", 4)
    for n in range(10):
        store.end(begin(store, f"s{n}"), "deleted", 5.0 + n).result()
    assert store.purge(14.5).result() is True
    assert store.find("s4").ending == "deleted", "one transaction for all of a day would keep robots waiting"
    while store.purge(13.5).result():
        pass
    assert store.find("s9").ending == "deleted"
    with pytest.raises(UnknownSessionError):
        store.find("s8")


def test_no_robot_waits_while_views_are_counted(store: SessionStore, number: int) -> None:
    """A session of days has a hundred thousand, and truths are told one by one."""
    store.append(number, observed(1), 1.0).result()
    with ThreadPoolExecutor() as pool, store._reader_lock:
        assert pool.submit(store.n_observations, number).result(5.0) == 1


def test_a_damaged_row_is_named(store: SessionStore, number: int, tmp_path: Path) -> None:
    store.append(number, observed(1), 1.0, StateSnapshot(1, {"mass": np.ones(3)})).result()
    with closing(sqlite3.connect(tmp_path / "sessions.sqlite", isolation_level=None)) as other:
        other.execute("UPDATE snapshot SET body = x'00'")
    with pytest.raises(DamagedFileError):
        store.history(number, 2)


def test_living_sessions_are_listed_page_by_page_newest_first(store: SessionStore) -> None:
    numbers = [begin(store, f"s{n}", domain="campus" if n % 2 else "yard") for n in range(6)]
    store.append(numbers[1], observed(1), 101.0).result()
    store.append(numbers[1], PriorRow(2, 400.0, 1.0, 2.0), 102.0).result()
    store.append(numbers[1], observed(3, expires_at=400.0), 103.0).result()
    store.end(numbers[4], "deleted", 104.0).result()

    def names(domain: str | None, last_key: int | None, limit: int, time_s: float) -> tuple[list[str], int | None]:
        page = store.newest_living(domain, last_key, limit, time_s)
        return [entry.session.session_id for entry in page.records], page.last_key

    assert names(None, None, 10, 150.0) == (["s5", "s3", "s2", "s1", "s0"], None)
    assert names(None, None, 2, 150.0) == (["s5", "s3"], numbers[3])
    assert names(None, numbers[3], 3, 150.0) == (["s2", "s1", "s0"], None)
    assert names("campus", None, 2, 150.0) == (["s5", "s3"], numbers[3])
    assert names("campus", numbers[3], 2, 150.0) == (["s1"], None)
    assert names("nowhere", None, 2, 150.0) == ([], None)
    assert names(None, None, 10, 250.0) == (["s1"], None)  # the others have expired, though nobody has looked yet
    (entry,) = store.newest_living(None, None, 10, 250.0).records
    assert (entry.n_observations, entry.session.n_events, entry.session.expires_at) == (2, 3, 400.0)


@pytest.mark.parametrize("name", ["sessions.sqlite", "sessions.sqlite-wal"])
def test_sessions_that_were_removed_meanwhile_take_no_more(
    store: SessionStore, number: int, tmp_path: Path, name: str
) -> None:
    assert store.find("s1").n_events == 0
    (tmp_path / name).unlink()
    with pytest.raises(DamagedFileError, match=f"{name} was removed under the running service"):
        store.append(number, observed(1), 1.0).result()
    (tmp_path / name).touch()  # another one of its name is none
    with pytest.raises(DamagedFileError, match="was removed"):
        store.try_writing().result()
    assert store.find("s1").n_events == 0


def test_an_ordered_end_writes_what_a_removed_log_held(store: SessionStore, number: int, tmp_path: Path) -> None:
    store.append(number, observed(1), 1.0).result()
    (tmp_path / "sessions.sqlite-wal").unlink()
    store.close()
    with SessionStore.open(tmp_path) as reopened_store:
        assert reopened_store.find("s1").n_events == 1


# Group commit


@contextmanager
def another_writer(folder: Path) -> Iterator[None]:
    """A block in which every commit has to wait."""
    with closing(sqlite3.connect(folder / "sessions.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


def sequences(store: SessionStore, number: int) -> list[int]:
    return [row.sequence for row in store.journal(number)]


def test_what_waits_is_committed_together_and_in_order(tmp_path: Path) -> None:
    batches: list[int] = []
    with SessionStore.open(tmp_path, batches.append) as store:
        number = store.create(RECORD).result().number
        batches.clear()
        with another_writer(tmp_path):
            waiting = [store.append(number, observed(n), 1.0) for n in range(1, 2 * MAX_BATCH + 1)]
            assert waiting[7].cancel() is False, "who goes away does not undo what is on its way"
            assert sequences(store, number) == []
        wait(waiting)
        assert sequences(store, number) == list(range(1, 2 * MAX_BATCH + 1))
    assert (sum(batches), max(batches)) == (2 * MAX_BATCH, MAX_BATCH)
    assert len(batches) in {2, 3}, "the first may have begun alone"


def test_one_bad_write_fails_alone(store: SessionStore, number: int, tmp_path: Path) -> None:
    with another_writer(tmp_path):
        futures = [store.append(number, observed(n), 1.0) for n in (1, 2, 1, 3)]
    wait(futures)
    assert [type(future.exception()) for future in futures] == [type(None), type(None), InvalidInputError, type(None)]
    assert sequences(store, number) == [1, 2, 3]


def test_closing_commits_what_waits_and_takes_no_more(store: SessionStore, number: int) -> None:
    futures = [store.append(number, observed(n), 1.0) for n in range(1, 6)]
    store.close()
    assert [future.result(0) for future in futures] == [None] * 5
    with pytest.raises(UnavailableError):
        store.try_writing()
    assert not store.is_committing


def test_a_write_may_be_on_the_disk_before_its_sender_goes_on(
    store: SessionStore, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sender's thread may be put aside, for as long as a commit takes, right after it handed the write in."""
    waiting = store._commits._queue

    class Preempted:
        get, empty = waiting.get, waiting.empty

        def put(self, write: Any) -> None:
            waiting.put(write)
            if write is not None:
                wait([future for _, future in write], timeout=60)

    monkeypatch.setattr(store._commits, "_queue", Preempted())
    store.append(number, observed(1), 101.0).result(60)
    assert store.living_sessions()[0].n_events == 1


def test_what_an_event_loop_appends_at_one_turn_is_written_together(tmp_path: Path) -> None:
    commits: list[int] = []

    async def append_at_once(store: SessionStore, numbers: list[int]) -> None:
        writes = [store.append(number, observed(1), 1.0) for number in numbers]
        await asyncio.gather(*map(asyncio.wrap_future, writes))

    with SessionStore.open(tmp_path, commits.append) as store:
        numbers = [begin(store, f"s{n}") for n in range(20)]
        commits.clear()
        asyncio.run(append_at_once(store, numbers))
        assert (sum(commits), len(commits)) in {(20, 1), (20, 2)}, "the first may have been handed over at once"
        assert all(store.journal(number) for number in numbers)


def test_what_was_appended_before_the_end_is_on_the_disk_though_its_turn_never_ended(tmp_path: Path) -> None:
    async def append_and_close(store: SessionStore, number: int) -> None:
        store.append(number, observed(1), 1.0)
        store.close()

    store = SessionStore.open(tmp_path)
    number = store.create(RECORD).result().number
    asyncio.run(append_and_close(store, number))
    with SessionStore.open(tmp_path) as again:
        assert len(again.journal(number)) == 1


def test_where_no_transaction_begins_all_that_wait_are_told_at_once(
    store: SessionStore, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever holds the file's lock would else be waited for by one robot after the other."""
    attempts, all_wait = [], threading.Event()

    @contextmanager
    def held_by_another_process() -> Iterator[Any]:
        attempts.append(all_wait.wait(60))
        raise UnavailableError("busy")
        yield

    with monkeypatch.context() as patched:
        patched.setattr(store._commits, "_transaction", held_by_another_process)
        writes = [store.append(number, observed(1), 101.0) for _ in range(6)]
        all_wait.set()
        assert [type(write.exception(60)) for write in writes] == [UnavailableError] * 6
    assert len(attempts) <= 2, "the first may have begun alone"
    store.append(number, observed(1), 101.0).result()
