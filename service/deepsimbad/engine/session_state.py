"""One session's belief, and how every row of its journal moves it on: live and after a restart by the same function."""

from collections.abc import Sequence
from dataclasses import dataclass

from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.engine.active_localizer import ActiveLocalizer, LocalizerState, Step
from deepsimbad.engine.session_config import SessionConfig
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import DamagedFileError, DeepSimbadError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.session_records import IdempotencyKey, JournalRow, ObservedRow, PriorRow, StateSnapshot


@dataclass(frozen=True)
class SessionState:
    """What a session believes after a row of its journal. Immutable, so it is read without a lock.

    Attributes:
        sequence: That row's number; 0 before any.
        belief: The algorithm's state.
        step: The algorithm's step, where that row was an observation.
    """

    sequence: int
    belief: LocalizerState
    step: Step | None = None


@dataclass(frozen=True)
class SessionEngine:
    """What moves one session on.

    Attributes:
        config: What the session was begun with.
        snapshot: The map that it is pinned to.
        evaluator: The domain's.
        localizer: The algorithm on that map.
    """

    config: SessionConfig
    snapshot: MapSnapshot
    evaluator: Evaluator
    localizer: ActiveLocalizer

    @classmethod
    def of(cls, config: SessionConfig, snapshot: MapSnapshot, evaluator: Evaluator) -> "SessionEngine":
        """The engine of a session; raises InvalidInputError where the configuration cannot be."""
        return cls(config, snapshot, evaluator, ActiveLocalizer(snapshot, config.localizer_config()))

    def start(self) -> SessionState:
        """The state before anything has happened."""
        return SessionState(0, self.localizer.start(self.config.start_position_m, self.config.start_std_m))

    def row_of(
        self,
        query: Query,
        sequence: int,
        expires_at: float,
        action_m: float,
        action_std_m: float | None,
        idempotency: IdempotencyKey | None = None,
    ) -> ObservedRow:
        """The journal's form of a described view: what the map's relevance compares, and no more."""
        relevance = self.snapshot.retrieval.relevance
        return ObservedRow(
            sequence=sequence,
            expires_at=expires_at,
            action_m=action_m,
            action_std_m=action_std_m,
            ranks=query.ranks,
            dissimilarities=query.dissimilarities if relevance is Relevance.SIMBAD else None,
            encoding=query.encoding if relevance is Relevance.BRUTE_FORCE else None,
            idempotency=idempotency,
        )

    def applied(self, state: SessionState, row: JournalRow) -> SessionState:
        """The state after one more row.

        Raises:
            InvalidInputError: The row cannot follow (a move past the end, a view that the map cannot compare).
        """
        if isinstance(row, PriorRow):
            belief = self.localizer.with_prior(state.belief, row.position_m, row.std_m)
            return SessionState(row.sequence, belief)
        query = Query(row.ranks, row.dissimilarities, row.encoding)
        step = self.localizer.step(state.belief, query, row.action_m, row.action_std_m)
        return SessionState(row.sequence, step.state, step)

    def followed(self, state: SessionState, row: JournalRow) -> SessionState:
        """The state after the next row of a journal, which could follow when it was written.

        Raises:
            DamagedFileError: It is not the next one, or cannot be of this session.
        """
        if row.sequence != state.sequence + 1:
            raise DamagedFileError(f"row {state.sequence + 1} of a session's journal is missing")
        try:
            return self.applied(state, row)
        except (DeepSimbadError, KeyError, TypeError, ValueError, IndexError) as error:
            raise DamagedFileError(f"a session's journal cannot be followed: {error}") from error

    def replayed(self, snapshot: StateSnapshot | None, rows: Sequence[JournalRow]) -> SessionState:
        """The state that a journal leads to; the same bits as when it was written.

        Raises:
            DamagedFileError: The journal cannot be of this session.
        """
        try:
            state = self.start()
            if snapshot is not None:
                state = SessionState(snapshot.sequence, self.localizer.from_arrays(snapshot.arrays))
            for row in rows:
                state = self.followed(state, row)
        except DamagedFileError:
            raise
        except (DeepSimbadError, KeyError, TypeError, ValueError, IndexError) as error:
            raise DamagedFileError(f"a session's journal cannot be followed: {error}") from error
        return state

    def snapshot_of(self, state: SessionState) -> StateSnapshot:
        """A state in the store's form."""
        return StateSnapshot(state.sequence, self.localizer.to_arrays(state.belief))
