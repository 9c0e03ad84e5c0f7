"""Recordings of the NCLT dataset (Carlevaris-Bianco, Ushani, Eustice, IJRR 2016), as they lie on disk.

One date is one drive. Images are `<utime>.tiff` in a folder for each camera, stored lying on their side; ground truth
is a csv of 100-150 poses a second. The archives may be unpacked in any of these ways:

    ROOT/DATE/lb3/Cam5                        ROOT/ground_truth/groundtruth_DATE.csv
    ROOT/images/DATE/lb3/Cam5                 ROOT/DATE/groundtruth_DATE.csv
                                              ROOT/DATE/groundtruth.csv
                                              ROOT/ground_truth/DATE.csv

The Ladybug3's lenses are undone with the dataset's own look-up tables (`U2D_Cam<k>_1616X1232.txt`): a header line, then
`row col v u` for every pixel of the undistorted image, saying where in the stored one to look.

A row of ground truth is `utime,x,y,z,roll,pitch,yaw`: microseconds, metres in the local frame of all drives (x north, y
east, z down), radians. Rows that are not seven finite numbers are counted and not used. Route position is metres along
the track, which do not grow while the robot stands: see `arc_length_m`.
"""

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.frames import UPRIGHT_TURN, Camera
from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings import (
    IMAGE_SUFFIXES,
    EncodedImage,
    Frame,
    Image,
    Recording,
    as_png,
    decode,
    read_file,
    turned,
)
from deepsimbad_client.recordings.placing import place_on_track
from deepsimbad_client.recordings.track import Reals, Track, track_of

FRONT_CAMERA = 5
TURNED_UPRIGHT = f"NCLT's images, which lie on their side as stored, are turned upright ({UPRIGHT_TURN} degrees)"
N_COLUMNS = 7

TIFF_SUFFIXES = frozenset({".tiff", ".tif"})
_CAMERA = re.compile(r"Cam[0-5].*")
_UTIME = re.compile(r"[0-9]{16}")


@dataclass(frozen=True, eq=False, kw_only=True)
class NcltRecording(Recording):
    """The frames of one camera on one date that have ground truth, in time order.

    Left out are those "before or after the ground truth", in a "gap in the ground truth", "missing in Cam<k>" (another
    camera has an image of that time), and where the "file name is not a time".
    """

    folder: Path  # the camera's
    undistortion: NDArray[np.float32] | None = None  # as `read_undistortion`; applied before an image is turned upright
    rotate: int | None = None  # degrees clockwise; None: upright; copies higher than wide are upright already

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame upright, no larger than asked, as PNG; see `Recording.image`."""
        return as_png(self.upright(frame), input_size)

    def upright(self, frame: Frame) -> Image:
        """Read a frame, undistorted where asked, turned upright; raises BrokenFrameError."""
        path = self.folder / frame.name
        stored = decode(read_file(path), path, as_stored=True)
        height, width = stored.shape[:2]
        if self.undistortion is not None:
            column, row = self.undistortion
            if column.shape != (height, width):
                sizes = f"{width} x {height}, the undistortion table of {column.shape[1]} x {column.shape[0]}"
                raise BrokenFrameError(f"{path} is {sizes}", "wrong size")
            stored = np.asarray(cv2.remap(stored, column, row, cv2.INTER_LINEAR), dtype=np.uint8)
        turn = (UPRIGHT_TURN if width > height else 0) if self.rotate is None else self.rotate
        return turned(stored, turn)


def lies_on_its_side(path: Path) -> bool:
    """Whether an image is one of NCLT's, by its folder (lb3/Cam5) or its name (Unix microseconds), lying as stored.

    False for a file that cannot be read.
    """
    in_layout = bool(_CAMERA.fullmatch(path.parent.name)) and path.parent.parent.name.startswith("lb3")
    if not in_layout and not _UTIME.fullmatch(path.stem):
        return False
    try:
        height, width = decode(read_file(path), path, as_stored=True).shape[:2]
    except BrokenFrameError:
        return False
    return width > height and (in_layout or Camera(width, height).lies_like_nclt)


def read_nclt(
    root: Path,
    date: str,
    *,
    camera: int = FRONT_CAMERA,
    undistortion: Path | None = None,
    rotate: int | None = None,
    folder: Path | None = None,
) -> NcltRecording:
    """Open one date (2012-01-22) of NCLT, whose folders are below `root`; camera 5 looks forward, 0 up.

    Frames may be copies in another format, smaller, undistorted or turned upright, in `folder`. `undistortion` is a
    `U2D_Cam<k>_*.txt` or the folder of them; None: images stay as the lens made them. Raises SourceError (no images, no
    ground truth, or no image that has ground truth).
    """
    if folder is None:
        places = [parent / date / "lb3" / f"Cam{camera}" for parent in (root, root / "images")]
        for parent in (root, root / "images"):
            places += sorted((parent / date).glob(f"lb3*/Cam{camera}*"))
        folder = _first_path(f"images of NCLT {date}", places, Path.is_dir, drives_in(root / date, root))
    truth = read_ground_truth(_first_path(f"ground truth of NCLT {date}", ground_truth_files(root, date), Path.is_file))
    names, not_times = _images_by_time(folder)
    if not names:
        raise SourceError(f"{folder} holds no image named <utime>.tiff (nor .jpg, .png or another format)")
    placement = place_on_track(
        truth, [(name, time) for time, name in sorted(names.items())], str(folder), "the ground truth"
    )
    left_out = {
        **placement.left_out_names,
        f"missing in Cam{camera}": _missing_names(folder, names),
        "file name is not a time": not_times,
    }
    return NcltRecording(
        name=date,
        frames=tuple(placement.frames),
        left_out_names={reason: files for reason, files in left_out.items() if files},
        remarks=placement.remarks,
        folder=folder,
        undistortion=None if undistortion is None else read_undistortion(undistortion, camera),
        rotate=rotate,
        camera=f"Cam{camera}",
    )


def ground_truth_files(root: Path, date: str) -> list[Path]:
    """The paths where a date's ground truth may lie."""
    return [
        root / "ground_truth" / f"groundtruth_{date}.csv",
        root / date / f"groundtruth_{date}.csv",
        root / date / "groundtruth.csv",
        root / "ground_truth" / f"{date}.csv",
    ]


