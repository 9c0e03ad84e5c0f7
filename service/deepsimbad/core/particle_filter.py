"""The paper's filter: weighted hypotheses of the route position (II-C)."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.filters import LEAST_SURVIVING_SHARE
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import UpdateRule, evidence, weigh
from deepsimbad.errors import PastTheEndError

DEFAULT_N_PARTICLES = 1000
_START, _MOVE, _RESAMPLE = range(3)  # what a draw is for; part of its seed


@dataclass(frozen=True)
class ParticleFilter:
    """Particles. Whatever is random is drawn from (seed, step), so that no generator's state need be kept.

    Attributes:
        route: Where the map images are.
        position_m: [m] float64, hypotheses of the route position.
        weight: [m] float64; sums to 1.
        seed: Of all draws.
    """

    route: Route
    position_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    seed: int

    @classmethod
    def uniform(cls, route: Route, n_particles: int = DEFAULT_N_PARTICLES, seed: int = 0) -> Self:
        """No knowledge: one particle in each of m equal stretches of the route."""
        rng = np.random.default_rng([seed, 0, _START])
        stretch = (np.arange(n_particles) + rng.random(n_particles)) / n_particles
        return cls._equal(route, route.start_m + stretch * route.length_m, seed)

    @classmethod
    def around(
        cls, route: Route, position_m: float, std_m: float, n_particles: int = DEFAULT_N_PARTICLES, seed: int = 0
    ) -> Self:
        """Particles drawn around a position; beyond the ends of an open route they stand at the end."""
        rng = np.random.default_rng([seed, 0, _START])
        drawn = position_m + std_m * rng.standard_normal(n_particles)
        return cls._equal(route, _onto(route, drawn), seed)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]], seed: int) -> Self:
        """Restore what `arrays` gave."""
        return cls(route, arrays["position_m"], arrays["weight"], seed)

    @classmethod
    def _equal(cls, route: Route, position_m: NDArray[np.float64], seed: int) -> Self:
        return cls(route, position_m, np.full(position_m.size, 1.0 / position_m.size), seed)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        return {"position_m": self.position_m, "weight": self.weight}

    @property
    def mass(self) -> NDArray[np.float64]:
        """See `BeliefFilter.mass`: every particle counts for the map image nearest to it."""
        images = self.route.nearest_image(self.position_m)
        return np.asarray(np.bincount(images, self.weight, self.route.n_images), np.float64)

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:
        """See `BeliefFilter.predicted`; a particle that would be past the end of an open route dies."""
        rng = np.random.default_rng([self.seed, step, _MOVE])
        alive = self if self.route.closed or action_m == 0 else self._with_route_ahead(action_m, step)
        moved = alive.position_m + action_m + action_std_m * rng.standard_normal(alive.position_m.size)
        return replace(alive, position_m=_onto(self.route, moved))

    def _with_route_ahead(self, action_m: float, step: int) -> Self:
        """Particles that would be past the end die, and the living take their places."""
        dead = self.position_m + action_m > self.route.position_m[-1] + 1e-9
        if not dead.any():
            return self
        weight = np.where(dead, 0.0, self.weight)
        if weight.sum() <= LEAST_SURVIVING_SHARE:
            end_m = float(self.route.position_m[-1])
            raise PastTheEndError(
                f"no particle has {action_m:g} m of route before it; the route ends at {end_m:g} m", route_end_m=end_m
            )
        return replace(self, weight=weight / weight.sum())._resampled(step)

    def updated(self, relevance: NDArray[np.float32], rule: UpdateRule, step: int) -> Self:
        """See `BeliefFilter.updated`; resamples when the effective sample size falls below half the particles."""
        seen = evidence(relevance, rule)[self.route.nearest_image(self.position_m)]
        weighed = replace(self, weight=weigh(self.weight, seen, rule))
        effective = 1.0 / np.square(weighed.weight).sum()
        return weighed if effective >= weighed.weight.size / 2 else weighed._resampled(step)

    def _resampled(self, step: int) -> Self:
        """Systematic resampling: one draw places an even comb over the cumulated weights."""
        n = self.weight.size
        offset = np.random.default_rng([self.seed, step, _RESAMPLE]).random()
        cumulated = np.cumsum(self.weight)
        chosen = np.searchsorted(cumulated / cumulated[-1], (np.arange(n) + offset) / n, side="right")
        return self._equal(self.route, self.position_m[np.minimum(chosen, n - 1)], self.seed)


def _onto(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions on the route: round a closed one, to the ends of an open one."""
    if route.closed and route.length_m > 0:
        return np.asarray(route.start_m + (position_m - route.start_m) % route.length_m, np.float64)
    return np.clip(position_m, route.start_m, route.position_m[-1])
