"""Where the time of one answer goes, stage by stage."""

from collections.abc import Mapping
from time import perf_counter


class Stopwatch:
    """Runs from its making; each lap says what the time since the one before was spent on.

    An answer is in the hands of one thread at a time: laps follow each other, and their sum is never above the total.
    """

    def __init__(self) -> None:
        self._began = self._since = perf_counter()
        self._spent_ms: dict[str, float] = {}

    def lap(self, stage: str, **within_ms: float) -> None:
        """Count the time since the last lap to a stage, less what was spent within it on stages of their own."""
        now = perf_counter()
        spent_ms = max(0.0, 1000 * (now - self._since) - sum(within_ms.values()))
        for name, spent in {stage: spent_ms, **within_ms}.items():
            self._spent_ms[name] = self._spent_ms.get(name, 0.0) + spent
        self._since = now

    def take(self, timings_ms: Mapping[str, float]) -> None:
        """Take over stages that were measured since the last lap, by whoever did the work."""
        self._spent_ms.update(timings_ms)
        self._since = perf_counter()

    def timings_ms(self) -> dict[str, float]:
        """Milliseconds by stage, and their `total` up to now."""
        spent_ms = {stage: round(spent, 3) for stage, spent in self._spent_ms.items()}
        spent_ms["total"] = round(1000 * (perf_counter() - self._began), 3)
        return spent_ms
