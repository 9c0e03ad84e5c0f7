"""The second half of `make demo`: an active robot, told step by step, and compared with blind moves."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Table

from deepsimbad_client.active_plots import draw_active
from deepsimbad_client.active_replay import active_replay
from deepsimbad_client.active_report import localized_table, planner_table, summarise_active
from deepsimbad_client.console import EpisodeBar
from deepsimbad_client.http.client import Client
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.report import write_summary
from deepsimbad_client.stage import DEFAULT_PLANNER, Stage
from deepsimbad_client.story import told

STEPS = 10
EPISODES = 10
PLANNERS = (DEFAULT_PLANNER, "random", "constant:10")
_SEED = 0


def steps_that_fit(recording: Recording, longest_m: float) -> int:
    """Moves of the longest kind that leave half of a recording to start from, at most the usual number."""
    length_m = recording.frames[-1].position_m - recording.frames[0].position_m
    return min(STEPS, int(length_m / 2 / longest_m))


def tell_episode(stage: Stage, steps: int, say: Callable[[str], None]) -> None:
    """Drive one episode under the planner that ships and say at every view what the robot sees, believes and asks."""
    row, seed = stage.start(steps, _SEED, 0)
    with stage.session(DEFAULT_PLANNER, seed) as session:
        for _, step in stage.play(session, row, steps):
            say(f"   {told(step)}")


def compare_planners(
    client: Client, live: Recording, domain: str, folder: Path, steps: int
) -> tuple[list[Table], list[Path], dict[str, Any]]:
    """Drive the same starts under every planner; returns the tables, the pictures and the figures."""
    with EpisodeBar("driving actively", len(PLANNERS) * EPISODES) as bar:
        done = active_replay(
            client,
            live,
            domain,
            folder,
            planners=PLANNERS,
            episodes=EPISODES,
            steps=steps,
            seed=_SEED,
            restart=True,
            on_progress=bar,
        )
    summary = summarise_active(done)
    write_summary(summary, folder)
    return [planner_table(summary), localized_table(summary)], draw_active(done, summary, folder), summary
