"""The paper's particles (II-C): the belief by hypotheses, in place of a mass for every cell."""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import (
    LEAST_ALLOWED,
    LOST_AT_FIX,
    LOST_AT_START,
    Doubt,
    ViewEvidence,
    added,
    moved_along,
)
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.motion import SIGMAS, check_ahead, leaving_and_found, move_stds_m
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route

DEFAULT_N_PARTICLES = 1000
_LEAST_PLACED = 4  # particles where a robot that was lost may be
_NEGLIGIBLE = 1e-3  # of the belief; particles that hold no more are given up without drawing all anew
_EVENNESS = 0.5  # the power of its weight by which a particle is drawn: unlikely places keep some, of less weight each
_NOTHING = 1e-300  # of a likelihood or a weight: less is no less
_LEVEL = 1e-6  # of a logarithm's rise: the likelihood is the same all the way
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
    mass_moved: float = 0.0  # see `GridFilter.mass_moved`

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
        """Particles drawn around a position; none is beyond the ends of an open route."""
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
        """[n] every particle counts for the stretch of route that it stands for; images of one place share its mass."""
        route, trust = self.route, self.doubt.trust
        together, order = trust @ self.weights, np.argsort(self.position_m, kind="stable")
        if self.doubt.is_mixture:
            mass = _on_images(route, *_stretches(route, self.position_m[order]), together[order])
        else:  # the paper's count for the image nearest to them
            mass = np.bincount(route.nearest_image(self.position_m), together, route.n_images).astype(np.float64)
        mass = mass + (trust @ self.found) * route.cell_m / route.cell_m.sum()
        return np.asarray(mass / max(mass.sum(), _NOTHING), np.float64)

    @property
    def off_route(self) -> float:
        """As `GridFilter.off_route`."""
        return self.doubt.off_route

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:
        """As `GridFilter.predicted`; a particle that would be past the end of an open route dies.

        Particles are drawn anew now rather than after the last view, of which their weights told more.
        """
        route, before = self.route, self._evened_out(step) if self.doubt.is_mixture else self
        rng = np.random.default_rng([self.seed, step, _MOVE])
        target_m, weights = before.position_m + action_m, before.weights
        if not route.closed and action_m != 0:
            reach_m = SIGMAS * action_std_m + 1e-9
            past_m = np.maximum(target_m - route.position_m[-1], route.start_m - target_m)
            weights = np.where(past_m > (reach_m if self.doubt.is_mixture else 1e-9), 0.0, weights)
            if not weights.any():  # it may still have stopped at the end
                weights = np.where(past_m > reach_m, 0.0, before.weights)
            target_m = np.clip(target_m, route.start_m, route.position_m[-1])
        on_route, surviving = before.weights.sum(axis=1) + self.found, weights.sum(axis=1) + self.found
        if step == 1 or not self.doubt.is_mixture:  # later it may have been carried, if no particle is where that is
            check_ahead(route, self.doubt, on_route, surviving, action_m)
        lost, staying, found = leaving_and_found(self.doubt, self.doubt.lost, on_route, surviving, action_m)
        found = found + staying * self.found  # before a view that told nothing
        stds_m = move_stds_m(action_m, action_std_m, self.doubt)
        std_m = rng.choice(list(stds_m.values()), target_m.size, p=list(stds_m))
        moved = _onto(route, target_m + std_m * rng.standard_normal(target_m.size))
        last = self.doubt.last
        last = last if last is None else moved_along(route, last, action_m)
        doubt = replace(self.doubt, lost=lost, last=last)
        after = replace(self, position_m=moved, weights=weights * staying[:, np.newaxis], found=found, doubt=doubt)
        return after._resampled(step) if (weights.sum(axis=0) == 0).any() and surviving.any() else after

    def updated(self, seen: ViewEvidence, step: int) -> Self:
        """As `GridFilter.updated`; the paper's particles are drawn anew at once where their weights ask for it."""
        trust, least_told = self.doubt.trust, 0.0
        if seen.is_added:
            images, on_route = self.route.nearest_image(self.position_m), 1 - self.doubt.lost
            weights = np.outer(on_route, added(trust @ self.weights / on_route.mean(), seen.values[images]))
            weighed = replace(self, weights=weights, found=np.zeros_like(self.found))
            after = weighed if self.doubt.is_mixture else weighed._evened_out(step)
        else:
            values = self.route.places.means(seen.values)
            likelihood, least_told = seen.likelihood(values, self.doubt.last)
            way = _Way.of(self.route, likelihood)
            ends_m = np.array([self.route.start_m, self.route.start_m + self.route.length_m])
            average = way.means(ends_m[:1], ends_m[1:], trust.size)[:, 0]
            weights, found, lost = (
                self.weights * self._likelihoods(way),
                self.found * average,
                self.doubt.lost * average,
            )
            if (is_excluded := weights.sum(axis=1) + found <= _NOTHING).any():  # what was known of places stays
                kept = LEAST_ALLOWED * average / np.maximum(self.weights.sum(axis=1) + self.found, _NOTHING)
                weights = np.where(is_excluded[:, np.newaxis], self.weights * kept[:, np.newaxis], weights)
                found = np.where(is_excluded, self.found * kept, found)
            total = weights.sum(axis=1) + found + lost
            doubt = Doubt(lost / total, self.doubt.log_trust + np.log(total / average), values)
            weighed = replace(self, weights=weights / total[:, np.newaxis], found=found / total, doubt=doubt)
            after = weighed._placed(way, step) if doubt.is_mixture else weighed._evened_out(step)
        moved = 0.5 * float(np.abs(weighed._believed - self._believed).sum())
        return replace(after, mass_moved=max(moved, least_told))

    def _likelihoods(self, way: "_Way") -> NDArray[np.float64]:
        """[t, m] of the particles, by trust: on average over the stretches that they stand for, where they do."""
        if not self.doubt.is_mixture:
            return way.at(self.position_m)[np.newaxis]
        order, likelihoods = np.argsort(self.position_m, kind="stable"), np.empty_like(self.weights)
        likelihoods[:, order] = way.means(*_stretches(self.route, self.position_m[order]), self.doubt.trust.size)
        return likelihoods

    @property
    def _believed(self) -> NDArray[np.float64]:
        """[m + 1] of the particles and of what was found, if the robot is on the route; sums to 1."""
        believed = np.append(self.doubt.trust @ self.weights, self.doubt.trust @ self.found)
        return np.asarray(believed / max(believed.sum(), _NOTHING))

    def _evened_out(self, step: int) -> Self:
        """Resampled where the effective sample size has fallen below half the particles."""
        together = self.doubt.trust @ self.weights
        effective = np.square(together.sum()) / max(np.square(together).sum(), _NOTHING)
        return self if effective >= together.size / 2 else self._resampled(step)

    def _placed(self, way: "_Way", step: int) -> Self:
        """What was found gets particles where the view says it may be, a few at least, in place of the lightest.

        Args:
            way: What the view says along the route.
            step: Number of this step in the session.
        """
        trust, m = self.doubt.trust, self.position_m.size
        if not self.found.any():
            return self
        n_placed = int(np.clip(round(float(trust @ self.found) * m), min(_LEAST_PLACED, m // 2), m // 2))
        if n_placed == 0:
            return replace(self, doubt=replace(self.doubt, lost=self.doubt.lost + self.found), found=0 * self.found)
        rng = np.random.default_rng([self.seed, step, _RETURN])
        cumulated = _cumulated(way.likelihood[: self.route.n_images], self.route.cell_m, trust * self.found)
        images, _ = _comb(cumulated, n_placed, rng.random())
        together = trust @ self.weights
        heaviest = np.argsort(together, kind="stable")[n_placed:]
        if together[heaviest].sum() >= (1 - _NEGLIGIBLE) * together.sum():
            kept = self._of(self.position_m[heaviest], self.weights[:, heaviest])
        else:
            kept = self._resampled(step, m - n_placed)
        half_m = self.route.cell_m[images] * (rng.random(n_placed) - 0.5)
        placed_m = _onto(self.route, self.route.position_m[images] + half_m)
        density = cumulated[images] - np.where(images > 0, cumulated[images - 1], 0.0)
        placed = _by_trust(way.at(placed_m), trust.size) * self.route.cell_m[images] / density
        placed *= (self.found / np.maximum(placed.sum(axis=1), _NOTHING))[:, np.newaxis]
        position_m = np.concatenate([kept.position_m, placed_m])
        weights = np.concatenate([kept.weights, placed], axis=1)
        return replace(self, position_m=position_m, weights=weights, found=np.zeros_like(self.found))

    def _resampled(self, step: int, n_particles: int | None = None) -> Self:
        """Systematic resampling: one draw places an even comb over the cumulated weights.

        All but the paper's are drawn anew from the stretches that they stand for, so that none is there twice, and by
        the root of their weights (Liu, Chen and Logvinenko 2001): what is unlikely would else have none, and be
        impossible when the next views speak for it.
        """
        n = n_particles or self.position_m.size
        together = self.doubt.trust @ self.weights
        if together.sum() <= 0:
            return self
        rng = np.random.default_rng([self.seed, step, _RESAMPLE])
        drawn_by = together**_EVENNESS if self.doubt.is_mixture else together
        if self.doubt.is_mixture:
            order = np.argsort(self.position_m, kind="stable")
            chosen, part = _comb(np.cumsum(drawn_by[order]), n, rng.random())
            low_m, high_m = _stretches(self.route, self.position_m[order])
            position_m = low_m[chosen] + part * (high_m - low_m)[chosen]
            chosen = order[chosen]
        else:
            chosen, _ = _comb(np.cumsum(drawn_by), n, rng.random())
            position_m = self.position_m[chosen]
        return self._of(position_m, np.ascontiguousarray(self.weights[:, chosen]) / drawn_by[chosen])

    def _of(self, position_m: NDArray[np.float64], weights: NDArray[np.float64]) -> Self:
        """Other particles, with as much of every trust's belief on the route as these have."""
        total = np.maximum(weights.sum(axis=1), _NOTHING)
        return replace(self, position_m=position_m, weights=weights * (self.weights.sum(axis=1) / total)[:, np.newaxis])


def _by_trust(least: NDArray[np.float64], n_trusts: int) -> NDArray[np.float64]:
    """[t, m] likelihoods from those of the least trust [m]: every trust is twice the one before."""
    rows = [least]
    for _ in range(1, n_trusts):
        rows.append(np.square(rows[-1]))
    return np.array(rows)


@dataclass(frozen=True)
class _Way:
    """How likely a view is along the route: between two images its logarithm leads from one to the other."""

    at_m: NDArray[np.float64]  # [w] of the images; a closed route goes on to its first one
    likelihood: NDArray[np.float64]  # [w] of the least trust
    log: NDArray[np.float64]  # [w]

    @classmethod
    def of(cls, route: Route, least: NDArray[np.float64]) -> Self:
        """Of the likelihoods of images [n], alike where they show one place."""
        at_m = route.position_m
        if route.closed:
            at_m, least = np.append(at_m, route.start_m + route.length_m), np.append(least, least[0])
        return cls(at_m, least, np.log(np.maximum(least, _NOTHING)))

    def at(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """[m] at positions on the route."""
        return np.asarray(np.exp(np.interp(position_m, self.at_m, self.log)), np.float64)

    def means(self, low_m: NDArray[np.float64], high_m: NDArray[np.float64], n_trusts: int) -> NDArray[np.float64]:
        """[t, s] of stretches that do not overlap, in order, by trust."""
        return _means(self.at_m, self.likelihood, self.log, low_m, high_m, n_trusts)


@njit(cache=True, nogil=True)
def _means(
    at_m: NDArray[np.float64],
    likelihood: NDArray[np.float64],
    log: NDArray[np.float64],
    low_m: NDArray[np.float64],
    high_m: NDArray[np.float64],
    n_trusts: int,
) -> NDArray[np.float64]:
    """[t, s] of likelihoods whose logarithm is linear between positions [w]; without length, what is there."""
    means, last, part = np.zeros((n_trusts, low_m.size)), at_m.size - 1, 0
    for stretch in range(low_m.size):
        from_m, end_m = low_m[stretch], high_m[stretch]
        while part + 1 < last and at_m[part + 1] <= from_m:
            part += 1
        from_log = _log_at(from_m, at_m, log, part)
        before, length_m = np.exp(from_log), end_m - from_m
        for t in range(n_trusts if length_m <= 0 else 0):
            means[t, stretch] = before ** (1 << t)
        while from_m < end_m:  # the pieces between two positions each
            to_m, to_log, after = end_m, 0.0, 0.0
            if part + 1 == last or end_m < at_m[part + 1]:
                to_log = _log_at(end_m, at_m, log, part)
                after = np.exp(to_log)
            else:
                to_m, to_log, after = at_m[part + 1], log[part + 1], likelihood[part + 1]
                part += 1
            low, high, rise, share = before, after, to_log - from_log, (to_m - from_m) / length_m
            for t in range(n_trusts):
                means[t, stretch] += share * ((high - low) / rise if abs(rise) > _LEVEL else high)
                low, high, rise = low * low, high * high, 2 * rise
            from_m, from_log, before = to_m, to_log, after
    return means


@njit(cache=True, nogil=True)
def _log_at(metres: float, at_m: NDArray[np.float64], log: NDArray[np.float64], part: int) -> float:
    """What is linear from one position to the next, where the next is farther."""
    if metres <= at_m[part]:
        return float(log[part])
    return float(log[part] + (log[part + 1] - log[part]) * (metres - at_m[part]) / (at_m[part + 1] - at_m[part]))


@njit(cache=True, nogil=True)
def _cumulated(
    least: NDArray[np.float64], cell_m: NDArray[np.float64], found: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[n] how much of what was found [t] may be at an image or before it, each part spread by its likelihood."""
    sums = np.zeros(found.size)
    for image in range(least.size):
        likelihood = least[image]
        for t in range(found.size):
            sums[t] += likelihood * cell_m[image]
            likelihood *= likelihood
    shares, cumulated, total = found / sums, np.empty(least.size), 0.0
    for image in range(least.size):
        likelihood = least[image]
        for t in range(found.size):
            total += shares[t] * likelihood * cell_m[image]
            likelihood *= likelihood
        cumulated[image] = total
    return cumulated


def _comb(cumulated: NDArray[np.float64], count: int, offset: float) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """[count] ids, each as often as its weight asks for, and how far in each its tooth stands, 0 to 1."""
    teeth = cumulated[-1] * (np.arange(count) + offset) / count
    chosen = np.minimum(np.searchsorted(cumulated, teeth, side="right"), cumulated.size - 1)
    before = np.where(chosen > 0, cumulated[chosen - 1], 0.0)
    part = (teeth - before) / np.maximum(cumulated[chosen] - before, _NOTHING)
    return np.asarray(chosen, np.intp), np.asarray(np.clip(part, 0, 1), np.float64)


def _stretches(route: Route, position_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[m], [m] where the stretches begin and end that particles stand for, at ascending positions.

    They go half the way to the next particles, no farther than a particle of a belief that knows nothing.
    """
    reach_m = max(route.length_m / position_m.size, route.cells.step_m) / 2
    half_m = np.minimum(np.diff(position_m) / 2, reach_m)
    low_m, high_m = position_m - np.r_[reach_m, half_m], position_m + np.r_[half_m, reach_m]
    end_m = route.start_m + route.length_m
    return np.clip(low_m, route.start_m, end_m), np.clip(high_m, route.start_m, end_m)


def _on_images(
    route: Route, low_m: NDArray[np.float64], high_m: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[n] of weights [m] that lie evenly on stretches that do not overlap, in order."""
    places = route.places
    middle_m = (places.position_m[1:] + places.position_m[:-1]) / 2
    last_m = route.start_m + route.length_m
    if route.closed:  # behind the last image the first may be nearer
        middle_m = np.append(middle_m, (places.position_m[-1] + last_m) / 2)
    below = _below(middle_m, low_m, high_m, weight)
    mass = np.maximum(np.diff(below, prepend=0.0, append=weight.sum()), 0.0)  # sums round otherwise than a sum of parts
    if route.closed:
        mass = np.concatenate([mass[:1] + mass[-1:], mass[1:-1]])
    return mass if mass.size == route.n_images else np.asarray(mass[places.of_image] / places.n_images[places.of_image])


@njit(cache=True, nogil=True)
def _below(
    at_m: NDArray[np.float64], low_m: NDArray[np.float64], high_m: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[k] how much of the weights lies below ascending positions [k]."""
    below, whole, part = np.empty(at_m.size), 0.0, 0
    for at in range(at_m.size):
        while part < weight.size and high_m[part] <= at_m[at]:
            whole += weight[part]
            part += 1
        below[at] = whole
        if part < weight.size and at_m[at] > low_m[part]:
            below[at] += weight[part] * (at_m[at] - low_m[part]) / (high_m[part] - low_m[part])
    return below


def _onto(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions on the route: round a closed one, turned back at the ends of an open one."""
    if route.closed and route.length_m > 0:
        return route.wrapped(position_m)
    start_m, end_m = route.start_m, route.position_m[-1]
    turned_m = end_m - np.abs(end_m - start_m - np.abs(position_m - start_m))
    return np.asarray(np.clip(turned_m, start_m, end_m), np.float64)


class FilterKind(StrEnum):
    """The filters that exist."""

    GRID = "grid"
    PARTICLE = "particle"


BeliefFilter: TypeAlias = GridFilter | ParticleFilter
"""A belief over the route. Immutable: every call returns a new one, so a failed step leaves nothing half done."""
