"""SOURCE, the way to name a recording on a command line, and the choice of its frames.

    nclt:ROOT/DATE        one date of the NCLT dataset (`nclt`)
    FOLDER                images in name order, with an optional positions.csv
    rosbag:FILE[#topic]   a ROS bag; an MCAP file needs no prefix (`bag`)
    FILE.mp4 and others   a video (`video`)
    FILE.npy, FILE.csv    ready encodings [n, d], one row for each frame, in travel order
    nordland:ROOT/summer  and other public benchmark sets (`benchmarks`)

Each may end in #START:STOP or #START:STOP:STEP, Python's slice of its frames, which keep their places and positions.

In a folder, name order counts digits as numbers (2.png before 10.png); names padded with zeros sort as
usual. Folders inside and files whose name starts with a dot are not looked at.

Frames are then chosen: every few, from the other end, of one turn; and those of several drives are refused.
"""

import dataclasses
import math
import re
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import InvalidArgumentError, SourceError
from deepsimbad_client.http import text_of
from deepsimbad_client.recordings import TURNS, Frame, Recording, finite_number
from deepsimbad_client.recordings.bag import BAG_PREFIX, BAG_SUFFIXES, METADATA, read_bag
from deepsimbad_client.recordings.benchmarks import open_benchmark, open_recognised
from deepsimbad_client.recordings.folder import read_folder
from deepsimbad_client.recordings.names import counted_anew, dates_in
from deepsimbad_client.recordings.nclt import NcltRecording, ground_truth_files, read_nclt
from deepsimbad_client.recordings.positions import positions_file
from deepsimbad_client.recordings.video import VIDEO_SUFFIXES, read_video

NCLT_PREFIX = "nclt:"
MOST_OFFSET_S = 1e10  # three centuries
ENCODING_SUFFIXES = frozenset({".npy", ".csv"})
RECORDING_SUFFIXES = ENCODING_SUFFIXES | VIDEO_SUFFIXES | BAG_SUFFIXES
"""The suffixes of files that hold many frames."""

_SLICE = re.compile(r"\s*([+-]?\d+)?\s*:\s*([+-]?\d+)?\s*(?::\s*([+-]?\d+)?\s*)?")


