"""Augmented views of a picture: what another day, another light or a robot a little aside would show of the place.

No change of geometry is larger than what a robot sees within a metre or two; light, contrast and colour change as far
as seasons do. The same seed gives the same views. The first half of them is moved and not relit, so that what is learnt
from these can be judged on the others: with one season known, another light has to stand for the season to come.
"""

import cv2
import numpy as np

from deepsimbad.evaluators.base import Image

VIEWS_A_LANDMARK = 8  # the first half only moved, the second relit too
_LONGEST_SIDE = 512  # more pixels than any extractor looks at
_LEAST_ZOOM = 0.8  # share of the picture's sides that a crop keeps
_TURN_DEG = 3.0
_STRETCH, _GAMMA, _CONTRAST, _TINT = 0.06, 0.5, 0.4, 0.12  # largest logarithm of a factor
_LEAST_BLUR = 0.3  # pixels; less is none
_BRIGHTNESS, _NOISE, _BLUR = 40.0, 10.0, 1.5  # grey levels; grey levels; pixels, of the largest


def augmented(image: Image, seed: int, n_views: int = VIEWS_A_LANDMARK) -> list[Image]:
    """Views of one picture, each at the picture's own size or, of a large one, at a smaller one of the same aspect."""
    rng = np.random.default_rng([seed, 0xA06])
    height, width = image.shape[:2]
    factor = min(1.0, _LONGEST_SIDE / max(height, width))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = image if factor == 1.0 else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    moved = [_moved(small, rng) for _ in range(n_views)]
    return [*moved[: n_views // 2], *(_relit(each, rng) for each in moved[n_views // 2 :])]


def _moved(image: Image, rng: np.random.Generator) -> Image:
    """Zoomed in, shifted within what a crop leaves, turned and stretched a little; the rim repeats."""
    height, width = image.shape[:2]
    zoom = 1 / rng.uniform(_LEAST_ZOOM, 1.0)
    stretch = float(np.exp(rng.uniform(-_STRETCH, _STRETCH) / 2))
    angle = np.deg2rad(rng.uniform(-_TURN_DEG, _TURN_DEG))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = zoom * np.diag([stretch, 1 / stretch]) @ turn
    centre = np.array([width, height]) / 2
    shift = rng.uniform(-0.5, 0.5, 2) * (zoom - 1) * np.array([width, height])
    moved = cv2.warpAffine(
        image,
        np.column_stack([matrix, centre - matrix @ centre + shift]),
        (width, height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(moved, np.uint8)


def _relit(image: Image, rng: np.random.Generator) -> Image:
    """By another light and another lens: gamma, contrast, brightness and tint by one table a channel; blur, noise."""
    levels = np.linspace(0, 1, 256) ** np.exp(rng.uniform(-_GAMMA, _GAMMA)) * 255
    levels = (levels - 128) * np.exp(rng.uniform(-_CONTRAST, _CONTRAST)) + 128 + rng.uniform(-_BRIGHTNESS, _BRIGHTNESS)
    tables = levels[:, np.newaxis] * np.exp(rng.uniform(-_TINT, _TINT, 3))
    lit = cv2.LUT(image, np.clip(np.rint(tables), 0, 255).astype(np.uint8)[np.newaxis])
    if (sigma := float(rng.uniform(0, _BLUR))) > _LEAST_BLUR:
        lit = cv2.GaussianBlur(lit, (0, 0), sigmaX=sigma)
    noise = rng.normal(0, float(rng.uniform(0, _NOISE)), lit.shape)
    return np.asarray(np.clip(np.rint(lit + noise), 0, 255), np.uint8)
