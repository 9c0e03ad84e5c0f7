"""Recordings of the NCLT dataset (Carlevaris-Bianco, Ushani, Eustice, IJRR 2016), as they lie on disk.

One date is one drive. Images are `<utime>.tiff` in a folder per camera, stored lying on their side; ground truth is
a csv of 100-150 poses a second. People unpack the archives in several ways and all of these are found:

    ROOT/DATE/lb3/Cam5                        ROOT/ground_truth/groundtruth_DATE.csv
    ROOT/images/DATE/lb3/Cam5                 ROOT/DATE/groundtruth_DATE.csv
                                              ROOT/DATE/groundtruth.csv
                                              ROOT/ground_truth/DATE.csv

The Ladybug3's lenses are undone with the dataset's own look-up tables (`U2D_Cam<k>_1616X1232.txt`): a header line, then
`row col v u` for every pixel of the undistorted image, saying where in the stored one to look.

Ground truth is `utime,x,y,z,roll,pitch,yaw` a row: microseconds, metres in the local frame of all drives (x north, y
east, z down), radians. Rows that are not seven finite numbers are counted and not used. Route position is metres along
the track, unmoved by a robot that stands still: see `arc_length_m`.
"""

import logging
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import hypot
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings import EncodedImage, Frame, Image, Recording, as_jpeg, decode, read_file

FRONT_CAMERA = 5
N_CAMERAS = 6
STORED_SIZE = (1616, 1232)  # (width, height) of the dataset's own images as stored; smaller copies are read too

N_SIZE_PROBES = 9
SUFFIXES = frozenset({".tiff", ".tif"})
N_COLUMNS = 7
MAX_GAP_S = 1.0  # Between ground-truth rows farther apart than this nothing is interpolated: the robot may have turned
DEADBAND_M = 0.25
SMOOTHING_HALF_WIDTH_US = 250_000

Reals = NDArray[np.float64]
Times = NDArray[np.int64]


logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class UndistortionMap:
    """Where each pixel of the undistorted image lies in the stored one."""

    u: NDArray[np.float32]  # [height, width] column in the stored image
    v: NDArray[np.float32]  # [height, width] row in the stored image

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the images it is for, as stored."""
        return self.u.shape[1], self.u.shape[0]

    def apply(self, stored: Image) -> Image:
        """Undistort an image in its stored orientation; what the camera did not see becomes black."""
        return np.asarray(cv2.remap(stored, self.u, self.v, cv2.INTER_LINEAR), dtype=np.uint8)


@dataclass(frozen=True, eq=False, kw_only=True)
class NcltRecording(Recording):
    """The frames of one camera on one date that have ground truth, in time order, with all that it tells of them.

    Left out are those "before or after the ground truth", in a "gap in the ground truth", "missing in Cam<k>" (another
    camera has an image of that time), and where the "file name is not a time".
    """

    folder: Path  # the camera's
    probes: Sequence[str]  # file names of a few frames spread over the drive
    undistortion: UndistortionMap | None = None  # applied before an image is turned upright

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame upright, no larger than asked, as JPEG; see `Recording.image`."""
        return as_jpeg(self.upright(frame), input_size)

    def upright(self, frame: Frame) -> Image:
        """Read a frame, undistorted where asked, turned upright; raises BrokenFrameError."""
        stored = self._stored(frame.name)
        size, expected = (stored.shape[1], stored.shape[0]), self.stored_size
        if size != expected:
            raise BrokenFrameError(
                f"{self.folder / frame.name} is {size[0]} x {size[1]}, the recording's images are "
                f"{expected[0]} x {expected[1]}",
                "wrong size",
            )
        if self.undistortion is not None:
            stored = self.undistortion.apply(stored)
        return np.asarray(cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE), dtype=np.uint8)

    @cached_property
    def stored_size(self) -> tuple[int, int]:
        """(width, height) of this recording's images as stored: the undistortion table's, or what most probes have."""
        if self.undistortion is not None:
            return self.undistortion.size
        sizes: Counter[tuple[int, int]] = Counter()
        for name in self.probes:
            try:
                image = self._stored(name)
            except BrokenFrameError:
                continue
            sizes[image.shape[1], image.shape[0]] += 1
        most = max(sizes.values(), default=0)
        commonest = [size for size, n in sizes.items() if n == most]
        return commonest[0] if commonest and STORED_SIZE not in commonest else STORED_SIZE

    def _stored(self, name: str) -> Image:
        path = self.folder / name
        return decode(read_file(path), path, as_stored=True)