def open_source(
    source: str,
    *,
    spacing_m: float = 1.0,
    undistortion: Path | None = None,
    rotate: int | None = None,
    time_offset_s: float = 0.0,
    every_s: float | None = None,
    every_m: float | None = None,
    reverse: bool = False,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Recording:
    """Open a recording.

    Args:
        source: SOURCE, see the top of this module.
        spacing_m: Metres between frames where the recording states no positions.
        undistortion: NCLT's table, or the folder of them.
        rotate: Degrees clockwise, 0, 90, 180 or 270, by which images are turned; None: NCLT's upright, others not.
        time_offset_s: Added to the images' times before they are looked up on a track.
        every_s: Take one frame every so many seconds.
        every_m: Take one frame every so many metres.
        reverse: Take the frames in the other order.
        on_progress: Called with the share that is read, where opening takes long.

    Raises:
        SourceError: There is no such recording, it makes no sense, or positions fall along the drive.
        InvalidArgumentError: An option does not go with a recording of this kind.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise SourceError(f"a spacing of {spacing_m} m: frames must be more than 0 m apart")
    if not abs(time_offset_s) < MOST_OFFSET_S:
        raise InvalidArgumentError(f"a time offset of {time_offset_s} s: clocks are not so far apart")
    if rotate is not None and rotate not in TURNS:
        raise SourceError(f"images cannot be turned by {rotate} degrees: give 0, 90, 180 or 270")
    place, part = split_slice(source)
    options = _Options(spacing_m, undistortion, rotate, round(time_offset_s * 1e6), on_progress)
    recording = _open_whole(place, options)
    recording = dataclasses.replace(recording, name=text_of(recording.name))  # a file's may be none that can be written
    _check_options(recording, options)
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
class _Options:
    """The options of `open_source` that readers take."""

    spacing_m: float
    undistortion: Path | None
    rotate: int | None
    time_offset_us: int
    on_progress: Callable[[float], None]


def _check_options(recording: Recording, options: _Options) -> None:
    """Raise InvalidArgumentError for an option that would change nothing in a recording of this kind."""
    is_nclt, is_set = isinstance(recording, NcltRecording), recording.tolerance_m is not None
    has_images = recording.encodings is None
    for option, is_asked, fits in (
        ("--undistortion", options.undistortion is not None, is_nclt),
        ("--rotate", bool(options.rotate), has_images),
        ("--time-offset-s", options.time_offset_us != 0, has_images and not is_nclt and not is_set),
    ):
        if is_asked and not fits:
            raise InvalidArgumentError(f"{option} does not go with a recording such as {recording.name}: leave it out")


def split_slice(source: str) -> tuple[str, slice | None]:
    """Split SOURCE into the recording and the slice of its frames; a `#` in a file's own name does no harm.

    Raises SourceError (the text behind the `#` is neither a slice nor part of a file's name).
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


def _open_whole(place: str, options: _Options) -> Recording:
    if place.startswith(NCLT_PREFIX):
        drive = Path(place.removeprefix(NCLT_PREFIX)).expanduser()
        if not drive.name or drive.name == "..":
            raise SourceError(f"{place}: expected nclt:ROOT/DATE, for example nclt:/data/nclt/2012-01-22")
        return read_nclt(drive.parent, drive.name, undistortion=options.undistortion, rotate=options.rotate)
    if (benchmark := open_benchmark(place, options.spacing_m, options.rotate or 0)) is not None:
        return benchmark
    bag, _, topics = place.partition("#")
    if _is_bag(bag):
        bag_path = Path(bag.removeprefix(BAG_PREFIX)).expanduser()
        if not bag_path.exists():
            raise SourceError(f"no bag at {bag_path}")
        return read_bag(
            bag_path, topics, options.spacing_m, options.rotate or 0, options.time_offset_us, options.on_progress
        )
    path = Path(place).expanduser()
    if not place or not path.exists():
        raise SourceError(
            f"no recording at {place!r}: expected nclt:ROOT/DATE, a folder of images, rosbag:FILE, a video, or "
            "encodings in a .npy or .csv"
        )
    if path.is_dir():
        recording = _nclt_camera(path, options) or open_recognised(path, options.spacing_m, options.rotate or 0)
        return recording or read_folder(
            path, options.spacing_m, options.rotate, options.time_offset_us, options.on_progress
        )
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return read_video(path, options.spacing_m, options.rotate or 0, options.time_offset_us, options.on_progress)
    if path.suffix.lower() in ENCODING_SUFFIXES:
        return _read_encodings(path, options.spacing_m)
    raise SourceError(
        f"{path}: expected a video ({', '.join(sorted(VIDEO_SUFFIXES))}) or ready encodings [n, d] in a .npy or .csv; "
        "images are named by their folder"
    )


def _is_bag(place: str) -> bool:
    path = Path(place)
    return place.startswith(BAG_PREFIX) or path.suffix.lower() in BAG_SUFFIXES or (path / METADATA).is_file()


def _nclt_camera(folder: Path, options: _Options) -> Recording | None:
    """The recording of a camera's folder in NCLT's layout (ROOT/DATE/lb3/Cam5); None: it is none, or has no poses.

    Raises SourceError (it cannot be read).
    """
    drive = folder.resolve().parent.parent
    camera = re.fullmatch(r"Cam([0-5]).*", folder.resolve().name)
    if camera is None or not folder.resolve().parent.name.startswith("lb3") or positions_file(folder):
        return None
    root = drive.parent.parent if drive.parent.name == "images" else drive.parent
    if not any(path.is_file() for path in ground_truth_files(root, drive.name)):
        return None
    arguments: dict[str, Any] = {"undistortion": options.undistortion, "rotate": options.rotate, "folder": folder}
    recording = read_nclt(root, drive.name, camera=int(camera[1]), **arguments)
    turn = "upright" if options.rotate is None else f"turned by {options.rotate} degrees"
    remark = f"NCLT's layout: read as {NCLT_PREFIX}{root / drive.name}, camera {camera[1]}, {turn}"
    return dataclasses.replace(recording, remarks=[remark, *recording.remarks])


def _read_encodings(path: Path, spacing_m: float) -> Recording:
    """Read a file of ready encodings [n, d]; row i is `i * spacing_m` metres along the route.

    A csv is numbers between commas, semicolons (then with decimal commas too), tabs or blanks; one line of words at its
    top is taken for a header. Raises SourceError (not a table of finite numbers).
    """
    try:
        raw = _read_npy(path) if path.suffix.lower() == ".npy" else _read_csv(path)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
    if raw.ndim != 2 or 0 in raw.shape:
        raise SourceError(f"{path}: encodings are [n, d], one row for each frame; this is {list(raw.shape)}")
    if raw.dtype.kind not in "fiu":
        raise SourceError(f"{path}: encodings are real numbers, not {raw.dtype}")
    with np.errstate(over="ignore"):  # what does not fit float32 becomes infinite and is named below
        encodings = np.ascontiguousarray(raw, dtype=np.float32)
    broken_rows = np.flatnonzero(~np.isfinite(encodings).all(axis=1))
    if len(broken_rows):
        raise SourceError(
            f"{path}: {len(broken_rows)} rows hold NaN, infinity or values beyond float32, the first is row "
            f"{broken_rows[0]} (from 0)"
        )
    frames = tuple(Frame(row, f"{path.stem}[{row}]", row * spacing_m) for row in range(len(encodings)))
    return Recording(path.stem, frames, encodings=encodings)


def _read_npy(path: Path) -> NDArray[np.generic]:
    try:
        with path.open("rb") as file:  # opened here, because numpy leaves a file open that turns out to be damaged
            raw = np.load(file, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SourceError(f"{path} is not a .npy of numbers: {error}") from error
    if not isinstance(raw, np.ndarray):
        raw.close()
        raise SourceError(f"{path} is an npz archive named .npy: save the one array with numpy.save")
    return raw


def _read_csv(path: Path) -> NDArray[np.generic]:
    """Read a csv line by line, so that errors name the line."""
    rows: list[NDArray[np.float64]] = []
    try:
        lines = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not text: {error}") from error
    filled_lines = [(number, line) for number, line in lines if line.strip()]
    for number, line in filled_lines:
        separator = next((mark for mark in ";\t," if mark in line), None)  # None: blanks
        cells = line.split(separator) if separator == "," else line.replace(",", ".").split(separator)
        try:
            row = np.array(cells, dtype=np.float64)
        except ValueError as error:
            if number == filled_lines[0][0] and all(finite_number(cell) is None for cell in cells):
                continue  # a header
            raise SourceError(f"{path}, line {number}: {error}") from error
        if rows and len(row) != len(rows[0]):
            raise SourceError(f"{path}, line {number}: {len(row)} values where the lines before have {len(rows[0])}")
        rows.append(row)
    if not rows:
        raise SourceError(f"{path} holds no encodings: expected one line of numbers for each frame")
    return np.stack(rows)


EARLY_SHARE = 0.02  # of a step, by which a frame may come before it is due
FEWEST_OF_A_TURN, NEAR_START_M = 10, 1.0
FEWEST_OF_A_KIND = 3  # frames whose names are of one kind
LONGEST_PAUSE_S, SAME_PLACE_M = 3600.0, 10.0  # of one drive, unless the robot goes on where it stood


def thinned(recording: Recording, every_s: float | None, every_m: float | None) -> Recording:
    """The first frame of every so many seconds or metres, with indices from 0; with neither, the recording as it is.

    Raises SourceError (both are given, one is not above 0, or the frames have no times).
    """
    every = every_s if every_m is None else every_m
    if every is None:
        return recording
    if (every_s is not None and every_m is not None) or not (math.isfinite(every) and every > 0):
        raise SourceError("frames are taken every so many seconds (--every-s) or metres (--every-m), above 0")
    progress = [frame.position_m if every_m else (frame.timestamp_us or 0) / 1e6 for frame in recording.frames]
    if every_s is not None and any(frame.timestamp_us is None for frame in recording.frames):
        raise SourceError(
            f"{recording.name} does not say when its frames were taken: --every-m goes by their positions"
        )
    steps = np.floor((np.array(progress) - progress[0]) / every + EARLY_SHARE)  # so that a jittery clock skips no frame
    rows = np.flatnonzero(np.diff(steps, prepend=np.nan) != 0)
    frames = tuple(dataclasses.replace(recording.frames[row], index=index) for index, row in enumerate(rows.tolist()))
    encodings = None if recording.encodings is None else recording.encodings[rows]
    return dataclasses.replace(recording, frames=frames, encodings=encodings, n_before_slice=recording.n_whole)


def one_turn(recording: Recording) -> Recording:
    """A drive along a closed route without the frames after it reached its start again.

    It does so at x, y within two median steps of the first frame, in its direction. A drive without x, y stays.
    """
    places = [(frame.x_m, frame.y_m) for frame in recording.frames if frame.x_m is not None and frame.y_m is not None]
    if len(places) < max(len(recording.frames), FEWEST_OF_A_TURN):
        return recording
    x_m, y_m = np.array(places, np.float64).T
    steps = np.hypot(np.diff(x_m), np.diff(y_m))
    near_m = max(NEAR_START_M, 2 * float(np.median(steps[steps > 0]))) if (steps > 0).any() else NEAR_START_M
    away_m = np.hypot(x_m - x_m[0], y_m - y_m[0])
    left_row = int(np.argmax(away_m > 3 * near_m))
    ahead_x, ahead_y = x_m[left_row] - x_m[0], y_m[left_row] - y_m[0]
    onwards = np.gradient(x_m) * ahead_x + np.gradient(y_m) * ahead_y >= 0
    return_rows = np.flatnonzero((np.arange(len(x_m)) > left_row) & (away_m <= near_m) & onwards)
    if not left_row or not len(return_rows):
        return recording
    visit = return_rows[: int(np.argmax(np.diff(return_rows, append=len(x_m) + 2) > 1)) + 1]
    end = int(visit[np.argmin(away_m[visit])]) + 1
    if end == len(recording.frames):
        return recording
    remark = (
        f"the start is reached again at {recording.frames[end - 1].name}: {len(recording.frames) - end} frames of a "
        "second turn are not used"
    )
    return dataclasses.replace(recording.sliced(slice(0, end)), remarks=[*recording.remarks, remark])


def turned_back(recording: Recording) -> Recording:
    """The frames in reverse order: positions that fell now rise; those that rose count from the other end."""
    first_m, last_m = recording.frames[0].position_m, recording.frames[-1].position_m
    frames = tuple(
        dataclasses.replace(
            frame, index=index, position_m=last_m - frame.position_m if last_m >= first_m else frame.position_m
        )
        for index, frame in enumerate(recording.frames[::-1])
    )
    encodings = None if recording.encodings is None else np.ascontiguousarray(recording.encodings[::-1])
    return dataclasses.replace(recording, frames=frames, encodings=encodings)


def _check_names(recording: Recording) -> None:
    """Refuse frames placed evenly in the order of names that are of two kinds, one after the other or by turns."""
    frames = recording.frames
    metres = np.array([frame.position_m for frame in frames]) - frames[0].position_m
    steps = np.array([frame.index for frame in frames]) - frames[0].index
    if len(frames) < 2 or frames[0].x_m is not None:
        return
    if not np.allclose(metres, steps * (metres[-1] / max(1, steps[-1]))):
        return
    names = [frame.name for frame in frames]
    kinds = [re.sub(r"[0-9]+(?:[.,][0-9]+)*", "0", name) for name in names]
    changes = np.flatnonzero([left != right for left, right in pairwise(kinds)]) + 1
    if 2 * len(changes) >= len(frames) and min(Counter(kinds).values()) >= FEWEST_OF_A_KIND:
        row = int(changes[0])
        raise SourceError(
            f"{recording.name}: {frames[row - 1].name} and {frames[row].name} are names of several kinds by "
            "turns: are these several drives or cameras? Move each into a folder of its own, or say in a positions.csv "
            "where each image was taken"
        )
    if frames[0].timestamp_us is not None:  # times show several drives by themselves
        return
    if len(set(kinds)) == 1 and dates_in(names) is None:
        changes = np.array(counted_anew(names), np.intp)
    ends = [0, *changes.tolist(), len(frames)]
    if len(changes) and min(np.diff(ends)) >= FEWEST_OF_A_KIND and len(set(kinds)) in {1, len(changes) + 1}:
        last, first = frames[ends[1] - 1], frames[ends[1]]
        trouble = "count anew" if len(set(kinds)) == 1 else "are names of two kinds"
        raise SourceError(
            f"{recording.name}: {last.name} and {first.name} {trouble}: are these several drives? Name "
            f"one of them by a slice (#:{first.index} or #{first.index}:), move them apart, or say in a positions.csv "
            "where each image was taken"
        )


def check_one_drive(recording: Recording) -> None:
    """Raise SourceError for a recording of several drives at several places, the ways between which are unknown."""
    _check_names(recording)
    frames = [frame for frame in recording.frames if frame.timestamp_us is not None]
    times = [frame.timestamp_us / 1e6 for frame in frames if frame.timestamp_us is not None]
    if not frames and (dates := dates_in([frame.name for frame in recording.frames])) is not None:
        frames, times = list(recording.frames), [date.timestamp() for date in dates]
    if len(times) < 3:
        return
    pauses_s = np.abs(np.diff(times))
    longest = int(np.argmax(pauses_s))
    if pauses_s[longest] < max(LONGEST_PAUSE_S, 100 * float(np.median(pauses_s))):
        return
    last, first = frames[longest : longest + 2]
    if None not in (last.x_m, last.y_m, first.x_m, first.y_m):
        apart_m = math.dist((last.x_m or 0, last.y_m or 0), (first.x_m or 0, first.y_m or 0))
        if apart_m <= SAME_PLACE_M:
            return
    raise SourceError(
        f"{recording.name}: between {last.name} and {first.name} pass {pauses_s[longest] / 3600:.1f} hours: these "
        f"are several drives. Name one of them by a slice (#:{first.index} or #{first.index}:), or move them apart"
    )
