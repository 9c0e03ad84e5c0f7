"""`deepsimbad settings`: every setting as a command would take it, and where it comes from."""

from pathlib import Path
from typing import Any

import click
from rich.markup import escape
from rich.table import Table

from deepsimbad.cli.options import address_options, data_dir_option, traced_settings
from deepsimbad.cli.terminal import console, write_json
from deepsimbad.settings_sources import Origin, unknown_variables, variable_of


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@data_dir_option
@address_options
def settings(as_json: bool, data_dir: Path | None, host: str | None, port: int | None) -> None:
    """Print every setting with its value and where it comes from: flag, environment, file or default."""
    traced = traced_settings(data_dir=data_dir, host=host, port=port)
    for variable in unknown_variables():
        click.echo(f"deepsimbad: {variable} is set in the environment and is no setting", err=True)
    values: dict[str, Any] = traced.settings.model_dump(mode="json")
    if as_json:
        document = {
            name: {"value": value, "origin": traced.origins[name].value, "variable": variable_of(name)}
            for name, value in values.items()
        }
        write_json({"file": None if traced.file is None else str(traced.file), "settings": document})
        return
    table = Table("setting", "value", "from")
    for name, value in values.items():
        origin = traced.origins[name]
        place = str(traced.file) if origin is Origin.FILE else origin.value
        table.add_row(name, escape(shown(value)), escape(place))
    console().print(table)


def shown(value: Any) -> str:
    """A setting's value as it is written in the environment; `none` where there is none."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(f'"{each}"' for each in value) + "]"
    return str(value)
