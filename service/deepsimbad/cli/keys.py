"""`deepsimbad keys`: making, listing and revoking API keys, beside a running service or without one."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import click
from rich.markup import escape
from rich.table import Table

from deepsimbad.cli.options import data_dir_option, given_settings, json_option
from deepsimbad.cli.terminal import print_table, report, write_json
from deepsimbad.errors import UnknownKeyError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_keys import ApiKey
from deepsimbad.store.layout import catalog_path
from deepsimbad.store.records import KeyRecord, KeyScope, now


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
def create(scope: str, name: str, expires_days: float | None, domains: tuple[str, ...], data_dir: Path | None) -> None:
    """Make a key and print it, alone, on standard output. It is shown this once: only a digest is kept."""
    lifetime = None if expires_days is None else timedelta(days=min(expires_days, timedelta.max.days))
    with Catalog.open(given_settings(data_dir=data_dir).data_dir) as catalog:
        is_first = not catalog.keys()
        record, key = catalog.create_key(KeyScope(scope), name, lifetime, domains or None)
    click.echo(key.text)
    until = "" if record.expires_at is None else f" until {record.expires_at}"
    where = f" of {', '.join(domains)}" if domains else ""
    click.echo(f"key {record.key_id} opens {scope}{where}{until}; keep it now, it cannot be shown again", err=True)
    if is_first:
        click.echo("it is the first: from now on every call under /v1 asks for a key", err=True)


@keys.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON list.")
@data_dir_option
def list_(as_json: bool, data_dir: Path | None) -> None:
    """List every key that was ever created, without the secrets."""
    folder = given_settings(data_dir=data_dir).data_dir
    records = []
    if catalog_path(folder).is_file():  # a question must not make the folder it asks about
        with Catalog.open(folder) as catalog:
            records = catalog.keys()
    else:
        click.echo(f"nothing was ever kept in {folder}: if keys were, name their folder with --data-dir", err=True)
    if as_json:
        write_json([_described(record) for record in records])
        return
    table = Table("key", "name", "scope", "domains", "state", "created", "expires", "revoked")
    for record in records:
        cells = {**_described(record), "domains": "all" if record.domains is None else ", ".join(record.domains)}
        table.add_row(*("-" if value is None else escape(value) for value in cells.values()))
    print_table(table)


@keys.command()
@click.argument("key_id")
@json_option
@data_dir_option
def revoke(key_id: str, as_json: bool, data_dir: Path | None) -> None:
    """Let a key open nothing any more. KEY_ID is what `keys list` shows; a whole key, a leaked one say, does too."""
    whole = ApiKey.parse(key_id)
    folder = given_settings(data_dir=data_dir).data_dir
    if not catalog_path(folder).is_file():
        raise UnknownKeyError(f"there are no keys in {folder}: name their folder with --data-dir")
    with Catalog.open(folder) as catalog:
        record = catalog.revoke_key(key_id if whole is None else whole.key_id)
        records = catalog.keys()
    report(as_json, _described(record), f"key {record.key_id} is revoked")
    if not any(other.is_usable(now()) for other in records):
        click.echo("no usable key is left: the service stays closed until one is created", err=True)


def _described(record: KeyRecord) -> dict[str, Any]:
    state = "usable" if record.is_usable(now()) else "expired"
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
