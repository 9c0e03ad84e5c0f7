"""`make demo`: a campus is rendered in three seasons, mapped, and driven again against a live service.

The paper's triplet WI-SP-SU: the map is of spring and knows winter too, the robot comes in summer, which nobody has
seen. First the whole drive is one session, then an active robot chooses where to look next. Everything goes through
the service's HTTP interface, as a robot's would.
"""

import signal
import sys
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from deepsimbad_campus.season import CampusError
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.commands.console import EpisodeBar, FrameBar, JobBar, ReplayBar, UploadBar
from deepsimbad_client.errors import DeepSimbadClientError
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay import DEFAULT_PLANNER
from deepsimbad_client.replay.active import Stage, active_replay
from deepsimbad_client.replay.passive import Replay, replay
from deepsimbad_client.replay.plots import draw_active, draw_passive
from deepsimbad_client.replay.report import active_tables, planner_label, summarise, summarise_active, write_summary
from deepsimbad_client.replay.watch import describe_step

DOMAIN = "campus"
SEASONS = ("winter", "spring", "summer")
LANDMARK_SEASON, MAP_SEASON, LIVE_SEASON = SEASONS
# The one that ships comes last: it stays active.
RELEVANCES = ("brute_force", "bag_of_landmarks", "simbad", "rrf", "standardised", "composed")
STEPS = 10
EPISODES = 10
PLANNERS = (DEFAULT_PLANNER, "random", "constant:10")
_N_LANDMARKS = 250
_TRAINING_EPISODES = 2000
_SEED = 0

_say = Console(highlight=False, soft_wrap=True).print


@click.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path), default=Path("demo-output"))
@click.option("--frames", type=click.IntRange(min=30), default=300, show_default=True, help="Of every season.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another campus.")
def demo(folder: Path, frames: int, seed: int) -> None:
    """Render a campus, map it, and find a drive of another season on it."""
    root = folder / "campus"
    _say(f"1. A campus in three seasons, {frames} frames each, in NCLT's layout: {root}")
    with FrameBar("rendering", len(SEASONS) * frames) as bar:
        sources = write_campus(root, SEASONS, frames, seed, on_progress=bar)
    drives = {season: open_source(source) for season, source in zip(SEASONS, sources, strict=True)}
    with LocalServer(folder / "data") as server, Client(server.url) as client:
        _say(f"2. The service runs at {server.url}; its log is {server.log_path}")
        _upload(client, drives)
        _say(
            f"4. {MAP_SEASON} becomes the map, {LANDMARK_SEASON} is known too, {LIVE_SEASON} is driven: "
            "every relevance by the live service"
        )
        n_landmarks = min(_N_LANDMARKS, len(drives[LANDMARK_SEASON].frames))
        table = Table("relevance", "ANR %", "R@1 %", "R@5 %", "median answer", caption="ANR: 0 is perfect, 50 chance")
        for column in table.columns[1:]:
            column.justify = "right"
        replays = {name: _drive(client, drives[LIVE_SEASON], name, n_landmarks, folder) for name in RELEVANCES}
        for name, (_, summary) in sorted(replays.items(), key=lambda item: item[1][1]["anr"]):
            table.add_row(
                f"{name} (default)" if name == RELEVANCES[-1] else name,
                f"{summary['anr']:.2f}",
                f"{summary['recall_at_1']:.1f}",
                f"{summary['recall_at_5']:.1f}",
                f"{summary['latency_ms']['median']:.1f} ms",
            )
        _say(table)
        _show_one(client, drives[LIVE_SEASON])
        shipped_replay, _ = replays[RELEVANCES[-1]]
        pictures = draw_passive(shipped_replay, shipped_replay.folder) + _drive_actively(
            client, drives[LIVE_SEASON], folder / "active"
        )
        _say("8. Pictures: " + ", ".join(str(picture) for picture in pictures))
        if sys.stdin.isatty() and sys.stdout.isatty():
            _say(f"\nThe service stays up: look at {server.url}/console (API: {server.url}/docs). Ctrl-C ends it.")
            server.wait()


def _upload(client: Client, drives: dict[str, Recording]) -> None:
    client.admin.put_domain(DOMAIN, {"kind": "feature_l2"})
    for season in (LANDMARK_SEASON, MAP_SEASON):
        with UploadBar(f"uploading {season}", len(drives[season].frames)) as bar:
            report = upload(client, drives[season], DOMAIN, season, on_progress=bar)
        left_out = ", ".join(f"{count} {reason}" for reason, count in report.left_out.items()) or "none"
        _say(
            f"3. {season}: {report.n_done} frames, {report.bytes_sent / 1e6:.1f} MB sent "
            f"(TIFFs stay at home), left out: {left_out}"
        )


