"""The one value of a map: what it refuses, what of it can be taken, and its form in a file."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.map import ARRAYS, Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import InvalidMapConfigError, InvalidRouteError

N, H, R = 8, 2, 5


def full_map(**changes):
    """A map that has every array there is."""
    rng = np.random.default_rng(0)
    lengths = {"n": N, "h": H, "r": R, "a": 2, "*": 3}
    arrays = {
        name: rng.random([lengths.get(axis, axis) for axis in row.axes]).astype(row.dtype)
        for name, row in ARRAYS.items()
        if row.dtype.kind != "U"
    }
    arrays |= {"frame_name": np.array([f"{i:0{i}}.png" for i in range(N)]), "frame_drive": np.array(["a", "bc"] * 4)}
    arrays |= {"landmark_frame": np.array([*"abcd", ""]), "landmark_drive": np.full(R, "a")}
    arrays["lists"] = rng.integers(0, R, (H, N)).astype(np.uint16)
    arrays["position_m"] = np.arange(float(N))
    config = {"relevance": "composed", "n_landmarks": R, "seed": 3}
    return Map(**{"config": config, "actions_m": (1.0, 2.5), "domain": "d", "version": 7, **arrays, **changes})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"config": {"relevance": "rrf"}}, "does not say n_landmarks"),
        ({"config": {"relevance": "rrf", "n_landmarks": 70_000}}, "70000 landmarks"),
        ({"config": {"relevance": "rrf", "n_landmarks": 1}}, "not"),
        ({"lists": np.zeros((H, N), np.int64)}, "lists is int64"),
        ({"lists": np.zeros((H, 0), np.uint16)}, "not .h, n."),
        ({"lists": np.full((H, N), R, np.uint16)}, "not among the 5"),
        ({"values": np.zeros((H, N + 1), np.float32)}, "values is"),
        ({"q_values": np.zeros((N, 3), np.float32)}, "q_values is"),
        ({"statistics": None}, "a map for composed needs statistics"),
        ({"usual_encoding": None}, "needs usual_encoding"),
        ({"actions_m": (1.0, "2")}, "no metres"),
        ({"position_m": np.arange(float(N))[::-1]}, "backwards"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes, says):
    with pytest.raises((InvalidMapConfigError, InvalidRouteError), match=says):
        full_map(**changes)


def test_an_unknown_relevance_is_refused():
    with pytest.raises(ValueError, match="telepathy"):
        _ = full_map(config={"relevance": "telepathy", "n_landmarks": R}).relevance


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"statistics": np.full((2, R), np.nan)}, "statistics holds NaN"),
        ({"statistics": np.zeros((2, R))}, "no spread"),
        ({"q_values": np.full((N, 2), np.inf, np.float32)}, "q_values holds NaN"),
        ({"position_m": np.full(N, 4.0)}, "at one position"),
        ({"actions_m": (2.0, 1.0)}, "no moves that ascend"),
        ({"actions_m": (), "q_values": None}, "no moves that ascend"),
        ({"actions_m": (1.0, 1.0)}, "no moves that ascend"),
        ({"actions_m": (1.0, np.nan)}, "no moves that ascend"),
        ({"actions_m": (1.0, 1001.0)}, "at most 1000 m"),
        ({"actions_m": (0.0,), "q_values": None}, "goes somewhere"),
    ],
)
def test_what_makes_no_sense_may_not_serve(changes, says):
    full_map().check()
    full_map(x_m=np.full(N, np.nan)).check()
    full_map(actions_m=(-1.0, 0.0)).check()
    with pytest.raises(InvalidMapConfigError, match=says):
        full_map(**changes).check()


def test_nothing_in_it_can_be_written_to():
    map_ = full_map(landmark_model={"prototypes": np.zeros(3)})
    for array in (*map_.arrays().values(), *map_.landmark_model.values(), map_.actions_m):
        with pytest.raises(ValueError, match="read-only"):
            array[:1] = 0


def test_it_comes_back_from_its_document_and_arrays():
    map_ = full_map(landmark_model={"prototypes": np.zeros(3)}, metrics={"anr": 1.5}, closed=True)
    again = Map.from_arrays(map_.document(), map_.landmark_model, map_.arrays(), 80)
    assert again.document() == map_.document()
    assert again.arrays().keys() == map_.arrays().keys() == ARRAYS.keys()
    assert all(np.array_equal(again.arrays()[name], array) for name, array in map_.arrays().items())
    assert (again.index_bytes, again.index_bits_per_map_image, again.relevance) == (80, 80, Relevance.COMPOSED)


def test_a_part_of_its_images_and_those_put_together_again():
    map_ = full_map()
    images, other_images = np.array([0, 1, 4, 6]), np.array([2, 3, 5, 7])
    part = map_.at(images)
    assert part.position_m.tolist() == images.tolist()
    assert np.array_equal(part.lists, map_.lists[:, images])
    assert np.array_equal(part.q_values, map_.q_values[images])
    assert part.statistics is map_.statistics
    new_arrays = {name: array for name, array in map_.at(other_images).arrays().items() if "n" in ARRAYS[name].axes}
    for name, array in part.with_images(new_arrays).arrays().items():
        assert np.array_equal(array, map_.arrays()[name]), name


def test_of_added_images_what_only_the_others_know_is_unknown():
    map_ = replace(full_map(), x_m=None, y_m=None, frame_name=None, frame_drive=None)
    names = np.array([f"{i}.png" for i in range(N)])
    required = {name: map_.arrays()[name] for name, row in ARRAYS.items() if "n" in row.axes and row.unknown is None}
    longer = map_.with_images({**required, "x_m": np.arange(float(N)), "frame_name": names})
    assert longer.n_images == 2 * N
    assert np.isnan(longer.x_m[::2]).all(), "at one position the old come first"
    assert longer.x_m[1::2].tolist() == list(range(N))
    assert (longer.timestamp_us[1::2] == -1).all()
    assert (longer.frame_digest[1::2] == 0).all()
    assert longer.y_m is None
    assert longer.frames.tolist() == [name for i in range(N) for name in (None, f"{i}.png")]
    assert longer.frame_drive is None
