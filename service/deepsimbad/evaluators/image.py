"""The one place where images are decoded: JPEG, PNG, TIFF and WebP bytes -> upright 8-bit BGR.

EXIF (and TIFF) orientation is applied; grey becomes three equal channels; of 16 bits a channel the upper 8 are
kept; alpha is dropped (PNG and WebP give their colours as stored, TIFF's come composited on black); of several
pages or animation frames the first is taken and no other decoded. An image of more than `KEPT_PIXELS` is reduced by a
whole factor, whoever decodes it: no extractor needs so many, and looking at them would keep live views waiting.
"""

import math

import cv2
import numpy as np

from deepsimbad.errors import EmptyBodyError, ImageTooLargeError, InvalidImageError, OutOfMemoryError
from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.image_header import MEDIA_TYPES, check_whole, media_type, picture_alone, read_size

__all__ = ["KEPT_PIXELS", "MEDIA_TYPES", "claimed_pixels", "decode_image"]

KEPT_PIXELS = 3840 * 2160

# Bad input is answered by a named error; OpenCV's own words about it would only fill the server's log.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

_NO_MEMORY = "there is too little memory to decode an image now: try again, or give the service more"
_BLANK_BELOW_STD = 1.0  # grey levels of 256


def claimed_pixels(body: bytes, max_pixels: int) -> int:
    """How many pixels an image's header claims.

    Args:
        body: The file's bytes; its real format is read from them.
        max_pixels: Greatest width x height accepted.

    Raises:
        EmptyBodyError: No bytes.
        ImageTooLargeError: The header claims more pixels.
        TruncatedImageError: The end of the header is missing.
        InvalidImageError: Not one of `MEDIA_TYPES`, or a header that contradicts itself.
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
    return width * height


def decode_image(body: bytes, max_pixels: int) -> Image:
    """Decode one image.

    Args:
        body: The file's bytes; its real format is read from them.
        max_pixels: Greatest width x height accepted, judged by the header before anything is decoded.

    Returns:
        [height, width, 3] uint8 BGR; height x width is at most `KEPT_PIXELS`.

    Raises:
        EmptyBodyError: No bytes.
        ImageTooLargeError: The header claims more pixels.
        TruncatedImageError: The end of the file is missing.
        InvalidImageError: Not one of `MEDIA_TYPES`, or damaged.
        OutOfMemoryError: There is too little memory for it.
    """
    claimed_pixels(body, max_pixels)
    check_whole(body)
    try:
        image = cv2.imdecode(np.frombuffer(picture_alone(body), np.uint8), cv2.IMREAD_COLOR_BGR)
    except MemoryError as error:
        raise OutOfMemoryError(_NO_MEMORY) from error
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:  # no fault of the picture's
            raise OutOfMemoryError(_NO_MEMORY) from error
        raise InvalidImageError(f"the {media_type(body)} image cannot be decoded") from error
    if image is None or image.size == 0:
        raise InvalidImageError(f"the {media_type(body)} image cannot be decoded")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InvalidImageError(f"the image decodes to {list(image.shape)} {image.dtype}, not to 8-bit colour")
    return _reduced(np.ascontiguousarray(image, np.uint8))


def is_blank(image: Image) -> bool:
    """Whether an image shows nothing: grey levels that differ by no more than a sensor's noise does in the dark."""
    _, deviation = cv2.meanStdDev(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return float(deviation[0, 0]) < _BLANK_BELOW_STD


def _reduced(image: Image) -> Image:
    """Means of squares, of the least whole side that leaves no more than may be kept; usual images as they are."""
    height, width = image.shape[:2]
    side = math.ceil(math.sqrt(height * width / KEPT_PIXELS))
    if side == 1:
        return image
    size = (max(1, width // side), max(1, height // side))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
