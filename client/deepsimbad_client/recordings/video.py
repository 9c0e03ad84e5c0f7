"""Video files: frames by number, at the times that the file gives them, placed by a table or a track beside them.

`drive.mp4` takes its positions from `drive.csv` (the columns of `positions.csv`: a line a frame, an `index`, or times
with x_m, y_m, which begin with the video where they count from 1970), from `drive.gpx` or `drive.nmea`; without one
frames are evenly spaced.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings import EncodedImage, Frame, Image, Recording, as_png, stamp_of, turned
from deepsimbad_client.recordings.gps import TRACK_SUFFIXES, read_track
from deepsimbad_client.recordings.placing import Placed, placed, placed_on
from deepsimbad_client.recordings.positions import read_positions

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv"})
MOST_HZ, USUAL_HZ = 1000.0, 30.0  # a rate beyond the one says nothing; the other stands for it
N_PROBED = 64  # frames whose times tell whether all come at one rate
N_KEPT = 32  # decoded frames, for several threads ask for neighbours in any order


class _Decoder:
    """Decodes frames by number: forwards fast, backwards from the beginning, which alone is exact in every format."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._turn = threading.Lock()
        self._capture: cv2.VideoCapture | None = None
        self._next = 0
        self._kept: OrderedDict[int, Image] = OrderedDict()

    def frame(self, number: int, wanted: frozenset[int]) -> Image:
        """One frame; those of `wanted` that are passed on the way are kept. Raises BrokenFrameError."""
        with self._turn:
            if number not in self._kept:
                self._read_to(number, wanted)
            if number not in self._kept:
                raise BrokenFrameError(f"{self._path} has no frame {number} that can be decoded", "undecodable")
            return self._kept[number]

    def _read_to(self, number: int, wanted: frozenset[int]) -> None:
        if self._capture is None or number < self._next:
            self._capture, self._next = cv2.VideoCapture(str(self._path)), 0
        while self._next <= number and self._capture.grab():
            if self._next in wanted:
                decoded, image = self._capture.retrieve()
                if decoded:
                    self._kept[self._next] = np.asarray(image, dtype=np.uint8)
                if len(self._kept) > N_KEPT:
                    self._kept.popitem(last=False)
            self._next += 1


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoRecording(Recording):
    """Frames of a video."""

    path: Path
    rotate: int = 0  # degrees clockwise by which images are turned
    decoder: _Decoder = field(repr=False)

    def stamp(self, frame: Frame) -> str:
        """Of its file and number; see `Recording.stamp`."""
        return f"{stamp_of(self.path)} {frame.name}"

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Decode a frame, as PNG; see `Recording.image`."""
        return as_png(turned(self.decoder.frame(_number(frame), self._wanted), self.rotate), input_size)

    @cached_property
    def _wanted(self) -> frozenset[int]:
        return frozenset(map(_number, self.frames))


def _number(frame: Frame) -> int:
    return int(frame.name.rpartition("/")[2])


def _times_us(path: Path, on_progress: Callable[[float], None]) -> tuple[list[int], int]:
    """When each frame is shown, from the first, none where it cannot be decoded; and how many the file says it has.

    Of a file whose first frames come at its rate, all do; others are gone through.
    """
    capture = cv2.VideoCapture(str(path))
    n_said, rate_hz = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
    step_us = 1e6 / (rate_hz if 0 < rate_hz < MOST_HZ else USUAL_HZ)
    shown: list[int] = []
    while len(shown) < min(n_said, N_PROBED) and capture.grab():
        shown.append(round(1000 * capture.get(cv2.CAP_PROP_POS_MSEC)))
    late_us = np.abs(np.array(shown) - step_us * np.arange(len(shown)))
    if shown and late_us.max() < step_us / 2:
        return [round(number * step_us) for number in range(n_said)], n_said
    while capture.grab():
        shown.append(round(1000 * capture.get(cv2.CAP_PROP_POS_MSEC)))
        on_progress(min(1.0, len(shown) / max(1, n_said)))
    if any(before >= after for before, after in pairwise(shown)):
        shown = [round(number * step_us) for number in range(len(shown))]
    return shown, n_said


def _beside(path: Path, suffixes: Collection[str]) -> Path | None:
    """The file of the video's name with another ending, in any letter case."""
    stem = path.stem.lower()
    files = (file for file in sorted(path.parent.iterdir()) if file.stem.lower() == stem and file.is_file())
    return next((file for file in files if file.suffix.lower() in suffixes), None)


def read_video(
    path: Path,
    spacing_m: float,
    rotate: int = 0,
    time_offset_us: int = 0,
    on_progress: Callable[[float], None] = lambda _: None,
) -> VideoRecording:
    """Open a video; raises SourceError (it cannot be decoded, or what lies beside it does not place its frames)."""
    shown_us, n_said = _times_us(path, on_progress)
    times_us = [time + time_offset_us for time in shown_us]
    if not times_us:
        raise SourceError(f"{path} is no video that OpenCV can decode: convert it, for example to H.264 in an .mp4")
    n_frames = len(times_us)
    names = [f"{path.name}/{number:06d}" for number in range(n_frames)]
    table, track = _beside(path, {".csv"}), _beside(path, TRACK_SUFFIXES)
    if table is not None:
        result = read_positions(table, names, times_us)
        result.follow(placed(result.frames, str(table), result.deadband_m))
    elif track is not None:
        images = list(zip(names, times_us, strict=True))
        result = placed_on(read_track(track), images, str(track), "the track", together=True)
    else:
        result = Placed(
            [
                Frame(number, name, number * spacing_m, time_us)
                for number, (name, time_us) in enumerate(zip(names, times_us, strict=True))
            ]
        )
        lasting = f"{n_frames} frames of {shown_us[-1] / 1e6:.1f} s are taken {spacing_m:g} m apart"
        result.remarks.append(
            f"{lasting}: --every-s takes fewer, {path.stem}.csv (or .gpx, .nmea) beside the video says where they are"
        )
    if n_frames < n_said:
        result.remarks.append(f"the file says that it has {n_said} frames, and {n_frames} can be decoded")
    return VideoRecording(
        path.stem,
        tuple(result.frames),
        result.left_out_names,
        remarks=result.remarks,
        path=path,
        rotate=rotate,
        decoder=_Decoder(path),
    )
