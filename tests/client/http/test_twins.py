"""Every operation of the service has its call in both clients, the blocking and the async one, and it is that call.

An operation without a twin fails here by name: add the call to both clients and a line to `ASKED`.
"""

import asyncio
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import httpx2
import pytest

from deepsimbad.api.app import create_app
from deepsimbad.api.bodies import RemapBody
from deepsimbad.api.session_bodies import SessionBody
from deepsimbad.settings import Settings
from deepsimbad_client import AsyncClient, AsyncSession, Client, RetryPolicy, Session
from deepsimbad_client.commands.group import cli
from deepsimbad_client.http.admin import RemapOptions
from deepsimbad_client.http.models import SessionState

NO_ANSWER = httpx2.ConnectError
STATE = SessionState.model_validate(
    {
        "session_id": "s",
        "domain": "d",
        "map_version": 1,
        "n_observations": 0,
        "belief": {
            "mean_m": 0,
            "mode_m": 0,
            "std_m": 0,
            "credible_95_m": [0, 0],
            "entropy_bits": 0,
            "histogram": {"edges_m": [0, 1], "mass": [1]},
            "top": [],
        },
    }
)

Ask = Callable[[Any, Any, Path], Any]
"""From a client, one of its sessions and a file: what the call gives."""

ASKED: dict[str, Ask] = {
    "GET /healthz": lambda c, s, f: c.health(),
    "GET /readyz": lambda c, s, f: c.ready(),
    "GET /metrics": lambda c, s, f: c.metrics(),
    "GET /v1/domains": lambda c, s, f: c.domains(),
    "GET /v1/domains/{domain}": lambda c, s, f: c.domain("d"),
    "GET /v1/domains/{domain}/landmark-model": lambda c, s, f: c.on_board("d"),
    "POST /v1/domains/{domain}/localizations": lambda c, s, f: c.localize("d", ranked_landmarks=[0]),
    "POST /v1/domains/{domain}/sessions": lambda c, s, f: c.session("d"),
    "POST /v1/sessions/{session_id}/observations": lambda c, s, f: s.observe(ranked_landmarks=[0]),
    "POST /v1/sessions/{session_id}/truths": lambda c, s, f: s.truths([1.0]),
    "GET /v1/sessions/{session_id}": lambda c, s, f: s.state(),
    "GET /v1/sessions/{session_id}/belief": lambda c, s, f: s.belief_masses(),
    "GET /v1/sessions/{session_id}/next-best-view": lambda c, s, f: s.next_best_view(),
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
    "GET /v1/admin/domains/{domain}/maps": lambda c, s, f: c.admin.maps("d"),
    "DELETE /v1/admin/domains/{domain}/maps/{version}": lambda c, s, f: c.admin.delete_map("d", 2),
    "GET /v1/admin/domains/{domain}/maps/{version}/file": lambda c, s, f: c.admin.download_map("d", 2, f),
    "PUT /v1/admin/domains/{domain}/active-map": lambda c, s, f: c.admin.activate("d", 2),
    "GET /v1/admin/sessions": lambda c, s, f: c.admin.sessions(),
    "GET /v1/admin/jobs": lambda c, s, f: c.admin.jobs(),
    "GET /v1/admin/jobs/{job_id}": lambda c, s, f: c.admin.job("j"),
    "GET /v1/admin/jobs/{job_id}/events": lambda c, s, f: c.admin.job_events("j"),
    "DELETE /v1/admin/jobs/{job_id}": lambda c, s, f: c.admin.cancel_job("j"),
}


def document() -> dict[str, Any]:
    return create_app(Settings(data_dir=Path("never-opened"))).openapi()


OPERATIONS = sorted(f"{method.upper()} {path}" for path, methods in document()["paths"].items() for method in methods)


class Nobody:
    """Answers nothing and remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.asked.append(f"{request.method} {request.url.path}")
        raise NO_ANSWER("nobody is here", request=request)


def leads_to(operation: str, asked: str) -> bool:
    method, _, path = operation.partition(" ")
    return re.fullmatch(f"{method} {re.sub('{[^}]*}', '[^/]+', path)}", asked) is not None


def test_no_twin_is_of_a_call_that_is_gone() -> None:
    assert sorted(ASKED) == OPERATIONS


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_operation_has_its_call_in_both_clients(operation: str, tmp_path: Path) -> None:
    assert operation in ASKED, f"{operation} has no call in the clients"
    ask = ASKED[operation]
    nobody = Nobody()
    once = RetryPolicy(attempts=1)

    client = Client("http://service", retry=once, transport=httpx2.MockTransport(nobody))
    with pytest.raises(Exception, match="nobody is here"):
        _exhaust(ask(client, Session(client._wire, STATE, keep=True), tmp_path / "file"))

    async def await_it() -> None:
        twin = AsyncClient("http://service", retry=once, transport=httpx2.MockTransport(nobody))
        given = ask(twin, AsyncSession(twin._wire, STATE, keep=True), tmp_path / "file")
        if inspect.isasyncgen(given):
            async for _ in given:
                pass
        else:
            await given

    with pytest.raises(Exception, match="nobody is here"):
        asyncio.run(await_it())
    assert len(nobody.asked) == 2
    assert all(leads_to(operation, asked) for asked in nobody.asked), nobody.asked


def _exhaust(given: Any) -> None:
    if inspect.isgenerator(given):
        for _ in given:
            pass


def test_every_option_of_a_remap_can_be_given_in_python_and_on_the_command_line() -> None:
    members = set(RemapBody.model_fields)
    assert members == set(RemapOptions.__annotations__) | {"training_traverse"}
    command = cli.commands["remap"]
    options = {
        name.lstrip("-").replace("-", "_")
        for option in command.params
        for name in (*option.opts, *option.secondary_opts)
        if isinstance(option, click.Option)
    }
    assert members <= options


def test_every_option_of_a_session_can_be_given() -> None:
    for client in (Client, AsyncClient):
        assert set(SessionBody.model_fields) <= set(inspect.signature(client.session).parameters)
