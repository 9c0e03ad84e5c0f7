"""The paper's particles (II-C): the belief of `core.belief` by hypotheses, in place of a mass for every map image."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief import (
    LOST_AT_FIX,
    LOST_AT_START,
    SIGMAS,
    SLIPS,
    Doubt,
    GridFilter,
    ViewEvidence,
    added,
    check_ahead,
    leaving_and_found,
    moved_along,
    slipping_std_m,
)
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route

DEFAULT_N_PARTICLES = 1000
_START, _RETURN, _MOVE, _RESAMPLE = range(4)  # what a draw is for; part of its seed


@dataclass(frozen=True)
class ParticleFilter:
    """Particles. Whatever is random is drawn from (seed, step), so that no generator's state need be kept."""

    route: Route
    position_m: NDArray[np.float64]  # [m] hypotheses of the route position
    weights: NDArray[np.float64]  # [t, m] by trust; with `doubt.lost` and `found` each row sums to 1
    found: NDArray[np.float64]  # [t] what may be anywhere again; the next view says where
    doubt: Doubt
    seed: int  # of all draws

    @classmethod
    def uniform(
        cls,
        route: Route,
        n_particles: int = DEFAULT_N_PARTICLES,
        seed: int = 0,
        rule: UpdateRule = UpdateRule.MIXTURE,
    ) -> Self:
        """No knowledge: one particle in each of m equal stretches of the route."""
        rng = np.random.default_rng([seed, 0, _START])
        stretch = (np.arange(n_particles) + rng.random(n_particles)) / n_particles
        return cls._equal(route, route.start_m + stretch * route.length_m, seed, rule, LOST_AT_START)

    @classmethod
    def around(
        cls,
        route: Route,
        position_m: float,
        std_m: float,
        n_particles: int = DEFAULT_N_PARTICLES,
        seed: int = 0,
        rule: UpdateRule = UpdateRule.MIXTURE,
    ) -> Self:
        """Particles drawn around a position; beyond the ends of an open route they stand at the end."""
        rng = np.random.default_rng([seed, 0, _START])
        drawn = position_m + std_m * rng.standard_normal(n_particles)
        return cls._equal(route, _onto(route, drawn), seed, rule, LOST_AT_FIX)

    @classmethod
    def _equal(cls, route: Route, position_m: NDArray[np.float64], seed: int, rule: UpdateRule, lost: float) -> Self:
        doubt = Doubt.at_start(rule, lost)
        weights = np.repeat((1 - doubt.lost)[:, np.newaxis] / position_m.size, position_m.size, axis=1)
        return cls(route, position_m, weights, np.zeros_like(doubt.lost), doubt, seed)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]], seed: int) -> Self:
        """Restore what `arrays` gave."""
        return cls(route, arrays["position_m"], arrays["weights"], arrays["found"], Doubt.from_arrays(arrays), seed)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        held = {"position_m": self.position_m, "weights": self.weights, "found": self.found}
        return {**held, **self.doubt.arrays()}

    @cached_property
    def mass(self) -> NDArray[np.float64]:
        """[n] every particle counts for the map image nearest to it."""
        images = self.route.nearest_image(self.position_m)
        mass = np.bincount(images, self.doubt.trust @ self.weights, self.route.n_images)
        mass += (self.doubt.trust @ self.found) * self.route.cell_m / self.route.cell_m.sum()
        return np.asarray(mass / max(mass.sum(), 1e-300), np.float64)

    @property
    def off_route(self) -> float:
        """As `GridFilter.off_route`."""
        return self.doubt.off_route

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:
        """As `GridFilter.predicted`; a particle that would be past the end of an open route dies."""
        route = self.route
        rng = np.random.default_rng([self.seed, step, _MOVE])
        target_m, weights = self.position_m + action_m, self.weights
        if not route.closed and action_m != 0:
            reach_m = SIGMAS * action_std_m + 1e-9
            past_m = np.maximum(target_m - route.position_m[-1], route.start_m - target_m)
            weights = np.where(past_m > (reach_m if self.doubt.is_mixture else 1e-9), 0.0, weights)
            if not weights.any():  # it may still have stopped at the end
                weights = np.where(past_m > reach_m, 0.0, self.weights)
        on_route, surviving = self.weights.sum(axis=1), weights.sum(axis=1)
        check_ahead(route, self.doubt, on_route, surviving, action_m)
        lost, staying, found = leaving_and_found(
            self.doubt, self.doubt.lost + self.found, on_route, surviving, action_m
        )
        slips = rng.random(target_m.size) < SLIPS
        std_m = np.where(slips, slipping_std_m(action_m, action_std_m, self.doubt), action_std_m)
        moved = _onto(route, target_m + std_m * rng.standard_normal(target_m.size))
        last = self.doubt.last
        last = last if last is None else moved_along(route, last, action_m)
        doubt = replace(self.doubt, lost=lost, last=last)
        after = replace(self, position_m=moved, weights=weights * staying[:, np.newaxis], found=found, doubt=doubt)
        return after._resampled(step) if (weights.sum(axis=0) == 0).any() and surviving.any() else after

    def updated(self, seen: ViewEvidence, step: int) -> Self:
        """As `GridFilter.updated`; resamples when the effective sample size falls below half the particles."""
        images = self.route.nearest_image(self.position_m)
        trust = self.doubt.trust
        if seen.is_added:
            on_route = 1 - self.doubt.lost
            weights = np.outer(on_route, added(trust @ self.weights / on_route.mean(), seen.values[images]))
            weighed = replace(self, weights=weights, found=np.zeros_like(self.found))
        else:
            least = seen.likelihood(self.doubt.last)
            factors = np.stack([least ** (2**t) for t in range(trust.size)])  # each twice the one before
            average = factors.mean(axis=1)
            weights, found, lost = self.weights * factors[:, images], self.found * average, self.doubt.lost * average
            total = weights.sum(axis=1) + found + lost
            if (total <= 0).any():  # the view allows nothing that is still believed: what was known stays
                return self
            doubt = Doubt(lost / total, self.doubt.log_trust + np.log(total / average), seen.values)
            weighed = replace(self, weights=weights / total[:, np.newaxis], found=found / total, doubt=doubt)
            weighed = weighed._placed(factors * self.route.cell_m, step)
        together = weighed.doubt.trust @ weighed.weights
        effective = np.square(together.sum()) / max(np.square(together).sum(), 1e-300)
        return weighed if effective >= together.size / 2 else weighed._resampled(step)

    def _placed(self, likelihood: NDArray[np.float64], step: int) -> Self:
        """What was found gets particles where the view says it may be, in place of the lightest."""
        trust, m = self.doubt.trust, self.position_m.size
        n_placed = min(m // 2, round(float(trust @ self.found) * m))
        if n_placed == 0:
            return (
                self
                if not self.found.any()
                else replace(
                    self, doubt=replace(self.doubt, lost=self.doubt.lost + self.found), found=np.zeros_like(self.found)
                )
            )
        rng = np.random.default_rng([self.seed, step, _RETURN])
        density = (trust * self.found) @ (likelihood / likelihood.sum(axis=1, keepdims=True))
        images = _comb(density, n_placed, rng.random())
        kept = self._resampled(step, m - n_placed)
        half_m = self.route.cell_m[images] * (rng.random(n_placed) - 0.5)
        position_m = np.concatenate([kept.position_m, _onto(self.route, self.route.position_m[images] + half_m)])
        placed = np.ascontiguousarray(likelihood[:, images]) / density[images]
        placed *= (self.found / np.maximum(placed.sum(axis=1), 1e-300))[:, np.newaxis]
        weights = np.concatenate([kept.weights, placed], axis=1)
        return replace(self, position_m=position_m, weights=weights, found=np.zeros_like(self.found))

    def _resampled(self, step: int, n_particles: int | None = None) -> Self:
        """Systematic resampling: one draw places an even comb over the cumulated weights."""
        n = n_particles or self.position_m.size
        together = self.doubt.trust @ self.weights
        if together.sum() <= 0:
            return self
        chosen = _comb(together, n, np.random.default_rng([self.seed, step, _RESAMPLE]).random())
        weights = np.ascontiguousarray(self.weights[:, chosen]) / together[chosen]
        weights *= (self.weights.sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300))[:, np.newaxis]
        return replace(self, position_m=self.position_m[chosen], weights=weights)


def _comb(weight: NDArray[np.float64], count: int, offset: float) -> NDArray[np.intp]:
    """[count] ids, each as often as its weight asks for."""
    cumulated = np.cumsum(weight)
    chosen = np.searchsorted(cumulated / cumulated[-1], (np.arange(count) + offset) / count, side="right")
    return np.minimum(chosen, weight.size - 1)


def _onto(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions on the route: round a closed one, to the ends of an open one."""
    if route.closed and route.length_m > 0:
        return route.wrapped(position_m)
    return np.clip(position_m, route.start_m, route.position_m[-1])


BeliefFilter: TypeAlias = GridFilter | ParticleFilter
"""A belief over the route. Immutable: every call returns a new one, so a failed step leaves nothing half done."""
