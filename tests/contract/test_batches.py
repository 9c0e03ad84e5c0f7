"""A batch of frames: what comes in comes out, and whatever is wrong with one is refused and changes nothing."""

import io
import zipfile

import numpy as np
import pytest

from deepsimbad.engine.traverses import read_batch
from deepsimbad.errors import InvalidBatchError, TooLargeError

from .conftest import DIM, JSON, NPZ, npz, problem

TRAVERSE = "/v1/admin/domains/ready/traverses/drive"
FRAMES = f"{TRAVERSE}/frames"

GOOD = {"encodings": np.ones((2, DIM), np.float32), "index": np.array([0, 1]), "position_m": np.array([0.0, 1.0])}


def zipped(members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def npy(array, **options):
    file = io.BytesIO()
    np.lib.format.write_array(file, array, **options)
    return file.getvalue()


def npy_header(shape):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue()


def with_encodings(content):
    return zipped({**{f"{key}.npy": npy(array) for key, array in GOOD.items()}, "encodings.npy": content})


BATCHES = [
    (b"not a zip", "invalid_batch"),
    (npz(**GOOD)[:-30], "invalid_batch"),
    (npz(**GOOD)[30:], "invalid_batch"),
    (b"PK\x05\x06" + bytes(18), "invalid_batch"),
    (npz(encodings=GOOD["encodings"], index=GOOD["index"]), "invalid_batch"),
    (with_encodings(npy(np.array([["a", object()]], object), allow_pickle=True)), "invalid_batch"),
    (with_encodings(npy_header((10**9, 10**9))), "invalid_batch"),
    (with_encodings(npy_header((2, DIM)) + bytes(4 * DIM)), "invalid_batch"),
    (with_encodings(npy_header((2, DIM)) + bytes(8 * DIM + 1)), "invalid_batch"),
    (with_encodings(b"\x93NUMPY\x09\x00"), "invalid_batch"),
    (with_encodings(b""), "invalid_batch"),
    (zipped({f"{i}.npy": b"" for i in range(1000)}), "invalid_batch"),
    *(
        (npz(**{**GOOD, **changed}), code)
        for code, changed in (
            ("invalid_batch", {"colour": np.ones(2)}),
            ("invalid_batch", {"encodings": np.ones(2, np.float32)}),
            ("invalid_batch", {"encodings": np.ones((2, DIM), complex)}),
            ("invalid_batch", {"index": np.array([0.0, 1.0])}),
            ("invalid_batch", {"index": np.array(["0", "1"])}),
            ("invalid_input", {"index": np.array([0, 0])}),
            ("invalid_input", {"index": np.array([0, -1])}),
            ("invalid_input", {"index": np.array([0, 2**64 - 1], np.uint64)}),
            ("invalid_input", {"index": np.array([0])}),
            ("invalid_route", {"position_m": np.array([0.0, np.nan])}),
            ("invalid_route", {"position_m": np.array([0.0, np.inf])}),
            ("invalid_route", {"position_m": np.array([-1.7e308, 1.7e308])}),
            ("invalid_route", {"position_m": np.array([0.0, 1.1e9])}),
            ("invalid_input", {"x_m": np.array([0.0, np.inf])}),
            ("invalid_input", {"x_m": np.array([0.0, 1e200])}),
            ("invalid_input", {"y_m": np.array([np.nan, -1e200])}),
            ("invalid_input", {"timestamp_us": np.array([0, -2])}),
            ("invalid_input", {"name": np.array(["a", "b\t"])}),
            ("invalid_batch", {"name": np.array(["a", "b" * 256])}),
            ("invalid_batch", {"name": np.array([1, 2])}),
            ("invalid_encoding", {"encodings": np.full((2, DIM), np.nan, np.float32)}),
            ("invalid_encoding", {"encodings": np.full((2, DIM), 1e300)}),
            ("invalid_encoding", {"encodings": np.ones((2, DIM + 1), np.float32)}),
            ("invalid_encoding", {"encodings": np.ones((0, DIM), np.float32)}),
        )
    ),
]


@pytest.mark.parametrize(("body", "code"), BATCHES, ids=range(len(BATCHES)))
def test_bad_batches(client, body, code):
    description = client.get(TRAVERSE).json()
    problem(client.post(FRAMES, content=body, headers=NPZ), 422, code)
    assert client.get(TRAVERSE).json() == description


def test_batches_that_are_too_much(client):
    problem(client.post(FRAMES, content=bytes(500_001), headers=NPZ), 413, "body_too_large")
    bomb = with_encodings(npy_header((62_500, DIM)) + bytes(4 * 62_500 * DIM))
    assert len(bomb) < 100_000
    assert problem(client.post(FRAMES, content=bomb, headers=NPZ), 413, "too_large")["max_bytes"] == 500_000
    problem(client.post(FRAMES, content=b"", headers=NPZ), 422, "empty_body")
    problem(client.post(FRAMES, content=npz(**GOOD), headers=JSON), 415, "unsupported_media_type")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_round_trip(save):
    encodings = np.asfortranarray(np.arange(6.0).reshape(2, 3)).astype(np.float16, order="F")
    frames = {"encodings": encodings, "index": np.array([4, 1]), "position_m": np.array([2.0, 1.0])}
    places = {"timestamp_us": np.array([-1, 5]), "x_m": np.array([np.nan, 1.0]), "y_m": np.array([0, 1])}
    file = io.BytesIO()
    save(file, **frames, **places)
    drive = read_batch(file, 10_000).checked()
    for name, array in {**frames, **places}.items():
        np.testing.assert_array_equal(getattr(drive, name), array)
        assert getattr(drive, name).dtype.kind == ("i" if name in {"index", "timestamp_us"} else "f")
    bare_drive = read_batch(io.BytesIO(npz(**frames)), 10_000).checked()
    assert bare_drive.timestamp_us.tolist() == [-1, -1]
    assert np.isnan([bare_drive.x_m, bare_drive.y_m]).all()


def test_every_cut_of_a_batch_is_refused_and_any_flipped_byte_is_or_is_harmless():
    batch = npz(**GOOD)
    for length in range(0, len(batch), 7):
        with pytest.raises(InvalidBatchError):
            read_batch(io.BytesIO(batch[:length]), 10_000)
    rng = np.random.default_rng(0)
    n_refused = 0
    for place in rng.choice(len(batch), 300):
        content = bytearray(batch)
        content[place] ^= 1 << int(rng.integers(8))
        try:
            read_batch(io.BytesIO(bytes(content)), 10_000)
        except (InvalidBatchError, TooLargeError):  # no other error may come out
            n_refused += 1
    assert n_refused > 100
