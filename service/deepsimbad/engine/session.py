"""One session: its configuration, its belief, and how every row of its journal moves it on.

The same function moves it on live and after a restart, so a journal leads to the same bits.
"""

import asyncio
import hashlib
import math
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.motion import SIGMAS, motion_std_m
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.belief.summary import DEFAULT_CONFIDENCE, BeliefSummary, summarise
from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig, LocalizerState, Step
from deepsimbad.core.map import Map
from deepsimbad.core.planners import Plan
from deepsimbad.core.relevance import Query, UpdateRule
from deepsimbad.core.route import Route
from deepsimbad.engine.localizer import View, shortlist_length
from deepsimbad.engine.worker import InferenceWorker, Priority
from deepsimbad.errors import (
    DamagedFileError,
    DeepSimbadError,
    InvalidMoveError,
    InvalidPriorError,
    UnknownSessionError,
)
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.sessions import IdempotencyKey, JournalRow, PriorRow, SessionRecord, SessionStore, StateSnapshot

DEFAULT_START_STD_M = 5.0
_LONGEST_MOVE_ACTIONS = 10.0  # a robot may report a move of up to so many of the domain's longest action
_SLACK_STDS = 3.0  # a prior may lie beyond the route by so many of its deviations
_LARGEST_STD_M = 1e6
_ROWS_AT_ONCE = 64  # of a journal in memory: 130 kB with 500 landmarks
_PIECE_S = 0.01  # a live view waits no longer for a replay than this and one step
DOMAIN_DIGITS = 8  # of a session's id


def domain_digits(domain: str) -> str:
    """The digits that stand for a domain in the ids of its sessions, so that an id alone tells which domain to ask."""
    return hashlib.sha256(domain.encode("utf-8", "surrogatepass")).hexdigest()[:DOMAIN_DIGITS]


@dataclass(frozen=True)
class SessionConfig:
    """How a session begins and goes on; kept with it."""

    start_position_m: float | None = None  # None: anywhere on the route
    start_std_m: float = DEFAULT_START_STD_M
    seed: int = 0  # of whatever is random in it
    planner: str | None = None  # by name; None: the default
    belief: FilterKind = FilterKind.GRID
    update: UpdateRule | None = None  # how a view counts; None: as the map's relevance wants
    confidence: float = DEFAULT_CONFIDENCE  # of the mass within 5 m of the mode, from which on it may stop
    price_bits_per_m: float = 0.0  # of moving, to the planner

    def as_dict(self) -> dict[str, Any]:
        """The configuration as JSON-ready values by name."""
        return asdict(self)

    @classmethod
    def from_dict(cls, document: dict[str, Any]) -> Self:
        """The configuration of which `as_dict` made the document."""
        update = document["update"]
        enums = {"belief": FilterKind(document["belief"]), "update": None if update is None else UpdateRule(update)}
        return cls(**{**document, **enums})


@dataclass(frozen=True)
class Observation:
    """A move and the view after it, as a robot reports them."""

    # Decodes the view for an evaluator and a map, and makes remarks on it for a person; called in the session's turn,
    # in order of arrival
    view: Callable[[Evaluator, Map], Awaitable[tuple[View, Sequence[str]]]]
    action_m: float = 0.0  # metres moved since the last view; ignored for the first one
    action_std_m: float | None = None  # None: that of usual odometry
    n_shortlist: int | None = None  # length of the answer's lists; None: the default
    idempotency: IdempotencyKey | None = None  # by which a repetition is recognised; None: it is not
    landmark_models: frozenset[str] | None = None  # digests, one of which the map must have; None: any will do

    def check(self, snapshot: Map) -> None:
        """Refuse a shortlist or a move that is impossible on a map; a move backward within its error is allowed.

        Raises:
            InvalidInputError: The shortlist is longer than the map.
            InvalidMoveError: The move or its deviation is NaN, or farther than a robot of the domain moves.
        """
        shortlist_length(snapshot, self.n_shortlist)
        action_m, std_m, longest_m = self.action_m, self.action_std_m, _LONGEST_MOVE_ACTIONS * snapshot.longest_action_m
        if std_m is not None and not (math.isfinite(std_m) and 0 <= std_m <= longest_m):
            raise InvalidMoveError(f"action_std_m is {std_m}: give metres from 0 to {longest_m:g}")
        least_m = within_error_m = -longest_m if snapshot.goes_backward else 0.0
        if math.isfinite(action_m) and not snapshot.goes_backward:
            within_error_m = -SIGMAS * (motion_std_m(action_m) if std_m is None else std_m)
        if not (math.isfinite(action_m) and within_error_m <= action_m <= longest_m):
            raise InvalidMoveError(
                f"action_m is {action_m}: give metres from {least_m:g} to {longest_m:g}, ten of the longest action",
                minimum=least_m,
                maximum=longest_m,
            )


