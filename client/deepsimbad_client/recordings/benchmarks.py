"""Public benchmark sets as downloaded: the frames' files, the places they were taken at, and when a match is true.

    nordland:ROOT/summer         a folder a season, frame i is frame i; ROOT/cleanImageNames.txt leaves out tunnels
    gardens_point:ROOT/day_left  likewise, Image000.jpg to Image199.jpg
    st_lucia:ROOT/190809_0845    webcam_video.avi with fGPS.txt, latitude,longitude a line, degrees south as positive
    msls:ROOT/train_val/cph/database   images/KEY.jpg with postprocessed.csv (easting, northing), seq_info.csv, raw.csv
    svox:ROOT/images/test/gallery      names @EAST@NORTH@...@.jpg, as the common downloader writes every set
    robotcar:ROOT/2014-12-09-13-21-02  stereo/centre/UTIME.png, a raw mosaic, with gps/ins.csv (northing, easting)

Except for the first two, a folder's layout shows its set and no prefix is needed. Formats:
gmberton/VPR-datasets-downloader, mapillary/mapillary_sls, ori-mrg/robotcar-dataset-sdk.
"""

import csv
import dataclasses
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import (
    IMAGE_SUFFIXES,
    EncodedImage,
    Frame,
    Recording,
    as_png,
    decode,
    finite_number,
    read_file,
    turned,
)
from deepsimbad_client.recordings.folder import FolderRecording
from deepsimbad_client.recordings.gps import GPS_DEADBAND_M, utm
from deepsimbad_client.recordings.names import in_order, times_of
from deepsimbad_client.recordings.placing import UNPLACED, place_frames, place_on_track
from deepsimbad_client.recordings.track import track_of
from deepsimbad_client.recordings.video import read_video

_CLEAN_NAMES, _VIDEO, _GPS, _PLACES = "cleanImageNames.txt", "webcam_video.avi", "fGPS.txt", "postprocessed.csv"
_UTM_NAME = re.compile(r"@\s*-?[0-9.]+\s*@\s*-?[0-9.]+\s*@.*")
_MOSAICS = {"stereo": cv2.COLOR_BayerGBRG2BGR, "mono": cv2.COLOR_BayerRGGB2BGR}  # by the camera's name
_PNG_COLOUR, _PNG_GREY = 25, 0  # place of the header's byte for colours, and its value for one channel


@dataclass(frozen=True)
class Benchmark:
    """A set, and the tolerance within which papers count a match as true."""

    title: str
    read: Callable[[Path, float], Recording | None]  # (folder, metres between frames); None: no drive of this set
    tolerance_m: float = 25.0
    tolerance_frames: int | None = None  # in place of metres, where frames alone are aligned

    def open(self, folder: Path, spacing_m: float, rotate: int = 0) -> Recording | None:
        """One drive, with a remark that names its set; None: the folder is no such drive."""
        recording = self.read(folder, spacing_m)
        if recording is None:
            return None
        if isinstance(recording, FolderRecording):
            recording = dataclasses.replace(recording, rotate=rotate)
        frames = self.tolerance_frames
        # Half a frame more, so that no rounding decides
        tolerance_m = self.tolerance_m if frames is None else (frames + 0.5) * spacing_m
        tolerance = f"{self.tolerance_m:g} m" if frames is None else f"{frames} frames"
        remark = (
            f"{self.title}: {len(recording.frames)} frames, true within {tolerance} unless --tolerance says otherwise"
        )
        return dataclasses.replace(recording, tolerance_m=tolerance_m, remarks=[*recording.remarks, remark])


def open_benchmark(place: str, spacing_m: float, rotate: int = 0) -> Recording | None:
    """The drive that a SOURCE with a set's prefix names; None: it has no such prefix. Raises SourceError."""
    name, colon, path = place.partition(":")
    if not colon or name not in BENCHMARKS:
        return None
    folder = Path(path).expanduser()
    if not folder.is_dir():
        raise SourceError(f"{place}: there is no folder {folder}")
    recording = BENCHMARKS[name].open(folder, spacing_m, rotate)
    # Whatever the set, the common downloader may have renamed its files
    recording = recording or BENCHMARKS["svox"].open(folder, spacing_m, rotate)
    if recording is None:
        raise SourceError(f"{folder} is not laid out as {BENCHMARKS[name].title} is: see docs/benchmarks.md")
    return recording


