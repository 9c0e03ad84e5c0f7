"""Active self-localization on a recorded drive: episodes of views and commanded moves (III, Fig. 7).

The robot stands on a test frame, looks, is told how far to move, and moves exactly so far along the test traverse.
After each move the belief of the map image nearest to the truth is ranked by ANR's rule.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.summary import CONFIDENT_WITHIN_M, DEFAULT_CONFIDENCE, near_mode
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerState, Step
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query
from deepsimbad.core.route import Route

MOST_MOVES = 20
PENALTY_VIEWS = 20


@dataclass(frozen=True)
class TestDrive:
    """What the robot may see, and where it truly is."""

    views: Query  # the described test frames, in the order they were driven; a batch
    route: Route  # their positions
    true_image: NDArray[np.int64]  # [m] int64, the map image nearest to every test frame

    def starts(self, travel_m: float, count: int | None, seed: int) -> NDArray[np.int64]:
        """Frames from which so many metres fit: all of them, or some drawn."""
        fitting = np.flatnonzero(self.route.position_m + travel_m <= self.route.position_m[-1])
        return fitting if count is None or not fitting.size else np.random.default_rng(seed).choice(fitting, count)


@dataclass(frozen=True)
class Episode:
    """One episode: the truth's rank after each of some moves, and when the robot was sure of its place."""

    rank_share: NDArray[np.float64]  # [steps] share of map images placed before the truth after each move
    travelled_m: NDArray[np.float64]  # [steps] metres moved until then
    views: float  # until it was sure; a sure mistake and never being sure count 20 more
    metres: float  # moved by then
    is_wrong: bool  # it was sure, and more than 5 m off


Chooser: TypeAlias = Callable[[int, Step, float], float]
"""Commands the next move in metres, of episode number, last step and true position (for those who may know it)."""


@dataclass(frozen=True)
class EpisodeRunner:
    """Runs episodes with the localizer that ships."""

    localizer: ActiveLocalizer  # the algorithm on a map
    drive: TestDrive  # the test traverse
    n_steps: int  # moves an episode
    action_std_m: float | None = None  # how far the filter trusts a move; None: as usual
    until_sure: bool = True  # go on after so many moves, to 20, while it is not sure

    def run(self, episode: int, start: int, choose: Chooser) -> Episode:
        """One episode from a test frame; on to 20 moves where it is not sure before, while the drive lasts."""
        shares, travelled = np.empty(self.n_steps), np.empty(self.n_steps)
        route, position_m = self.drive.route, float(self.drive.route.position_m[start])
        step = self.localizer.step(self.localizer.start(), self.drive.views.at(start))
        moved_m, sure = 0.0, self._sure(step, position_m, 1, 0.0)
        for number in range(max(self.n_steps, MOST_MOVES) if self.until_sure else self.n_steps):
            if number >= self.n_steps and sure is not None:
                break
            action_m = choose(episode, step, position_m)
            if number >= self.n_steps and not route.start_m <= position_m + action_m <= route.position_m[-1]:
                break
            moved_m, position_m = moved_m + abs(action_m), position_m + action_m
            step, share = self.observe(step.state, position_m, action_m)
            if number < self.n_steps:
                shares[number], travelled[number] = share, moved_m
            sure = sure or self._sure(step, position_m, number + 2, moved_m)
        views, metres, is_wrong = sure or (MOST_MOVES + 1, moved_m, False)
        late = PENALTY_VIEWS if is_wrong or sure is None else 0
        return Episode(shares, travelled, float(views + late), metres, is_wrong)

    def _sure(self, step: Step, position_m: float, views: int, metres: float) -> tuple[int, float, bool] | None:
        """Views, metres, and whether it is mistaken, of a robot that is sure of its place; None where it is not."""
        belief = step.state.belief
        mass, route = belief.mass, belief.route
        mode = int(mass.argmax())
        if near_mode(route, mass, mode) * (1 - belief.off_route) < DEFAULT_CONFIDENCE:
            return None
        frame = int(self.drive.route.nearest_image(np.array([position_m]))[0])
        truth_m = route.position_m[self.drive.true_image[frame]]
        off_m = abs(float(route.offset_m(np.array([truth_m]), float(route.position_m[mode]))[0]))
        return views, metres, off_m > CONFIDENT_WITHIN_M

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
