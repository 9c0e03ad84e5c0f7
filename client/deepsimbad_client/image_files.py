"""Image files on disk: which there are, in what order, what is in them, and how they are made ready to post."""

import re
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recording import EncodedImage

Image = NDArray[np.uint8]  # [height, width, 3] BGR

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm"})
JPEG_QUALITY = 92

_DIGITS = re.compile(r"(\d+)")
_START_OF_SCAN, _END_OF_JPEG = b"\xff\xda", b"\xff\xd9"


def natural_order(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort key for file names: digits count as numbers, so 2.png comes before 10.png.

    Names padded with zeros come out exactly as plain sorting would have them.
    """
    parts = _DIGITS.split(name)
    return [(int(part), "") if place % 2 else (-1, part) for place, part in enumerate(parts)], name


def sniff_media_type(body: bytes) -> str | None:
    """Tell what an image file is from its first bytes, whatever its name; None: nothing the service takes."""
    if body.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    if body.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if body.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
        return "image/tiff"
    if body.startswith(b"RIFF") and body[8:12] == b"WEBP":
        return "image/webp"
    return None


def read_file(path: Path) -> bytes:
    """Read a frame's file.

    Raises:
        BrokenFrameError: it is missing, unreadable or empty.
    """
    try:
        body = path.read_bytes()
    except OSError as error:
        raise BrokenFrameError(f"cannot read {path}: {error.strerror or error}", "unreadable file") from error
    if not body:
        raise BrokenFrameError(f"{path} is empty", "empty file")
    return body


def decode(body: bytes, path: Path, *, as_stored: bool = False) -> Image:
    """Decode an image to 8-bit BGR; grey becomes grey BGR, 16 bits become 8, alpha is dropped.

    Args:
        body: The file's bytes.
        path: Its path, for the error alone.
        as_stored: Leave the pixels as they lie in the file; else the file's own orientation tag is obeyed.

    Raises:
        BrokenFrameError: not an image, damaged, or its end is missing.
    """
    if _ends_early(body):
        raise BrokenFrameError(f"{path} is truncated: its end is missing", "undecodable")
    flags = cv2.IMREAD_COLOR | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0)
    try:
        image = cv2.imdecode(np.frombuffer(body, dtype=np.uint8), flags)
    except cv2.error as error:
        raise BrokenFrameError(f"{path} cannot be decoded: {error.err or error}", "undecodable") from error
    if image is None:
        raise BrokenFrameError(f"{path} is not an image that can be decoded", "undecodable")
    return np.asarray(image, dtype=np.uint8)


def is_larger(image: Image, input_size: tuple[int, int] | None) -> bool:
    """Whether an image is wider or higher than (width, height)."""
    return input_size is not None and (image.shape[1] > input_size[0] or image.shape[0] > input_size[1])


def as_jpeg(image: Image, input_size: tuple[int, int] | None) -> EncodedImage:
    """Make an image ready to post: resized to exactly `input_size` where it is larger, as JPEG of quality 92."""
    if input_size is not None and is_larger(image, input_size):
        image = np.asarray(cv2.resize(image, input_size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    _, body = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return EncodedImage(body.tobytes(), "image/jpeg")


def as_png(image: Image) -> EncodedImage:
    """Make an image of a format that cannot be posted ready without losing anything."""
    _, body = cv2.imencode(".png", image)
    return EncodedImage(body.tobytes(), "image/png")


def _ends_early(body: bytes) -> bool:
    """Whether the end of an image is missing: decoders fill the rest with grey or black and say nothing."""
    match sniff_media_type(body):
        case "image/jpeg":
            # A preview inside the header has an end of its own; the one that counts follows the last scan.
            return body.rfind(_END_OF_JPEG) < body.rfind(_START_OF_SCAN) or _END_OF_JPEG not in body
        case "image/png":
            return b"IEND" not in body
        case "image/webp":
            return len(body) < 8 + int.from_bytes(body[4:8], "little")
        case "image/tiff":
            return _tiff_ends_early(body)
        case _:
            return False


_TIFF_WIDTHS = {3: 2, 4: 4}  # SHORT and LONG: what offsets and counts are written as
_STRIP_OFFSETS, _STRIP_BYTE_COUNTS, _TILE_OFFSETS, _TILE_BYTE_COUNTS = 273, 279, 324, 325


def _tiff_ends_early(body: bytes) -> bool:
    """Whether the first picture of a TIFF points past the end of the file (a BigTIFF is left to the decoder)."""
    order: Literal["little", "big"] = "little" if body[:2] == b"II" else "big"

    def number(at: int, width: int) -> int:
        return int.from_bytes(body[at : at + width], order)

    if number(2, 2) != 42:
        return False
    directory = number(4, 4)
    if directory + 2 > len(body):
        return True
    arrays: dict[int, list[int]] = {}
    for entry in range(directory + 2, directory + 2 + 12 * number(directory, 2), 12):
        tag, kind, count = number(entry, 2), number(entry + 2, 2), number(entry + 4, 4)
        width = _TIFF_WIDTHS.get(kind)
        if width is None or tag not in (_STRIP_OFFSETS, _STRIP_BYTE_COUNTS, _TILE_OFFSETS, _TILE_BYTE_COUNTS):
            continue
        at = entry + 8 if count * width <= 4 else number(entry + 8, 4)
        if at + count * width > len(body):
            return True
        arrays[tag] = [number(at + width * i, width) for i in range(count)]
    offsets = arrays.get(_STRIP_OFFSETS) or arrays.get(_TILE_OFFSETS) or []
    counts = arrays.get(_STRIP_BYTE_COUNTS) or arrays.get(_TILE_BYTE_COUNTS) or []
    return any(offset + count > len(body) for offset, count in zip(offsets, counts, strict=False))
