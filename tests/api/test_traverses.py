"""Reading a batch: what comes in comes out."""

import io
from typing import Any

import numpy as np
import pytest

from deepsimbad.api.traverses import InvalidBatchError, read_batch
from deepsimbad.errors import TooLargeError

GOOD: dict[str, Any] = {
    "encodings": np.arange(6, dtype=np.float32).reshape(2, 3),
    "index": np.array([4, 1]),
    "position_m": np.array([2.0, 1.0]),
}


def packed(compress: bool = False, **arrays: Any) -> io.BytesIO:
    file = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(file, **arrays)
    return file


@pytest.mark.parametrize("compress", [False, True])
def test_round_trip(compress: bool) -> None:
    places = {"timestamp_us": np.array([-1, 5]), "x_m": np.array([np.nan, 1.0]), "y_m": np.array([0, 1])}
    frames = read_batch(packed(compress, **GOOD, **places), 10_000).checked()
    for name, array in {**GOOD, **places}.items():
        np.testing.assert_array_equal(getattr(frames, name), array)
        assert getattr(frames, name).dtype.kind == ("i" if name in {"index", "timestamp_us"} else "f")


def test_what_was_not_sent_is_unknown() -> None:
    frames = read_batch(packed(**GOOD), 10_000).checked()
    assert frames.timestamp_us.tolist() == [-1, -1]
    assert np.isnan(frames.x_m).all()
    assert np.isnan(frames.y_m).all()


def test_fortran_order_and_other_floats() -> None:
    encodings = np.asfortranarray(np.arange(6.0).reshape(2, 3)).astype(np.float16, order="F")
    frames = read_batch(packed(**{**GOOD, "encodings": encodings}), 10_000)
    np.testing.assert_array_equal(frames.encodings, encodings)


def test_every_cut_of_a_batch_is_refused() -> None:
    whole = packed(**GOOD).getvalue()
    for length in range(0, len(whole), 7):
        with pytest.raises(InvalidBatchError):
            read_batch(io.BytesIO(whole[:length]), 10_000)


def test_any_flipped_byte_is_refused_or_harmless() -> None:
    whole = packed(**GOOD).getvalue()
    rng = np.random.default_rng(0)
    n_refused = 0
    for place in rng.choice(len(whole), 300):
        broken = bytearray(whole)
        broken[place] ^= 1 << int(rng.integers(8))
        try:
            read_batch(io.BytesIO(bytes(broken)), 10_000)
        except (InvalidBatchError, TooLargeError):
            n_refused += 1
        except Exception as error:  # only the named error may come out
            raise AssertionError(place) from error
    assert n_refused > 100
