"""The commands of `deepsimbad-client`, and what they share: options, and how results are printed."""

import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import click
from pydantic import BaseModel
from rich.table import Table

from deepsimbad_client.commands.console import as_json, show
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.upload import CONCURRENCY
from deepsimbad_client.http.wire import DEFAULT_URL, KEY_VARIABLE, URL_VARIABLE

Command = Callable[..., None]


def serving(command: Command) -> Command:
    """Options of every command that talks to a service, and the `client` made of them."""

    @click.option(
        "--server", envvar=URL_VARIABLE, default=DEFAULT_URL, show_default=True, show_envvar=True, metavar="URL"
    )
    @click.option(
        "--api-key",
        envvar=KEY_VARIABLE,
        help=f"Better kept in ${KEY_VARIABLE}: a command line can be read by others.",
    )
    @wraps(command)
    def connected(server: str, api_key: str | None, **options: Any) -> None:
        with Client(server, api_key) as client:
            command(client=client, **options)

    return connected


def reading(command: Command) -> Command:
    """Options of every command that reads a recording."""
    spacing = click.option(
        "--spacing-m",
        type=float,
        default=1.0,
        show_default=True,
        help="Metres between frames where the source does not say where they are.",
    )
    undistortion = click.option(
        "--undistortion",
        type=click.Path(exists=True, path_type=Path),
        help="NCLT's undistortion maps (U2D_Cam*.txt or their folder); absent: images stay as they are.",
    )
    return spacing(undistortion(command))


at_once = click.option(
    "--concurrency",
    type=click.IntRange(1, 64),
    default=CONCURRENCY,
    show_default=True,
    help="Requests under way at once.",
)
json_flag = click.option("--json", "json_output", is_flag=True, help="Print one JSON document.")
domain_option = click.option("--domain", required=True, metavar="NAME")
of_domain = click.option("--domain", metavar="NAME", help="Only this domain's.")


def show_list(models: Sequence[BaseModel], table: Table, json_output: bool) -> None:
    """Print a list, for a script or for a person."""
    if json_output:
        click.echo(as_json([model.model_dump(mode="json") for model in models]))
    else:
        show(table)


def confirmed(question: str) -> bool:
    """Ask on a terminal; where there is none, or on Ctrl-C, the answer is no."""
    if not sys.stdin.isatty():
        return False
    try:
        return click.confirm(question, default=False, err=True)
    except click.Abort:
        return False
