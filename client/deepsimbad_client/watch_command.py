"""`deepsimbad-client watch`."""

from pathlib import Path

import click
from rich.console import Console

from deepsimbad_client.active_replay import STEPS
from deepsimbad_client.commands import reading, serving
from deepsimbad_client.http.client import Client
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.stage import DEFAULT_PLANNER, Stage
from deepsimbad_client.watch import watch_episode, watch_session


@click.command()
@click.argument("source", required=False)
@click.option("--domain", metavar="NAME", help="Where SOURCE is driven.")
@click.option("--session", "session_id", metavar="ID", help="Watch a session that another robot drives instead.")
@click.option("--planner", default=DEFAULT_PLANNER, show_default=True, metavar="NAME", help="Who chooses the moves.")
@click.option("--steps", type=click.IntRange(min=1), default=STEPS, show_default=True, help="Moves to make.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another start.")
@click.option(
    "--pause",
    "pause_s",
    type=click.FloatRange(min=0),
    default=1.0,
    show_default=True,
    help="Seconds between views, or between looks at --session.",
)
@reading
@serving
def watch(
    client: Client,
    source: str | None,
    domain: str | None,
    session_id: str | None,
    planner: str,
    steps: int,
    seed: int,
    pause_s: float,
    spacing_m: float,
    undistortion: Path | None,
) -> None:
    """Show one session live: what it believes along the route, its last move and the next.

    Drives SOURCE from a random start, or with --session looks on while another robot drives, until the session ends.
    """
    console = Console(highlight=False, markup=False)
    if session_id is not None:
        if source is not None or domain is not None:
            raise click.UsageError("--session names all there is to watch: leave SOURCE and --domain out")
        watch_session(client, session_id, console, every_s=max(pause_s, 0.05))
        return
    if source is None or domain is None:
        raise click.UsageError("give SOURCE and --domain, or --session")
    recording = open_source(source, spacing_m=spacing_m, undistortion=undistortion)
    stage = Stage.of(client, recording, domain)
    watch_episode(stage, console, planner=planner, steps=steps, seed=seed, pause_s=pause_s)
