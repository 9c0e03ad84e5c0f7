"""What a view says of places and how far it is to be trusted, for both filters.

The robot is somewhere on the route or lost: off it, or anywhere on it after having been carried. How well the believed
places explain a view, against the map on the whole, decides between the two.

Views err alike where they are near each other, so a view counts by what it says beyond the one before, carried along by
the move; this is generalised least squares for errors that are autoregressive along the route. And how far this season
can be trusted nobody knows before: the belief is a mixture of three, which trust a view half, once and twice as much as
the map learnt, weighed by how well each has predicted the views so far (`mixture`, ours). The paper's updates have one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.relevance import UpdateRule, mean_ranks
from deepsimbad.core.route import Route

TRUSTS = (0.5, 1.0, 2.0)
"""How much of the learnt log-likelihood each part of a mixture believes; each twice the one before."""

PRIOR_TRUST = (0.2, 0.4, 0.4)
"""How probable each trust is before any view: few seasons are as bad as the least takes them for."""

TRUSTS_OF = {rule: TRUSTS if rule is UpdateRule.MIXTURE else (1.0,) for rule in UpdateRule}

LEAST_ALLOWED = 1e-12
"""How likely a view is at places that it excludes, relative to the map on average: no belief loses all its mass."""

LOST_AT_START, LOST_AT_FIX = 0.02, 0.005  # probability before any view: of a robot anywhere, and after a fix


@dataclass(frozen=True)
class ViewEvidence:
    """What one view says of every map image."""

    rule: UpdateRule
    # [n] log-likelihoods but for a constant, of mean 0; or the weights that additive rules add
    values: NDArray[np.float32]
    shared_error: float = 0.0  # c', share of its error that is that of the view before; counts where there was one

    @classmethod
    def of(cls, relevance: NDArray[np.float32], rule: UpdateRule, scale: float, shared_error: float = 0.0) -> Self:
        """From a view's relevance [n], which times `scale` is a log-likelihood."""
        if rule.is_additive:
            return cls(rule, _addends(relevance, rule).astype(np.float32))
        return cls(rule, _centred(relevance, scale), shared_error if rule is UpdateRule.MIXTURE else 0.0)

    def likelihood(
        self, values: NDArray[np.float32], last: NDArray[np.float32] | None
    ) -> tuple[NDArray[np.float32], float]:
        """How likely the view is, by what its values [m] say beyond the last view's.

        Args:
            values: Its values, of map images or at cells.
            last: Those of the last view [m], carried along by the move; None where there was none.

        Returns:
            [m] likelihoods by the least trust, the greatest 1, so that none overflows; and the share of a belief that
            knew nothing which they would have moved elsewhere, as far as it is small.
        """
        trust = TRUSTS_OF[self.rule][0]
        exponent, size = _news(values, *((values, 0.0) if last is None else (last, self.shared_error)), trust)
        return np.exp(exponent, out=exponent), 0.5 * trust * size


def batch_evidence(relevance: NDArray[np.float32], rule: UpdateRule, scale: float) -> NDArray[np.float32]:
    """[e, n] float32: what views of this relevance [e, n] add to weights of mean 1, or multiply them by.

    It is what `ViewEvidence` says of each, believed once and in single precision, with no view before.
    """
    if rule.is_additive:
        return np.asarray(_addends(relevance, rule), np.float32)
    return np.asarray(np.exp(np.float32(scale) * (relevance - relevance.max(axis=1, keepdims=True))), np.float32)


def _addends(relevance: NDArray[np.float32], rule: UpdateRule) -> NDArray[np.floating]:
    """What an additive rule adds, for relevances [n] or [e, n]: what is above 0 of them, or their reciprocal ranks."""
    if rule is UpdateRule.ADDITIVE_RELEVANCE:
        return np.maximum(relevance, 0)
    return np.asarray(1.0 / np.apply_along_axis(mean_ranks, -1, relevance))


