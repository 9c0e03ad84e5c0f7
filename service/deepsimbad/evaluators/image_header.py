"""What an image file's header claims, and whether the file is all there, before a decoder sees it.

Decoders allocate what a header asks for, and some half decode a truncated file without a word, so both questions
are answered here from the bytes alone: `read_size` looks at the header, `check_whole` walks the containers, and
`picture_alone` leaves away what a decoder needs not see.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import NoReturn

from deepsimbad.errors import InvalidImageError, TruncatedImageError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Start-of-frame markers: C0..CF without DHT (C4), JPG (C8) and DAC (CC).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_JPEG_END, _JPEG_SCAN = 0xD9, 0xDA
# In entropy-coded data FF 00 is a stuffed FF and FF D0..D7 a restart; any other FF xx ends the scan.
_JPEG_SCAN_END = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_JPEG_MARKER = re.compile(rb"[^\xff]", re.DOTALL)
_JPEG_MAX_SCANS = 200  # a progressive file uses about ten; thousands of empty ones are an attack on the decoder
_JPEG_MAX_SCANNED = 2_000_000_000  # pixels of all scans together: each costs the decoder a pass over the picture
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_PNG_PICTURE = frozenset({b"IHDR", b"PLTE", b"tRNS", b"eXIf", b"IDAT", b"IEND"})
_PNG_UNPACKED = 1 << 18  # bytes of picture data: what is packed in less keeps a decoder for a quarter of a second
_MAX_PARTS = 100_000  # chunks, segments, strips: a real file has far fewer, walking millions costs seconds
_TIFF_FIELD_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_TIFF_FORMATS = {1: "B", 3: "H", 4: "I", 13: "I"}  # the integer field types: BYTE, SHORT, LONG, IFD
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SAMPLES, _TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 256, 257, 277, 322, 323
_TIFF_PARTS = ((273, 279), (324, 325))  # offsets and byte counts of strips, of tiles
_TIFF_MAX_SAMPLES = 5  # CMYK and alpha
_TIFF_TAGS = frozenset({256, 257, 273, 277, 279, 322, 323, 324, 325})


def media_type(body: bytes) -> str:
    """The media type the first bytes speak of, whatever the sender called it.

    Raises:
        InvalidImageError: None of those we decode.
    """
    if body.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    if body.startswith(_PNG_SIGNATURE):
        return "image/png"
    if body[:4] in (b"II*\x00", b"MM\x00*"):
        return "image/tiff"
    if body[:4] == b"RIFF" and body[8:12] == b"WEBP":
        return "image/webp"
    raise InvalidImageError("this is not a JPEG, PNG, TIFF or WebP image", allowed=list(_READERS))


def read_size(body: bytes) -> tuple[int, int]:
    """(width, height) in pixels of the largest surface the header makes a decoder allocate.

    Raises:
        InvalidImageError: No such image, or a header that contradicts itself.
        TruncatedImageError: The end of the header is missing.
    """
    kind = media_type(body)
    width, height = _READERS[kind][0](body)
    if width < 1 or height < 1:
        raise InvalidImageError(f"the {kind} header claims {width} x {height} pixels")
    return width, height


def check_whole(body: bytes) -> None:
    """Refuse a file whose end is missing.

    Raises:
        TruncatedImageError: The end is missing.
        InvalidImageError: The containers contradict themselves.
    """
    _READERS[media_type(body)][1](body)


def picture_alone(body: bytes) -> bytes:
    """A file without what tells nothing of its picture.

    Of a PNG file, texts, colour profiles and further frames: its decoder unpacks them, and complains of damaged ones
    on standard error. Other files are given back as they are.

    Args:
        body: A file that `check_whole` has passed.
    """
    if media_type(body) != "image/png":
        return body
    chunks = [body[start:end] for name, start, end in _png_chunks(body) if name in _PNG_PICTURE]
    return b"".join([_PNG_SIGNATURE, *chunks])


def _truncated(kind: str) -> NoReturn:
    raise TruncatedImageError(f"the {kind} file ends too early: its end is missing")


def _too_many_parts(kind: str) -> NoReturn:
    raise InvalidImageError(f"the {kind} file has more than {_MAX_PARTS} parts")


def _unpack(form: str, body: bytes, offset: int, kind: str) -> tuple[int, ...]:
    if offset + struct.calcsize(form) > len(body):
        _truncated(kind)
    return struct.unpack_from(form, body, offset)


# PNG: signature, then chunks of (length, name, content, checksum); IHDR first, IEND last.
def _png_size(body: bytes) -> tuple[int, int]:
    length, name, width, height = _unpack(">I4sII", body, len(_PNG_SIGNATURE), "PNG")
    if name != b"IHDR" or length != 13:  # type: ignore[comparison-overlap]  # `4s` unpacks to bytes
        raise InvalidImageError("the PNG file does not begin with its header")
    return width, height


def _png_chunks(body: bytes) -> Iterator[tuple[bytes, int, int]]:
    """(name, start, end) of the chunks up to IEND; length and checksum are in between."""
    at = len(_PNG_SIGNATURE)
    for _ in range(_MAX_PARTS):
        (length,) = _unpack(">I", body, at, "PNG")
        name, end = body[at + 4 : at + 8], at + 12 + length
        yield name, at, end
        if name == b"IEND":
            return
        at = end
    _too_many_parts("PNG")


def _png_whole(body: bytes) -> None:
    packed = []
    for name, start, end in _png_chunks(body):
        (checksum,) = _unpack(">I", body, end - 4, "PNG")
        if zlib.crc32(memoryview(body)[start + 4 : end - 4]) != checksum:
            raise InvalidImageError("the PNG file is damaged: a checksum does not fit")
        if name == b"IDAT":
            packed.append(memoryview(body)[start + 8 : end - 4])
    _check_png_unpacks(body, packed)


def _check_png_unpacks(body: bytes, packed: list[memoryview]) -> None:
    """Refuse picture data that unpack to far more than the header's pixels: a decoder would unpack it all."""
    if sum(map(len, packed)) <= _PNG_UNPACKED:
        return
    width, height, bits, colour = _unpack(">IIBB", body, len(_PNG_SIGNATURE) + 8, "PNG")
    # Twice, for interlacing adds a little.
    most = 2 * height * (1 + width * bits * _PNG_CHANNELS.get(colour, 4) // 8) + (1 << 16)
    unpacker, n_bytes = zlib.decompressobj(), 0
    try:
        for piece in packed:
            rest: bytes | memoryview = piece
            while len(rest) > 0 and not unpacker.eof:
                n_bytes += len(unpacker.decompress(rest, 1 << 20))
                rest = unpacker.unconsumed_tail
                if n_bytes > most:
                    raise InvalidImageError("the PNG file unpacks to more than the pixels that its header claims")
    except zlib.error as error:
        raise InvalidImageError("the PNG file is damaged: its picture cannot be unpacked") from error


# JPEG: segments of (FF, marker, length, content); after SOS, entropy-coded data to the next marker; EOI last.
def _jpeg_segments(body: bytes) -> Iterator[tuple[int, int]]:
    """(marker, offset of its content), up to the end-of-image marker."""
    at = 2
    for _ in range(_MAX_PARTS):
        if at < len(body) and body[at] != 0xFF:
            raise InvalidImageError("the JPEG file is damaged: no marker where one must be")
        found = _JPEG_MARKER.search(body, at)  # fill bytes before a marker are allowed
        if found is None:
            _truncated("JPEG")
        marker, at = body[found.start()], found.end()
        if marker in _JPEG_BARE:
            continue
        if marker == _JPEG_END:
            return
        (length,) = _unpack(">H", body, at, "JPEG")
        if length < 2:
            raise InvalidImageError("the JPEG file is damaged: a segment shorter than its own length")
        yield marker, at + 2
        at += length
        if marker == _JPEG_SCAN:
            end = _JPEG_SCAN_END.search(body, at)
            if end is None:
                _truncated("JPEG")
            at = end.start()
    _too_many_parts("JPEG")


def _jpeg_size(body: bytes) -> tuple[int, int]:
    for marker, at in _jpeg_segments(body):
        if marker in _JPEG_FRAMES:
            _, height, width = _unpack(">BHH", body, at, "JPEG")
            return width, height
    raise InvalidImageError("the JPEG file has no frame header")


def _jpeg_whole(body: bytes) -> None:
    frames = scans = n_pixels = 0
    for marker, at in _jpeg_segments(body):
        if marker in _JPEG_FRAMES:
            frames += 1
            _, height, width = _unpack(">BHH", body, at, "JPEG")
            n_pixels = height * width
        scans += marker == _JPEG_SCAN
        if frames > 1 or scans > _JPEG_MAX_SCANS or scans * n_pixels > _JPEG_MAX_SCANNED:
            raise InvalidImageError(f"the JPEG file has {frames} frames and {scans} scans")
    if scans == 0:
        raise InvalidImageError("the JPEG file has no picture in it")


# TIFF: byte order, offset of the first directory; a directory holds (tag, type, count, value or its offset).
def _tiff_directory(body: bytes) -> dict[int, tuple[int, ...]]:
    """The fields we need of the first directory, the one that is decoded."""
    order = "<" if body.startswith(b"II") else ">"
    (at,) = _unpack(order + "I", body, 4, "TIFF")
    (n_fields,) = _unpack(order + "H", body, at, "TIFF")
    fields: dict[int, tuple[int, ...]] = {}
    for entry in range(at + 2, at + 2 + 12 * n_fields, 12):
        tag, kind, count, offset = _unpack(order + "HHII", body, entry, "TIFF")
        size = count * _TIFF_FIELD_BYTES.get(kind, 0)
        if size > 4 and offset + size > len(body):
            _truncated("TIFF")
        if tag in _TIFF_TAGS and tag not in fields and kind in _TIFF_FORMATS:
            if count > _MAX_PARTS:
                _too_many_parts("TIFF")
            form = f"{order}{count}{_TIFF_FORMATS[kind]}"
            fields[tag] = _unpack(form, body, offset if size > 4 else entry + 8, "TIFF")
    return fields


def _tiff_size(body: bytes) -> tuple[int, int]:
    fields = _tiff_directory(body)
    width, height, samples, tile_width, tile_height = (
        max(fields.get(tag, ()), default=default)
        for tag, default in (
            (_TIFF_WIDTH, 0),
            (_TIFF_HEIGHT, 0),
            (_TIFF_SAMPLES, 1),
            (_TIFF_TILE_WIDTH, 0),
            (_TIFF_TILE_HEIGHT, 0),
        )
    )
    if samples > _TIFF_MAX_SAMPLES:
        raise InvalidImageError(f"the TIFF header claims {samples} channels")
    if width * height == 0 or tile_width * tile_height <= width * height:
        return width, height
    return tile_width, tile_height


def _tiff_whole(body: bytes) -> None:
    fields = _tiff_directory(body)
    n_parts = 0
    for offsets, counts in _TIFF_PARTS:
        for offset, count in zip(fields.get(offsets, ()), fields.get(counts, ()), strict=False):
            n_parts += 1
            if offset + count > len(body):
                _truncated("TIFF")
    if n_parts == 0:
        raise InvalidImageError("the TIFF file has no picture in it")


# WebP: RIFF, size, WEBP, then chunks of (name, length, content, padding to even).
def _webp_chunks(body: bytes) -> Iterator[tuple[bytes, int]]:
    """(name, offset of its content) of the top-level chunks that begin inside the file."""
    (riff_length,) = _unpack("<I", body, 4, "WebP")
    at, end = 12, min(8 + riff_length, len(body))
    for _ in range(_MAX_PARTS):
        if at + 8 > end:
            return
        (length,) = _unpack("<I", body, at + 4, "WebP")
        yield body[at : at + 4], at + 8
        at += 8 + length + length % 2
    _too_many_parts("WebP")


def _webp_size(body: bytes) -> tuple[int, int]:
    sizes = [(0, 0)]
    for name, at in _webp_chunks(body):
        if name == b"VP8 ":
            width, height = _unpack("<HH", body, at + 6, "WebP")
            sizes.append((width & 0x3FFF, height & 0x3FFF))
        elif name == b"VP8L":
            (bits,) = _unpack("<I", body, at + 1, "WebP")
            sizes.append(((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1))
        elif name == b"VP8X":
            low_w, high_w, low_h, high_h = _unpack("<HBHB", body, at + 4, "WebP")
            sizes.append(((high_w << 16 | low_w) + 1, (high_h << 16 | low_h) + 1))
    return max(sizes, key=lambda size: size[0] * size[1])


def _webp_whole(body: bytes) -> None:
    (riff_length,) = _unpack("<I", body, 4, "WebP")
    if 8 + riff_length > len(body):
        _truncated("WebP")


_READERS: Mapping[str, tuple[Callable[[bytes], tuple[int, int]], Callable[[bytes], None]]] = {
    "image/jpeg": (_jpeg_size, _jpeg_whole),
    "image/png": (_png_size, _png_whole),
    "image/tiff": (_tiff_size, _tiff_whole),
    "image/webp": (_webp_size, _webp_whole),
}
MEDIA_TYPES = tuple(_READERS)
