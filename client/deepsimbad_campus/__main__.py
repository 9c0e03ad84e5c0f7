"""`python -m deepsimbad_campus ROOT` renders a campus."""

import sys
from pathlib import Path

import click

from deepsimbad_campus.season import PAPER_DATES, CampusError
from deepsimbad_campus.writer import write_campus


@click.command("campus")
@click.argument("root", type=click.Path(file_okay=False, path_type=Path))
@click.option(
    "--seasons",
    default=",".join(PAPER_DATES),
    show_default=True,
    help="Comma-separated: winter, spring, summer, autumn or dates like 2012-05-11; one drive each.",
)
@click.option("--frames", default=300, show_default=True, type=click.IntRange(min=1), help="Pictures of every drive.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Equal seeds, equal bytes.")
@click.option(
    "--spacing-m", default=1.75, show_default=True, type=click.FloatRange(0.05, 20), help="Metres between pictures."
)
def campus_command(root: Path, seasons: str, frames: int, seed: int, spacing_m: float) -> None:
    """Render drives along one route in several seasons, written under ROOT in NCLT's layout.

    Then nclt:ROOT/2012-01-22 and so on are sources like any recording. Cut short, it goes on where it stopped; with
    more frames it adds to those that are there.
    """
    names = [name.strip() for name in seasons.split(",") if name.strip()]
    with click.progressbar(length=len(names) * frames, label="rendering", file=sys.stderr) as bar:
        try:
            sources = write_campus(root, names, frames, seed, spacing_m=spacing_m, on_progress=lambda *_: bar.update(1))
        except CampusError as error:
            raise click.ClickException(str(error)) from error
    for source in sources:
        click.echo(source)


if __name__ == "__main__":
    campus_command()
