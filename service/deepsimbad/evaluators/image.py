"""The one place where images are decoded: JPEG, PNG, TIFF and WebP bytes -> upright 8-bit BGR.

EXIF (and TIFF) orientation is applied; grey becomes three equal channels; 16 bits a channel become 8, by the grey
levels of a recording (`evaluators.grey_levels`); alpha is dropped (PNG and WebP give their colours as stored, TIFF's
come composited on black); of several pages or animation frames the first is taken and no other decoded. An image of
more than `KEPT_PIXELS` is reduced by a whole factor, whoever decodes it: no extractor needs so many pixels, and work on
them would keep live views waiting.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from io import BytesIO
from typing import Any

import cv2
import numpy as np
import PIL.Image
import simplejpeg
from numpy.typing import NDArray

from deepsimbad.errors import DeepSimbadError, InvalidImageError
from deepsimbad.evaluators.base import Image, named_lack_of_memory
from deepsimbad.evaluators.grey_levels import GreyLevels, in_eight_bits
from deepsimbad.evaluators.image_files import JPEG, ImageFile, raise_truncated

KEPT_PIXELS = 3840 * 2160

# Bad input is answered by a named error; OpenCV's and Pillow's own words about it would only stand beside it.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")

_BLANK_BELOW_STD = 1.0  # grey levels of 256
_FIELDS, _BLANK_BELOW_SHARE = 8, 0.25  # fields a side; share of all variation that lies between their means
THUMBNAIL_HEIGHT = 96  # pixels; of a JPEG of some 2 kB
_WIDEST, _THUMBNAIL_QUALITY = 2.0, 60  # a thumbnail's width by its height; its JPEG quality
_DECODER_BYTES = 9  # a pixel: the picture, and the coefficients of a progressive JPEG
_DTYPES = (np.uint8, np.uint16)
_UPRIGHT: Mapping[int, Callable[[cv2.typing.MatLike], cv2.typing.MatLike]] = {  # by Exif's orientation
    2: lambda image: cv2.flip(image, 1),
    3: lambda image: cv2.rotate(image, cv2.ROTATE_180),
    4: lambda image: cv2.flip(image, 0),
    5: cv2.transpose,
    6: lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    7: lambda image: cv2.rotate(cv2.transpose(image), cv2.ROTATE_180),
    8: lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
}
_EXIF_ORIENTATION, _LYING = 274, frozenset({5, 6, 7, 8})


def decode_image(body: bytes, max_pixels: int, *, as_stored: bool = False, levels: GreyLevels | None = None) -> Image:
    """Read and decode one image; see `ImageFile.read` and `decode_file`."""
    return decode_file(ImageFile.read(body, max_pixels), as_stored=as_stored, levels=levels)


def decode_file(file: ImageFile, *, as_stored: bool = False, levels: GreyLevels | None = None) -> Image:
    """[height, width, 3] uint8 BGR; height x width is at most `KEPT_PIXELS`.

    Args:
        as_stored: Give the pixels as they lie in the file, whatever its orientation is.
        levels: Grey levels by which more than 8 bits are shown; None: those that suit the picture itself.

    Raises:
        InvalidImageError: It is damaged; TruncatedImageError where a part of its picture is missing.
        OutOfMemoryError: There is too little memory for it.
    """
    return in_eight_bits(decode_deep(file, as_stored=as_stored), levels)[0]


def decode_deep(file: ImageFile, *, as_stored: bool = False) -> NDArray[Any]:
    """As `decode_file`, but 9 to 16 bits a channel are all kept, as uint16."""
    try:
        with named_lack_of_memory("decode"):
            if file.media_type == JPEG:
                image: cv2.typing.MatLike | None = _of_jpeg(file.picture)
            else:
                flags = cv2.IMREAD_COLOR_BGR | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0)
                flags |= cv2.IMREAD_ANYDEPTH if 8 < file.bits <= 16 else 0
                image = cv2.imdecode(np.frombuffer(file.picture, np.uint8), flags)
            if image is not None and image.dtype in _DTYPES and image.size and image.shape[2:] == (3,):
                if not as_stored and file.orientation in _UPRIGHT:
                    image = _UPRIGHT[file.orientation](image)
                return _reduced(np.ascontiguousarray(image))
            np.empty(_DECODER_BYTES * file.n_pixels, np.uint8)  # codecs report too little memory as damage
    except cv2.error as error:
        raise InvalidImageError("the image cannot be decoded") from error
    raise InvalidImageError("the image cannot be decoded")


def picture_size(body: bytes) -> tuple[int, int] | None:
    """(width, height) of a whole picture as it is shown: upright, its pixels square; None where it cannot be read.

    A picture that was brought to another shape says so by the shape of its pixels, as clients' do (`as_png`).
    """
    try:
        with PIL.Image.open(BytesIO(body)) as picture:
            width, height = picture.size
            # Of a TIFF the size is upright already, and of a PNG without it every pixel would be read first.
            has_exif = picture.format != "TIFF" and (picture.format != "PNG" or "exif" in picture.info)
            is_lying = has_exif and picture.getexif().get(_EXIF_ORIENTATION) in _LYING
            density_x, density_y = picture.info.get("aspect") or (1, 1)  # pixels a unit of length, as PNG has it
            if picture.info.get("jfif_unit") == 0:
                density_x, density_y = picture.info["jfif_density"]
    except Exception:  # Pillow raises a dozen kinds
        return None
    if density_x > 0 and density_y > 0 and density_x != density_y:
        width = max(1, round(width * density_y / density_x))
    return (height, width) if is_lying else (width, height)


def resized(image: Image, size: tuple[int, int]) -> Image:
    """An image at (width, height): averaged where it shrinks, interpolated linearly where it grows; aspect not kept.

    Clients resize by this rule too, so that a view encodes to the same numbers wherever it was made small.
    """
    height, width = image.shape[:2]
    if (width, height) == size:
        return image
    shrinks = width >= size[0] and height >= size[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)


def thumbnail(body: bytes, max_pixels: int, high: int = THUMBNAIL_HEIGHT) -> bytes | None:
    """A small JPEG of an image however it came, upright, its pixels square; None where it cannot be decoded."""
    try:
        image = decode_image(body, max_pixels)
    except DeepSimbadError:
        return None
    width, height = picture_size(body) or image.shape[1::-1]
    size = (max(1, round(high * min(_WIDEST, width / height))), high)
    was_encoded, content = cv2.imencode(".jpg", resized(image, size), [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])
    return np.asarray(content).tobytes() if was_encoded else None


def is_blank(image: Image) -> bool:
    """Whether an image shows nothing: it is of one grey, or of noise.

    The means of 8 x 8 fields keep much of a scene's variation, and next to none of noise, whose grains are small.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    deviation = float(grey.std())
    fields = cv2.resize(grey, (_FIELDS, _FIELDS), interpolation=cv2.INTER_AREA)
    return deviation < _BLANK_BELOW_STD or float(fields.std()) < _BLANK_BELOW_SHARE * deviation


