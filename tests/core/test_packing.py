"""Posting lists survive packing, and damage is noticed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.packing import pack_index, pack_postings, unpack_index, unpack_postings


@given(st.sets(st.integers(0, 3000), min_size=1))
def test_any_posting_list_comes_back(image_ids):
    ordered = np.array(sorted(image_ids))
    assert unpack_postings(pack_postings(ordered), 3001).tolist() == ordered.tolist()


@given(st.integers(1, 10_000_000), st.integers(0, 200))
def test_far_runs_come_back(start, length):
    ordered = np.arange(start, start + length + 1)
    assert unpack_postings(pack_postings(ordered), 10_000_300).tolist() == ordered.tolist()


def test_what_lies_side_by_side_is_written_as_runs_and_what_lies_apart_as_gaps():
    assert len(pack_postings(np.arange(1000))) <= 4
    assert len(pack_postings(np.arange(0, 4000, 4))) <= 1 + 1000 * 3 // 8


def test_an_empty_list_is_an_empty_blob():
    assert pack_postings(np.array([], np.int64)) == b""
    assert unpack_postings(b"", 5).size == 0


@pytest.mark.parametrize("image_ids", [[3, 3], [4, 2], [-1, 2]])
def test_ids_that_do_not_increase_are_refused(image_ids):
    with pytest.raises(ValueError, match="increase"):
        pack_postings(np.array(image_ids))


def _lists(rng, n_images, n_landmarks, list_length):
    shuffled = rng.random((n_images, n_landmarks)).argsort(axis=1)[:, :list_length]
    return np.ascontiguousarray(shuffled.T, np.uint16)


@pytest.mark.parametrize(("n_images", "n_landmarks", "list_length"), [(1, 1, 1), (7, 5, 5), (400, 60, 4)])
def test_an_index_comes_back(n_images, n_landmarks, list_length):
    lists = _lists(np.random.default_rng(0), n_images, n_landmarks, list_length)
    postings = list(pack_index(lists, n_landmarks))
    assert [key[:2] for key in postings] == sorted(key[:2] for key in postings)
    assert all(blob for _, _, blob in postings)
    np.testing.assert_array_equal(unpack_index(postings, list_length, n_images), lists)


def test_random_lists_stay_below_the_papers_size():
    lists = _lists(np.random.default_rng(1), 26_208, 500, 4)
    payload_bits = sum(8 * len(blob) for _, _, blob in pack_index(lists, 500))
    assert payload_bits / 26_208 < 44  # the paper spends 15h = 60


def test_damage_is_noticed():
    lists = _lists(np.random.default_rng(3), 50, 8, 2)
    postings = list(pack_index(lists, 8))
    with pytest.raises(ValueError, match="fill"):
        unpack_index(postings[:-1], 2, 50)
    with pytest.raises(ValueError, match="damaged"):
        unpack_index([*postings, postings[0]], 2, 50)
    with pytest.raises(ValueError, match="out of range"):
        unpack_index([(0, 3, postings[0][2])], 2, 50)


@given(st.binary(min_size=1, max_size=40))
def test_arbitrary_bytes_never_crash(blob):
    try:
        image_ids = unpack_postings(blob, 300)
    except ValueError:
        return
    assert ((image_ids >= 0) & (image_ids < 300)).all()
