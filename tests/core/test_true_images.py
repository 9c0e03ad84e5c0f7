"""Which map images show a frame's place, against a slow search through all of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.route import Route
from deepsimbad.core.true_images import same_places, true_images_of


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
    found = true_images_of(query, map_route, tolerance_m, max_heading_rad=np.pi)
    assert [ids.tolist() for ids in found] == by_looking_at_all(query, map_route, tolerance_m)


@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([0.0, 0.1, 2.0, np.inf]))
def test_the_window_along_the_route_finds_what_looking_at_all_finds(seed, closed, tolerance_m):
    rng = np.random.default_rng(seed)
    map_route = Route(np.sort(rng.integers(0, 200, 50)) / 10, closed)
    query = Route(np.sort(rng.integers(-10, 210, 20)) / 10)
    expected = [
        np.flatnonzero(np.abs(map_route.offset_m(map_route.position_m, at)) <= tolerance_m).tolist()
        for at in query.position_m
    ]
    assert [ids.tolist() for ids in true_images_of(query, map_route, tolerance_m)] == expected


def test_the_nearest_is_paired():
    map_route = Route(np.arange(5.0), x_m=np.arange(5.0), y_m=np.zeros(5))
    frames = Route(np.arange(3.0), x_m=np.array([0.9, 3.2, 90.0]), y_m=np.zeros(3))
    assert same_places(frames, map_route).tolist() == [[1, 0], [3, 1]]
    assert same_places(frames, map_route, tolerance_m=np.inf).tolist() == [[1, 0], [3, 1], [4, 2]]


def test_truth_along_the_route():
    route = Route(np.arange(6.0))
    found = true_images_of(Route(np.array([0.0, 3.4, 9.0])), route, 2.0)
    assert [ids.tolist() for ids in found] == [[0, 1, 2], [2, 3, 4, 5], []]


def test_truth_in_the_plane_needs_the_same_direction():
    """A corridor driven up and back down: the same place has two route positions, one of them facing us."""
    up = np.arange(10.0)
    x = np.r_[up, up[::-1]]
    there_and_back = Route(np.arange(20.0), x_m=x, y_m=np.zeros(20))
    upward = Route(np.arange(10.0), x_m=up, y_m=np.full(10, 0.5))
    found = true_images_of(upward, there_and_back, 1.2)
    assert found[4].tolist() == [3, 4, 5]


def test_truth_in_the_plane_finds_both_visits_of_a_place():
    circle = np.linspace(0, 4 * np.pi, 200)
    twice_round = Route(np.arange(200.0), x_m=50 * np.cos(circle), y_m=50 * np.sin(circle))
    found = true_images_of(twice_round, twice_round, 2.0)
    assert {100, 0} <= set(found[100].tolist()) | set(found[0].tolist())
    assert all(abs(i - 50) < 3 or abs(i - 149.5) < 3 for i in found[50].tolist())
    assert len(found[50]) >= 2