@dataclass(frozen=True)
class SessionEngine:
    """All that is needed to move one session on."""

    config: SessionConfig
    snapshot: Map
    evaluator: Evaluator  # of its domain

    @cached_property
    def localizer(self) -> ActiveLocalizer:
        """The algorithm; raises InvalidInputError where the configuration does not fit the map."""
        config = self.config
        algorithm = LocalizerConfig(
            filter=config.belief,
            update=config.update,
            planner=config.planner,
            seed=config.seed,
            price_bits_per_m=config.price_bits_per_m,
        )
        return ActiveLocalizer(self.snapshot, algorithm, perf_counter)


@dataclass(frozen=True)
class SessionState:
    """A session's belief after a row of its journal; immutable, published by one assignment, read with no lock."""

    engine: SessionEngine  # moves it on
    sequence: int  # that row's number; 0 before any
    belief: LocalizerState
    step: Step | None = None  # where that row was an observation

    @classmethod
    def start(cls, engine: SessionEngine) -> Self:
        """The state before the first row."""
        return cls(engine, 0, engine.localizer.start(engine.config.start_position_m, engine.config.start_std_m))

    def next_state(self, row: JournalRow) -> "SessionState":
        """The state after one more row; raises InvalidInputError."""
        if isinstance(row, PriorRow):
            belief = self.engine.localizer.with_prior(self.belief, row.position_m, row.std_m)
            return SessionState(self.engine, row.sequence, belief)
        query = Query(row.ranks, row.dissimilarities, row.encoding)
        step = self.engine.localizer.step(self.belief, query, row.action_m, row.action_std_m)
        return SessionState(self.engine, row.sequence, step.state, step)

    def snapshot(self) -> StateSnapshot:
        """The state as the store keeps it."""
        return StateSnapshot(self.sequence, self.engine.localizer.to_arrays(self.belief))

    @classmethod
    def restored(cls, engine: SessionEngine, snapshot: StateSnapshot | None) -> Self:
        """The state of which `snapshot` was made; None: the state before the first row. Raises DamagedFileError."""
        with _journal_faults():
            if snapshot is None:
                return cls.start(engine)
            try:
                return cls(engine, snapshot.sequence, engine.localizer.from_arrays(snapshot.arrays))
            except KeyError:  # written by an earlier release: the journal is followed from its beginning
                return cls.start(engine)

    def followed(self, row: JournalRow) -> "SessionState":
        """The state after the journal's next row, the same bits as when it was written; raises DamagedFileError."""
        if row.sequence != self.sequence + 1:
            raise DamagedFileError(f"row {self.sequence + 1} of a session's journal is missing")
        with _journal_faults():
            return self.next_state(row)


@contextmanager
def _journal_faults() -> Iterator[None]:
    try:
        yield
    except DamagedFileError:
        raise
    except (DeepSimbadError, KeyError, TypeError, ValueError, IndexError) as error:
        raise DamagedFileError(f"a session's journal cannot be followed: {error}") from error


