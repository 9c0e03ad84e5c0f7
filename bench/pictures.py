"""The pictures of the README, from what `make demo` left.

python -m bench.pictures demo-output
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bench.recordings import RESULTS
from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_client.commands.demo import SEASONS
from deepsimbad_client.recordings.nclt import read_nclt

IMAGES = RESULTS.parent / "images"
_PLACES = (0.08, 0.25, 0.42, 0.58, 0.75, 0.92)  # shares of the route
_TILE, _GAP = (150, 150), 4


def contact_sheet(campus: Path) -> NDArray[np.uint8]:
    """[height, width, 3] BGR: one place a column, one season a row."""
    drives = [read_nclt(campus, PAPER_DATES[season]) for season in SEASONS]
    furthest_m = min(drive.frames[-1].position_m for drive in drives)
    rows = []
    for drive in drives:
        tiles = []
        for share in _PLACES:
            frame = min(drive.frames, key=lambda frame: abs(frame.position_m - share * furthest_m))
            tile = cv2.resize(_middle(drive.upright(frame)), _TILE, interpolation=cv2.INTER_AREA)
            tiles.append(np.asarray(tile, np.uint8))
        rows.append(_joined(tiles, axis=1))
    return _joined(rows, axis=0)


def _middle(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The square in the middle of an upright picture."""
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return image[top : top + side, left : left + side]


def _joined(parts: list[NDArray[np.uint8]], axis: int) -> NDArray[np.uint8]:
    """Pictures beside or below each other with a white gap."""
    shape = list(parts[0].shape)
    shape[axis] = _GAP
    gap = np.full(shape, 255, np.uint8)
    spaced = [piece for part in parts for piece in (part, gap)][:-1]
    return np.concatenate(spaced, axis=axis)


def save(picture: Image.Image, path: Path) -> None:
    """Write a small PNG: 128 colours are enough for a page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Write `docs/images/campus.png` and `docs/images/belief.png`."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-output")
    save(Image.fromarray(contact_sheet(folder / "campus")[..., ::-1].copy()), IMAGES / "campus.png")
    with Image.open(folder / "replays" / "calibrated" / "belief_along_drive.png") as belief:
        belief.thumbnail((820, 820), Image.Resampling.LANCZOS)
        save(belief, IMAGES / "belief.png")


if __name__ == "__main__":
    main()
