"""The lists of a map survive packing, in few bits, and damage is noticed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.index import packing
from deepsimbad.core.index.packing import pack_lists, unpack_lists

RNG = np.random.default_rng(0)
PROTOTYPES = RNG.normal(size=(60, 16)).astype(np.float32)


def scattered(n_images, n_landmarks, list_length):
    shuffled = RNG.random((n_images, n_landmarks)).argsort(axis=1)[:, :list_length]
    return np.ascontiguousarray(shuffled.T, np.uint16)


def nearest(n_images):
    """The four landmarks most like a view that wanders."""
    views = np.zeros((n_images + 1, 16))
    for image in range(n_images):
        views[image + 1] = 0.9 * views[image] + RNG.normal(size=16)
    return np.ascontiguousarray((-views[1:] @ PROTOTYPES.T).argsort(axis=1)[:, :4].T, np.uint16)


def n_bits(lists, n_landmarks, prototypes):
    return 8 * sum(map(len, pack_lists(lists, n_landmarks, prototypes))) / lists.shape[1]


def comes_back(lists, n_landmarks, prototypes=None):
    blocks = pack_lists(lists, n_landmarks, prototypes)
    np.testing.assert_array_equal(unpack_lists(blocks, *lists.shape, n_landmarks, prototypes), lists)
    return blocks


@pytest.mark.parametrize(
    ("n_images", "n_landmarks", "list_length"), [(1, 1, 1), (7, 5, 5), (400, 60, 4), (40, 9000, 6)]
)
def test_lists_come_back(n_images, n_landmarks, list_length):
    lists = scattered(n_images, n_landmarks, list_length)
    comes_back(lists, n_landmarks)
    comes_back(lists, n_landmarks, RNG.normal(size=(n_landmarks, 3)))


@given(st.lists(st.lists(st.integers(0, 5), min_size=3, max_size=3), min_size=1, max_size=50), st.booleans())
def test_any_lists_come_back_with_landmarks_twice_and_standing_robots(rows, are_alike):
    """Also by prototypes that tell nothing: all alike, infinite, or not a number."""
    prototypes = np.ones((6, 2)) if are_alike else np.array([[0.0, np.nan], *[[np.inf, 1.0]] * 5])
    comes_back(np.ascontiguousarray(np.array(rows, np.uint16).T), 6, prototypes)


def test_lists_without_any_order_take_little_more_than_their_landmarks_numbers():
    lists = scattered(20_000, 500, 4)
    assert n_bits(lists, 500, None) < 4 * np.log2(500) + 0.6


def test_what_neighbours_share_and_what_is_alike_costs_less():
    lists = nearest(2000)
    assert n_bits(lists, 60, PROTOTYPES) < n_bits(lists, 60, None) - 0.7 < 4 * np.log2(60) - 8
    assert n_bits(np.repeat(lists[:, :5], 400, axis=1), 60, PROTOTYPES) < 0.5  # a robot that stands


def test_appending_changes_no_block_but_the_last(monkeypatch):
    monkeypatch.setattr(packing, "BLOCK", 100)
    lists = nearest(450)
    all_blocks, first_blocks = comes_back(lists, 60, PROTOTYPES), comes_back(lists[:, :330], 60, PROTOTYPES)
    assert (len(all_blocks), len(first_blocks)) == (5, 4)
    assert all_blocks[:3] == first_blocks[:3]
    assert all_blocks[3] != first_blocks[3]


def test_blocks_that_are_not_of_such_lists_are_refused():
    blocks = pack_lists(nearest(300), 60, PROTOTYPES)
    for bad_blocks in ([], [b""], [blocks[0][:-3]], [blocks[0] + b"\0"], [*blocks, blocks[0]]):
        with pytest.raises(ValueError, match="block"):
            unpack_lists(bad_blocks, 4, 300, 60, PROTOTYPES)
    for list_length, n_images in ((0, 300), (61, 300), (4, 0), (4, 10**9)):
        with pytest.raises(ValueError, match="blocks are not those"):
            unpack_lists(blocks, list_length, n_images, 60, PROTOTYPES)


@given(st.binary(max_size=80), st.integers(1, 200))
def test_arbitrary_bytes_never_crash(block, n_images):
    try:
        lists = unpack_lists([block], 4, n_images, 60, PROTOTYPES)
    except ValueError:
        return
    assert lists.max() < 60
