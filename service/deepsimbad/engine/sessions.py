"""The live sessions: each moves on in order of arrival, and nothing is answered before it is on the disk."""

import asyncio
import secrets
import time
from collections.abc import Callable, Container, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.planners import Plan
from deepsimbad.engine.active_maps import ActiveDomain
from deepsimbad.engine.live_session import LiveSession, Loaded, Observation
from deepsimbad.engine.localizer import describe, shortlist_length
from deepsimbad.engine.observation import View, encoding_ms
from deepsimbad.engine.pinned_maps import PinnedMaps
from deepsimbad.engine.replay import Replay
from deepsimbad.engine.session_config import SessionConfig, check_move, check_prior, check_start
from deepsimbad.engine.session_registry import DELETED, SessionRegistry
from deepsimbad.engine.session_state import SessionEngine
from deepsimbad.engine.session_view import SessionView, view_of
from deepsimbad.engine.stopwatch import Stopwatch
from deepsimbad.engine.worker import InferenceWorker
from deepsimbad.errors import EndedSessionError, IdempotencyKeyReusedError, InvalidInputError, UnavailableError
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.session_records import (
    IdempotencyKey,
    JournalRow,
    ListedSession,
    ObservedRow,
    PriorRow,
    SessionRecord,
)
from deepsimbad.store.sessions import SessionStore

T = TypeVar("T")


