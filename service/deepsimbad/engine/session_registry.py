"""Which sessions live, and how their states come back from the disk at first touch."""

import asyncio
import math
from collections.abc import Callable

from deepsimbad.engine.live_session import LiveSession, Loaded, ended
from deepsimbad.engine.pinned_maps import PinnedMaps
from deepsimbad.engine.session_config import SessionConfig
from deepsimbad.engine.session_state import SessionEngine
from deepsimbad.errors import DamagedFileError, TooManySessionsError, UnknownSessionError
from deepsimbad.store.session_records import SessionRecord
from deepsimbad.store.sessions import SessionStore

DELETED, EXPIRED = "deleted", "expired"
_LONGEST_RETRY_S = 60


class SessionRegistry:
    """The sessions that have not ended; used from one event loop.

    Args:
        store: Where they are kept.
        maps: What they are pinned to.
        max_sessions: How many may live at once.
        clock: Seconds since 1970.
    """

    def __init__(self, store: SessionStore, maps: PinnedMaps, max_sessions: int, clock: Callable[[], float]) -> None:
        self._store = store
        self._maps = maps
        self._max_sessions = max_sessions
        self._clock = clock
        self._n_reserved = 0
        # Only who they are: a start takes no longer for many sessions.
        self._living = {record.session_id: _living(record) for record in store.living()}

    @property
    def n_living(self) -> int:
        """How many sessions have not ended, as far as is known without looking."""
        return len(self._living)

    def domains(self) -> set[str]:
        """The domains that living sessions are of."""
        return {live.record.domain for live in self._living.values()}

    def of_domain(self, domain: str) -> list[LiveSession]:
        """The living sessions of a domain."""
        return [live for live in self._living.values() if live.record.domain == domain]

    async def reserve(self) -> None:
        """Make room for one session more; `settle` ends the reservation.

        Raises:
            TooManySessionsError: As many live as may.
        """
        if self._is_full:
            await self.expire()
        if self._is_full:
            soonest_s = min((live.expires_at for live in self._living.values()), default=0.0) - self._clock()
            raise TooManySessionsError(
                f"{self._max_sessions} sessions live, and no more may: delete one that is done with, or wait",
                max_sessions=self._max_sessions,
                retry_after_s=max(1, min(_LONGEST_RETRY_S, math.ceil(soonest_s))),
            )
        self._n_reserved += 1

    def settle(self, live: LiveSession | None) -> None:
        """Put a session in the room made for it, or give the room back."""
        self._n_reserved -= 1
        if live is not None:
            self._living.setdefault(live.session_id, live)  # a repeated request may have found it on the disk already

    @property
    def _is_full(self) -> bool:
        return len(self._living) + self._n_reserved >= self._max_sessions

    async def knows(self, session_id: str) -> bool:
        """Whether there is a session of that id, or was one lately."""
        try:
            return session_id in self._living or bool(await asyncio.to_thread(self._store.find, session_id))
        except UnknownSessionError:
            return False

    async def find(self, session_id: str) -> LiveSession:
        """A living session.

        Raises:
            UnknownSessionError: There is none of that id.
            EndedSessionError: It has been deleted, or has expired.
        """
        live = self._living.get(session_id)
        if live is None:
            record = await asyncio.to_thread(self._store.find, session_id)
            if record.ending is not None:
                raise ended(session_id, record.ending)
            live = self._living.setdefault(session_id, _living(record))  # another process began it
        if self.is_due(live):
            await self.end(live, EXPIRED)
        if live.ending is not None:
            raise ended(session_id, live.ending)
        return live

    async def loaded(self, live: LiveSession) -> Loaded:
        """What a session answers from, read from the disk where need be; the caller holds the session's lock.

        Raises:
            EndedSessionError: It ended while the caller waited.
            RetiredMapError: Its map is no more.
            DamagedMapError, DamagedFileError: The map or the session cannot be read.
        """
        if live.ending is not None:
            raise ended(live.session_id, live.ending)
        if live.loaded is None:
            live.loaded = await asyncio.to_thread(self._restored, live.record)
        return live.loaded

    def _restored(self, record: SessionRecord) -> Loaded:
        """A session as its journal tells; reads files."""
        engine = engine_of(record, self._maps)
        last = self._store.find(record.session_id).n_events
        return Loaded(engine, engine.replayed(*self._store.history(record.number, last)))

    def is_due(self, live: LiveSession) -> bool:
        """Whether nothing happened to a session for too long, and nothing is happening now."""
        return self._clock() >= live.expires_at and not live.lock.locked()

    async def end(self, live: LiveSession, ending: str) -> None:
        """End a session, once what it is doing is done.

        Raises:
            EndedSessionError: It had ended before.
        """
        async with live.lock:
            if live.ending is not None:
                raise ended(live.session_id, live.ending)
            has_ended = await asyncio.wrap_future(self._store.end(live.record.number, ending, self._clock()))
            live.loaded = None
            if has_ended:
                live.ending = ending
            else:  # another process ended it, or moved it on
                record = await asyncio.to_thread(self._store.find, live.session_id)
                live.ending, live.expires_at = record.ending, record.expires_at
            if live.ending is not None:
                self._living.pop(live.session_id, None)

    async def expire(self) -> None:
        """End what has expired."""
        for live in [live for live in self._living.values() if self.is_due(live)]:
            if self.is_due(live) and live.ending is None:  # neither moved on nor ended since the list was made
                await self.end(live, EXPIRED)

    async def purge(self, kept_s: float) -> None:
        """Forget what ended longer ago than this."""
        while await asyncio.wrap_future(self._store.purge(self._clock() - kept_s)):
            pass


def engine_of(record: SessionRecord, maps: PinnedMaps) -> SessionEngine:
    """What moves a session on, whether it lives or has ended; may read files.

    Raises:
        RetiredMapError: Its map is no more.
        DamagedMapError, DamagedFileError: The map or the session cannot be read.
    """
    snapshot, evaluator = maps.take(record.domain, record.map_version, record.map_sha256)
    try:
        config = SessionConfig.from_dict(record.config)
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedFileError(f"session {record.session_id} cannot be read: {error}") from error
    return SessionEngine.of(config, snapshot, evaluator)


def _living(record: SessionRecord) -> LiveSession:
    return LiveSession(record, record.expires_at)
