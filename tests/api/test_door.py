"""The door, request by request: who is let in, how much at once, how long a body may be."""

import asyncio
import json
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from deepsimbad.api.door import FREE_BYTES, Door
from deepsimbad.api.keys import KeyRing
from deepsimbad.api.metrics import Metrics
from deepsimbad.api.problems import error_response
from deepsimbad.errors import BodyTooLargeError, OverloadedError
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import ApiKey
from deepsimbad.store.records import KeyScope

from .conftest import ring_of

BATCH = "/v1/admin/domains/d/traverses/t/frames"
LEFT = {"type": "http.disconnect"}
LIMITS = {"max_requests": 2, "max_body_memory_bytes": 1000}


@dataclass
class Exchange:
    """One request, sent and answered piece by piece as a test wants it."""

    scope: dict
    incoming: asyncio.Queue = field(default_factory=asyncio.Queue)
    answers: list = field(default_factory=list)
    may_answer: asyncio.Event = field(default_factory=asyncio.Event)
    may_end: asyncio.Event = field(default_factory=asyncio.Event)
    n_read: int = 0

    async def send(self, message):
        self.answers.append(message)

    def push(self, n_bytes, has_more=False):
        self.incoming.put_nowait({"type": "http.request", "body": bytes(n_bytes), "more_body": has_more})

    @property
    def status(self):
        return self.answers[0]["status"] if self.answers else None

    @property
    def headers(self):
        return {name.decode(): value.decode() for name, value in self.answers[0]["headers"]}

    def problem(self, status, code):
        document = json.loads(b"".join(message.get("body", b"") for message in self.answers))
        assert (self.status, document["code"]) == (status, code)
        assert self.headers["content-type"] == "application/problem+json"
        assert self.headers["x-request-id"] == document["request_id"]
        return document

    @property
    def limit(self):
        assert self.headers["retry-after"] == "1"
        return self.problem(503, "overloaded")["limit"]


async def application(scope, receive, send):
    """Reads the body if there is one, answers when the test lets it."""
    exchange = scope["exchange"]
    try:
        while (message := await receive())["type"] != "http.disconnect":
            exchange.n_read += len(message["body"])
            if not message["more_body"]:
                break
        else:
            return
    except (OverloadedError, BodyTooLargeError) as error:
        await error_response(scope, error)(scope, receive, send)
        return
    if "breaks" in scope["path"]:
        raise RuntimeError("broken")
    await exchange.may_answer.wait()
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await exchange.may_end.wait()
    await send({"type": "http.response.body", "body": b""})


class Asker:
    """The door before the application, and requests through it."""

    def __init__(self, keys=None, **settings):
        if keys is None:
            keys = KeyRing()
            keys.load(list)
        self.door = Door(application, Settings(data_dir=Path("none"), **{**LIMITS, **settings}), keys, Metrics())
        self.tasks = []

    async def ask(self, path="/v1/domains", method="GET", n_declared=None, **more_headers):
        """Send a head; a request without a body is whole by that."""
        headers = {
            "host": "127.0.0.1",
            **({} if n_declared is None else {"content-length": str(n_declared)}),
            **more_headers,
        }
        raw_headers = [(name.replace("_", "-").encode(), value.encode("latin-1")) for name, value in headers.items()]
        scope = {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "headers": raw_headers}
        exchange = scope["exchange"] = Exchange(scope)
        exchange.may_end.set()
        if n_declared is None and not {"transfer_encoding", "content_length"} & set(more_headers):
            exchange.push(0)
        self.tasks.append(asyncio.ensure_future(self.door(scope, exchange.incoming.get, exchange.send)))
        await settle()
        return exchange

    async def answered(self, path="/v1/domains", method="GET", **options):
        """Ask, and let the application answer."""
        exchange = await self.ask(path, method, **options)
        exchange.may_answer.set()
        await settle()
        return exchange

    @property
    def in_use(self):
        return self.door.under_way.n_taken, self.door.body_bytes.n_taken


async def settle():
    for _ in range(20):
        await asyncio.sleep(0)


pytestmark = pytest.mark.anyio


# How much at once


async def test_more_requests_than_may_be_under_way():
    door = Asker()
    first, second = await door.ask(), await door.ask()
    assert (await door.ask()).limit == "max_requests"
    for path in ("/healthz", "/readyz", "/metrics"):
        assert (await door.answered(path)).status == 200, "health is always answered"
    first.may_answer.set()
    await settle()
    assert first.status == 200
    fourth = await door.ask()
    assert fourth.status is None
    for exchange in (second, fourth):
        exchange.may_answer.set()
    await asyncio.gather(*door.tasks)
    assert door.in_use == (0, 0)


async def test_bodies_on_their_way_and_answers_read_slowly_take_nobodys_turn():
    door = Asker()
    slow = [await door.ask(method="PUT", n_declared=100) for _ in range(10)]
    for exchange in slow:
        exchange.push(10, has_more=True)
    for _ in range(3):
        reader = await door.ask()
        reader.may_end.clear()
        reader.may_answer.set()
        await settle()
        assert (reader.status, door.in_use[0]) == (200, 0)
    for exchange in slow:  # all are whole at once: two are done, the others come back later
        exchange.push(90)
    await settle()
    assert [exchange.status for exchange in slow] == [None] * 2 + [503] * 8
    assert slow[2].limit == "max_requests"
    assert door.in_use[0] == 2