async def replayed_until(
    store: SessionStore,
    worker: InferenceWorker,
    record: SessionRecord,
    engine: SessionEngine,
    is_last: Callable[[JournalRow, SessionState], bool],
    snapshot: StateSnapshot | None = None,
) -> SessionState:
    """A session's state after the first row for which `is_last` holds, computed behind every live view.

    It takes as long as the observations took, but in short pieces, with a few rows of the journal in memory at a time.

    Args:
        is_last: Called on the worker with every row and the state after it.
        snapshot: The state to begin from; None: the one before the first row.

    Raises:
        UnknownSessionError: The journal ends before such a row; it was purged meanwhile.
        DamagedFileError: The journal does not fit the session.
    """
    state = await asyncio.wrap_future(worker.submit(lambda: SessionState.restored(engine, snapshot), Priority.BATCH))
    is_done = False

    def piece(rows: Iterator[JournalRow]) -> None:
        nonlocal state, is_done
        start_s = perf_counter()
        for row in rows:
            state = state.followed(row)
            is_done = is_last(row, state)
            if is_done or perf_counter() - start_s > _PIECE_S:
                break

    while not is_done:
        sequence = state.sequence
        rows = await asyncio.to_thread(store.journal, record.number, sequence, sequence + _ROWS_AT_ONCE)
        if not rows:
            raise UnknownSessionError(f"there is no session {record.session_id!a}")
        run = partial(piece, iter(rows))
        while not is_done and state.sequence < rows[-1].sequence:
            await asyncio.wrap_future(worker.submit(run, Priority.BATCH))
    return state


@dataclass
class LiveSession:
    """A session that has not ended; touched from the event loop alone."""

    record: SessionRecord  # its row as it began
    expires_at: float  # unless something happens to it; seconds since 1970
    state: SessionState | None = None  # what answers, once it is on the disk; None until first needed after a start
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)  # of whoever moves it on; first come, first served
    ending: str | None = None  # how it ended; whoever waited for the lock meanwhile comes too late


@dataclass(frozen=True)
class SessionView:
    """A session as of one row of its journal."""

    session_id: str
    expires_at: float  # unless something happens to it; seconds since 1970
    snapshot: Map  # the map it is pinned to
    n_observations: int  # of which its belief is made
    belief: BeliefSummary
    plan: Plan | None  # the move to make next; None where the map can name none
    relevance: NDArray[np.float32] | None  # [n] of the last view; None before any
    shortlist: NDArray[np.int64]  # ids of the map images most relevant to the last view, best first
    is_confident: bool = False  # whether it is as sure of its place as was asked
    is_informative: bool = True  # whether the last view changed the belief
    is_repeated: bool = False  # whether the observation had been counted before
    remarks: Sequence[str] = ()  # for a person, on the view


def view_of(
    session: LiveSession, expires_at: float, state: SessionState, n_shortlist: int | None = None
) -> SessionView:
    """Summarise a state, with lists of the default length where `n_shortlist` is None; milliseconds of work."""
    snapshot, belief, step = state.engine.snapshot, state.belief, state.step
    length = shortlist_length(snapshot, n_shortlist)
    summary = summarise(snapshot.route, belief.belief.mass, length, belief.belief.doubt.off_route)
    return SessionView(
        session_id=session.record.session_id,
        expires_at=expires_at,
        snapshot=snapshot,
        n_observations=belief.n_observations,
        belief=summary,
        plan=state.engine.localizer.plan(belief) if step is None else step.plan,
        relevance=belief.relevance,
        shortlist=np.empty(0, np.int64) if belief.relevance is None else shortlist(belief.relevance, length),
        is_confident=summary.near_mode >= state.engine.config.confidence,
        is_informative=step is None or step.is_informative,
    )


def check_prior(route: Route, position_m: float | None, std_m: float) -> None:
    """Refuse a prior that is no belief on the route; without a position it is uniform over the route.

    Raises:
        InvalidPriorError: A value is NaN or infinite, the deviation is not positive, or the position is so far beyond
            the route that the robot would hardly be on it.
    """
    if not (math.isfinite(std_m) and 0 < std_m <= _LARGEST_STD_M):
        raise InvalidPriorError(
            f"a standard deviation of {std_m} m cannot be one: it must be above 0 and at most {_LARGEST_STD_M:g}"
        )
    if position_m is None:
        return
    first_m = route.start_m
    last_m = first_m + route.length_m if route.closed else float(route.position_m[-1])
    slack_m = _SLACK_STDS * std_m
    if not (math.isfinite(position_m) and first_m - slack_m <= position_m <= last_m + slack_m):
        raise InvalidPriorError(
            f"position {position_m} m is off the route, which runs from {first_m:g} m to {last_m:g} m",
            route_start_m=first_m,
            route_end_m=last_m,
        )
