"""A session's events, as they happen or from any earlier moment on: its journal, read like a log file."""

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from functools import partial

from deepsimbad.engine.session import LiveSession, SessionState, SessionView, view_of
from deepsimbad.engine.sessions import Sessions, check_owner
from deepsimbad.engine.worker import InferenceWorker, Priority
from deepsimbad.store.sessions import JournalRow, SessionRecord, SessionStore

_ROWS_AT_ONCE = 64
_GLANCE_S = 0.05  # between looks at what a living session believes, which is in memory


@dataclass(frozen=True)
class SessionEvent:
    """One row of a session's journal, and what the session believed after it."""

    sequence: int  # of the row, from 1
    view: SessionView
    is_observation: bool  # else somebody said where the robot is


class SessionEvents:
    """Follows sessions, living ones and those that ended and are still known; used from an event loop."""

    def __init__(self, store: SessionStore, worker: InferenceWorker, sessions: Sessions, poll_s: float) -> None:
        self._store = store
        self._worker = worker
        self._sessions = sessions
        self._poll_s = poll_s

    def find(self, session_id: str, key_id: str | None) -> SessionRecord:
        """A session, ended ones too; raises UnknownSessionError where there is none, or it is another key's."""
        record = self._store.find(session_id)
        check_owner(record, key_id)
        return record

    async def follow(self, record: SessionRecord, after_sequence: int | None) -> AsyncIterator[SessionEvent | None]:
        """Every event behind row `after_sequence`, then every new one until the session ends; None while none comes.

        Past events are computed again, behind every live view: the same journal leads to the same beliefs.

        Args:
            record: The session.
            after_sequence: Number of a row; None: the one before the last, so that the last event comes first.

        Raises:
            RetiredMapError: The session's map is no more.
            DamagedMapError, DamagedFileError: One of them cannot be read.
        """
        engine = await asyncio.to_thread(self._sessions.engine_of, record)
        first = record.n_events if after_sequence is None else after_sequence + 1  # row whose event is yielded
        snapshot = await asyncio.to_thread(self._store.snapshot_before, record.number, first)
        state = await self._computed(partial(SessionState.restored, engine, snapshot))
        while True:
            session = self._sessions.living(record.session_id)
            live_state = None if session is None else session.state
            rows: list[JournalRow] = []
            if session is not None and live_state is not None and live_state.sequence == state.sequence + 1 >= first:
                state = live_state
                yield await self._event(record, state, session.expires_at)
                continue
            if live_state is None or live_state.sequence != state.sequence:
                span = (record.number, state.sequence, state.sequence + _ROWS_AT_ONCE)
                rows = await asyncio.to_thread(self._store.journal, *span)
            for row in rows:
                state = await self._computed(partial(state.followed, row))
                if row.sequence >= first:
                    yield await self._event(record, state, row.expires_at)
            if rows:
                continue
            if session is None:
                return
            yield None
            await asyncio.sleep(_GLANCE_S if live_state is not None else self._poll_s)

    async def _event(self, record: SessionRecord, state: SessionState, expires_at: float) -> SessionEvent:
        view = await asyncio.to_thread(view_of, LiveSession(record, expires_at), expires_at, state)
        return SessionEvent(state.sequence, view, state.step is not None)

    async def _computed(self, compute: Callable[[], SessionState]) -> SessionState:
        return await asyncio.wrap_future(self._worker.submit(compute, Priority.BATCH))
