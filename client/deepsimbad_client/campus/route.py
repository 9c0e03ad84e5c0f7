"""The centre line every drive follows: straight stretches joined by bends, never crossing itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.noise import stream

STEP_M = 0.5
"""Distance between two samples of the centre line."""

MAX_HEADING_RAD = np.deg2rad(62)
"""Headings stay within this of the general direction, so the route cannot meet itself again."""


@dataclass(frozen=True)
class Stretch:
    """A straight part of the route and the bend that follows it.

    Attributes:
        index: Its number along the route, from 0.
        start_m: Route position where the straight part begins.
        straight_m: Length of the straight part.
        bend_m: Length of the bend after it.
    """

    index: int
    start_m: float
    straight_m: float
    bend_m: float


class Route:
    """The centre line in the local north-east plane.

    Args:
        seed: Seed of the campus.
        length_m: At least so long; the beginning of a longer route is the shorter route.
    """

    def __init__(self, seed: int, length_m: float) -> None:
        rng = stream(seed, "route")
        general = rng.uniform(-np.pi, np.pi)
        offset, position = 0.0, 0.0
        headings: list[NDArray[np.float64]] = []
        stretches: list[Stretch] = []
        while position < length_m:
            straight = int(rng.integers(70, 150)) * STEP_M
            turn = rng.uniform(0.35, 1.5) * rng.choice([-1.0, 1.0])
            if abs(offset + turn) > MAX_HEADING_RAD:
                turn = -turn
            turn = float(np.clip(offset + turn, -MAX_HEADING_RAD, MAX_HEADING_RAD) - offset)
            bend = max(6.0, np.ceil(abs(turn) * rng.uniform(9, 20) / STEP_M) * STEP_M)
            stretches.append(Stretch(len(stretches), position, straight, bend))
            headings.append(np.full(int(straight / STEP_M), general + offset))
            share = (np.arange(int(bend / STEP_M)) + 0.5) * STEP_M / bend
            headings.append(general + offset + turn * share)
            offset += turn
            position += straight + bend
        self.stretches = tuple(stretches)
        self._heading = np.concatenate(headings)
        self._north = np.concatenate([[0.0], np.cumsum(np.cos(self._heading)) * STEP_M])
        self._east = np.concatenate([[0.0], np.cumsum(np.sin(self._heading)) * STEP_M])
        self._position = np.arange(len(self._north)) * STEP_M

    @property
    def length_m(self) -> float:
        """Length of the centre line."""
        return float(self._position[-1])

    def heading(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """[n] heading of the centre line in radians, clockwise from north, at [n] route positions."""
        centres = self._position[:-1] + STEP_M / 2
        return np.interp(position_m, centres, self._heading)

    def place(self, position_m: NDArray[np.float64], right_m: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
        """[n, 2] north and east, in metres, of the points `right_m` to the right of [n] route positions."""
        heading = self.heading(position_m)
        north = np.interp(position_m, self._position, self._north) - np.sin(heading) * right_m
        east = np.interp(position_m, self._position, self._east) + np.cos(heading) * right_m
        return np.stack([north, east], axis=1)

    def between(self, first_m: float, last_m: float) -> NDArray[np.float64]:
        """[n, 2] north and east of the centre line's samples between two route positions."""
        first = max(0, int(first_m / STEP_M))
        last = min(len(self._north), int(last_m / STEP_M) + 1)
        return np.stack([self._north[first:last], self._east[first:last]], axis=1)
