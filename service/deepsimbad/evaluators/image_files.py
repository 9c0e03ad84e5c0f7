"""Files of images, walked from one end to the other before a decoder sees them: JPEG, PNG, TIFF and WebP.

Decoders allocate what a header asks for, unpack what a file brings and half decode a truncated one without a warning.
Why no library does this: docs/decisions/0005-libraries.md.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from deepsimbad.errors import EmptyBodyError, ImageTooLargeError, InvalidImageError, TruncatedImageError
from deepsimbad.evaluators.base import named_lack_of_memory

JPEG, PNG, TIFF, WEBP = "image/jpeg", "image/png", "image/tiff", "image/webp"

_MAX_PARTS = 100_000  # chunks, segments, strips: a real file has far fewer, walking millions costs seconds
# A marker that ends entropy-coded data, in which FF 00 is a stuffed FF and FF D0..D7 a restart.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # without DHT, JPG and DAC
_JPEG_START, _JPEG_END, _JPEG_SCAN, _JPEG_EXIF = 0xD8, 0xD9, 0xDA, 0xE1
_JPEG_MAX_SCANS = 200  # a progressive file uses about ten; thousands of empty ones are an attack on the decoder
_JPEG_MAX_SCANNED = 2_000_000_000  # pixels of all scans together: each costs the decoder a pass over the picture
_JPEG_MAX_COMPONENTS = 4
_ALL_COEFFICIENTS = (1 << 64) - 1
_EXIF = b"Exif\0\0"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_PICTURE = frozenset({b"IHDR", b"PLTE", b"tRNS", b"eXIf", b"IDAT", b"IEND"})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_PNG_UNPACKED = 1 << 18  # bytes of picture data: what is packed in less keeps a decoder for a quarter of a second
_TIFF_FIELD_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 18: 8}
_TIFF_FORMATS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}  # the integers: BYTE, SHORT, LONG, IFD, 8 bytes
_TIFF_SIZES = (256, 257, 322, 323, 277)  # width and height, those of tiles, samples of a pixel
_TIFF_PARTS = ((273, 279), (324, 325))  # offsets and byte counts of strips, of tiles
_TIFF_BITS, _TIFF_ORIENTATION = 258, 274
_TIFF_TAGS = {*_TIFF_SIZES, *_TIFF_PARTS[0], *_TIFF_PARTS[1], _TIFF_BITS, _TIFF_ORIENTATION}
_TIFF_MAX_SAMPLES = 5  # CMYK and alpha


@dataclass(frozen=True)
class ImageFile:
    """A file that is whole and claims no more pixels than it may."""

    media_type: str
    picture: bytes  # the file, without what a decoder need not see
    n_pixels: int  # of the largest surface that its header makes a decoder allocate
    orientation: int = 1  # as a JPEG's Exif gives it; other files' decoders apply it themselves
    bits: int = 8  # a channel

    @classmethod
    def read(cls, body: bytes, max_pixels: int) -> "ImageFile":
        """Look at a file from one end to the other; its first bytes say what it is, whatever its name.

        Raises:
            EmptyBodyError: No bytes.
            ImageTooLargeError: The header claims more pixels than `max_pixels`.
            TruncatedImageError: The end of the file is missing.
            InvalidImageError: Not one of `MEDIA_TYPES`, or it contradicts itself.
            OutOfMemoryError: There is too little memory for it.
        """
        if not body:
            raise EmptyBodyError("the body is empty: send the image's bytes")
        for media_type, (signature, walk) in _FORMATS.items():
            if re.match(signature, body, re.DOTALL):
                with named_lack_of_memory("decode"):
                    return cls(media_type, *walk(body, max_pixels))
        raise InvalidImageError("this is not a JPEG, PNG, TIFF or WebP image", allowed=list(MEDIA_TYPES))


def raise_truncated() -> NoReturn:
    """Raise TruncatedImageError."""
    raise TruncatedImageError("the image file ends too early: its end is missing")


def _n_pixels(width: int, height: int, max_pixels: int) -> int:
    if width < 1 or height < 1:
        _raise_damaged(f"it claims {width} x {height} pixels")
    if width * height > max_pixels:
        raise ImageTooLargeError(
            f"the image claims {width} x {height} pixels, at most {max_pixels} are accepted",
            width=width, height=height, max_pixels=max_pixels,
        )  # fmt: skip
    return width * height


def _unpack(form: str, body: bytes, offset: int) -> tuple[Any, ...]:
    if offset + struct.calcsize(form) > len(body):
        raise_truncated()
    return struct.unpack_from(form, body, offset)


def _raise_damaged(reason: str) -> NoReturn:
    raise InvalidImageError(f"the image file is damaged: {reason}")


def _jpeg(body: bytes, max_pixels: int) -> tuple[bytes, int, int]:
    """Segments of (FF, marker, length, content); after SOS, entropy-coded data to the next marker; EOI last.

    What follows the end (a film, a map of depths) is left out. A file that was cut and closed by an end lacks scans, or
    has one that its decoder finds short.
    """
    n_frames, n_scans, n_pixels, orientation, end = 0, 0, 0, 1, 2
    complete_bits: dict[int, int] = {}  # by component, a bit for each coefficient of a block that is complete
    for marker, start, end in _jpeg_segments(body):
        if marker in _JPEG_FRAMES:
            n_frames += 1
            _, height, width, n_components = _unpack(">BHHB", body, start)
            n_pixels = _n_pixels(width, height, max_pixels)
            n_components = min(n_components, _JPEG_MAX_COMPONENTS)  # a decoder refuses more
            complete_bits = dict.fromkeys(_unpack("B2x" * n_components, body, start + 6), 0)
        elif marker == _JPEG_SCAN:
            n_scans += 1
            _note_scan(body[start:end], complete_bits)
        elif marker == _JPEG_EXIF and body.startswith(_EXIF, start):
            orientation = _exif_orientation(body[start + len(_EXIF) : end])
        if n_frames > 1 or n_scans > _JPEG_MAX_SCANS or n_scans * n_pixels > _JPEG_MAX_SCANNED:
            _raise_damaged(f"it has {n_frames} frames and {n_scans} scans")
    if n_frames == 0 or n_scans == 0:
        _raise_damaged("it has no picture")
    if any(coefficients != _ALL_COEFFICIENTS for coefficients in complete_bits.values()):
        raise_truncated()
    return body[:end], n_pixels, orientation


def _jpeg_segments(body: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (marker, start and end of its content) of the segments in order, the picture's end last."""
    offset, is_scanned = 2, False
    for _ in range(_MAX_PARTS):
        if not is_scanned and offset < len(body) and body[offset] != 0xFF:
            _raise_damaged("no marker where one must be")
        match = _JPEG_MARKER.search(body, offset)
        if match is None:
            raise_truncated()
        marker, offset = match[0][1], match.end()
        if marker == _JPEG_END:
            yield marker, offset, offset
            return
        if marker in {_JPEG_START, 0x01}:
            continue
        (length,) = _unpack(">H", body, offset)
        if length < 2:
            _raise_damaged("a segment shorter than its own length")
        if offset + length > len(body):
            raise_truncated()
        yield marker, offset + 2, offset + length
        is_scanned |= marker == _JPEG_SCAN
        offset += length
    _raise_damaged(f"it has more than {_MAX_PARTS} parts")


