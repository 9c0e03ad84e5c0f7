"""What a move does to a belief, for both filters: its error, where it may end, and who is lost on the way.

A robot gets lost at a small rate a metre, and a lost one is found anywhere. A move ends where an open route ends,
within its error; only one whose whole error lies past the end is refused.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import Doubt
from deepsimbad.core.route import Route
from deepsimbad.errors import PastTheEndError

LOST_A_METRE = 0.0005  # probability of getting lost
FOUND_A_VIEW = 0.02  # share of the lost mass that a move spreads over the route
LEAST_SURVIVING_SHARE = 1e-9  # of a belief; a move that leaves less leads past the end wherever the robot may be
_DOUBTING = 0.01  # probability of being lost; a belief that has more refuses no move
SIGMAS = 4.0  # standard deviations at which a move's error is cut off
_EXACT_SHARE = 0.6  # of moves, whose error is no more than odometry says
_SLIP_SHARE = 0.2  # of a move's length, by which the others err: a wheel slips, or its size has changed
_NARROW = 0.6  # cells; of a narrower normal curve three weights with its variance stand in for samples


def motion_std_m(action_m: float) -> float:
    """Standard deviation of a move whose odometry says nothing of its own error.

    Independent errors add their variances: 0.1 m per square root of a metre, and 0.05 m for standing.
    """
    return float(np.sqrt(0.05**2 + 0.01 * abs(action_m)))


def move_stds_m(action_m: float, action_std_m: float, is_mixture: bool) -> dict[float, float]:
    """{probability: standard deviation} of a move: a mixture takes some to err by more than odometry says.

    Where odometry says that it is more exact than usual, its moves slip less in proportion.
    """
    if not is_mixture:
        return {1.0: action_std_m}
    slip_m = _SLIP_SHARE * action_m * min(1.0, action_std_m / motion_std_m(action_m))
    return {_EXACT_SHARE: action_std_m, 1 - _EXACT_SHARE: float(np.hypot(action_std_m, slip_m))}


@lru_cache(maxsize=64)  # maps have few sets of actions
def usual_errors(*actions_m: float) -> NDArray[np.float64]:
    """[a, 2, 2] probabilities and standard deviations of moves of usual odometry; shared, so not to be written to."""
    return np.array([list(move_stds_m(action_m, motion_std_m(action_m), True).items()) for action_m in actions_m])


def check_ahead(
    route: Route, doubt: Doubt, on_route: NDArray[np.float64], surviving: NDArray[np.float64], action_m: float
) -> None:
    """Raise PastTheEndError where a belief that does not take the robot for lost has nowhere to go."""
    if (surviving > LEAST_SURVIVING_SHARE * on_route).any() or (doubt.is_mixture and doubt.off_route > _DOUBTING):
        return
    end_m, side = (float(route.position_m[-1]), "ends") if action_m > 0 else (route.start_m, "begins")
    raise PastTheEndError(
        f"no place of the belief has {abs(action_m):g} m of route {'before' if action_m > 0 else 'behind'} it; "
        f"the route {side} at {end_m:g} m",
        route_end_m=end_m,
    )


def leaving_and_found(
    doubt: Doubt,
    lost: NDArray[np.float64],
    on_route: NDArray[np.float64],
    surviving: NDArray[np.float64],
    action_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """[t], [t], [t] after a move: the lost mass, the factor of the masses that survived, and what is found anywhere.

    In the paper's updates a move past the end is impossible, and nobody is lost on the way.
    """
    if not doubt.is_mixture:
        return lost, on_route / surviving, np.zeros_like(lost)
    lost = lost + on_route - surviving
    found_mass = FOUND_A_VIEW * lost if action_m != 0 else np.zeros_like(lost)
    leaving = 1 - np.exp(-LOST_A_METRE * abs(action_m))
    return lost - found_mass + leaving * surviving, np.full(lost.size, 1 - leaving), found_mass


def move_error(step_m: float, n_cells: int, std_m: float) -> NDArray[np.float64]:
    """[2 w + 1] weights of a move's normal error, from w cells of `step_m` behind to w ahead."""
    deviation = std_m / step_m
    if deviation < _NARROW:
        half = deviation**2 / 2 if n_cells > 1 else 0.0
        return np.array([half, 1 - 2 * half, half]) if half > 0 else np.ones(1)
    reach = min(int(SIGMAS * deviation), n_cells - 1)
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / deviation))
    return np.asarray(weights / weights.sum())


@lru_cache(maxsize=64)  # robots make the same moves again and again
def mixed_error(step_m: float, n_cells: int, *stds_m: tuple[float, float]) -> NDArray[np.float64]:
    """[2 w + 1] `move_error` averaged over (probability, deviation) pairs `stds_m`; shared, so not to be written to."""
    errors = [share * move_error(step_m, n_cells, std_m) for share, std_m in stds_m]
    widest = max(error.size for error in errors)
    return np.asarray(np.sum([np.pad(error, (widest - error.size) // 2) for error in errors], axis=0), np.float64)
