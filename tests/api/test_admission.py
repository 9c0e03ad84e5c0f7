"""How much is let in at once, request by request."""

import asyncio
import json
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from deepsimbad.api.admission import FREE_BYTES, AdmissionLimits, AdmissionMiddleware
from deepsimbad.api.problems import error_response
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import OverloadedError

LIMITS = AdmissionLimits(max_requests=2, max_uploads=1, max_event_streams=1, max_body_memory_bytes=1000)
UPLOAD = "/v1/admin/domains/d/traverses/t/frames"
EVENTS = "/v1/admin/jobs/j/events"
LEFT: Message = {"type": "http.disconnect"}


@dataclass
class Exchange:
    """One request, sent and answered piece by piece as a test wants it."""

    incoming: asyncio.Queue[Message] = field(default_factory=asyncio.Queue)
    answers: list[Message] = field(default_factory=list)
    may_answer: asyncio.Event = field(default_factory=asyncio.Event)
    may_end: asyncio.Event = field(default_factory=asyncio.Event)
    n_read: int = 0

    def __post_init__(self) -> None:
        self.may_end.set()

    async def send(self, message: Message) -> None:
        self.answers.append(message)

    def came(self, n_bytes: int, more: bool = False) -> None:
        self.incoming.put_nowait({"type": "http.request", "body": bytes(n_bytes), "more_body": more})

    @property
    def status(self) -> int | None:
        return self.answers[0]["status"] if self.answers else None

    @property
    def limit(self) -> str:
        problem = json.loads(b"".join(message.get("body", b"") for message in self.answers))
        assert (self.status, problem["code"]) == (503, "overloaded")
        assert (b"retry-after", b"1") in self.answers[0]["headers"]
        found: str = problem["limit"]
        return found


async def application(scope: Scope, receive: Receive, send: Send) -> None:
    """Reads the body if there is one, answers when the test lets it."""
    exchange: Exchange = scope["exchange"]
    try:
        while scope["headers"]:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            exchange.n_read += len(message["body"])
            if not message["more_body"]:
                break
    except OverloadedError as error:
        await error_response(scope, error)(scope, receive, send)
        return
    if "breaks" in scope["path"]:
        raise RuntimeError("broken")
    await exchange.may_answer.wait()
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await exchange.may_end.wait()
    await send({"type": "http.response.body", "body": b""})


class Door:
    """The middleware before the application, and requests through it."""

    def __init__(self, full: frozenset[Priority] = frozenset(), limits: AdmissionLimits = LIMITS) -> None:
        self.middleware = AdmissionMiddleware(application, limits, lambda priority: priority in full)
        self.tasks: list[asyncio.Task[None]] = []

    async def ask(
        self, path: str = "/v1/domains", method: str = "GET", declared: int | None = None, chunked: bool = False
    ) -> Exchange:
        exchange = Exchange()
        headers = [] if declared is None else [(b"content-length", str(declared).encode())]
        headers += [(b"transfer-encoding", b"chunked")] * chunked
        scope = {"type": "http", "method": method, "path": path, "headers": headers, "exchange": exchange}
        call: Coroutine[Any, Any, None] = self.middleware(scope, exchange.incoming.get, exchange.send)
        self.tasks.append(asyncio.ensure_future(call))
        await settle()
        return exchange

    @property
    def in_use(self) -> tuple[int, int, int, int]:
        shares = self.middleware.shares
        return shares.n_requests, shares.n_uploads, shares.n_event_streams, shares.n_body_bytes


async def settle() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    def runs() -> None:
        asyncio.run(test())

    runs.__name__ = test.__name__
    return runs


@run
async def test_more_requests_than_may_be_under_way() -> None:
    door = Door()
    first, second = await door.ask(), await door.ask()
    third = await door.ask()
    assert third.limit == "max_requests"
    first.may_answer.set()
    await settle()
    assert first.status == 200
    fourth = await door.ask()
    assert fourth.status is None
    for exchange in (second, fourth):
        exchange.may_answer.set()
    await asyncio.gather(*door.tasks)
    assert door.in_use == (0, 0, 0, 0)


@run
async def test_health_is_always_answered() -> None:
    door = Door(full=frozenset(Priority))
    await door.ask()
    await door.ask()
    for path in ("/healthz", "/readyz", "/metrics"):
        exchange = await door.ask(path)
        exchange.may_answer.set()
        await settle()
        assert exchange.status == 200


@run
async def test_a_body_on_its_way_takes_nobodys_turn() -> None:
    door = Door()
    slow = [await door.ask(method="PUT", declared=100) for _ in range(10)]
    for exchange in slow:
        exchange.came(10, more=True)
    quick = await door.ask()
    quick.may_answer.set()
    await settle()
    assert quick.status == 200
    for exchange in slow:  # all are whole at once: two are done, the others come back later
        exchange.came(90)
    await settle()
    assert [exchange.status for exchange in slow] == [None] * 2 + [503] * 8
    assert slow[2].limit == "max_requests"
    assert door.in_use[0] == 2


