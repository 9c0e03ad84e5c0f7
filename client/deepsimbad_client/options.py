"""Options that several commands share."""

from collections.abc import Callable
from pathlib import Path

import click

from deepsimbad_client.transport import DEFAULT_URL, KEY_VARIABLE, URL_VARIABLE
from deepsimbad_client.upload import CONCURRENCY


def serving(command: Callable[..., None]) -> Callable[..., None]:
    """Options of every command that talks to a service."""
    key = click.option(
        "--api-key",
        envvar=KEY_VARIABLE,
        help=f"Better kept in ${KEY_VARIABLE}: a command line can be read by others.",
    )
    server = click.option(
        "--server", envvar=URL_VARIABLE, default=DEFAULT_URL, show_default=True, show_envvar=True, metavar="URL"
    )
    return server(key(command))


def reading(command: Callable[..., None]) -> Callable[..., None]:
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


def at_once(command: Callable[..., None]) -> Callable[..., None]:
    """How many requests are under way."""
    return click.option(
        "--concurrency",
        type=click.IntRange(1, 64),
        default=CONCURRENCY,
        show_default=True,
        help="Requests under way at once.",
    )(command)


json_flag = click.option("--json", "json_output", is_flag=True, help="Print one JSON document.")
domain_option = click.option("--domain", required=True, metavar="NAME")
