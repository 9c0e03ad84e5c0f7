"""Every operation of the service has its call, and the blocking and the async client have the same calls."""

import asyncio
import inspect
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import httpx2
import pytest

from deepsimbad.api.app import create_app
from deepsimbad.api.jobs import RemapBody
from deepsimbad.api.sessions import SessionBody
from deepsimbad.settings import Settings
from deepsimbad_client import AsyncClient, AsyncSession, Client, Session, errors
from deepsimbad_client.commands import cli
from deepsimbad_client.http.admin import Admin, AsyncAdmin, RemapOptions
from deepsimbad_client.http.client import SessionOptions
from deepsimbad_client.http.models import SessionState

from .scripted import JOB, POLICY, STATE, Script, answer
from .test_requests import JOBS, shelf

Ask = Callable[[Any, Any, Path], Any]
"""A call of a client, one of its sessions or a file."""

ASKED: dict[str, Ask] = {
    "GET /healthz": lambda c, s, f: c.health(),
    "GET /readyz": lambda c, s, f: c.ready(),
    "GET /metrics": lambda c, s, f: c.metrics(),
    "GET /v1/domains": lambda c, s, f: c.domains(),
    "GET /v1/domains/{domain}": lambda c, s, f: c.domain("d"),
    "GET /v1/domains/{domain}/landmark-model": lambda c, s, f: c.on_board("d"),
    "GET /v1/domains/{domain}/coverage": lambda c, s, f: c.coverage("d"),
    "GET /v1/domains/{domain}/landmarks": lambda c, s, f: c.landmarks("d"),
    "GET /v1/domains/{domain}/landmarks/{index}/thumbnail": lambda c, s, f: c.landmark_thumbnail("d", 3),
    "GET /v1/domains/{domain}/map-images/{index}/thumbnail": lambda c, s, f: c.thumbnail("d", 3),
    "POST /v1/domains/{domain}/localizations": lambda c, s, f: c.localize("d", ranked_landmarks=[0]),
    "POST /v1/localizations": lambda c, s, f: c.localize_anywhere(ranked_landmarks=[0]),
    "POST /v1/domains/{domain}/sessions": lambda c, s, f: c.session("d"),
    "POST /v1/sessions/{session_id}/observations": lambda c, s, f: s.observe(ranked_landmarks=[0]),
    "POST /v1/sessions/{session_id}/truths": lambda c, s, f: s.truths([1.0]),
    "GET /v1/sessions/{session_id}": lambda c, s, f: s.state(),
    "GET /v1/sessions/{session_id}/belief": lambda c, s, f: s.belief_masses(),
    "GET /v1/sessions/{session_id}/next-best-view": lambda c, s, f: s.next_best_view(),
    "GET /v1/sessions/{session_id}/events": lambda c, s, f: s.events(),
    "GET /v1/sessions/{session_id}/view": lambda c, s, f: s.view(),
    "PUT /v1/sessions/{session_id}/prior": lambda c, s, f: s.set_prior(1.0, 2.0),
    "DELETE /v1/sessions/{session_id}": lambda c, s, f: s.delete(),
    "PUT /v1/admin/domains/{domain}": lambda c, s, f: c.admin.put_domain("d", {"kind": "feature_l2"}),
    "DELETE /v1/admin/domains/{domain}": lambda c, s, f: c.admin.delete_domain("d"),
    "POST /v1/admin/domains/{domain}/traverses": lambda c, s, f: c.admin.create_traverse("d", "t"),
    "GET /v1/admin/domains/{domain}/traverses": lambda c, s, f: c.admin.traverses("d"),
    "GET /v1/admin/domains/{domain}/traverses/{name}": lambda c, s, f: c.admin.traverse("d", "t"),
    "DELETE /v1/admin/domains/{domain}/traverses/{name}": lambda c, s, f: c.admin.delete_traverse("d", "t"),
    "PUT /v1/admin/domains/{domain}/traverses/{name}/frames/{index}": lambda c, s, f: c.admin.put_frame(
        "d", "t", 3, encoding=[1.0], position_m=0.0
    ),
    "POST /v1/admin/domains/{domain}/traverses/{name}/frames": lambda c, s, f: c.admin.put_frames(
        "d", "t", encodings=[[1.0]], index=[0], position_m=[0.0]
    ),
    "POST /v1/admin/domains/{domain}/remaps": lambda c, s, f: c.admin.remap("d", training_traverse="t"),
    "POST /v1/admin/domains/{domain}/experience": lambda c, s, f: c.admin.feed_experience("d", "s", [1.0]),
    "POST /v1/admin/domains/{domain}/warm": lambda c, s, f: c.admin.warm("d"),
    "GET /v1/admin/domains/{domain}/maps": lambda c, s, f: c.admin.maps("d"),
    "DELETE /v1/admin/domains/{domain}/maps/{version}": lambda c, s, f: c.admin.delete_map("d", 2),
    "GET /v1/admin/domains/{domain}/maps/{version}/file": lambda c, s, f: c.admin.download_map("d", 2, f),
    "PUT /v1/admin/domains/{domain}/active-map": lambda c, s, f: c.admin.activate("d", 2),
    "GET /v1/admin/domains/{domain}/traverses/{name}/frames": lambda c, s, f: c.admin.frames("d", "t"),
    "GET /v1/admin/sessions": lambda c, s, f: c.admin.sessions(),
    "GET /v1/admin/jobs": lambda c, s, f: c.admin.jobs(),
    "GET /v1/admin/jobs/{job_id}": lambda c, s, f: c.admin.job("j"),
    "GET /v1/admin/jobs/{job_id}/events": lambda c, s, f: c.admin.job_events("j"),
    "DELETE /v1/admin/jobs/{job_id}": lambda c, s, f: c.admin.cancel_job("j"),
}


