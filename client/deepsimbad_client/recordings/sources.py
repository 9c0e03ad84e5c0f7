"""SOURCE: the one way to name a recording on a command line.

    nclt:ROOT/DATE        one date of the NCLT dataset (`nclt`)
    FOLDER                images in name order, with an optional positions.csv
    rosbag:FILE[#topic]   a ROS bag; an MCAP file needs no prefix (`bag`)
    FILE.mp4 and others   a video (`video`)
    FILE.npy, FILE.csv    ready encodings [n, d], one row for each frame, in travel order
    nordland:ROOT/summer  and other sets that others measure on (`benchmarks`)

Each may end in #START:STOP or #START:STOP:STEP, Python's slice of its frames, which keep their places and positions.

In a folder, name order counts digits as numbers (2.png before 10.png); names padded with zeros sort as
usual. Folders inside and files whose name starts with a dot are not looked at.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepsimbad_client.errors import InvalidArgumentError, SourceError
from deepsimbad_client.recordings import TURNS, Recording
from deepsimbad_client.recordings.bag import BAG_PREFIX, BAG_SUFFIXES, METADATA, read_bag
from deepsimbad_client.recordings.benchmarks import open_benchmark, recognised
from deepsimbad_client.recordings.cuts import check_one_drive, thinned, turned_back
from deepsimbad_client.recordings.encodings import ENCODING_SUFFIXES, read_encodings
from deepsimbad_client.recordings.folder import read_folder
from deepsimbad_client.recordings.nclt import FRONT_CAMERA, NcltRecording, ground_truth_files, read_nclt
from deepsimbad_client.recordings.positions import positions_file
from deepsimbad_client.recordings.video import VIDEO_SUFFIXES, read_video

NCLT_PREFIX = "nclt:"
MOST_OFFSET_S = 1e10  # three centuries
RECORDING_SUFFIXES = ENCODING_SUFFIXES | VIDEO_SUFFIXES | BAG_SUFFIXES
"""Of files that hold many frames."""

_SLICE = re.compile(r"\s*([+-]?\d+)?\s*:\s*([+-]?\d+)?\s*(?::\s*([+-]?\d+)?\s*)?")


def open_source(
    source: str,
    *,
    spacing_m: float = 1.0,
    camera: int = FRONT_CAMERA,
    undistortion: Path | None = None,
    rotate: int | None = None,
    time_offset_s: float = 0.0,
    every_s: float | None = None,
    every_m: float | None = None,
    reverse: bool = False,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Recording:
    """Open a recording, see the top of this module.

    Args:
        source: SOURCE.
        spacing_m: Between frames of unsaid places.
        camera: NCLT's, 0..5.
        undistortion: NCLT's table, or the folder of them.
        rotate: Degrees clockwise, 0, 90, 180 or 270, by which images are turned; None: NCLT's upright, others not.
        time_offset_s: Added to the images' times before a track is asked where they were taken.
        every_s: Take one frame every so many seconds.
        every_m: Take one frame every so many metres.
        reverse: Take the frames in the other order.
        on_progress: Told the share that is read, where opening takes long.

    Raises:
        SourceError: There is no such recording, it makes no sense, or positions fall along the drive.
        InvalidArgumentError: What was asked does not go with a recording of this kind.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise SourceError(f"a spacing of {spacing_m} m: frames must be more than 0 m apart")
    if not abs(time_offset_s) < MOST_OFFSET_S:
        raise InvalidArgumentError(f"a time offset of {time_offset_s} s: clocks are not so far apart")
    if rotate is not None and rotate not in TURNS:
        raise SourceError(f"images cannot be turned by {rotate} degrees: give 0, 90, 180 or 270")
    place, part = split_slice(source)
    how = _How(spacing_m, camera, undistortion, rotate, round(time_offset_s * 1e6), on_progress)
    recording = _open_whole(place, how)
    _check_options(recording, how)
    first, last = recording.frames[0], recording.frames[-1]
    if reverse:
        recording = turned_back(recording)
    elif last.position_m < first.position_m:
        raise SourceError(
            f"{place}: positions fall along the drive, from {first.position_m:g} m ({first.name}) to "
            f"{last.position_m:g} m ({last.name}), and a route's rise: --reverse takes the frames in the other order"
        )
    recording = thinned(recording, every_s, every_m)
    recording = recording if part is None else recording.sliced(part)
    check_one_drive(recording)
    return recording


@dataclass(frozen=True)
class _How:
    """As `open_source` was asked."""

    spacing_m: float
    camera: int
    undistortion: Path | None
    rotate: int | None
    time_offset_us: int
    on_progress: Callable[[float], None]


