"""The algorithm on one page: describe, retrieve, predict, update, plan (II-C, II-D).

Describing comes first and apart (`engine.localizer.describe`), because it alone needs the evaluator and is done once
however often a journal is replayed.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import ViewEvidence
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.motion import SIGMAS, motion_std_m
from deepsimbad.core.belief.particles import DEFAULT_N_PARTICLES, BeliefFilter, FilterKind, ParticleFilter
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.planners import DEFAULT_PLANNER, Plan, PlanningView, parse_planner
from deepsimbad.core.relevance import LiveStatistics, Query, UpdateRule
from deepsimbad.errors import PastTheEndError

_LEAST_MASS_MOVED = 0.01  # share of the belief; a view that moves less of it elsewhere tells nothing


@dataclass(frozen=True)
class LocalizerConfig:
    """How a robot is localized."""

    filter: FilterKind = FilterKind.GRID  # the exact grid or the paper's particles
    update: UpdateRule | None = None  # how a view changes the belief; None: as the map's relevance does by default
    planner: str | None = None  # by name; None: the default
    seed: int = 0  # of every random draw
    n_particles: int = DEFAULT_N_PARTICLES  # of the particle filter
    price_bits_per_m: float = 0.0  # what the planner takes a metre of moving to cost


@dataclass(frozen=True)
class LocalizerState:
    """All that the service knows of one robot. Immutable: a step makes a new one."""

    belief: BeliefFilter  # where it is, and whether it is lost
    live: LiveStatistics | None  # usual views, from the map's statistics on; None where the relevance needs none
    relevance: NDArray[np.float32] | None  # [n] of the last view; None before the first
    n_observations: int  # views so far


@dataclass(frozen=True)
class Step:
    """The outcome of one observation."""

    state: LocalizerState  # after the observation
    relevance: NDArray[np.float32]  # [n] of the view
    shows_place: bool  # whether the view shows anything of the route; another leaves the belief as it was
    is_informative: bool  # whether the view changed the belief, or would have changed one that was less sure
    timings_ms: dict[str, float]  # milliseconds by stage
    plan: Plan | None = None  # the recommended next move; None where nobody planned, or had nothing to go by


class ActiveLocalizer:
    """Localizes one robot on one map; `clock` gives seconds, by which the stages of a step are timed.

    Raises:
        InvalidInputError: The domain has no such planner.
    """

    def __init__(self, map_: Map, config: LocalizerConfig, clock: Callable[[], float] = lambda: 0.0) -> None:
        self._map = map_
        self._config = config
        self._clock = clock
        self._update = config.update or map_.update_rule
        self._planner = parse_planner(config.planner or DEFAULT_PLANNER, map_.actions_m.tolist())

    def start(self, position_m: float | None = None, std_m: float = 5.0) -> LocalizerState:
        """The state before any view: a belief around a position, or over the whole route."""
        return LocalizerState(self._prior(position_m, std_m), self._map.live_statistics, None, 0)

    def step(
        self, state: LocalizerState, query: Query, action_m: float = 0.0, action_std_m: float | None = None
    ) -> Step:
        """`observe`, and the plan of the next move."""
        observed = self.observe(state, query, action_m, action_std_m)
        start_s = self._clock()
        plan = self.plan(observed.state)
        timings_ms = {**observed.timings_ms, "plan": 1000 * (self._clock() - start_s)}
        return replace(observed, plan=plan, timings_ms=timings_ms)

    def observe(
        self, state: LocalizerState, query: Query, action_m: float = 0.0, action_std_m: float | None = None
    ) -> Step:
        """One observation, without a plan: the move that led to it, then the view.

        Args:
            action_m: Metres moved since the last view; ignored for the first. Where the domain's actions only go
                forward, a move backward within its error counts as none.
            action_std_m: Standard deviation of the move; None: that of usual odometry.

        Raises:
            PastTheEndError: The move leads past the end of an open route wherever the robot may have been.
            InvalidInputError: The view lacks what the map's relevance compares.
        """
        times_s = [self._clock()]
        map_, step = self._map, state.n_observations
        std_m = action_std_m if action_std_m is not None else motion_std_m(action_m) if action_m != 0 else 0.0
        is_jitter = not map_.goes_backward and -SIGMAS * std_m <= action_m < 0
        moved_m = 0.0 if step == 0 or is_jitter else action_m

        live, is_strange = map_.after_view(state.live, query, moved_m if step > 0 else None)
        relevance = relevances(map_, query, live)
        times_s.append(self._clock())

        belief = state.belief.predicted(moved_m, std_m, step) if step > 0 else state.belief
        times_s.append(self._clock())

        mass_moved = 0.0
        shows_place = query.is_informative and not is_strange
        if shows_place:
            shared_error = map_.shared_error_after(belief.doubt.since_last_m)
            evidence = ViewEvidence.of(relevance, self._update, map_.log_likelihood_scale, shared_error)
            belief = belief.updated(evidence, step)
            mass_moved = belief.mass_moved
        times_s.append(self._clock())

        timings_ms = dict(zip(("retrieve", "predict", "update"), (1000 * np.diff(times_s)).tolist(), strict=True))
        new_state = LocalizerState(belief, live, relevance, step + 1)
        return Step(new_state, relevance, shows_place, mass_moved > _LEAST_MASS_MOVED, timings_ms)

    def observe_or_restart(
        self, state: LocalizerState, query: Query, action_m: float, action_std_m: float | None = None
    ) -> tuple[Step, bool]:
        """`observe`; a robot whose move leads past the end was believed elsewhere, and this is its first view anew.

        Returns:
            The step, and whether the robot began anew.
        """
        try:
            return self.observe(state, query, action_m, action_std_m), False
        except PastTheEndError:
            return self.observe(self.restart(state), query), True

    def restart(self, state: LocalizerState) -> LocalizerState:
        """A robot that may be anywhere: the state before any view, but with the statistics of this one."""
        return replace(self.start(), live=state.live)

    def plan(self, state: LocalizerState) -> Plan | None:
        """The move to the next best view from this state."""
        return self._planner(
            PlanningView(
                self._map,
                state.belief.mass,
                state.relevance,
                self._config.seed,
                state.n_observations,
                self._config.price_bits_per_m,
            )
        )

    def with_prior(self, state: LocalizerState, position_m: float, std_m: float) -> LocalizerState:
        """A robot was carried or got a fix: the state with a new belief around a position, and the same statistics."""
        return replace(state, belief=self._prior(position_m, std_m))

    def to_arrays(self, state: LocalizerState) -> dict[str, NDArray[np.generic]]:
        """The named arrays of a state, from which `from_arrays` restores it bit for bit."""
        arrays: dict[str, NDArray[np.generic]] = {"n_observations": np.array([state.n_observations])}
        arrays |= {f"belief_{name}": array for name, array in state.belief.arrays().items()}
        if state.live is not None:
            arrays |= {f"live_{name}": array for name, array in state.live.to_arrays().items()}
        if state.relevance is not None:
            arrays["relevance"] = state.relevance
        return arrays

    def from_arrays(self, arrays: dict[str, NDArray[np.generic]]) -> LocalizerState:
        """The state whose arrays `to_arrays` gave; raises KeyError where one is missing."""
        belief_arrays = _with_prefix("belief_", arrays)
        belief: BeliefFilter
        if self._config.filter is FilterKind.GRID:
            belief = GridFilter.from_arrays(self._map.route, belief_arrays)
        else:
            belief = ParticleFilter.from_arrays(self._map.route, belief_arrays, self._config.seed)
        live = self._map.live_statistics
        if live is not None:
            live = live.from_arrays(_with_prefix("live_", arrays))
        relevance = np.asarray(arrays["relevance"], np.float32) if "relevance" in arrays else None
        return LocalizerState(belief, live, relevance, int(arrays["n_observations"][0]))

    def _prior(self, position_m: float | None, std_m: float) -> BeliefFilter:
        route, config, rule = self._map.route, self._config, self._update
        if config.filter is FilterKind.GRID:
            if position_m is None:
                return GridFilter.uniform(route, rule)
            return GridFilter.around(route, position_m, std_m, rule)
        if position_m is None:
            return ParticleFilter.uniform(route, config.n_particles, config.seed, rule)
        return ParticleFilter.around(route, position_m, std_m, config.n_particles, config.seed, rule)


def _with_prefix(prefix: str, arrays: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.float64]]:
    return {
        name.removeprefix(prefix): np.asarray(array, np.float64)
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
