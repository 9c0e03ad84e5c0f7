"""The live sessions: each moves on in order of arrival, and nothing is answered before it is on the disk."""

import asyncio
import math
import secrets
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepsimbad.engine.distant import encoded
from deepsimbad.engine.localizer import View, describe, is_short
from deepsimbad.engine.maps import MappedDomain, Maps
from deepsimbad.engine.session import (
    LiveSession,
    Observation,
    SessionConfig,
    SessionEngine,
    SessionState,
    SessionView,
    check_prior,
    domain_digits,
    replayed_until,
    view_of,
)
from deepsimbad.engine.worker import EncodedImage, EvaluatorPool, InferenceWorker, Stopwatch
from deepsimbad.errors import (
    DamagedFileError,
    DeepSimbadError,
    EndedSessionError,
    IdempotencyKeyReusedError,
    RetiredMapError,
    SessionMovedError,
    TooManySessionsError,
    UnknownSessionError,
)
from deepsimbad.evaluators.scenes import Scene
from deepsimbad.store.records import ListPage
from deepsimbad.store.sessions import JournalRow, ListedSession, ObservedRow, PriorRow, SessionRecord, SessionStore

T = TypeVar("T")

DELETED, EXPIRED = "deleted", "expired"
_LONGEST_RETRY_S = 60


