"""Entity tags: which content a request has, or insists on (RFC 9110, 13.1)."""

import re
from typing import Annotated

from fastapi import Header

_TAG = r'(?:W/)?"[\x21\x23-\x7e]*"'
_LIST = rf"^(?:\*|{_TAG}(?:[ \t]*,[ \t]*{_TAG})*)$"
_STRONG = re.compile(r'(W/)?"([\x21\x23-\x7e]*)"')

KEPT = {"Cache-Control": "private, no-cache"}
"""What is named by a tag may be kept by who asked, and asked for again: a domain made anew counts its versions anew."""

LandmarkModelTag = Annotated[
    str | None,
    Header(
        alias="If-Match",
        pattern=_LIST,
        description="The quoted digest of the landmark model that the view was ranked by, as `landmark-model` names "
        "it: a map with another one does not answer: 409 `landmark_model_differs`.",
    ),
]


def names(wanted: str | None, etag: str) -> bool:
    """Whether an If-None-Match names this content; weak tags do."""
    return wanted is not None and any(one.strip().removeprefix("W/") in {etag, "*"} for one in wanted.split(","))


def insisted_on(wanted: str | None) -> frozenset[str] | None:
    """The contents, one of which an If-Match insists on; None: any will do. Weak tags match nothing."""
    if wanted is None or wanted.strip() == "*":
        return None
    return frozenset(tag for weak, tag in _STRONG.findall(wanted) if not weak)
