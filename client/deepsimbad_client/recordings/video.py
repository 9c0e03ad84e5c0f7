"""Video files: frames by number, at the times that the file gives them, placed by a table or a track beside them.

`drive.mp4` takes its positions from `drive.csv` (the columns of `positions.csv`: a line for each frame, an `index`, or
times with x_m, y_m, which begin with the video where they count from 1970), from `drive.gpx` or `drive.nmea`; without
one of these frames are evenly spaced.
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
from deepsimbad_client.recordings.placing import Placement, place_frames, place_on_track
from deepsimbad_client.recordings.positions import read_positions

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv"})
MOST_HZ, USUAL_HZ = 1000.0, 30.0  # a file's rate beyond the first is meaningless, and the second taken instead
N_PROBED = 64  # frames whose times show whether all come at one rate
N_KEPT = 32  # decoded frames, since several threads ask for neighbours in any order


class _Decoder:
    """Decodes frames by number: forwards fast, backwards from the beginning, which alone is exact in every format."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._capture: cv2.VideoCapture | None = None
        self._next = 0
        self._images: OrderedDict[int, Image] = OrderedDict()

    def frame(self, number: int, frame_numbers: frozenset[int]) -> Image:
        """Decode one frame, and keep those of `frame_numbers` passed on the way; raises BrokenFrameError."""
        with self._lock:
            if number not in self._images:
                self._read_to(number, frame_numbers)
            if number not in self._images:
                raise BrokenFrameError(f"{self._path} has no frame {number} that can be decoded", "undecodable")
            return self._images[number]

    def _read_to(self, number: int, frame_numbers: frozenset[int]) -> None:
        if self._capture is None or number < self._next:
            self._capture, self._next = cv2.VideoCapture(str(self._path)), 0
        while self._next <= number and self._capture.grab():
            if self._next in frame_numbers:
                is_decoded, image = self._capture.retrieve()
                if is_decoded:
                    self._images[self._next] = np.asarray(image, dtype=np.uint8)
                if len(self._images) > N_KEPT:
                    self._images.popitem(last=False)
            self._next += 1


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoRecording(Recording):
    """Frames of a video."""

    path: Path
    rotate: int = 0  # degrees clockwise by which images are turned
    decoder: _Decoder = field(repr=False)

    def stamp(self, frame: Frame) -> str:
        """The stamp of the video and the frame's number; see `Recording.stamp`."""
        return f"{stamp_of(self.path)} {frame.name}"

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Decode a frame, as PNG; see `Recording.image`."""
        return as_png(turned(self.decoder.frame(_number(frame), self._frame_numbers), self.rotate), input_size)

    @cached_property
    def _frame_numbers(self) -> frozenset[int]:
        return frozenset(map(_number, self.frames))


def _number(frame: Frame) -> int:
    return int(frame.name.rpartition("/")[2])


def _times_us(path: Path, on_progress: Callable[[float], None]) -> tuple[list[int], int]:
    """The times of all frames from the first, empty if none can be decoded, and how many the file says it has.

    If the first frames come at the file's rate, all are taken to; otherwise the whole file is read.
    """
    capture = cv2.VideoCapture(str(path))
    n_declared, rate_hz = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
    step_us = 1e6 / (rate_hz if 0 < rate_hz < MOST_HZ else USUAL_HZ)
    times_us: list[int] = []
    while len(times_us) < min(n_declared, N_PROBED) and capture.grab():
        times_us.append(round(1000 * capture.get(cv2.CAP_PROP_POS_MSEC)))
    late_us = np.abs(np.array(times_us) - step_us * np.arange(len(times_us)))
    if times_us and late_us.max() < step_us / 2:
        return [round(number * step_us) for number in range(n_declared)], n_declared
    while capture.grab():
        times_us.append(round(1000 * capture.get(cv2.CAP_PROP_POS_MSEC)))
        on_progress(min(1.0, len(times_us) / max(1, n_declared)))
    if any(left >= right for left, right in pairwise(times_us)):
        times_us = [round(number * step_us) for number in range(len(times_us))]
    return times_us, n_declared


def _companion(path: Path, suffixes: Collection[str]) -> Path | None:
    """The file of the video's name with one of `suffixes`, in any letter case; None: there is none."""
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
    shown_us, n_declared = _times_us(path, on_progress)
    times_us = [time + time_offset_us for time in shown_us]
    if not times_us:
        raise SourceError(f"{path} is no video that OpenCV can decode: convert it, for example to H.264 in an .mp4")
    n_frames = len(times_us)
    names = [f"{path.name}/{number:06d}" for number in range(n_frames)]
    table, track = _companion(path, {".csv"}), _companion(path, TRACK_SUFFIXES)
    if table is not None:
        placement = read_positions(table, names, times_us)
        placement.follow(place_frames(placement.frames, str(table), placement.deadband_m))
    elif track is not None:
        images = list(zip(names, times_us, strict=True))
        placement = place_on_track(read_track(track), images, str(track), "the track", together=True)
    else:
        placement = Placement(
            [
                Frame(number, name, number * spacing_m, time_us)
                for number, (name, time_us) in enumerate(zip(names, times_us, strict=True))
            ]
        )
        pace = f"{n_frames} frames of {shown_us[-1] / 1e6:.1f} s are taken {spacing_m:g} m apart"
        placement.remarks.append(
            f"{pace}: --every-s takes fewer, {path.stem}.csv (or .gpx, .nmea) beside the video says where they are"
        )
    if n_frames < n_declared:
        placement.remarks.append(f"the file says that it has {n_declared} frames, and {n_frames} can be decoded")
    return VideoRecording(
        path.stem,
        tuple(placement.frames),
        placement.left_out_names,
        remarks=placement.remarks,
        path=path,
        rotate=rotate,
        decoder=_Decoder(path),
    )
