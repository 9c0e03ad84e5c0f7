"""Figures that must not be above something."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """A figure and what it may be at most.

    Attributes:
        what: Of which thing, with its unit.
        found: The figure.
        at_most: The limit.
    """

    what: str
    found: float
    at_most: float

    @property
    def is_kept(self) -> bool:
        """A figure that could not be taken keeps no limit."""
        return math.isfinite(self.found) and self.found <= self.at_most

    def __str__(self) -> str:
        return f"{self.what}: {self.found:.3g}, at most {self.at_most:g}"


def limit_table(limits: Sequence[Limit]) -> Iterator[str]:
    """Markdown lines."""
    yield "| limit | at most | found | |"
    yield "|---|---|---|---|"
    for limit in limits:
        verdict = "PASS" if limit.is_kept else "**over**"
        yield f"| {limit.what} | {limit.at_most:g} | {limit.found:.3g} | {verdict} |"


def breaches(limits: Sequence[Limit]) -> str | None:
    """What is over, on one line, for a command to end with; None where all is kept."""
    over = [str(limit) for limit in limits if not limit.is_kept]
    return f"over the limit: {'; '.join(over)}" if over else None
