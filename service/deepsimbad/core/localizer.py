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

_LEAST_TOLD = 0.01  # of the mass that a view moves elsewhere; with less it told nothing
_STAGES = ("retrieve", "predict", "update", "plan")


@dataclass(frozen=True)
class LocalizerConfig:
    """How a robot is localized."""

    filter: FilterKind = FilterKind.GRID  # the exact grid or the paper's particles
    update: UpdateRule | None = None  # how a view counts; None: as the map's relevance wants
    planner: str | None = None  # by name; None: the default
    seed: int = 0  # of whatever is random
    n_particles: int = DEFAULT_N_PARTICLES  # of the particle filter
    price_bits_per_m: float = 0.0  # of moving, to the planner


@dataclass(frozen=True)
class LocalizerState:
    """All that is known of one robot. Immutable: a step makes a new one."""

    belief: BeliefFilter  # where it is, and whether it is lost
    live: LiveStatistics | None  # what is usual, from the map's statistics on; None where the relevance asks for none
    relevance: NDArray[np.float32] | None  # [n] of the last view; None before any
    n_observations: int  # views so far


@dataclass(frozen=True)
class Step:
    """What one observation came to."""

    state: LocalizerState  # the state after it
    plan: Plan | None  # the recommended next move; None where the planner has nothing to go by
    is_informative: bool  # whether the view changed the belief, or would have changed one that was less sure
    timings_ms: dict[str, float]  # milliseconds by stage


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
        """Before any view: around a position, or anywhere on the route."""
        return LocalizerState(self._prior(position_m, std_m), self._map.live_statistics, None, 0)

    def step(
        self, state: LocalizerState, query: Query, action_m: float = 0.0, action_std_m: float | None = None
    ) -> Step:
        """One observation.

        Args:
            action_m: Metres moved since the last view; ignored for the first. Backward within its error is no move
                where the domain's actions go forward alone.
            action_std_m: How sure that is; None: as odometry usually is.

        Raises:
            PastTheEndError: The move leads past the end of an open route wherever the robot may have been.
            InvalidInputError: The view lacks what the map's relevance compares.
        """
        laps = [self._clock()]
        map_, number = self._map, state.n_observations
        std_m = action_std_m if action_std_m is not None else motion_std_m(action_m) if action_m != 0 else 0.0
        jitters = not map_.goes_backward and -SIGMAS * std_m <= action_m < 0
        moved_m = 0.0 if number == 0 or jitters else action_m

        live, is_strange = map_.after_view(state.live, query, moved_m if number > 0 else None)
        relevance = relevances(map_, query, live)
        laps.append(self._clock())

        belief = state.belief.predicted(moved_m, std_m, number) if number > 0 else state.belief
        laps.append(self._clock())

        told = 0.0
        if query.is_informative and not is_strange:
            shared = map_.shared_error_after(moved_m) if number > 0 else 0.0
            seen = ViewEvidence.of(relevance, self._update, map_.log_likelihood_scale, shared)
            belief = belief.updated(seen, number)
            told = belief.mass_moved
        laps.append(self._clock())

        after = LocalizerState(belief, live, relevance, number + 1)
        plan = self.plan(after)
        laps.append(self._clock())
        return Step(after, plan, told > _LEAST_TOLD, dict(zip(_STAGES, (1000 * np.diff(laps)).tolist(), strict=True)))

    def plan(self, state: LocalizerState) -> Plan | None:
        """The next best view from what is known now."""
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
        """The robot was carried, or got a fix: a new belief; what is usual for each landmark stays."""
        return replace(state, belief=self._prior(position_m, std_m))

    def to_arrays(self, state: LocalizerState) -> dict[str, NDArray[np.generic]]:
        """All of a state, to be restored bit for bit."""
        arrays: dict[str, NDArray[np.generic]] = {f"belief_{name}": a for name, a in state.belief.arrays().items()}
        arrays["n_observations"] = np.array([state.n_observations])
        if state.live is not None:
            arrays |= {f"live_{name}": array for name, array in state.live.to_arrays().items()}
        if state.relevance is not None:
            arrays["relevance"] = state.relevance
        return arrays

    def from_arrays(self, arrays: dict[str, NDArray[np.generic]]) -> LocalizerState:
        """Restore what `to_arrays` gave; raises KeyError where an array is missing."""
        held = _of("belief_", arrays)
        belief: BeliefFilter
        if self._config.filter is FilterKind.GRID:
            belief = GridFilter.from_arrays(self._map.route, held)
        else:
            belief = ParticleFilter.from_arrays(self._map.route, held, self._config.seed)
        live = self._map.live_statistics
        if live is not None:
            live = live.from_arrays(_of("live_", arrays))
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


def _of(prefix: str, arrays: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.float64]]:
    return {
        name.removeprefix(prefix): np.asarray(array, np.float64)
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
