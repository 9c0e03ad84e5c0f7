"""One reader: the decoder's own pixels of every kind of file, and a name for each that lacks a part of its picture."""

import struct

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow
from PIL import TiffImagePlugin

from deepsimbad.errors import InvalidImageError, TruncatedImageError
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.image_files import MEDIA_TYPES, ImageFile
from deepsimbad_client.http import media_type_of

from .conftest import saved

LIMIT = 1_000_000
SIZE = (160, 120)


def photo(channels: int = 3) -> np.ndarray:
    """[120, 160, channels]: smooth and busy parts."""
    random = np.random.default_rng(5)
    pixels = cv2.resize(random.integers(0, 255, (12, 16, channels), np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    pixels = pixels.reshape(SIZE[1], SIZE[0], channels)
    pixels[40:80, 60:120] = random.integers(0, 255, (40, 60, channels), np.uint8)
    return pixels


def turned(orientation: int) -> Pillow.Exif:
    exif = Pillow.Exif()
    exif[0x112] = orientation
    return exif


RGB = Pillow.fromarray(photo()[..., ::-1])
CLEAR = RGB.convert("RGBA")
CLEAR.putalpha(128)
DEEP = Pillow.fromarray(np.tile(np.linspace(0, 0xFFFF, 48).astype(np.uint16), (32, 1)))
JPEGS = {
    "4:2:0": saved(RGB, "JPEG"),
    "4:4:4": saved(RGB, "JPEG", subsampling=0, quality=95),
    "progressive": saved(RGB, "JPEG", progressive=True),
    "grey": saved(RGB.convert("L"), "JPEG"),
    "progressive grey": saved(RGB.convert("L"), "JPEG", progressive=True),
    "CMYK": saved(RGB.convert("CMYK"), "JPEG"),
    "restarts": cv2.imencode(".jpg", photo(), [cv2.IMWRITE_JPEG_RST_INTERVAL, 3])[1].tobytes(),
}
OTHERS = {
    "palette": saved(RGB.convert("P"), "PNG"),
    "clear palette": saved(RGB.convert("P"), "PNG", transparency=3),
    "grey and alpha": saved(RGB.convert("LA"), "PNG"),
    "CMYK TIFF": saved(RGB.convert("CMYK"), "TIFF"),
    **{f"grey {form}": saved(RGB.convert("L"), form) for form in ("PNG", "TIFF", "WEBP")},
    **{f"bilevel {form}": saved(RGB.convert("1"), form) for form in ("PNG", "TIFF")},
    **{f"clear {form}": saved(CLEAR, form, lossless=True) for form in ("PNG", "WEBP")},
    **{f"{form} of sixteen bits": saved(DEEP, form) for form in ("PNG", "TIFF")},
    **{f"{form} on its side": saved(RGB, form, exif=turned(6), lossless=True) for form in ("PNG", "TIFF", "WEBP")},
    "pages": saved(RGB, "TIFF", save_all=True, append_images=[RGB.rotate(90)]),
    "BigTIFF": saved(RGB, "TIFF", big_tiff=True),
    "grey BigTIFF": saved(RGB.convert("L"), "TIFF", big_tiff=True, compression="tiff_lzw"),
    "animation": saved(RGB, "WEBP", save_all=True, append_images=[RGB.rotate(90)], lossless=True),
}
DECODED = {
    **{f"grey {form}": np.asarray(RGB.convert("L"))[..., np.newaxis].repeat(3, axis=2) for form in ("PNG", "TIFF")},
    **{f"clear {form}": photo() for form in ("PNG", "WEBP")},
    **{
        f"{form} of sixteen bits": (np.asarray(DEEP) >> 8)[..., np.newaxis].repeat(3, axis=2)
        for form in ("PNG", "TIFF")
    },
    **{f"{form} on its side": cv2.rotate(photo(), cv2.ROTATE_90_CLOCKWISE) for form in ("PNG", "TIFF", "WEBP")},
}
FILM = b"\0\0\0\x18ftypmp42" + np.random.default_rng(0).bytes(5000) + b"\xff\xda\xff\xd9\xff\xd8"


@pytest.mark.parametrize("kind", [*JPEGS, *OTHERS])
def test_the_pixels_are_opencvs(kind):
    """Three channels of 8 bits without alpha, the upper 8 of 16, turned as the file says."""
    body = (JPEGS | OTHERS)[kind]
    expected = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR_BGR)
    np.testing.assert_array_equal(decode_image(body, LIMIT), expected)
    np.testing.assert_array_equal(expected, DECODED.get(kind, expected))
    assert media_type_of(body) == ImageFile.read(body, LIMIT).media_type


@pytest.mark.parametrize("byte_order", [b"II", b"MM"])
@pytest.mark.parametrize("orientation", range(10))
def test_a_jpegs_orientation_is_opencvs(orientation, byte_order):
    exif = turned(orientation)
    exif.endian = "<" if byte_order == b"II" else ">"
    body = saved(RGB, "JPEG", exif=exif.tobytes())
    for flags, as_stored in ((0, False), (cv2.IMREAD_IGNORE_ORIENTATION, True)):
        expected = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR_BGR | flags)
        np.testing.assert_array_equal(decode_image(body, LIMIT, as_stored=as_stored), expected)


