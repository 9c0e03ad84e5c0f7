"""`deepsimbad check`: every file of the data directory read and verified."""

from dataclasses import asdict
from pathlib import Path

import click

from deepsimbad.cli.options import data_dir_option, given_settings
from deepsimbad.cli.terminal import progress_bar, write_json
from deepsimbad.errors import UnavailableError
from deepsimbad.store.inspection import inspect
from deepsimbad.store.layout import catalog_path, domains_folder

DAMAGE_FOUND = 1


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@data_dir_option
@click.pass_context
def check(context: click.Context, as_json: bool, data_dir: Path | None) -> None:
    """Verify every file, beside a running service or without one: one line a problem, exit code 1 if one is damaged.

    Nothing is changed. What a crash left over is named too, and is no damage: the next start of the service removes it.
    """
    folder = given_settings(data_dir=data_dir).data_dir
    if not catalog_path(folder).exists() and not domains_folder(folder).exists():
        raise UnavailableError(f"there is nothing to check in {folder}: name its folder with --data-dir")
    with progress_bar({"read": 1.0}, "check") as progress:
        progress.stage("read")
        found = inspect(folder, progress.update)
    if as_json:
        write_json({"ok": not found.damaged, **asdict(found)})
    else:
        for kind, findings in (("damaged", found.damaged), ("left over", found.left_over)):
            for finding in findings:
                click.echo(f"{kind}: {finding.file}: {finding.what}")
        click.echo(
            f"{found.n_files} files read, {len(found.damaged)} problems, {len(found.left_over)} left over", err=True
        )
    if found.damaged:
        context.exit(DAMAGE_FOUND)