def read_nclt(root: Path, date: str, *, camera: int = FRONT_CAMERA, undistortion: Path | None = None) -> NcltRecording:
    """Open one date (2012-01-22) of NCLT, whose folders are below `root`; camera 5 looks forward, 0 up.

    `undistortion` is a `U2D_Cam<k>_*.txt` or the folder of them; None: images stay as the lens made them. Raises
    SourceError (no images, no ground truth, or no image that has ground truth).
    """
    if not 0 <= camera < N_CAMERAS:
        raise SourceError(f"camera {camera}: NCLT has cameras 0 to {N_CAMERAS - 1}; 5 looks forward")
    places = [above / date / "lb3" / f"Cam{camera}" for above in (root, root / "images")]
    folder = _first(f"images of NCLT {date}", places, Path.is_dir)
    truths = [
        root / "ground_truth" / f"groundtruth_{date}.csv",
        root / date / f"groundtruth_{date}.csv",
        root / date / "groundtruth.csv",
        root / "ground_truth" / f"{date}.csv",
    ]
    truth = read_ground_truth(_first(f"ground truth of NCLT {date}", truths, Path.is_file))
    names, not_times = _images_by_time(folder)
    if not names:
        raise SourceError(f"{folder} holds no image named <utime>.tiff")
    time_us = np.array(sorted(names), dtype=np.int64)
    poses = truth.at(time_us)
    usable = np.flatnonzero(poses.covered & ~poses.in_gap)
    if not len(usable):
        raise SourceError(
            f"none of the {len(names)} images in {folder} has ground truth, which covers "
            f"{truth.time_us[0]} to {truth.time_us[-1]} microseconds: are they of one date?"
        )
    left_out = {
        "before or after the ground truth": [names[int(time)] for time in time_us[~poses.covered]],
        "gap in the ground truth": [names[int(time)] for time in time_us[poses.in_gap]],
        f"missing in Cam{camera}": _missing(folder, names),
        "file name is not a time": not_times,
    }
    frames = tuple(
        Frame(
            index,
            names[int(time_us[at])],
            float(poses.position_m[at]),
            timestamp_us=int(time_us[at]),
            x_m=float(poses.x_m[at]),
            y_m=float(poses.y_m[at]),
            heading_rad=float(poses.heading_rad[at]),
        )
        for index, at in enumerate(usable)
    )
    probed = np.unique(np.linspace(0, len(frames) - 1, N_SIZE_PROBES).round().astype(int))
    return NcltRecording(
        name=date,
        frames=frames,
        left_out_names={reason: files for reason, files in left_out.items() if files},
        folder=folder,
        probes=[frames[place].name for place in probed],
        undistortion=None if undistortion is None else read_undistortion(undistortion, camera),
    )


def _first(what: str, places: Sequence[Path], is_there: Callable[[Path], bool]) -> Path:
    for place in places:
        if is_there(place):
            return place
    raise SourceError(f"no {what}: looked for {', '.join(map(str, places))}")


def _images_by_time(folder: Path) -> tuple[dict[int, str], list[str]]:
    """List a camera's folder: Unix microseconds -> file name, and the TIFFs that are not named by a time."""
    try:
        paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.name[0] != "."]
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    timed = [path for path in paths if path.stem.isascii() and path.stem.isdigit() and len(path.stem) <= 18]
    return {int(path.stem): path.name for path in timed}, sorted(path.name for path in set(paths) - set(timed))


def _missing(folder: Path, names: Mapping[int, str]) -> list[str]:
    """Files of the other cameras on disk, of times of exposure that this one lacks."""
    others: dict[int, str] = {}
    for other in folder.parent.glob("Cam[0-9]"):
        if other != folder and other.is_dir():
            others |= _images_by_time(other)[0]
    return [others[time] for time in sorted(others.keys() - names.keys())]


