"""Folders of images in the order of their names, placed by a `positions.csv` beside them."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import (
    IMAGE_SUFFIXES,
    EncodedImage,
    Frame,
    Recording,
    read_file,
    ready,
    stamp_of,
)
from deepsimbad_client.recordings.names import in_order, times_of
from deepsimbad_client.recordings.nclt import TURNED_UPRIGHT, UPRIGHT_TURN, lies_on_its_side
from deepsimbad_client.recordings.placing import placed
from deepsimbad_client.recordings.positions import POSITIONS_FILE, read_positions


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
        return ready(read_file(path), path, input_size, self.rotate)


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


def read_folder(folder: Path, spacing_m: float, rotate: int | None = None, time_offset_us: int = 0) -> FolderRecording:
    """Open a folder of images; without a positions.csv frame i is `i * spacing_m` metres along the route.

    `rotate` turns the images clockwise by so many degrees; None: NCLT's images upright, others not at all.
    `time_offset_us` is added to the times that names tell.
    Raises SourceError: no images, or a positions.csv that cannot be understood; the message names the line.
    """
    try:
        paths = [path for path in folder.iterdir() if path.name[0] != "." and not path.is_dir()]
        names = in_order([path.name for path in paths if path.suffix.lower() in IMAGE_SUFFIXES])
    except OSError as error:
        raise SourceError(f"cannot read the folder {folder}: {error.strerror or error}") from error
    if not names:
        hint = f"; for NCLT write nclt:{folder}" if (folder / "lb3").is_dir() else ""
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){hint}")
    name, path = folder.resolve().name, folder / POSITIONS_FILE
    told_us: Sequence[int | None] = times_of(names) or [None] * len(names)
    times_us = [None if time is None else time + time_offset_us for time in told_us]
    if not path.is_file():
        frames = tuple(
            Frame(i, file, i * spacing_m, timestamp_us=time_us)
            for i, (file, time_us) in enumerate(zip(names, times_us, strict=True))
        )
        return _upright(FolderRecording(name=name, folder=folder, frames=frames), rotate)
    table = read_positions(path, names, times_us)
    result = placed(table.frames, str(path))
    recording = FolderRecording(
        name=name,
        folder=folder,
        frames=tuple(result.frames),
        left_out_names=table.left_out_names | result.left_out_names,
        remarks=[*table.remarks, *result.remarks],
    )
    return _upright(recording, rotate)
