"""Keys: what a request may carry, what the ring makes of it, and that nothing is read before."""

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from deepsimbad.api import auth
from deepsimbad.api.auth import KEPT_S, AuthMiddleware, KeyRing, needed_scope, presented_key
from deepsimbad.api.rate_limit import RateLimit
from deepsimbad.errors import UnauthorizedError, UnavailableError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_keys import ApiKey
from deepsimbad.store.records import KeyRecord, KeyScope

KEY = ApiKey.new()


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(tmp_path) as opened:
        yield opened


def scope_of(path: str = "/v1/domains", *headers: tuple[str, bytes], method: str = "GET") -> Scope:
    sent = [(name.lower().encode(), value) for name, value in headers]
    return {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "headers": sent}


def bearer(text: str) -> tuple[str, bytes]:
    return ("Authorization", f"Bearer {text}".encode("latin-1"))


# Headers


@pytest.mark.parametrize(
    "headers",
    [
        [("Authorization", b"Bearer " + KEY.text.encode())],
        [("Authorization", b"bEaReR   " + KEY.text.encode() + b"  ")],
        [("X-API-Key", KEY.text.encode())],
        [("Authorization", b"Bearer " + KEY.text.encode()), ("X-API-Key", KEY.text.encode())],
        [("Authorization", b"Basic dXNlcjpwYXNz"), ("X-API-Key", KEY.text.encode())],
    ],
)
def test_one_key(headers: list[tuple[str, bytes]]) -> None:
    assert presented_key(scope_of("/v1", *headers)) == KEY.text


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ([], "no key came"),
        ([("Authorization", b"Basic dXNlcjpwYXNz")], "no key came"),
        ([("Authorization", b"")], "no key came"),
        ([("Cookie", b"key=" + KEY.text.encode())], "no key came"),
        ([("Authorization", b"Bearer a"), ("X-API-Key", b"b")], "more than one"),
        ([("Authorization", b"Bearer a"), ("Authorization", b"Bearer a")], "more than one"),
        ([("Authorization", b"Basic a"), ("Authorization", b"Bearer a")], "more than one"),
        ([("X-API-Key", b"a"), ("X-API-Key", b"a")], "more than one"),
        ([("X-API-Key", KEY.text.encode() + b"\xff")], "malformed"),
        ([("Authorization", "Bearer ключ".encode())], "malformed"),
    ],
)
def test_no_one_key(headers: list[tuple[str, bytes]], why: str) -> None:
    with pytest.raises(UnauthorizedError, match=why):
        presented_key(scope_of("/v1", *headers))


@pytest.mark.parametrize(
    ("path", "needed"),
    [
        ("/healthz", None),
        ("/", None),
        ("/v1x", None),
        ("/v1", KeyScope.LOCALIZE),
        ("/v1/", KeyScope.LOCALIZE),
        ("/v1/domains", KeyScope.LOCALIZE),
        ("/v1/administrators", KeyScope.LOCALIZE),
        ("/v1/admin", KeyScope.ADMIN),
        ("/v1/admin/", KeyScope.ADMIN),
        ("/v1/admin/jobs", KeyScope.ADMIN),
    ],
)
def test_what_a_path_needs(path: str, needed: KeyScope | None) -> None:
    assert needed_scope(path) is needed


# The ring


def ring_of(catalog: Catalog, clock: Callable[[], float] = time.monotonic) -> KeyRing:
    ring = KeyRing(clock)
    ring.load(catalog.keys)
    return ring


def test_a_ring_without_keys_is_open_until_the_first(catalog: Catalog) -> None:
    ring = ring_of(catalog)
    assert (ring.is_open, ring.n_created, ring.n_usable) == (True, 0, 0)
    record, key = catalog.create_key(KeyScope.LOCALIZE)
    assert ring.is_open, "it asks the catalog now and then, not every time"
    asyncio.run(ring.reread())
    assert (ring.is_open, ring.n_created, ring.n_usable) == (False, 1, 1)
    assert ring.holder(key.text) == record


def test_all_revoked_is_closed(catalog: Catalog) -> None:
    record, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog)
    catalog.revoke_key(record.key_id)
    asyncio.run(ring.reread())
    assert (ring.is_open, ring.n_created, ring.n_usable) == (False, 1, 0)
    with pytest.raises(UnauthorizedError, match="revoked") as caught:
        ring.holder(key.text)
    assert caught.value.hints == {"key_id": record.key_id}


