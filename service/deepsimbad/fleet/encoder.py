"""The networks of the fleet, in processes of their own: views of all replicas share one copy, and batches."""

import asyncio
from collections.abc import Awaitable
from concurrent.futures import Future
from typing import Any

from deepsimbad.api.server import configure_logging
from deepsimbad.engine.distant import NetworkFacts
from deepsimbad.engine.worker import EncodedImage, EvaluatorPool, InferenceWorker, Priority, ready
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.registry import EvaluatorConfig
from deepsimbad.evaluators.scenes import Scene
from deepsimbad.fleet.backend import AWAY_S, Backend, Gone
from deepsimbad.settings import Settings


async def answer_or_error(call: Awaitable[Any]) -> Any:
    """A call's answer, or the error of ours that it raises: errors that Serve raises are of ended processes."""
    try:
        return await call
    except DeepSimbadError as error:
        return error.with_traceback(None)


class Encoder:
    """The deployment behind `engine.distant.Encoder`: evaluators, made when first asked for, and one worker."""

    def __init__(self, settings: Settings) -> None:
        configure_logging(settings.log_level)
        self._evaluators = EvaluatorPool(settings.compute())
        self._worker = InferenceWorker(max_waiting=settings.max_queue, longest_wait_s=settings.encode_wait_ms / 1000)

    def __del__(self) -> None:
        self._worker.close()

    def check_health(self) -> None:
        """Raise where nothing encodes any more."""
        if not self._worker.is_alive:
            raise RuntimeError("the inference worker has ended")

    async def lives(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def ask(self, method: str, *arguments: Any) -> Any:
        """As `answer_or_error`."""
        return await answer_or_error(getattr(self, method)(*arguments))

    async def facts(self, config: EvaluatorConfig) -> NetworkFacts:
        evaluator = self._of(config)
        await asyncio.to_thread(evaluator.load)
        return NetworkFacts.of(evaluator)

    async def prepared(self, config: EvaluatorConfig, image: Image) -> Image:
        return await asyncio.to_thread(ready(self._of(config)).prepare, image)

    async def encoded(self, config: EvaluatorConfig, view: Image | Scene, priority: Priority) -> EncodedImage:
        evaluator = await asyncio.to_thread(ready, self._of(config))
        return await asyncio.wrap_future(self._worker.encode(evaluator, view, priority))

    def _of(self, config: EvaluatorConfig) -> Evaluator:
        return self._evaluators.evaluator(config.as_dict())


class AskedEncoder:
    """`engine.distant.Encoder` that asks the deployment, from any thread, through a handle of an event loop."""

    def __init__(self, backend: Backend, loop: asyncio.AbstractEventLoop) -> None:
        self._backend, self._loop = backend, loop

    def facts(self, config: EvaluatorConfig) -> Future[NetworkFacts]:
        return self._promised("facts", config)

    def prepared(self, config: EvaluatorConfig, image: Image) -> Future[Image]:
        return self._promised("prepared", config, image)

    def encoded(self, config: EvaluatorConfig, view: Image | Scene, priority: Priority) -> Future[EncodedImage]:
        return self._promised("encoded", config, view, priority)

    def _promised(self, method: str, *arguments: Any) -> Future[Any]:
        return asyncio.run_coroutine_threadsafe(self._answer(method, *arguments), self._loop)

    async def _answer(self, method: str, *arguments: Any) -> Any:
        try:
            answer = await self._backend.ask("ask", method, *arguments)
        except Gone as error:
            raise UnavailableError("the encoder is away this moment: try again", retry_after_s=AWAY_S) from error
        if isinstance(answer, DeepSimbadError):
            raise answer
        return answer
