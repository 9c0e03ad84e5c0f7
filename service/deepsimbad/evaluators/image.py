"""The one place where images are decoded: JPEG, PNG, TIFF and WebP bytes -> upright 8-bit BGR.

EXIF (and TIFF) orientation is applied; grey becomes three equal channels; of 16 bits a channel the upper 8 are
kept; alpha is dropped (PNG and WebP give their colours as stored, TIFF's come composited on black); of several
pages or animation frames the first is taken and no other decoded.
"""

import cv2
import numpy as np

from deepsimbad.errors import EmptyBodyError, ImageTooLargeError, InvalidImageError
from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.image_header import MEDIA_TYPES, check_whole, media_type, read_size

__all__ = ["MEDIA_TYPES", "decode_image"]

# Bad input is answered by a named error; OpenCV's own words about it would only fill the server's log.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

_BLANK_BELOW_STD = 1.0  # grey levels of 256


def decode_image(body: bytes, max_pixels: int) -> Image:
    """Decode one image.

    Args:
        body: The file's bytes; its real format is read from them.
        max_pixels: Greatest width x height accepted, judged by the header before anything is decoded.

    Returns:
        [height, width, 3] uint8 BGR.

    Raises:
        EmptyBodyError: No bytes.
        ImageTooLargeError: The header claims more pixels.
        TruncatedImageError: The end of the file is missing.
        InvalidImageError: Not one of `MEDIA_TYPES`, or damaged.
    """
    if not body:
        raise EmptyBodyError("the body is empty: send the image's bytes")
    width, height = read_size(body)
    if width * height > max_pixels:
        raise ImageTooLargeError(
            f"the image claims {width} x {height} pixels, at most {max_pixels} are accepted",
            width=width,
            height=height,
            max_pixels=max_pixels,
        )
    check_whole(body)
    try:
        image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR_BGR)
    except cv2.error as error:
        raise InvalidImageError(f"the {media_type(body)} image cannot be decoded") from error
    if image is None or image.size == 0:
        raise InvalidImageError(f"the {media_type(body)} image cannot be decoded")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InvalidImageError(f"the image decodes to {list(image.shape)} {image.dtype}, not to 8-bit colour")
    return np.ascontiguousarray(image)


def is_blank(image: Image) -> bool:
    """Whether an image shows nothing: grey levels that differ by no more than a sensor's noise does in the dark."""
    return float(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).std()) < _BLANK_BELOW_STD
