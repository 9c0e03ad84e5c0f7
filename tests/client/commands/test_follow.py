"""Following a job through whatever happens to the connection."""

import io
import json
from collections.abc import Callable
from typing import Any

import httpx2
import pytest
from rich.console import Console

from deepsimbad_client import Client, RetryPolicy, commands, errors
from deepsimbad_client.commands import console, jobs
from deepsimbad_client.commands.group import run
from deepsimbad_client.http.jobs import follow_job
from deepsimbad_client.http.models import Job

EVENTS = "/v1/admin/jobs/7/events"


def job(state: str, progress: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"job_id": "7", "domain": "d", "state": state, "progress": progress, **more}


class Events(httpx2.SyncByteStream):
    """A stream that gives some events and ends, or breaks off."""

    def __init__(self, events: tuple[dict[str, Any], ...], breaks_off: bool) -> None:
        self.events = events
        self.breaks_off = breaks_off

    def __iter__(self) -> Any:
        for event in self.events:
            yield f"event: progress\ndata: {json.dumps(event)}\n\n".encode()
        if self.breaks_off:
            raise httpx2.ReadError("the link is gone")


def stream(*events: dict[str, Any], breaks_off: bool = False) -> Callable[[], httpx2.Response]:
    headers = {"content-type": "text/event-stream"}
    return lambda: httpx2.Response(200, stream=Events(events, breaks_off), headers=headers)


def answer(status: int, document: dict[str, Any]) -> Callable[[], httpx2.Response]:
    return lambda: httpx2.Response(status, json=document)


class Service:
    """Answers from two queues, of the stream and of single questions, the last of each for ever."""

    def __init__(self, streams: list[Any], answers: list[Any]) -> None:
        self.queues = {True: streams, False: answers}
        self.asked: list[str] = []
        self.now = 0.0
        self.heard: list[Job] = []
        self.silences: list[float] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.asked.append(request.url.path)
        queue = self.queues[request.url.path == EVENTS]
        outcome = queue.pop(0) if len(queue) > 1 else queue[0]
        if isinstance(outcome, type):
            raise outcome("scripted", request=request)
        if callable(outcome):
            outcome = outcome()
        return outcome if isinstance(outcome, httpx2.Response) else httpx2.Response(200, json=outcome)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def follow(self, patience_s: float = 60.0) -> Job:
        retry = RetryPolicy(attempts=1)
        client = Client("http://service", retry=retry, transport=httpx2.MockTransport(self), sleep=self.sleep)
        return follow_job(
            client,
            "7",
            self.heard.append,
            on_silence=self.silences.append,
            patience_s=patience_s,
            sleep=self.sleep,
            clock=lambda: self.now,
        )


DONE = stream(job("succeeded", 1.0))


def test_a_stream_that_lasts_is_all_there_is() -> None:
    service = Service([stream(job("running", 0.5), job("succeeded", 1.0))], [httpx2.ReadError])
    assert service.follow().state == "succeeded"
    assert [heard.progress for heard in service.heard] == [0.5, 1.0]
    assert service.asked == [EVENTS]


def test_a_stream_that_breaks_off_is_listened_to_again() -> None:
    first = stream(job("running", 0.2), breaks_off=True)
    service = Service([first, httpx2.ConnectError, DONE], [httpx2.ConnectError, job("running", 0.6)])
    assert service.follow().state == "succeeded"
    assert [heard.progress for heard in service.heard] == [0.2, 0.6, 1.0]


def test_a_restarted_service_takes_the_job_up_again() -> None:
    """It was far, goes back to the queue while the service starts, and is resumed behind its last finished stage."""
    before = stream(job("running", 0.7), breaks_off=True)
    starting = answer(503, {"code": "unavailable"})
    after = stream(job("queued", 0.0), job("running", 0.5), job("succeeded", 1.0))
    service = Service([before, httpx2.ConnectError, starting, after], [httpx2.ConnectError, starting, job("queued")])
    assert service.follow().state == "succeeded"
    states = [(heard.state, heard.progress) for heard in service.heard]
    queued = ("queued", 0.0)
    assert states == [("running", 0.7), queued, queued, ("running", 0.5), ("succeeded", 1.0)]
    assert service.silences == [0.0, 2.0]


@pytest.mark.parametrize("status", [408, 429, 502, 503])
def test_a_service_with_too_much_to_do_is_asked_again(status: int) -> None:
    busy = answer(status, {"code": "busy"})
    service = Service([busy, DONE], [busy])
    assert service.follow().state == "succeeded"
    assert service.asked.count(EVENTS) == 2


