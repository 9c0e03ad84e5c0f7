"""One kept connection without a client library, so that the sender costs the machine as little as may be."""

import asyncio
from typing import Self
from urllib.parse import urlsplit

JSON = "application/json"


class BareConnection:
    """HTTP/1.1 as far as a benchmark needs it: one request at a time, JSON back.

    Args:
        reader: What comes back.
        writer: What is sent.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def to(cls, url: str) -> Self:
        """Connect."""
        where = urlsplit(url)
        return cls(*await asyncio.open_connection(where.hostname, where.port))

    async def request(
        self, method: str, path: str, body: bytes = b"", key: str = "", media_type: str = JSON
    ) -> tuple[int, bytes]:
        """Send a request.

        Args:
            method: GET, POST, ...
            path: With its query.
            body: What is sent.
            key: The idempotency key; empty: none.
            media_type: Of the body.

        Returns:
            Status and body of the answer.
        """
        named = f"Idempotency-Key: {key}\r\n" if key else ""
        head = (
            f"{method} {path} HTTP/1.1\r\nHost: bench\r\nContent-Type: {media_type}\r\n"
            f"{named}Content-Length: {len(body)}\r\n\r\n"
        )
        self._writer.write(head.encode() + body)
        answer_head = await self._reader.readuntil(b"\r\n\r\n")
        length = int(answer_head.lower().partition(b"content-length:")[2].partition(b"\r\n")[0])
        return int(answer_head[9:12]), await self._reader.readexactly(length)

    def close(self) -> None:
        """Close it."""
        self._writer.close()
