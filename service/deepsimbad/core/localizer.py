"""The algorithm on one page: describe, retrieve, predict, update, plan (II-C, II-D).

Describing comes first and apart (`engine.localizer.describe`), because it alone needs the evaluator and is done once
however often a journal is replayed.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief import (
    DEFAULT_N_PARTICLES,
    BeliefFilter,
    FilterKind,
    GridFilter,
    ParticleFilter,
    motion_std_m,
)
from deepsimbad.core.descriptor import LandmarkStatistics
from deepsimbad.core.map import Map
from deepsimbad.core.off_route import OFF_ROUTE_AT_START, OffRouteModel, agreement_of
from deepsimbad.core.planners import DEFAULT_PLANNER, Plan, PlanningView, parse_planner
from deepsimbad.core.relevance import Query, UpdateRule
from deepsimbad.core.retrieval import relevances

_STAGES = ("retrieve", "predict", "update", "plan")


@dataclass(frozen=True)
class LocalizerConfig:
    """How a robot is localized."""

    filter: FilterKind = FilterKind.GRID  # the exact grid or the paper's particles
    update: UpdateRule | None = None  # how a view counts; None: as the map's relevance wants
    planner: str | None = None  # by name; None: the default
    seed: int = 0  # of whatever is random
    n_particles: int = DEFAULT_N_PARTICLES  # of the particle filter


@dataclass(frozen=True)
class LocalizerState:
    """All that is known of one robot. Immutable: a step makes a new one."""

    belief: BeliefFilter  # where it is, if it is on the route
    # What is usual for each landmark, from the map's statistics on; None where the relevance has none
    live: LandmarkStatistics | None
    relevance: NDArray[np.float32] | None  # [n] of the last view; None before any
    off_route: float | None  # probability that it is nowhere on the route; None where the map has not learnt to tell
    n_observations: int  # views so far


@dataclass(frozen=True)
class Step:
    """What one observation came to."""

    state: LocalizerState  # the state after it
    plan: Plan | None  # the recommended next move; None where the planner has nothing to go by
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
        self._off_route_model = OffRouteModel.of(map_)

    def start(self, position_m: float | None = None, std_m: float = 5.0) -> LocalizerState:
        """Before any view: around a position, or anywhere on the route."""
        off_route = None if self._off_route_model is None else OFF_ROUTE_AT_START
        return LocalizerState(self._prior(position_m, std_m), self._map.landmark_statistics, None, off_route, 0)

    def step(
        self, state: LocalizerState, query: Query, action_m: float = 0.0, action_std_m: float | None = None
    ) -> Step:
        """One observation.

        Args:
            action_m: Metres moved since the last view; ignored for the first.
            action_std_m: How sure that is; None: as odometry usually is.

        Raises:
            PastTheEndError: The move leads past the end of an open route wherever the robot may have been.
            InvalidInputError: The view lacks what the map's relevance compares.
        """
        laps = [self._clock()]
        live, relevance, off_route = state.live, np.zeros(self._map.n_images, np.float32), state.off_route
        if query.is_informative:
            live = live.observing(query.ranks) if live else None
            relevance = relevances(self._map, query, live)
        laps.append(self._clock())

        belief, number = state.belief, state.n_observations
        if number > 0:
            std_m = motion_std_m(action_m) if action_std_m is None else action_std_m
            belief = belief.predicted(action_m, std_m, number)
            if off_route is not None and self._off_route_model is not None:
                agreement = agreement_of(belief.mass, relevance) if query.is_informative else None
                off_route = self._off_route_model.after(off_route, agreement)
        laps.append(self._clock())

        if query.is_informative:
            belief = belief.updated(relevance, self._update, number)
        laps.append(self._clock())

        after = LocalizerState(belief, live, relevance, off_route, number + 1)
        plan = self.plan(after)
        laps.append(self._clock())
        return Step(after, plan, dict(zip(_STAGES, (1000 * np.diff(laps)).tolist(), strict=True)))

    def plan(self, state: LocalizerState) -> Plan | None:
        """The next best view from what is known now."""
        return self._planner(
            PlanningView(self._map, state.belief.mass, state.relevance, self._config.seed, state.n_observations)
        )

    def with_prior(self, state: LocalizerState, position_m: float, std_m: float) -> LocalizerState:
        """The robot was carried, or got a fix: a new belief; what is usual for each landmark stays."""
        return replace(state, belief=self._prior(position_m, std_m))

    def to_arrays(self, state: LocalizerState) -> dict[str, NDArray[np.generic]]:
        """All of a state, to be restored bit for bit."""
        arrays: dict[str, NDArray[np.generic]] = {f"belief_{name}": a for name, a in state.belief.arrays().items()}
        arrays["n_observations"] = np.array([state.n_observations])
        if state.live is not None:
            arrays["live"] = np.stack([state.live.mean, state.live.square])
            arrays["live_weight"] = np.array([state.live.weight])
        if state.relevance is not None:
            arrays["relevance"] = state.relevance
        if state.off_route is not None:
            arrays["off_route"] = np.array([state.off_route])
        return arrays

    def from_arrays(self, arrays: dict[str, NDArray[np.generic]]) -> LocalizerState:
        """Restore what `to_arrays` gave; raises KeyError where an array is missing."""
        prefix = "belief_"
        held = {name.removeprefix(prefix): _floats(a) for name, a in arrays.items() if name.startswith(prefix)}
        belief: BeliefFilter
        if self._config.filter is FilterKind.GRID:
            belief = GridFilter.from_arrays(self._map.route, held)
        else:
            belief = ParticleFilter.from_arrays(self._map.route, held, self._config.seed)
        live, of_map = None, self._map.landmark_statistics
        if "live" in arrays and of_map is not None:
            mean, square = _floats(arrays["live"])
            live = replace(of_map, weight=_floats(arrays["live_weight"])[0].item(), mean=mean, square=square)
        relevance = np.asarray(arrays["relevance"], np.float32) if "relevance" in arrays else None
        off_route = _floats(arrays["off_route"])[0].item() if "off_route" in arrays else None
        return LocalizerState(belief, live, relevance, off_route, int(_floats(arrays["n_observations"])[0]))

    def _prior(self, position_m: float | None, std_m: float) -> BeliefFilter:
        route, config = self._map.route, self._config
        if config.filter is FilterKind.GRID:
            return GridFilter.uniform(route) if position_m is None else GridFilter.around(route, position_m, std_m)
        if position_m is None:
            return ParticleFilter.uniform(route, config.n_particles, config.seed)
        return ParticleFilter.around(route, position_m, std_m, config.n_particles, config.seed)


def _floats(array: NDArray[np.generic]) -> NDArray[np.float64]:
    return np.asarray(array, np.float64)
