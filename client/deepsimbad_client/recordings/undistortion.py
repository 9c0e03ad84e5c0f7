"""Undistortion of the Ladybug3's cameras with the dataset's own look-up tables (`U2D_Cam<k>_1616X1232.txt`).

A table is text: a header line with `width,height` somewhere in it, then `row col v u` for every pixel of the
undistorted image, saying where in the stored one to look. Two million such lines are parsed once and kept as npz
in the user's cache folder.
"""

import hashlib
import logging
import os
import re
import tempfile
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.images import Image

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class UndistortionMap:
    """Where each pixel of the undistorted image lies in the stored one.

    Attributes:
        u: [height, width] float32, column in the stored image.
        v: [height, width] float32, row in the stored image.
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the images it is for, as stored."""
        return self.u.shape[1], self.u.shape[0]

    def apply(self, stored: Image) -> Image:
        """Undistort an image in its stored orientation; what the camera did not see becomes black."""
        return np.asarray(cv2.remap(stored, self.u, self.v, cv2.INTER_LINEAR), dtype=np.uint8)


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

    Args:
        path: The text file.
        cache_dir: Where parsed tables are kept; None: `deep-simbad` in the user's cache folder
            ($XDG_CACHE_HOME, else ~/.cache). A cache that cannot be written is done without.

    Raises:
        SourceError: The file cannot be read or is not a complete table.
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
