"""`deepsimbad-client replay`."""

from pathlib import Path

import click

from deepsimbad_client.active_replay import EPISODES, STEPS
from deepsimbad_client.active_replay_command import replay_actively
from deepsimbad_client.commands import at_once, domain_option, json_flag, reading, serving
from deepsimbad_client.console import REMARKS, ReplayBar, as_json, show
from deepsimbad_client.http.client import Client
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay import TOLERANCE_M
from deepsimbad_client.replay import replay as replay_recording
from deepsimbad_client.report import summarise, table, write_summary


@click.command()
@click.argument("source")
@domain_option
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the results; absent: replays/DOMAIN-RECORDING, with -active behind it for an active replay.",
)
@click.option(
    "--tolerance",
    "tolerance_m",
    type=click.FloatRange(min=0),
    help=f"Metres that a right answer of a passive replay may be off.  [default: {TOLERANCE_M:g}]",
)
@click.option(
    "--planner",
    "planners",
    multiple=True,
    metavar="NAME",
    help="Drive actively, NAME choosing the moves: default, nnql, random, constant:3, ...; repeat it to compare "
    "planners from the same starts.",
)
@click.option("--episodes", type=click.IntRange(min=1), help=f"Of every planner.  [default: {EPISODES}]")
@click.option("--steps", type=click.IntRange(min=1), help=f"Moves in an episode.  [default: {STEPS}]")
@click.option("--seed", type=click.IntRange(min=0), help="Of the starts and the sessions.  [default: 0]")
@click.option("--restart", is_flag=True, help="Throw away what an earlier replay left in the folder.")
@click.option("--plots/--no-plots", default=True, show_default=True)
@at_once
@reading
@json_flag
@serving
def replay(
    client: Client,
    source: str,
    domain: str,
    out: Path | None,
    tolerance_m: float | None,
    planners: tuple[str, ...],
    episodes: int | None,
    steps: int | None,
    seed: int | None,
    restart: bool,
    plots: bool,
    concurrency: int,
    spacing_m: float,
    undistortion: Path | None,
    json_output: bool,
) -> None:
    """Localize every frame of a recording, score the answers; with --planner, drive along it as an active robot.

    An active robot starts at a random frame, looks, asks for the next-best view, goes to the recorded frame nearest to
    it, and looks again. Writes steps.jsonl, summary.json and pictures; interrupted, the same command goes on where it
    stopped.
    """
    given = {"--episodes": episodes, "--steps": steps, "--seed": seed}
    if not planners and any(value is not None for value in given.values()):
        raise click.UsageError(f"{', '.join(given)} belong to an active replay: give --planner too")
    if planners and tolerance_m is not None:
        raise click.UsageError("--tolerance belongs to a passive replay: an active one ranks the nearest map image")
    recording = open_source(source, spacing_m=spacing_m, undistortion=undistortion)
    folder = out or Path("replays") / f"{domain}-{recording.name}{'-active' if planners else ''}"
    if planners:
        replay_actively(
            client,
            recording,
            domain,
            folder,
            planners=planners,
            episodes=EPISODES if episodes is None else episodes,
            steps=STEPS if steps is None else steps,
            seed=seed or 0,
            concurrency=concurrency,
            restart=restart,
            plots=plots,
            json_output=json_output,
        )
        return
    with ReplayBar(f"{recording.name} against {domain}", len(recording.frames)) as bar:
        done = replay_recording(
            client,
            recording,
            domain,
            folder,
            tolerance_m=TOLERANCE_M if tolerance_m is None else tolerance_m,
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