@pytest.mark.parametrize(
    "exif", [b"", b"II", b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x02\0\0\0\x01"]
)
def test_exif_that_cannot_be_read_turns_nothing(exif):
    segment = b"\xff\xe1" + struct.pack(">H", 8 + len(exif)) + b"Exif\0\0" + exif
    body = JPEGS["4:2:0"]
    np.testing.assert_array_equal(decode_image(body[:2] + segment + body[2:], LIMIT), decode_image(body, LIMIT))


@pytest.mark.parametrize("kind", JPEGS)
def test_a_cut_jpeg_that_was_closed_is_truncated_wherever_it_was_cut(kind):
    """Decoders fill the rest with grey, or give a progressive picture blurred, and only warn."""
    body = JPEGS[kind]
    expected, n_refused = decode_image(body, LIMIT), 0
    scan = body.index(b"\xff\xda")
    for cut in {*range(scan + 20, len(body) - 2, max(1, len(body) // 120)), *range(len(body) - 12, len(body) - 2)}:
        try:
            image = decode_image(body[:cut] + b"\xff\xd9", LIMIT)
        except TruncatedImageError:
            n_refused += 1
        else:  # the bytes behind the cut only fill up
            np.testing.assert_array_equal(image, expected, err_msg=f"cut at {cut} of {len(body)}")
    assert n_refused > 100


@pytest.mark.parametrize("kind", ["progressive", "progressive grey"])
def test_a_progressive_jpeg_that_lacks_scans_is_truncated(kind):
    body = JPEGS[kind]
    starts = [offset for offset in range(len(body)) if body[offset : offset + 2] == b"\xff\xda"]
    assert len(starts) > 4
    for start in starts[1:]:  # between scans nothing is half read, and no decoder warns
        with pytest.raises(TruncatedImageError):
            decode_image(body[:start] + b"\xff\xd9", LIMIT)


def test_most_jpegs_that_are_damaged_inside_are_refused():
    """There is no checksum: a few are decoded to their last bit for all that."""
    body, n_refused = JPEGS["4:4:4"], 0
    losses = range(len(body) // 3, len(body) * 2 // 3, 97)  # packets of a stream
    for lost in losses:
        try:
            decode_image(body[:lost] + body[lost + 200 :], LIMIT)
        except InvalidImageError:
            n_refused += 1
    assert n_refused > 0.75 * len(losses)


@pytest.mark.parametrize("kind", JPEGS)
def test_what_lies_behind_a_jpeg_or_fills_it_up_is_no_part_of_it(kind):
    body = JPEGS[kind]
    expected = decode_image(body, LIMIT)
    for longer in (body + FILM, body + JPEGS["grey"], body + b"\0" * 9, body[:-2] + b"\0" * 9 + b"\xff\xd9"):
        np.testing.assert_array_equal(decode_image(longer, LIMIT), expected)
    with pytest.raises(TruncatedImageError):
        decode_image(body[: len(body) // 2] + FILM, LIMIT)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_bigtiff_is_read_and_its_cuts_are_refused(order):
    prefix = TiffImagePlugin.II if order == "<" else TiffImagePlugin.MM
    grey = photo(1)[..., 0]
    entries = [(256, 3, SIZE[0]), (257, 3, SIZE[1]), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 16, 16)]
    entries += [(277, 3, 1), (278, 3, SIZE[1]), (279, 16, grey.size)]
    directory = struct.pack(order + "Q", len(entries))
    for tag, kind, value in entries:
        packed = struct.pack(order + ("H" if kind == 3 else "Q"), value).ljust(8, b"\0")
        directory += struct.pack(order + "HHQ", tag, kind, 1) + packed
    start = prefix + struct.pack(order + "HHHQ", 43, 8, 0, 16 + grey.size)
    body = start + grey.tobytes() + directory + bytes(8)
    np.testing.assert_array_equal(decode_image(body, LIMIT)[..., 1], grey)
    assert ImageFile.read(body, LIMIT).n_pixels == grey.size
    for cut in range(4, len(body) - 8, 300):
        with pytest.raises(TruncatedImageError):
            decode_image(body[:cut], LIMIT)


def test_every_type_is_known_to_the_client():
    assert {media_type_of(body) for body in (JPEGS | OTHERS).values()} == set(MEDIA_TYPES)
