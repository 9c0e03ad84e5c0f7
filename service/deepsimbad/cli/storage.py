"""`deepsimbad backup`, `restore`, `export`, `import` and `check`: data directories and maps as files."""

import signal
import sys
from dataclasses import asdict
from pathlib import Path

import click

from deepsimbad import release
from deepsimbad.cli.terminal import (
    data_dir_option,
    existing_data_dir,
    given_settings,
    json_option,
    map_store_option,
    open_given_catalog,
    progress_bar,
    report,
    write_json,
)
from deepsimbad.errors import UnavailableError
from deepsimbad.jobs.versions import import_map
from deepsimbad.store.backup import Inspection, back_up, inspect
from deepsimbad.store.backup import restore as restore_backup
from deepsimbad.store.layout import catalog_path, domains_folder
from deepsimbad.store.map_file import export_map
from deepsimbad.store.shared_catalog import inspect_objects

_file_argument = click.argument("file", type=click.Path(path_type=Path))


@click.command()
@_file_argument
@json_option
@data_dir_option
def backup(file: Path, as_json: bool) -> None:
    """Copy everything (domains, maps, traverses, sessions, keys) into FILE, beside a running service or not."""
    source = existing_data_dir()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # a timer's, or the system stops: what is half written goes
    with progress_bar({"copy": 1.0}, "backup") as progress:
        progress.stage("copy")
        backup_report = back_up(source, file, release(), progress.update)
    counts = f"{backup_report.n_domains} domains, {backup_report.n_maps} maps, {backup_report.n_traverses} traverses"
    report(
        as_json, asdict(backup_report), f"{file}: {counts}, {backup_report.bytes} bytes, sha256 {backup_report.sha256}"
    )


@click.command()
@_file_argument
@json_option
@data_dir_option
def restore(file: Path, as_json: bool) -> None:
    """Make a data directory of the backup FILE. It must be absent or empty, and no service may run on it."""
    target = given_settings().data_dir
    with progress_bar({"unpack": 1.0}, "restore") as progress:
        progress.stage("unpack")
        restore_report = restore_backup(file, target, progress.update)
    counts = f"{restore_report.n_files} files, {restore_report.bytes} bytes"
    line = f"{restore_report.data_dir}: {counts}, as of {restore_report.created_at}"
    report(as_json, asdict(restore_report), line)


@click.command()
@click.argument("domain")
@_file_argument
@click.option("--version", type=int, help="Which version.  [default: the active one]")
@json_option
@data_dir_option
def export(domain: str, file: Path, version: int | None, as_json: bool) -> None:
    """Copy a sealed map of DOMAIN into FILE, byte for byte, checked against its digest."""
    existing_data_dir()
    with open_given_catalog() as catalog:
        record = export_map(catalog, domain, version, file)
    n_bytes, digest = record.file_bytes, record.sha256
    document = {"domain": domain, "map_version": record.version, "file": str(file), "bytes": n_bytes, "sha256": digest}
    report(as_json, document, f"map {record.version} of {domain} is in {file}: {n_bytes} bytes, sha256 {digest}")


@click.command("import")
@_file_argument
@click.option("--domain", help="What its domain is called here.  [default: as where it was made]")
@click.option("--sha256", metavar="HEX", help="Digest that the file must have.")
@click.option("--activate/--no-activate", default=True, show_default=True, help="Whether it shall serve at once.")
@json_option
@map_store_option
@data_dir_option
def import_(file: Path, domain: str | None, sha256: str | None, activate: bool, as_json: bool) -> None:
    """Take over an exported map as its domain's next version; a running service serves it within a second or so.

    The domain is made where it is absent; else it must have the same evaluator, actions and kind of route.
    """
    with open_given_catalog() as catalog:
        import_report = import_map(catalog, file, domain, sha256, activate=activate)
    state = "active" if import_report.active else "sealed"
    line = f"map {import_report.map_version} of {import_report.domain} is {state}: {import_report.bytes} bytes"
    report(as_json, asdict(import_report), line)


@click.command()
@click.option("--objects", is_flag=True, help="Read the maps that the map store has too, all of them.")
@json_option
@data_dir_option
@click.pass_context
def check(context: click.Context, objects: bool, as_json: bool) -> None:
    """Verify every file, beside a running service or without one: one line a problem, exit code 1 if one is damaged.

    Nothing is changed.
    """
    folder = given_settings().data_dir
    if not catalog_path(folder).exists() and not domains_folder(folder).exists():
        raise UnavailableError(f"there is nothing to check in {folder}: name its folder with --data-dir")
    with progress_bar({"read": 1.0, "objects": 1.0 * objects}, "check") as progress:
        progress.stage("read")
        inspection = inspect(folder, progress.update)
        if objects:
            progress.stage("objects")
            store_inspection = inspect_objects(folder, progress.update)
            inspection = Inspection(
                inspection.n_files + store_inspection.n_files, inspection.damaged + store_inspection.damaged
            )
    if as_json:
        write_json({"ok": not inspection.damaged, **asdict(inspection)})
    else:
        for finding in inspection.damaged:
            click.echo(f"damaged: {finding.file}: {finding.what}")
        click.echo(f"{inspection.n_files} files read, {len(inspection.damaged)} problems", err=True)
    if inspection.damaged:
        context.exit(1)
