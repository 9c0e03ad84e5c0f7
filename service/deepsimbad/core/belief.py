"""Belief over the route (II-C): the exact grid filter over map images, and its summary."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.relevance import Relevance
from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.route import Route

HISTOGRAM_BINS = 200
_CREDIBLE_SHARE = 0.95


class UpdateRule(StrEnum):
    """How one view's relevance changes the belief."""

    ADDITIVE_RELEVANCE = "additive_relevance"
    ADDITIVE_RECIPROCAL_RANK = "additive_reciprocal_rank"
    LOG_LIKELIHOOD = "log_likelihood"


DEFAULT_UPDATE = {
    Relevance.STANDARDISED: UpdateRule.LOG_LIKELIHOOD,
    Relevance.RRF: UpdateRule.ADDITIVE_RELEVANCE,
    Relevance.BAG_OF_LANDMARKS: UpdateRule.ADDITIVE_RELEVANCE,
    Relevance.SIMBAD: UpdateRule.ADDITIVE_RECIPROCAL_RANK,
    Relevance.BRUTE_FORCE: UpdateRule.ADDITIVE_RECIPROCAL_RANK,
}


@dataclass(frozen=True)
class BeliefSummary:
    """What a person or planner reads of a belief.

    Attributes:
        mean_m, std_m: Mean and standard deviation of the position; circular on a closed route.
        mode_m: Position of the map image with the greatest mass.
        credible_95_m: The shortest stretch that holds 95 % of the mass; lo > hi crosses a closed route's start.
        entropy_bits: Entropy over map images.
        off_route: Probability that the robot is nowhere on the route; None until it is calibrated.
        histogram_edges_m, histogram_mass: Equal bins along the route, at most 200; [b + 1] and [b].
        top: Ids of the map images with the greatest mass, best first.
        top_mass: Their masses.
    """

    mean_m: float
    mode_m: float
    std_m: float
    credible_95_m: tuple[float, float]
    entropy_bits: float
    off_route: float | None
    histogram_edges_m: NDArray[np.float64]
    histogram_mass: NDArray[np.float64]
    top: NDArray[np.int64]
    top_mass: NDArray[np.float64]


@dataclass(frozen=True)
class GridBelief:
    """A mass for every map image; the masses sum to 1.

    Attributes:
        route: Where the map images are.
        mass: [n] float64.
    """

    route: Route
    mass: NDArray[np.float64]

    @classmethod
    def uniform(cls, route: Route) -> Self:
        """No knowledge: every metre of the route alike, so images of one long stop share one place's mass."""
        return cls(route, route.cell_m / route.cell_m.sum())

    def updated(self, relevance: NDArray[np.float32], rule: UpdateRule) -> Self:
        """The belief after one view.

        Args:
            relevance: [n], larger is better.
            rule: How it counts. The additive rules weigh a view against the masses times n, so that a belief
                that knows nothing has weight 1 a map image, as n particles of the paper's filter would.
        """
        if rule is UpdateRule.LOG_LIKELIHOOD:
            log_likelihood = relevance.astype(np.float64)
            mass = self.mass * np.exp(log_likelihood - log_likelihood.max())
        else:
            if rule is UpdateRule.ADDITIVE_RELEVANCE:
                evidence = np.maximum(relevance.astype(np.float64), 0.0)
            else:
                evidence = 1.0 / _mean_ranks(relevance)
            mass = self.mass * self.mass.size + evidence
        total = mass.sum()
        if not np.isfinite(total) or total <= 0:  # every likely place was already excluded: start anew
            return self.uniform(self.route)
        return type(self)(self.route, mass / total)

    def summary(self, n_top: int) -> BeliefSummary:
        """Summarise, with the `n_top` likeliest map images."""
        top = shortlist(self.mass, n_top)
        mean_m, std_m = self._moments()
        held = self.mass[self.mass > 0]
        edges_m, bins = _bins(self.route)
        return BeliefSummary(
            mean_m=mean_m,
            mode_m=float(self.route.position_m[top[0]]),
            std_m=std_m,
            credible_95_m=self._credible_stretch(),
            entropy_bits=max(0.0, float(-(held * np.log2(held)).sum())),
            off_route=None,
            histogram_edges_m=edges_m,
            histogram_mass=np.asarray(np.bincount(bins, self.mass, edges_m.size - 1), np.float64),
            top=top,
            top_mass=self.mass[top],
        )

    def _moments(self) -> tuple[float, float]:
        position = self.route.position_m
        if self.route.closed and self.route.length_m > 0:
            turn = 2 * np.pi / self.route.length_m
            resultant = (self.mass * np.exp(1j * turn * (position - self.route.start_m))).sum()
            mean = self.route.start_m + (np.angle(resultant) / turn) % self.route.length_m
        else:
            mean = (self.mass * position).sum()  # not `@`: waking BLAS threads costs more than the product
        offset = self.route.offset_m(position, float(mean))
        return float(mean), float(np.sqrt((self.mass * np.square(offset)).sum()))

    def _credible_stretch(self) -> tuple[float, float]:
        """Shortest stretch of images whose masses reach 95 %, by sliding its end for every start."""
        position, n = self.route.position_m, self.mass.size
        mass = np.r_[self.mass, self.mass] if self.route.closed else self.mass
        unrolled = np.r_[position, position + self.route.length_m] if self.route.closed else position
        before = np.r_[0.0, np.cumsum(mass)]
        wanted = before[:n] + _CREDIBLE_SHARE * (1 - 1e-12)
        last = np.searchsorted(before[1:], wanted)  # the image whose mass reaches the share
        starts = np.flatnonzero(last < mass.size)
        best = starts[np.argmin(unrolled[last[starts]] - unrolled[starts])]
        return float(position[best]), float(position[last[best] % n])


def _mean_ranks(relevance: NDArray[np.float32]) -> NDArray[np.float64]:
    """[n] rank of every map image in the retrieval, from 1; tied images share their mean rank."""
    _, place, counts = np.unique(-relevance, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - (counts - 1) / 2
    return np.asarray(mean_rank[place], np.float64)


def _bins(route: Route) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Histogram edges over the route, and every map image's bin."""
    n_bins = min(HISTOGRAM_BINS, route.n_images)
    width_m = route.length_m / n_bins
    if width_m <= 0:
        return np.array([route.start_m, route.start_m]), np.zeros(route.n_images, np.intp)
    edges_m = np.linspace(route.start_m, route.start_m + route.length_m, n_bins + 1)
    bins = ((route.position_m - route.start_m) / width_m).astype(np.intp)
    return edges_m, np.minimum(bins, n_bins - 1, dtype=np.intp)
