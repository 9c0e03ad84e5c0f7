"""When a request is sent again, and after how long.

Nothing here waits or sends: `Attempts` is told what happened and says what to do, so the blocking and the async client
share every rule.
"""

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum
from typing import Any

import httpx2

from deepsimbad_client.errors import TransportError, TransportTimeoutError

logger = logging.getLogger(__name__)

RETRIED_STATUSES = frozenset({408, 429, 502, 503, 504})
REFUSED_STATUSES = frozenset({408, 429, 503})
"""The request was turned away before it was acted on, 408 because not all of it came.

502 and 504 come from a proxy that cannot know.
"""
UNTOUCHED_FAILURES = (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout)
"""Failures in which the service never saw the request."""
LASTING_CODES = frozenset({"damaged_map", "damaged_file"})  # Problems behind a 503 that waiting cannot cure


class Repeat(Enum):
    """Which failures make a call safe to send again; its value is the statuses that do."""

    ALWAYS = RETRIED_STATUSES  # Idempotent: reads, stateless localizations, puts, deletes, frame batches
    IF_UNTOUCHED = REFUSED_STATUSES
    """Acts once: only when the service surely did not act (no connection, 408, 429, 503)."""
    NEVER = frozenset[int]()  # The caller has its own way to go on


@dataclass(frozen=True)
class RetryPolicy:
    """How patient a client is.

    Attributes:
        attempts: Times a request is sent in all; 1 never repeats.
        base_s: Wait before the first repetition, doubled each time.
        max_backoff_s: Longest such wait.
        max_retry_after_s: Longest `Retry-After` that is waited out. When the service asks for more, its error is
            raised at once (with `retry_after_s`) instead of knocking before the time it named.
    """

    attempts: int = 5
    base_s: float = 0.25
    max_backoff_s: float = 8.0
    max_retry_after_s: float = 60.0

    def backoff_s(self, n_sent: int, jitter: float) -> float:
        """Wait after the `n_sent`-th try; `jitter` in 0..1 spreads it over its upper half."""
        longest = min(self.base_s * 2.0 ** (n_sent - 1), self.max_backoff_s)
        return longest * (0.5 + 0.5 * jitter)


def problem_of(response: httpx2.Response) -> dict[str, Any]:
    """The problem document (RFC 9457) of an error answer; empty where it holds none, as a proxy's own page."""
    try:
        document = json.loads(response.content)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def retry_after_s(header: str | None, now: datetime | None = None) -> float | None:
    """Seconds that a `Retry-After` header asks for (seconds or an HTTP date); None when it says nothing usable."""
    header = (header or "").strip()
    if header.isascii() and header.isdigit():
        return float(header)
    try:
        date = parsedate_to_datetime(header)
    except ValueError:
        return None
    date = date if date.tzinfo else date.replace(tzinfo=UTC)
    return max(0.0, (date - (now or datetime.now(UTC))).total_seconds())


@dataclass
class Attempts:
    """The tries of one request.

    Attributes:
        policy: How patient.
        repeat: What is safe.
        what: The request in words, for errors.
        jitter: Draws in 0..1.
        answer_lost: Whether an earlier try may have been acted on without our hearing of it.
    """

    policy: RetryPolicy
    repeat: Repeat
    what: str
    jitter: Callable[[], float]
    n_sent: int = 0
    answer_lost: bool = False

    def after_failure(self, error: httpx2.TransportError) -> float:
        """Seconds to wait before the next try. Raises TransportError (when there is none)."""
        self.n_sent += 1
        untouched = isinstance(error, UNTOUCHED_FAILURES)
        safe = self.repeat is Repeat.ALWAYS or (self.repeat is Repeat.IF_UNTOUCHED and untouched)
        hopeless = isinstance(error, httpx2.UnsupportedProtocol | httpx2.LocalProtocolError)
        if safe and not hopeless and self.n_sent < self.policy.attempts:
            self.answer_lost |= not untouched
            return self._announced(self.policy.backoff_s(self.n_sent, self.jitter()), _reason(error))
        kind = TransportTimeoutError if isinstance(error, httpx2.TimeoutException) else TransportError
        tries = f"{self.n_sent} tries" if self.n_sent > 1 else "one try"
        there = "; is the service running there?" if untouched else ""
        raise kind(f"no answer to {self.what} after {tries}: {_reason(error)}{there}") from error

    def after_answer(self, response: httpx2.Response) -> float | None:
        """Seconds to wait before the next try; None when this answer is the last word."""
        self.n_sent += 1
        status = response.status_code
        if status not in self.repeat.value or self.n_sent >= self.policy.attempts:
            return None
        code = problem_of(response).get("code")
        if code in LASTING_CODES:
            return None
        wait_s = retry_after_s(response.headers.get("retry-after"))
        if wait_s is None:
            self.answer_lost |= status not in REFUSED_STATUSES
            wait_s = self.policy.backoff_s(self.n_sent, self.jitter())
        elif wait_s > self.policy.max_retry_after_s:
            return None
        return self._announced(wait_s, f"{status} {code or ''}".rstrip())

    def _announced(self, wait_s: float, reason: str) -> float:
        """The wait, told to whoever listens to this module's logger: a client that only waits looks dead."""
        logger.info(
            "%s: %s; trying again in %.1f s (try %d of %d)",
            self.what,
            reason,
            wait_s,
            self.n_sent + 1,
            self.policy.attempts,
        )
        return wait_s


def _reason(error: httpx2.TransportError) -> str:
    return str(error) or type(error).__name__