def open_recognised(folder: Path, spacing_m: float, rotate: int = 0) -> Recording | None:
    """The drive in a folder whose layout shows its set; None: it is no set's."""
    candidates = (benchmark for benchmark in BENCHMARKS.values() if benchmark.tolerance_frames is None)
    drives = (benchmark.open(folder, spacing_m, rotate) for benchmark in candidates)
    return next(filter(None, drives), None)


def _images(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    return in_order([path.name for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES])


def _by_numbers(folder: Path, spacing_m: float) -> Recording | None:
    """Frames placed by the numbers in their names, or by a list of clean names in or above their folder."""
    names, left_out = _images(folder), dict[str, list[str]]()
    lists = [place / _CLEAN_NAMES for place in (folder, folder.parent) if (place / _CLEAN_NAMES).is_file()]
    if lists:
        clean_names = in_order(
            [line.strip() for line in lists[0].read_text(encoding="utf-8").splitlines() if line.strip()]
        )
        number_of = {name: number for number, name in enumerate(clean_names)}
        left_out = {f"not in {_CLEAN_NAMES}": [name for name in names if name not in number_of]}
    else:
        digits = {name: re.findall(r"[0-9]+", Path(name).stem) for name in names}
        number_of = {name: int(numbers[-1]) for name, numbers in digits.items() if numbers}
        left_out = {"without a number": [name for name in names if name not in number_of]}
    usable_names = sorted((name for name in names if name in number_of), key=number_of.__getitem__)
    frames = [Frame(index, name, number_of[name] * spacing_m) for index, name in enumerate(usable_names)]
    return _folder_recording(folder, frames, left_out)


def _folder_recording(folder: Path, frames: Sequence[Frame], left_out: dict[str, list[str]]) -> FolderRecording | None:
    if not frames:
        return None
    left_out_names = {reason: names for reason, names in left_out.items() if names}
    return FolderRecording(folder.resolve().name, tuple(frames), left_out_names, folder=folder)


def _summed_up(
    folder: Path, places: Sequence[tuple[str, float, float]], left_out: dict[str, list[str]]
) -> Recording | None:
    """Images at (name, north, east), which need not be one drive: positions add up the ways between them."""
    if not places:
        return None
    plane = np.array([place[1:] for place in places], np.float64)
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(plane, axis=0).T))]).tolist()
    frames = [
        Frame(index, name, position_m, None, north, east)
        for index, ((name, north, east), position_m) in enumerate(zip(places, along_m, strict=True))
    ]
    return _folder_recording(folder, frames, left_out)


