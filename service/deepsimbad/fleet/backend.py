"""One process of the fleet as others see it: called while it lives, and given up the moment it ends."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable
from dataclasses import dataclass
from typing import Any, TypeVar

from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle

T = TypeVar("T")

WATCH_S = 2.0
BRIEFLY_S = 5.0  # longest wait for an answer that should not keep others waiting
AWAY_S = 2  # wait before the next try that a refused caller is advised of


class Gone(Exception):  # noqa: N818 - nobody's error
    """A process ended before it answered, or there is none."""


@dataclass(eq=False)
class Backend:
    """A process of a deployment, as its callers see it; its method `lives` answers after a given number of seconds."""

    handle: DeploymentHandle[Any]
    n_calls: int = 0  # under way
    process_end: asyncio.Future[None] | None = None  # has a result once the process ends; None: there is none

    async def watch(self) -> None:
        """Keep `process_end` true to whether there is a process, until cancelled."""
        while True:
            try:
                await self.handle.lives.remote(0)  # waits until there is one
                self.process_end = self.process_end or asyncio.get_running_loop().create_future()
                while True:
                    await self.handle.lives.remote(WATCH_S)
            except (RayError, RayServeException):
                if self.process_end is not None:
                    self.process_end.set_result(None)
                self.process_end = None
                await asyncio.sleep(0.05)

    async def wait_for_process(self, within_s: float) -> None:
        """Return once there is a process, or after `within_s` seconds."""
        deadline_s = asyncio.get_running_loop().time() + within_s
        while self.process_end is None and asyncio.get_running_loop().time() < deadline_s:
            await asyncio.sleep(0.05)

    async def while_alive(self, call: Awaitable[T], process_end: asyncio.Future[None]) -> T:
        """The answer of a call; raises Gone where its process ends before."""
        task = asyncio.ensure_future(call)
        task.add_done_callback(lambda call: call.cancelled() or call.exception())  # nobody may ask for its error
        try:
            futures: list[asyncio.Future[Any]] = [task, process_end]
            await asyncio.wait(futures, return_when=asyncio.FIRST_COMPLETED)
            if not task.done():  # Serve would have it wait for the next process
                raise Gone
            return task.result()
        except (RayError, RayServeException) as error:
            raise Gone from error
        finally:
            task.cancel()

    async def ask(self, method: str, *arguments: Any) -> Any:
        """A short answer of a method; raises Gone where there is no process, or it ends before."""
        if self.process_end is None:
            raise Gone
        response = getattr(self.handle, method).remote(*arguments)
        try:
            return await self.while_alive(response, self.process_end)
        except BaseException:
            response.cancel()
            raise

    async def ask_briefly(self, method: str, *arguments: Any) -> Any:
        """As `ask`, but raises Gone too where the process lives and does not answer within `BRIEFLY_S`."""
        try:
            return await asyncio.wait_for(self.ask(method, *arguments), BRIEFLY_S)
        except TimeoutError as error:
            raise Gone from error

    async def stream(self, method: str, *arguments: Any) -> AsyncGenerator[Any]:
        """A long answer of a method in its parts; raises Gone as `ask`, or where it breaks off."""
        if (process_end := self.process_end) is None:
            raise Gone
        parts = getattr(self.handle.options(stream=True), method).remote(*arguments)
        try:
            while True:
                try:
                    yield await self.while_alive(anext(parts), process_end)
                except StopAsyncIteration:
                    return
        finally:
            parts.cancel()
