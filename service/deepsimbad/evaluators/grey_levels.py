"""Grey levels: what becomes black and what white of pictures of more than 8 bits a channel.

Cameras of 10, 12 and 14 bits fill the low bits of 16, thermal ones a few hundred counts somewhere in the middle: their
upper eight bits show nearly one grey. So levels are measured over a recording, kept with its traverse and its map, and
live views are shown by the same: docs/decisions/0025-grey-levels.md.
"""

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image, LandmarkModel

GreyLevels: TypeAlias = tuple[int, int]
"""The greatest number that is shown black and the least that is shown white, 0 <= black < white <= 65535."""

DEEPEST = 65535
_ARRAY = "grey_levels"  # in a landmark model: the levels by which the landmarks were shown
_USUAL_WHITES = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 16))
_OUTSIDE = 0.001  # share of the pixels at either end that may be a lamp or a broken pixel
_USED = 0.5  # share of a depth from which pictures are well exposed, and shown as a camera's own 8 bits would be
_MARGIN = 0.05  # of the range that is used, at either end, for other exposures
_LEAST_RANGE = 64  # counts: less is a sensor's noise, which no stretching turns into a picture
_CLIPPED = 0.2
CLIPPED = (
    "much of the picture is as bright as what the map shows white, or brighter: is it overexposed, or of another bit "
    "depth than the map's pictures?"
)
_FEW_GREYS = 8
FEW_GREYS = (
    f"the picture lies within {_FEW_GREYS} grey levels of 256: is it of a few bits in more, or badly exposed? "
    "Post the camera's full range"
)


def measured_levels(pictures: Iterable[NDArray[np.uint16]]) -> GreyLevels:
    """Levels that suit pictures [height, width, 3] uint16 of one camera.

    They are 0 and the end of the smallest usual depth that holds the pictures, or, where less than half of that depth
    is used, the ends of the range in use.
    """
    histogram = np.zeros(DEEPEST + 1, np.int64)
    for picture in pictures:
        histogram += np.bincount(picture[::2, ::2].ravel(), minlength=DEEPEST + 1)
    share = np.cumsum(histogram) / max(1, histogram.sum())
    low, high = (int(np.searchsorted(share, quantile)) for quantile in (_OUTSIDE, 1 - _OUTSIDE))
    white = next(white for white in _USUAL_WHITES if high <= white)
    span = high - low
    if white == _USUAL_WHITES[0] or span >= _USED * white or span < _LEAST_RANGE:
        return 0, white
    margin = round(_MARGIN * span)
    return max(0, low - margin), min(DEEPEST, high + margin)


def scaled_picture(picture: NDArray[np.uint16], levels: GreyLevels) -> Image:
    """A picture of 16 bits as 8, linear between the levels; by the levels of a whole depth, its upper eight bits."""
    black, white = levels
    table = np.clip((np.arange(DEEPEST + 1) - black) * 256 // (white + 1 - black), 0, 255).astype(np.uint8)
    return np.asarray(table[picture], np.uint8)


def clips(picture: NDArray[Any], levels: GreyLevels) -> bool:
    """Whether much of a picture of more than 8 bits is shown white, as hardly any of the pictures measured is."""
    return picture.dtype == np.uint16 and bool((picture[::2, ::2] >= levels[1]).mean() > _CLIPPED)


def in_eight_bits(picture: NDArray[Any], levels: GreyLevels | None) -> tuple[Image, GreyLevels | None]:
    """A picture of 8 bits as it is, and None; one of more bits as 8, and its levels: those given, else its own."""
    if picture.dtype == np.uint8:
        return picture, None
    levels = levels or measured_levels([picture])
    return scaled_picture(picture, levels), levels


def levels_in(model: LandmarkModel) -> GreyLevels | None:
    """The levels by which the images of a map were shown; None: they had 8 bits."""
    if _ARRAY not in model:
        return None
    black, white = model[_ARRAY].tolist()
    return int(black), int(white)


def with_levels(model: LandmarkModel, levels: GreyLevels | None) -> LandmarkModel:
    """A landmark model with the levels by which its map's images were shown; None: they had 8 bits."""
    arrays = {name: array for name, array in model.items() if name != _ARRAY}
    return arrays if levels is None else {**arrays, _ARRAY: np.array(levels, np.int64)}


def holds_few_greys(image: Image) -> bool:
    """Whether all but the rarest pixels of an image lie within a few grey levels."""
    share = np.cumsum(np.bincount(image[..., 1].ravel(), minlength=256)) / image[..., 1].size
    return int(np.searchsorted(share, 1 - _OUTSIDE) - np.searchsorted(share, _OUTSIDE)) < _FEW_GREYS
