"""What happens to a session, told as it happens or from any earlier moment on: its journal, read like a log file."""

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

    async def follow(self, record: SessionRecord, after: int | None) -> AsyncIterator[SessionEvent | None]:
        """Every event behind row `after`, then every new one until the session ends; None now and then, for none.

        What has passed is computed again, behind every live view: the same journal leads to the same beliefs.

        Args:
            record: The session.
            after: None: the last event that there was, and what follows.

        Raises:
            RetiredMapError: The session's map is no more.
            DamagedMapError, DamagedFileError: One of them cannot be read.
        """
        engine = await asyncio.to_thread(self._sessions.engine_of, record)
        first = record.n_events if after is None else after + 1  # to be told of
        snapshot = await asyncio.to_thread(self._store.snapshot_before, record.number, first)
        state = await self._worked(partial(SessionState.restored, engine, snapshot))
        while True:
            live = self._sessions.living(record.session_id)
            latest = None if live is None else live.state
            rows: list[JournalRow] = []
            if live is not None and latest is not None and latest.sequence == state.sequence + 1 >= first:
                state = latest
                yield await self._told(record, state, live.expires_at)
                continue
            if latest is None or latest.sequence != state.sequence:
                span = (record.number, state.sequence, state.sequence + _ROWS_AT_ONCE)
                rows = await asyncio.to_thread(self._store.journal, *span)
            for row in rows:
                state = await self._worked(partial(state.followed, row))
                if row.sequence >= first:
                    yield await self._told(record, state, row.expires_at)
            if rows:
                continue
            if live is None:
                return
            yield None
            await asyncio.sleep(_GLANCE_S if latest is not None else self._poll_s)

    async def _told(self, record: SessionRecord, state: SessionState, expires_at: float) -> SessionEvent:
        view = await asyncio.to_thread(view_of, LiveSession(record, expires_at), expires_at, state)
        return SessionEvent(state.sequence, view, state.step is not None)

    async def _worked(self, compute: Callable[[], SessionState]) -> SessionState:
        return await asyncio.wrap_future(self._worker.submit(compute, Priority.BATCH))
