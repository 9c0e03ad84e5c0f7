"""The id by which the service's log tells of a request: told with answers and errors, chosen by whoever wants to."""

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

import httpx2
import pytest

from deepsimbad_client import AsyncClient, Client, RetryPolicy, errors
from deepsimbad_client.http.models import Answer, Job, Localization

from .test_requests import BELIEF, LOCALIZATION

JOB = {"job_id": "j", "domain": "d", "state": "running"}
SESSION = {"session_id": "s", "domain": "d", "map_version": 1, "n_observations": 1, "belief": BELIEF}
NEXT = {"planner": "telling", "action_m": 2.0}
DOCUMENTS = {
    "/v1/domains/d/localizations": LOCALIZATION,
    "/v1/domains/d/sessions": SESSION,
    "/v1/sessions/s/observations": {**SESSION, "timings_ms": {}},
    "/v1/sessions/s/next-best-view": NEXT,
    "/v1/admin/jobs/j": JOB,
    "/v1/admin/jobs": {"jobs": [JOB, JOB], "next": None},
    "/v1/domains": {"domains": [{"name": "d"}]},
}


class Service:
    """Answers every request by its path, and names it by its number."""

    def __init__(self, *, named: bool = True) -> None:
        self.sent: list[str | None] = []
        self._named = named

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.sent.append(request.headers.get("x-request-id"))
        headers = {"X-Request-ID": self.sent[-1] or f"r{len(self.sent)}"} if self._named else {}
        document = DOCUMENTS.get(request.url.path)
        return httpx2.Response(503 if document is None else 200, json=document or {}, headers=headers)


def by_client(service: Service, **options: Any) -> list[Answer]:
    with Client("http://service", transport=httpx2.MockTransport(service), **options) as client:
        found: list[Answer] = [client.localize("d", ranked_landmarks=[0])]
        session = client.session("d", keep=True)
        found += [session.opened, session.observe(ranked_landmarks=[0])]
        best = session.next_best_view()
        assert best is not None
        return [*found, best, client.admin.job("j"), *client.admin.jobs(), *client.domains()]


def by_async_client(service: Service, **options: Any) -> list[Answer]:
    async def ask() -> list[Answer]:
        async with AsyncClient("http://service", transport=httpx2.MockTransport(service), **options) as client:
            found: list[Answer] = [await client.localize("d", ranked_landmarks=[0])]
            session = await client.session("d", keep=True)
            found += [session.opened, await session.observe(ranked_landmarks=[0])]
            best = await session.next_best_view()
            assert best is not None
            return [*found, best, await client.admin.job("j"), *await client.admin.jobs(), *await client.domains()]

    return asyncio.run(ask())


BOTH = pytest.mark.parametrize("ask", [by_client, by_async_client])
Ask = Callable[..., list[Answer]]


@BOTH
def test_every_answer_knows_its_request(ask: Ask) -> None:
    assert [answer.request_id for answer in ask(Service())] == ["r1", "r2", "r3", "r4", "r5", "r6", "r6", "r7"]


@BOTH
def test_it_is_none_where_nobody_told(ask: Ask) -> None:
    service = Service(named=False)
    assert {answer.request_id for answer in ask(service)} == {None}
    assert set(service.sent) == {None}


@BOTH
def test_the_caller_may_name_his_requests(ask: Ask) -> None:
    numbers, service = itertools.count(), Service()
    answers = ask(service, request_id=lambda: f"robot-7.{next(numbers)}")
    assert service.sent == [f"robot-7.{number}" for number in range(7)]
    assert [answer.request_id for answer in answers[:2]] == service.sent[:2]


def test_every_try_has_an_id_of_its_own_and_the_error_tells_the_last() -> None:
    numbers, service = itertools.count(), Service()
    client = Client(
        "http://service",
        transport=httpx2.MockTransport(service),
        retry=RetryPolicy(attempts=2),
        sleep=lambda seconds: None,
        request_id=lambda: f"t{next(numbers)}",
    )
    with client, pytest.raises(errors.UnavailableError) as raised:
        client.domain("gone")
    assert service.sent == ["t0", "t1"]
    assert raised.value.request_id == "t1"


@pytest.mark.parametrize("bad", ["", "a b", "ä", "x\r\ny: z", "x" * 65])
def test_an_id_that_the_service_would_not_take_is_not_sent(bad: str) -> None:
    service = Service()
    with (
        Client("http://service", transport=httpx2.MockTransport(service), request_id=lambda: bad) as client,
        pytest.raises(errors.InvalidArgumentError, match="cannot name a request"),
    ):
        client.domains()
    assert service.sent == []


def test_it_is_no_part_of_what_was_answered() -> None:
    known, unknown = Localization.model_validate(LOCALIZATION), Localization.model_validate(LOCALIZATION)
    assert known.answering("r1").request_id == "r1"
    assert unknown.request_id is None
    assert known == unknown
    assert known.model_dump() == unknown.model_dump()
    assert "r1" not in known.model_dump_json() + repr(known)
    assert Job.model_validate({**JOB, "_request_id": "theirs", "request_id": "theirs"}).request_id is None
