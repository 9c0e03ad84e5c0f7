"""One page of a list, and where the next one begins."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

Record = TypeVar("Record")
Key = TypeVar("Key", int, str)


@dataclass(frozen=True)
class ListPage(Generic[Record, Key]):
    """Some records in the list's order.

    A page is found by the key of the record before it, never by a count: whatever is made or removed meanwhile, no
    record that stays is shown twice or left out.

    Attributes:
        records: At most as many as were asked for.
        last_key: The key of the last of them where more follow; None: this is the end.
    """

    records: tuple[Record, ...]
    last_key: Key | None

    @classmethod
    def of(cls, rows: Iterable[tuple[Key, Record]], limit: int) -> "ListPage[Record, Key]":
        """The page of what a statement found that asked for one record more than the `limit`."""
        found = list(rows)
        kept = found[:limit]
        return cls(tuple(record for _, record in kept), kept[-1][0] if len(found) > limit else None)
