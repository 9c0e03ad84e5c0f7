"""Folders of images in the order of their names, placed by a `positions.csv`, a track, or EXIF."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image as Pictures

from deepsimbad.core.frames import UPRIGHT_TURN
from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import (
    HEIC_SUFFIXES,
    IMAGE_SUFFIXES,
    OTHER_SUFFIXES,
    EncodedImage,
    Frame,
    Recording,
    decode_deep,
    read_file,
    ready,
    require_heic,
    shown,
    spread,
    stamp_of,
    with_grey_levels,
)
from deepsimbad_client.recordings.annotations import CAPTIONS
from deepsimbad_client.recordings.gps import GPS_DEADBAND_M, TRACK_SUFFIXES, read_exif, read_track, utm, zone_remarks
from deepsimbad_client.recordings.names import in_order, times_of
from deepsimbad_client.recordings.nclt import TURNED_UPRIGHT, drives_in, lies_on_its_side
from deepsimbad_client.recordings.placing import UNPLACED, Placed, placed, placed_on
from deepsimbad_client.recordings.positions import POSITIONS_FILE, positions_file, read_positions

_ORIENTATION, _MODEL = 0x0112, 0x0110  # of EXIF
_LYING = range(5, 9)  # orientations in which width is height
_MOST_TOLD = 4
_TABLE = re.compile(r".*\.(csv|tsv|xlsx|ods|kml|kmz|fit|tcx)|.*(pos|gps|nmea|track).*\.(txt|json|log)")


@dataclass(frozen=True, eq=False, kw_only=True)
class FolderRecording(Recording):
    """The images of a folder in name order."""

    folder: Path
    rotate: int = 0  # degrees clockwise by which images are turned

    def stamp(self, frame: Frame) -> str:
        """Of its file; see `Recording.stamp`."""
        return stamp_of(self.folder / frame.name)

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame; see `Recording.image`."""
        path = self.folder / frame.name
        return ready(read_file(path), path, input_size, self.rotate, self.grey_levels)


def single(path: Path, rotate: int | None = None) -> FolderRecording:
    """One image file as a recording, turned as `read_folder` would turn it."""
    return _upright(FolderRecording(path.parent.name, (Frame(0, path.name, 0.0),), folder=path.parent), rotate)


