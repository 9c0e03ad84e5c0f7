"""Folders of images in the order of their names, placed by a `positions.csv` beside them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from deepsimbad_client.errors import SourceError
from deepsimbad_client.http import media_type_of
from deepsimbad_client.recordings import (
    IMAGE_SUFFIXES,
    EncodedImage,
    Frame,
    Recording,
    as_jpeg,
    decode,
    is_larger,
    read_file,
    stamp_of,
)
from deepsimbad_client.recordings.names import in_order, times_of
from deepsimbad_client.recordings.placing import placed
from deepsimbad_client.recordings.positions import POSITIONS_FILE, read_positions


@dataclass(frozen=True, eq=False, kw_only=True)
class FolderRecording(Recording):
    """The images of a folder in name order."""

    folder: Path

    def stamp(self, frame: Frame) -> str:
        """Of its file; see `Recording.stamp`."""
        return stamp_of(self.folder / frame.name)

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame: a file no larger than asked goes as it is, a larger one as JPEG.

        A format that cannot be posted (BMP, PGM, PPM) goes as PNG.
        """
        path = self.folder / frame.name
        body = read_file(path)
        image = decode(body, path)
        if is_larger(image, input_size):
            return as_jpeg(image, input_size)
        media_type = media_type_of(body)
        if media_type is None:
            return EncodedImage(cv2.imencode(".png", image)[1].tobytes(), "image/png")
        return EncodedImage(body, media_type)


def read_folder(folder: Path, spacing_m: float) -> FolderRecording:
    """Open a folder of images; without a positions.csv frame i is `i * spacing_m` metres along the route.

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
    times_us: Sequence[int | None] = times_of(names) or [None] * len(names)
    if not path.is_file():
        frames = tuple(
            Frame(i, file, i * spacing_m, timestamp_us=time_us)
            for i, (file, time_us) in enumerate(zip(names, times_us, strict=True))
        )
        return FolderRecording(name=name, folder=folder, frames=frames)
    table = read_positions(path, names, times_us)
    result = placed(table.frames, str(path))
    return FolderRecording(
        name=name,
        folder=folder,
        frames=tuple(result.frames),
        left_out_names=table.left_out_names | result.left_out_names,
        remarks=[*table.remarks, *result.remarks],
    )
