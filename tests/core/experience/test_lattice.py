"""The training lattice against moves and views in loops."""

import numpy as np
import pytest

from deepsimbad.core.experience.lattice import NO_MOVE, Lattice, Moves, moves_along, step_beliefs, uniform_beliefs
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.route import Route


def equal_route(n: int, spacing_m: float, closed: bool) -> Route:
    return Route(5.0 + spacing_m * np.arange(n), closed)


def at_first_view(moves: Moves, action: int, first: bool) -> Moves:
    shift = np.array([NO_MOVE if first else moves.shift[action]])
    return Moves(shift, moves.fraction[[action]], moves.taps[[action]])


def slow_move(mass: np.ndarray, cells: float, std_cells: float, closed: bool) -> np.ndarray:
    """Mass shared between two cells, dropped where it would be past the end, then blurred within the ends."""
    n, n_whole = len(mass), int(np.floor(cells + 1e-4))
    part, shifted_mass, spread = cells - n_whole, np.zeros(n), np.zeros(n)
    for c in range(n):
        for to, share in ((c + n_whole, 1 - part), (c + n_whole + 1, part)):
            if share > 1e-4 and (closed or (c + n_whole >= 0 and c + n_whole + (part > 1e-4) < n)):
                shifted_mass[to % n] += mass[c] * share
    reach = max(1, int(4 * std_cells))
    for c in range(n):
        to = np.array([d for d in range(-reach, reach + 1) if closed or 0 <= c + d < n])
        weight = np.exp(-0.5 * np.square(to / std_cells))
        if std_cells < 0.6:  # three weights of that variance
            weight = np.where(to == 0, 1 - std_cells**2, np.where(np.abs(to) == 1, std_cells**2 / 2, 0))
        np.add.at(spread, (c + to) % n, shifted_mass[c] * weight / weight.sum())
    return spread / spread.sum()


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("additive", [False, True])
@pytest.mark.parametrize(
    ("spacing_m", "actions_m"),
    [(1.0, (1.0, 4.0)), (0.2, (1.0, 3.0)), (0.5, (1.3, 0.2)), (1.0, (-3.0, 0.0)), (0.5, (-1.3, 2.0))],
)
def test_on_equal_steps_the_beliefs_are_those_of_plain_loops(closed, additive, spacing_m, actions_m):
    route = equal_route(120, spacing_m, closed)
    lattice = Lattice.of_route(route, np.zeros(1))  # without moves to divide the cells are the images
    assert lattice.n_cells == 120
    stds_m = [0.72, 0.33]  # cut off between two images, so that rounding decides nothing
    moves = moves_along(lattice, actions_m, stds_m)
    beliefs = uniform_beliefs(lattice, 1)
    slow = np.full(120, 1 / 120)
    rng = np.random.default_rng(3)
    for step in range(9):
        action = int(rng.integers(2))
        evidence = rng.gamma(0.3, 4.0, 120).astype(np.float32)
        if step:
            slow = slow_move(slow, actions_m[action] / spacing_m, stds_m[action] / spacing_m, closed)
        slow = slow * 120 + evidence if additive else slow * evidence
        slow /= slow.sum()
        factors = evidence[np.newaxis]
        truth = int(rng.integers(120))
        rank = step_beliefs(
            lattice, beliefs, at_first_view(moves, action, step == 0), factors, np.array([truth]), additive=additive
        )
        mass = beliefs[0].astype(np.float64) / beliefs[0].sum(dtype=np.float64)
        assert np.abs(mass - slow).max() <= 2e-5 * slow.max()
        assert rank[0] == rank_of_truth(beliefs[0], np.array([truth]))


def test_beliefs_do_not_touch_each_other_and_ranks_count_images():
    route = equal_route(50, 1.0, closed=False)
    lattice = Lattice.of_route(route, np.array([1.0, 5.0]))
    moves = moves_along(lattice, (1.0, 5.0), (0.4, 0.9))
    rng = np.random.default_rng(0)
    evidence = rng.random((3, 50), np.float32)
    batch = uniform_beliefs(lattice, 3)
    beliefs = [uniform_beliefs(lattice, 1) for _ in range(3)]
    for turn in range(4):
        action = rng.integers(0, 2, 3)
        steps = Moves(moves.shift[action] if turn else np.full(3, NO_MOVE), moves.fraction[action], moves.taps[action])
        ranks = step_beliefs(lattice, batch, steps, evidence, np.array([7, 40, -1]), additive=True)
        assert ranks[2] == -1
        for row, belief in enumerate(beliefs):
            single_moves = Moves(steps.shift[[row]], steps.fraction[[row]], steps.taps[[row]])
            single_rank = step_beliefs(lattice, belief, single_moves, evidence[[row]], np.array([7]), additive=True)
            assert np.array_equal(batch[row], belief[0])
            assert row > 0 or single_rank[0] == ranks[0] == rank_of_truth(belief[0], np.array([7]))


def test_uneven_images_take_the_cell_nearest_to_them():
    position_m = np.array([0.0, 0.0, 0.0, 1.1, 1.9, 3.0, 3.0, 6.0])
    lattice = Lattice.of_route(Route(position_m), np.array([-2.0, 0.0, 1.0]))
    assert lattice.step_m == 1.0
    assert lattice.cell_of_image.tolist() == [0, 0, 0, 1, 2, 3, 3, 6]
    assert lattice.images_in_cell.tolist() == [3, 1, 1, 2, 0, 0, 1]
    assert [position_m[i] for i in lattice.image_of_cell] == [0.0, 1.1, 1.9, 3.0, 3.0, 6.0, 6.0]
    evidence = np.array([[0, 0, 0, 1, 5, 2, 2, 0]], np.float32)
    first = Moves(np.array([NO_MOVE]), np.zeros(1, np.float32), np.ones((1, 1), np.float32))
    rank = step_beliefs(lattice, uniform_beliefs(lattice, 1), first, evidence, np.array([5]), additive=True)
    assert rank[0] == 1 + 0.5  # the image at 1.9 is better, the other at 3.0 is tied


def test_a_belief_that_would_be_wholly_past_the_end_stays_and_evidence_against_every_place_is_not_believed():
    lattice = Lattice.of_route(equal_route(10, 1.0, closed=False), np.ones(1))
    beliefs = np.eye(10, dtype=np.float32)[[8]]
    moves = moves_along(lattice, (3.0,), (0.0,))
    rank = step_beliefs(lattice, beliefs, moves, np.ones((1, 10), np.float32), np.array([8]), additive=False)
    assert (rank[0], beliefs[0].argmax()) == (0, 8)
    beliefs, moves = uniform_beliefs(lattice, 1), moves_along(lattice, (1.0,), (0.0,))
    step_beliefs(lattice, beliefs, moves, np.zeros((1, 10), np.float32), np.array([8]), additive=False)
    np.testing.assert_allclose(beliefs[0], [0, *[10 / 9] * 9], rtol=1e-5)


def test_one_place_and_one_image():
    for position_m in ([2.0], [2.0, 2.0, 2.0]):
        lattice = Lattice.of_route(Route(np.array(position_m)), np.ones(1))
        assert lattice.n_cells == len(position_m) or lattice.n_cells == 1
        beliefs = uniform_beliefs(lattice, 1)
        moves = moves_along(lattice, (1.0,), (0.5,))
        evidence = np.ones((1, len(position_m)), np.float32)
        rank = step_beliefs(lattice, beliefs, moves, evidence, np.array([0]), additive=True)
        assert rank[0] == 0.5 * (len(position_m) - 1)
