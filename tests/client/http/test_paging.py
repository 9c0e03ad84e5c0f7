"""Lists longer than a page, through both clients."""

import asyncio
from typing import Any

import httpx2
import pytest

from deepsimbad_client import AsyncClient, Client, errors

N_JOBS = 7
PER_PAGE = 3
JOBS = [{"job_id": f"j{number}", "domain": "d", "state": "succeeded"} for number in range(N_JOBS)]


class Shelf:
    """Gives out jobs three at a time, whatever length is asked for."""

    def __init__(self) -> None:
        self.asked: list[dict[str, str]] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        params = dict(request.url.params)
        self.asked.append(params)
        first = int(params.get("after", "jobs-0").removeprefix("jobs-"))
        following = first + PER_PAGE
        answer = {"jobs": JOBS[first:following], "next": f"jobs-{following}" if following < N_JOBS else None}
        return httpx2.Response(200, json=answer)


def test_a_list_is_read_to_its_end() -> None:
    shelf = Shelf()
    with Client("http://service", transport=httpx2.MockTransport(shelf)) as client:
        assert [job.job_id for job in client.admin.jobs("d")] == [job["job_id"] for job in JOBS]
    assert [asked.get("after") for asked in shelf.asked] == [None, "jobs-3", "jobs-6"]
    assert {asked["domain"] for asked in shelf.asked} == {"d"}


def test_a_page_is_fetched_when_it_is_wanted() -> None:
    shelf = Shelf()
    with Client("http://service", transport=httpx2.MockTransport(shelf)) as client:
        jobs = client.admin.iter_jobs()
        assert shelf.asked == []
        for _ in range(PER_PAGE):
            next(jobs)
        assert len(shelf.asked) == 1
        assert next(jobs).job_id == "j3"
        assert len(shelf.asked) == 2


def test_the_async_client_reads_the_same() -> None:
    async def read() -> tuple[list[str], list[str]]:
        async with AsyncClient("http://service", transport=httpx2.MockTransport(Shelf())) as client:
            some = []
            async for job in client.admin.iter_jobs():
                some.append(job.job_id)
                if len(some) == 4:
                    break
            return [job.job_id for job in await client.admin.jobs("d")], some

    whole, some = asyncio.run(read())
    assert whole == [job["job_id"] for job in JOBS]
    assert some == whole[:4]


@pytest.mark.parametrize("answer", [{"jobs": JOBS[:2]}, {"jobs": JOBS[:2], "next": None}, JOBS[:2]])
def test_a_list_that_names_no_next_page_is_whole(answer: Any) -> None:
    """As those of an older service."""
    respond = httpx2.MockTransport(lambda request: httpx2.Response(200, json=answer))
    with Client("http://service", transport=respond) as client:
        assert len(client.admin.jobs()) == 2


@pytest.mark.parametrize("answer", [{}, {"next": None}, {"jobs": 7, "next": None}, {"jobs": [{}], "next": None}])
def test_what_is_no_list_is_said(answer: Any) -> None:
    respond = httpx2.MockTransport(lambda request: httpx2.Response(200, json=answer))
    with Client("http://service", transport=respond) as client, pytest.raises(errors.UnexpectedAnswerError):
        client.admin.jobs()
