import contextlib
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deepsimbad.evaluators.image import picture_size
from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recordings import as_png, decode

NOISE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
HERE = Path("frame")


def encoded(suffix, image=NOISE, flags=()):
    return cv2.imencode(suffix, image, list(flags))[1].tobytes()


def strip_tiff(image, keep=1.0):
    """An uncompressed one-strip TIFF whose directory stands before its pixels, as many cameras write them."""
    height, width = image.shape[:2]
    entries = [(256, 3, width), (257, 3, height), (258, 3, 8), (259, 3, 1), (262, 3, 1)]
    entries += [(273, 4, 8 + 2 + 12 * 9 + 4), (277, 3, 1), (278, 3, height), (279, 4, width * height)]
    directory = struct.pack("<H", len(entries))
    directory += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    body = b"II*\0" + struct.pack("<I", 8) + directory + b"\0\0\0\0" + image.tobytes()
    return body[: int(len(body) * keep)]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tiff", ".webp"])
@pytest.mark.parametrize("keep", [0.01, 0.5, 0.9, 0.98])
def test_a_cut_file_is_refused_not_half_decoded(suffix, keep):
    body = encoded(suffix)
    assert decode(body, HERE).shape == (40, 60, 3)
    with pytest.raises(BrokenFrameError, match="frame"):
        decode(body[: int(len(body) * keep)], HERE)


def test_a_cut_tiff_whose_directory_survived_is_refused():
    grey = NOISE[:, :, 0].copy()
    np.testing.assert_array_equal(decode(strip_tiff(grey), HERE)[:, :, 1], grey)
    with pytest.raises(BrokenFrameError, match="its end is missing"):
        decode(strip_tiff(grey, keep=0.8), HERE)


def test_the_end_of_a_preview_inside_a_jpeg_is_not_its_end():
    body, preview = encoded(".jpg"), encoded(".jpg", NOISE[::4, ::4].copy())
    with_preview = body[:2] + b"\xff\xe1" + struct.pack(">H", len(preview) + 2) + preview + body[2:]
    assert decode(with_preview, HERE).shape == (40, 60, 3)
    with pytest.raises(BrokenFrameError, match="its end is missing"):
        decode(with_preview[:-100], HERE)


@settings(max_examples=25, deadline=None)
@given(st.binary(max_size=200))
@example(b"")
@example(b"II*\0\xff\xff\xff\xff")
@example(b"MM\0*\0\0\0\x08\0\x09")
def test_no_bytes_at_all_do_anything_but_decode_or_refuse(tail):
    for head in (b"", b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08", b"\xff\xd8\xff"):
        with contextlib.suppress(BrokenFrameError):
            assert decode(head + tail, HERE).ndim == 3


def test_grey_16_bit_and_alpha_become_8_bit_bgr():
    grey = NOISE[:, :, 0].copy()
    np.testing.assert_array_equal(decode(encoded(".png", grey), HERE), cv2.merge([grey] * 3))
    deep = NOISE.astype(np.uint16) * 256 + 128
    np.testing.assert_array_equal(decode(encoded(".png", deep), HERE), NOISE)
    with_alpha = np.dstack((NOISE, np.zeros((40, 60), np.uint8)))
    np.testing.assert_array_equal(decode(encoded(".png", with_alpha), HERE), NOISE)


@pytest.mark.parametrize(("size", "picture_shape"), [((60, 40), (60, 40)), ((24, 24), (36, 24)), ((30, 40), (60, 40))])
def test_a_copy_says_which_shape_its_picture_has(size, picture_shape):
    copy = as_png(NOISE, size).body
    assert decode(copy, HERE).shape == (size[1], size[0], 3)
    assert picture_size(copy) == picture_shape
