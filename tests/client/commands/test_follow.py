"""Following a job through whatever happens to the connection."""

import json
import sys

import click
import httpx2
import pytest

from deepsimbad_client import Client, RetryPolicy, errors
from deepsimbad_client.commands import console, run
from deepsimbad_client.http.admin import follow_job
from deepsimbad_client.http.models import Job

from ..http.scripted import answer

EVENTS = "/v1/admin/jobs/7/events"


def job(state, progress=0.0, **fields):
    return {"job_id": "7", "domain": "d", "state": state, "progress": progress, **fields}


def stream(*events, breaks_off=False):
    """A function that makes a response of some events, which ends or breaks off."""

    class Events(httpx2.SyncByteStream):
        def __iter__(self):
            for event in events:
                yield f"event: progress\ndata: {json.dumps(event)}\n\n".encode()
            if breaks_off:
                raise httpx2.ReadError("the link is gone")

    return lambda: httpx2.Response(200, stream=Events(), headers={"content-type": "text/event-stream"})


class Service:
    """Answers from two queues, of the stream and of single questions, the last of each for ever."""

    def __init__(self, streams, answers):
        self.queues = {True: streams, False: answers}
        self.paths: list[str] = []
        self.time_s = 0.0
        self.heard: list[Job] = []
        self.silences: list[float] = []

    def __call__(self, request):
        self.paths.append(request.url.path)
        queue = self.queues[request.url.path == EVENTS]
        outcome = queue.pop(0) if len(queue) > 1 else queue[0]
        if isinstance(outcome, type):
            raise outcome("scripted", request=request)
        if callable(outcome):
            outcome = outcome()
        return outcome if isinstance(outcome, httpx2.Response) else httpx2.Response(200, json=outcome)

    def sleep(self, seconds):
        self.time_s += seconds

    def follow(self, patience_s=60.0):
        retry = RetryPolicy(attempts=1)
        client = Client("http://service", retry=retry, transport=httpx2.MockTransport(self), sleep=self.sleep)
        return follow_job(
            *(client, "7", self.heard.append),
            on_silence=self.silences.append,
            patience_s=patience_s,
            sleep=self.sleep,
            clock=lambda: self.time_s,
        )


DONE = stream(job("succeeded", 1.0))
BROKEN_OFF = stream(job("running", 0.2), breaks_off=True)
LOST = httpx2.ConnectError
STARTING = answer(503, {"code": "unavailable"})
NO_STREAMS = answer(404, {"code": "not_found"})
PAGE = httpx2.Response(200, content=b"<html>", headers={"content-type": "text/html"})
QUEUED, RUNNING, SUCCEEDED = job("queued"), job("running", 0.6), job("succeeded", 1.0)


@pytest.mark.parametrize(
    ("streams", "answers", "heard"),
    [
        ([stream(RUNNING, SUCCEEDED)], [httpx2.ReadError], [0.6, 1.0]),
        ([BROKEN_OFF, LOST, DONE], [LOST, RUNNING], [0.2, 0.6, 1.0]),
        # Restarted: the job goes back to the queue while the service starts, and begins again.
        (
            [BROKEN_OFF, LOST, STARTING, stream(QUEUED, RUNNING, SUCCEEDED)],
            [LOST, STARTING, QUEUED],
            [0.2, 0, 0, 0.6, 1],
        ),
        ([NO_STREAMS] * 3, [QUEUED, RUNNING, SUCCEEDED], [0.0, 0.6, 1.0]),
        ([PAGE], [SUCCEEDED], [1.0]),
        *(([answer(status), DONE], [answer(status)], [1.0]) for status in (408, 429, 502, 503)),
    ],
)
def test_a_job_is_followed_to_its_end(streams, answers, heard):
    service = Service([*streams], [*answers])
    assert service.follow().state == "succeeded"
    assert [job.progress for job in service.heard] == heard
    assert service.paths.count(EVENTS) == len(streams)
    assert service.silences == ([0.0, 2.0] if STARTING in streams else service.silences)


