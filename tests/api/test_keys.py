"""Keys in requests, the ring that checks them, and rates on a clock of the test's own."""

import asyncio
import time
from datetime import timedelta

import pytest

from deepsimbad.api import keys
from deepsimbad.api.keys import GRACE_S, KeyRing, RateLimit, presented_key
from deepsimbad.errors import RateLimitedError, UnauthorizedError, UnavailableError
from deepsimbad.store.catalog import ApiKey
from deepsimbad.store.records import KeyScope

from .conftest import ring_of

KEY = ApiKey.new().text.encode()
PATH = "/v1/domains"
BEARER, BASIC, OWN = (
    (b"authorization", b"Bearer " + KEY),
    (b"authorization", b"Basic dXNlcjpwYXNz"),
    (b"x-api-key", KEY),
)


# Headers


@pytest.mark.parametrize(
    ("headers", "complaint"),
    [
        ([BEARER], None),
        ([(b"authorization", b"bEaReR   " + KEY + b"  ")], None),
        ([OWN], None),
        ([BEARER, OWN], None),
        ([BASIC, OWN], None),
        ([], "no key came"),
        ([BASIC], "no key came"),
        ([(b"authorization", b"")], "no key came"),
        ([(b"cookie", b"key=" + KEY)], "no key came"),
        ([BEARER, (b"x-api-key", b"b")], "more than one"),
        ([BEARER, BEARER], "more than one"),
        ([BASIC, BEARER], "more than one"),
        ([OWN, OWN], "more than one"),
        ([(b"x-api-key", KEY + b"\xff")], "malformed"),
        ([(b"authorization", "Bearer ключ".encode())], "malformed"),
    ],
)
def test_a_request_carries_one_key(headers, complaint):
    if complaint is None:
        assert presented_key({"headers": headers}) == KEY.decode()
        return
    with pytest.raises(UnauthorizedError, match=complaint):
        presented_key({"headers": headers})


# The ring


def test_a_ring_without_keys_is_open_until_the_first_and_closed_for_good(catalog):
    ring = ring_of(catalog)
    assert (ring.scope_for(PATH), len(ring.by_id), ring.still_opens(None)) == (None, 0, True)
    record, key = catalog.create_key(KeyScope.LOCALIZE)
    assert ring.scope_for(PATH) is None, "it asks the catalog now and then, not every time"
    asyncio.run(ring.reread())
    assert (ring.scope_for(PATH), len(ring.by_id)) == (KeyScope.LOCALIZE, 1)
    assert ring.holder(key.text) == record
    assert ring.still_opens(record.key_id)
    assert not ring.still_opens(None), "a long answer ends that was begun while no key was asked"
    catalog.revoke_key(record.key_id)
    asyncio.run(ring.reread())
    assert (ring.scope_for(PATH), len(ring.by_id)) == (KeyScope.LOCALIZE, 1)
    assert not ring.still_opens(record.key_id)
    with pytest.raises(UnauthorizedError, match="revoked") as caught:
        ring.holder(key.text)
    assert caught.value.hints == {"key_id": record.key_id}
    ring.load(list)
    assert ring.scope_for(PATH) is KeyScope.LOCALIZE


def test_who_shares_the_keys_is_told_of_a_change_before_it_counts_here(catalog):
    ring, n_keys = ring_of(catalog), []

    async def announce():
        n_keys.append(len(ring.by_id))

    ring.announce = announce
    for _ in range(2):
        catalog.create_key(KeyScope.LOCALIZE)
        for _ in range(2):
            asyncio.run(ring.reread())
    assert (n_keys, len(ring.by_id)) == ([0, 1], 2)


def test_what_is_not_a_key_of_ours(catalog):
    record, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog)
    for text, complaint in (
        (ApiKey(record.key_id, ApiKey.new().secret).text, "not known"),
        (ApiKey.new().text, "not known"),
        (f"dsk_{record.key_id}_{record.secret_sha256[:43]}", "not known"),
        (key.text[:-1], "malformed"),
        (key.text + "A", "malformed"),
        ("", "malformed"),
        ("x" * 100_000, "malformed"),
        (record.secret_sha256, "malformed"),
    ):
        with pytest.raises(UnauthorizedError, match=complaint) as caught:
            ring.holder(text)
        assert caught.value.hints == {}, "only its holder learns more"


