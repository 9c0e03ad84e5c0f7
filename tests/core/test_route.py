"""Open and closed routes; which map images show a frame's place, against a slow search through all of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.route import Route, same_places, true_images_of
from deepsimbad.errors import InvalidRouteError

CORNERS = {"x_m": np.array([0.0, 10, 10, 0]), "y_m": np.array([0.0, 0, 10, 5])}


@pytest.mark.parametrize(
    ("route", "length_m", "cell_m"),
    [
        pytest.param(Route(np.arange(5) * 2.0), 8, [2] * 5, id="even spacing"),
        pytest.param(Route(np.arange(5) * 2.0, closed=True), 10, [2] * 5, id="a loop"),
        pytest.param(
            Route(np.arange(4) * 10.0, closed=True, **CORNERS), 35, [7.5, 10, 10, 7.5], id="the gap is the plane's"
        ),
        pytest.param(Route(np.array([0.0, 1, 2, 2, 2, 2, 3, 4])), 4, [1, 1, 0.5, 0, 0, 0.5, 1, 1], id="a stop"),
        pytest.param(Route(np.full(3, 7.0)), 0, [1] * 3, id="no length"),
        pytest.param(Route(np.array([4.0])), 0, [1], id="one image"),
    ],
)
def test_length_and_cells(route, length_m, cell_m):
    assert route.length_m == length_m
    np.testing.assert_allclose(route.cell_m, cell_m)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("n", [1, 2, 36, 700])
def test_a_bin_of_the_histogram_holds_what_lies_in_it(n, closed):
    """Of unevenly spaced images none leaves an empty bin beside it; one of a stop stands for a stretch or for none."""
    rng = np.random.default_rng(n)
    position_m, mass = np.sort(2.0 * n * rng.random(n)), rng.dirichlet(np.ones(n))
    position_m[3:6] = position_m[3:4]
    route = Route(position_m, closed)
    edges_m, bin_mass = route.histogram_edges_m, route.histogram_of(mass)
    assert (bin_mass > 0).all()
    middle_m, round_m = (position_m[1:] + position_m[:-1]) / 2, route.length_m
    around_m = (position_m[-1] - round_m + position_m[0]) / 2 if closed else edges_m[0]
    from_m, until_m = np.r_[around_m, middle_m], np.r_[middle_m, around_m + round_m]
    for first_m, last_m, share in zip(edges_m, edges_m[1:], bin_mass, strict=False):
        within_m = sum(
            np.clip(np.minimum(last_m, until_m + turn_m) - np.maximum(first_m, from_m + turn_m), 0, None)
            for turn_m in ((0.0, round_m) if closed else (0.0,))
        )
        length_m = np.maximum(until_m - from_m, 1e-12)
        points = (until_m == from_m) & (until_m > first_m) & (until_m <= last_m)
        assert share == pytest.approx(mass @ (within_m / length_m) + mass[points].sum() + (n == 1), abs=1e-9)


def test_a_belief_that_knows_nothing_fills_the_bins_of_a_loop_alike():
    """Whatever the last image is away from the first: either stands for half of that."""
    route = Route(np.arange(4) * 10.0, closed=True, **CORNERS)
    np.testing.assert_allclose(route.histogram_of(route.cell_m / route.length_m), 0.25)


def test_offsets_take_the_short_way_round():
    route = Route(np.arange(10.0), closed=True)
    np.testing.assert_allclose(route.offset_m(np.array([9.0, 1.0, 5.0]), 0.0), [-1.0, 1.0, -5.0])
    open_route = Route(np.arange(10.0))
    np.testing.assert_allclose(open_route.offset_m(np.array([9.0, 1.0]), 0.0), [9.0, 1.0])


@pytest.mark.parametrize("closed", [False, True])
def test_of_two_images_equally_near_the_one_before_counts(closed):
    assert Route(np.arange(4.0), closed).nearest_image(np.array([0.5, 1.5, 2.75, 3.5])).tolist() == [0, 1, 3, 3]


@pytest.mark.parametrize(
    ("positions", "says"),
    [
        ([0.0, 2.0, 1.0], "backwards at frame 2"),
        ([0.0, np.nan], "frame 1 is NaN"),
        ([np.inf], "frame 0"),
        ([], "at least one"),
        ([0.0, 1e-310], "1e-310 m long"),
    ],
)
def test_bad_positions_are_named(positions, says):
    with pytest.raises(InvalidRouteError, match=says):
        Route(np.array(positions, float))


def test_a_closed_route_that_only_its_gap_makes_too_short_is_refused():
    with pytest.raises(InvalidRouteError, match="m long"):
        Route(np.zeros(2), closed=True, x_m=np.array([0.0, 1e-310]), y_m=np.zeros(2))


def test_an_open_route_ends_and_a_closed_one_does_not():
    at_m = np.array([4.9, 5.0, 9.0, 14.0, 14.1])
    assert Route(np.arange(5.0, 15.0)).reaches(at_m).tolist() == [False, True, True, True, False]
    assert Route(np.arange(5.0, 15.0), closed=True).reaches(at_m).all()


# --- which images show the same place ------------------------------------------------------------------------------


def by_looking_at_all(query, map_route, tolerance_m):
    x, y = query.x_m, query.y_m
    return [
        np.flatnonzero(np.hypot(map_route.x_m - x[frame], map_route.y_m - y[frame]) <= tolerance_m).tolist()
        for frame in range(query.n_images)
    ]


def wandering(rng, n, spread):
    x, y = rng.normal(size=(2, n)) * spread
    unknown = rng.random(n) < 0.1
    x[unknown] = np.nan
    return Route(np.sort(rng.random(n)) * 100, x_m=x, y_m=y)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 2.0, 50.0, np.inf]), st.sampled_from([0.01, 1.0, 500.0]))
def test_squares_find_what_looking_at_all_finds(seed, tolerance_m, spread):
    rng = np.random.default_rng(seed)
    query, map_route = wandering(rng, 20, spread), wandering(rng, 60, spread)
    true_images = true_images_of(query, map_route, tolerance_m, max_heading_rad=np.pi)
    assert [ids.tolist() for ids in true_images] == by_looking_at_all(query, map_route, tolerance_m)


@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([0.0, 0.1, 2.0, np.inf]))
def test_the_window_along_the_route_finds_what_looking_at_all_finds(seed, closed, tolerance_m):
    rng = np.random.default_rng(seed)
    map_route = Route(np.sort(rng.integers(0, 200, 50)) / 10, closed)
    query = Route(np.sort(rng.integers(-10, 210, 20)) / 10)
    expected = [
        np.flatnonzero(np.abs(map_route.offset_m(map_route.position_m, position_m)) <= tolerance_m).tolist()
        for position_m in query.position_m
    ]
    assert [ids.tolist() for ids in true_images_of(query, map_route, tolerance_m)] == expected


@pytest.mark.parametrize(
    ("frames", "pairs"),
    [
        pytest.param(Route(np.array([0.4, 5.6, 30.0])), [[0, 0], [6, 1]], id="along the route"),
        pytest.param(
            Route(np.arange(4.0), x_m=np.array([0.9, 3.2, 3.4, 90.0]), y_m=np.full(4, 0.3)),
            [[1, 0], [3, 1], [3, 2]],
            id="in the plane",
        ),
    ],
)
def test_same_places_are_the_nearest_within_the_tolerance(frames, pairs):
    x_m = np.arange(10.0)
    map_route = Route(x_m, x_m=x_m, y_m=np.zeros(10))
    assert same_places(frames, map_route).tolist() == pairs
    last = [9, frames.n_images - 1]
    assert same_places(frames, map_route, tolerance_m=np.inf).tolist() == [*pairs, last]


def test_truth_in_the_plane_needs_the_same_direction():
    """A corridor driven up and back down: the same place has two route positions, one of them facing us."""
    up = np.arange(10.0)
    x = np.r_[up, up[::-1]]
    there_and_back = Route(np.arange(20.0), x_m=x, y_m=np.zeros(20))
    upward = Route(np.arange(10.0), x_m=up, y_m=np.full(10, 0.5))
    true_images = true_images_of(upward, there_and_back, 1.2)
    assert true_images[4].tolist() == [3, 4, 5]


def test_truth_in_the_plane_finds_both_visits_of_a_place():
    circle = np.linspace(0, 4 * np.pi, 200)
    twice_round = Route(np.arange(200.0), x_m=50 * np.cos(circle), y_m=50 * np.sin(circle))
    true_images = true_images_of(twice_round, twice_round, 2.0)
    assert {100, 0} <= set(true_images[100].tolist()) | set(true_images[0].tolist())
    assert all(abs(i - 50) < 3 or abs(i - 149.5) < 3 for i in true_images[50].tolist())
    assert len(true_images[50]) >= 2


def test_distance_is_in_the_plane_where_both_sides_know_it_else_along_the_route():
    images, x_m, y_m = np.arange(3), np.array([0.0, 1.0, np.nan]), np.array([0.0, 0.0, np.nan])
    route = Route(np.arange(3.0), False, x_m, y_m)
    assert route.apart_m(images, 2.0, 0.0, 0.5).tolist() == [0.5, pytest.approx(1.118, abs=1e-3), 0.0]
    assert route.apart_m(images, 2.0, None, None).tolist() == [2.0, 1.0, 0.0]
    assert Route(np.arange(10.0), closed=True).apart_m(images, 9.0, 0.0, 0.0)[0] == 1.0
