"""Decoding: what comes out of every format, and what is refused with which name."""

import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from deepsimbad.errors import (
    DeepSimbadError,
    EmptyBodyError,
    ImageTooLargeError,
    InvalidImageError,
    TruncatedImageError,
)
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import KEPT_PIXELS, decode_image, is_blank, picture_size
from deepsimbad.evaluators.image_files import MEDIA_TYPES

from .conftest import saved

LIMIT = 1_000_000


def _png(width: int, height: int, *rest: tuple[bytes, bytes]) -> bytes:
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), *rest)
    parts = [b"\x89PNG\r\n\x1a\n"]
    for name, content in chunks:
        checksum = struct.pack(">I", zlib.crc32(name + content))
        parts.append(struct.pack(">I", len(content)) + name + content + checksum)
    return b"".join(parts)


@contextmanager
def at_most_bytes(n_bytes: int) -> Iterator[None]:
    """A block that takes no more memory at once."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()


def test_every_format_gives_the_picture(body, the_picture):
    image = decode_image(body, LIMIT)
    assert (image.shape, image.dtype) == (the_picture.shape, np.uint8)
    assert np.abs(image.astype(int) - the_picture).mean() < 8  # lossy formats included


def test_lossless_formats_give_the_very_pixels(files, the_picture):
    for name in ("png", "tiff", "deflate tiff", "lossless webp"):
        np.testing.assert_array_equal(decode_image(files[name], LIMIT), the_picture, err_msg=name)


@pytest.mark.parametrize("form", ["PNG", "TIFF", "WEBP"])
def test_of_many_frames_only_the_first_is_decoded(form):
    frames = [Pillow.fromarray(np.full((600, 800, 3), level, np.uint8)) for level in range(40, 100)]
    body = saved(frames[0], form, save_all=True, append_images=frames[1:])
    with at_most_bytes(8 * 600 * 800 * 3):
        image = decode_image(body, LIMIT)
    assert abs(int(image.mean()) - 40) <= 1


@pytest.mark.parametrize("body", [b"not an image", b"GIF89a" + bytes(40), b"BM" + bytes(60), b"%PDF-1.7", b"{}"])
def test_not_an_image(body):
    with pytest.raises(InvalidImageError) as caught:
        decode_image(body, LIMIT)
    assert (caught.value.code, caught.value.hints["allowed"]) == ("undecodable_image", list(MEDIA_TYPES))
    with pytest.raises(EmptyBodyError):
        decode_image(b"", LIMIT)


def test_every_cut_is_refused(body):
    expected = decode_image(body, LIMIT)
    for cut in range(4, len(body) - 1, max(1, len(body) // 60)):
        try:
            image = decode_image(body[:cut], LIMIT)
        except InvalidImageError:
            continue
        np.testing.assert_array_equal(image, expected)  # a cut behind the last byte that matters


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_file_without_its_end_is_named_truncated(body, share):
    with pytest.raises(TruncatedImageError):
        decode_image(body[: int(len(body) * share)], LIMIT)


def test_a_thumbnail_inside_does_not_hide_a_missing_end(files):
    thumbnail = files["jpeg"]  # holds an end-of-image marker of its own
    segment = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    holding = files["jpeg"][:2] + segment + files["jpeg"][2:]
    assert decode_image(holding, LIMIT).shape == (32, 48, 3)
    with pytest.raises(TruncatedImageError):
        decode_image(holding[:-20], LIMIT)


def test_the_pixel_limit_is_exact(body):
    assert decode_image(body, 48 * 32).shape == (32, 48, 3)
    with pytest.raises(ImageTooLargeError) as caught:
        decode_image(body, 48 * 32 - 1)
    assert caught.value.hints == {"width": 48, "height": 32, "max_pixels": 48 * 32 - 1}


def _tiff(width: int, height: int, *further_entries: tuple[int, int]) -> bytes:
    entries = [(256, width), (257, height), (273, 8), (277, 1), (279, 4), *further_entries]
    directory = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    return b"II*\x00" + struct.pack("<I", 12) + bytes(4) + struct.pack("<H", len(entries)) + directory + bytes(4)


CLAIMS = {
    "png": _png(60_000, 60_000, (b"IDAT", zlib.compress(b"")), (b"IEND", b"")),
    "png header alone": _png(60_000, 60_000),
    "jpeg": b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", 60_000, 60_000) + b"\x03" + bytes(9) + b"\xff\xd9",
    "progressive jpeg": b"\xff\xd8\xff\xc2\x00\x11\x08" + struct.pack(">HH", 60_000, 60_000) + bytes(10),
    "tiff": _tiff(60_000, 60_000),
    "tiff with huge tiles": _tiff(16, 16, (322, 60_000), (323, 60_000)),
    "webp lossy": b"RIFF\x20\0\0\0WEBPVP8 \x14\0\0\0\x10\0\0\x9d\x01\x2a"
    + struct.pack("<HH", 16_383, 16_383)
    + bytes(10),
    "webp lossless": b"RIFF\x20\0\0\0WEBPVP8L\x14\0\0\0\x2f\xff\xff\xff\x0f" + bytes(15),
    "webp extended": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\x02\0\0\0" + b"\x5f\xea\0\x5f\xea\0" + bytes(10),
}


@pytest.mark.parametrize("claim", sorted(CLAIMS))
def test_a_huge_claim_is_refused_before_anything_is_allocated(claim):
    with at_most_bytes(1_000_000), pytest.raises(ImageTooLargeError):
        decode_image(CLAIMS[claim], 50_000_000)


def test_no_pixels_and_damage_are_named(files):
    broken = bytearray(files["png"])
    broken[len(broken) // 2] ^= 0xFF
    many_scans = b"\xff\xda\x00\x02" * 300
    for body in (
        _png(0, 5, (b"IEND", b"")),
        _png(5, 5, (b"IEND", b"")),
        bytes(broken),
        files["jpeg"][:-2] + many_scans + b"\xff\xd9",
        _tiff(16, 16, (277, 60_000)),
        b"\xff\xd8\xff\xd9",
    ):
        with pytest.raises(InvalidImageError) as caught:
            decode_image(body, LIMIT)
        assert not isinstance(caught.value, TruncatedImageError)


def test_walking_a_file_of_countless_parts_is_given_up():
    for body in (b"\xff\xd8" + b"\xff\xfe\0\2" * 1_000_000, _png(5, 5, *[(b"tEXt", b"")] * 110_000)):
        with pytest.raises(InvalidImageError, match="parts"):
            decode_image(body, LIMIT)


def test_refusals_print_nothing(files, capfd):
    for body in (*files.values(), *CLAIMS.values()):
        for cut in (len(body) // 3, len(body) - 3):
            with pytest.raises((InvalidImageError, ImageTooLargeError)):
                decode_image(body[:cut], LIMIT)
    assert capfd.readouterr() == ("", "")


def test_picture_data_that_unpack_to_more_than_the_picture_are_not_unpacked():
    """A decoder unpacks all of it, though it only needs the first few rows."""
    packer = zlib.compressobj(9)
    start = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    mebibyte = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    bomb = _png(16, 16, (b"IDAT", start + mebibyte * 20_000), (b"IEND", b""))
    assert len(bomb) < 32 << 20
    with pytest.raises(InvalidImageError, match="more than the pixels"):
        decode_image(bomb, 300)


def test_a_large_png_passes(the_picture):
    noisy = np.random.default_rng(0).integers(0, 255, (500, 500, 3), np.uint8)
    body = cv2.imencode(".png", noisy)[1].tobytes()
    assert len(body) > 1 << 18
    np.testing.assert_array_equal(decode_image(body, 250_000), noisy)
    rows = body.index(b"IDAT")
    with pytest.raises(InvalidImageError):
        decode_image(_png(500, 500, (b"IDAT", b"x" + body[rows + 4 : -16]), (b"IEND", b"")), 250_000)


def test_passes_over_a_large_picture_are_counted():
    large = np.zeros((7000, 7000), np.uint8)
    body = cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last_pass = body[body.rindex(b"\xff\xda") : -2]
    with pytest.raises(InvalidImageError, match="scans"):
        decode_image(body[:-2] + last_pass * 40 + b"\xff\xd9", 49_000_000)


def test_what_a_png_says_beside_its_picture_is_not_read(the_picture, capfd):
    body = cv2.imencode(".png", the_picture)[1].tobytes()
    remarks = [(b"zTXt", b"a"), (b"iCCP", b"a\0\0" + b"x" * 20), (b"tEXt", b""), (b"gAMA", bytes(4)), (b"sRGB", b"")]
    odd = _png(48, 32, *remarks * 50)[33:]
    image = decode_image(body[:33] + odd + body[33:], LIMIT)
    np.testing.assert_array_equal(image, the_picture)
    assert capfd.readouterr() == ("", "")


def test_more_pixels_than_are_kept_are_averaged_by_a_whole_factor():
    small = cv2.resize(np.random.default_rng(2).integers(0, 255, (9, 16, 3), np.uint8), (2000, 1100))
    large = np.repeat(np.repeat(small, 3, axis=0), 3, axis=1)
    body = cv2.imencode(".png", large)[1].tobytes()
    reduced = decode_image(body, 50_000_000)
    side = 2 if large.shape[0] * large.shape[1] <= 4 * KEPT_PIXELS else 3
    assert reduced.shape == (3300 // side, 6000 // side, 3)
    assert reduced.shape[0] * reduced.shape[1] <= KEPT_PIXELS < large.shape[0] * large.shape[1]
    large_encoding, reduced_encoding = FeatureL2("gradient_grid").encode([large, reduced])
    assert np.square(large_encoding - reduced_encoding).sum() < 1e-4  # two unlike pictures are about 1 apart


@pytest.mark.parametrize("shape", [(2160, 3840), (3840, 2160), (8, 1_000_000)])
def test_as_many_pixels_as_are_kept_stay_as_they_are(shape):
    image = np.random.default_rng(3).integers(0, 2, (*shape, 1), np.uint8).repeat(3, axis=2) * 200
    np.testing.assert_array_equal(decode_image(cv2.imencode(".png", image)[1].tobytes(), 50_000_000), image)


def test_the_thinnest_image_keeps_a_row():
    thin = np.full((1, 1_000_000, 3), 90, np.uint8)
    body = cv2.imencode(".png", np.repeat(thin, 20, axis=0))[1].tobytes()
    assert decode_image(body, 50_000_000).shape == (10, 500_000, 3)


def _grained(random, grain, level=128, spread=50, size=(120, 160)):
    noise = cv2.GaussianBlur(random.normal(0, 1, size), (0, 0), grain) if grain else random.normal(0, 1, size)
    grey = np.clip(level + spread * noise / noise.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., np.newaxis], 3, axis=2)


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_one_grey_is_blank_and_so_is_noise_of_small_grain_but_not_a_faint_scene(scale):
    random = np.random.default_rng(4)
    size = (int(120 * scale), int(160 * scale))
    for blank in (_grained(random, 0, 250, 2, size), _grained(random, 0, 8, 3, size), _grained(random, 1, size=size)):
        assert is_blank(blank)
    assert is_blank(np.full((*size, 3), 90, np.uint8))
    faint = _grained(random, 25 * scale, 20, 2, size)  # blots as large as houses, hardly lit
    assert not is_blank(np.clip(faint + random.normal(0, 1, faint.shape), 0, 255).astype(np.uint8))


# Any bytes give an image or a named error, never a crash

PREFIXES = (
    b"\xff\xd8\xff",
    b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR",
    b"II*\x00\x08\x00\x00\x00",
    b"MM\x00*\x00\x00\x00\x08",
    b"RIFF\x40\x00\x00\x00WEBPVP8 ",
    b"RIFF\x40\x00\x00\x00WEBPVP8X",
    b"",
)
FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def image_or_named_error(body: bytes) -> None:
    try:
        image = decode_image(body, LIMIT)
    except DeepSimbadError:
        return
    assert (image.dtype, image.ndim, image.shape[2]) == (np.uint8, 3, 3)
    assert 0 < image.shape[0] * image.shape[1] <= LIMIT


@FUZZ
@given(prefix=st.sampled_from(PREFIXES), rest=st.binary(max_size=300))
def test_any_bytes(prefix, rest):
    image_or_named_error(prefix + rest)


@FUZZ
@given(data=st.data())
def test_damaged_files(files, data):
    body = bytearray(files[data.draw(st.sampled_from(sorted(files)))])
    for place in data.draw(st.lists(st.integers(0, len(body) - 1), min_size=1, max_size=6)):
        body[place] = data.draw(st.integers(0, 255))
    image_or_named_error(bytes(body[: data.draw(st.integers(len(body) // 2, len(body)))]))


@pytest.mark.slow
def test_damaged_headers_at_length(files):
    rng, names = np.random.default_rng(0), sorted(files)
    for number in range(2000):
        body = bytearray(files[names[number % len(names)]])
        for place in rng.integers(0, min(len(body), 220), rng.integers(1, 11)):
            body[place] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.integers(0, 256)])
        image_or_named_error(bytes(body))


@pytest.mark.parametrize("form", ["JPEG", "TIFF", "PNG", "WEBP"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_picture_is_as_large_as_it_is_decoded(form, orientation):
    exif = Pillow.Exif()
    exif[274] = orientation
    body = saved(Pillow.fromarray(np.zeros((40, 60, 3), np.uint8)), form, exif=exif)
    height, width = decode_image(body, 10_000).shape[:2]
    assert (picture_size(body), picture_size(body[:20])) == ((width, height), None)


def test_pixels_that_are_not_square_are_heeded():
    body = saved(Pillow.fromarray(np.zeros((40, 60, 3), np.uint8)), "JPEG")
    anamorphic = body.replace(b"JFIF\0\1\1\0\0\1\0\1", b"JFIF\0\1\1\0\0\2\0\1")
    assert (picture_size(body), picture_size(anamorphic)) == ((60, 40), (30, 40))
