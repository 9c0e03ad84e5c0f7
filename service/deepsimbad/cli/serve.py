"""`deepsimbad serve`, and `settings`: every setting as a command would take it, and where it comes from."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.markup import escape
from rich.table import Table

from deepsimbad.cli.options import data_dir_option, given_settings, json_option, traced_settings
from deepsimbad.cli.terminal import print_table, write_json
from deepsimbad.errors import DeepSimbadError
from deepsimbad.settings import unknown_variables, variable_of
from deepsimbad.store.catalog import Catalog

log = logging.getLogger(__name__)

_Command = TypeVar("_Command", bound=Callable[..., Any])


def _address_options(command: _Command) -> _Command:
    host = click.option("--host", help="Address to listen on.  [default: $DEEPSIMBAD_HOST, else 127.0.0.1]")
    port = click.option(
        "--port", type=int, help="Port to listen on; 0 takes a free one.  [default: $DEEPSIMBAD_PORT, else 8000]"
    )
    return host(port(command))


@click.command()
@data_dir_option
@_address_options
@click.option("--create", is_flag=True, help="Make the data directory if it is not there.")
def serve(data_dir: Path | None, host: str | None, port: int | None, create: bool) -> None:
    """Serve the domains over HTTP until interrupted. Ready when /readyz answers 200."""
    from deepsimbad.api.server import configure_logging  # noqa: PLC0415 - other commands need no server
    from deepsimbad.api.server import serve as serve_until_stopped  # noqa: PLC0415

    try:
        settings = given_settings(data_dir=data_dir, host=host, port=port)
        configure_logging(settings.log_level)
        for variable in unknown_variables():
            log.warning("set in the environment, and no setting", extra={"variable": variable})
        serve_until_stopped(settings, create)
    except DeepSimbadError as error:
        configure_logging("ERROR")  # the settings themselves may be what is wrong
        log.error("cannot start", extra={"code": error.code, "why": error.message})
        raise


@click.command()
@data_dir_option
def init(data_dir: Path | None) -> None:
    """Make a data directory, for its owner alone; one that is there stays as it is."""
    folder = given_settings(data_dir=data_dir).data_dir
    Catalog.open(folder).close()
    click.echo(f"{folder} is a data directory", err=True)


@click.command()
@json_option
@data_dir_option
@_address_options
def settings(as_json: bool, data_dir: Path | None, host: str | None, port: int | None) -> None:
    """Print every setting with its value and where it comes from: flag, environment, file or default."""
    traced = traced_settings(data_dir=data_dir, host=host, port=port)
    for variable in unknown_variables():
        click.echo(f"deepsimbad: {variable} is set in the environment and is no setting", err=True)
    values: dict[str, Any] = traced.settings.model_dump(mode="json")
    if as_json:
        document = {
            name: {"value": value, "origin": traced.origins[name], "variable": variable_of(name)}
            for name, value in values.items()
        }
        write_json({"file": None if traced.file is None else str(traced.file), "settings": document})
        return
    table = Table("setting", "value", "from")
    for name, value in values.items():
        origin = traced.origins[name]
        place = str(traced.file) if origin == "file" else origin
        table.add_row(name, escape(shown(value)), escape(place))
    print_table(table)


def shown(value: Any) -> str:
    """A setting's value as it is written in the environment; `none` where there is none."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(f'"{item}"' for item in value) + "]"
    return str(value)
