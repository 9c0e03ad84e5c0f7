"""Following a job through whatever happens to the connection."""

import io
import json
from collections.abc import Callable
from typing import Any

import httpx2
import pytest
from rich.console import Console

from deepsimbad_client import Client, RetryPolicy, commands, console, errors
from deepsimbad_client.commands import jobs
from deepsimbad_client.commands.group import run
from deepsimbad_client.http.jobs import follow_job
from deepsimbad_client.http.models import Job

EVENTS = "/v1/admin/jobs/7/events"


def job(state: str, progress: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"job_id": "7", "domain": "d", "state": state, "progress": progress, **more}


class Broken(httpx2.SyncByteStream):
    """A stream that gives some events and breaks off."""

    def __init__(self, *events: dict[str, Any]) -> None:
        self.events = events

    def __iter__(self) -> Any:
        for event in self.events:
            yield f"event: progress\ndata: {json.dumps(event)}\n\n".encode()
        raise httpx2.ReadError("the link is gone")


def stream(*events: dict[str, Any]) -> httpx2.Response:
    text = "".join(f"event: progress\ndata: {json.dumps(event)}\n\n" for event in events)
    return httpx2.Response(200, content=text.encode(), headers={"content-type": "text/event-stream"})


def broken_stream(*events: dict[str, Any]) -> httpx2.Response:
    return httpx2.Response(200, stream=Broken(*events), headers={"content-type": "text/event-stream"})


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


def test_a_stream_that_lasts_is_all_there_is() -> None:
    events = lambda: stream(job("running", 0.5), job("succeeded", 1.0))  # noqa: E731
    service = Service([events], [httpx2.ReadError])
    assert service.follow().state == "succeeded"
    assert [heard.progress for heard in service.heard] == [0.5, 1.0]
    assert service.asked == [EVENTS]


def test_a_stream_that_breaks_off_is_listened_to_again() -> None:
    first: Callable[[], httpx2.Response] = lambda: broken_stream(job("running", 0.2))  # noqa: E731
    last: Callable[[], httpx2.Response] = lambda: stream(job("succeeded", 1.0))  # noqa: E731
    service = Service([first, httpx2.ConnectError, last], [httpx2.ConnectError, job("running", 0.6)])
    assert service.follow().state == "succeeded"
    assert [heard.progress for heard in service.heard] == [0.2, 0.6, 1.0]


def test_a_restarted_service_takes_the_job_up_again() -> None:
    """It was far, goes back to the queue while the service starts, and is resumed behind its last finished stage."""
    before: Callable[[], httpx2.Response] = lambda: broken_stream(job("running", 0.7))  # noqa: E731
    starting = lambda: httpx2.Response(503, json={"code": "unavailable"})  # noqa: E731
    after: Callable[[], httpx2.Response] = lambda: stream(  # noqa: E731
        job("queued", 0.0), job("running", 0.5), job("succeeded", 1.0)
    )
    service = Service([before, httpx2.ConnectError, starting, after], [httpx2.ConnectError, starting, job("queued")])
    assert service.follow().state == "succeeded"
    assert [(heard.state, heard.progress) for heard in service.heard] == [
        ("running", 0.7),
        ("queued", 0.0),
        ("queued", 0.0),
        ("running", 0.5),
        ("succeeded", 1.0),
    ]
    assert service.silences == [0.0, 2.0]


@pytest.mark.parametrize("status", [408, 429, 502, 503])
def test_a_service_with_too_much_to_do_is_asked_again(status: int) -> None:
    busy = lambda: httpx2.Response(status, json={"code": "busy"})  # noqa: E731
    last: Callable[[], httpx2.Response] = lambda: stream(job("succeeded", 1.0))  # noqa: E731
    service = Service([busy, last], [busy])
    assert service.follow().state == "succeeded"
    assert service.asked.count(EVENTS) == 2


@pytest.mark.parametrize(("status", "error"), [(401, errors.UnauthorizedError), (403, errors.ForbiddenError)])
def test_a_key_that_was_revoked_meanwhile_ends_it(status: int, error: type[errors.ApiError]) -> None:
    refused = lambda: httpx2.Response(status, json={"detail": "no"})  # noqa: E731
    with pytest.raises(error, match="keys create"):
        Service([refused], [refused]).follow()


def test_without_streams_the_job_is_asked_for() -> None:
    refusal = lambda: httpx2.Response(404, json={"code": "not_found"})  # noqa: E731
    service = Service([refusal], [job("queued"), job("running", 0.5), job("succeeded", 1.0)])
    assert service.follow().state == "succeeded"
    assert service.asked.count(EVENTS) == 1


def test_a_page_instead_of_a_stream_is_no_end() -> None:
    page = lambda: httpx2.Response(200, content=b"<html>", headers={"content-type": "text/html"})  # noqa: E731
    service = Service([page], [job("succeeded", 1.0)])
    assert service.follow().state == "succeeded"


@pytest.mark.parametrize(
    ("state", "error"), [("failed", errors.JobFailedError), ("cancelled", errors.JobCancelledError)]
)
def test_a_job_without_success_is_an_error(state: str, error: type[errors.JobFailedError]) -> None:
    ended = job(state, error={"code": "too_few_candidates", "detail": "only 3 candidates"})
    with pytest.raises(error) as raised:
        Service([lambda: stream(ended)], [ended]).follow()
    assert raised.value.job.state == state
    assert state != "failed" or "only 3 candidates" in str(raised.value)


def test_silence_is_not_waited_out_for_ever() -> None:
    service = Service([httpx2.ConnectError], [httpx2.ConnectError])
    with pytest.raises(errors.TransportError):
        service.follow(patience_s=60)
    assert 60 < service.now < 120


def test_an_unknown_job_is_said_at_once() -> None:
    unknown = lambda: httpx2.Response(404, json={"code": "unknown_job", "detail": "no job 7"})  # noqa: E731
    with pytest.raises(errors.UnknownJobError):
        Service([unknown], [unknown]).follow()


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
            bar._progress.refresh()
        bar.silent(12.4)
        bar._progress.refresh()
    printed = shown.file.getvalue()  # type: ignore[attr-defined]
    for words in (
        "beginning",
        "train planner",
        "70 %",
        "1:02:03",
        "waiting for its turn",
        "rank",
        "40 %",
        "no answer for 12 s, still trying",
    ):
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
