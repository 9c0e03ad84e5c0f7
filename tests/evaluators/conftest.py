"""Small image files of every format the service takes."""

import io

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow

WIDTH, HEIGHT = 48, 32


def picture() -> NDArray[np.uint8]:
    """[32, 48, 3] BGR: blue-ish above, red-ish below, a little texture so that files have some length."""
    pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    pixels[: HEIGHT // 2], pixels[HEIGHT // 2 :] = (200, 30, 10), (10, 30, 180)
    pixels[::3, ::5] += 20
    return pixels


def _cv2_file(extension: str, parameters: list[int]) -> bytes:
    is_encoded, body = cv2.imencode(extension, picture(), parameters)
    assert is_encoded
    return bytes(body)


def saved(image: Pillow.Image, form: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return stream.getvalue()


FILES = {
    "jpeg": _cv2_file(".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95]),
    "progressive jpeg": _cv2_file(".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "png": _cv2_file(".png", []),
    "tiff": _cv2_file(".tiff", [cv2.IMWRITE_TIFF_COMPRESSION, 1]),
    "deflate tiff": _cv2_file(".tiff", [cv2.IMWRITE_TIFF_COMPRESSION, 8]),
    "jpeg tiff": _cv2_file(".tiff", [cv2.IMWRITE_TIFF_COMPRESSION, 7, cv2.IMWRITE_TIFF_ROWSPERSTRIP, 8]),
    "webp": _cv2_file(".webp", [cv2.IMWRITE_WEBP_QUALITY, 90]),
    "lossless webp": _cv2_file(".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    "extended webp": saved(Pillow.fromarray(picture()[..., ::-1]), "WEBP", exif=Pillow.Exif(), icc_profile=b"x" * 20),
}


@pytest.fixture(params=sorted(FILES))
def body(request: pytest.FixtureRequest) -> bytes:
    """One whole file of each kind."""
    return FILES[request.param]


@pytest.fixture(scope="session")
def files() -> dict[str, bytes]:
    """Name -> one whole file of each kind, all of the same picture, 48 x 32."""
    return FILES


@pytest.fixture(scope="session")
def the_picture() -> NDArray[np.uint8]:
    return picture()
