"""Open and closed routes."""

import numpy as np
import pytest

from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidRouteError


def test_even_spacing_has_equal_cells():
    for closed in (False, True):
        route = Route(np.arange(5) * 2.0, closed)
        assert route.length_m == (10.0 if closed else 8.0)
        np.testing.assert_allclose(route.cell_m, 2.0)


def test_a_stop_shares_one_cell():
    route = Route(np.array([0.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 4.0]))
    np.testing.assert_allclose(route.cell_m[2:6].sum(), 1.0)


def test_a_route_of_no_length_has_equal_cells():
    np.testing.assert_allclose(Route(np.full(3, 7.0)).cell_m, 1.0)
    assert Route(np.array([4.0])).length_m == 0.0


def test_a_closed_route_that_only_its_gap_makes_too_short_is_refused():
    with pytest.raises(InvalidRouteError, match="m long"):
        Route(np.zeros(2), closed=True, x_m=np.array([0.0, 1e-310]), y_m=np.zeros(2))


def test_closing_gap_is_taken_from_the_plane():
    square = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
    route = Route(np.array([0.0, 10, 20, 30]), closed=True, x_m=square[:, 0], y_m=square[:, 1])
    assert route.length_m == 40.0


def test_offsets_take_the_short_way_round():
    route = Route(np.arange(10.0), closed=True)
    np.testing.assert_allclose(route.offset_m(np.array([9.0, 1.0, 5.0]), 0.0), [-1.0, 1.0, -5.0])
    open_route = Route(np.arange(10.0))
    np.testing.assert_allclose(open_route.offset_m(np.array([9.0, 1.0]), 0.0), [9.0, 1.0])


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