def _check_options(recording: Recording, how: _How) -> None:
    """Raises InvalidArgumentError: what was asked would change nothing in a recording of this kind."""
    is_nclt, is_set = isinstance(recording, NcltRecording), recording.tolerance_m is not None
    has_images = recording.encodings is None
    for option, is_asked, fits in (
        ("--undistortion", how.undistortion is not None, is_nclt),
        ("--rotate", bool(how.rotate), has_images),
        ("--time-offset-s", how.time_offset_us != 0, has_images and not is_nclt and not is_set),
    ):
        if is_asked and not fits:
            raise InvalidArgumentError(f"{option} does not go with a recording such as {recording.name}: leave it out")


def split_slice(source: str) -> tuple[str, slice | None]:
    """Split SOURCE into the recording and the slice of its frames; a `#` in a file's own name does no harm.

    Raises SourceError (what follows the `#` is neither a slice nor a file's).
    """
    place, mark, ending = source.rpartition("#")
    if not mark or Path(source.removeprefix(NCLT_PREFIX)).expanduser().exists():
        return source, None
    match = _SLICE.fullmatch(ending)
    if not match and _is_bag(source.partition("#")[0]):
        return source, None
    if match:
        return place, slice(*(None if number is None else int(number) for number in match.groups()))
    raise SourceError(f"{source}: a slice is #START:STOP or #START:STOP:STEP in whole frames, not #{ending}")


def _open_whole(place: str, how: _How) -> Recording:
    if place.startswith(NCLT_PREFIX):
        drive = Path(place.removeprefix(NCLT_PREFIX)).expanduser()
        if not drive.name or drive.name == "..":
            raise SourceError(f"{place}: expected nclt:ROOT/DATE, for example nclt:/data/nclt/2012-01-22")
        return read_nclt(drive.parent, drive.name, camera=how.camera, undistortion=how.undistortion, rotate=how.rotate)
    if (benchmark := open_benchmark(place, how.spacing_m, how.rotate or 0)) is not None:
        return benchmark
    bag, _, topics = place.partition("#")
    if _is_bag(bag):
        bag_path = Path(bag.removeprefix(BAG_PREFIX)).expanduser()
        if not bag_path.exists():
            raise SourceError(f"no bag at {bag_path}")
        return read_bag(bag_path, topics, how.spacing_m, how.rotate or 0, how.time_offset_us, how.on_progress)
    path = Path(place).expanduser()
    if not place or not path.exists():
        raise SourceError(
            f"no recording at {place!r}: expected nclt:ROOT/DATE, a folder of images, rosbag:FILE, a video, or "
            "encodings in a .npy or .csv"
        )
    if path.is_dir():
        known = _nclt_camera(path, how) or recognised(path, how.spacing_m, how.rotate or 0)
        return known or read_folder(path, how.spacing_m, how.rotate, how.time_offset_us, how.on_progress)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return read_video(path, how.spacing_m, how.rotate or 0, how.time_offset_us, how.on_progress)
    if path.suffix.lower() in ENCODING_SUFFIXES:
        return read_encodings(path, how.spacing_m)
    raise SourceError(
        f"{path}: expected a video ({', '.join(sorted(VIDEO_SUFFIXES))}) or ready encodings [n, d] in a .npy or .csv; "
        "images are named by their folder"
    )


def _is_bag(place: str) -> bool:
    path = Path(place)
    return place.startswith(BAG_PREFIX) or path.suffix.lower() in BAG_SUFFIXES or (path / METADATA).is_file()


def _nclt_camera(folder: Path, how: _How) -> Recording | None:
    """The recording of a camera's folder in NCLT's layout (ROOT/DATE/lb3/Cam5); None: it is none, or has no poses.

    Raises SourceError (what is there cannot be read).
    """
    drive = folder.resolve().parent.parent
    camera = re.fullmatch(r"Cam([0-5]).*", folder.resolve().name)
    if camera is None or not folder.resolve().parent.name.startswith("lb3") or positions_file(folder):
        return None
    root = drive.parent.parent if drive.parent.name == "images" else drive.parent
    if not any(path.is_file() for path in ground_truth_files(root, drive.name)):
        return None
    options: dict[str, Any] = {"undistortion": how.undistortion, "rotate": how.rotate, "folder": folder}
    recording = read_nclt(root, drive.name, camera=int(camera[1]), **options)
    turn = "upright" if how.rotate is None else f"turned by {how.rotate} degrees"
    said = f"NCLT's layout: read as {NCLT_PREFIX}{root / drive.name}, camera {camera[1]}, {turn}"
    return dataclasses.replace(recording, remarks=[said, *recording.remarks])
