"""`deepsimbad backup` and `restore`: a whole data directory in one file, and back."""

from dataclasses import asdict
from pathlib import Path

import click

from deepsimbad.cli.options import data_dir_option, existing_data_dir, given_settings
from deepsimbad.cli.terminal import progress_bar, write_json
from deepsimbad.release import release
from deepsimbad.store.backup import back_up
from deepsimbad.store.restore import restore as restore_backup


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@data_dir_option
def backup(file: Path, as_json: bool, data_dir: Path | None) -> None:
    """Copy everything (domains, maps, traverses, sessions, keys) into FILE, beside a running service or not."""
    source = existing_data_dir(given_settings(data_dir=data_dir).data_dir)
    with progress_bar({"copy": 1.0}, "backup") as progress:
        progress.stage("copy")
        report = back_up(source, file, release(), progress.update)
    if as_json:
        write_json(asdict(report))
        return
    click.echo(
        f"{file}: {report.n_domains} domains, {report.n_maps} maps, {report.n_traverses} traverses, "
        f"{report.bytes} bytes, sha256 {report.sha256}",
        err=True,
    )


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@data_dir_option
def restore(file: Path, as_json: bool, data_dir: Path | None) -> None:
    """Make a data directory of the backup FILE. It must be absent or empty, and no service may run on it."""
    target = given_settings(data_dir=data_dir).data_dir
    with progress_bar({"unpack": 1.0}, "restore") as progress:
        progress.stage("unpack")
        report = restore_backup(file, target, progress.update)
    if as_json:
        write_json(asdict(report))
        return
    click.echo(f"{report.data_dir}: {report.n_files} files, {report.bytes} bytes, as of {report.created_at}", err=True)
