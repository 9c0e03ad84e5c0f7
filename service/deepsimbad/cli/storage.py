"""`deepsimbad backup`, `restore`, `export`, `import` and `check`: data directories and maps as files."""

from dataclasses import asdict
from pathlib import Path

import click

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
from deepsimbad.release import release
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
    with progress_bar({"copy": 1.0}, "backup") as progress:
        progress.stage("copy")
        backed_up = back_up(source, file, release(), progress.update)
    counts = f"{backed_up.n_domains} domains, {backed_up.n_maps} maps, {backed_up.n_traverses} traverses"
    report(as_json, asdict(backed_up), f"{file}: {counts}, {backed_up.bytes} bytes, sha256 {backed_up.sha256}")


@click.command()
@_file_argument
@json_option
@data_dir_option
def restore(file: Path, as_json: bool) -> None:
    """Make a data directory of the backup FILE. It must be absent or empty, and no service may run on it."""
    target = given_settings().data_dir
    with progress_bar({"unpack": 1.0}, "restore") as progress:
        progress.stage("unpack")
        restored = restore_backup(file, target, progress.update)
    line = f"{restored.data_dir}: {restored.n_files} files, {restored.bytes} bytes, as of {restored.created_at}"
    report(as_json, asdict(restored), line)


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
        exported = export_map(catalog, domain, version, file)
    n_bytes, digest = exported.file_bytes, exported.sha256
    document = {
        "domain": domain,
        "map_version": exported.version,
        "file": str(file),
        "bytes": n_bytes,
        "sha256": digest,
    }
    report(as_json, document, f"map {exported.version} of {domain} is in {file}: {n_bytes} bytes, sha256 {digest}")


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
        imported = import_map(catalog, file, domain, sha256, activate=activate)
    state = "active" if imported.active else "sealed"
    line = f"map {imported.map_version} of {imported.domain} is {state}: {imported.bytes} bytes"
    report(as_json, asdict(imported), line)


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
        seen = inspect(folder, progress.update)
        if objects:
            progress.stage("objects")
            in_store = inspect_objects(folder, progress.update)
            seen = Inspection(seen.n_files + in_store.n_files, seen.damaged + in_store.damaged)
    if as_json:
        write_json({"ok": not seen.damaged, **asdict(seen)})
    else:
        for finding in seen.damaged:
            click.echo(f"damaged: {finding.file}: {finding.what}")
        click.echo(f"{seen.n_files} files read, {len(seen.damaged)} problems", err=True)
    if seen.damaged:
        context.exit(1)