def _upright(recording: FolderRecording, rotate: int | None) -> FolderRecording:
    """The recording turned as asked; where nothing is asked, NCLT's images upright, which is said."""
    if rotate is not None:
        return dataclasses.replace(recording, rotate=rotate)
    frames = recording.frames
    probes = {frames[place].name for place in (0, len(frames) // 2, len(frames) - 1)}
    if 2 * sum(lies_on_its_side(recording.folder / name) for name in probes) <= len(probes):
        return recording
    return dataclasses.replace(recording, rotate=UPRIGHT_TURN, remarks=[*recording.remarks, TURNED_UPRIGHT])


def read_folder(
    folder: Path,
    spacing_m: float,
    rotate: int | None = None,
    time_offset_us: int = 0,
    on_progress: Callable[[float], None] = lambda _: None,
) -> FolderRecording:
    """Open a folder of images, placed by a positions.csv in it, else a GPX or NMEA file, else their own EXIF.

    Without any of these frame i is `i * spacing_m` metres along the route. `rotate` turns the images clockwise by so
    many degrees; None: NCLT's images upright, others not at all. `time_offset_us` is added to the times that names or
    EXIF tell. Raises SourceError: no images, or positions that cannot be understood; the message names the line.
    """
    try:
        paths = [path for path in folder.iterdir() if path.name[0] != "." and not path.is_dir()]
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    names = in_order([path.name for path in paths if path.suffix.lower() in IMAGE_SUFFIXES])
    others = in_order([path.name for path in paths if path.suffix.lower() in OTHER_SUFFIXES])
    if not names:
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){_hint(folder, others)}")
    if any(Path(name).suffix.lower() in HEIC_SUFFIXES for name in names):
        require_heic()
    told_us: Sequence[int | None] = times_of(names) or [None] * len(names)
    times_us = [None if time is None else time + time_offset_us for time in told_us]
    tracks = sorted(path for path in paths if path.suffix.lower() in TRACK_SUFFIXES)
    table = positions_file(folder)
    if table is not None:
        result = read_positions(table, names, times_us)
        result.follow(placed(result.frames, str(table), result.deadband_m))
    elif tracks:
        result = _on_track(tracks, names, times_us, folder, time_offset_us)
    elif any(math.isfinite(read_exif(folder / names[at]).latitude) for at in spread(len(names))):
        result = _by_exif(names, times_us, folder, time_offset_us, on_progress)
    else:
        frames = zip(names, times_us, strict=True)
        result = Placed([Frame(i, name, i * spacing_m, timestamp_us=time) for i, (name, time) in enumerate(frames)])
        result.remarks.append(
            f"{len(names)} images are taken {spacing_m:g} m apart: there is no {POSITIONS_FILE} and no track (.gpx, "
            f".nmea) beside them, and no EXIF among them says a place{_misnamed(paths)}"
        )
    if inner := _inner(folder):
        result.remarks.append(
            f"folders inside are not looked at, and {shown([path.name for path in inner])} holds images"
        )
    if others:
        result.left_out_names["of a format that is not read: convert to PNG"] = others
    recording = FolderRecording(
        folder.resolve().name, tuple(result.frames), result.left_out_names, remarks=result.remarks, folder=folder
    )
    return _prepared(recording, rotate)


def _misnamed(paths: Sequence[Path]) -> str:
    """What is to be said of files that may tell positions and are not read."""
    names = sorted(path.name for path in paths if _TABLE.fullmatch(path.name.lower()) and path.name != CAPTIONS)
    return f" ({shown(names)} is not read: it must be called {POSITIONS_FILE}, or be a .gpx or .nmea)" if names else ""


def _hint(folder: Path, others: Sequence[str]) -> str:
    """What to do where a folder holds no images that are read."""
    if (folder / "lb3").is_dir():
        return f"; for NCLT write nclt:{folder}"
    if others:
        return f"; {others[0]} is of a format that is not read: convert it to PNG"
    return next((f"; {path} does" for path in _inner(folder)), drives_in(folder))


def _inner(folder: Path) -> list[Path]:
    """Folders inside that hold images."""
    return sorted({file.parent for file in folder.glob("[!.]*/*") if file.suffix.lower() in IMAGE_SUFFIXES})


def _prepared(recording: FolderRecording, rotate: int | None) -> FolderRecording:
    """The recording turned as asked and shown by the grey levels of its images; these and several shapes are told."""
    paths = [recording.folder / frame.name for frame in recording.frames]
    recording = dataclasses.replace(
        recording, remarks=[*recording.remarks, *shape_remarks((path.name, shape_in(path)) for path in paths)]
    )
    recording = with_grey_levels(recording, lambda at: decode_deep(read_file(paths[at]), paths[at]))
    return _upright(recording, rotate)


def _on_track(
    tracks: Sequence[Path], names: Sequence[str], times_us: Sequence[int | None], folder: Path, time_offset_us: int
) -> Placed:
    if len(tracks) > 1:
        raise SourceError(f"{folder} holds several tracks ({', '.join(path.name for path in tracks)}): leave one")
    remarks = [f"placed by {tracks[0].name}"]
    if None in times_us:
        taken = [read_exif(folder / name) for name in names]
        times_us = [None if one.time_us is None else one.time_us + time_offset_us for one in taken]
        if not all(one.in_zone for one in taken if one.time_us is not None):
            remarks.append("EXIF says times without a zone, read as UTC: --time-offset-s corrects them")
    images = [(name, time) for name, time in zip(names, times_us, strict=True) if time is not None]
    if not images:
        raise SourceError(f"{folder}: no image tells its time, by name or EXIF, so {tracks[0].name} cannot place it")
    result = placed_on(read_track(tracks[0]), images, str(tracks[0]), "the track")
    without = [name for name, time in zip(names, times_us, strict=True) if time is None]
    if without:
        result.left_out_names["without a time"] = without
    result.remarks = remarks + result.remarks
    return result


def _by_exif(
    names: Sequence[str],
    times_us: Sequence[int | None],
    folder: Path,
    time_offset_us: int,
    on_progress: Callable[[float], None],
) -> Placed:
    taken = []
    for at, name in enumerate(names):
        taken.append(read_exif(folder / name))
        on_progress((at + 1) / len(names))
    degrees = np.array([(one.latitude, one.longitude) for one in taken], np.float64).T
    x_m, y_m = utm(*degrees)
    frames = []
    for name, one, told_us, x, y in zip(names, taken, times_us, x_m.tolist(), y_m.tolist(), strict=True):
        exif_us = None if one.time_us is None else one.time_us + time_offset_us
        place = (None, None) if math.isnan(x) else (x, y)
        frames.append(Frame(0, name, UNPLACED, exif_us if told_us is None else told_us, *place))
    result = placed(frames, str(folder), GPS_DEADBAND_M)
    result.remarks = ["placed by the EXIF of the images", *zone_remarks(*degrees), *result.remarks]
    return result


def shape_remarks(shapes: Iterable[tuple[str, str | None]]) -> list[str]:
    """In a line, how many images are of which size and camera, those of most first; nothing where all are alike.

    Of each its name and what `shape_in` says; None is not counted.
    """
    names: dict[str, list[str]] = {}
    for name, shape in shapes:
        if shape is not None:
            names.setdefault(shape, []).append(name)
    if len(names) < 2:
        return []
    most_first = sorted(names.items(), key=lambda item: -len(item[1]))
    told = [f"{len(alike)} of {shape} ({shown(alike)})" for shape, alike in most_first[:_MOST_TOLD]]
    others = sum(len(alike) for _, alike in most_first[_MOST_TOLD:])
    told += [f"{others} of others"] if others else []
    return [f"the images are not of one kind: {', '.join(told)}; those of several cameras compare badly"]


def shape_in(file: Path | BytesIO) -> str | None:
    """Width, height and camera, by the header of a picture.

    None where it cannot be read here: it is broken, or of a format that says its size elsewhere.
    """
    try:
        with Pictures.open(file) as picture:
            (width, height), exif = picture.size, picture.getexif()
    except (OSError, ValueError, SyntaxError, Pictures.DecompressionBombError):
        return None
    if exif.get(_ORIENTATION) in _LYING:
        width, height = height, width
    camera = str(exif.get(_MODEL, "")).strip(" \0")
    return f"{width} x {height}" + (f" by {camera}" if camera else "")
