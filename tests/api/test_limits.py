"""Counting a body while it streams in, message by message."""

import asyncio
import json
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from deepsimbad.api import limits
from deepsimbad.api.limits import BodyLimitMiddleware
from deepsimbad.api.problems import error_response
from deepsimbad.errors import BodyTooLargeError

START: Message = {"type": "http.response.start", "status": 200, "headers": []}
END: Message = {"type": "http.response.body", "body": b"done"}


class Sender:
    """A client that sends pieces; counts how many were taken."""

    def __init__(self, pieces: list[bytes], stalls: bool = False) -> None:
        self.pieces = list(pieces)
        self.stalls = stalls
        self.n_taken = 0
        self.answers: list[Message] = []

    async def receive(self) -> Message:
        if not self.pieces:
            if self.stalls:
                await asyncio.sleep(3600)
            return {"type": "http.disconnect"}
        self.n_taken += 1
        body = self.pieces.pop(0)
        return {"type": "http.request", "body": body, "more_body": bool(self.pieces) or self.stalls}

    async def send(self, message: Message) -> None:
        self.answers.append(message)

    @property
    def status(self) -> int:
        return int(self.answers[0]["status"])

    @property
    def closes(self) -> bool:
        return (b"connection", b"close") in self.answers[0]["headers"]


async def reads_all(scope: Scope, receive: Receive, send: Send) -> None:
    try:
        while (await receive()).get("more_body"):
            pass
    except BodyTooLargeError as error:
        await error_response(scope, error)(scope, receive, send)
        return
    await send(START)
    await send(END)


async def reads_nothing(scope: Scope, receive: Receive, send: Send) -> None:
    await send(START)
    await send(END)


def ask(app: Any, sender: Sender, **headers: str) -> None:
    scope: Scope = {
        "type": "http",
        "method": "POST",
        "path": "/",
        "raw_path": b"/",
        "headers": [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()],
    }
    asyncio.run(BodyLimitMiddleware(app, lambda _: 100)(scope, sender.receive, sender.send))


def test_a_body_at_the_limit_passes() -> None:
    sender = Sender([bytes(50), bytes(50)])
    ask(reads_all, sender, transfer_encoding="chunked")
    assert sender.status == 200
    assert not sender.closes


def test_a_body_over_the_limit_is_refused_at_the_byte_that_shows_it() -> None:
    sender = Sender([bytes(50)] * 40)
    taken: list[int] = []

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            while (await receive()).get("more_body"):
                pass
        except BodyTooLargeError as error:
            taken.append(sender.n_taken)
            await error_response(scope, error)(scope, receive, send)

    ask(app, sender, transfer_encoding="chunked")
    assert taken == [3]
    assert sender.status == 413
    assert sender.closes
    assert json.loads(sender.answers[1]["body"])["max_bytes"] == 100


def test_a_declared_length_over_the_limit_never_reaches_the_application() -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        raise AssertionError("not to be called")

    sender = Sender([bytes(101)])
    ask(app, sender, content_length="101")
    assert sender.status == 413
    assert json.loads(sender.answers[1]["body"])["code"] == "body_too_large"


@pytest.mark.parametrize("length", ["-1", "x", "1e3"])
def test_a_length_that_is_no_number(length: str) -> None:
    sender = Sender([b"x"])
    ask(reads_all, sender, content_length=length)
    assert sender.status == 422


def test_the_answer_is_out_before_the_rest_is_thrown_away() -> None:
    sender = Sender([bytes(50)] * 10)
    ask(reads_nothing, sender, transfer_encoding="chunked")
    assert sender.closes
    assert sender.answers[1] == {**END, "more_body": True}
    assert sender.answers[2] == {"type": "http.response.body", "body": b"", "more_body": False}
    assert sender.n_taken == 10


def test_a_sender_who_stalls_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "_LINGER_IDLE_S", 0.05)
    sender = Sender([bytes(10)], stalls=True)
    ask(reads_nothing, sender, transfer_encoding="chunked")
    assert sender.answers[-1]["more_body"] is False


def test_a_request_without_body_is_left_alone() -> None:
    sender = Sender([b""])
    ask(reads_nothing, sender)
    assert sender.answers == [START, END]


@pytest.mark.parametrize(
    ("headers", "allowed"),
    [
        ({"content_encoding": "gzip", "content_length": "5"}, "identity"),
        ({"content_encoding": "GZIP", "transfer_encoding": "chunked"}, "identity"),
        ({"content_encoding": "identity, br", "content_length": "5"}, "identity"),
        ({"transfer_encoding": "gzip, chunked"}, "chunked"),
        ({"transfer_encoding": "identity"}, "chunked"),
    ],
)
def test_a_packed_body_is_refused(headers: dict[str, str], allowed: str) -> None:
    sender = Sender([b"12345"])
    ask(reads_all, sender, **headers)
    assert sender.status == 415
    assert json.loads(sender.answers[1]["body"])["allowed"] == [allowed]


@pytest.mark.parametrize(
    "headers",
    [
        {"content_encoding": "gzip"},  # of no body
        {"content_encoding": "identity", "content_length": "5"},
        {"content_encoding": "", "content_length": "5"},
        {"transfer_encoding": "Chunked"},
    ],
)
def test_a_body_as_it_is_passes(headers: dict[str, str]) -> None:
    sender = Sender([b"12345"])
    ask(reads_all, sender, **headers)
    assert sender.status == 200
