"""The one place where images are read and decoded: JPEG, PNG, TIFF and WebP bytes -> upright 8-bit BGR.

EXIF (and TIFF) orientation is applied; grey becomes three equal channels; of 16 bits a channel the upper 8 are
kept; alpha is dropped (PNG and WebP give their colours as stored, TIFF's come composited on black); of several
pages or animation frames the first is taken and no other decoded. An image of more than `KEPT_PIXELS` is reduced by a
whole factor, whoever decodes it: no extractor needs so many, and looking at them would keep live views waiting.

Decoders allocate what a header asks for, unpack what a file brings and half decode a truncated one without a word, so a
file is walked from one end to the other before OpenCV sees it. Why by hand: docs/decisions/0005-libraries.md.
"""

import math
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import cv2
import numpy as np

from deepsimbad.errors import EmptyBodyError, ImageTooLargeError, InvalidImageError, TruncatedImageError
from deepsimbad.evaluators.base import Image, named_lack_of_memory

KEPT_PIXELS = 3840 * 2160

# Bad input is answered by a named error; OpenCV's own words about it would only fill the server's log.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

_BLANK_BELOW_STD = 1.0  # grey levels of 256
_DECODER_BYTES = 9  # a pixel: the picture, and the coefficients of a progressive JPEG
_MAX_PARTS = 100_000  # chunks, segments, strips: a real file has far fewer, walking millions costs seconds
# A marker that ends entropy-coded data, in which FF 00 is a stuffed FF and FF D0..D7 a restart.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # without DHT, JPG and DAC
_JPEG_START, _JPEG_END, _JPEG_SCAN = 0xD8, 0xD9, 0xDA
_JPEG_MAX_SCANS = 200  # a progressive file uses about ten; thousands of empty ones are an attack on the decoder
_JPEG_MAX_SCANNED = 2_000_000_000  # pixels of all scans together: each costs the decoder a pass over the picture
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_PICTURE = frozenset({b"IHDR", b"PLTE", b"tRNS", b"eXIf", b"IDAT", b"IEND"})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_PNG_UNPACKED = 1 << 18  # bytes of picture data: what is packed in less keeps a decoder for a quarter of a second
_TIFF_FIELD_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_TIFF_FORMATS = {1: "B", 3: "H", 4: "I", 13: "I"}  # the integer field types: BYTE, SHORT, LONG, IFD
_TIFF_SIZES = (256, 257, 322, 323, 277)  # width and height, those of tiles, samples of a pixel
_TIFF_PARTS = ((273, 279), (324, 325))  # offsets and byte counts of strips, of tiles
_TIFF_TAGS = {*_TIFF_SIZES, *_TIFF_PARTS[0], *_TIFF_PARTS[1]}
_TIFF_MAX_SAMPLES = 5  # CMYK and alpha


@dataclass(frozen=True)
class ImageFile:
    """A file that is whole and claims no more pixels than it may."""

    picture: bytes  # the file, without what a decoder need not see
    n_pixels: int  # of the largest surface that its header makes a decoder allocate

    @classmethod
    def read(cls, body: bytes, max_pixels: int) -> "ImageFile":
        """Look at a file from one end to the other; what it is stands in its first bytes, whatever it was called.

        Raises:
            EmptyBodyError: No bytes.
            ImageTooLargeError: The header claims more pixels than `max_pixels`.
            TruncatedImageError: The end of the file is missing.
            InvalidImageError: Not one of `MEDIA_TYPES`, or it contradicts itself.
            OutOfMemoryError: There is too little memory for it.
        """
        if not body:
            raise EmptyBodyError("the body is empty: send the image's bytes")
        for signature, walk in _FORMATS.values():
            if re.match(signature, body, re.DOTALL):
                with named_lack_of_memory("decode"):
                    return cls(*walk(body, max_pixels))
        raise InvalidImageError("this is not a JPEG, PNG, TIFF or WebP image", allowed=list(MEDIA_TYPES))

    def decode(self) -> Image:
        """[height, width, 3] uint8 BGR; height x width is at most `KEPT_PIXELS`.

        Raises:
            InvalidImageError: It is damaged.
            OutOfMemoryError: There is too little memory for it.
        """
        try:
            with named_lack_of_memory("decode"):
                image = cv2.imdecode(np.frombuffer(self.picture, np.uint8), cv2.IMREAD_COLOR_BGR)
                if image is not None and image.dtype == np.uint8 and image.size and image.shape[2:] == (3,):
                    return _reduced(np.ascontiguousarray(image, np.uint8))
                np.empty(_DECODER_BYTES * self.n_pixels, np.uint8)  # codecs say of too little memory what of damage
        except cv2.error as error:
            raise InvalidImageError("the image cannot be decoded") from error
        raise InvalidImageError("the image cannot be decoded")


