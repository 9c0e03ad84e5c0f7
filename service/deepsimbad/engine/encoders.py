"""From images to encodings: evaluators shared by all domains, and the rules that a ready encoding must keep."""

import json
import logging
import threading
from collections.abc import Mapping, Sequence
from time import monotonic, perf_counter
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from deepsimbad.engine.views import EncodedImage
from deepsimbad.errors import (
    DeepSimbadError,
    EvaluatorUnavailableError,
    InvalidEncodingError,
    InvalidInputError,
    InvalidWeightsError,
)
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator

log = logging.getLogger(__name__)

RETRY_AFTER_S = 30.0  # an extractor that cannot be loaded is not tried again before: to read its weights takes seconds
_failures: WeakKeyDictionary[Evaluator, tuple[float, InvalidInputError]] = WeakKeyDictionary()


class EvaluatorPool:
    """Evaluators by configuration, made at first need: one copy of a network, whoever uses it.

    Args:
        compute: How networks are computed; None: by the defaults.
    """

    def __init__(self, compute: Compute | None = None) -> None:
        self._compute = compute or Compute()
        self._evaluators: dict[str, Evaluator] = {}
        self._lock = threading.Lock()

    def evaluator(self, raw_config: Mapping[str, Any]) -> Evaluator:
        """The evaluator of a configuration, loaded or not: ranked landmarks and ready encodings need no network.

        Raises:
            InvalidInputError: There is none of that kind or name.
        """
        config = evaluator_config(raw_config)
        key = json.dumps(config.as_dict(), sort_keys=True)
        with self._lock:
            if key not in self._evaluators:
                self._evaluators[key] = make_evaluator(config, self._compute)
            return self._evaluators[key]

    def load_all(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        """Load the evaluators of all domains, by their names; one that cannot be keeps no other from serving."""
        for domain, raw_config in configs.items():
            try:
                self.evaluator(raw_config).load()
            except DeepSimbadError as error:
                log.error("an extractor cannot be loaded", extra={"domain": domain, "why": error.message})


def ready(evaluator: Evaluator) -> Evaluator:
    """The evaluator of a domain that exists, loaded; the first time that takes a moment.

    Raises:
        EvaluatorUnavailableError: It cannot be loaded, or could not some seconds ago; what the robot sent is not at
            fault.
        OutOfMemoryError: There is too little memory for it.
    """
    failed_at, failure = _failures.get(evaluator, (0.0, None))
    if failure is None or monotonic() - failed_at >= RETRY_AFTER_S:
        try:
            evaluator.load()
        except InvalidInputError as error:
            failure = error
            _failures[evaluator] = (monotonic(), error)
        else:
            _failures.pop(evaluator, None)
            return evaluator
    raise EvaluatorUnavailableError(
        f"the domain's extractor cannot be loaded: {failure.message}", reason=failure.code, **failure.hints
    ) from failure


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