@njit(cache=True, nogil=True, fastmath=SUMS)
def _centred(relevance: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    """[n] `scale` times the relevance less its mean."""
    total = 0.0
    for i in range(relevance.size):
        total += relevance[i]
    mean, factor, values = np.float32(total / relevance.size), np.float32(scale), np.empty_like(relevance)
    for i in range(relevance.size):
        values[i] = factor * (relevance[i] - mean)
    return values


@njit(cache=True, nogil=True, fastmath=SUMS)
def _news(
    values: NDArray[np.float32], last: NDArray[np.float32], shared_error: float, trust: float
) -> tuple[NDArray[np.float32], float]:
    """What values [m] say beyond the last ones [m], of whose error theirs contains the share `shared_error`.

    Returns:
        [m] `trust` times that, shifted so that the greatest is 0; and the mean size of it without trust and shift.
    """
    news, size, factor, shared = np.empty_like(values), 0.0, trust / (1 + shared_error), np.float32(shared_error)
    for i in range(values.size):
        news[i] = np.float32(factor) * (values[i] - shared * last[i])
        size += abs(news[i])
    greatest = news[0]
    for i in range(values.size):
        greatest = max(greatest, news[i])
    for i in range(values.size):
        news[i] -= greatest
    return news, size / (trust * values.size)


@dataclass(frozen=True)
class Doubt:
    """What both filters hold besides places: whether the robot is lost, and how far views are trusted."""

    lost: NDArray[np.float64]  # [t] probability of being lost, by trust
    log_trust: NDArray[np.float64]  # [t] logarithm of each trust's weight: how well it has predicted the views so far
    # [n] values of the last view that showed a place, carried along by the moves since; and how far these have led
    last: NDArray[np.float32] | None = None
    since_last_m: float = 0.0

    @classmethod
    def at_start(cls, rule: UpdateRule, lost: float) -> Self:
        """The doubt before any view, of a robot that is lost with this probability."""
        n = len(TRUSTS_OF[rule])
        return cls(np.full(n, lost), np.log(PRIOR_TRUST) if n > 1 else np.zeros(n))

    @property
    def is_mixture(self) -> bool:
        """Whether a robot may get lost and be found; in the paper's updates it is lost as likely as at the start."""
        return self.lost.size > 1

    @cached_property
    def trust(self) -> NDArray[np.float64]:
        """[t] probability of each trust; sums to 1."""
        weight = np.exp(self.log_trust - self.log_trust.max())
        return np.asarray(weight / weight.sum())

    @cached_property
    def off_route(self) -> float:
        """Probability of being lost."""
        return float(self.trust @ self.lost)

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """The named arrays from which `from_arrays` restores it."""
        arrays: dict[str, NDArray[np.floating]] = {"lost": self.lost, "log_trust": self.log_trust}
        if self.last is None:
            return arrays
        return {**arrays, "last": self.last, "since_last_m": np.array([self.since_last_m])}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.float64]]) -> Self:
        """The doubt whose arrays `arrays` gave."""
        since_last_m = arrays.get("since_last_m", np.zeros(1))  # earlier releases had none
        last = arrays["last"].astype(np.float32) if "last" in arrays else None
        return cls(arrays["lost"], arrays["log_trust"], last, float(since_last_m[0]))


def moved_along(route: Route, values: NDArray[np.float32], action_m: float) -> NDArray[np.float32]:
    """[n] values of map images carried along by a move: each gets that of the place `action_m` behind it, or 0."""
    if action_m == 0 or route.length_m == 0:
        return values
    from_m = route.wrapped(route.position_m - action_m)
    if route.closed:
        return np.interp(from_m, route.position_m, values, period=route.length_m).astype(np.float32)
    return np.interp(from_m, route.position_m, values, left=0.0, right=0.0).astype(np.float32)


def add_evidence(mass: NDArray[np.floating], values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Masses [m], summing to 1, after values [m] are added, as the paper adds `v[u_k]` to its particles' weights.

    Weights have mean 1 for that, so that the belief that knows nothing gives every hypothesis weight 1, however many
    there are.
    """
    weights = mass * mass.size + values
    return np.asarray(weights / weights.sum(), np.float64)
