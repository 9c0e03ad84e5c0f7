"""One process of the fleet as others see it: asked while it lives, and given up the moment it ends."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable
from dataclasses import dataclass
from typing import Any, TypeVar

from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle

T = TypeVar("T")

WATCH_S = 2.0
BRIEFLY_S = 5.0  # that an answer may take for which others should not wait
AWAY_S = 2  # that who is told to come again should wait


class Gone(Exception):  # noqa: N818 - nobody's error
    """A process ended before it answered, or there is none."""


@dataclass(eq=False)
class Backend:
    """A process of a deployment, as one that asks it sees it; it answers `lives` after the seconds that it is told."""

    handle: DeploymentHandle[Any]
    n_calls: int = 0  # under way
    gone: asyncio.Future[None] | None = None  # has a result once the process ends; None: there is none

    async def watch(self) -> None:
        """Know from when on and how long there is a process, until cancelled."""
        while True:
            try:
                await self.handle.lives.remote(0)  # waits until there is one
                self.gone = self.gone or asyncio.get_running_loop().create_future()
                while True:
                    await self.handle.lives.remote(WATCH_S)
            except (RayError, RayServeException):
                if self.gone is not None:
                    self.gone.set_result(None)
                self.gone = None
                await asyncio.sleep(0.05)

    async def there(self, within_s: float) -> None:
        """Return once there is a process, or after a while."""
        until = asyncio.get_running_loop().time() + within_s
        while self.gone is None and asyncio.get_running_loop().time() < until:
            await asyncio.sleep(0.05)

    async def before_gone(self, call: Awaitable[T], gone: asyncio.Future[None]) -> T:
        """What a call answers; raises Gone where its process ends before."""
        asking = asyncio.ensure_future(call)
        asking.add_done_callback(lambda done: done.cancelled() or done.exception())  # it may end unheard
        try:
            either: list[asyncio.Future[Any]] = [asking, gone]
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if not asking.done():  # Serve would have it wait for the next process
                raise Gone
            return asking.result()
        except (RayError, RayServeException) as error:
            raise Gone from error
        finally:
            asking.cancel()

    async def ask(self, method: str, *arguments: Any) -> Any:
        """A short answer; raises Gone where there is nobody to give it."""
        if self.gone is None:
            raise Gone
        response = getattr(self.handle, method).remote(*arguments)
        try:
            return await self.before_gone(response, self.gone)
        except BaseException:
            response.cancel()
            raise

    async def ask_briefly(self, method: str, *arguments: Any) -> Any:
        """As `ask`; who does not answer soon, though the process has not ended, is gone too."""
        try:
            return await asyncio.wait_for(self.ask(method, *arguments), BRIEFLY_S)
        except TimeoutError as error:
            raise Gone from error

    async def stream(self, method: str, *arguments: Any) -> AsyncGenerator[Any]:
        """A long answer in its parts; raises Gone as `ask`, or where it breaks off."""
        if (gone := self.gone) is None:
            raise Gone
        parts = getattr(self.handle.options(stream=True), method).remote(*arguments)
        try:
            while True:
                try:
                    yield await self.before_gone(anext(parts), gone)
                except StopAsyncIteration:
                    return
        finally:
            parts.cancel()