def test_a_long_answer_ends_with_its_key(catalog: Catalog) -> None:
    ring = ring_of(catalog)
    assert ring.still_opens(None)
    record, _ = catalog.create_key(KeyScope.ADMIN)
    asyncio.run(ring.reread())
    assert ring.still_opens(record.key_id)
    assert not ring.still_opens(None), "it was let in while no key was asked"
    catalog.revoke_key(record.key_id)
    asyncio.run(ring.reread())
    assert not ring.still_opens(record.key_id)


def test_once_closed_it_never_opens_again(catalog: Catalog) -> None:
    catalog.create_key(KeyScope.ADMIN)
    kept = catalog.keys()
    ring = KeyRing()
    ring.load(lambda: kept)
    kept = []
    asyncio.run(ring.reread())
    assert not ring.is_open


def test_what_is_not_a_key_of_ours(catalog: Catalog) -> None:
    record, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog)
    wrong = ApiKey(record.key_id, ApiKey.new().secret)
    for text, why in (
        (wrong.text, "not known"),
        (ApiKey.new().text, "not known"),
        (key.text[:-1], "malformed"),
        (key.text + "A", "malformed"),
        ("", "malformed"),
        ("x" * 100_000, "malformed"),
        (record.secret_sha256, "malformed"),
        (f"dsk_{record.key_id}_{record.secret_sha256[:43]}", "not known"),
    ):
        with pytest.raises(UnauthorizedError, match=why) as caught:
            ring.holder(text)
        assert caught.value.hints == {}, "only its holder learns more"


def test_an_expired_key(catalog: Catalog) -> None:
    _, key = catalog.create_key(KeyScope.ADMIN, lifetime=timedelta(milliseconds=1))
    ring = ring_of(catalog)
    time.sleep(0.01)
    with pytest.raises(UnauthorizedError, match="expired"):
        ring.holder(key.text)
    assert ring.n_usable == 0
    assert not ring.is_open


def test_every_key_is_compared_known_or_not(catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    record, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog)
    compared: list[tuple[str, str]] = []
    real = auth.hmac.compare_digest

    def watched(given: str, kept: str) -> bool:
        compared.append((given, kept))
        return real(given, kept)

    monkeypatch.setattr(auth.hmac, "compare_digest", watched)
    unknown = ApiKey.new()
    with pytest.raises(UnauthorizedError):
        ring.holder(unknown.text)
    ring.holder(key.text)
    assert [given for given, _ in compared] == [unknown.secret_sha256, key.secret_sha256]
    assert {len(kept) for _, kept in compared} == {64}
    assert compared[1][1] == record.secret_sha256


def test_a_catalog_that_cannot_be_read_lets_the_last_known_keys_count_for_a_while(catalog: Catalog) -> None:
    now_s = 0.0
    _, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog, lambda: now_s)
    catalog.close()
    now_s = KEPT_S - 1
    asyncio.run(ring.reread())
    assert not ring.is_open
    assert ring.holder(key.text).scope is KeyScope.ADMIN
    now_s = KEPT_S + 1
    asyncio.run(ring.reread())
    with pytest.raises(UnavailableError):
        _ = ring.is_open


def test_an_open_service_whose_catalog_cannot_be_read_does_not_stay_open(catalog: Catalog) -> None:
    now_s = 0.0
    ring = ring_of(catalog, lambda: now_s)
    catalog.close()
    now_s = KEPT_S + 1
    asyncio.run(ring.reread())
    with pytest.raises(UnavailableError):
        _ = ring.is_open


def test_a_ring_that_was_never_read_is_not_open() -> None:
    with pytest.raises(UnavailableError):
        _ = KeyRing().is_open


