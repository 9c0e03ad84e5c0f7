"""The prelearned route: where along it every map image was taken (II-C, the robot's 1-D state)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidRouteError

_LEAST_LENGTH_M = 1e-9  # counted in steps that are far shorter, moves would overflow


@dataclass(frozen=True)
class Places:
    """The distinct positions of a route; images of one stop share a place.

    Attributes:
        position_m: [p] float64, strictly increasing.
        of_image: [n] the place of every map image.
        n_images: [p] images at every place.
    """

    position_m: NDArray[np.float64]
    of_image: NDArray[np.intp]
    n_images: NDArray[np.intp]


@dataclass(frozen=True)
class Route:
    """Route positions of the map images, in route order.

    Attributes:
        position_m: [n] float64, non-decreasing, metres driven along the route.
        closed: The end joins the start.
        x_m, y_m: [n] float64 in the recording's plane, NaN where unknown; None where never known.
    """

    position_m: NDArray[np.float64]
    closed: bool = False
    x_m: NDArray[np.float64] | None = None
    y_m: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.position_m.ndim != 1 or self.position_m.size == 0:
            raise InvalidRouteError("a route needs at least one position")
        if not np.isfinite(self.position_m).all():
            first = int(np.flatnonzero(~np.isfinite(self.position_m))[0])
            raise InvalidRouteError(f"route position of frame {first} is NaN or infinite", frame=first)
        steps = np.diff(self.position_m)
        if (steps < 0).any():
            first = int(np.flatnonzero(steps < 0)[0]) + 1
            raise InvalidRouteError(
                f"route position goes backwards at frame {first}: {self.position_m[first - 1]:.3f} m then "
                f"{self.position_m[first]:.3f} m",
                frame=first,
            )
        if 0 < self.length_m < _LEAST_LENGTH_M:
            raise InvalidRouteError(
                f"the route is {self.length_m:g} m long: {_LEAST_LENGTH_M:g} m is the least above 0"
            )
        for array in (self.position_m, self.x_m, self.y_m):
            if array is not None:
                array.setflags(write=False)

    @property
    def n_images(self) -> int:
        """n."""
        return int(self.position_m.size)

    @property
    def start_m(self) -> float:
        """Position of the first map image."""
        return float(self.position_m[0])

    @cached_property
    def length_m(self) -> float:
        """Metres from the start to the end; of a closed route once around, back to the start."""
        span = float(self.position_m[-1] - self.position_m[0])
        return span + self._closing_gap_m if self.closed else span

    @cached_property
    def _closing_gap_m(self) -> float:
        """Metres from the last map image on to the first: in the plane where known, else a usual step."""
        if self.x_m is not None and self.y_m is not None:
            gap = float(np.hypot(self.x_m[0] - self.x_m[-1], self.y_m[0] - self.y_m[-1]))
            if np.isfinite(gap):
                return gap
        steps = np.diff(self.position_m)
        moving = steps[steps > 0]
        return float(np.median(moving)) if moving.size else 0.0

    @cached_property
    def cell_m(self) -> NDArray[np.float64]:
        """[n] metres of route that each map image stands for: half the way to either neighbour.

        Images taken while standing still share one place's cell. A route of no length has equal cells.
        """
        steps = np.diff(self.position_m)
        if self.length_m <= 0:
            return np.ones(self.n_images)
        if self.closed:
            before, after = np.r_[self._closing_gap_m, steps], np.r_[steps, self._closing_gap_m]
        else:
            before, after = np.r_[steps[:1], steps], np.r_[steps, steps[-1:]]
        cells = (before + after) / 2
        return cells if cells.sum() > 0 else np.ones(self.n_images)

    def offset_m(self, position_m: NDArray[np.float64], from_m: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed metres along the route to positions, from one or each from its own; the short way on a closed one."""
        offset = np.asarray(position_m, np.float64) - from_m
        if not self.closed or self.length_m <= 0:
            return offset
        half = self.length_m / 2
        return np.asarray((offset + half) % self.length_m - half)

    @cached_property
    def places(self) -> Places:
        """The distinct positions."""
        position_m, of_image, n_images = np.unique(self.position_m, return_inverse=True, return_counts=True)
        return Places(position_m, of_image, n_images)

    def nearest_image(self, position_m: NDArray[np.float64]) -> NDArray[np.intp]:
        """The map image nearest to each position along the route; of two equally near the earlier."""
        known = self.position_m
        after = np.clip(np.searchsorted(known, position_m), 1, max(self.n_images - 1, 1))
        if self.n_images == 1:
            return np.zeros(np.shape(position_m), np.intp)
        before = after - 1
        nearest = np.where(position_m - known[before] <= known[after] - position_m, before, after)
        if self.closed:  # behind the last image the first may be nearer
            behind = position_m - known[-1]
            nearest = np.where(behind > self._closing_gap_m - behind, 0, nearest)
        return np.asarray(nearest, np.intp)

    def histogram(self, max_bins: int) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Edges [b + 1] of equal bins over the whole route, and every map image's bin [n]."""
        if max_bins not in self._histograms:  # the same for every belief on the route
            self._histograms[max_bins] = self._histogram(max_bins)
        return self._histograms[max_bins]

    @cached_property
    def _histograms(self) -> dict[int, tuple[NDArray[np.float64], NDArray[np.intp]]]:
        return {}

    def _histogram(self, max_bins: int) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        n_bins = min(max_bins, self.n_images)
        width_m = self.length_m / n_bins
        if width_m <= 0:
            return np.array([self.start_m, self.start_m]), np.zeros(self.n_images, np.intp)
        edges_m = np.linspace(self.start_m, self.start_m + self.length_m, n_bins + 1)
        bins = ((self.position_m - self.start_m) / width_m).astype(np.intp)
        return edges_m, np.minimum(bins, n_bins - 1, dtype=np.intp)
