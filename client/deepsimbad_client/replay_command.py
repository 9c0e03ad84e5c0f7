"""`deepsimbad-client replay`."""

from pathlib import Path

import click

from deepsimbad_client.client import Client
from deepsimbad_client.console import REMARKS, ReplayBar, as_json, show
from deepsimbad_client.options import at_once, domain_option, json_flag, reading, serving
from deepsimbad_client.replay import TOLERANCE_M
from deepsimbad_client.replay import replay as replay_recording
from deepsimbad_client.report import summarise, table, write_summary
from deepsimbad_client.sources import open_source


@click.command()
@click.argument("source")
@domain_option
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the results; absent: replays/DOMAIN-RECORDING.",
)
@click.option(
    "--tolerance",
    "tolerance_m",
    type=click.FloatRange(min=0),
    default=TOLERANCE_M,
    show_default=True,
    help="Metres that a right answer may be off.",
)
@click.option("--restart", is_flag=True, help="Throw away what an earlier replay left in the folder.")
@click.option("--plots/--no-plots", default=True, show_default=True)
@at_once
@reading
@json_flag
@serving
def replay(
    source: str,
    domain: str,
    out: Path | None,
    tolerance_m: float,
    restart: bool,
    plots: bool,
    concurrency: int,
    spacing_m: float,
    undistortion: Path | None,
    json_output: bool,
    server: str,
    api_key: str | None,
) -> None:
    """Localize every frame of a recording, score the answers.

    Writes steps.jsonl, summary.json and pictures; interrupted, the same command goes on where it stopped.
    """
    recording = open_source(source, spacing_m=spacing_m, undistortion=undistortion)
    folder = out or Path("replays") / f"{domain}-{recording.name}"
    with (
        Client(server, api_key) as client,
        ReplayBar(f"{recording.name} against {domain}", len(recording.frames)) as bar,
    ):
        done = replay_recording(
            client,
            recording,
            domain,
            folder,
            tolerance_m=tolerance_m,
            concurrency=concurrency,
            restart=restart,
            on_progress=bar,
        )
    summary = summarise(done)
    write_summary(summary, folder)
    if plots:
        from deepsimbad_client.plots import draw_all  # noqa: PLC0415 - matplotlib takes its time

        draw_all(done, folder)
    if json_output:
        click.echo(as_json(summary))
    else:
        show(table(summary))
    REMARKS.print(f"results in {folder}", soft_wrap=True)