def test_it_follows_the_catalog(catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(auth, "REREAD_S", 0.001)
    n_read = 0

    def read() -> list[KeyRecord]:
        nonlocal n_read
        n_read += 1
        if n_read == 3:
            raise RuntimeError("something that nobody foresaw")
        return catalog.keys()

    async def until_closed() -> None:
        ring = KeyRing()
        ring.load(read)
        following = asyncio.create_task(ring.follow())
        while n_read < 5:
            await asyncio.sleep(0.001)
        catalog.create_key(KeyScope.ADMIN)
        while ring.is_open:
            await asyncio.sleep(0.001)
        following.cancel()

    asyncio.run(asyncio.wait_for(until_closed(), 30))


# The middleware


class Caller:
    """Sends one request straight to the middleware; notes whether the application and the body were reached."""

    def __init__(self, ring: KeyRing, rate_limit: RateLimit | None = None) -> None:
        self.middleware = AuthMiddleware(self._app, ring, rate_limit or RateLimit(0, 1))
        self.n_reached = 0
        self.n_received = 0

    async def _app(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.n_reached += 1
        self.reached = scope

    def __call__(self, scope: Scope) -> tuple[int, dict[str, str], dict[str, Any]] | None:
        sent: list[Message] = []

        async def receive() -> Message:
            self.n_received += 1
            return {"type": "http.disconnect"}

        async def send(message: Message) -> None:
            sent.append(message)

        asyncio.run(self.middleware(scope, receive, send))
        if not sent:
            return None
        headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
        return sent[0]["status"], headers, json.loads(b"".join(each.get("body", b"") for each in sent[1:]))


def test_scopes(catalog: Catalog) -> None:
    _, robot = catalog.create_key(KeyScope.LOCALIZE)
    admin_record, admin = catalog.create_key(KeyScope.ADMIN)
    call = Caller(ring_of(catalog))
    for path, key in (("/v1/domains", robot), ("/v1/domains", admin), ("/v1/admin/jobs", admin)):
        assert call(scope_of(path, bearer(key.text))) is None, path
    assert call.n_reached == 3
    assert call.reached["state"]["key_id"] == admin_record.key_id
    answer = call(scope_of("/v1/admin/jobs", bearer(robot.text)))
    assert answer is not None
    assert (answer[0], answer[2]["code"], answer[2]["needed"]) == (403, "forbidden", "admin")
    assert call(scope_of("/healthz")) is None
    assert call.n_reached == 4


def test_the_log_line_of_a_revoked_key_says_whose(catalog: Catalog) -> None:
    record, key = catalog.create_key(KeyScope.LOCALIZE)
    ring = ring_of(catalog)
    catalog.revoke_key(record.key_id)
    asyncio.run(ring.reread())
    scope = scope_of("/v1/domains", bearer(key.text))
    answer = Caller(ring)(scope)
    assert answer is not None
    assert answer[0] == 401
    assert scope["state"]["key_id"] == record.key_id
    forged = scope_of("/v1/domains", bearer(ApiKey(record.key_id, ApiKey.new().secret).text))
    Caller(ring)(forged)
    assert "key_id" not in forged["state"], "who only knows an id is nobody"


def test_refused_before_the_body(catalog: Catalog) -> None:
    catalog.create_key(KeyScope.ADMIN)
    call = Caller(ring_of(catalog))
    scope = scope_of("/v1/admin/domains/a", ("Content-Length", b"1000"), bearer("dsk_x"), method="PUT")
    answer = call(scope)
    assert answer is not None
    status, headers, problem = answer
    assert (status, problem["code"]) == (401, "unauthorized")
    assert headers["www-authenticate"] == "Bearer"
    assert headers["content-type"] == "application/problem+json"
    assert (call.n_reached, call.n_received) == (0, 0)


def test_no_ring_no_entry() -> None:
    call = Caller(KeyRing())
    answer = call(scope_of("/v1/domains"))
    assert answer is not None
    assert (answer[0], answer[1]["retry-after"]) == (503, "5")
    assert call(scope_of("/healthz")) is None


def test_the_rate_is_counted_by_key(catalog: Catalog) -> None:
    _, one = catalog.create_key(KeyScope.LOCALIZE)
    _, other = catalog.create_key(KeyScope.LOCALIZE)
    call = Caller(ring_of(catalog), RateLimit(0.5, 2))
    assert [call(scope_of("/v1/domains", bearer(one.text))) for _ in range(2)] == [None, None]
    answer = call(scope_of("/v1/domains", bearer(one.text)))
    assert answer is not None
    status, headers, problem = answer
    assert (status, problem["code"], headers["retry-after"]) == (429, "rate_limited", "2")
    assert call(scope_of("/v1/domains", bearer(other.text))) is None
    assert call(scope_of("/readyz", bearer(one.text))) is None


def test_an_open_service_asks_nobody(catalog: Catalog) -> None:
    call = Caller(ring_of(catalog), RateLimit(0.5, 1))
    for headers in ([], [bearer("nonsense")], [bearer("a"), ("X-API-Key", b"b")]):
        assert call(scope_of("/v1/admin/jobs", *headers)) is None