@pytest.mark.parametrize(
    ("status", "code", "error", "words"),
    [
        (401, "unauthorized", errors.UnauthorizedError, "API_KEY"),  # the key was revoked meanwhile
        (403, "forbidden", errors.ForbiddenError, "keys create --scope admin"),
        (404, "unknown_job", errors.UnknownJobError, "no job 7"),
    ],
)
def test_a_refusal_ends_it(status, code, error, words):
    refused = answer(status, {"code": code, "detail": "no job 7", "needed": "admin"})
    with pytest.raises(error, match=words):
        Service([refused], [refused]).follow()


@pytest.mark.parametrize(
    ("state", "error"), [("failed", errors.JobFailedError), ("cancelled", errors.JobCancelledError)]
)
def test_a_job_without_success_is_an_error(state, error):
    last_job = job(state, error={"code": "too_few_candidates", "detail": "only 3 candidates"})
    with pytest.raises(error) as raised:
        Service([stream(last_job)], [last_job]).follow()
    assert raised.value.job.state == state
    assert state != "failed" or "only 3 candidates" in str(raised.value)


def test_silence_is_not_waited_out_for_ever():
    service = Service([LOST], [LOST])
    with pytest.raises(errors.TransportError):
        service.follow(patience_s=60)
    assert 60 < service.time_s < 120


@pytest.fixture
def responding(monkeypatch):
    """Lets commands talk to a service of one function; returns the list of their requests, as "VERB path"."""

    def responding(respond):
        requests = []

        def handle(request):
            requests.append(f"{request.method} {request.url.path}")
            return httpx2.Response(204) if request.method == "DELETE" else respond(request)

        transport = httpx2.MockTransport(handle)
        monkeypatch.setattr(console, "Client", lambda url, key: Client(url, key, transport=transport))
        return requests

    return responding


@pytest.fixture
def confirming(monkeypatch):
    """Puts a person at the terminal who gives this reply, or presses Ctrl-C (None); returns the list of questions."""

    def confirming(reply):
        questions = []

        def confirm(question, **options):
            questions.append(question)
            assert options["default"] is False, "Enter alone changes nothing"
            if reply is None or (options.get("abort") and not reply):
                raise click.Abort
            return reply

        monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
        monkeypatch.setattr(click, "confirm", confirm)
        return questions

    return confirming


REMAP = ("remap", "--domain", "d", "--training", "t")


@pytest.mark.parametrize("command", [REMAP, ("jobs", "7", "--follow")])
@pytest.mark.parametrize("reply", [True, False, None])
def test_ctrl_c_asks_whether_to_cancel(command, reply, responding, confirming, capsys):
    def respond(request):
        if request.url.path == EVENTS:
            raise KeyboardInterrupt
        return httpx2.Response(202, json=job("running"))

    requests, questions = responding(respond), confirming(reply)
    assert run([*command, "--server", "http://service"]) == 130
    assert questions == ["Cancel job 7 on the server too?"]
    assert requests.count("DELETE /v1/admin/jobs/7") == (reply is True)
    assert ("job 7 is being cancelled" if reply else "deepsimbad-client jobs 7 --follow") in capsys.readouterr().err


@pytest.mark.parametrize(("reply", "code"), [(True, 0), (False, 130), (None, 130)])
def test_a_deletion_is_asked_about(reply, code, responding, confirming):
    requests = responding(lambda request: httpx2.Response(200, json={"name": "t", "n_frames": 12}))
    questions = confirming(reply)
    assert run(["delete-traverse", "d", "t", "--server", "http://service"]) == code
    assert questions == ["Delete traverse t of domain d with its 12 frames?"]
    assert requests.count("DELETE /v1/admin/domains/d/traverses/t") == (reply is True)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ("running", "job 7 is being cancelled"),
        ("cancelled", "job 7 is cancelled"),
        ("succeeded", "job 7 had ended as succeeded before it could be cancelled"),
    ],
)
def test_a_cancel_says_what_came_of_it(state, words, responding, capsys):
    requests = responding(lambda request: httpx2.Response(200, json=job(state)))
    assert run(["jobs", "7", "--cancel", "--json", "--server", "http://service"]) == 0
    printed = capsys.readouterr()
    assert requests == ["DELETE /v1/admin/jobs/7", "GET /v1/admin/jobs/7"]
    assert printed.err == f"{words}\n"
    assert json.loads(printed.out)["state"] == state
