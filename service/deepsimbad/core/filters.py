"""What every belief filter does (II-C): predict, update, tell its masses."""

from enum import StrEnum
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.update_rules import UpdateRule

LEAST_SURVIVING_SHARE = 1e-9
"""Of a belief before a move along an open route; with less the move leads past the end wherever the robot may be."""


class FilterKind(StrEnum):
    """The filters that exist."""

    GRID = "grid"
    PARTICLE = "particle"


class BeliefFilter(Protocol):
    """A belief over the route. Immutable: every call returns a new one, so a failed step leaves nothing half done."""

    @property
    def mass(self) -> NDArray[np.float64]:
        """[n] mass of every map image; sums to 1."""
        ...

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:
        """The belief after a move.

        Args:
            action_m: Metres moved forward, at least 0.
            action_std_m: Standard deviation of the move, at least 0.
            step: Number of this step in the session; seeds whatever is random in it.

        Raises:
            PastTheEndError: No place of the belief has that much open route before it.
        """
        ...

    def updated(self, relevance: NDArray[np.float32], rule: UpdateRule, step: int) -> Self:
        """The belief after a view.

        Args:
            relevance: [n], larger is better.
            rule: How it counts.
            step: As in `predicted`.
        """
        ...

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state, to be stored and restored bit for bit."""
        ...


def motion_std_m(action_m: float) -> float:
    """Standard deviation of a move whose odometry says nothing of its own error.

    Independent errors add their variances: 0.1 m per square root of a metre, and 0.05 m for standing.
    """
    return float(np.sqrt(0.05**2 + 0.01 * action_m))
