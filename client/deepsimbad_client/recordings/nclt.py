"""Recordings of the NCLT dataset (Carlevaris-Bianco, Ushani, Eustice, IJRR 2016), as they lie on disk.

One date is one drive. Images are `<utime>.tiff` in a folder per camera, stored lying on their side; ground truth is
a csv of 100-150 poses a second. People unpack the archives in several ways and all of these are found:

    ROOT/DATE/lb3/Cam5                        ROOT/ground_truth/groundtruth_DATE.csv
    ROOT/images/DATE/lb3/Cam5                 ROOT/DATE/groundtruth_DATE.csv
                                              ROOT/DATE/groundtruth.csv
                                              ROOT/ground_truth/DATE.csv

The Ladybug3's lenses are undone with the dataset's own look-up tables (`U2D_Cam<k>_1616X1232.txt`): a header line with
`width,height` somewhere in it, then `row col v u` for every pixel of the undistorted image, saying where in the stored
one to look. Two million such lines are parsed once and kept as npz in the user's cache folder.
"""

import hashlib
import logging
import os
import re
import tempfile
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings.ground_truth import MAX_GAP_S, read_ground_truth
from deepsimbad_client.recordings.images import Image, as_jpeg, decode, read_file
from deepsimbad_client.recordings.recording import EncodedImage, Frame, Recording

FRONT_CAMERA = 5
N_CAMERAS = 6
STORED_SIZE = (1616, 1232)  # (width, height) of the dataset's own images as stored; smaller copies are read too

N_SIZE_PROBES = 9
SUFFIXES = frozenset({".tiff", ".tif"})

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
    """The frames of one camera on one date that have ground truth, in time order.

    Frames have `timestamp_us`, x north, y east, heading and position along the ground truth. Left out are: "before or
    after the ground truth", "gap in the ground truth", "missing in Cam<k>" (another camera has an image of that time),
    "file name is not a time".

    Attributes:
        folder: The camera's.
        probes: File names of a few frames spread over the drive.
        undistortion: Applied to the stored image before it is turned upright.
    """

    folder: Path
    probes: Sequence[str]
    undistortion: UndistortionMap | None = None

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame upright, no larger than asked, as JPEG; see `Recording.image`."""
        return as_jpeg(self.upright(frame), input_size)

    def upright(self, frame: Frame) -> Image:
        """Read a frame, undistorted where asked, turned upright: 1232 wide, 1616 high in the dataset itself.

        Raises BrokenFrameError (missing, undecodable, or not of the size of the others).
        """
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
        """(width, height) of this recording's images as stored.

        The undistortion table's where there is one; else what most of a few frames spread over the drive have, so
        that copies at another resolution can be read and a single broken file cannot set the measure.
        """
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


def read_nclt(
    root: Path,
    date: str,
    *,
    camera: int = FRONT_CAMERA,
    undistortion: Path | None = None,
    max_gap_s: float = MAX_GAP_S,
    cache_dir: Path | None = None,
) -> NcltRecording:
    """Open one date of NCLT.

    Args:
        root: The folder that holds the dates (see the layouts at the top of this module).
        date: The drive's date, e.g. 2012-01-22.
        camera: 0..5; 5 looks forward, 0 up.
        undistortion: A `U2D_Cam<k>_*.txt` or the folder of them; None: images stay as the lens made them.
        max_gap_s: Images between two ground-truth rows farther apart than this are left out.
        cache_dir: Where parsed undistortion tables are kept; None: the user's cache folder.

    Raises SourceError (no images, no ground truth, or no image that has ground truth).
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
    names, n_not_times = _images_by_time(folder)
    if not names:
        raise SourceError(f"{folder} holds no image named <utime>.tiff")
    time_us = np.array(sorted(names), dtype=np.int64)
    poses = truth.at(time_us, max_gap_s)
    usable = np.flatnonzero(poses.covered & ~poses.in_gap)
    if not len(usable):
        raise SourceError(
            f"none of the {len(names)} images in {folder} has ground truth, which covers "
            f"{truth.time_us[0]} to {truth.time_us[-1]} microseconds: are they of one date?"
        )
    left_out = {
        "before or after the ground truth": int((~poses.covered).sum()),
        "gap in the ground truth": int(poses.in_gap.sum()),
        f"missing in Cam{camera}": _n_missing(folder, names),
        "file name is not a time": n_not_times,
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
    table = None
    if undistortion is not None:
        table = load_undistortion(find_undistortion_file(undistortion, camera), cache_dir)
    probed = np.unique(np.linspace(0, len(frames) - 1, N_SIZE_PROBES).round().astype(int))
    return NcltRecording(
        name=date,
        frames=frames,
        left_out={reason: n for reason, n in left_out.items() if n},
        folder=folder,
        probes=[frames[place].name for place in probed],
        undistortion=table,
    )


def _first(what: str, places: Sequence[Path], is_there: Callable[[Path], bool]) -> Path:
    for place in places:
        if is_there(place):
            return place
    raise SourceError(f"no {what}: looked for {', '.join(map(str, places))}")


def _images_by_time(folder: Path) -> tuple[dict[int, str], int]:
    """List a camera's folder: Unix microseconds -> file name, and how many TIFFs are not named by a time."""
    try:
        paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.name[0] != "."]
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    timed = [path for path in paths if path.stem.isascii() and path.stem.isdigit() and len(path.stem) <= 18]
    return {int(path.stem): path.name for path in timed}, len(paths) - len(timed)