def _by_utm_names(folder: Path, _: float) -> Recording | None:
    names = _images(folder)
    if not names or not _UTM_NAME.fullmatch(names[len(names) // 2]):
        return None
    fields = {name: name.split("@") for name in names if _UTM_NAME.fullmatch(name)}
    # The image's id, the seventh field, orders a drive; east and north do not
    order = in_order([f"{parts[7] if len(parts) > 7 else ''}\n{name}" for name, parts in fields.items()])
    image_fields = [(name, fields[name]) for name in (key.partition("\n")[2] for key in order)]
    places = [(name, float(parts[2]), float(parts[1])) for name, parts in image_fields]
    return _summed_up(folder, places, {"whose name tells no place": [name for name in names if name not in fields]})


def _table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as text:
            return list(csv.DictReader(text))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"cannot read {path}: {error}") from error


def _msls(folder: Path, _: float) -> Recording | None:
    if not (folder / _PLACES).is_file() or not (folder / "images").is_dir():
        return None
    tables = {name: _table(folder / name) if (folder / name).is_file() else [] for name in ("seq_info.csv", "raw.csv")}
    panoramas = {row.get("key") for row in tables["raw.csv"] if row.get("pano") == "True"}
    try:
        place_of = {
            row["key"]: (row.get("sequence_key") or row.get("sequence_id") or "", int(row["frame_number"]))
            for row in tables["seq_info.csv"]
        }
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(
            f"{folder / 'seq_info.csv'}: the columns key and frame_number, a number, are needed"
        ) from error
    rows = _table(folder / _PLACES)
    if rows and not {"key", "easting", "northing"} <= rows[0].keys():
        raise SourceError(f"{folder / _PLACES}: the columns key, easting and northing are needed")
    rows.sort(key=lambda row: place_of.get(row["key"], ("", 0)))
    names = {Path(name).stem: name for name in _images(folder / "images")}
    left_out: dict[str, list[str]] = defaultdict(list)
    places = []
    for row in rows:
        north, east = finite_number(row["northing"] or ""), finite_number(row["easting"] or "")
        if row["key"] in panoramas:
            left_out["panorama"].append(row["key"])
        elif row["key"] not in names:
            left_out["in postprocessed.csv without an image"].append(row["key"])
        elif north is None or east is None:
            left_out["without a place"].append(row["key"])
        else:
            places.append((names[row["key"]], north, east))
    recording = _summed_up(folder / "images", places, left_out)
    return None if recording is None else dataclasses.replace(recording, name=f"{folder.parent.name}/{folder.name}")


def _st_lucia(folder: Path, spacing_m: float) -> Recording | None:
    if not (folder / _VIDEO).is_file() or not (folder / _GPS).is_file():
        return None
    video = read_video(folder / _VIDEO, spacing_m)
    lines = (folder / _GPS).read_text(encoding="utf-8").splitlines()
    fixes = [[finite_number(cell) for cell in line.split(",")[:2]] for line in lines]
    degrees = np.array([fix if len(fix) == 2 and None not in fix else (np.nan, np.nan) for fix in fixes], np.float64)
    north, east = utm(-np.abs(degrees[:, 0]), degrees[:, 1])  # Brisbane: the file leaves the sign out
    frame_places = zip(video.frames, north.tolist(), east.tolist(), strict=False)
    frames = [
        dataclasses.replace(frame, position_m=UNPLACED, x_m=x, y_m=y) for frame, x, y in frame_places if np.isfinite(x)
    ]
    placement = place_frames(frames, str(folder / _GPS), GPS_DEADBAND_M)
    return dataclasses.replace(
        video, name=folder.resolve().name, frames=tuple(placement.frames), left_out_names=placement.left_out_names,
        remarks=placement.remarks,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class MosaicRecording(FolderRecording):
    """Raw images of which every pixel holds one colour."""

    pattern: int  # OpenCV's code of the mosaic

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame in colours; see `Recording.image`."""
        path = self.folder / frame.name
        body = read_file(path)
        if body[_PNG_COLOUR : _PNG_COLOUR + 1] != bytes([_PNG_GREY]):
            return super().image(frame, input_size)  # it has been converted to colours already
        colours = np.asarray(cv2.cvtColor(decode(body, path)[..., 0], self.pattern), np.uint8)
        return as_png(turned(colours, self.rotate), input_size)


def _robotcar(folder: Path, _: float) -> Recording | None:
    folder, camera = (folder.parent.parent, folder) if (folder.parent.parent / "gps").is_dir() else (folder, None)
    poses, camera = folder / "gps" / "ins.csv", camera or folder / "stereo" / "centre"
    names = _images(camera)
    if not poses.is_file() or not names:
        return None
    times_us = times_of(names)
    if times_us is None:
        raise SourceError(f"{camera}: RobotCar's images are named by their time in microseconds")
    columns = ("timestamp", "northing", "easting", "yaw")
    rows = [[finite_number(row.get(column) or "") for column in columns] for row in _table(poses)]
    values = np.array(rows, np.float64).reshape(-1, len(columns)).T  # None becomes NaN
    track = track_of(*values)
    if track is None:
        raise SourceError(f"{poses}: fewer than two rows hold {', '.join(columns)}")
    placement = place_on_track(track, list(zip(names, times_us, strict=True)), str(poses))
    pattern = _MOSAICS["mono" if camera.name.startswith("mono") else "stereo"]
    name = folder.resolve().name
    return MosaicRecording(name, tuple(placement.frames), placement.left_out_names, folder=camera, pattern=pattern)


BENCHMARKS = {
    "nordland": Benchmark("Nordland", _by_numbers, tolerance_frames=10),
    "gardens_point": Benchmark("Gardens Point", _by_numbers, tolerance_frames=2),
    "st_lucia": Benchmark("St Lucia", _st_lucia),
    "msls": Benchmark("MSLS", _msls),
    "robotcar": Benchmark("RobotCar", _robotcar),
    "svox": Benchmark("names that tell UTM places", _by_utm_names),
}
