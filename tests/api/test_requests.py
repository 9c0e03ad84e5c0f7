"""Long bodies are read beside the event loop, none that is longer than anything here; parameters by one validator."""

import threading
from types import SimpleNamespace
from typing import Annotated

import httpx2
import pytest
from anyio import CapacityLimiter
from fastapi import APIRouter, FastAPI, Header, Path, Query, Request
from pydantic import Field
from starlette.responses import JSONResponse

from deepsimbad.api.frames import FrameBody
from deepsimbad.api.problems import InvalidRequestError, install_problem_handlers
from deepsimbad.api.requests import MAX_NUMBERS, QuickRoute, StrictRoute, parse_json

pytestmark = pytest.mark.anyio


@pytest.fixture
def services():
    return SimpleNamespace(long_work=CapacityLimiter(1))  # as much of the service as these need


@pytest.mark.parametrize("n_blanks", [0, 1 << 16])
async def test_a_long_body_is_read_in_a_thread(services, n_blanks, monkeypatch):
    threads = []
    parsed = FrameBody.model_validate_json

    def noting(body):
        threads.append(threading.get_ident())
        return parsed(body)

    monkeypatch.setattr(FrameBody, "model_validate_json", noting)
    body = await parse_json(b'{"encoding":[1.5' + b" " * n_blanks + b"]}", FrameBody, services)
    assert body.encoding == (1.5,)
    assert (threads == [threading.get_ident()]) == (n_blanks == 0)


async def test_a_body_of_too_many_numbers_is_refused_before_it_is_parsed(services):
    body = b'{"encoding":[' + b"1," * (MAX_NUMBERS - 1) + b"1%s]}"
    assert len((await parse_json(body % b"", FrameBody, services)).encoding) == MAX_NUMBERS
    with pytest.raises(InvalidRequestError, match="numbers"):
        await parse_json(body % b",1", FrameBody, services)


@pytest.mark.parametrize(
    ("query", "headers"),
    [
        ("", []),
        ("metres=3&count=7", [("Word", "w-1")]),
        ("metres=1e3&metres=-2.5", [("word", "first"), ("WORD", "second")]),
        ("metres=%20%201&count=", []),
        ("metres=nan&count=0", []),
        ("count=5.0", [("Word", "é".encode())]),
        ("metres=true", [("Word", "")]),
        ("word=w&Word=w", []),
        ("metres=1_0", [("Word", " ")]),
    ],
)
@pytest.mark.parametrize("name", ["some", "a b", "no;ne"])
async def test_a_quick_route_takes_and_refuses_what_the_framework_does(query, headers, name):
    async def heard(
        request: Request,
        name: Annotated[str, Path(pattern="^[a-z ]+$")],
        metres: Annotated[float, Query()] = 0.5,
        count: Annotated[int | None, Query(ge=1)] = None,
        word: Annotated[Annotated[str, Field(pattern="^[!-~]+$")] | None, Header(alias="Word")] = None,
    ) -> JSONResponse:
        return JSONResponse(repr([name, metres, count, word]))

    answers = []
    for kind in (StrictRoute, QuickRoute):
        app, router = FastAPI(), APIRouter(route_class=kind)
        router.get("/{name}", response_model=None)(heard)
        app.include_router(router)
        install_problem_handlers(app)
        async with httpx2.AsyncClient(transport=httpx2.ASGITransport(app), base_url="http://robot") as robot:
            answer = await robot.get(f"/{name}?{query}", headers=headers)
        answers.append((answer.status_code, answer.json()))
    assert answers[0] == answers[1]
