"""What `deepsimbad-client replay` does when it is given a planner."""

from collections.abc import Sequence
from pathlib import Path

import click

from deepsimbad_client.active_replay import active_replay
from deepsimbad_client.active_report import distance_table, localized_table, planner_table, summarise_active
from deepsimbad_client.console import REMARKS, EpisodeBar, as_json, show
from deepsimbad_client.http.client import Client
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.report import write_summary


def replay_actively(
    client: Client,
    recording: Recording,
    domain: str,
    folder: Path,
    *,
    planners: Sequence[str],
    episodes: int,
    steps: int,
    seed: int,
    concurrency: int,
    restart: bool,
    plots: bool,
    json_output: bool,
) -> None:
    """Drive episodes, write summary.json, steps.jsonl and pictures, and print the tables (or one JSON document)."""
    n_planners = len(dict.fromkeys(planners))
    with EpisodeBar(f"{recording.name} against {domain}", n_planners * episodes) as bar:
        done = active_replay(
            client,
            recording,
            domain,
            folder,
            planners=planners,
            episodes=episodes,
            steps=steps,
            seed=seed,
            concurrency=concurrency,
            restart=restart,
            on_progress=bar,
        )
    summary = summarise_active(done)
    write_summary(summary, folder)
    if plots:
        from deepsimbad_client.active_plots import draw_active  # noqa: PLC0415 - matplotlib takes its time

        draw_active(done, summary, folder)
    if json_output:
        click.echo(as_json(summary))
    else:
        for table in (planner_table(summary), localized_table(summary), distance_table(summary)):
            show(table)
    REMARKS.print(f"results in {folder}", soft_wrap=True)