async def test_bodies_that_fill_the_memory():
    door = Asker(max_requests=10)
    first_exchange = await door.ask(method="PUT", transfer_encoding="chunked")
    for n_bytes, n_held in ((FREE_BYTES, 0), (300, 300), (300, 600)):
        first_exchange.push(n_bytes, has_more=True)
        await settle()
        assert door.in_use[1] == n_held
    # One that says that it will not fit is refused before a byte of it ...
    large_exchange = await door.ask(method="PUT", n_declared=FREE_BYTES + 401)
    assert (large_exchange.limit, large_exchange.n_read) == ("max_body_memory_bytes", 0)
    # ... one that fits takes its room as it comes, and small ones always fit.
    fitting_exchange = await door.ask(method="PUT", n_declared=FREE_BYTES + 400)
    small_exchange = await door.ask(method="PUT", n_declared=FREE_BYTES)
    small_exchange.push(FREE_BYTES)
    assert door.in_use[1] == 600
    # What comes in chunks is refused by the chunk that is too much.
    chunked_exchange = await door.ask(method="PUT", transfer_encoding="chunked")
    chunked_exchange.push(FREE_BYTES + 400, has_more=True)
    await settle()
    assert chunked_exchange.status is None
    chunked_exchange.push(1, has_more=True)
    await settle()
    assert (chunked_exchange.limit, door.in_use[1]) == ("max_body_memory_bytes", 600)
    # A batch goes to the disk.
    batch_exchange = await door.ask(BATCH, "POST", n_declared=10_000_000)
    batch_exchange.push(10_000_000)
    await settle()
    assert (batch_exchange.status, door.in_use[1]) == (None, 600)
    for exchange in (first_exchange, fitting_exchange):
        exchange.incoming.put_nowait(LEFT)
    for exchange in (small_exchange, batch_exchange):
        exchange.may_answer.set()
    await settle()
    assert door.in_use == (0, 0)


@pytest.mark.filterwarnings("default::ResourceWarning")
async def test_nothing_is_kept_by_what_breaks_or_is_cancelled():
    door = Asker()
    broken_exchange = await door.ask("/breaks", method="PUT", n_declared=FREE_BYTES + 5)
    broken_exchange.push(FREE_BYTES + 5)
    cancelled_exchange = await door.ask(BATCH, "POST", n_declared=5)
    await settle()
    door.tasks[1].cancel()
    await asyncio.gather(*door.tasks)
    broken_exchange.problem(500, "internal_error")
    assert cancelled_exchange.problem(503, "unavailable")["detail"] == "the service is shutting down"
    assert door.in_use == (0, 0)


# How long a body may be


async def test_a_body_at_the_limit_passes_and_one_over_it_is_refused_at_the_byte_that_shows_it():
    door = Asker(max_json_bytes=100)
    for sizes, status in (([50, 50], 200), ([50, 50, 1, 50], 413)):
        exchange = await door.ask(method="POST", transfer_encoding="chunked")
        exchange.may_answer.set()
        for place, n_bytes in enumerate(sizes, 1):
            exchange.push(n_bytes, has_more=place < len(sizes))
        await settle()
        assert exchange.status == status
    assert exchange.n_read == 100
    assert exchange.problem(413, "body_too_large")["max_bytes"] == 100


@pytest.mark.parametrize(
    ("path", "content_type", "limit"),
    [
        ("/v1/x", "application/json", 100),
        ("/v1/x", "image/JPEG", 200),
        (BATCH, "application/octet-stream", 300),
        ("/v1/x", "application/octet-stream", 100),
    ],
)
async def test_a_declared_length_over_the_limit_never_reaches_the_application(path, content_type, limit):
    door = Asker(max_json_bytes=100, max_image_bytes=200, max_batch_bytes=300)
    exchange = await door.ask(path, "POST", n_declared=limit + 1, content_type=content_type)
    assert (exchange.problem(413, "body_too_large")["max_bytes"], exchange.n_read) == (limit, 0)
    assert (await door.ask(path, "POST", n_declared=limit, content_type=content_type)).status is None


@pytest.mark.parametrize(("length", "status"), [("-1", 422), ("x", 422), ("1e3", 422), ("24 ", None), (" 24\t", None)])
async def test_a_length_is_a_number_with_legal_white_space(length, status):
    assert (await Asker().ask(method="POST", content_length=length)).status == status


@pytest.mark.parametrize(
    ("coding", "is_taken"), [("GZIP", False), ("identity, br", False), ("identity", True), ("", True)]
)
async def test_a_packed_body_is_refused(coding, is_taken):
    exchange = await Asker().ask(method="POST", n_declared=5, content_encoding=coding)
    assert exchange.status == (None if is_taken else 415)
    assert is_taken or exchange.problem(415, "unsupported_media_type")["allowed"] == ["identity"]
    assert (await Asker().answered(content_encoding=coding)).status == 200, "there is no body"