def read_undistortion(path: Path, camera: int) -> UndistortionMap:
    """Read a table, `path` itself or the camera's own in the folder `path`; raises SourceError.

    The pixels' own rows and columns say where they go, so their order does not matter; they must form a complete grid.
    """
    if path.is_dir():
        tables = sorted(path.glob(f"U2D_Cam{camera}_*.txt"))
        if not tables:
            raise SourceError(f"no undistortion table for camera {camera}: looked for {path}/U2D_Cam{camera}_*.txt")
        path = tables[0]
    try:
        with warnings.catch_warnings(), path.open(encoding="utf-8", errors="replace") as text:
            text.readline()
            warnings.simplefilter("ignore", UserWarning)  # numpy's word for an empty file; we say it better
            pixels = np.loadtxt(text, dtype=np.float64, ndmin=2, comments=None)
    except OSError as error:
        raise SourceError(f"cannot read the undistortion table {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: not an undistortion table of `row col v u` lines: {error}") from error
    if pixels.shape[1] != 4 or not np.isfinite(pixels).all() or pixels[:, :2].min() < 0:
        raise SourceError(f"{path}: an undistortion table has a header and lines of four numbers `row col v u`")
    row, column = pixels[:, 0].astype(np.int64), pixels[:, 1].astype(np.int64)
    width, height = int(column.max()) + 1, int(row.max()) + 1
    if len(np.unique(row * width + column)) != width * height:
        raise SourceError(f"{path}: {len(pixels)} pixels are not the whole of a table of {width} x {height}")
    u, v = np.empty((2, height, width), dtype=np.float32)
    v[row, column], u[row, column] = pixels[:, 2], pixels[:, 3]
    return UndistortionMap(u=u, v=v)


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses at [n] asked times; where `covered` is False or `in_gap` True the values mean nothing."""

    covered: NDArray[np.bool_]  # the time lies between the first and the last ground-truth row
    in_gap: NDArray[np.bool_]  # covered, but between two rows too far apart to interpolate
    x_m: Reals  # north
    y_m: Reals  # east
    heading_rad: Reals  # in (-pi, pi], from north towards east
    position_m: Reals  # along the track


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The track of one drive: as `Poses`, at [m] strictly increasing times."""

    time_us: Times
    x_m: Reals
    y_m: Reals
    heading_rad: Reals
    position_m: Reals
    n_skipped_rows: int = 0  # that held NaN, too few values or no numbers

    def at(self, time_us: Times) -> Poses:
        """Interpolate at [n] times, in any order: x, y and position linearly, heading the short way round."""
        covered = (time_us >= self.time_us[0]) & (time_us <= self.time_us[-1])
        last = len(self.time_us) - 1
        before = np.clip(np.searchsorted(self.time_us, time_us, side="right") - 1, 0, last)
        after = np.minimum(before + 1, last)
        # Differences of int64 first: absolute microseconds and fractions of them do not fit one float.
        step_us = self.time_us[after] - self.time_us[before]
        since_us = np.clip(time_us - self.time_us[before], 0, step_us)
        share = since_us / np.maximum(step_us, 1)

        def between(values: Reals) -> Reals:
            return np.asarray(values[before] + share * (values[after] - values[before]), dtype=np.float64)

        turn = wrapped_rad(self.heading_rad[after] - self.heading_rad[before])
        return Poses(
            covered=covered,
            in_gap=covered & (since_us > 0) & (step_us > MAX_GAP_S * 1e6),
            x_m=between(self.x_m),
            y_m=between(self.y_m),
            heading_rad=wrapped_rad(self.heading_rad[before] + share * turn),
            position_m=between(self.position_m),
        )


