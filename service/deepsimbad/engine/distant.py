"""Evaluators whose networks another process has: a view travels there, its encoding back, and maps stay here."""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from deepsimbad.engine.worker import EncodedImage, InferenceWorker, Priority
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.fused import Fused
from deepsimbad.evaluators.image import resized
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.evaluators.scenes import Scene


@dataclass(frozen=True)
class NetworkFacts:
    """The attributes of an evaluator that need its network; see `Evaluator`."""

    input_size: tuple[int, int] | None
    encoding_dim: int | None
    halves: tuple[int, ...]
    weights_sha256: str | None
    largest_batch: int

    @classmethod
    def of(cls, evaluator: Evaluator) -> Self:
        """The facts of an evaluator that is loaded."""
        return cls(**{name: getattr(evaluator, name) for name in cls.__dataclass_fields__})


class Encoder(Protocol):
    """A process that has the networks; its futures fail as the evaluator would, or with UnavailableError."""

    def facts(self, config: EvaluatorConfig) -> Future[NetworkFacts]:
        """The facts of an evaluator, once it is loaded there."""

    def prepared(self, config: EvaluatorConfig, image: Image) -> Future[Image]:
        """The image as `Evaluator.prepare` makes it."""

    def encoded(self, config: EvaluatorConfig, view: Image | Scene, priority: Priority) -> Future[EncodedImage]:
        """The encoding of one view, made in a batch with others."""


class DistantEvaluator:
    """An `Evaluator` whose network another process has; what needs no network is done by the `local` evaluator."""

    def __init__(self, local: Evaluator, config: EvaluatorConfig, encoder: Encoder) -> None:
        self._local, self._config, self._encoder = local, config, encoder
        self._facts: NetworkFacts | None = None

    def __getattr__(self, name: str) -> Any:
        if name in NetworkFacts.__dataclass_fields__:
            self.load()
            return getattr(self._facts, name)
        return getattr(self._local, name)

    def load(self) -> None:
        """See `Evaluator`."""
        self._facts = self._facts or self._encoder.facts(self._config).result()

    def prepare(self, image: Image) -> Image:
        """See `Evaluator`; an image that is not simply resized, or may be none, travels to the encoder."""
        size: tuple[int, int] | None = self.input_size
        is_image = image.dtype == np.uint8 and image.shape[2:] == (3,) and image.size > 0
        return resized(image, size) if size and is_image else self._encoder.prepared(self._config, image).result()

    def encode(self, images: Sequence[Image | Scene]) -> NDArray[np.float32]:
        """See `Evaluator`."""
        futures = [self.encoded(image, Priority.LIVE) for image in images]
        return np.array([future.result().values for future in futures], np.float32).reshape(
            len(images), self.encoding_dim
        )

    def encoded(self, view: Image | Scene, priority: Priority) -> Future[EncodedImage]:
        """The future encoding of a view."""
        return self._encoder.encoded(self._config, view, priority)


def by_encoder(encoder: Encoder) -> Callable[[EvaluatorConfig, Compute | None], Evaluator]:
    """A function that makes evaluators as `make_evaluator` does; those with a network use the encoder's."""

    def make(config: EvaluatorConfig, compute: Compute | None = None) -> Evaluator:
        if not config.has_network:
            return make_evaluator(config, compute)
        local = Fused([make(half, compute) for half in config.of]) if config.of else make_evaluator(config, compute)
        return cast("Evaluator", DistantEvaluator(local, config, encoder))

    return make


async def encoded(
    worker: InferenceWorker, evaluator: Evaluator, view: Image | Scene, priority: Priority = Priority.LIVE
) -> EncodedImage:
    """An image or a scene, encoded by whoever has the network."""
    if isinstance(evaluator, DistantEvaluator):
        return await asyncio.wrap_future(evaluator.encoded(view, priority))
    return await asyncio.wrap_future(worker.encode(evaluator, view, priority))
