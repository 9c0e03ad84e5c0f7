"""`deepsimbad serve`, and what a service needs beside it or before it: data directory, settings, keys."""

import gc
import logging
from datetime import timedelta
from typing import Any

import click
from rich.markup import escape
from rich.table import Table

from deepsimbad.cli.terminal import (
    Command,
    data_dir_option,
    given_settings,
    json_list_option,
    json_option,
    map_store_option,
    open_given_catalog,
    print_table,
    report,
    traced_settings,
    write_json,
)
from deepsimbad.errors import DeepSimbadError, UnknownKeyError
from deepsimbad.settings import unknown_variables, variable_of
from deepsimbad.store.catalog import ApiKey, Catalog
from deepsimbad.store.layout import catalog_path
from deepsimbad.store.records import KeyRecord, KeyScope, current_moment

log = logging.getLogger(__name__)


def address_options(command: Command) -> Command:
    """The options of where a command that serves listens."""
    host = click.option("--host", help="Address to listen on.  [default: $DEEPSIMBAD_HOST, else 127.0.0.1]")
    port = click.option(
        "--port", type=int, help="Port to listen on; 0 takes a free one.  [default: $DEEPSIMBAD_PORT, else 8000]"
    )
    return host(port(command))


@click.command()
@data_dir_option
@map_store_option
@address_options
@click.option("--create", is_flag=True, help="Make the data directory if it is not there.")
def serve(host: str | None, port: int | None, create: bool) -> None:
    """Serve the domains over HTTP until interrupted. Ready when /readyz answers 200."""
    gc.disable()  # imports leave little behind, and looking for it, now and later, would be an eighth of a start
    from deepsimbad.api.server import configure_logging  # noqa: PLC0415 - other commands need no server
    from deepsimbad.api.server import serve as serve_until_stopped  # noqa: PLC0415

    gc.freeze()
    gc.enable()
    try:
        settings = given_settings(host=host, port=port)
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
@map_store_option
def init() -> None:
    """Make a data directory, for its owner alone; one that is there stays as it is.

    With --map-store it follows that from then on, and publishes the domains that it has.
    """
    open_given_catalog().close()
    folder = given_settings().data_dir
    click.echo(f"{folder} is a data directory", err=True)


@click.command()
@json_option
@data_dir_option
@address_options
def settings(as_json: bool, host: str | None, port: int | None) -> None:
    """Print every setting with its value and where it comes from: flag, environment, file or default."""
    traced = traced_settings(host=host, port=port)
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
        table.add_row(name, escape(setting_text(value)), escape(str(traced.file) if origin == "file" else origin))
    print_table(table)


def setting_text(value: Any) -> str:
    """A setting's value as it is written in the environment; `none` where there is none."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(f'"{item}"' for item in value) + "]"
    return str(value)


@click.group()
def keys() -> None:
    """API keys. While none was ever created the service runs open; a running one heeds changes within a second."""


@keys.command()
@click.option(
    "--scope",
    type=click.Choice([scope.value for scope in KeyScope]),
    required=True,
    help="What it opens: `localize` is for robots, `admin` for everything.",
)
@click.option("--name", default="", help="What to call it, for `keys list`.")
@click.option("--expires-days", type=click.FloatRange(min=0, min_open=True), help="Days it lives.  [default: for ever]")
@click.option(
    "--domain",
    "domains",
    multiple=True,
    help="What it opens, of scope `localize`; several are allowed.  [default: all]",
)
@data_dir_option
def create(scope: str, name: str, expires_days: float | None, domains: tuple[str, ...]) -> None:
    """Make a key and print it, alone, on standard output. It is shown this once: only a digest is kept."""
    lifetime = None if expires_days is None else timedelta(days=min(expires_days, timedelta.max.days))
    with Catalog.open(given_settings().data_dir) as catalog:
        is_first = not catalog.keys()
        record, key = catalog.create_key(KeyScope(scope), name, lifetime, domains or None)
    click.echo(key.text)
    expiry = "" if record.expires_at is None else f" until {record.expires_at}"
    scope_domains = f" of {', '.join(domains)}" if domains else ""
    click.echo(
        f"key {record.key_id} opens {scope}{scope_domains}{expiry}; keep it now, it cannot be shown again", err=True
    )
    if is_first:
        click.echo("it is the first: from now on every call under /v1 asks for a key", err=True)


@keys.command("list")
@json_list_option
@data_dir_option
def list_(as_json: bool) -> None:
    """List every key that was ever created, without the secrets."""
    folder = given_settings().data_dir
    records = []
    if catalog_path(folder).is_file():  # a question must not make the folder it asks about
        with Catalog.open(folder) as catalog:
            records = catalog.keys()
    else:
        click.echo(f"nothing was ever kept in {folder}: if keys were, name their folder with --data-dir", err=True)
    if as_json:
        write_json([_key_document(record) for record in records])
        return
    table = Table("key", "name", "scope", "domains", "state", "created", "expires", "revoked")
    for record in records:
        cells = {**_key_document(record), "domains": "all" if record.domains is None else ", ".join(record.domains)}
        table.add_row(*("-" if value is None else escape(value) for value in cells.values()))
    print_table(table)


@keys.command()
@click.argument("key_id")
@json_option
@data_dir_option
def revoke(key_id: str, as_json: bool) -> None:
    """Let a key open nothing any more. KEY_ID is what `keys list` shows; a whole key, a leaked one say, does too."""
    api_key = ApiKey.parse(key_id)
    folder = given_settings().data_dir
    if not catalog_path(folder).is_file():
        raise UnknownKeyError(f"there are no keys in {folder}: name their folder with --data-dir")
    with Catalog.open(folder) as catalog:
        record = catalog.revoke_key(key_id if api_key is None else api_key.key_id)
        records = catalog.keys()
    report(as_json, _key_document(record), f"key {record.key_id} is revoked")
    if not any(left_record.is_usable(current_moment()) for left_record in records):
        click.echo("no usable key is left: the service stays closed until one is created", err=True)


def _key_document(record: KeyRecord) -> dict[str, Any]:
    state = "usable" if record.is_usable(current_moment()) else "expired"
    return {
        "key_id": record.key_id,
        "name": record.name,
        "scope": record.scope.value,
        "domains": None if record.domains is None else list(record.domains),
        "state": state if record.revoked_at is None else "revoked",
        "created_at": record.created_at,
        "expires_at": record.expires_at,
        "revoked_at": record.revoked_at,
    }
