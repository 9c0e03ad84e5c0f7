"""Who may ask, and how often: API keys and their rates."""

import asyncio
import hmac
import logging
import math
import re
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence

from anyio.to_thread import run_sync
from starlette.types import Scope

from deepsimbad.errors import ForbiddenError, RateLimitedError, UnauthorizedError, UnavailableError
from deepsimbad.store.catalog import ApiKey
from deepsimbad.store.records import KeyRecord, KeyScope, current_moment

log = logging.getLogger(__name__)

REREAD_S = 1.0  # a key that was made or revoked counts within this time
GRACE_S = 60.0  # a catalog that cannot be read lets the last known keys count for so long
MAX_BUCKETS = 10_000
_OF_DOMAIN = re.compile(r"/v1/domains/([^/]+)")
_NO_DIGEST = "0" * 64  # what a key that does not exist is compared with
_KEY_HELP = "send a key as `Authorization: Bearer <key>` or `X-API-Key: <key>`; `deepsimbad keys create` makes one"


class KeyRing:
    """The keys as the catalog had them a moment ago; `by_id` holds all that were ever created.

    Without any key the service is open. Once there was a key it stays closed, whatever is read later. Before a change
    of the keys counts here, `announce` tells those that share them.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.announce: Callable[[], Awaitable[object]] | None = None
        self._read: Callable[[], Sequence[KeyRecord]] = tuple
        self._read_at = -math.inf
        self.by_id: dict[str, KeyRecord] = {}

    def load(self, read: Callable[[], Sequence[KeyRecord]]) -> None:
        """Read the keys by `read`, which reads them from then on too; raises what `read` raises."""
        self._read = read
        self._keep(read())

    async def follow(self) -> None:
        """Read the keys again and again, until cancelled."""
        while True:
            await self.reread()
            await asyncio.sleep(REREAD_S)

    async def reread(self) -> None:
        """Read the keys again; where that fails, those read last count for `GRACE_S`."""
        try:
            records = await run_sync(self._read)
        except Exception as error:  # whatever it is, the next try may succeed
            log.warning("the keys cannot be read: %s", error)
            return
        was_open = not self.by_id
        if self.announce is not None and list(records) != list(self.by_id.values()):
            await self.announce()
        self._keep(records)
        if was_open and self.by_id:
            log.info("the first key was created: from now on a key is asked")

    def _keep(self, records: Sequence[KeyRecord]) -> None:
        if records or not self.by_id:
            self.by_id = {record.key_id: record for record in records}
        self._read_at = self._clock()

    @property
    def next_expiry(self) -> str | None:
        """When the next of the usable keys expires; None: no one does."""
        moment = current_moment()
        expiries = [record.expires_at for record in self.by_id.values() if record.is_usable(moment)]
        return min(filter(None, expiries), default=None)

    def scope_for(self, path: str) -> KeyScope | None:
        """The scope that a decoded path needs now; None: no key is asked.

        Raises:
            UnavailableError: A key may be needed, but for too long the keys could not be read.
        """
        is_known = self._clock() - self._read_at <= GRACE_S
        if is_known and not self.by_id:
            return None
        required_scope = needed_scope(path)
        if required_scope is not None and not is_known:
            raise UnavailableError("the keys cannot be read, so nobody can be let in; try again")
        return required_scope

    def still_opens(self, key_id: str | None) -> bool:
        """Whether a request let in with this key (None: without any) would be let in now; asked during long answers."""
        if key_id is None:
            return not self.by_id
        record = self.by_id.get(key_id)
        return record is not None and record.is_usable(current_moment())

    def holder(self, key_text: str) -> KeyRecord:
        """The key presented as text; raises UnauthorizedError where it is malformed, unknown, revoked or expired."""
        key = ApiKey.parse(key_text)
        if key is None:
            raise UnauthorizedError(f"the key is malformed: {_KEY_HELP}")
        record = self.by_id.get(key.key_id)
        # Always one comparison, so that its time does not tell which ids exist.
        is_right = hmac.compare_digest(key.secret_sha256, _NO_DIGEST if record is None else record.secret_sha256)
        if record is None or not is_right:
            raise UnauthorizedError("the key is not known here")
        if not record.is_usable(current_moment()):  # told to its holder alone
            reason = "expired" if record.revoked_at is None else "was revoked"
            raise UnauthorizedError(f"the key {reason}: ask the operator for another", key_id=record.key_id)
        return record

    def admit(self, scope: Scope, required_scope: KeyScope, rate_limit: "RateLimit") -> None:
        """Let a request in, and note whose it is; raises UnauthorizedError, RateLimitedError, ForbiddenError."""
        state = scope["state"]
        try:
            key = self.holder(presented_key(scope))
        except UnauthorizedError as error:
            state |= error.hints  # whose key was revoked or has expired
            raise
        state |= {"key_id": key.key_id, "key_scope": key.scope, "domains": key.domains}
        rate_limit.take(key.key_id)
        check_reach(key, scope["path"], required_scope)


def check_reach(key: KeyRecord, path: str, required_scope: KeyScope) -> None:
    """Raise ForbiddenError where a key lacks the required scope, or a decoded path is of a domain it is not for."""
    if not key.scope.includes(required_scope):
        raise ForbiddenError(
            f"this call needs a key of scope {required_scope}; this one has {key.scope}", needed=required_scope.value
        )
    of_domain = _OF_DOMAIN.match(path)
    if key.domains is not None and of_domain is not None and of_domain[1] not in key.domains:
        raise ForbiddenError("this key is for other domains", domains=list(key.domains))


def needed_scope(path: str) -> KeyScope | None:
    """The scope that a decoded path needs; None: no key is asked."""
    if path == "/v1/admin" or path.startswith("/v1/admin/"):
        return KeyScope.ADMIN
    if path == "/v1" or path.startswith("/v1/"):
        return KeyScope.LOCALIZE
    return None


def presented_key(scope: Scope) -> str:
    """The one key in a request's headers; raises UnauthorizedError where there is none, or more than one."""
    headers: list[tuple[bytes, bytes]] = scope["headers"]
    authorizations = [value.partition(b" ") for name, value in headers if name == b"authorization"]
    # Another scheme is someone else's, a proxy's say.
    bearer = [text.strip(b" ") for scheme, _, text in authorizations if scheme.lower() == b"bearer"]
    api_keys = [value.strip(b" ") for name, value in headers if name == b"x-api-key"]
    if not bearer and not api_keys:
        raise UnauthorizedError(f"no key came: {_KEY_HELP}")
    if len(authorizations) > 1 or len(api_keys) > 1 or len({*bearer, *api_keys}) > 1:
        raise UnauthorizedError("more than one key came: send one")
    try:
        return (bearer or api_keys)[0].decode("ascii")
    except UnicodeDecodeError as error:
        raise UnauthorizedError(f"the key is malformed: {_KEY_HELP}") from error


class RateLimit:
    """A bucket of `burst` tokens for each key, filled by `per_s` tokens a second (0: no limit); a request takes one.

    Memory is bounded: the bucket that was used longest ago makes room, and whoever owned it begins with a full one.
    """

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = float(burst)
        self._clock = clock
        self.buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens, and when there were so many

    def take(self, key_id: str) -> None:
        """Count a request of a key; raises RateLimitedError, which counts nothing."""
        if self._per_s == 0:
            return
        now_s = self._clock()
        tokens, last_s = self.buckets.pop(key_id, (self._burst, now_s))
        tokens = min(self._burst, tokens + (now_s - last_s) * self._per_s)
        is_allowed = tokens >= 1
        self.buckets[key_id] = (tokens - 1 if is_allowed else tokens, now_s)
        if len(self.buckets) > MAX_BUCKETS:
            self.buckets.popitem(last=False)
        if not is_allowed:
            wait_s = max(1, math.ceil((1 - tokens) / self._per_s))
            raise RateLimitedError(
                f"this key may send {self._per_s:g} requests a second; send fewer, or wait {wait_s} s",
                retry_after_s=wait_s,
                rate_limit_per_s=self._per_s,
                rate_limit_burst=int(self._burst),
            )