def _first_path(description: str, places: Sequence[Path], is_there: Callable[[Path], bool], hint: str = "") -> Path:
    for place in places:
        if is_there(place):
            return place
    raise SourceError(f"no {description}: looked for {', '.join(map(str, places))}{hint}")


def drives_in(*roots: Path) -> str:
    """Words for the drives in the first of some folders to hold any; "" where none does."""
    names_by_root = [sorted(f"nclt:{images.parent}" for images in root.glob("*/lb3")) for root in roots]
    return next((f"; there is {', '.join(drives)}" for drives in names_by_root if drives), "")


def _images_by_time(folder: Path) -> tuple[dict[int, str], list[str]]:
    """A camera's images by Unix microseconds, a TIFF rather than its copy, and the names of images that are no time."""
    try:
        paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.name[0] != "."]
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    timed_paths = [path for path in paths if path.stem.isascii() and path.stem.isdigit() and len(path.stem) <= 18]
    timed_paths.sort(key=lambda path: path.suffix.lower() in TIFF_SUFFIXES)
    return {int(path.stem): path.name for path in timed_paths}, sorted(
        path.name for path in set(paths) - set(timed_paths)
    )


def _missing_names(folder: Path, names: Mapping[int, str]) -> list[str]:
    """Files of the other cameras' images at times of which this camera's `folder` has none."""
    other_names: dict[int, str] = {}
    for camera_folder in folder.parent.glob("Cam[0-9]"):
        if camera_folder != folder and camera_folder.is_dir():
            other_names |= _images_by_time(camera_folder)[0]
    return [other_names[time] for time in sorted(other_names.keys() - names.keys())]


def read_undistortion(path: Path, camera: int) -> NDArray[np.float32]:
    """Read a table, `path` itself or the camera's own in the folder `path`; raises SourceError.

    The order of its lines does not matter, for each names its pixel; they must form a complete grid. Returns
    [2, height, width] column and row where each pixel of the undistorted image lies in the stored one.
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
    table = np.empty((2, height, width), dtype=np.float32)
    table[:, row, column] = pixels[:, [3, 2]].T
    return table


def read_ground_truth(path: Path) -> Track:
    """Read a ground-truth file in whatever state it is: rows out of order are sorted, of equal times the first is used.

    Raises SourceError (it cannot be read, or fewer than two usable rows are in it).
    """
    try:
        rows = _rows(path)
    except OSError as error:
        raise SourceError(f"cannot read the ground truth {path}: {error.strerror or error}") from error
    # Unix microseconds have 16 digits: below 2^53 a float64 holds every one of them exactly.
    usable = rows[np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 0]) < 2**53)]
    track = track_of(*usable[:, [0, 1, 2, 6]].T)
    if track is None:
        raise SourceError(
            f"{path}: fewer than 2 usable rows among {len(rows)}; ground truth needs at least two rows of "
            "utime,x,y,z,roll,pitch,yaw without NaN"
        )
    return replace(track, n_skipped_rows=track.n_skipped_rows + len(rows) - len(usable))


def _rows(path: Path) -> Reals:
    """Read all rows [m, 7] float64; one that is not seven numbers becomes NaN."""
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
    nan_row = [float("nan")] * N_COLUMNS
    try:
        values = [float(cell) for cell in line.split(",")[:N_COLUMNS]]
    except ValueError:
        return nan_row
    return values if len(values) == N_COLUMNS else nan_row
