"""Ranks, short lists of ranks and normal scores, against their definitions."""

from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.descriptor import (
    n_ranked,
    nearest_landmarks,
    normal_scores,
    pack_ranked_landmarks,
    rank_landmarks,
    ranked_landmarks_within,
    ranks_from_ranked_landmarks,
    unpack_ranked_landmarks,
)
from deepsimbad.errors import InvalidDissimilaritiesError, InvalidRankedLandmarksError


@given(st.lists(st.integers(0, 6), min_size=1, max_size=30))
def test_ranks_count_nearer_landmarks_and_earlier_ties(dissimilarities):
    expected = [
        1 + sum(1 for j, other in enumerate(dissimilarities) if (other, j) < (own, i))
        for i, own in enumerate(dissimilarities)
    ]
    assert rank_landmarks(dissimilarities).tolist() == expected
    assert rank_landmarks([dissimilarities] * 2).tolist() == [expected] * 2


@pytest.mark.parametrize("bad", [[1.0, float("nan")], [float("inf"), 1.0], [], 3.0])
def test_bad_dissimilarities_are_refused(bad):
    with pytest.raises(InvalidDissimilaritiesError):
        rank_landmarks(bad)


def test_unsent_landmarks_share_the_mean_of_the_ranks_left():
    assert ranks_from_ranked_landmarks([3, 1], 6).tolist() == [4.5, 2.0, 4.5, 1.0, 4.5, 4.5]
    assert ranks_from_ranked_landmarks([1, 0, 2], 3).tolist() == [2.0, 1.0, 3.0]


@pytest.mark.parametrize("bad", [[], [0, 0], [-1], [4], [0, 1, 2, 3, 1], [2**70]])
def test_bad_ranked_landmarks_are_refused(bad):
    with pytest.raises(InvalidRankedLandmarksError):
        ranks_from_ranked_landmarks(bad, 4)


def test_how_many_landmarks_have_a_rank_of_their_own():
    order = [3, 1, 0, 5, 4, 2]
    assert [n_ranked(ranks_from_ranked_landmarks(order[:m], 6)) for m in range(1, 7)] == [1, 2, 3, 4, 6, 6]
    assert n_ranked(np.full(6, 3.5, np.float32)) == 0
    assert n_ranked(np.ones(1, np.float32)) == 1


def slow_packed(ids, n_landmarks):
    """By text: two bytes of m, then every id in as many digits as the largest needs."""
    width = 0
    while 2**width < n_landmarks:
        width += 1
    digits = f"{len(ids):016b}" + "".join(f"{one:0{width}b}" if width else "" for one in ids)
    digits += "0" * (-len(digits) % 8)
    return bytes(int(digits[place : place + 8], 2) for place in range(0, len(digits), 8))


@given(st.data())
def test_packed_ranks_are_what_their_definition_says(data):
    n_landmarks = data.draw(st.one_of(st.integers(1, 70), st.sampled_from([256, 257, 500, 512, 65_535])))
    ids = data.draw(st.lists(st.integers(0, n_landmarks - 1), min_size=1, max_size=min(n_landmarks, 80), unique=True))
    body = pack_ranked_landmarks(ids, n_landmarks)
    assert body == slow_packed(ids, n_landmarks)
    assert unpack_ranked_landmarks(body, n_landmarks) == tuple(ids)


@given(st.integers(1, 40), st.binary(max_size=30))
def test_a_packed_body_is_read_as_what_would_pack_to_it_or_refused(n_landmarks, body):
    try:
        ids = unpack_ranked_landmarks(body, n_landmarks)
    except InvalidRankedLandmarksError:
        return
    assert slow_packed(ids, n_landmarks) == body


@pytest.mark.parametrize(
    "body",
    [b"", b"\0", b"\0\0", b"\0\x0b" + bytes(6), b"\0\2", b"\0\2\x12\0", b"\0\1\x11", b"\0\1\xa0", b"\0\2\x11"],
    ids=["empty", "a byte", "m 0", "m 11 of 10", "too short", "too long", "padding", "id 10 of 10", "twice"],
)
def test_bad_packed_ranks_are_refused(body):
    with pytest.raises(InvalidRankedLandmarksError):
        unpack_ranked_landmarks(body, 10)


def test_how_many_landmarks_64_bytes_hold():
    assert [ranked_landmarks_within(64, r) for r in (1, 2, 40, 256, 300, 500, 512, 513)] == [
        1,
        2,
        40,
        62,
        55,
        55,
        55,
        49,
    ]
    assert len(pack_ranked_landmarks(range(55), 500)) == 64


def test_normal_scores_are_the_quantiles_of_the_ranks():
    ranks = np.array([[1, 2.5, 4], [4, 2, 1]], np.float32)
    expected = [[NormalDist().inv_cdf((v - 0.5) / 4) for v in row] for row in ranks]
    np.testing.assert_allclose(normal_scores(ranks, 4), expected)


def test_nearest_landmarks_are_planar_and_ties_go_by_id():
    values = np.array([[3.0, 1.0, 1.0, 2.0], [0.0, 5.0, -1.0, 0.0]])
    assert nearest_landmarks(values, 3).tolist() == [[1, 2], [2, 0], [3, 3]]
