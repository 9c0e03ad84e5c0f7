"""SOURCE: the one way to name a recording on a command line.

    nclt:ROOT/DATE        one date of the NCLT dataset (`nclt`)
    FOLDER                images in name order, with an optional positions.csv (`folder`)
    FILE.npy, FILE.csv    ready encodings [n, d] (`encodings`)

Each may end in #START:STOP or #START:STOP:STEP, Python's slice of its frames, which keep their places and positions.
"""

import math
import re
from pathlib import Path

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.encodings import SUFFIXES, read_encodings
from deepsimbad_client.recordings.folder import read_folder
from deepsimbad_client.recordings.nclt import FRONT_CAMERA, read_nclt
from deepsimbad_client.recordings.recording import Recording

NCLT_PREFIX = "nclt:"

_SLICE = re.compile(r"\s*([+-]?\d+)?\s*:\s*([+-]?\d+)?\s*(?::\s*([+-]?\d+)?\s*)?")


def open_source(
    source: str, *, spacing_m: float = 1.0, camera: int = FRONT_CAMERA, undistortion: Path | None = None
) -> Recording:
    """Open a recording.

    Args:
        source: See the top of this module.
        spacing_m: Metres between frames where the source does not say where they are.
        camera: NCLT's camera, 0..5.
        undistortion: NCLT's undistortion table or the folder of them; None: not undistorted.

    Raises:
        SourceError: There is no such recording, or it cannot be used; the message says why.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise SourceError(f"a spacing of {spacing_m} m: frames must be more than 0 m apart")
    place, part = split_slice(source)
    recording = _open_whole(place, spacing_m, camera, undistortion)
    return recording if part is None else recording.sliced(part)


def split_slice(source: str) -> tuple[str, slice | None]:
    """Split SOURCE into the recording and the slice of its frames.

    A `#` in a file's own name does no harm: only an ending shaped like a slice is taken for one, and one that is
    not, where no such file exists either, is an error rather than silently the whole recording.

    Raises:
        SourceError: What follows the `#` is neither.
    """
    place, mark, ending = source.rpartition("#")
    if not mark:
        return source, None
    match = _SLICE.fullmatch(ending)
    if match:
        return place, slice(*(None if number is None else int(number) for number in match.groups()))
    if Path(source.removeprefix(NCLT_PREFIX)).expanduser().exists():
        return source, None
    raise SourceError(f"{source}: a slice is #START:STOP or #START:STOP:STEP in whole frames, not #{ending}")


def _open_whole(place: str, spacing_m: float, camera: int, undistortion: Path | None) -> Recording:
    if place.startswith(NCLT_PREFIX):
        drive = Path(place.removeprefix(NCLT_PREFIX)).expanduser()
        if not drive.name or drive.name == "..":
            raise SourceError(f"{place}: expected nclt:ROOT/DATE, for example nclt:/data/nclt/2012-01-22")
        return read_nclt(drive.parent, drive.name, camera=camera, undistortion=undistortion)
    path = Path(place).expanduser()
    if not place or not path.exists():
        raise SourceError(
            f"no recording at {place!r}: expected nclt:ROOT/DATE, a folder of images, or encodings in a .npy or .csv"
        )
    if path.is_dir():
        return read_folder(path, spacing_m)
    if path.suffix.lower() in SUFFIXES:
        return read_encodings(path, spacing_m)
    raise SourceError(f"{path}: a file of ready encodings is a .npy or a .csv [n, d]; images are named by their folder")
