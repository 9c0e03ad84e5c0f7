"""Token buckets, on a clock of our own."""

import pytest

from deepsimbad.api import rate_limit
from deepsimbad.api.rate_limit import RateLimit
from deepsimbad.errors import RateLimitedError


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
    monkeypatch.setattr(rate_limit, "MAX_BUCKETS", 3)
    limit = RateLimit(1.0, 1, Clock())
    for key_id in ("a", "b", "c"):
        limit.take(key_id)
    assert taken(limit, "a", 1) == 0
    limit.take("d")  # b was used longest ago
    assert limit.n_buckets == 3
    assert [taken(limit, key_id, 1) for key_id in ("a", "c", "d")] == [0, 0, 0]
    assert taken(limit, "b", 1) == 1