class Sessions:
    """All sessions of the service; used from one event loop.

    A change that has begun is finished even if its caller goes away: it may already be on the disk. A change that fails
    leaves the session as it was. Everywhere `key_id` is the API key whose sessions alone the caller may know of; None:
    it may know of all.
    """

    def __init__(
        self,
        store: SessionStore,
        maps: Maps,
        evaluators: EvaluatorPool,
        worker: InferenceWorker,
        *,
        ttl_s: float,  # time after its last change at which a session ends
        max_sessions: int,  # that live at once
        max_sessions_per_key: int,
        snapshot_every: int,  # rows of a journal between snapshots; so many are replayed after a start
        keep_ended_s: float,  # time for which an ended session and its observations are kept
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._store = store
        self._maps = maps
        self._evaluators = evaluators
        self._worker = worker
        self._ttl_s = ttl_s
        self._max_sessions = max_sessions
        self._max_sessions_per_key = max_sessions_per_key
        self._snapshot_every = snapshot_every
        self._keep_ended_s = keep_ended_s
        self._clock = clock
        self._n_beginning: Counter[str | None] = Counter()  # by key
        self._repeating = asyncio.Lock()
        # A thread of their own, because what only reads should not keep a robot's next step waiting for the worker
        self._summaries = ThreadPoolExecutor(1, "summaries")
        self._under_way: set[asyncio.Task[Any]] = set()
        # Without their states, which are read at first need, so that a start takes no longer for many sessions
        self._living = {record.session_id: LiveSession(record, record.expires_at) for record in store.living_sessions()}

    @property
    def n_living(self) -> int:
        """How many sessions have not ended, as far as is known without reading the store."""
        return len(self._living)

    def living(self, session_id: str) -> LiveSession | None:
        """A session that has not ended, as far as is known without reading the store; None where there is none."""
        session = self._living.get(session_id)
        return None if session is None or session.ending is not None else session

    def close(self) -> None:
        """End the thread of summaries."""
        self._summaries.shutdown()

    async def begin(
        self,
        mapped_domain: MappedDomain,
        config: SessionConfig,
        session_id: str | None = None,
        key_id: str | None = None,
    ) -> SessionView:
        """Begin a session on a domain's active map.

        Args:
            session_id: An id that repetitions of the request share: where such a session was begun already, that one is
                returned as it stands. None: a random id.
            key_id: The API key that it belongs to; None: no key is asked.

        Raises:
            InvalidInputError: The start or the configuration does not fit the map.
            TooManySessionsError: The limit on living sessions, of all or of this key, is reached.
            IdempotencyKeyReusedError: A session of that id began with another configuration.
            EndedSessionError: The session of that id has ended.
            RetiredMapError: The domain was deleted meanwhile.
        """
        digits = domain_digits(mapped_domain.record.name)
        if session_id is not None:
            session_id = digits + session_id[len(digits) :]
            with suppress(UnknownSessionError):
                return await self._begun_before(session_id, config)
        check_prior(mapped_domain.snapshot.route, config.start_position_m, config.start_std_m)
        session_id = session_id or digits + secrets.token_hex(12)
        return await self._finished(self._begin(mapped_domain, config, session_id, key_id))

    async def observe(
        self, session_id: str, observation: Observation, watch: Stopwatch | None = None, key_id: str | None = None
    ) -> SessionView:
        """Move a session on by a move and the view after it.

        The stage `wait` of the watch is the wait behind earlier observations, and then for the worker.

        Raises:
            UnknownSessionError, EndedSessionError, RetiredMapError: There is no such session, or no more.
            InvalidInputError: The move, the view or the shortlist does not fit the map.
            LandmarkModelDiffersError: The view was ranked by another landmark model than that of the session's map.
            IdempotencyKeyReusedError: Its idempotency key came before with another observation.
            SessionMovedError: Another node counted another observation at this moment.
        """
        session, watch = await self._find(session_id, key_id), watch or Stopwatch()
        try:
            return await self._finished(self._observe(session, observation, watch))
        except SessionMovedError:
            session = await self._find(session_id, key_id)  # reads what another node has written
            number, idempotency = session.record.number, observation.idempotency
            if (
                idempotency is None
                or await asyncio.to_thread(self._store.find_observation, number, idempotency.key) is None
            ):
                raise
            return await self._finished(self._observe(session, observation, watch))  # which was this observation

    async def set_prior(
        self, session_id: str, position_m: float, std_m: float, key_id: str | None = None
    ) -> SessionView:
        """Replace a session's belief by one around a position; raises InvalidPriorError."""
        session = await self._find(session_id, key_id)
        return await self._finished(self._set_prior(session, position_m, std_m))

    async def view(self, session_id: str, n_shortlist: int | None = None, key_id: str | None = None) -> SessionView:
        """A session as it stands now."""
        session, state = await self._read(session_id, key_id)
        return await asyncio.wrap_future(
            self._summaries.submit(view_of, session, session.expires_at, state, n_shortlist)
        )

    async def mass(self, session_id: str, key_id: str | None = None) -> NDArray[np.float32]:
        """[n] mass of every map image in a session's belief; sums to 1."""
        _, state = await self._read(session_id, key_id)
        return await asyncio.wrap_future(self._worker.submit(lambda: state.belief.belief.mass))

    async def newest(self, domain: str | None, before_number: int | None, limit: int) -> ListPage[ListedSession, int]:
        """A page of the living sessions, of a domain or all, newest first, with numbers below `before_number`."""
        return await asyncio.to_thread(self._store.newest_living, domain, before_number, limit, self._clock())

    async def end(self, session_id: str, key_id: str | None = None) -> None:
        """End a session."""
        await self._finished(self._end(await self._find(session_id, key_id), DELETED))

    async def end_those(self, is_over: Callable[[SessionRecord], bool]) -> None:
        """End the living sessions for which `is_over` holds, as those of a deleted domain."""
        for session in list(self._living.values()):
            if session.ending is None and is_over(session.record):
                with suppress(EndedSessionError):  # its robot was quicker
                    await self._finished(self._end(session, DELETED))

    async def sweep(self) -> None:
        """End what has expired, and forget what ended long ago."""
        await self._finished(self._expire())
        while await asyncio.wrap_future(self._store.purge(self._clock() - self._keep_ended_s)):
            pass

    def engine_of(self, record: SessionRecord) -> SessionEngine:
        """The engine of a session, living or ended; may read files.

        Raises:
            RetiredMapError: Its map is no more.
            DamagedMapError, DamagedFileError: The map or the session cannot be read.
        """
        mapped_domain = self._maps.pinned(record.domain, record.map_version, record.map_sha256)
        try:
            config = SessionConfig.from_dict(record.config)
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedFileError(f"session {record.session_id} cannot be read: {error}") from error
        return SessionEngine(config, mapped_domain.snapshot, self._evaluators.evaluator(mapped_domain.record.evaluator))

    # Beginning

    async def _begun_before(self, session_id: str, config: SessionConfig) -> SessionView:
        session = await self._find(session_id)
        if session.record.config != config.as_dict():
            raise IdempotencyKeyReusedError(
                "this idempotency key began a session with another configuration: choose a new one"
            )
        return await self.view(session_id)

    async def _begin(
        self, mapped_domain: MappedDomain, config: SessionConfig, session_id: str, key_id: str | None
    ) -> SessionView:
        crowd = self._crowd(key_id, await self._holders(may_have_ended=True))
        if crowd is not None:
            await self._expire()
            crowd = self._crowd(key_id, await self._holders())
        if crowd is not None:
            raise crowd
        self._n_beginning[key_id] += 1
        try:
            snapshot = mapped_domain.snapshot
            with self._maps.beginning(snapshot):
                digest = await asyncio.to_thread(self._maps.digest, snapshot)
                engine = SessionEngine(config, snapshot, self._evaluators.evaluator(mapped_domain.record.evaluator))
                state = await asyncio.wrap_future(self._worker.submit(lambda: SessionState.start(engine)))
                now_s = self._clock()
                new_record = SessionRecord(
                    number=0,
                    session_id=session_id,
                    domain=snapshot.domain,
                    map_version=snapshot.version,
                    map_sha256=digest,
                    config=config.as_dict(),
                    created_at=now_s,
                    expires_at=now_s + self._ttl_s,
                    n_events=0,
                    ending=None,
                    key_id=key_id,
                )
                record = await asyncio.wrap_future(self._store.create(new_record))
            if replace(record, number=0) != new_record:  # the same request came twice at once, and the other was first
                return await self._begun_before(session_id, config)
            # A repetition may have found it on the disk already.
            session = self._living.setdefault(session_id, LiveSession(record, record.expires_at, state))
            try:  # who deletes the domain ends its sessions afterwards, so that one of the two sees the other
                await asyncio.to_thread(self._maps.pinned, snapshot.domain, snapshot.version, digest)
            except RetiredMapError:
                await self._end(session, DELETED)
                raise
            return await asyncio.wrap_future(self._summaries.submit(view_of, session, record.expires_at, state))
        finally:
            self._n_beginning[key_id] -= 1

    async def _holders(self, *, may_have_ended: bool = False) -> list[str | None]:
        """The API key of every session that lives, wherever it does; see `SessionStore.holders`."""
        if self._store.is_shared:
            return await asyncio.to_thread(partial(self._store.holders, may_have_ended=may_have_ended))
        return [session.record.key_id for session in self._living.values()]

    def _crowd(self, key_id: str | None, holders: Sequence[str | None]) -> TooManySessionsError | None:
        """The error where no further session may live, of all or of this key; None where one may."""
        rivals = list(self._living.values())
        setting, limit, whose = "max_sessions", self._max_sessions, "sessions"
        if len(holders) + self._n_beginning.total() < limit:
            if key_id is None:
                return None
            rivals = [session for session in rivals if session.record.key_id == key_id]
            setting, limit, whose = "max_sessions_per_key", self._max_sessions_per_key, "sessions of this key"
            if holders.count(key_id) + self._n_beginning[key_id] < limit:
                return None
        soonest_s = min((session.expires_at for session in rivals), default=0.0) - self._clock()
        hints = {setting: limit, "limit": setting, "retry_after_s": max(1, min(_LONGEST_RETRY_S, math.ceil(soonest_s)))}
        return TooManySessionsError(
            f"{limit} {whose} live, and no more may: delete one that is done with, or wait", **hints
        )

    # Finding

    async def _find(self, session_id: str, key_id: str | None = None) -> LiveSession:
        """A living session.

        Raises:
            UnknownSessionError: There is none of that id, or it belongs to another key.
            EndedSessionError: It has been deleted, or has expired.
        """
        session = self._living.get(session_id)
        if session is None:
            record = await asyncio.to_thread(self._store.find, session_id)
            check_owner(record, key_id)
            if record.ending is not None:
                raise _ended_error(session_id, record.ending)
            session = self._living.setdefault(session_id, LiveSession(record, record.expires_at))  # begun this moment
        if key_id is not None:
            check_owner(session.record, key_id)
        if self._store.is_shared:
            async with session.lock:
                self._heed(session, await asyncio.to_thread(self._store.find, session_id))
        if self._clock() >= session.expires_at and not session.lock.locked():
            await self._end(session, EXPIRED)
        if session.ending is not None:
            raise _ended_error(session_id, session.ending)
        return session

    def _heed(self, session: LiveSession, record: SessionRecord) -> None:
        """Drop the state of a session that another node has moved on or ended, by its row in the store."""
        session.expires_at = record.expires_at
        if session.state is not None and session.state.sequence != record.n_events:
            session.state = None
        if record.ending is not None:
            session.ending, session.state = record.ending, None
            self._living.pop(record.session_id, None)

    async def _read(self, session_id: str, key_id: str | None) -> tuple[LiveSession, SessionState]:
        session = await self._find(session_id, key_id)
        if session.state is None:
            async with session.lock:
                return session, await self._state(session)
        return session, session.state

    async def _state(self, session: LiveSession) -> SessionState:
        """The state of a session, read from the disk where it is not in memory; the caller holds the session's lock.

        Raises:
            EndedSessionError: It ended while the caller waited.
            RetiredMapError: Its map is no more.
            DamagedMapError, DamagedFileError: The map or the session cannot be read.
        """
        if session.ending is not None:
            raise _ended_error(session.record.session_id, session.ending)
        if session.state is None:
            session.state = await asyncio.to_thread(self._from_disk, session.record)
        return session.state

    def _from_disk(self, record: SessionRecord) -> SessionState:
        engine = self.engine_of(record)
        snapshot, rows = self._store.history(record.number, self._store.find(record.session_id).n_events)
        state = SessionState.restored(engine, snapshot)
        for row in rows:
            state = state.followed(row)
        return state

    # Moving on

    async def _observe(self, session: LiveSession, observation: Observation, watch: Stopwatch) -> SessionView:
        """Decode, describe, compute, write and publish, in this order and under the session's lock."""
        async with session.lock:
            state = session.state or await self._state(session)
            engine = state.engine
            observation.check(engine.snapshot)
            watch.lap("wait")
            view, remarks = await observation.view(engine.evaluator, engine.snapshot)
            watch.lap("decode")
            if isinstance(view, np.ndarray | Scene):
                view = await encoded(self._worker, engine.evaluator, view)
            step = partial(self._step, session, state, observation, self._clock() + self._ttl_s, watch, view)
            try:
                answer = await self._published(
                    session, step, watch, is_short=is_short(engine.snapshot, view, observation.n_shortlist)
                )
            except _CountedBefore as repetition:
                answer = await self._repeated(session, state, repetition.sequence, observation.n_shortlist)
                watch.lap("summarise")
            return replace(answer, remarks=remarks) if remarks else answer

    def _step(
        self,
        session: LiveSession,
        state: SessionState,
        observation: Observation,
        expires_at: float,
        watch: Stopwatch,
        view: View,
    ) -> "_Move":
        """Move the session on by the observation's row; raises _CountedBefore where it has one already."""
        watch.lap("wait", {"encode": view.encode_ms} if isinstance(view, EncodedImage) else None)
        idempotency, snapshot = observation.idempotency, state.engine.snapshot
        if idempotency is not None:
            earlier = self._store.find_observation(session.record.number, idempotency.key)
            if earlier is not None and earlier[1] != idempotency.digest:
                raise IdempotencyKeyReusedError(
                    "this idempotency key came before with another observation: choose a new one"
                )
            if earlier is not None:
                raise _CountedBefore(earlier[0])
        if observation.landmark_models is not None:
            snapshot.check_landmark_model(observation.landmark_models)
        query = describe(snapshot, state.engine.evaluator, view)
        watch.lap("describe")
        traits = snapshot.relevance.traits
        encoding = query.encoding if traits.compares_encodings else None
        has_dissimilarities = encoding is None and traits.compares_dissimilarities
        row = ObservedRow(  # what the map's relevance compares, and no more
            sequence=state.sequence + 1,
            expires_at=expires_at,
            action_m=observation.action_m,
            action_std_m=observation.action_std_m,
            ranks=query.ranks,
            dissimilarities=query.dissimilarities if has_dissimilarities else None,
            encoding=encoding,
            idempotency=observation.idempotency,
        )
        return self._move_on(session, state, row, observation.n_shortlist, watch)

    def _move_on(
        self, session: LiveSession, previous: SessionState, row: JournalRow, n_shortlist: int | None, watch: Stopwatch
    ) -> "_Move":
        """The state after a row, which is written while the answer is summed up."""
        state = previous.next_state(row)
        if state.step is not None:
            watch.lap("plan", state.step.timings_ms)
        snapshot = None
        if previous.sequence > 0 and previous.sequence % self._snapshot_every == 0:
            # Of the state before the row, so that a restart replays at least the last row and has its whole step.
            snapshot = previous.snapshot()
        commit = self._store.append(session.record.number, row, self._clock(), snapshot)
        try:
            answer = view_of(session, row.expires_at, state, n_shortlist)
        except Exception as error:
            raise _NotSummedUp(commit) from error
        watch.lap("summarise")
        return _Move(state, answer, commit)

    async def _published(
        self, session: LiveSession, move_on: "Callable[[], _Move]", watch: Stopwatch, *, is_short: bool = False
    ) -> SessionView:
        """Move a session on by `move_on`; its answer, once the move is on the disk."""
        is_written = False
        try:
            move = await self._worker.computed(move_on, is_short=is_short)
            is_written = True
            await asyncio.wrap_future(move.commit)
        except _NotSummedUp as failure:
            session.state = None
            await asyncio.wrap_future(failure.commit)  # the row counts, and is there when the session is read again
            raise
        except BaseException as error:
            if is_written or not isinstance(error, DeepSimbadError | _CountedBefore):
                session.state = None  # what the file holds is the truth: it is read again at the next touch
            raise
        session.expires_at, session.state = move.answer.expires_at, move.state
        watch.lap("commit")
        return move.answer

    async def _repeated(
        self, session: LiveSession, state: SessionState, sequence: int, n_shortlist: int | None
    ) -> SessionView:
        """The answer to an observation counted before, computed again: the same journal leads to the same belief."""
        if state.sequence != sequence:
            async with self._repeating:  # a replay is long: many of them take turns
                snapshot = await asyncio.to_thread(self._store.snapshot_before, session.record.number, sequence)
                state = await replayed_until(
                    self._store,
                    self._worker,
                    session.record,
                    state.engine,
                    lambda row, _: row.sequence == sequence,
                    snapshot,
                )
        answer = await asyncio.wrap_future(
            self._summaries.submit(view_of, session, session.expires_at, state, n_shortlist)
        )
        return replace(answer, is_repeated=True)

    async def _set_prior(self, session: LiveSession, position_m: float, std_m: float) -> SessionView:
        async with session.lock:
            state = session.state or await self._state(session)
            check_prior(state.engine.snapshot.route, position_m, std_m)
            row = PriorRow(state.sequence + 1, self._clock() + self._ttl_s, position_m, std_m)
            watch = Stopwatch()
            return await self._published(session, lambda: self._move_on(session, state, row, None, watch), watch)

    # Ending

    async def _end(self, session: LiveSession, ending: str) -> None:
        """End a session after the change under way; raises EndedSessionError where it had ended before."""
        async with session.lock:
            if session.ending is not None:
                raise _ended_error(session.record.session_id, session.ending)
            await asyncio.wrap_future(self._store.end(session.record.number, ending, self._clock()))
            self._heed(session, await asyncio.to_thread(self._store.find, session.record.session_id))

    async def _expire(self) -> None:
        for session in list(self._living.values()):
            if session.ending is None and self._clock() >= session.expires_at and not session.lock.locked():
                await self._end(session, EXPIRED)

    # Tasks

    async def _finished(self, change: Coroutine[Any, Any, T]) -> T:
        task = asyncio.ensure_future(change)
        self._under_way.add(task)
        task.add_done_callback(self._under_way.discard)
        return await asyncio.shield(task)


class _CountedBefore(Exception):  # noqa: N818 - nobody's error
    """An observation came again; `sequence` is the number of its row."""

    def __init__(self, sequence: int) -> None:
        super().__init__()
        self.sequence = sequence


class _NotSummedUp(RuntimeError):  # noqa: N818 - as `_CountedBefore`
    """A session that moved cannot be summed up."""

    def __init__(self, commit: Future[None]) -> None:
        super().__init__("a session that moved cannot be summed up")
        self.commit = commit  # done when the row is on the disk


@dataclass(frozen=True)
class _Move:
    """A session moved on, whose row may still be on its way to the disk."""

    state: SessionState
    answer: SessionView
    commit: Future[None]  # done when the row is on the disk


def check_owner(record: SessionRecord, key_id: str | None) -> None:
    """Deny a session that has a key to every other key; raises UnknownSessionError. Without a key all are allowed."""
    if key_id is not None and record.key_id not in {None, key_id}:
        raise UnknownSessionError(f"there is no session {record.session_id!a}")


def _ended_error(session_id: str, ending: str) -> EndedSessionError:
    return EndedSessionError(f"session {session_id} has ended ({ending}): begin a new one", ending=ending)
