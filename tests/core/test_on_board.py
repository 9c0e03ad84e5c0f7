"""Views in a few bytes, against their definitions: packed ranked landmarks and packed unit encodings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.composed import unit
from deepsimbad.core.on_board import (
    pack_ranked_landmarks,
    pack_unit_encoding,
    ranked_landmarks_within,
    unpack_ranked_landmarks,
    unpack_unit_encoding,
)
from deepsimbad.errors import InvalidEncodingError, InvalidRankedLandmarksError


def slow_packed(ids, n_landmarks):
    """By text: two bytes of m, then every id in as many digits as the largest needs."""
    width = 0
    while 2**width < n_landmarks:
        width += 1
    digits = f"{len(ids):016b}" + "".join(f"{landmark:0{width}b}" if width else "" for landmark in ids)
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


def test_a_unit_encoding_by_hand():
    # Three bits: three steps on either side of zero, the largest number the last of them; 6, 3, 1, 3 and four zeros.
    body = bytes([3, 0b110_011_00, 0b1_011_0000])
    assert pack_unit_encoding(np.array([0.9, 0.1, -0.6, 0.0]), 3) == body
    assert unpack_unit_encoding(body, 4) == pytest.approx(np.array([3, 0, -2, 0]) / np.sqrt(13))
    assert pack_unit_encoding(np.zeros(2), 2) == bytes([2, 0b01_01_0000])
    assert not unpack_unit_encoding(bytes([2, 0b01_01_0000]), 2).any()


@given(st.integers(0, 99), st.integers(1, 200), st.integers(2, 8))
def test_a_unit_encoding_comes_back_within_half_a_step(seed, n_numbers, n_bits):
    u = unit(np.random.default_rng(seed).normal(size=n_numbers))
    body = pack_unit_encoding(u, n_bits)
    assert len(body) == 1 + -(-n_numbers * n_bits // 8)
    back = unpack_unit_encoding(body, n_numbers)
    assert np.linalg.norm(back) == pytest.approx(1)
    steps = 2 ** (n_bits - 1) - 1
    assert np.abs(back / np.abs(back).max() - u / np.abs(u).max()).max() <= 0.5001 / steps


@given(st.integers(1, 20), st.binary(max_size=20))
def test_a_packed_unit_encoding_is_read_whole_or_refused(n_numbers, body):
    try:
        u = unpack_unit_encoding(body, n_numbers)
    except InvalidEncodingError:
        return
    assert u.shape == (n_numbers,)
    assert np.linalg.norm(u) == pytest.approx(1 if u.any() else 0)


@pytest.mark.parametrize(
    "body",
    [b"", b"\5", b"\1\0", b"\x09\0\0\0\0", b"\3\0", b"\3\0\0\0", b"\3\0\1", b"\3\xff\xf0"],
    ids=["empty", "a byte", "1 bit", "9 bits", "too short", "too long", "padding", "code 7 of 6"],
)
def test_bad_packed_unit_encodings_are_refused(body):
    with pytest.raises(InvalidEncodingError):
        unpack_unit_encoding(body, 4)


@pytest.mark.parametrize(("u", "n_bits"), [([np.nan, 1], 5), ([np.inf, 1], 5), ([0, 1], 1), ([0, 1], 9)])
def test_what_is_no_unit_encoding_is_not_packed(u, n_bits):
    with pytest.raises(InvalidEncodingError):
        pack_unit_encoding(np.array(u, float), n_bits)
