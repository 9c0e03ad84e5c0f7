"""Lists page by page: how long a page is, and where it begins.

A cursor names the list and the key of the last thing shown. It stays good whatever is made or removed meanwhile, and
says nothing that the list itself does not.
"""

from typing import Annotated

from fastapi import Query

from deepsimbad.api.bodies import NAME_PATTERN
from deepsimbad.api.schemas import Next

MOST_AT_ONCE = 1000
USUALLY_AT_ONCE = 100

_NUMBER = "[0-9]{1,18}"
_AFTER = "`next` of the page before; absent: the first page."

Limit = Annotated[int, Query(ge=1, le=MOST_AT_ONCE, description="Most entries of the answer.")]
AfterJob = Annotated[str | None, Query(alias="after", pattern=f"^jobs-{_NUMBER}$", description=_AFTER)]
AfterMap = Annotated[str | None, Query(alias="after", pattern=f"^maps-{_NUMBER}$", description=_AFTER)]
AfterSession = Annotated[str | None, Query(alias="after", pattern=f"^sessions-{_NUMBER}$", description=_AFTER)]
AfterTraverse = Annotated[
    str | None, Query(alias="after", pattern=f"^traverses-{NAME_PATTERN.removeprefix('^')}", description=_AFTER)
]


def number_of(cursor: str | None) -> int | None:
    """The key that a list of numbers goes on behind; None: from its beginning."""
    return None if cursor is None else int(cursor.partition("-")[2])


def name_of(cursor: str | None) -> str | None:
    """The name that a list of names goes on behind; None: from its beginning."""
    return None if cursor is None else cursor.partition("-")[2]


def cursor_of(what: str, last_key: int | str | None) -> Next:
    """What `next` says: the cursor of the page behind a key; None where there is none."""
    return None if last_key is None else f"{what}-{last_key}"