def _note_scan(header: bytes, complete_bits: dict[int, int]) -> None:
    """Note which coefficients of which components a scan completes."""
    n_components = header[0] if header else 0
    if n_components == 0 or len(header) < 4 + 2 * n_components:
        _raise_damaged("a scan that does not say what it holds")
    first, last, bits = header[1 + 2 * n_components : 4 + 2 * n_components]
    if first <= last <= 63 and bits & 0x0F == 0:  # else a progressive file's lower bits are still to come
        for component in header[1 : 1 + 2 * n_components : 2]:
            if component in complete_bits:
                complete_bits[component] |= (2 << last) - (1 << first)


def _exif_orientation(exif: bytes) -> int:
    """1..8 as Exif counts orientations, from its TIFF's first directory; 1 where it cannot be read, as for decoders."""
    try:
        (orientation,) = _tiff_fields(exif)[_TIFF_ORIENTATION]
    except (InvalidImageError, KeyError, ValueError):
        return 1
    return orientation if orientation in range(1, 9) else 1


def _png(body: bytes, max_pixels: int) -> tuple[bytes, int, int, int]:
    """Signature, then chunks of (length, name, content, checksum); IHDR first, IEND last.

    Texts, colour profiles and further frames are left out: the decoder would unpack them, and complain of damaged ones
    on standard error.
    """
    length, name, width, height, bits, colour = _unpack(">I4sIIBB", body, len(_PNG_SIGNATURE))
    if name != b"IHDR" or length != 13:
        _raise_damaged("it does not begin with its header")
    n_pixels = _n_pixels(width, height, max_pixels)
    view, start = memoryview(body), len(_PNG_SIGNATURE)
    packed, picture = [], [view[:start]]
    for _ in range(_MAX_PARTS):
        (length,) = _unpack(">I", body, start)
        name, end = body[start + 4 : start + 8], start + 12 + length
        (checksum,) = _unpack(">I", body, end - 4)
        if zlib.crc32(view[start + 4 : end - 4]) != checksum:
            _raise_damaged("a checksum does not fit")
        if name in _PNG_PICTURE:
            picture.append(view[start:end])
        if name == b"IDAT":
            packed.append(view[start + 8 : end - 4])
        start = end
        if name == b"IEND":
            break
    else:
        _raise_damaged(f"it has more than {_MAX_PARTS} parts")
    # Twice, for interlacing adds a little.
    _check_unpacks(packed, 2 * height * (1 + width * bits * _PNG_CHANNELS.get(colour, 4) // 8) + (1 << 16))
    return b"".join(picture), n_pixels, 1, bits


def _check_unpacks(packed: list[memoryview], limit_bytes: int) -> None:
    """Refuse a PNG whose picture data unpacks to far more than its pixels: a decoder would unpack it all."""
    if sum(map(len, packed)) <= _PNG_UNPACKED:
        return
    unpacker, n_bytes = zlib.decompressobj(), 0
    try:
        for piece in packed:
            rest: bytes | memoryview = piece
            while len(rest) > 0 and not unpacker.eof:
                n_bytes += len(unpacker.decompress(rest, 1 << 20))
                rest = unpacker.unconsumed_tail
                if n_bytes > limit_bytes:
                    _raise_damaged("it unpacks to more than the pixels that its header claims")
    except zlib.error as error:
        raise InvalidImageError("the image file is damaged: its picture cannot be unpacked") from error


def _tiff(body: bytes, max_pixels: int) -> tuple[bytes, int, int, int]:
    fields = _tiff_fields(body)
    width, height, tile_width, tile_height, samples = (max(fields.get(tag, ()), default=0) for tag in _TIFF_SIZES)
    if samples > _TIFF_MAX_SAMPLES:
        _raise_damaged(f"it claims {samples} channels")
    if width * height > 0 and tile_width * tile_height > width * height:
        width, height = tile_width, tile_height
    n_pixels = _n_pixels(width, height, max_pixels)
    parts = (zip(fields.get(begin, ()), fields.get(length, ()), strict=False) for begin, length in _TIFF_PARTS)
    ends = [begin + length for part in parts for begin, length in part]
    if not ends:
        _raise_damaged("it has no picture")
    if max(ends) > len(body):
        raise_truncated()
    return body, n_pixels, 1, max(fields.get(_TIFF_BITS, ()), default=1)


def _tiff_fields(body: bytes) -> dict[int, tuple[int, ...]]:
    """The fields we look at in the first directory of a TIFF.

    Byte order, offset of the directory, which holds (tag, type, count, value or its offset); in a BigTIFF numbers and
    offsets have 8 bytes.
    """
    order = "<" if body.startswith(b"II") else ">"
    (version,) = _unpack(order + "H", body, 2)
    is_big = version == 43
    number, n_value_bytes = ("Q", 8) if is_big else ("I", 4)
    (directory,) = _unpack(order + number, body, 8 if is_big else 4)
    n_form = order + ("Q" if is_big else "H")
    (n_fields,) = _unpack(n_form, body, directory)
    first, entry_bytes = directory + struct.calcsize(n_form), 4 + 2 * n_value_bytes
    if n_fields > _MAX_PARTS:
        _raise_damaged(f"it has more than {_MAX_PARTS} parts")
    fields: dict[int, tuple[int, ...]] = {}
    for entry in range(first, first + entry_bytes * n_fields, entry_bytes):
        tag, kind, count, offset = _unpack(f"{order}HH{number}{number}", body, entry)
        size = count * _TIFF_FIELD_BYTES.get(kind, 0)
        if size > n_value_bytes and offset + size > len(body):
            raise_truncated()
        if tag in _TIFF_TAGS and tag not in fields and kind in _TIFF_FORMATS:
            if count > _MAX_PARTS:
                _raise_damaged(f"it has more than {_MAX_PARTS} parts")
            start = offset if size > n_value_bytes else entry + 4 + n_value_bytes
            fields[tag] = _unpack(f"{order}{count}{_TIFF_FORMATS[kind]}", body, start)
    return fields


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
        raise_truncated()
    return body, n_pixels


_FORMATS: Mapping[str, tuple[bytes, Callable[[bytes, int], tuple[Any, ...]]]] = {
    JPEG: (rb"\xff\xd8\xff", _jpeg),
    PNG: (_PNG_SIGNATURE, _png),
    TIFF: (rb"II[*+]\0|MM\0[*+]", _tiff),
    WEBP: (rb"RIFF....WEBP", _webp),
}
MEDIA_TYPES = tuple(_FORMATS)