@pytest.mark.parametrize(
    ("status", "code", "error", "words"),
    [
        (401, "unauthorized", errors.UnauthorizedError, "keys create"),  # the key was revoked meanwhile
        (403, "forbidden", errors.ForbiddenError, "keys create"),
        (404, "unknown_job", errors.UnknownJobError, "no job 7"),
    ],
)
def test_a_refusal_ends_it(status: int, code: str, error: type[errors.ApiError], words: str) -> None:
    refused = answer(status, {"code": code, "detail": "no job 7"})
    with pytest.raises(error, match=words):
        Service([refused], [refused]).follow()


def test_without_streams_the_job_is_asked_for() -> None:
    service = Service([answer(404, {"code": "not_found"})], [job("queued"), job("running", 0.5), job("succeeded", 1.0)])
    assert service.follow().state == "succeeded"
    assert service.asked.count(EVENTS) == 1


def test_a_page_instead_of_a_stream_is_no_end() -> None:
    page = lambda: httpx2.Response(200, content=b"<html>", headers={"content-type": "text/html"})  # noqa: E731
    assert Service([page], [job("succeeded", 1.0)]).follow().state == "succeeded"


@pytest.mark.parametrize(
    ("state", "error"), [("failed", errors.JobFailedError), ("cancelled", errors.JobCancelledError)]
)
def test_a_job_without_success_is_an_error(state: str, error: type[errors.JobFailedError]) -> None:
    ended = job(state, error={"code": "too_few_candidates", "detail": "only 3 candidates"})
    with pytest.raises(error) as raised:
        Service([stream(ended)], [ended]).follow()
    assert raised.value.job.state == state
    assert state != "failed" or "only 3 candidates" in str(raised.value)


def test_silence_is_not_waited_out_for_ever() -> None:
    service = Service([httpx2.ConnectError], [httpx2.ConnectError])
    with pytest.raises(errors.TransportError):
        service.follow(patience_s=60)
    assert 60 < service.now < 120


@pytest.mark.parametrize("cancel", [True, False])
def test_ctrl_c_asks_whether_to_cancel(cancel: bool, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    asked: list[tuple[str, str]] = []

    def respond(request: httpx2.Request) -> httpx2.Response:
        asked.append((request.method, request.url.path))
        if request.url.path == EVENTS:
            raise KeyboardInterrupt
        if request.method == "DELETE":
            return httpx2.Response(204)
        return httpx2.Response(202, json=job("running"))

    questions: list[str] = []

    def answer(question: str) -> bool:
        questions.append(question)
        return cancel

    monkeypatch.setattr(jobs, "confirmed", answer)
    monkeypatch.setattr(commands, "Client", lambda url, key: Client(url, key, transport=httpx2.MockTransport(respond)))
    assert run(["remap", "--domain", "d", "--training", "t", "--server", "http://service"]) == 130
    assert questions == ["Cancel job 7 on the server too?"]
    assert (("DELETE", "/v1/admin/jobs/7") in asked) == cancel
    assert ("being cancelled" if cancel else "jobs 7 --follow") in capsys.readouterr().err


def test_the_bar_shows_what_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Console(file=io.StringIO(), force_terminal=True, width=100)
    monkeypatch.setattr(console, "REMARKS", shown)
    with console.JobBar("mapping d") as bar:
        for state in (
            job("running"),
            job("running", 0.7, stage="train_planner", eta_s=3723.4),
            job("queued"),
            job("running", 0.4, stage="rank"),
        ):
            bar(Job.model_validate(state))
            bar.refresh()
        bar.silent(12.4)
        bar.refresh()
    printed = shown.file.getvalue()  # type: ignore[attr-defined]
    shown_words = ("beginning", "train planner", "70 %", "1:02:03", "waiting for its turn", "rank", "40 %")
    for words in (*shown_words, "no answer for 12 s, still trying"):
        assert words in printed


def test_without_a_terminal_nobody_is_asked() -> None:
    assert commands.confirmed("?") is False


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ("running", "job 7 is being cancelled; see how it ends with: deepsimbad-client jobs 7 --follow"),
        ("cancelled", "job 7 is cancelled"),
        ("succeeded", "job 7 had ended before it could be cancelled"),
    ],
)
def test_a_cancel_says_what_came_of_it(
    state: str, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []

    def respond(request: httpx2.Request) -> httpx2.Response:
        asked.append(request.method)
        return httpx2.Response(204) if request.method == "DELETE" else httpx2.Response(200, json=job(state))

    monkeypatch.setattr(commands, "Client", lambda url, key: Client(url, key, transport=httpx2.MockTransport(respond)))
    assert run(["jobs", "7", "--cancel", "--json", "--server", "http://service"]) == 0
    shown = capsys.readouterr()
    assert asked == ["DELETE", "GET"]
    assert shown.err == f"{told}\n"
    assert json.loads(shown.out)["state"] == state
