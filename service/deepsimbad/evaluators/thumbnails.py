"""Small pictures for people."""

import cv2
import numpy as np

from deepsimbad.errors import DeepSimbadError
from deepsimbad.evaluators.image import decode_image, picture_size, resized

HEIGHT = 96  # pixels; of a JPEG of some 2 kB
_WIDEST = 2.0  # its width by its height
_QUALITY = 60


def thumbnail(body: bytes, max_pixels: int, high: int = HEIGHT) -> bytes | None:
    """A small JPEG of an image however it came, upright, its pixels square; None where it cannot be decoded."""
    try:
        image = decode_image(body, max_pixels)
    except DeepSimbadError:
        return None
    width, height = picture_size(body) or image.shape[1::-1]
    size = (max(1, round(high * min(_WIDEST, width / height))), high)
    was_encoded, content = cv2.imencode(".jpg", resized(image, size), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return np.asarray(content).tobytes() if was_encoded else None
