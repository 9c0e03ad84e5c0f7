"""HEIC images, as telephones write them, by an optional library."""

from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import MissingExtraError

HEIC_SUFFIXES = frozenset({".heic", ".heif"})


def require_heic() -> None:
    """Raises MissingExtraError where the library is not installed; where it is, Pillow opens such files from now on."""
    try:
        from pillow_heif import register_heif_opener  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtraError(
            "HEIC images need pillow-heif: pip install 'deep-simbad[heic]', or convert them to JPEG"
        ) from error
    register_heif_opener()


def decode_heic(body: bytes) -> NDArray[np.uint8]:
    """An upright image [height, width, 3] BGR. Raises MissingExtraError, OSError or ValueError (damaged)."""
    require_heic()
    from PIL import Image  # noqa: PLC0415 - beside the extra

    with Image.open(BytesIO(body)) as picture:
        return np.ascontiguousarray(np.asarray(picture.convert("RGB"), dtype=np.uint8)[:, :, ::-1])
