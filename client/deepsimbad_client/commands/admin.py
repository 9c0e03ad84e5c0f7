"""What an administrator looks at and changes: domains, traverses, sessions and maps."""

import sys
from pathlib import Path

import click

from deepsimbad_client.commands import json_flag, of_domain, serving, show_list
from deepsimbad_client.commands.console import (
    DownloadBar,
    as_json,
    domain_table,
    gate_verdict,
    map_table,
    session_table,
    traverse_table,
)
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import MapVersion

asking = click.option("--yes", is_flag=True, help="Do not ask.")
domain_argument = click.argument("domain")
version_argument = click.argument("version", type=click.IntRange(min=1))


@click.command()
@json_flag
@serving
def domains(client: Client, json_output: bool) -> None:
    """List the domains of a service."""
    listed = client.domains()
    show_list(listed, domain_table(listed), json_output)


@click.command()
@of_domain
@json_flag
@serving
def sessions(client: Client, domain: str | None, json_output: bool) -> None:
    """List the sessions that live, newest first."""
    listed = client.admin.sessions(domain)
    show_list(listed, session_table(listed), json_output)


@click.command()
@domain_argument
@json_flag
@serving
def traverses(client: Client, domain: str, json_output: bool) -> None:
    """List the recorded drives of a domain, and which of their frames are missing."""
    listed = client.admin.traverses(domain)
    show_list(listed, traverse_table(domain, listed), json_output)


@click.command()
@domain_argument
@json_flag
@serving
def maps(client: Client, domain: str, json_output: bool) -> None:
    """List the versions of a domain's map: which serves, and how each compared with the one before it."""
    listed = client.admin.maps(domain)
    show_list(listed, map_table(domain, listed), json_output)
    for version in () if json_output else listed:
        if why := gate_verdict(version.check):
            click.echo(f"map {version.version}: {why}")


@click.command()
@domain_argument
@version_argument
@click.option("--expected", type=click.IntRange(min=1), metavar="N", help="Only if version N serves now.")
@json_flag
@serving
def activate(client: Client, domain: str, version: int, expected: int | None, json_output: bool) -> None:
    """Let another version of a domain's map serve, forward or back.

    Sessions keep the version they began on.
    """
    _show_active(domain, client.admin.activate(domain, version, expected=expected), json_output)


@click.command()
@domain_argument
@json_flag
@serving
def rollback(client: Client, domain: str, json_output: bool) -> None:
    """Let the version serve again that served before the present one.

    Once more, and the present one is back.
    """
    _show_active(domain, client.admin.rollback(domain), json_output)


@click.command()
@domain_argument
@version_argument
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--force", is_flag=True, help="Replace FILE where it is there already.")
@json_flag
@serving
def download(client: Client, domain: str, version: int, file: Path, force: bool, json_output: bool) -> None:
    """Fetch the sealed file of a version, checked against its digest.

    Interrupted, the same command goes on where it stopped. `deepsimbad import` takes the file in elsewhere.
    """
    if file.exists() and not force:
        raise click.UsageError(f"{file} is there already: give --force to replace it")
    with DownloadBar(f"map {version} of {domain}") as bar:
        saved = client.admin.download_map(domain, version, file, on_progress=bar)
    if json_output:
        click.echo(as_json({"path": str(saved.path), "sha256": saved.sha256, "file_bytes": saved.file_bytes}))
    else:
        click.echo(f"{saved.path}: {saved.file_bytes} bytes, sha256 {saved.sha256}")


@click.command("delete-domain")
@domain_argument
@asking
@json_flag
@serving
def delete_domain(client: Client, domain: str, yes: bool, json_output: bool) -> None:
    """Delete a domain with all its maps, drives and sessions."""
    if not yes:
        client.domain(domain)
        n_maps, n_traverses = len(client.admin.maps(domain)), len(client.admin.traverses(domain))
        n_sessions = len(client.admin.sessions(domain))
        _ask(f"Delete domain {domain}: maps {n_maps}, traverses {n_traverses}, living sessions {n_sessions}?")
    client.admin.delete_domain(domain)
    _show_deleted(json_output, domain=domain)


@click.command("delete-traverse")
@domain_argument
@click.argument("traverse")
@asking
@json_flag
@serving
def delete_traverse(client: Client, domain: str, traverse: str, yes: bool, json_output: bool) -> None:
    """Delete a recorded drive; the maps made from it stay."""
    if not yes:
        n_frames = client.admin.traverse(domain, traverse).n_frames
        _ask(f"Delete traverse {traverse} of domain {domain} with its {n_frames} frames?")
    client.admin.delete_traverse(domain, traverse)
    _show_deleted(json_output, domain=domain, traverse=traverse)


@click.command("delete-map")
@domain_argument
@version_argument
@asking
@json_flag
@serving
def delete_map(client: Client, domain: str, version: int, yes: bool, json_output: bool) -> None:
    """Delete the file of a map that does not serve; no rollback to it afterwards."""
    if not yes:
        _ask(f"Delete map {version} of domain {domain}?")
    client.admin.delete_map(domain, version)
    _show_deleted(json_output, domain=domain, version=version)


@click.command("delete-session")
@click.argument("session_id")
@asking
@json_flag
@serving
def delete_session(client: Client, session_id: str, yes: bool, json_output: bool) -> None:
    """End a session; its robot must begin another."""
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


def _show_active(domain: str, version: MapVersion, json_output: bool) -> None:
    if json_output:
        click.echo(as_json(version.model_dump(mode="json")))
    else:
        click.echo(f"{domain} serves map {version.version}")


def _show_deleted(json_output: bool, **names: str | int) -> None:
    """A script is told what is gone; a person who was asked knows."""
    if json_output:
        click.echo(as_json({**names, "deleted": True}))