# Who is let in


def bearer(key):
    return f"Bearer {key.text}"


async def test_scopes(catalog):
    _, robot = catalog.create_key(KeyScope.LOCALIZE)
    record, admin = catalog.create_key(KeyScope.ADMIN)
    door = Asker(ring_of(catalog))
    for path, key in (("/v1/domains", robot), ("/v1/domains", admin), ("/v1/admin/jobs", admin)):
        exchange = await door.answered(path, authorization=bearer(key))
        assert exchange.status == 200, path
    assert exchange.scope["state"]["key_id"] == record.key_id
    forbidden_exchange = await door.ask("/v1/admin/jobs", authorization=bearer(robot))
    assert forbidden_exchange.problem(403, "forbidden")["needed"] == "admin"
    refused = await door.ask("/v1/admin/domains/a", "PUT", n_declared=1000, x_api_key="dsk_x")
    refused.push(1000)
    refused.problem(401, "unauthorized")
    assert (refused.n_read, refused.incoming.qsize(), refused.headers["www-authenticate"]) == (0, 1, "Bearer")
    assert (await door.answered("/healthz")).status == 200


async def test_the_log_line_of_a_revoked_key_says_whose(catalog):
    record, key = catalog.create_key(KeyScope.LOCALIZE)
    ring = ring_of(catalog)
    catalog.revoke_key(record.key_id)
    await ring.reread()
    revoked = await Asker(ring).ask(authorization=bearer(key))
    assert (revoked.status, revoked.scope["state"]["key_id"]) == (401, record.key_id)
    forged = await Asker(ring).ask(authorization=bearer(ApiKey(record.key_id, ApiKey.new().secret)))
    assert "key_id" not in forged.scope["state"], "who only knows an id is nobody"


async def test_keys_that_were_never_read_let_nobody_in():
    door = Asker(KeyRing())
    exchange = await door.ask()
    assert (exchange.status, exchange.headers["retry-after"]) == (503, "5")
    assert (await door.answered("/healthz")).status == 200


async def test_the_rate_is_counted_by_key(catalog):
    (_, key), (_, other) = (catalog.create_key(KeyScope.LOCALIZE) for _ in range(2))
    door = Asker(ring_of(catalog), rate_limit_per_s=0.5, rate_limit_burst=2)
    assert [(await door.answered(authorization=bearer(key))).status for _ in range(3)] == [200, 200, 429]
    exchange = await door.ask(authorization=bearer(key))
    exchange.problem(429, "rate_limited")
    assert exchange.headers["retry-after"] == "2"
    assert (await door.answered(authorization=bearer(other))).status == 200
    assert (await door.answered("/readyz", authorization=bearer(key))).status == 200


async def test_an_open_service_asks_nobody():
    for headers in ({}, {"authorization": "Bearer nonsense"}, {"authorization": "Bearer a", "x_api_key": "b"}):
        assert (await Asker(rate_limit_per_s=0.5, rate_limit_burst=1).answered(**headers)).status == 200


# Pages of other hosts

OURS = ("127.0.0.1", "127.0.0.1:8000", "localhost:1", "LOCALHOST", "[::1]:80")
OTHERS = ("robot.lan:8000", "evil.example", "192.168.1.2", "localhost.evil.example", "127.0.0.1.evil.example")


@pytest.mark.parametrize("host", [*OURS, *OTHERS, "[::1", "127.0.0.1@evil.example"])
async def test_while_no_key_is_asked_only_the_names_of_this_machine_are_answered(host):
    for path in ("/v1/admin/domains", "/v1/domains", "/metrics"):
        exchange = await Asker().answered(path, host=host)
        assert exchange.status == (200 if host in OURS else 403), path
        assert host in OURS or exchange.problem(403, "foreign_host")


async def test_the_name_that_is_listened_on_is_answered_too(catalog):
    assert (await Asker(host="127.0.0.7").answered(host="127.0.0.7:80")).status == 200
    assert (await Asker(host="0.0.0.0", allow_open=True).answered(host="robot.lan")).status == 200
    _, key = catalog.create_key(KeyScope.ADMIN)
    closed = Asker(ring_of(catalog))
    assert (await closed.answered(host="robot.lan", authorization=bearer(key), origin="https://a")).status == 200


@pytest.mark.parametrize(
    ("origin", "allowed", "status"),
    [
        ("http://127.0.0.1:8000", (), 200),
        ("http://127.0.0.1", (), 403),
        ("https://evil.example", (), 403),
        ("null", (), 403),
        ("https://map.example", ("https://map.example",), 200),
        ("https://evil.example", ("https://map.example",), 403),
        ("https://evil.example", ("*",), 200),
    ],
)
async def test_while_no_key_is_asked_no_foreign_page_is_answered(origin, allowed, status):
    for settings in ({}, {"host": "0.0.0.0", "allow_open": True}):
        door = Asker(cors_origins=allowed, **settings)
        exchange = await door.answered("/v1/admin/domains/d", "DELETE", host="127.0.0.1:8000", origin=origin)
        assert exchange.status == status