def _n_missing(folder: Path, names: Mapping[int, str]) -> int:
    """How many times of exposure the other cameras on disk have and this one lacks."""
    others: set[int] = set()
    for other in folder.parent.glob("Cam[0-9]"):
        if other != folder and other.is_dir():
            others.update(_images_by_time(other)[0])
    return len(others - names.keys())


def find_undistortion_file(path: Path, camera: int) -> Path:
    """Find one camera's table: `path` itself, or the one for the camera in the folder `path`; else SourceError."""
    if path.is_file():
        return path
    tables = sorted(path.glob(f"U2D_Cam{camera}_*.txt"))
    if not tables:
        raise SourceError(f"no undistortion table for camera {camera}: looked for {path}/U2D_Cam{camera}_*.txt")
    return tables[0]


def load_undistortion(path: Path, cache_dir: Path | None = None) -> UndistortionMap:
    """Load a table, from the cache where this very file was parsed before.

    Parsed tables are kept in `cache_dir`, else in `deep-simbad` in the user's cache folder ($XDG_CACHE_HOME, else
    ~/.cache). A cache that cannot be written is done without. Raises SourceError (the file cannot be read or is not
    a complete table).
    """
    try:
        about = path.stat()
    except OSError as error:
        raise SourceError(f"cannot read the undistortion table {path}: {error.strerror or error}") from error
    # Names this version of the file without reading its 60 MB.
    identity = f"{path.resolve()}|{about.st_size}|{about.st_mtime_ns}"
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache_dir or caches / "deep-simbad"
    cached = folder / f"undistortion-{hashlib.sha256(identity.encode()).hexdigest()[:24]}.npz"
    table = _read_cached(cached)
    if table is None:
        table = parse_undistortion(path)
        _write_cached(cached, table)
    return table


def parse_undistortion(path: Path) -> UndistortionMap:
    """Parse the text of a table; see `load_undistortion`.

    The pixels' own rows and columns say where they go, so their order does not matter. They must form a complete
    grid of the size the header names; the header's wording is not known for certain, so it is read leniently.
    """
    try:
        with warnings.catch_warnings(), path.open(encoding="utf-8", errors="replace") as text:
            header = text.readline()
            warnings.simplefilter("ignore", UserWarning)  # numpy's word for an empty file; we say it better
            pixels = np.loadtxt(text, dtype=np.float64, ndmin=2, comments=None)
    except OSError as error:
        raise SourceError(f"cannot read the undistortion table {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: not an undistortion table of `row col v u` lines: {error}") from error
    if pixels.ndim != 2 or pixels.shape[1] != 4 or not np.isfinite(pixels).all() or pixels[:, :2].min() < 0:
        raise SourceError(f"{path}: an undistortion table has a header and lines of four numbers `row col v u`")
    row, column = pixels[:, 0].astype(np.int64), pixels[:, 1].astype(np.int64)
    width, height = int(column.max()) + 1, int(row.max()) + 1
    complete = len(np.unique(row * width + column)) == width * height
    if not complete or not _header_allows(header, width, height):
        raise SourceError(
            f"{path}: {len(pixels)} pixels reaching {width} x {height} are not the whole of the table its header "
            f"announces ({header.strip()!r}); the file is cut short or is something else"
        )
    u = np.empty((height, width), dtype=np.float32)
    v = np.empty((height, width), dtype=np.float32)
    v[row, column], u[row, column] = pixels[:, 2], pixels[:, 3]
    return UndistortionMap(u=u, v=v)


def _header_allows(header: str, width: int, height: int) -> bool:
    """Whether a header can mean this size.

    Keeping only digits and commas gives `width,height`; where a camera's number stands before them it runs into
    the width, so the numbers as written count too. A header without two fields says nothing.
    """
    fields = re.sub(r"[^0-9,]", "", header).split(",")
    as_written = {int(number) for number in re.findall(r"\d+", header)}
    return len(fields) != 2 or fields == [str(width), str(height)] or {width, height} <= as_written


def _read_cached(cached: Path) -> UndistortionMap | None:
    try:
        # Opened here, because numpy leaves a file open that turns out not to be an archive.
        with cached.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return UndistortionMap(u=arrays["u"], v=arrays["v"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        logger.warning("the cached undistortion table %s is damaged and is made again: %s", cached, error)
        return None


def _write_cached(cached: Path, table: UndistortionMap) -> None:
    """Write beside and rename, so that two readers starting together never see half a file."""
    try:
        cached.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cached.parent) as folder:
            beside = Path(folder) / cached.name
            np.savez(beside, u=table.u, v=table.v)
            beside.replace(cached)
    except OSError as error:
        logger.warning("cannot keep the parsed undistortion table in %s: %s", cached.parent, error)
