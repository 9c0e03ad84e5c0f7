"""Keys: what a request may carry, what the ring makes of it; rates, on a clock of our own."""

import asyncio
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from starlette.types import Scope

from deepsimbad.api import keys
from deepsimbad.api.keys import KEPT_S, KeyRing, RateLimit, needed_scope, presented_key
from deepsimbad.errors import RateLimitedError, UnauthorizedError, UnavailableError
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
    assert (ring.is_open, len(ring.by_id), ring.n_usable) == (True, 0, 0)
    record, key = catalog.create_key(KeyScope.LOCALIZE)
    assert ring.is_open, "it asks the catalog now and then, not every time"
    asyncio.run(ring.reread())
    assert (ring.is_open, len(ring.by_id), ring.n_usable) == (False, 1, 1)
    assert ring.holder(key.text) == record


def test_all_revoked_is_closed(catalog: Catalog) -> None:
    record, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog)
    catalog.revoke_key(record.key_id)
    asyncio.run(ring.reread())
    assert (ring.is_open, len(ring.by_id), ring.n_usable) == (False, 1, 0)
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
    real = keys.hmac.compare_digest

    def watched(given: str, kept: str) -> bool:
        compared.append((given, kept))
        return real(given, kept)

    monkeypatch.setattr(keys.hmac, "compare_digest", watched)
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
    monkeypatch.setattr(keys, "REREAD_S", 0.001)
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


# Rates


class Clock:
    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> float:
        return self.s


def taken(limit: RateLimit, key_id: str, n: int) -> int:
    """How many of n requests pass."""
    passed = 0
    for _ in range(n):
        try:
            limit.take(key_id)
        except RateLimitedError:
            continue
        passed += 1
    return passed


def test_a_burst_then_the_rate() -> None:
    clock = Clock()
    limit = RateLimit(2.0, 5, clock)
    assert taken(limit, "a", 10) == 5
    assert taken(limit, "b", 10) == 5, "each key has its own"
    clock.s += 1.0
    assert taken(limit, "a", 10) == 2
    clock.s += 1000.0
    assert taken(limit, "a", 10) == 5, "no more than a burst is saved up"


def test_in_the_long_run_it_is_the_rate() -> None:
    clock = Clock()
    limit = RateLimit(3.0, 4, clock)
    passed = 0
    for _ in range(1000):
        clock.s += 0.1
        passed += taken(limit, "a", 2)
    assert passed == pytest.approx(4 + 3.0 * 100, abs=1)


def test_a_refusal_says_how_long_to_wait_and_costs_nothing() -> None:
    clock = Clock()
    limit = RateLimit(0.25, 1, clock)
    limit.take("a")
    for _ in range(3):
        with pytest.raises(RateLimitedError) as caught:
            limit.take("a")
        assert caught.value.hints == {"retry_after_s": 4, "rate_limit_per_s": 0.25, "rate_limit_burst": 1}
    clock.s += 3.0
    with pytest.raises(RateLimitedError) as caught:
        limit.take("a")
    assert caught.value.hints["retry_after_s"] == 1
    clock.s += 1.0
    limit.take("a")


def test_no_limit() -> None:
    limit = RateLimit(0.0, 1, Clock())
    assert taken(limit, "a", 1000) == 1000
    assert limit.n_buckets == 0


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "MAX_BUCKETS", 3)
    limit = RateLimit(1.0, 1, Clock())
    for key_id in ("a", "b", "c"):
        limit.take(key_id)
    assert taken(limit, "a", 1) == 0
    limit.take("d")  # b was used longest ago
    assert limit.n_buckets == 3
    assert [taken(limit, key_id, 1) for key_id in ("a", "c", "d")] == [0, 0, 0]
    assert taken(limit, "b", 1) == 1
