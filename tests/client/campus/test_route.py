import numpy as np
import pytest

from deepsimbad_client.campus.route import Route


def test_a_longer_route_begins_like_a_shorter_one():
    where = np.linspace(0, 290, 600)
    np.testing.assert_array_equal(Route(4, 300).place(where), Route(4, 3000).place(where))
    assert Route(4, 300).length_m >= 300


@pytest.mark.parametrize("seed", range(6))
def test_it_never_comes_near_itself_again(seed):
    where = np.arange(0, 1500, 4.0)
    place = Route(seed, 1500).place(where)
    apart = np.abs(where[:, None] - where[None])
    distance = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1))
    assert distance[apart > 40].min() > 18


def test_position_is_arc_length_and_heading_is_the_way_it_goes():
    route = Route(1, 800)
    where = np.arange(0, 780, 0.5)
    place = route.place(where)
    steps = np.diff(place, axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 0.5, rtol=2e-3)
    north_east = np.arctan2(steps[:, 1], steps[:, 0])
    turn = (north_east - route.heading(where[:-1] + 0.25) + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn).max() < 0.03
    assert np.ptp(route.heading(where)) > 0.5  # it bends


def test_right_is_to_the_right():
    route = Route(1, 200)
    where = np.array([10.0])
    heading = route.heading(where)[0]
    offset = (route.place(where, 2.0) - route.place(where))[0]
    np.testing.assert_allclose(offset, 2 * np.array([-np.sin(heading), np.cos(heading)]), atol=1e-9)