def document():
    return create_app(Settings(data_dir=Path("never-opened"))).openapi()


OPERATIONS = sorted(f"{method.upper()} {path}" for path, methods in document()["paths"].items() for method in methods)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_operation_has_its_call(operation, tmp_path):
    assert operation in ASKED, f"{operation} has no call in the client"
    script = Script(httpx2.ConnectError)
    client = script.client()
    session = Session(client._wire, SessionState.model_validate(STATE), keep=True)
    with pytest.raises(errors.TransportError):
        tuple(ASKED[operation](client, session, tmp_path / "file"))
    method, _, path = operation.partition(" ")
    request = script.requests[0]
    assert request.method == method
    assert re.fullmatch(re.sub("{[^}]*}", "[^/]+", path), request.url.path)


def test_every_option_of_a_remap_and_a_session_can_be_given():
    assert sorted(ASKED) == OPERATIONS, "no call is of an operation that is gone"
    assert set(SessionBody.model_fields) == {"start_position_m", "start_std_m", *SessionOptions.__annotations__}
    members = set(RemapBody.model_fields)
    assert members == {"training_traverse", *RemapOptions.__annotations__}
    options = {
        name.lstrip("-").replace("-", "_")
        for option in cli.commands["remap"].params
        for name in (*option.opts, *option.secondary_opts)
        if isinstance(option, click.Option)
    }
    assert members <= options


@pytest.mark.parametrize("faces", [(Client, AsyncClient), (Session, AsyncSession), (Admin, AsyncAdmin)])
def test_both_faces_show_signature_and_docstring(faces):
    blocking, awaiting = faces
    calls = [name for name, _ in inspect.getmembers(blocking, inspect.isfunction) if name[0] != "_" and name != "close"]
    assert len(calls) > 6
    for name in calls:
        blocking_call, awaiting_call = getattr(blocking, name), getattr(awaiting, name)
        assert inspect.signature(blocking_call) == inspect.signature(awaiting_call)
        assert blocking_call.__doc__ == awaiting_call.__doc__ != ""
        assert not inspect.iscoroutinefunction(blocking_call)
        assert inspect.iscoroutinefunction(awaiting_call) != (name in {"job_events", "events"})


def run_async(transport, act):
    """Run `act` on an async client; returns the seconds it slept between tries."""
    slept: list[float] = []

    async def sleep(seconds):
        slept.append(seconds)

    async def run():
        arguments = {"retry": POLICY, "sleep": sleep, "jitter": lambda: 1.0}
        async with AsyncClient("http://service", transport=httpx2.MockTransport(transport), **arguments) as client:
            await act(client)

    asyncio.run(run())
    return slept


def test_the_async_client_obeys_the_same_rules():
    async def ask(client):
        assert (await client.health()).status == "alive"

    script = Script(httpx2.ConnectError, answer(503, retry_after="4"), answer(200, {"status": "alive"}))
    assert run_async(script, ask) == [1.0, 4.0]
    with pytest.raises(errors.TransportError):
        run_async(Script(httpx2.ReadError), ask)


def test_lists_and_events_in_both_clients():
    last_job = {**JOB, "state": "succeeded"}
    stream = f": ping\n\nevent: progress\ndata: {json.dumps(JOB)}\n\nevent: done\ndata: {json.dumps(last_job)}\n\n"

    def events():
        return Script(httpx2.Response(200, content=stream.encode(), headers={"content-type": "text/event-stream"}))

    async def listen(client):
        assert [job.state async for job in client.admin.job_events("j")] == ["running", "succeeded"]

    async def read(client):
        assert len(await client.admin.jobs("d")) == len(JOBS)

    script = events()
    assert [job.state for job in script.client().admin.job_events("j")] == ["running", "succeeded"]
    assert script.requests[0].headers["accept"] == "text/event-stream"
    run_async(events(), listen)
    run_async(shelf, read)


def test_a_stream_that_ends_before_its_last_event_broke_off():
    """As the service ends all when it stops: the session, or the job, goes on."""
    stream = f"event: progress\ndata: {json.dumps(JOB)}\n\n"
    script = Script(httpx2.Response(200, content=stream.encode(), headers={"content-type": "text/event-stream"}))
    events = script.client().admin.job_events("j")
    assert next(events).state == "running"
    with pytest.raises(errors.TransportError, match="ended before"):
        next(events)


def test_a_stream_that_is_left_early_is_closed():
    class Stream(httpx2.SyncByteStream):
        closed = False

        def __iter__(self):
            while True:
                yield f"event: progress\ndata: {json.dumps(JOB)}\n\n".encode()

        def close(self):
            self.closed = True

    stream = Stream()
    script = Script(httpx2.Response(200, stream=stream, headers={"content-type": "text/event-stream"}))

    async def leave():  # under a running loop, what is not closed by hand is closed later
        events = script.client().admin.job_events("j")
        assert next(events).state == "running"
        assert not stream.closed
        events.close()
        assert stream.closed

    asyncio.run(leave())
