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
    add_evidence,
    moved_along,
)
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.motion import SIGMAS, check_ahead, leaving_and_found, move_stds_m
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route

DEFAULT_N_PARTICLES = 1000
_LEAST_PLACED = 4  # particles that found mass is placed as
_NEGLIGIBLE = 1e-3  # of the belief; particles that hold less together are given up without resampling
_EVENNESS = 0.5  # power of its weight by which a particle is drawn, so that unlikely places keep a few of less weight
_NOTHING = 1e-300  # the least likelihood or weight that is divided by, or whose logarithm is taken
_LEVEL = 1e-6  # of a logarithm's rise: with less the likelihood counts as constant
_START, _RETURN, _MOVE, _RESAMPLE = range(4)  # what a draw is for; part of its seed


@dataclass(frozen=True)
class ParticleFilter:
    """A belief of m particles. Random draws depend on (seed, step) alone, so that no generator's state need be kept."""

    route: Route
    position_m: NDArray[np.float64]  # [m] hypotheses of the route position
    weights: NDArray[np.float64]  # [t, m] by trust; each row sums to 1 with `doubt.lost` and `found_mass`
    found_mass: NDArray[np.float64]  # [t] of being found, anywhere on the route; the next view places it
    doubt: Doubt
    seed: int  # of all random draws
    mass_moved: float = 0.0  # see `GridFilter.mass_moved`

    @classmethod
    def uniform(
        cls,
        route: Route,
        n_particles: int = DEFAULT_N_PARTICLES,
        seed: int = 0,
        rule: UpdateRule = UpdateRule.MIXTURE,
    ) -> Self:
        """The belief that knows nothing: one particle in each of m equal stretches of the route."""
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
        drawn_m = position_m + std_m * rng.standard_normal(n_particles)
        return cls._equal(route, _onto(route, drawn_m), seed, rule, LOST_AT_FIX)

    @classmethod
    def _equal(cls, route: Route, position_m: NDArray[np.float64], seed: int, rule: UpdateRule, lost: float) -> Self:
        doubt = Doubt.at_start(rule, lost)
        weights = np.repeat((1 - doubt.lost)[:, np.newaxis] / position_m.size, position_m.size, axis=1)
        return cls(route, position_m, weights, np.zeros_like(doubt.lost), doubt, seed)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]], seed: int) -> Self:
        """The belief whose arrays `arrays` gave."""
        return cls(route, arrays["position_m"], arrays["weights"], arrays["found"], Doubt.from_arrays(arrays), seed)

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """The named arrays from which `from_arrays` restores it."""
        arrays = {"position_m": self.position_m, "weights": self.weights, "found": self.found_mass}
        return {**arrays, **self.doubt.arrays()}

    @cached_property
    def _mean_weights(self) -> NDArray[np.float64]:
        """[m] averaged over the trusts."""
        return np.asarray(self.doubt.trust @ self.weights)

    @cached_property
    def mass(self) -> NDArray[np.float32]:
        """[n] belief of map images, sums to 1; a particle counts for its stretch, images of one place share a mass."""
        route, weights, order = self.route, self._mean_weights, np.argsort(self.position_m, kind="stable")
        if self.doubt.is_mixture:
            mass = _on_images(route, *_stretches(route, self.position_m[order]), weights[order])
        else:  # in the paper a particle counts for the image nearest to it
            mass = np.bincount(route.nearest_image(self.position_m), weights, route.n_images).astype(np.float64)
        mass = mass + (self.doubt.trust @ self.found_mass) * route.cell_m / route.cell_m.sum()
        return np.asarray(mass / max(mass.sum(), _NOTHING), np.float32)

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:
        """See `GridFilter.predicted`; a particle that would be past the end of an open route dies.

        Particles of a mixture are resampled here rather than after the last view, whose weights tell more than draws.
        """
        route, source = self.route, self._evened_out(step) if self.doubt.is_mixture else self
        rng = np.random.default_rng([self.seed, step, _MOVE])
        target_m, weights = source.position_m + action_m, source.weights
        if not route.closed and action_m != 0:
            reach_m = SIGMAS * action_std_m + 1e-9
            past_m = np.maximum(target_m - route.position_m[-1], route.start_m - target_m)
            weights = np.where(past_m > (reach_m if self.doubt.is_mixture else 1e-9), 0.0, weights)
            if not weights.any():  # it may still have stopped at the end
                weights = np.where(past_m > reach_m, 0.0, source.weights)
            target_m = np.clip(target_m, route.start_m, route.position_m[-1])
        on_route, surviving = source.weights.sum(axis=1) + self.found_mass, weights.sum(axis=1) + self.found_mass
        if step == 1 or not self.doubt.is_mixture:  # a later move past the end may mean that the robot was carried
            check_ahead(route, self.doubt, on_route, surviving, action_m)
        lost, staying, found_mass = leaving_and_found(self.doubt, self.doubt.lost, on_route, surviving, action_m)
        found_mass = found_mass + staying * self.found_mass  # what an uninformative view has not placed
        stds_m = move_stds_m(action_m, action_std_m, self.doubt.is_mixture)
        std_m = rng.choice(list(stds_m.values()), target_m.size, p=list(stds_m))
        position_m = _onto(route, target_m + std_m * rng.standard_normal(target_m.size))
        last = None if self.doubt.last is None else moved_along(route, self.doubt.last, action_m)
        belief = replace(
            self,
            position_m=position_m,
            weights=weights * staying[:, np.newaxis],
            found_mass=found_mass,
            doubt=replace(self.doubt, lost=lost, last=last, since_last_m=self.doubt.since_last_m + action_m),
        )
        return belief._resampled(step) if (weights.sum(axis=0) == 0).any() and surviving.any() else belief

    def updated(self, evidence: ViewEvidence, step: int) -> Self:
        """See `GridFilter.updated`; the paper's particles are resampled at once where their weights are uneven."""
        least_moved = 0.0
        if evidence.rule.is_additive:
            images, on_route = self.route.nearest_image(self.position_m), 1 - self.doubt.lost
            weights = np.outer(on_route, add_evidence(self._mean_weights / on_route.mean(), evidence.values[images]))
            belief = replace(self, weights=weights, found_mass=np.zeros_like(self.found_mass))
            particles = belief if self.doubt.is_mixture else belief._evened_out(step)
        else:
            values = self.route.places.means(evidence.values)
            likelihood, least_moved = evidence.likelihood(values, self.doubt.last)
            profile = _Profile.of(self.route, likelihood)
            ends_m = np.array([self.route.start_m, self.route.start_m + self.route.length_m])
            average = profile.means(ends_m[:1], ends_m[1:], self.doubt.trust.size)[:, 0]
            weights, found_mass = self.weights * self._likelihoods(profile), self.found_mass * average
            lost = self.doubt.lost * average
            if (is_excluded := weights.sum(axis=1) + found_mass <= _NOTHING).any():  # places keep their shares
                scale = LEAST_ALLOWED * average / np.maximum(self.weights.sum(axis=1) + self.found_mass, _NOTHING)
                weights = np.where(is_excluded[:, np.newaxis], self.weights * scale[:, np.newaxis], weights)
                found_mass = np.where(is_excluded, self.found_mass * scale, found_mass)
            total = weights.sum(axis=1) + found_mass + lost
            doubt = Doubt(lost / total, self.doubt.log_trust + np.log(total / average), values)
            belief = replace(self, weights=weights / total[:, np.newaxis], found_mass=found_mass / total, doubt=doubt)
            particles = belief._with_found_placed(profile, step) if doubt.is_mixture else belief._evened_out(step)
        mass_moved = 0.5 * float(np.abs(belief._believed - self._believed).sum())
        return replace(particles, mass_moved=max(mass_moved, least_moved))

    def _likelihoods(self, profile: "_Profile") -> NDArray[np.float64]:
        """[t, m] likelihoods of the particles, by trust; of a mixture the means over their stretches."""
        if not self.doubt.is_mixture:
            return profile.at(self.position_m)[np.newaxis]
        order, likelihoods = np.argsort(self.position_m, kind="stable"), np.empty_like(self.weights)
        likelihoods[:, order] = profile.means(*_stretches(self.route, self.position_m[order]), self.doubt.trust.size)
        return likelihoods

    @property
    def _believed(self) -> NDArray[np.float64]:
        """[m + 1] belief of the particles and of the found mass, given that the robot is on the route; sums to 1."""
        masses = np.append(self._mean_weights, self.doubt.trust @ self.found_mass)
        return np.asarray(masses / max(masses.sum(), _NOTHING))

    def _evened_out(self, step: int) -> Self:
        """Resampled where the effective sample size has fallen below half the particles."""
        weights = self._mean_weights
        effective = np.square(weights.sum()) / max(np.square(weights).sum(), _NOTHING)
        return self if effective >= weights.size / 2 else self._resampled(step)

    def _with_found_placed(self, profile: "_Profile", step: int) -> Self:
        """The found mass as particles where the view says that it may be, at least a few, in place of the lightest.

        Args:
            profile: How likely the view is along the route.
            step: Number of this step in the session.
        """
        trust, m = self.doubt.trust, self.position_m.size
        if not self.found_mass.any():
            return self
        n_placed = int(np.clip(round(float(trust @ self.found_mass) * m), min(_LEAST_PLACED, m // 2), m // 2))
        if n_placed == 0:
            doubt = replace(self.doubt, lost=self.doubt.lost + self.found_mass)
            return replace(self, doubt=doubt, found_mass=0 * self.found_mass)
        rng = np.random.default_rng([self.seed, step, _RETURN])
        cumulated = _cumulated(profile.likelihood[: self.route.n_images], self.route.cell_m, trust * self.found_mass)
        images, _ = _comb(cumulated, n_placed, rng.random())
        heaviest = np.argsort(self._mean_weights, kind="stable")[n_placed:]
        if self._mean_weights[heaviest].sum() >= (1 - _NEGLIGIBLE) * self._mean_weights.sum():
            rest = self._with_particles(self.position_m[heaviest], self.weights[:, heaviest])
        else:
            rest = self._resampled(step, m - n_placed)
        half_m = self.route.cell_m[images] * (rng.random(n_placed) - 0.5)
        placed_m = _onto(self.route, self.route.position_m[images] + half_m)
        density = cumulated[images] - np.where(images > 0, cumulated[images - 1], 0.0)
        placed_weights = _by_trust(profile.at(placed_m), trust.size) * self.route.cell_m[images] / density
        placed_weights *= (self.found_mass / np.maximum(placed_weights.sum(axis=1), _NOTHING))[:, np.newaxis]
        position_m = np.concatenate([rest.position_m, placed_m])
        weights = np.concatenate([rest.weights, placed_weights], axis=1)
        return replace(self, position_m=position_m, weights=weights, found_mass=np.zeros_like(self.found_mass))

    def _resampled(self, step: int, n_particles: int | None = None) -> Self:
        """Systematic resampling: one draw places an even comb over the cumulated weights.

        Those of a mixture are drawn from the stretches that they stand for, so that no two are the same, and by the
        root of their weights (Liu, Chen and Logvinenko 2001), so that unlikely places keep particles for when the next
        views speak for them.
        """
        n = n_particles or self.position_m.size
        mean_weights = self._mean_weights
        if mean_weights.sum() <= 0:
            return self
        rng = np.random.default_rng([self.seed, step, _RESAMPLE])
        draw_weights = mean_weights**_EVENNESS if self.doubt.is_mixture else mean_weights
        if self.doubt.is_mixture:
            order = np.argsort(self.position_m, kind="stable")
            drawn_ids, part = _comb(np.cumsum(draw_weights[order]), n, rng.random())
            low_m, high_m = _stretches(self.route, self.position_m[order])
            position_m = low_m[drawn_ids] + part * (high_m - low_m)[drawn_ids]
            drawn_ids = order[drawn_ids]
        else:
            drawn_ids, _ = _comb(np.cumsum(draw_weights), n, rng.random())
            position_m = self.position_m[drawn_ids]
        weights = np.ascontiguousarray(self.weights[:, drawn_ids]) / draw_weights[drawn_ids]
        return self._with_particles(position_m, weights)

    def _with_particles(self, position_m: NDArray[np.float64], weights: NDArray[np.float64]) -> Self:
        """Other particles [m], [t, m], scaled so that each trust believes in the route as much as before."""
        total = np.maximum(weights.sum(axis=1), _NOTHING)
        return replace(self, position_m=position_m, weights=weights * (self.weights.sum(axis=1) / total)[:, np.newaxis])


def _by_trust(likelihood: NDArray[np.float64], n_trusts: int) -> NDArray[np.float64]:
    """[t, m] likelihoods from those of the least trust [m]; each trust is twice the one before, each row a square."""
    rows = [likelihood]
    for _ in range(1, n_trusts):
        rows.append(np.square(rows[-1]))
    return np.array(rows)


@dataclass(frozen=True)
class _Profile:
    """How likely a view is along the route; between two images its logarithm is linear."""

    at_m: NDArray[np.float64]  # [w] positions of the images; of a closed route also of the first, once around
    likelihood: NDArray[np.float64]  # [w] of the least trust
    log: NDArray[np.float64]  # [w] of `likelihood`

    @classmethod
    def of(cls, route: Route, likelihood: NDArray[np.float32]) -> Self:
        """From the likelihoods of images [n], which are equal for images of one place."""
        at_m, at_images = route.position_m, likelihood.astype(np.float64)
        if route.closed:
            at_m, at_images = np.append(at_m, route.start_m + route.length_m), np.append(at_images, at_images[0])
        return cls(at_m, at_images, np.log(np.maximum(at_images, _NOTHING)))

    def at(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """[m] likelihoods of the least trust at positions on the route [m]."""
        return np.asarray(np.exp(np.interp(position_m, self.at_m, self.log)), np.float64)

    def means(self, low_m: NDArray[np.float64], high_m: NDArray[np.float64], n_trusts: int) -> NDArray[np.float64]:
        """[t, s] mean likelihoods, by trust, of stretches [s] in ascending order that do not overlap."""
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
    """[t, s] as `_Profile.means`; of a stretch without length the likelihood at its position."""
    means, last, part = np.zeros((n_trusts, low_m.size)), at_m.size - 1, 0
    for stretch in range(low_m.size):
        from_m, end_m = low_m[stretch], high_m[stretch]
        while part + 1 < last and at_m[part + 1] <= from_m:
            part += 1
        from_log = _log_at(from_m, at_m, log, part)
        from_likelihood, length_m = np.exp(from_log), end_m - from_m
        for t in range(n_trusts if length_m <= 0 else 0):
            means[t, stretch] = from_likelihood ** (1 << t)
        while from_m < end_m:  # the pieces between two positions each
            to_m, to_log, to_likelihood = end_m, 0.0, 0.0
            if part + 1 == last or end_m < at_m[part + 1]:
                to_log = _log_at(end_m, at_m, log, part)
                to_likelihood = np.exp(to_log)
            else:
                to_m, to_log, to_likelihood = at_m[part + 1], log[part + 1], likelihood[part + 1]
                part += 1
            low, high, rise, share = from_likelihood, to_likelihood, to_log - from_log, (to_m - from_m) / length_m
            for t in range(n_trusts):
                means[t, stretch] += share * ((high - low) / rise if abs(rise) > _LEVEL else high)
                low, high, rise = low * low, high * high, 2 * rise
            from_m, from_log, from_likelihood = to_m, to_log, to_likelihood
    return means


@njit(cache=True, nogil=True)
def _log_at(metres: float, at_m: NDArray[np.float64], log: NDArray[np.float64], part: int) -> float:
    """The logarithm at a position between `at_m[part]`, `at_m[part + 1]`; at the first where they are equal."""
    if metres <= at_m[part]:
        return float(log[part])
    return float(log[part] + (log[part + 1] - log[part]) * (metres - at_m[part]) / (at_m[part + 1] - at_m[part]))


@njit(cache=True, nogil=True)
def _cumulated(
    likelihood: NDArray[np.float64], cell_m: NDArray[np.float64], found_mass: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[n] how much of the found mass [t] is at an image or before it, spread by the likelihoods of each trust."""
    sums = np.zeros(found_mass.size)
    for image in range(likelihood.size):
        power = likelihood[image]
        for t in range(found_mass.size):
            sums[t] += power * cell_m[image]
            power *= power
    shares, cumulated, total = found_mass / sums, np.empty(likelihood.size), 0.0
    for image in range(likelihood.size):
        power = likelihood[image]
        for t in range(found_mass.size):
            total += shares[t] * power * cell_m[image]
            power *= power
        cumulated[image] = total
    return cumulated


def _comb(cumulated: NDArray[np.float64], count: int, offset: float) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """[count] ids, each as often as its weight asks for, and where each tooth stands in its id's weight, 0 to 1."""
    teeth = cumulated[-1] * (np.arange(count) + offset) / count
    ids = np.minimum(np.searchsorted(cumulated, teeth, side="right"), cumulated.size - 1)
    below = np.where(ids > 0, cumulated[ids - 1], 0.0)
    part = (teeth - below) / np.maximum(cumulated[ids] - below, _NOTHING)
    return np.asarray(ids, np.intp), np.asarray(np.clip(part, 0, 1), np.float64)


def _stretches(route: Route, position_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[m], [m] where the stretches of particles at ascending positions [m] begin and end.

    They reach half the way to the next particles, but no farther than those of a belief that knows nothing.
    """
    reach_m = max(route.length_m / position_m.size, route.cells.step_m) / 2
    half_m = np.minimum(np.diff(position_m) / 2, reach_m)
    low_m, high_m = position_m - np.r_[reach_m, half_m], position_m + np.r_[half_m, reach_m]
    end_m = route.start_m + route.length_m
    return np.clip(low_m, route.start_m, end_m), np.clip(high_m, route.start_m, end_m)


def _on_images(
    route: Route, low_m: NDArray[np.float64], high_m: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[n] masses of map images, of weights [m] that lie evenly on ascending stretches that do not overlap."""
    places = route.places
    middle_m = (places.position_m[1:] + places.position_m[:-1]) / 2
    last_m = route.start_m + route.length_m
    if route.closed:  # behind the last image the first may be nearer
        middle_m = np.append(middle_m, (places.position_m[-1] + last_m) / 2)
    below = _below(middle_m, low_m, high_m, weight)
    mass = np.maximum(np.diff(below, prepend=0.0, append=weight.sum()), 0.0)  # a difference may round below 0
    if route.closed:
        mass = np.concatenate([mass[:1] + mass[-1:], mass[1:-1]])
    return mass if mass.size == route.n_images else np.asarray(mass[places.of_image] / places.n_images[places.of_image])


@njit(cache=True, nogil=True)
def _below(
    at_m: NDArray[np.float64], low_m: NDArray[np.float64], high_m: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[k] how much of the weights [m], spread evenly over their stretches, lies below ascending positions [k]."""
    below, total, part = np.empty(at_m.size), 0.0, 0
    for k in range(at_m.size):
        while part < weight.size and high_m[part] <= at_m[k]:
            total += weight[part]
            part += 1
        below[k] = total
        if part < weight.size and at_m[k] > low_m[part]:
            below[k] += weight[part] * (at_m[k] - low_m[part]) / (high_m[part] - low_m[part])
    return below


def _onto(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions brought onto the route: wrapped around a closed one, mirrored at the ends of an open one."""
    if route.closed and route.length_m > 0:
        return route.wrapped(position_m)
    start_m, end_m = route.start_m, route.position_m[-1]
    mirrored_m = end_m - np.abs(end_m - start_m - np.abs(position_m - start_m))
    return np.asarray(np.clip(mirrored_m, start_m, end_m), np.float64)


class FilterKind(StrEnum):
    """The filters that exist."""

    GRID = "grid"
    PARTICLE = "particle"


BeliefFilter: TypeAlias = GridFilter | ParticleFilter
"""A belief over the route. Immutable: every call returns a new one, so a failed step leaves nothing half done."""