def decode_image(body: bytes, max_pixels: int) -> Image:
    """Read and decode one image; see `ImageFile`."""
    return ImageFile.read(body, max_pixels).decode()


def is_blank(image: Image) -> bool:
    """Whether an image shows nothing: grey levels that differ by no more than a sensor's noise does in the dark."""
    _, deviation = cv2.meanStdDev(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return float(deviation[0, 0]) < _BLANK_BELOW_STD


def _reduced(image: Image) -> Image:
    """Means of squares, of the least whole side that leaves no more than may be kept; usual images as they are."""
    height, width = image.shape[:2]
    side = math.ceil(math.sqrt(height * width / KEPT_PIXELS))
    if side == 1:
        return image
    size = (max(1, width // side), max(1, height // side))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _n_pixels(width: int, height: int, max_pixels: int) -> int:
    if width < 1 or height < 1:
        _damaged(f"it claims {width} x {height} pixels")
    if width * height > max_pixels:
        raise ImageTooLargeError(
            f"the image claims {width} x {height} pixels, at most {max_pixels} are accepted",
            width=width, height=height, max_pixels=max_pixels,
        )  # fmt: skip
    return width * height


def _unpack(form: str, body: bytes, offset: int) -> tuple[Any, ...]:
    if offset + struct.calcsize(form) > len(body):
        _truncated()
    return struct.unpack_from(form, body, offset)


def _truncated() -> NoReturn:
    raise TruncatedImageError("the image file ends too early: its end is missing")


def _damaged(why: str) -> NoReturn:
    raise InvalidImageError(f"the image file is damaged: {why}")


def _jpeg(body: bytes, max_pixels: int) -> tuple[bytes, int]:
    """Segments of (FF, marker, length, content); after SOS, entropy-coded data to the next marker; EOI last."""
    at, n_frames, n_scans, n_pixels = 2, 0, 0, 0
    for _ in range(_MAX_PARTS):
        if n_scans == 0 and at < len(body) and body[at] != 0xFF:
            _damaged("no marker where one must be")
        marked = _JPEG_MARKER.search(body, at)
        if marked is None:
            _truncated()
        marker, at = marked[0][1], marked.end()
        if marker == _JPEG_END:
            break
        if marker in {_JPEG_START, 0x01}:
            continue
        (length,) = _unpack(">H", body, at)
        if length < 2:
            _damaged("a segment shorter than its own length")
        if marker in _JPEG_FRAMES:
            n_frames += 1
            _, height, width = _unpack(">BHH", body, at + 2)
            n_pixels = _n_pixels(width, height, max_pixels)
        n_scans += marker == _JPEG_SCAN
        if n_frames > 1 or n_scans > _JPEG_MAX_SCANS or n_scans * n_pixels > _JPEG_MAX_SCANNED:
            _damaged(f"it has {n_frames} frames and {n_scans} scans")
        at += length
    else:
        _damaged(f"it has more than {_MAX_PARTS} parts")
    if n_frames == 0 or n_scans == 0:
        _damaged("it has no picture")
    return body, n_pixels


def _png(body: bytes, max_pixels: int) -> tuple[bytes, int]:
    """Signature, then chunks of (length, name, content, checksum); IHDR first, IEND last.

    Texts, colour profiles and further frames are left away: the decoder would unpack them, and complain of damaged ones
    on standard error.
    """
    length, name, width, height, bits, colour = _unpack(">I4sIIBB", body, len(_PNG_SIGNATURE))
    if name != b"IHDR" or length != 13:
        _damaged("it does not begin with its header")
    n_pixels = _n_pixels(width, height, max_pixels)
    view, at = memoryview(body), len(_PNG_SIGNATURE)
    packed, picture = [], [view[:at]]
    for _ in range(_MAX_PARTS):
        (length,) = _unpack(">I", body, at)
        name, end = body[at + 4 : at + 8], at + 12 + length
        (checksum,) = _unpack(">I", body, end - 4)
        if zlib.crc32(view[at + 4 : end - 4]) != checksum:
            _damaged("a checksum does not fit")
        if name in _PNG_PICTURE:
            picture.append(view[at:end])
        if name == b"IDAT":
            packed.append(view[at + 8 : end - 4])
        at = end
        if name == b"IEND":
            break
    else:
        _damaged(f"it has more than {_MAX_PARTS} parts")
    # Twice, for interlacing adds a little.
    _check_unpacks(packed, 2 * height * (1 + width * bits * _PNG_CHANNELS.get(colour, 4) // 8) + (1 << 16))
    return b"".join(picture), n_pixels


def _check_unpacks(packed: list[memoryview], most: int) -> None:
    """Refuse picture data of a PNG that unpack to far more than its pixels: a decoder would unpack it all."""
    if sum(map(len, packed)) <= _PNG_UNPACKED:
        return
    unpacker, n_bytes = zlib.decompressobj(), 0
    try:
        for piece in packed:
            rest: bytes | memoryview = piece
            while len(rest) > 0 and not unpacker.eof:
                n_bytes += len(unpacker.decompress(rest, 1 << 20))
                rest = unpacker.unconsumed_tail
                if n_bytes > most:
                    _damaged("it unpacks to more than the pixels that its header claims")
    except zlib.error as error:
        raise InvalidImageError("the image file is damaged: its picture cannot be unpacked") from error


def _tiff(body: bytes, max_pixels: int) -> tuple[bytes, int]:
    """Byte order, offset of the first directory; a directory holds (tag, type, count, value or its offset)."""
    order = "<" if body.startswith(b"II") else ">"
    (at,) = _unpack(order + "I", body, 4)
    (n_fields,) = _unpack(order + "H", body, at)
    fields: dict[int, tuple[int, ...]] = {}
    for entry in range(at + 2, at + 2 + 12 * n_fields, 12):
        tag, kind, count, offset = _unpack(order + "HHII", body, entry)
        size = count * _TIFF_FIELD_BYTES.get(kind, 0)
        if size > 4 and offset + size > len(body):
            _truncated()
        if tag in _TIFF_TAGS and tag not in fields and kind in _TIFF_FORMATS:
            if count > _MAX_PARTS:
                _damaged(f"it has more than {_MAX_PARTS} parts")
            fields[tag] = _unpack(f"{order}{count}{_TIFF_FORMATS[kind]}", body, offset if size > 4 else entry + 8)
    width, height, tile_width, tile_height, samples = (max(fields.get(tag, ()), default=0) for tag in _TIFF_SIZES)
    if samples > _TIFF_MAX_SAMPLES:
        _damaged(f"it claims {samples} channels")
    if width * height > 0 and tile_width * tile_height > width * height:
        width, height = tile_width, tile_height
    n_pixels = _n_pixels(width, height, max_pixels)
    parts = (zip(fields.get(begin, ()), fields.get(length, ()), strict=False) for begin, length in _TIFF_PARTS)
    ends = [begin + length for part in parts for begin, length in part]
    if not ends:
        _damaged("it has no picture")
    if max(ends) > len(body):
        _truncated()
    return body, n_pixels


def _webp(body: bytes, max_pixels: int) -> tuple[bytes, int]:
    """RIFF, length, WEBP, then chunks of (name, length, content); the decoder holds all of them to the first."""
    name, width, height = body[12:16], 0, 0
    if name == b"VP8 ":
        width, height = (side & 0x3FFF for side in _unpack("<HH", body, 26))
    elif name == b"VP8L":
        (bits,) = _unpack("<I", body, 21)
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    elif name == b"VP8X":
        low_width, high_width, low_height, high_height = _unpack("<HBHB", body, 24)
        width, height = (high_width << 16 | low_width) + 1, (high_height << 16 | low_height) + 1
    n_pixels = _n_pixels(width, height, max_pixels)
    if 8 + _unpack("<I", body, 4)[0] > len(body):
        _truncated()
    return body, n_pixels


_FORMATS: Mapping[str, tuple[bytes, Callable[[bytes, int], tuple[bytes, int]]]] = {
    "image/jpeg": (rb"\xff\xd8\xff", _jpeg),
    "image/png": (_PNG_SIGNATURE, _png),
    "image/tiff": (rb"II\*\0|MM\0\*", _tiff),
    "image/webp": (rb"RIFF....WEBP", _webp),
}
MEDIA_TYPES = tuple(_FORMATS)
