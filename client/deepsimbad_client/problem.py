"""The problem document (RFC 9457) in an error answer."""

import json
from typing import Any

import httpx2


def problem_of(response: httpx2.Response) -> dict[str, Any]:
    """The document, whole; empty where the answer holds none, as a proxy's own page."""
    try:
        document = json.loads(response.content)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}
