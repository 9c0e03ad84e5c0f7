"""What differs between drives: parked cars, cars that pass and people who walk."""

import datetime
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.drive import INTERVAL_US, START_M
from deepsimbad_client.campus.noise import stream
from deepsimbad_client.campus.props import CAR_COLOURS
from deepsimbad_client.campus.world import SIGHT_M, Section, World

CELL_M = 18.0
"""People come in groups, one group or none for every so many metres of route."""

PARKED_SHARE = 0.6
PEOPLE_SHARE = 0.8
LANE_M = 1.8
LOOP_M = 150.0


@dataclass(frozen=True)
class Car:
    """A car at one moment."""

    place: NDArray[np.float64]
    heading_rad: float
    paint: tuple[int, ...]


@dataclass(frozen=True)
class Walker:
    """Somebody at one moment."""

    place: NDArray[np.float64]
    look: int
    stride: float


class Passing:
    """Everything on the campus that is there in one drive and not in the next.

    Args:
        world: Where they are.
        seed: Seed of the campus.
        date: The drive.
        spacing_m: Metres the robot moves between two pictures on average, so that people are met.
    """

    def __init__(self, world: World, seed: int, date: datetime.date, spacing_m: float) -> None:
        self._world, self._seed, self._name = world, seed, date.isoformat()
        self._parked: dict[int, list[Car]] = {}
        self._pace_m_s = spacing_m / (INTERVAL_US / 1e6)

    def parked(self, section: Section) -> list[Car]:
        """The cars that stand in a section's bays during this drive."""
        index = section.stretch.index
        if index not in self._parked:
            self._parked[index] = self._park(section)
        return self._parked[index]

    def _park(self, section: Section) -> list[Car]:
        cars = []
        for bay in section.scene.bays:
            rng = stream(self._seed, f"bay {self._name}", bay.number)
            if rng.random() < PARKED_SHARE:
                heading = bay.heading_rad + float(rng.normal(0, 0.03)) + (np.pi if rng.random() < 0.3 else 0)
                cars.append(Car(bay.place, heading, CAR_COLOURS[int(rng.integers(0, len(CAR_COLOURS)))]))
        return cars

    def driving(self, position_m: float, time_s: float) -> list[Car]:
        """The cars on the roads in sight, at a time since the drive began."""
        cars = []
        for section in self._world.ahead(position_m):
            road = section.scene.road_right_m
            if road is None:
                continue
            rng = stream(self._seed, f"traffic {self._name}", section.stretch.index)
            for _ in range(int(rng.integers(1, 4))):
                speed = float(rng.uniform(6, 11)) * float(rng.choice([-1, 1]))
                along = (float(rng.uniform(0, LOOP_M)) + speed * time_s) % LOOP_M
                paint = CAR_COLOURS[int(rng.integers(0, len(CAR_COLOURS)))]
                if along > section.stretch.straight_m:
                    continue
                where = np.array([section.stretch.start_m + along])
                lane = road + np.sign(speed) * LANE_M
                heading = float(self._world.route.heading(where)[0]) + (np.pi if speed < 0 else 0.0)
                cars.append(Car(self._world.route.place(where, lane)[0], heading, paint))
        return cars

    def walking(self, position_m: float, time_s: float) -> list[Walker]:
        """The people in sight, at a time since the drive began."""
        walkers = []
        first, last = int(max(0.0, position_m - 2 * CELL_M) / CELL_M), int((position_m + SIGHT_M / 2) / CELL_M)
        for cell in range(first, last + 1):
            rng = stream(self._seed, f"people {self._name}", cell)
            if rng.random() > PEOPLE_SHARE:
                continue
            home = (cell + float(rng.random())) * CELL_M
            met_s = (home - START_M) / self._pace_m_s + float(rng.normal(0, 6))
            speed = float(rng.uniform(0.9, 1.5)) * float(rng.choice([-1, 0, 1]))
            side = float(rng.choice([-1, 1]))
            for k in range(int(rng.integers(1, 5))):
                right = side * float(rng.uniform(0.9, 3.0))
                where = home + speed * float(np.clip(time_s - met_s, -40, 40)) + 0.9 * k
                look = int(rng.integers(0, 1 << 31))
                if where > 0:
                    place = self._world.route.place(np.array([where]), right)[0]
                    walkers.append(Walker(place, look, 2.2 * where if speed else 0.4))
        return walkers
