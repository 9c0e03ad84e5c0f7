"""`deepsimbad-client maps`, `activate`, `rollback` and `download`."""

from pathlib import Path

import click

from deepsimbad_client.client import Client
from deepsimbad_client.console import DownloadBar, as_json, show
from deepsimbad_client.models import MapVersion
from deepsimbad_client.options import json_flag, serving
from deepsimbad_client.tables import gate_verdict, map_table


@click.command()
@click.argument("domain")
@json_flag
@serving
def maps(domain: str, json_output: bool, server: str, api_key: str | None) -> None:
    """List the versions of a domain's map: which serves, and how each compared with the one before it."""
    with Client(server, api_key) as client:
        found = client.admin.maps(domain)
    if json_output:
        click.echo(as_json([version.model_dump(mode="json") for version in found]))
        return
    show(map_table(domain, found))
    for version in found:
        why = gate_verdict(version.check)
        if why:
            click.echo(f"map {version.version}: {why}")


@click.command()
@click.argument("domain")
@click.argument("version", type=click.IntRange(min=1))
@click.option("--expected", type=click.IntRange(min=1), metavar="N", help="Only if version N serves now.")
@json_flag
@serving
def activate(
    domain: str, version: int, expected: int | None, json_output: bool, server: str, api_key: str | None
) -> None:
    """Let another version of a domain's map serve, forward or back.

    Sessions keep the version they began on.
    """
    with Client(server, api_key) as client:
        _show_active(domain, client.admin.activate(domain, version, expected=expected), json_output)


@click.command()
@click.argument("domain")
@json_flag
@serving
def rollback(domain: str, json_output: bool, server: str, api_key: str | None) -> None:
    """Let the version serve again that served before the present one.

    Once more, and the present one is back.
    """
    with Client(server, api_key) as client:
        _show_active(domain, client.admin.rollback(domain), json_output)


@click.command()
@click.argument("domain")
@click.argument("version", type=click.IntRange(min=1))
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--force", is_flag=True, help="Replace FILE where it is there already.")
@json_flag
@serving
def download(
    domain: str, version: int, file: Path, force: bool, json_output: bool, server: str, api_key: str | None
) -> None:
    """Fetch the sealed file of a version, checked against its digest.

    Interrupted, the same command goes on where it stopped. `deepsimbad import` takes the file in elsewhere.
    """
    if file.exists() and not force:
        raise click.UsageError(f"{file} is there already: give --force to replace it")
    with Client(server, api_key) as client, DownloadBar(f"map {version} of {domain}") as bar:
        there = client.admin.download_map(domain, version, file, on_progress=bar)
    if json_output:
        click.echo(as_json({"path": str(there.path), "sha256": there.sha256, "file_bytes": there.file_bytes}))
    else:
        click.echo(f"{there.path}: {there.file_bytes} bytes, sha256 {there.sha256}")


def _show_active(domain: str, version: MapVersion, json_output: bool) -> None:
    if json_output:
        click.echo(as_json(version.model_dump(mode="json")))
    else:
        click.echo(f"{domain} serves map {version.version}")
