"""Active self-localization on a recorded drive: episodes of views and commanded moves (III, Fig. 7).

The robot stands on a test frame, looks, is told how far to move, and moves exactly so far along the test traverse.
After each move the belief of the map image nearest to the truth is ranked by ANR's rule.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.localizer import ActiveLocalizer, LocalizerState, Step
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query
from deepsimbad.core.route import Route


@dataclass(frozen=True)
class TestDrive:
    """What the robot may see, and where it truly is."""

    views: Query  # the described test frames, in the order they were driven; a batch
    route: Route  # their positions
    true_image: NDArray[np.int64]  # [m] int64, the map image nearest to every test frame

    def starts(self, travel_m: float, count: int, seed: int) -> NDArray[np.int64]:
        """Frames [count], uniform over those from which so many metres fit."""
        fitting = np.flatnonzero(self.route.position_m + travel_m <= self.route.position_m[-1])
        return np.random.default_rng(seed).choice(fitting, count) if fitting.size else fitting


@dataclass(frozen=True)
class Episode:
    """One episode."""

    rank_share: NDArray[np.float64]  # [steps] share of map images placed before the truth after each move
    travelled_m: NDArray[np.float64]  # [steps] metres moved until then


Chooser: TypeAlias = Callable[[int, Step, float], float]
"""Commands the next move in metres, of episode number, last step and true position (for those who may know it)."""


@dataclass(frozen=True)
class EpisodeRunner:
    """Runs episodes with the localizer that ships."""

    localizer: ActiveLocalizer  # the algorithm on a map
    drive: TestDrive  # the test traverse
    n_steps: int  # moves an episode
    action_std_m: float | None = None  # how far the filter trusts a move; None: as usual

    def run(self, episode: int, start: int, choose: Chooser) -> Episode:
        """One episode from a test frame."""
        shares, travelled = np.empty(self.n_steps), np.empty(self.n_steps)
        position_m = float(self.drive.route.position_m[start])
        step = self.localizer.step(self.localizer.start(), self.drive.views.at(start))
        moved_m = 0.0
        for number in range(self.n_steps):
            action_m = choose(episode, step, position_m)
            moved_m, position_m = moved_m + action_m, position_m + action_m
            step, shares[number] = self.observe(step.state, position_m, action_m)
            travelled[number] = moved_m
        return Episode(shares, travelled)

    def observe(self, state: LocalizerState, position_m: float, action_m: float) -> tuple[Step, float]:
        """Look from the frame nearest to a position; returns the step and the truth's rank share."""
        frame = int(self.drive.route.nearest_image(np.array([position_m]))[0])
        step = self.localizer.step(state, self.drive.views.at(frame), action_m, self.action_std_m)
        mass = step.state.belief.mass
        return step, rank_of_truth(mass, self.drive.true_image[[frame]]) / mass.size


def follow_plan(episode: int, step: Step, position_m: float) -> float:  # noqa: ARG001
    """Do what the localizer's own planner recommends."""
    if step.plan is None:
        raise ValueError("the planner recommends nothing on this map")
    return step.plan.action_m


def random_chooser(actions_m: NDArray[np.float64], seed: int) -> Chooser:
    """Any move alike, drawn from the seed, the episode's number and the step's."""

    def choose(episode: int, step: Step, position_m: float) -> float:  # noqa: ARG001
        return float(np.random.default_rng([seed, episode, step.state.n_observations]).choice(actions_m))

    return choose


def clairvoyant_chooser(runner: EpisodeRunner, actions_m: NDArray[np.float64]) -> Chooser:
    """Tries every move on the test traverse itself and takes the best: a bound no planner can know."""

    def choose(episode: int, step: Step, position_m: float) -> float:  # noqa: ARG001
        shares = [runner.observe(step.state, position_m + action_m, action_m)[1] for action_m in actions_m]
        return float(actions_m[int(np.argmin(shares))])

    return choose
