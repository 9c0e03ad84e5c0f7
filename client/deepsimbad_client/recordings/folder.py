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
    first_names,
    read_file,
    ready,
    require_heic,
    spread,
    with_grey_levels,
)
from deepsimbad_client.recordings.annotations import CAPTIONS
from deepsimbad_client.recordings.gps import GPS_DEADBAND_M, TRACK_SUFFIXES, read_exif, read_track, utm, zone_remarks
from deepsimbad_client.recordings.names import in_order, times_of
from deepsimbad_client.recordings.nclt import TURNED_UPRIGHT, drives_in, lies_on_its_side
from deepsimbad_client.recordings.placing import UNPLACED, Placement, place_frames, place_on_track
from deepsimbad_client.recordings.positions import POSITIONS_FILE, positions_file, read_positions

_ORIENTATION, _MODEL = 0x0112, 0x0110  # of EXIF
_LYING = range(5, 9)  # orientations in which width is height
_MOST_SHAPES = 4  # that a remark names
_TABLE = re.compile(r".*\.(csv|tsv|xlsx|ods|kml|kmz|fit|tcx)|.*(pos|gps|nmea|track).*\.(txt|json|log)")


@dataclass(frozen=True, eq=False, kw_only=True)
class FolderRecording(Recording):
    """The images of a folder in name order."""

    folder: Path
    rotate: int = 0  # degrees clockwise by which images are turned

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame; see `Recording.image`."""
        path = self.folder / frame.name
        return ready(read_file(path), path, input_size, self.rotate, self.grey_levels)


def single(path: Path, rotate: int | None = None) -> FolderRecording:
    """One image file as a recording, turned as `read_folder` would turn it."""
    return _upright(FolderRecording(path.parent.name, (Frame(0, path.name, 0.0),), folder=path.parent), rotate)


def _upright(recording: FolderRecording, rotate: int | None) -> FolderRecording:
    """The recording turned by `rotate`; None: NCLT's images upright, with a remark, others as they are."""
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
    many degrees; None: NCLT's images upright, others not at all. `time_offset_us` is added to the times in names or
    EXIF. Raises SourceError (no images, or positions that cannot be understood; the message names the line).
    """
    try:
        paths = [path for path in folder.iterdir() if path.name[0] != "." and not path.is_dir()]
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    names = in_order([path.name for path in paths if path.suffix.lower() in IMAGE_SUFFIXES])
    unread_names = in_order([path.name for path in paths if path.suffix.lower() in OTHER_SUFFIXES])
    if not names:
        raise SourceError(
            f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){_hint(folder, unread_names)}"
        )
    if any(Path(name).suffix.lower() in HEIC_SUFFIXES for name in names):
        require_heic()
    name_times_us: Sequence[int | None] = times_of(names) or [None] * len(names)
    times_us = [None if time is None else time + time_offset_us for time in name_times_us]
    tracks = sorted(path for path in paths if path.suffix.lower() in TRACK_SUFFIXES)
    table = positions_file(folder)
    if table is not None:
        placement = read_positions(table, names, times_us)
        placement.follow(place_frames(placement.frames, str(table), placement.deadband_m))
    elif tracks:
        placement = _on_track(tracks, names, times_us, folder, time_offset_us)
    elif any(math.isfinite(read_exif(folder / names[row]).latitude) for row in spread(len(names))):
        placement = _by_exif(names, times_us, folder, time_offset_us, on_progress)
    else:
        frames = zip(names, times_us, strict=True)
        placement = Placement(
            [Frame(i, name, i * spacing_m, timestamp_us=time) for i, (name, time) in enumerate(frames)]
        )
        placement.remarks.append(
            f"{len(names)} images are taken {spacing_m:g} m apart: there is no {POSITIONS_FILE} and no track (.gpx, "
            f".nmea) beside them, and no EXIF among them says a place{_unread_tables_text(paths)}"
        )
    if inner := _inner(folder):
        placement.remarks.append(
            f"folders inside are not looked at, and {first_names([path.name for path in inner])} holds images"
        )
    if unread_names:
        placement.left_out_names["of a format that is not read: convert to PNG"] = unread_names
    recording = FolderRecording(
        folder.resolve().name,
        tuple(placement.frames),
        placement.left_out_names,
        remarks=placement.remarks,
        folder=folder,
    )
    return _prepare(recording, rotate)


def _unread_tables_text(paths: Sequence[Path]) -> str:
    """Words for files that may hold positions and are not read; "" where there are none."""
    names = sorted(path.name for path in paths if _TABLE.fullmatch(path.name.lower()) and path.name != CAPTIONS)
    return (
        f" ({first_names(names)} is not read: it must be called {POSITIONS_FILE}, or be a .gpx or .nmea)"
        if names
        else ""
    )


def _hint(folder: Path, unread_names: Sequence[str]) -> str:
    """Words for what to do where a folder holds no images that are read."""
    if (folder / "lb3").is_dir():
        return f"; for NCLT write nclt:{folder}"
    if unread_names:
        return f"; {unread_names[0]} is of a format that is not read: convert it to PNG"
    return next((f"; {path} does" for path in _inner(folder)), drives_in(folder))


def _inner(folder: Path) -> list[Path]:
    """Folders inside that hold images."""
    return sorted({file.parent for file in folder.glob("[!.]*/*") if file.suffix.lower() in IMAGE_SUFFIXES})


def _prepare(recording: FolderRecording, rotate: int | None) -> FolderRecording:
    """The recording turned by `rotate` and shown by the grey levels of its images, with remarks on these and shapes."""
    paths = [recording.folder / frame.name for frame in recording.frames]
    recording = dataclasses.replace(
        recording, remarks=[*recording.remarks, *shape_remarks((path.name, shape_in(path)) for path in paths)]
    )
    recording = with_grey_levels(recording, lambda row: decode_deep(read_file(paths[row]), paths[row]))
    return _upright(recording, rotate)


def _on_track(
    tracks: Sequence[Path], names: Sequence[str], times_us: Sequence[int | None], folder: Path, time_offset_us: int
) -> Placement:
    if len(tracks) > 1:
        raise SourceError(f"{folder} holds several tracks ({', '.join(path.name for path in tracks)}): leave one")
    remarks = [f"placed by {tracks[0].name}"]
    if None in times_us:
        fixes = [read_exif(folder / name) for name in names]
        times_us = [None if fix.time_us is None else fix.time_us + time_offset_us for fix in fixes]
        if not all(fix.in_zone for fix in fixes if fix.time_us is not None):
            remarks.append("EXIF says times without a zone, read as UTC: --time-offset-s corrects them")
    images = [(name, time) for name, time in zip(names, times_us, strict=True) if time is not None]
    if not images:
        raise SourceError(f"{folder}: no image tells its time, by name or EXIF, so {tracks[0].name} cannot place it")
    placement = place_on_track(read_track(tracks[0]), images, str(tracks[0]), "the track")
    timeless_names = [name for name, time in zip(names, times_us, strict=True) if time is None]
    if timeless_names:
        placement.left_out_names["without a time"] = timeless_names
    placement.remarks = remarks + placement.remarks
    return placement


def _by_exif(
    names: Sequence[str],
    times_us: Sequence[int | None],
    folder: Path,
    time_offset_us: int,
    on_progress: Callable[[float], None],
) -> Placement:
    fixes = []
    for row, name in enumerate(names):
        fixes.append(read_exif(folder / name))
        on_progress((row + 1) / len(names))
    degrees = np.array([(fix.latitude, fix.longitude) for fix in fixes], np.float64).T
    x_m, y_m = utm(*degrees)
    frames = []
    for name, fix, name_time_us, x, y in zip(names, fixes, times_us, x_m.tolist(), y_m.tolist(), strict=True):
        exif_us = None if fix.time_us is None else fix.time_us + time_offset_us
        place = (None, None) if math.isnan(x) else (x, y)
        frames.append(Frame(0, name, UNPLACED, exif_us if name_time_us is None else name_time_us, *place))
    placement = place_frames(frames, str(folder), GPS_DEADBAND_M)
    placement.remarks = ["placed by the EXIF of the images", *zone_remarks(*degrees), *placement.remarks]
    return placement


def shape_remarks(shapes: Iterable[tuple[str, str | None]]) -> list[str]:
    """A remark that counts images by size and camera, the most frequent first; empty where all are of one kind.

    `shapes` holds each image's name and what `shape_in` returns for it; None is not counted.
    """
    names: dict[str, list[str]] = {}
    for name, shape in shapes:
        if shape is not None:
            names.setdefault(shape, []).append(name)
    if len(names) < 2:
        return []
    most_first = sorted(names.items(), key=lambda item: -len(item[1]))
    counts = [
        f"{len(image_names)} of {shape} ({first_names(image_names)})"
        for shape, image_names in most_first[:_MOST_SHAPES]
    ]
    n_others = sum(len(image_names) for _, image_names in most_first[_MOST_SHAPES:])
    counts += [f"{n_others} of others"] if n_others else []
    return [f"the images are not of one kind: {', '.join(counts)}; those of several cameras compare badly"]


def shape_in(file: Path | BytesIO) -> str | None:
    """Width, height and camera in words, by the header of a picture; None where it cannot be read here."""
    try:
        with Pictures.open(file) as picture:
            (width, height), exif = picture.size, picture.getexif()
    except (OSError, ValueError, SyntaxError, Pictures.DecompressionBombError):
        return None
    if exif.get(_ORIENTATION) in _LYING:
        width, height = height, width
    camera = str(exif.get(_MODEL, "")).strip(" \0")
    return f"{width} x {height}" + (f" by {camera}" if camera else "")