class Sessions:
    """All sessions of the service; used from one event loop.

    A change that was begun is finished even if its asker goes away: it may already be on the disk. One that fails
    leaves the session as it was.

    Args:
        store: Where they are kept.
        maps: What they are pinned to.
        worker: Where views are described and beliefs computed.
        ttl_s: A session ends when nothing happened to it for so long.
        max_sessions: How many may live at once.
        snapshot_every: Rows of a journal between two snapshots: how much is replayed after a start.
        keep_ended_s: An ended session is known, with what it saw, for so long.
        clock: Seconds since 1970.
    """

    def __init__(
        self,
        store: SessionStore,
        maps: PinnedMaps,
        worker: InferenceWorker,
        *,
        ttl_s: float,
        max_sessions: int,
        snapshot_every: int,
        keep_ended_s: float,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._store = store
        self._maps = maps
        self._worker = worker
        self._ttl_s = ttl_s
        self._snapshot_every = snapshot_every
        self._keep_ended_s = keep_ended_s
        self._clock = clock
        self._replay = Replay(store, worker)
        self._repeating = asyncio.Lock()
        self._summaries = ThreadPoolExecutor(1, "summaries")
        self._registry = SessionRegistry(store, maps, max_sessions, clock)
        self._under_way: set[asyncio.Task[Any]] = set()

    @property
    def n_living(self) -> int:
        """How many sessions have not ended, as far as is known without looking."""
        return self._registry.n_living

    def close(self) -> None:
        """End the thread of summaries."""
        self._summaries.shutdown()

    async def begin(self, active: ActiveDomain, config: SessionConfig, session_id: str | None = None) -> SessionView:
        """Begin a session on a domain's active map.

        Args:
            active: The domain and its map.
            config: How it begins.
            session_id: Its id, where a repetition of the request would have the same: the session that was begun by
                the first one is answered then, as it stands. None: a new one.

        Raises:
            InvalidInputError: The start or the configuration cannot be.
            TooManySessionsError: As many live as may.
            IdempotencyKeyReusedError: A session of that id was begun with another configuration.
            EndedSessionError: The session of that id has ended.
        """
        if session_id is not None and await self._registry.knows(session_id):
            return await self._begun_before(session_id, config)
        check_start(active.snapshot.route, config)
        return await self._finished(self._begin(active, config, session_id or secrets.token_hex(16)))

    async def observe(self, session_id: str, observation: Observation, watch: Stopwatch | None = None) -> SessionView:
        """Move a session on by a move and the view after it.

        Args:
            session_id: Which session.
            observation: What its robot reports.
            watch: Told of every stage. `wait` is for its turn: behind what came before it, and then for the worker.

        Raises:
            UnknownSessionError, EndedSessionError, RetiredMapError: There is no such session, or no more.
            InvalidInputError: The move, the view or the shortlist cannot be.
            LandmarkModelDiffersError: The view was ranked by another landmark model than that of the session's map.
            IdempotencyKeyReusedError: The key named another observation.
        """
        live = await self._registry.find(session_id)
        return await self._finished(self._observe(live, observation, watch or Stopwatch()))

    async def set_prior(self, session_id: str, position_m: float, std_m: float) -> SessionView:
        """Replace a session's belief by one around a position; raises InvalidPriorError."""
        live = await self._registry.find(session_id)
        return await self._finished(self._set_prior(live, position_m, std_m))

    async def view(self, session_id: str, n_shortlist: int | None = None) -> SessionView:
        """What a session believes now."""
        live, loaded = await self._read(session_id)
        return await self._summarised(session_id, live.expires_at, loaded, n_shortlist)

    async def mass(self, session_id: str) -> NDArray[np.float64]:
        """[n] mass of every map image in a session's belief; sums to 1."""
        _, loaded = await self._read(session_id)
        return await self._compute(lambda: loaded.state.belief.belief.mass)

    async def next_best_view(self, session_id: str) -> tuple[Plan | None, NDArray[np.float64]]:
        """The move to make next, without a new view (None where the map can name none), and the moves there are."""
        _, loaded = await self._read(session_id)
        engine, state = loaded.engine, loaded.state
        if state.step is not None:
            return state.step.plan, engine.snapshot.actions_m
        return await self._compute(lambda: engine.localizer.plan(state.belief)), engine.snapshot.actions_m

    async def newest(self, domain: str | None, before: int | None, limit: int) -> ListPage[ListedSession, int]:
        """A page of the living sessions, of a domain or all, newest first, behind number `before`."""
        return await asyncio.to_thread(self._store.newest_living, domain, before, limit, self._clock())

    async def end(self, session_id: str) -> None:
        """End a session."""
        await self._finished(self._registry.end(await self._registry.find(session_id), DELETED))

    async def end_domain(self, domain: str) -> None:
        """End the sessions of a domain that was deleted."""
        for live in self._registry.of_domain(domain):
            if live.ending is None:
                with suppress(EndedSessionError):  # its robot was quicker
                    await self._finished(self._registry.end(live, DELETED))

    async def end_strangers(self, domains: Container[str]) -> None:
        """End the sessions of no domain there is: a command beside the service may have deleted theirs."""
        for domain in self._registry.domains():
            if domain not in domains:
                await self.end_domain(domain)

    async def sweep(self) -> None:
        """End what has expired, and forget what ended long ago."""
        await self._finished(self._registry.expire())
        await self._finished(self._registry.purge(self._keep_ended_s))

    async def _begun_before(self, session_id: str, config: SessionConfig) -> SessionView:
        live = await self._registry.find(session_id)
        if live.record.config != config.as_dict():
            raise IdempotencyKeyReusedError(
                "this idempotency key began a session with another configuration: choose a new one"
            )
        return await self.view(session_id)

    async def _begin(self, active: ActiveDomain, config: SessionConfig, session_id: str) -> SessionView:
        await self._registry.reserve()
        begun = None
        try:
            with self._maps.beginning(active.snapshot):
                digest, evaluator = await asyncio.to_thread(self._maps.pin, active)
                snapshot, now = active.snapshot, self._clock()
                expires_at = now + self._ttl_s

                def start() -> Loaded:
                    engine = SessionEngine.of(config, snapshot, evaluator)
                    return Loaded(engine, engine.start())

                loaded = await self._compute(start)
                told = self._summarised(session_id, expires_at, loaded)
                new = SessionRecord(
                    0, session_id, snapshot.domain, snapshot.version, digest, config.as_dict(), now, expires_at, 0, None
                )
                kept = await asyncio.wrap_future(self._store.create(new))
            if replace(kept, number=0) == new:
                begun = LiveSession(kept, expires_at, loaded)
            answer = await told
        finally:
            self._registry.settle(begun)
        # Else the same request was on its way twice, and the other one was quicker.
        return answer if begun is not None else await self._begun_before(session_id, config)

    async def _observe(self, live: LiveSession, observation: Observation, watch: Stopwatch) -> SessionView:
        """Everything in order under the session's lock: describe, compute, write, publish."""
        async with live.lock:
            loaded = await self._registry.loaded(live)
            shortlist_length(loaded.engine.snapshot, observation.n_shortlist)  # a bad one should not move the session
            check_move(loaded.engine.snapshot, observation.action_m, observation.action_std_m)
            watch.lap("wait")
            stepped = await self._looked(live, loaded, observation, watch)
            if isinstance(stepped, int):
                answer = await self._repeated(live, loaded, stepped, observation.n_shortlist)
                watch.lap("summarise")
                return answer
            row, moved_on = stepped
            told = self._summarised(live.session_id, row.expires_at, moved_on, observation.n_shortlist)
            await self._commit(live, loaded, row, moved_on)  # the disk and the summary take their time together
            watch.lap("commit")
            answer = await told
            watch.lap("summarise")  # what it took beyond the disk
            return answer

    async def _looked(
        self, live: LiveSession, loaded: Loaded, observation: Observation, watch: Stopwatch
    ) -> tuple[ObservedRow, Loaded] | int:
        """As `_step`, of a view that is still to be decoded and encoded."""
        evaluator = loaded.engine.evaluator
        view = await observation.view(evaluator)
        watch.lap("decode")
        expires_at = self._clock() + self._ttl_s

        def step(seen: View) -> tuple[ObservedRow, Loaded] | int:
            return self._step(live, loaded, observation, seen, expires_at, watch)

        return await asyncio.wrap_future(self._worker.look(evaluator, view, step))

    def _step(
        self,
        live: LiveSession,
        loaded: Loaded,
        observation: Observation,
        view: View,
        expires_at: float,
        watch: Stopwatch,
    ) -> tuple[ObservedRow, Loaded] | int:
        """The next row and what it leads to; or the row's number, if the observation was counted before."""
        watch.lap("wait", **encoding_ms(view))
        named = observation.idempotency
        if named is not None and (earlier := self._counted_before(live, named)) is not None:
            return earlier
        engine = loaded.engine
        engine.snapshot.check_landmark_model(observation.landmark_models)
        query = describe(engine.snapshot, engine.evaluator, view)
        watch.lap("describe")
        row = engine.row_of(
            query, loaded.state.sequence + 1, expires_at, observation.action_m, observation.action_std_m, named
        )
        state = engine.applied(loaded.state, row)
        if state.step is not None:
            watch.take(state.step.timings_ms)
        return row, Loaded(engine, state)

    def _counted_before(self, live: LiveSession, named: IdempotencyKey) -> int | None:
        found = self._store.named(live.record.number, named.key)
        if found is None:
            return None
        sequence, digest = found
        if digest != named.digest:
            raise IdempotencyKeyReusedError(
                "this idempotency key came before with another observation: choose a new one"
            )
        return sequence

    async def _repeated(self, live: LiveSession, loaded: Loaded, sequence: int, n_shortlist: int | None) -> SessionView:
        """The answer that an observation had; computed again, since the same journal leads to the same belief."""
        if loaded.state.sequence != sequence:
            async with self._repeating:  # a replay is long: many of them take turns
                snapshot = await asyncio.to_thread(self._store.snapshot_before, live.record.number, sequence)
                state = await self._replay.until(
                    live.record, loaded.engine, lambda row, _: row.sequence == sequence, snapshot
                )
            loaded = Loaded(loaded.engine, state)
        answer = await self._summarised(live.session_id, live.expires_at, loaded, n_shortlist)
        return replace(answer, is_repeated=True)

    async def _set_prior(self, live: LiveSession, position_m: float, std_m: float) -> SessionView:
        async with live.lock:
            loaded = await self._registry.loaded(live)
            check_prior(loaded.engine.snapshot.route, position_m, std_m)
            row = PriorRow(loaded.state.sequence + 1, self._clock() + self._ttl_s, position_m, std_m)
            state = await self._compute(lambda: loaded.engine.applied(loaded.state, row))
            moved_on = Loaded(loaded.engine, state)
            told = self._summarised(live.session_id, row.expires_at, moved_on)
            await self._commit(live, loaded, row, moved_on)
            return await told

    async def _commit(self, live: LiveSession, before: Loaded, row: JournalRow, after: Loaded) -> None:
        """Write a row, then publish what it leads to."""
        snapshot = None
        if before.state.sequence > 0 and before.state.sequence % self._snapshot_every == 0:
            # Of the state before the row, so that a restart replays at least the last row and has its whole step.
            snapshot = before.engine.snapshot_of(before.state)
        try:
            await asyncio.wrap_future(self._store.append(live.record.number, row, self._clock(), snapshot))
        except BaseException as error:
            live.loaded = None  # what the file holds is the truth: it is read again at the next touch
            if isinstance(error, InvalidInputError):
                raise UnavailableError("another process moved this session on: try again") from error
            raise
        live.expires_at, live.loaded = row.expires_at, after

    async def _read(self, session_id: str) -> tuple[LiveSession, Loaded]:
        live = await self._registry.find(session_id)
        if live.loaded is not None:
            return live, live.loaded
        async with live.lock:
            return live, await self._registry.loaded(live)

    def _summarised(
        self, session_id: str, expires_at: float, loaded: Loaded, n_shortlist: int | None = None
    ) -> asyncio.Future[SessionView]:
        """A summary to come, from a thread of its own: what only reads should not keep a robot's next step waiting."""
        return asyncio.wrap_future(
            self._summaries.submit(view_of, session_id, expires_at, loaded.engine, loaded.state, n_shortlist)
        )

    async def _compute(self, run: Callable[[], T]) -> T:
        return await asyncio.wrap_future(self._worker.submit(run))

    async def _finished(self, change: Coroutine[Any, Any, T]) -> T:
        task = asyncio.ensure_future(change)
        self._under_way.add(task)
        task.add_done_callback(self._under_way.discard)
        return await asyncio.shield(task)
