"""The clock that sessions live by: seconds since 1970 that never jump, though the computer's own clock does.

A robot without a battery-backed clock boots in 1970, or where it was switched off, and learns the time from the network
minutes later; an operator sets a clock back. Sessions would expire all at once, or live for ever. So the time is asked
for once, when the service starts, and runs on from there with the time since boot.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from deepsimbad.store.session_records import ClockRecord
from deepsimbad.store.sessions import SessionStore

NEVER_SET_BEFORE = 1_577_836_800.0  # 2020: a clock that shows less was never set
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", None)  # goes on while the computer sleeps; Linux alone has it


def seconds_since_boot() -> float:
    """Seconds that nobody can set."""
    return time.monotonic() if _SINCE_BOOT is None else time.clock_gettime(_SINCE_BOOT)


def boot_id() -> str | None:
    """Names this run of the operating system; None where it has no name."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or None
    except (OSError, ValueError):
        return None


class SteadyClock:
    """Seconds since 1970, as well as was known at the start; never less than what the sessions' file has seen.

    After a restart within one run of the operating system it goes on exactly. After a reboot the computer's clock says
    how long it was off, unless that shows a moment which has been already, or the sessions are from a time in which it
    had never been set: then no time has passed for them. Where no session lives the computer's clock counts, so that a
    wrong one is not kept.

    Args:
        past: The moment noted last, if any was.
        latest_event: When the last thing happened that the sessions tell of.
        has_sessions: Whether any lives.
        wall: The computer's clock, seconds since 1970.
        since_boot: Seconds since some moment of this run of the operating system.
        boot: Names that run.
    """

    def __init__(
        self,
        past: ClockRecord | None,
        latest_event: float | None,
        has_sessions: bool,
        *,
        wall: Callable[[], float] = time.time,
        since_boot: Callable[[], float] = seconds_since_boot,
        boot: str | None = None,
    ) -> None:
        moments = [latest_event, past.seen_at if past else None]
        seen_at = max((each for each in moments if each is not None), default=None)
        elapsed_s = since_boot()
        if seen_at is None:
            now = wall()
        elif has_sessions and past is not None and boot is not None and past.boot == boot:
            now = max(past.booted_at + elapsed_s, seen_at)
        elif has_sessions and seen_at < NEVER_SET_BEFORE:
            now = seen_at
        else:
            now = max(wall(), seen_at)
        self._since_boot = since_boot
        self._booted_at = now - elapsed_s
        self._boot = boot

    @classmethod
    def of(cls, store: SessionStore) -> Self:
        """The clock of a file's sessions."""
        past, latest_event = store.clock()
        clock = cls(past, latest_event, bool(store.living()), boot=boot_id())
        store.note_clock(clock.record()).result()
        return clock

    def __call__(self) -> float:
        """The present moment."""
        return self._booted_at + self._since_boot()

    def record(self) -> ClockRecord:
        """The present moment in the store's form; noted now and then, so that a reboot loses little."""
        return ClockRecord(self._boot, self._booted_at, self())