def test_an_expired_key(catalog):
    _, key = catalog.create_key(KeyScope.ADMIN, lifetime=timedelta(milliseconds=1))
    ring = ring_of(catalog)
    time.sleep(0.01)
    with pytest.raises(UnauthorizedError, match="expired"):
        ring.holder(key.text)
    assert (any(map(ring.still_opens, ring.by_id)), ring.scope_for(PATH)) == (False, KeyScope.LOCALIZE)


def test_every_key_is_compared_known_or_not(catalog, monkeypatch):
    record, key = catalog.create_key(KeyScope.ADMIN)
    ring, unknown_key = ring_of(catalog), ApiKey.new()
    comparisons = []
    compare_digest = keys.hmac.compare_digest

    def watched(sent_digest, stored_digest):
        comparisons.append((sent_digest, stored_digest))
        return compare_digest(sent_digest, stored_digest)

    monkeypatch.setattr(keys.hmac, "compare_digest", watched)
    with pytest.raises(UnauthorizedError):
        ring.holder(unknown_key.text)
    ring.holder(key.text)
    assert [sent_digest for sent_digest, _ in comparisons] == [unknown_key.secret_sha256, key.secret_sha256]
    assert {len(stored_digest) for _, stored_digest in comparisons} == {64}
    assert comparisons[1][1] == record.secret_sha256


@pytest.mark.parametrize("has_key", [True, False])
def test_a_catalog_that_cannot_be_read_lets_what_was_known_count_for_a_while(catalog, has_key):
    now_s = 0.0
    if has_key:
        _, key = catalog.create_key(KeyScope.ADMIN)
    ring = ring_of(catalog, lambda: now_s)
    catalog.close()
    now_s = GRACE_S - 1
    asyncio.run(ring.reread())
    assert ring.scope_for(PATH) is (KeyScope.LOCALIZE if has_key else None)
    assert not has_key or ring.holder(key.text).scope is KeyScope.ADMIN
    now_s = GRACE_S + 1
    asyncio.run(ring.reread())
    for unread in (ring, KeyRing()):
        with pytest.raises(UnavailableError):
            unread.scope_for(PATH)
        assert unread.scope_for("/healthz") is None


# Rates


class Clock:
    def __init__(self):
        self.s = 100.0

    def __call__(self):
        return self.s


def n_passed(limit, key_id, n):
    """How many of n requests pass."""
    n_refused = 0
    for _ in range(n):
        try:
            limit.take(key_id)
        except RateLimitedError:
            n_refused += 1
    return n - n_refused


def test_a_burst_then_the_rate():
    clock = Clock()
    limit = RateLimit(2.0, 5, clock)
    assert n_passed(limit, "a", 10) == 5
    assert n_passed(limit, "b", 10) == 5, "each key has its own"
    clock.s += 1.0
    assert n_passed(limit, "a", 10) == 2
    clock.s += 1000.0
    assert n_passed(limit, "a", 10) == 5, "no more than a burst is saved up"
    n_in_100_s = 0
    for _ in range(1000):
        clock.s += 0.1
        n_in_100_s += n_passed(limit, "a", 2)
    assert n_in_100_s == pytest.approx(2.0 * 100, abs=1)
    limit = RateLimit(0.0, 1, clock)
    assert (n_passed(limit, "a", 1000), len(limit.buckets)) == (1000, 0)


def test_a_refusal_says_how_long_to_wait_and_costs_nothing():
    clock = Clock()
    limit = RateLimit(0.25, 1, clock)
    limit.take("a")
    for waited_s, retry_after_s in ((0.0, 4), (0.0, 4), (3.0, 1)):
        clock.s += waited_s
        with pytest.raises(RateLimitedError) as caught:
            limit.take("a")
        expected = {"retry_after_s": retry_after_s, "rate_limit_per_s": 0.25, "rate_limit_burst": 1}
        assert caught.value.hints == expected
    clock.s += 1.0
    limit.take("a")


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(keys, "MAX_BUCKETS", 3)
    limit = RateLimit(1.0, 1, Clock())
    for key_id in ("a", "b", "c"):
        limit.take(key_id)
    assert n_passed(limit, "a", 1) == 0
    limit.take("d")  # b was used longest ago
    assert len(limit.buckets) == 3
    assert [n_passed(limit, key_id, 1) for key_id in ("a", "c", "d")] == [0, 0, 0]
    assert n_passed(limit, "b", 1) == 1