@run
async def test_an_answer_that_is_read_slowly_takes_nobodys_turn() -> None:
    door = Door()
    for _ in range(5):
        reader = await door.ask()
        reader.may_end.clear()
        reader.may_answer.set()
        await settle()
        assert reader.status == 200
    assert door.in_use[0] == 0


@run
async def test_uploads() -> None:
    door = Door()
    first = await door.ask(UPLOAD, "POST", declared=10_000_000)
    assert (await door.ask(UPLOAD, "POST", declared=10)).limit == "max_uploads"
    first.came(10_000_000)
    await settle()
    assert door.in_use == (1, 1, 0, 0)  # what goes to the disk is no memory
    first.incoming.put_nowait(LEFT)
    first.may_answer.set()
    await settle()
    assert door.in_use == (0, 0, 0, 0)
    assert (await door.ask(UPLOAD, "POST", declared=10)).status is None


@run
async def test_event_streams_count_apart() -> None:
    door = Door()
    stream = await door.ask(EVENTS)
    assert (await door.ask(EVENTS)).limit == "max_event_streams"
    assert door.in_use == (0, 0, 1, 0)
    stream.may_answer.set()
    await settle()
    assert (await door.ask(EVENTS)).status is None


@run
async def test_bodies_that_fill_the_memory() -> None:
    door = Door()
    first = await door.ask(method="PUT", chunked=True)
    first.came(FREE_BYTES, more=True)
    await settle()
    assert door.in_use[3] == 0
    for n_bytes in (300, 300):
        first.came(n_bytes, more=True)
    await settle()
    assert door.in_use[3] == 600
    # One that says that it will not fit is refused before a byte of it ...
    declared = await door.ask(method="PUT", declared=FREE_BYTES + 401)
    assert declared.limit == "max_body_memory_bytes"
    assert declared.n_read == 0
    # ... one that fits takes its room as it comes, and small ones always fit.
    fits = await door.ask(method="PUT", declared=FREE_BYTES + 400)
    small = await door.ask(method="PUT", declared=FREE_BYTES)
    small.came(FREE_BYTES)
    assert door.in_use[3] == 600
    # What comes in chunks is refused by the chunk that is too much.
    chunked = await door.ask(method="PUT", chunked=True)
    chunked.came(FREE_BYTES + 400, more=True)
    await settle()
    assert chunked.status is None
    chunked.came(1, more=True)
    await settle()
    assert chunked.limit == "max_body_memory_bytes"
    assert door.in_use[3] == 600
    for exchange in (first, fits):
        exchange.incoming.put_nowait(LEFT)
    small.may_answer.set()
    await settle()
    assert door.in_use == (0, 0, 0, 0)


@run
async def test_more_than_all_memory_is_for_another_to_refuse() -> None:
    door = Door()
    exchange = await door.ask(method="PUT", declared=10_000_000)
    assert exchange.status is None


@pytest.mark.filterwarnings("default::ResourceWarning")
@run
async def test_nothing_is_kept_by_what_breaks_or_is_cancelled() -> None:
    door = Door()
    broken = await door.ask("/breaks", method="PUT", declared=FREE_BYTES + 5)
    broken.came(FREE_BYTES + 5)
    cancelled = await door.ask(UPLOAD, "POST", declared=5)
    stream = await door.ask(EVENTS)
    await settle()
    for task in door.tasks[1:]:
        task.cancel()
    ended = await asyncio.gather(*door.tasks, return_exceptions=True)
    assert [type(error) for error in ended] == [RuntimeError, asyncio.CancelledError, asyncio.CancelledError]
    assert cancelled.status is stream.status is None
    assert door.in_use == (0, 0, 0, 0)


@run
async def test_a_full_queue_refuses_those_who_would_join_it() -> None:
    live, batch = frozenset({Priority.LIVE}), frozenset({Priority.BATCH})
    for path, method, queue in (
        ("/v1/domains/d/localizations", "POST", live),
        ("/v1/domains/d/sessions", "POST", live),
        ("/v1/sessions/s/observations", "POST", live),
        ("/v1/sessions/s/prior", "PUT", live),
        (f"{UPLOAD}/3", "PUT", batch),
    ):
        assert (await Door(queue).ask(path, method, declared=5)).limit == "max_queue"
        assert (await Door(live | batch - queue).ask("/v1/domains")).status is None
    assert (await Door(batch).ask("/v1/domains/d/localizations", "POST", declared=5)).status is None
    assert (await Door(live).ask(f"{UPLOAD}/3", "PUT", declared=5)).status is None
