"""Evaluators made once and shared by all domains that are configured alike."""

import json
import logging
import threading
from collections.abc import Mapping
from typing import Any

from deepsimbad.errors import DeepSimbadError, EvaluatorUnavailableError, InvalidInputError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator

log = logging.getLogger(__name__)


class EvaluatorPool:
    """Evaluators by configuration, made at first need: one copy of a network, whoever uses it.

    Args:
        compute: How networks are computed; None: by the defaults.
    """

    def __init__(self, compute: Compute | None = None) -> None:
        self._compute = compute or Compute()
        self._made: dict[str, Evaluator] = {}
        self._lock = threading.Lock()

    def evaluator(self, raw_config: Mapping[str, Any]) -> Evaluator:
        """The evaluator of a configuration, loaded or not: ranked landmarks and ready encodings need no network.

        Raises:
            InvalidInputError: There is none of that kind or name.
        """
        config = evaluator_config(raw_config)
        key = json.dumps(config.as_dict(), sort_keys=True)
        with self._lock:
            if key not in self._made:
                self._made[key] = make_evaluator(config, self._compute)
            return self._made[key]

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
        EvaluatorUnavailableError: It cannot be loaded any more; what the robot sent is not at fault.
        OutOfMemoryError: There is too little memory for it.
    """
    try:
        evaluator.load()
    except InvalidInputError as error:
        raise EvaluatorUnavailableError(
            f"the domain's extractor cannot be loaded: {error.message}", reason=error.code, **error.hints
        ) from error
    return evaluator
