"""Recordings as they lie on disk: what every reader returns and leaves out, and how images are made ready to post."""

import dataclasses
import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pictures

from deepsimbad.core.frames import UNKNOWN_TIMESTAMP
from deepsimbad.errors import DeepSimbadError
from deepsimbad.evaluators.grey_levels import GreyLevels, in_eight_bits, measured_levels
from deepsimbad.evaluators.image import decode_deep as decode_file
from deepsimbad.evaluators.image import resized
from deepsimbad.evaluators.image_files import ImageFile
from deepsimbad_client.errors import BrokenFrameError, MissingExtraError, SourceError, TooManyLeftOutError
from deepsimbad_client.http import media_type_of, text_of

Image = NDArray[np.uint8]  # [height, width, 3] BGR

HEIC_SUFFIXES = frozenset({".heic", ".heif"})  # as telephones write them; read by an optional library
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm"}) | HEIC_SUFFIXES
TURNS = {0: None, 90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
OTHER_SUFFIXES = frozenset(
    {".gif", ".jp2", ".j2k", ".avif", ".jxl", ".exr", ".hdr", ".tga", ".pbm", ".raw", ".dng", ".cr2", ".nef", ".arw"}
)
"""The suffixes of images that are not read."""

MOST_LEFT_OUT = 0.05  # of a recording's frames; more are accepted only where the caller says so
NO_IMAGE = " without an image"  # of lines "in positions.csv", beside images "not in positions.csv"

_N_PROBES, _N_SURE = 16, 3  # images that stand for all; if the first so many have 8 bits, all are taken to
_MAX_PIXELS = 1 << 30  # the picture is the caller's own


@dataclass(frozen=True, slots=True)
class Frame:
    """One moment of a recording; None where unknown."""

    index: int  # place in the whole recording, from 0; kept when the recording is sliced
    name: str  # as read, path-like: the file's name, or the row's for ready encodings
    position_m: float  # along the route
    timestamp_us: int | None = None  # Unix microseconds
    x_m: float | None = None  # first ground coordinate (NCLT: north)
    y_m: float | None = None  # second ground coordinate (NCLT: east)
    heading_rad: float | None = None  # in (-pi, pi], turning from x towards y

    @property
    def stored_name(self) -> str:
        """The name as traverses and maps hold it."""
        return text_of(self.name)


def columns_of(frames: Sequence[Frame]) -> dict[str, Any]:
    """The frames' columns, arrays [n] as a traverse has them: an unknown time is -1, an unknown coordinate NaN."""
    times_us = [UNKNOWN_TIMESTAMP if frame.timestamp_us is None else frame.timestamp_us for frame in frames]
    return {
        "index": np.array([frame.index for frame in frames], np.int64),
        "position_m": np.array([frame.position_m for frame in frames], np.float64),
        "timestamp_us": np.array(times_us, np.int64),
        "x_m": np.array([frame.x_m for frame in frames], np.float64),  # None becomes NaN
        "y_m": np.array([frame.y_m for frame in frames], np.float64),
    }


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image ready to be posted, with its media type."""

    body: bytes
    content_type: str


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames in travel order, with either ready encodings or, in the readers' own classes, images."""

    name: str  # short, for people: the date, the folder or the file
    frames: Sequence[Frame]  # those that can be used
    left_out_names: Mapping[str, Sequence[str]] = field(default_factory=dict)  # reason -> frames not in `frames`
    encodings: NDArray[np.float32] | None = None  # [n, d], row i of frame i; None where the frames are images
    remarks: Sequence[str] = ()  # on how the reader understood the recording, where that is not plain
    grey_levels: GreyLevels | None = None  # by which images of more than 8 bits are shown; None: by each one's own
    n_before_slice: int | None = None  # number of frames before some were chosen; None: these are all
    camera: str | None = None  # name of the camera that took the images
    folder: Path | None = None  # of the frames' files, where each has its own
    full_recording: "Recording | None" = None  # of whose frames these are a slice; None: these are all
    tolerance_m: float | None = None  # within which papers on this set count a match as true; None: no known set

    @property
    def left_out(self) -> dict[str, int]:
        """The number of frames left out, by reason."""
        return counts_of(self.left_out_names)

    @property
    def n_whole(self) -> int:
        """The number of usable frames before any slice or thinning."""
        return len(self.frames) if self.n_before_slice is None else self.n_before_slice

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:  # noqa: ARG002
        """Read one frame's image, ready to post; one larger than `input_size` (width, height) may be resized to it.

        Whichever is sent, the service encodes the same pixels.

        Raises BrokenFrameError (this file cannot be used; the others can), SourceError (there are no images at all).
        """
        raise SourceError(f"{self.name} holds ready encodings, not images")

    def shown_by(self, levels: GreyLevels | None) -> Self:
        """The recording shown by the grey levels of the traverse or the map that it goes to; None: by its own."""
        if levels is None:
            return self
        full_recording = None if self.full_recording is None else self.full_recording.shown_by(levels)
        return dataclasses.replace(self, grey_levels=levels, full_recording=full_recording)

    def stamp(self, frame: Frame) -> str:
        """A text that changes when a frame's image does: its name, and of a file its size and time."""
        return frame.name if self.folder is None else stamp_of(self.folder / frame.name)

    def view(self, row: int, input_size: tuple[int, int] | None) -> dict[str, Any]:
        """The view of `frames[row]` as arguments of a client's calls; raises as `image` does."""
        if self.encodings is not None:
            return {"encoding": self.encodings[row]}
        image = self.image(self.frames[row], input_size)
        return {"image": image.body, "content_type": image.content_type}

    def sliced(self, part: slice) -> Self:
        """Python's slice of the frames, which keep their indices and positions; what was left out stays counted.

        Raises SourceError (the slice leaves nothing, or its step is 0).
        """
        if part.step == 0:
            raise SourceError(f"the slice of {self.name} has step 0: use 1 for every frame")
        frames = self.frames[part]
        if not frames:
            ends = [part.start, part.stop] + ([] if part.step is None else [part.step])
            text = "#" + ":".join("" if end is None else str(end) for end in ends)
            raise SourceError(f"the slice {text} leaves none of the {len(self.frames)} frames of {self.name}")
        encodings = None if self.encodings is None else self.encodings[part]
        full_recording = self.full_recording or self
        return dataclasses.replace(
            self, frames=frames, encodings=encodings, n_before_slice=self.n_whole, full_recording=full_recording
        )


AnyRecording = TypeVar("AnyRecording", bound=Recording)


def counts_of(names: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """The number of names for each reason."""
    return {reason: len(frames) for reason, frames in names.items()}


def finite_number(text: str) -> float | None:
    """The number in a cell of a table; None if it is no finite number."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def stamp_of(path: Path) -> str:
    """A file's name, size and time; its name alone where it does not exist."""
    try:
        status = path.stat()
    except OSError:
        return path.name
    return f"{path.name} {status.st_size} {status.st_mtime_ns}"


def read_file(path: Path) -> bytes:
    """Read a frame's file. Raises BrokenFrameError (it is missing, unreadable or empty)."""
    try:
        body = path.read_bytes()
    except OSError as error:
        raise BrokenFrameError(f"cannot read {path}: {error.strerror or error}", "unreadable file") from error
    if not body:
        raise BrokenFrameError(f"{path} is empty", "empty file")
    return body


def decode(body: bytes, path: Path, *, as_stored: bool = False, levels: GreyLevels | None = None) -> Image:
    """Decode an image to 8-bit BGR as the service does (`deepsimbad.evaluators.image`).

    Formats that the service does not take (BMP, PGM, PPM) are decoded too. `as_stored` leaves pixels as they lie in the
    file, `levels` show more than 8 bits. Raises BrokenFrameError (not an image, damaged, or its end is missing).
    """
    return in_eight_bits(decode_deep(body, path, as_stored=as_stored), levels)[0]


def decode_deep(body: bytes, path: Path, *, as_stored: bool = True) -> NDArray[Any]:
    """Decode an image as `decode` does, but one of 9 to 16 bits as uint16 with all of them."""
    try:
        if media_type_of(body) is not None:
            return decode_file(ImageFile.read(body, _MAX_PIXELS), as_stored=as_stored)
        if path.suffix.lower() in HEIC_SUFFIXES:
            require_heic()
            with Pictures.open(BytesIO(body)) as picture:
                return np.ascontiguousarray(np.asarray(picture.convert("RGB"), dtype=np.uint8)[:, :, ::-1])
        image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR_BGR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    except (DeepSimbadError, OSError, ValueError) as error:
        raise BrokenFrameError(f"{path} cannot be read: {error}", "undecodable") from error
    if image is None or image.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise BrokenFrameError(f"{path} is not an image that can be decoded", "undecodable")
    return np.asarray(image)


def require_heic() -> None:
    """Make Pillow open HEIC files from now on; raises MissingExtraError where the library is not installed."""
    try:
        from pillow_heif import register_heif_opener  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtraError(
            "HEIC images need pillow-heif: pip install 'deep-simbad[heic]', or convert them to JPEG"
        ) from error
    register_heif_opener()


def spread(n: int) -> list[int]:
    """A few of the indices 0..n-1, evenly from the first to the last."""
    return [round(place) for place in np.linspace(0, max(0, n - 1), min(n, _N_PROBES)).tolist()]


def with_grey_levels(recording: AnyRecording, image: Callable[[int], NDArray[Any]]) -> AnyRecording:
    """The recording with the grey levels that suit its images, and a remark, where these have more than 8 bits.

    They are measured on a few images spread over it; `image` returns one by its row, as `decode_deep` does.
    """
    pictures: list[NDArray[np.uint16]] = []
    for number, place in enumerate(spread(len(recording.frames))):
        if number == _N_SURE and not pictures:
            return recording
        try:
            picture = image(place)
        except BrokenFrameError:
            continue
        pictures += [picture] if picture.dtype == np.uint16 else []
    if not pictures:
        return recording
    levels = measured_levels(pictures)
    remark = f"images of more than 8 bits are shown as 8: {levels[0]} is black, {levels[1]} white"
    return dataclasses.replace(recording, grey_levels=levels, remarks=[*recording.remarks, remark])


def turned(image: Image, degrees: int) -> Image:
    """Turn an image clockwise by a multiple of 90 degrees."""
    turn = TURNS[degrees]
    return image if turn is None else np.asarray(cv2.rotate(image, turn), dtype=np.uint8)


def ready(
    body: bytes, path: Path, input_size: tuple[int, int] | None, rotate: int, levels: GreyLevels | None = None
) -> EncodedImage:
    """An image file's body made ready to post: as it is, or as the image at `input_size` where that takes fewer bytes.

    An image that is to be turned or shown by levels, or of a format that cannot be posted, becomes a PNG. Raises
    BrokenFrameError.
    """
    image, media_type = decode(body, path, levels=levels), media_type_of(body)
    if media_type is None or rotate or levels is not None:
        return as_png(turned(image, rotate), input_size)
    original = EncodedImage(body, media_type)
    if not is_larger(image, input_size):
        return original
    return min(as_png(image, input_size), original, key=lambda encoded: len(encoded.body))


def is_larger(image: Image, input_size: tuple[int, int] | None) -> bool:
    """Whether an image is wider or higher than (width, height)."""
    return input_size is not None and (image.shape[1] > input_size[0] or image.shape[0] > input_size[1])


def as_png(image: Image, input_size: tuple[int, int] | None) -> EncodedImage:
    """Make an image ready to post as PNG, from which the service gets the same pixels as from the whole picture.

    A larger image is resized to exactly `input_size` by the rule of the service's evaluators.
    """
    height, width = image.shape[:2]
    if input_size is not None and is_larger(image, input_size):
        image = resized(image, input_size)
    body = cv2.imencode(".png", image)[1].tobytes()
    return EncodedImage(body if image.shape[:2] == (height, width) else _with_shape(width, height, body), "image/png")


def _with_shape(width: int, height: int, png: bytes) -> bytes:
    """The PNG with the shape of its pixels (chunk pHYs, of no unit) such that it shows a width x height picture."""
    own_width, own_height = struct.unpack_from(">II", png, 16)
    shape = Fraction(own_width * height, own_height * width)
    chunk = b"pHYs" + struct.pack(">IIB", shape.numerator, shape.denominator, 0)
    return png[:33] + struct.pack(">I", 9) + chunk + struct.pack(">I", zlib.crc32(chunk)) + png[33:]


class LeftOut:
    """The frames that are not used: by reason the `names` of those a reader left out and of those that broke later."""

    def __init__(self, recording: Recording, *, allow_missing: bool) -> None:
        """Begin with the frames that the reader left out; raises as `add`."""
        self.names = {reason: list(names) for reason, names in recording.left_out_names.items()}
        self._recording, self._allow_missing = recording, allow_missing
        n_by_reader = sum(map(len, self.names.values())) - _n_misspelt(self.names)
        self._share = n_by_reader / max(1, recording.n_whole + n_by_reader)
        self._check()

    def add(self, reason: str, name: str) -> None:
        """Count one more broken frame; raises TooManyLeftOutError (more than a twentieth is left out)."""
        self.names.setdefault(reason, []).append(name)
        self._share += 1 / len(self._recording.frames)
        self._check()

    def _check(self) -> None:
        if self._allow_missing or self._share <= MOST_LEFT_OUT + 1e-9:
            return
        reasons = "; ".join(f"{len(names)} {reason} ({first_names(names)})" for reason, names in self.names.items())
        raise TooManyLeftOutError(
            f"{self._share:.0%} of the frames of {self._recording.name} are left out: {reasons}; more than "
            f"{MOST_LEFT_OUT:.0%} need --allow-missing"
        )


def _n_misspelt(names: Mapping[str, Sequence[str]]) -> int:
    """How many images missing from a table may be meant by its lines that name no image."""
    return sum(
        min(len(lines), len(names.get(f"not {reason.removesuffix(NO_IMAGE)}", ())))
        for reason, lines in names.items()
        if reason.endswith(NO_IMAGE)
    )


def left_out_lines(names: Mapping[str, Sequence[str]], *, verbose: bool) -> list[str]:
    """A line for each reason why frames are left out, with all of their names or the first of them."""
    return [
        f"left out: {len(frames)} {reason} ({first_names(frames, len(frames) if verbose else 3)})"
        for reason, frames in names.items()
    ]


def first_names(names: Sequence[str], n_shown: int = 3) -> str:
    """The first names in words, with "..." for more."""
    return ", ".join(names[:n_shown]) + (", ..." if len(names) > n_shown else "")
