"""One page of a list."""

from dataclasses import dataclass
from typing import Generic, TypeVar

Entry = TypeVar("Entry")

PAGE_LENGTH = 200
"""Worth its round trip, and soon there on a thin link."""


@dataclass(frozen=True)
class Page(Generic[Entry]):
    """Some entries of a list, in its order.

    Attributes:
        entries: The entries.
        next: What the page behind this one is asked for with; None: there is none.
    """

    entries: tuple[Entry, ...]
    next: str | None
