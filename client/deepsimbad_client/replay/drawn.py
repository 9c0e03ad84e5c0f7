"""What every viewer of a replay draws, in metres: the route, the belief standing on it, where to go next."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route
from deepsimbad_client.http.models import Belief, NextBestView
from deepsimbad_client.recordings import Frame

LEAST_SHARE = 0.002  # of the fullest bin; less is not drawn
BLUE, QUIET, AMBER, GREEN = (31, 95, 191), (138, 151, 163), (217, 119, 6), (26, 110, 60)

Points = NDArray[np.float64]  # [k, 3] x, y, height


@dataclass(frozen=True)
class Ground:
    """A route as it lies in the plane, or along x where nobody knows its x and y."""

    route: Route
    line: Points  # one a map image whose place is known
    at_m: NDArray[np.float64]  # [k] where along the route

    @classmethod
    def of(cls, route: Route) -> "Ground":
        """Leave out images without a place."""
        x_m, y_m = route.x_m, route.y_m
        if x_m is None or y_m is None:
            x_m, y_m = route.position_m, np.zeros_like(route.position_m)
        is_known = np.isfinite(x_m) & np.isfinite(y_m)
        line = np.stack([x_m, y_m, np.zeros_like(x_m)], axis=1)[is_known]
        return cls(route, line, route.position_m[is_known])

    def at(self, position_m: NDArray[np.float64] | float) -> Points:
        """Places along the route, round a closed one and never past an open one's ends."""
        wrapped_m = np.atleast_1d(self.route.wrapped(np.asarray(position_m, np.float64)))
        return np.stack([np.interp(wrapped_m, self.at_m, axis) for axis in self.line.T], axis=1)

    def belief(self, belief: Belief) -> tuple[Points, NDArray[np.float64]]:
        """Feet of the bars that stand for a belief, and their shares of the highest, 0 to 1."""
        edges_m, mass = np.array(belief.histogram.edges_m), np.array(belief.histogram.mass)
        share = mass / max(mass.max(), 1e-12)
        is_drawn = share > LEAST_SHARE
        return self.at((edges_m[:-1] + edges_m[1:])[is_drawn] / 2), share[is_drawn]

    @property
    def highest_m(self) -> float:
        """Of a bar, so that it is seen beside the whole route."""
        return float(max(np.ptp(self.line, axis=0).max() / 8, 1.0))

    def ahead(self, belief: Belief, next_best_view: NextBestView) -> Points:
        """The likeliest place after the move that is asked for, where it is told to stop the one there is."""
        return self.at(belief.mode_m + (0.0 if next_best_view.stop else next_best_view.action_m))


def asked(next_best_view: NextBestView) -> str:
    """The next move, for people."""
    if next_best_view.stop:
        return "stop: it knows where it is"
    return f"next view {next_best_view.action_m:+g} m"


class Clock:
    """Times of views: a frame's own where they go on from one to the next, else a second later."""

    def __init__(self) -> None:
        self._last_us = 0

    def of(self, frame: Frame) -> int:
        """Unix microseconds."""
        own_us = frame.timestamp_us
        self._last_us = own_us if own_us is not None and own_us > self._last_us else self._last_us + 1_000_000
        return self._last_us
