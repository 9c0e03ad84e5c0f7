"""An application asked without a socket, as ASGI has it."""

import asyncio
from collections.abc import AsyncGenerator

import anyio
from starlette.types import ASGIApp, Message, Scope

_MESSAGES = 8  # of an answer that may wait to be fetched


async def asked(app: ASGIApp, scope: Scope, body: bytes) -> AsyncGenerator[Message]:
    """The messages of an application's answer to a request with this body, as it sends them."""
    parts = [{"type": "http.request", "body": body, "more_body": False}]
    send, messages = anyio.create_memory_object_stream[Message](_MESSAGES)

    async def receive() -> Message:
        if not parts:
            await asyncio.Event().wait()  # nobody leaves; who does is heard of by cancelling
        return parts.pop()

    async def answer() -> None:
        async with send:
            await app(scope, receive, send.send)

    answering = asyncio.create_task(answer())
    try:
        async for message in messages:
            yield message
    finally:
        messages.close()
        answering.cancel()
