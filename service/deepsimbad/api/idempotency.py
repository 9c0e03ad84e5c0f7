"""Requests that make something, and make it once however often they are sent: `Idempotency-Key`."""

import hashlib
from typing import Annotated

from fastapi import Header, Request
from pydantic import Field

KEY_HEADER = "Idempotency-Key"
KeyWord = Annotated[str, Field(pattern=r"^[\x21-\x7e]{1,255}$")]
KeyOfJob = Annotated[
    KeyWord | None,
    Header(
        alias=KEY_HEADER,
        description="The same key with the same body again makes no second job: the first one is answered, as it "
        "stands. Choose one that nobody else will, such as a UUID.",
    ),
]


def id_under_key(request: Request, kind: str, domain: str, key: str | None) -> str | None:
    """The id of what a request makes, which follows from its key; a repetition finds it after a restart too.

    Whoever holds another API key makes other things, though the words they choose be the same.

    Args:
        request: Whose API key counts.
        kind: What is made.
        domain: Where.
        key: The sender's word; None: none was given.

    Returns:
        32 hexadecimal digits; None without a key.
    """
    if key is None:
        return None
    asker = getattr(request.state, "key_id", "")
    return hashlib.sha256(f"{kind}\n{asker}\n{domain}\n{key}".encode()).hexdigest()[:32]
