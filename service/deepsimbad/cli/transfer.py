"""`deepsimbad export` and `import`: one sealed map moved between servers."""

from dataclasses import asdict
from pathlib import Path

import click

from deepsimbad.cli.options import data_dir_option, existing_data_dir, given_settings
from deepsimbad.cli.terminal import write_json
from deepsimbad.jobs.import_map import import_map
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.exported_map import export_map


@click.command()
@click.argument("domain")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--version", type=int, help="Which version.  [default: the active one]")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@data_dir_option
def export(domain: str, file: Path, version: int | None, as_json: bool, data_dir: Path | None) -> None:
    """Copy a sealed map of DOMAIN into FILE, byte for byte, checked against its digest."""
    with Catalog.open(existing_data_dir(given_settings(data_dir=data_dir).data_dir)) as catalog:
        report = export_map(catalog, domain, version, file)
    if as_json:
        write_json(asdict(report))
        return
    click.echo(
        f"map {report.map_version} of {domain} is in {file}: {report.bytes} bytes, sha256 {report.sha256}", err=True
    )


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--domain", help="What its domain is called here.  [default: as where it was made]")
@click.option("--sha256", metavar="HEX", help="Digest that the file must have.")
@click.option("--activate/--no-activate", default=True, show_default=True, help="Whether it shall serve at once.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@data_dir_option
def import_(
    file: Path, domain: str | None, sha256: str | None, activate: bool, as_json: bool, data_dir: Path | None
) -> None:
    """Take over an exported map as its domain's next version; a running service serves it within a second or so.

    The domain is made where it is absent; else it must have the same evaluator, actions and kind of route.
    """
    with Catalog.open(given_settings(data_dir=data_dir).data_dir) as catalog:
        report = import_map(catalog, file, domain, sha256, activate=activate)
    if as_json:
        write_json(asdict(report))
        return
    state = "active" if report.active else "sealed"
    click.echo(f"map {report.map_version} of {report.domain} is {state}: {report.bytes} bytes", err=True)