def _of_jpeg(picture: bytes) -> Image | None:
    """Decode by OpenCV's library, through a binding that reports warnings: OpenCV shows missing parts as grey."""
    try:
        return np.asarray(simplejpeg.decode_jpeg(picture, "BGR"), np.uint8)
    except ValueError as error:
        warning = str(error)
    if "premature end" in warning:
        raise_truncated()
    if warning.endswith("extraneous bytes before marker 0xd9") and (exact := _without_filling(picture)) != picture:
        return _of_jpeg(exact)
    return None


def _without_filling(picture: bytes) -> bytes:
    """A JPEG without the zeros with which some cameras fill up its last scan."""
    scan, end = picture[:-2].rstrip(b"\0"), picture[-2:]
    return scan + (b"\0" if scan.endswith(b"\xff") else b"") + end


def _reduced(image: NDArray[Any]) -> NDArray[Any]:
    """An image of at most `KEPT_PIXELS` as it is; a larger one by the means of squares, of the least whole side."""
    height, width = image.shape[:2]
    side = math.ceil(math.sqrt(height * width / KEPT_PIXELS))
    if side == 1:
        return image
    size = (max(1, width // side), max(1, height // side))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


VIEWS_A_LANDMARK = 8  # the first half only warped, the second relit too
_LONGEST_SIDE = 512  # more pixels than any extractor looks at
_LEAST_ZOOM = 0.8  # share of the picture's sides that a crop keeps
_TURN_DEG = 3.0
_STRETCH, _GAMMA, _CONTRAST, _TINT = 0.06, 0.5, 0.4, 0.12  # largest logarithm of a factor
_LEAST_BLUR = 0.3  # pixels; less is none
_BRIGHTNESS, _NOISE, _BLUR = 40.0, 10.0, 1.5  # grey levels; grey levels; pixels, of the largest


def augmented(image: Image, seed: int) -> list[Image]:
    """Views of one picture: what another day, another light or a robot a little aside would show of the place.

    Views have the picture's own size or, of a large one, a smaller one of the same aspect. No change of geometry is
    larger than what a robot sees within a metre or two; light, contrast and colour change as far as seasons do. The
    same seed gives the same views. The first half of them is warped and not relit, so that what is learnt from these
    can be judged on the others: with one season known, another light has to stand for the season to come.
    """
    rng = np.random.default_rng([seed, 0xA06])
    height, width = image.shape[:2]
    factor = min(1.0, _LONGEST_SIDE / max(height, width))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = image if factor == 1.0 else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    warped = [_warp(small, rng) for _ in range(VIEWS_A_LANDMARK)]
    return [*warped[: VIEWS_A_LANDMARK // 2], *(_relight(view, rng) for view in warped[VIEWS_A_LANDMARK // 2 :])]


def _warp(image: Image, rng: np.random.Generator) -> Image:
    """Zoom in, shift within what a crop leaves, turn and stretch a little; the rim is repeated."""
    height, width = image.shape[:2]
    zoom = 1 / rng.uniform(_LEAST_ZOOM, 1.0)
    stretch = float(np.exp(rng.uniform(-_STRETCH, _STRETCH) / 2))
    angle = np.deg2rad(rng.uniform(-_TURN_DEG, _TURN_DEG))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = zoom * np.diag([stretch, 1 / stretch]) @ turn
    centre = np.array([width, height]) / 2
    shift = rng.uniform(-0.5, 0.5, 2) * (zoom - 1) * np.array([width, height])
    warped = cv2.warpAffine(
        image,
        np.column_stack([matrix, centre - matrix @ centre + shift]),
        (width, height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(warped, np.uint8)


def _relight(image: Image, rng: np.random.Generator) -> Image:
    """Change gamma, contrast, brightness and tint by one table a channel; then add blur and noise."""
    levels = np.linspace(0, 1, 256) ** np.exp(rng.uniform(-_GAMMA, _GAMMA)) * 255
    levels = (levels - 128) * np.exp(rng.uniform(-_CONTRAST, _CONTRAST)) + 128 + rng.uniform(-_BRIGHTNESS, _BRIGHTNESS)
    tables = levels[:, np.newaxis] * np.exp(rng.uniform(-_TINT, _TINT, 3))
    lit = cv2.LUT(image, np.clip(np.rint(tables), 0, 255).astype(np.uint8)[np.newaxis])
    if (sigma := float(rng.uniform(0, _BLUR))) > _LEAST_BLUR:
        lit = cv2.GaussianBlur(lit, (0, 0), sigmaX=sigma)
    noise = rng.normal(0, float(rng.uniform(0, _NOISE)), lit.shape)
    return np.asarray(np.clip(np.rint(lit + noise), 0, 255), np.uint8)
