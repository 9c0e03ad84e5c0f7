"""`deepsimbad-client sessions` and `traverses`."""

import click

from deepsimbad_client.client import Client
from deepsimbad_client.console import as_json, show
from deepsimbad_client.options import json_flag, serving
from deepsimbad_client.tables import session_table, traverse_table


@click.command()
@click.option("--domain", metavar="NAME", help="Only this domain's.")
@json_flag
@serving
def sessions(domain: str | None, json_output: bool, server: str, api_key: str | None) -> None:
    """List the sessions that live, newest first."""
    with Client(server, api_key) as client:
        found = client.admin.sessions(domain)
    if json_output:
        click.echo(as_json([session.model_dump(mode="json") for session in found]))
    else:
        show(session_table(found))


@click.command()
@click.argument("domain")
@json_flag
@serving
def traverses(domain: str, json_output: bool, server: str, api_key: str | None) -> None:
    """List the recorded drives of a domain, and which of their frames are missing."""
    with Client(server, api_key) as client:
        found = client.admin.traverses(domain)
    if json_output:
        click.echo(as_json([traverse.model_dump(mode="json") for traverse in found]))
    else:
        show(traverse_table(domain, found))
