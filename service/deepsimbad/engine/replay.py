"""Sessions followed once more through their journals, in short pieces behind every live view."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TypeVar

from deepsimbad.engine.session_state import SessionEngine, SessionState
from deepsimbad.engine.worker import InferenceWorker, Priority
from deepsimbad.errors import UnknownSessionError
from deepsimbad.store.session_records import JournalRow, SessionRecord, StateSnapshot
from deepsimbad.store.sessions import SessionStore

T = TypeVar("T")
IsLast = Callable[[JournalRow, SessionState], bool]

_ROWS_AT_ONCE = 64  # of a journal in memory: 130 kB with 500 landmarks
_PIECE_S = 0.01  # a live view waits no longer for a replay than this and one step


class Replay:
    """Replays sessions on the inference worker; used from an event loop.

    A replay takes as long as the session's observations took, but in short pieces behind every live view, and holds a
    few rows of the journal at a time.

    Args:
        store: The sessions.
        worker: Where beliefs are computed.
    """

    def __init__(self, store: SessionStore, worker: InferenceWorker) -> None:
        self._store = store
        self._worker = worker

    async def until(
        self, record: SessionRecord, engine: SessionEngine, is_last: IsLast, snapshot: StateSnapshot | None = None
    ) -> SessionState:
        """The state after the first row that is the last one wanted.

        Args:
            record: The session.
            engine: What moves it on.
            is_last: Told on the worker of every row and the state after it; whether that is the last one wanted.
            snapshot: Where to begin; None: before anything happened.

        Raises:
            UnknownSessionError: The journal ends before; it was purged meanwhile.
            DamagedFileError: The journal cannot be of this session.
        """
        state = await self._compute(lambda: engine.replayed(snapshot, ()))
        while True:
            after = state.sequence
            rows = await asyncio.to_thread(self._store.journal_part, record.number, after, after + _ROWS_AT_ONCE)
            if not rows:
                raise UnknownSessionError(f"there is no session {record.session_id!a}")
            while rows:
                state, n_rows, is_done = await self._compute(_Piece(engine, state, rows, is_last).run)
                if is_done:
                    return state
                rows = rows[n_rows:]

    async def _compute(self, run: Callable[[], T]) -> T:
        return await asyncio.wrap_future(self._worker.submit(run, Priority.BATCH))


@dataclass(frozen=True)
class _Piece:
    """As many rows of a replay as fit into one turn of the worker; each is computed exactly as it was live."""

    engine: SessionEngine
    state: SessionState
    rows: Sequence[JournalRow]
    is_last: IsLast

    def run(self) -> tuple[SessionState, int, bool]:
        """The state after the last row done, how many rows were, and whether that is the last one wanted."""
        began = perf_counter()
        state, n_rows = self.state, 0
        for row in self.rows:
            state = self.engine.followed(state, row)
            n_rows += 1
            if self.is_last(row, state):
                return state, n_rows, True
            if perf_counter() - began > _PIECE_S:
                break
        return state, n_rows, False