def _drive(
    client: Client, live: Recording, relevance: str, n_landmarks: int, folder: Path
) -> tuple[Replay, dict[str, Any]]:
    """Map for one relevance and replay the live drive against it; returns the replay and its summary."""
    with JobBar(f"mapping for {relevance}") as bar:
        job = remap(
            client,
            DOMAIN,
            MAP_SEASON,
            landmark_traverse=LANDMARK_SEASON,
            n_landmarks=n_landmarks,
            relevance=relevance,
            training_episodes=_TRAINING_EPISODES if relevance == RELEVANCES[-1] else 0,
            on_progress=bar,
        )
    if relevance == RELEVANCES[-1]:
        season = job.second_season
        learnt = (
            "it learnt from both" if season["accepted"] else f"{LANDMARK_SEASON} taught it nothing: {season['why']}"
        )
        _say(f"   the map for {relevance}: {learnt}")
    with ReplayBar(f"driving by {relevance}", len(live.frames)) as bar:
        replayed = replay(client, live, DOMAIN, folder / "replays" / relevance, restart=True, on_progress=bar)
    summary = summarise(replayed)
    write_summary(summary, replayed.folder)
    return replayed, summary


def _drive_actively(client: Client, live: Recording, folder: Path) -> list[Path]:
    """One episode in words, then the default planner against blind moves; returns the pictures."""
    stage = Stage(client, live, DOMAIN)
    length_m = live.frames[-1].position_m - live.frames[0].position_m
    steps = min(STEPS, int(length_m / 2 / max(stage.scene.domain.actions_m)))  # half of the drive is left to start from
    if steps < 1:
        _say("6. The drive is too short for an active robot: give it more --frames")
        return []
    _say(f"6. An active robot, put down anywhere on the {LIVE_SEASON} drive, chooses its own next views:")
    row, seed = stage.start(steps, _SEED, 0)
    with stage.scene.session(DEFAULT_PLANNER, seed) as session:
        for _, step in stage.play(session, row, steps):
            _say(f"   {describe_step(step)}")
    _say(f"7. The same from {EPISODES} random starts, against blind moves:")
    with EpisodeBar("driving actively", len(PLANNERS) * EPISODES) as bar:
        active = active_replay(
            client,
            live,
            DOMAIN,
            folder,
            planners=PLANNERS,
            episodes=EPISODES,
            steps=steps,
            seed=_SEED,
            restart=True,
            on_progress=bar,
        )
    summary = summarise_active(active)
    write_summary(summary, folder)
    for table in active_tables(summary)[:2]:
        _say(table)
    _say(f"   {_verdict(summary)}")
    return draw_active(active, summary, folder)


def _verdict(summary: dict[str, Any]) -> str:
    """Words for the planner that did best, the default or another, and for how sure so few episodes make it."""
    anr = {name: value for name, value in summary["anr"].items() if value is not None}
    if not anr:
        return "No episode could be scored."
    default, best = PLANNERS[0], min(anr, key=lambda name: anr[name])
    intervals = {name: against["interval_95"] for name, against in summary["against"].items()}
    sure_names = [name for name, ends in intervals.items() if ends is not None and not ends[0] <= 0 <= ends[1]]
    winner = f"Lowest ANR: {planner_label(best, summary['planner_named'][best])}, {anr[best]:.2f} %."
    if best == default:
        return f"{winner} By these {EPISODES} starts that is more than chance over {', '.join(sure_names) or 'none'}."
    certainty = (
        "and that is more than chance" if best in sure_names else f"which {EPISODES} starts cannot tell from chance"
    )
    return f"{winner} The default did not win here, {certainty}."


def _show_one(client: Client, live: Recording) -> None:
    frame = live.frames[len(live.frames) // 2]
    domain = client.domain(DOMAIN)
    image = live.image(frame, domain.input_size)
    belief = client.localize(DOMAIN, image.body, content_type=image.content_type).belief
    low, high = belief.credible_95_m
    _say(
        f"5. One live image, {frame.name}: most likely at {belief.mode_m:.1f} m of {domain.route_length_m:.0f} m, "
        f"95 % within {low:.0f} .. {high:.0f} m, {belief.entropy_bits:.1f} bits of doubt; "
        f"it was driven at {frame.position_m:.1f} m of its own drive"
    )


def main() -> None:
    """Run the demonstration; when it is terminated, its service ends with it."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        demo()
    except (DeepSimbadClientError, CampusError) as error:
        sys.exit(f"{error.code}: {error}")


if __name__ == "__main__":
    main()
