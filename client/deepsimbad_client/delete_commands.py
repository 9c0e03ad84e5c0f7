"""`deepsimbad-client delete-domain`, `delete-traverse`, `delete-map` and `delete-session`: each asks first."""

import sys
from collections.abc import Callable

import click

from deepsimbad_client.client import Client
from deepsimbad_client.console import as_json
from deepsimbad_client.options import json_flag, serving


def asking(command: Callable[..., None]) -> Callable[..., None]:
    """The option of every command that deletes."""
    return click.option("--yes", is_flag=True, help="Do not ask.")(command)


@click.command("delete-domain")
@click.argument("domain")
@asking
@json_flag
@serving
def delete_domain(domain: str, yes: bool, json_output: bool, server: str, api_key: str | None) -> None:
    """Delete a domain with all its maps, drives and sessions."""
    with Client(server, api_key) as client:
        if not yes:
            client.domain(domain)
            n_maps = len(client.admin.maps(domain))
            n_traverses = len(client.admin.traverses(domain))
            n_sessions = len(client.admin.sessions(domain))
            _ask(f"Delete domain {domain}: maps {n_maps}, traverses {n_traverses}, living sessions {n_sessions}?")
        client.admin.delete_domain(domain)
    _show_deleted(json_output, domain=domain)


@click.command("delete-traverse")
@click.argument("domain")
@click.argument("traverse")
@asking
@json_flag
@serving
def delete_traverse(domain: str, traverse: str, yes: bool, json_output: bool, server: str, api_key: str | None) -> None:
    """Delete a recorded drive; the maps made from it stay."""
    with Client(server, api_key) as client:
        if not yes:
            n_frames = client.admin.traverse(domain, traverse).n_frames
            _ask(f"Delete traverse {traverse} of domain {domain} with its {n_frames} frames?")
        client.admin.delete_traverse(domain, traverse)
    _show_deleted(json_output, domain=domain, traverse=traverse)


@click.command("delete-map")
@click.argument("domain")
@click.argument("version", type=click.IntRange(min=1))
@asking
@json_flag
@serving
def delete_map(domain: str, version: int, yes: bool, json_output: bool, server: str, api_key: str | None) -> None:
    """Delete the file of a map that does not serve; no rollback to it afterwards."""
    with Client(server, api_key) as client:
        if not yes:
            _ask(f"Delete map {version} of domain {domain}?")
        client.admin.delete_map(domain, version)
    _show_deleted(json_output, domain=domain, version=version)


@click.command("delete-session")
@click.argument("session_id")
@asking
@json_flag
@serving
def delete_session(session_id: str, yes: bool, json_output: bool, server: str, api_key: str | None) -> None:
    """End a session; its robot must begin another."""
    with Client(server, api_key) as client:
        if not yes:
            session = client.attach_session(session_id)
            _ask(f"End session {session_id} in domain {session.domain} after {session.opened.n_observations} views?")
        client.admin.delete_session(session_id)
    _show_deleted(json_output, session_id=session_id)


def _ask(question: str) -> None:
    """Go on if a person says yes; where there is nobody to ask, say how to do without."""
    if not sys.stdin.isatty():
        raise click.UsageError("there is no terminal to ask on: give --yes")
    click.confirm(question, default=False, abort=True, err=True)


def _show_deleted(json_output: bool, **names: str | int) -> None:
    """A script is told what is gone; a person who was asked knows."""
    if json_output:
        click.echo(as_json({**names, "deleted": True}))
