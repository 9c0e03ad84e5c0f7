"""Evaluators made once and shared by all domains that are configured alike."""

import json
import threading
from collections.abc import Mapping
from typing import Any

from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator


class EvaluatorPool:
    """Evaluators by configuration, made at first need."""

    def __init__(self) -> None:
        self._made: dict[str, Evaluator] = {}
        self._lock = threading.Lock()

    def evaluator(self, raw_config: Mapping[str, Any]) -> Evaluator:
        """The evaluator of a configuration.

        Raises:
            InvalidInputError: There is none of that kind, or an option cannot be used.
        """
        config = evaluator_config(raw_config)
        key = json.dumps(config.as_dict(), sort_keys=True)
        with self._lock:
            if key not in self._made:
                self._made[key] = make_evaluator(config)
            return self._made[key]
