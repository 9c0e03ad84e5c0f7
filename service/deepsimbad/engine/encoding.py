"""From images to encodings, and the rules that a ready encoding must keep."""

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.engine.observation import EncodedImage
from deepsimbad.errors import EvaluatorUnavailableError, InvalidEncodingError, InvalidWeightsError
from deepsimbad.evaluators.base import Evaluator, Image


def encode_images(evaluator: Evaluator, images: Sequence[Image]) -> list[EncodedImage]:
    """Encode images at once.

    Raises:
        UnsupportedMediaTypeError: The evaluator takes ready encodings alone.
        OutOfMemoryError: There is too little memory for it.
        EvaluatorUnavailableError: Its network gives something else than encodings.
    """
    began = perf_counter()
    try:
        encodings = evaluator.encode(images)
    except InvalidWeightsError as error:  # the network is at fault, not what a robot sent
        raise EvaluatorUnavailableError(error.message, reason=error.code, **error.hints) from error
    encode_ms = 1000 * (perf_counter() - began)
    return [EncodedImage(encoding, evaluator.weights_sha256, encode_ms) for encoding in encodings]


def ready_encodings(values: NDArray[Any]) -> NDArray[np.float32]:
    """Check encodings that were computed elsewhere.

    They may have any one length, in a domain with an extractor too: the traverse they join and the landmarks they are
    compared with hold them to it.

    Args:
        values: [n, d] of any float type.

    Returns:
        [n, d] float32; the array itself where it already was.

    Raises:
        InvalidEncodingError: Empty, or NaN, infinity or too large a number somewhere.
    """
    if values.ndim != 2 or values.size == 0:
        raise InvalidEncodingError(f"encodings are [n, d] and not empty, not {list(values.shape)}")
    with np.errstate(over="ignore"):  # what overflows is refused below
        encodings = np.ascontiguousarray(values, np.float32)
    # In blocks, so that a large batch is not accompanied by as many booleans.
    for first in range(0, len(encodings), 1024):
        finite = np.isfinite(encodings[first : first + 1024]).all(axis=1)
        if not finite.all():
            row = first + int(np.flatnonzero(~finite)[0])
            raise InvalidEncodingError(f"encoding {row} holds NaN, infinity or a number too large for float32", row=row)
    return encodings