def wrapped_rad(angle_rad: Reals) -> Reals:
    """Bring angles into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi), dtype=np.float64)


def read_ground_truth(path: Path) -> GroundTruth:
    """Read a ground-truth file in whatever state it is: rows out of order are sorted, of one time the first stays.

    Raises SourceError (it cannot be read, or fewer than two usable rows are in it).
    """
    try:
        rows = _rows(path)
    except OSError as error:
        raise SourceError(f"cannot read the ground truth {path}: {error.strerror or error}") from error
    # Unix microseconds have 16 digits: below 2^53 a float64 holds every one of them exactly.
    usable = rows[np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 0]) < 2**53)]
    time_us, first = np.unique(usable[:, 0].astype(np.int64), return_index=True)
    if len(time_us) < 2:
        raise SourceError(
            f"{path}: {len(time_us)} usable rows among {len(rows)}; ground truth needs at least two rows of "
            "utime,x,y,z,roll,pitch,yaw without NaN"
        )
    x_m, y_m, heading_rad = (usable[first, column].copy() for column in (1, 2, 6))
    n_skipped = len(rows) - len(usable)
    if n_skipped:
        logger.info("%s: %d of %d rows skipped (NaN or unreadable)", path, n_skipped, len(rows))
    return GroundTruth(time_us, x_m, y_m, wrapped_rad(heading_rad), arc_length_m(x_m, y_m, time_us), n_skipped)


def _rows(path: Path) -> Reals:
    """Read every row [m, 7] float64; one that is not seven numbers becomes NaN."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy's word for an empty file; we say it better
            rows = np.loadtxt(path, delimiter=",", comments=None, ndmin=2, dtype=np.float64)
        if rows.size and rows.shape[1] >= N_COLUMNS:
            return rows[:, :N_COLUMNS]
    except ValueError:
        pass  # some row is broken: the slow way finds out which
    with path.open(encoding="utf-8", errors="replace") as lines:
        return np.array([_row(line) for line in lines if line.strip()], np.float64).reshape(-1, N_COLUMNS)


def _row(line: str) -> list[float]:
    broken = [float("nan")] * N_COLUMNS
    try:
        values = [float(cell) for cell in line.split(",")[:N_COLUMNS]]
    except ValueError:
        return broken
    return values if len(values) == N_COLUMNS else broken


def arc_length_m(x_m: Reals, y_m: Reals, time_us: Times | None = None) -> Reals:
    """How far a track [n], in travel order, has gone at each of its poses: [n] metres, non-decreasing, 0 at the first.

    A pose stream of 100-150 Hz trembles by centimetres, and summing its steps as they are turns a minute of standing
    into a hundred metres of driving. So, where increasing times [n] are given, each pose is first averaged with those
    within a quarter of a second; the track is then walked by anchors: the position is the distance summed up to the
    last anchor plus the greatest distance from it reached so far, and a pose at least `DEADBAND_M` away becomes the
    next anchor. A robot that moves straight on gets its distance exactly, at every pose and not only at anchors.
    """
    travelled = np.zeros(len(x_m), dtype=np.float64)
    if len(x_m) == 0:
        return travelled
    if time_us is not None:
        x_m, y_m = _smoothed(x_m, time_us), _smoothed(y_m, time_us)
    xs, ys = x_m.tolist(), y_m.tolist()
    anchor_x, anchor_y = xs[0], ys[0]
    up_to_anchor = farthest = 0.0
    for i, (x, y) in enumerate(zip(xs, ys, strict=True)):
        away = hypot(x - anchor_x, y - anchor_y)
        farthest = max(farthest, away)
        travelled[i] = up_to_anchor + farthest
        if away >= DEADBAND_M:
            up_to_anchor += away
            anchor_x, anchor_y, farthest = x, y, 0.0
    return travelled


def _smoothed(values: Reals, time_us: Times) -> Reals:
    """Average each value with those near in time; one-sided windows would shift both ends of every drive and gap."""
    breaks = np.flatnonzero(np.diff(time_us) > SMOOTHING_HALF_WIDTH_US) + 1
    starts = np.concatenate(([0], breaks))
    lengths = np.diff(np.concatenate((starts, [len(values)])))
    first_us = np.repeat(time_us[starts], lengths)
    last_us = np.repeat(time_us[starts + lengths - 1], lengths)
    half_us = np.minimum(SMOOTHING_HALF_WIDTH_US, np.minimum(time_us - first_us, last_us - time_us))
    low = np.searchsorted(time_us, time_us - half_us, side="left")
    high = np.searchsorted(time_us, time_us + half_us, side="right")
    centre = values.mean()  # keeps the running sum small, hence exact
    running = np.concatenate(([0.0], np.cumsum(values - centre)))
    return np.asarray(centre + (running[high] - running[low]) / (high - low), dtype=np.float64)
