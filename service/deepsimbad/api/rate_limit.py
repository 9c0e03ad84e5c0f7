"""How many requests a second one key may send: a token bucket a key."""

import math
import time
from collections import OrderedDict
from collections.abc import Callable

from deepsimbad.errors import RateLimitedError

MAX_BUCKETS = 10_000


class RateLimit:
    """A bucket of `burst` tokens for each key, filled by `per_s` tokens a second; a request takes one.

    Memory is bounded: the bucket that was used longest ago makes room, and whoever owned it begins with a full one.
    Used from the event loop alone.

    Args:
        per_s: Requests a second in the long run; 0: any number.
        burst: Requests at once.
        clock: Seconds that never go back.
    """

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = float(burst)
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens, and when there were so many

    @property
    def n_buckets(self) -> int:
        """Keys that are remembered."""
        return len(self._buckets)

    def take(self, key_id: str) -> None:
        """Count a request of a key; raises RateLimitedError, which counts nothing."""
        if self._per_s == 0:
            return
        now = self._clock()
        tokens, since = self._buckets.pop(key_id, (self._burst, now))
        tokens = min(self._burst, tokens + (now - since) * self._per_s)
        allowed = tokens >= 1
        self._buckets[key_id] = (tokens - 1 if allowed else tokens, now)
        if len(self._buckets) > MAX_BUCKETS:
            self._buckets.popitem(last=False)
        if not allowed:
            wait_s = max(1, math.ceil((1 - tokens) / self._per_s))
            raise RateLimitedError(
                f"this key may send {self._per_s:g} requests a second; send fewer, or wait {wait_s} s",
                retry_after_s=wait_s,
                rate_limit_per_s=self._per_s,
                rate_limit_burst=int(self._burst),
            )
