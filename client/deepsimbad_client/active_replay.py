"""Drive a recording as an active robot: ask where to look next, go there, look, and be scored against the truth."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from deepsimbad_client.episode_log import Episode, EpisodeLog, EpisodeStep, write_steps
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Domain
from deepsimbad_client.http.upload import CONCURRENCY, in_order
from deepsimbad_client.judge import TRUTH_WITHIN_M
from deepsimbad_client.map_route import MapRoute
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.replay import changed_map
from deepsimbad_client.stage import DEFAULT_PLANNER, Stage

EPISODES = 20
STEPS = 10
EPISODES_WITH_MASS = 10
"""Of so many the belief along the route is kept for pictures; of thousands it would fill the memory."""


@dataclass(frozen=True)
class ActiveReplay:
    """An active replay that has come to its end.

    Attributes:
        folder: Where its files are.
        planners: As they were asked for; the first is the one the others are compared with.
        episodes: For each planner, its episodes in order; the same numbers for all.
        route: The map's images.
        identity: What was replayed against what.
        seconds: How long this run took.
    """

    folder: Path
    planners: tuple[str, ...]
    episodes: dict[str, list[Episode]]
    route: MapRoute
    identity: dict[str, Any]
    seconds: float


class _Stopped(Exception):  # noqa: N818 - never leaves this module
    """The replay ends before this episode does."""


def active_replay(
    client: Client,
    recording: Recording,
    domain: str,
    folder: Path,
    *,
    planners: Sequence[str] = (DEFAULT_PLANNER,),
    episodes: int = EPISODES,
    steps: int = STEPS,
    concurrency: int = CONCURRENCY,
    seed: int = 0,
    restart: bool = False,
    on_progress: Callable[[Episode, int], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> ActiveReplay:
    """Drive episodes from random starts and compare what planners come to know.

    Every planner starts from the same places with the same session seeds. Each step takes the recorded frame nearest
    to the commanded place and tells the service the metres really moved. Interrupted at any moment, the same call goes
    on after the last episode written down; more planners and more episodes can be added to a folder later.

    Args:
        client: The client.
        recording: What there is to see, in travel order.
        domain: A domain with an active map.
        folder: Where `replay.json`, `episodes.jsonl` and `steps.jsonl` go.
        planners: Names the service knows (`nnql`, `random`, `constant:3`, ...); `default` is the one that ships.
        episodes: How many for each planner.
        steps: Moves in an episode.
        concurrency: Episodes under way at once.
        seed: Of the starts and the sessions.
        restart: Throw away what an earlier replay left in the folder.
        on_progress: Told of every episode, those of an earlier run first, and how many there are so far.
        clock: Seconds that never go backwards.

    Raises:
        ReplayError: No active map, one that changed meanwhile, a recording too short, or a folder of another replay.
        ApiError: The service refused, for example an unknown planner.
        TransportError: The service did not answer.
    """
    started = clock()
    stage = Stage.of(client, recording, domain)
    starts = [stage.start(steps, seed, episode) for episode in range(episodes)]
    planners = tuple(dict.fromkeys(planners))
    identity = _identity(recording, stage.domain, steps, seed)
    stopping = threading.Event()
    with EpisodeLog(folder, identity, restart=restart) as log:
        wanted = [(planner, episode) for episode in range(episodes) for planner in planners]
        n_done = 0
        for key in wanted:
            if key in log.done and on_progress is not None:
                n_done += 1
                on_progress(log.done[key], n_done)

        def work(key: tuple[str, int]) -> Episode:
            planner, number = key
            return _run(stage, planner, number, starts[number], steps, clock, stopping)

        todo = [key for key in wanted if key not in log.done]
        n_done = len(wanted) - len(todo)
        for _, episode in in_order(work, todo, concurrency, on_end=stopping.set):
            log.append(episode)
            n_done += 1
            if on_progress is not None:
                on_progress(episode, n_done)
        if client.domain(domain).map_version != stage.domain.map_version:
            raise changed_map(domain)
        by_planner = {name: [log.done[name, number] for number in range(episodes)] for name in planners}
    write_steps((each for name in planners for each in by_planner[name]), folder)
    identity |= {"planners": list(planners), "n_episodes": episodes}
    return ActiveReplay(folder, planners, by_planner, stage.judge.route, identity, clock() - started)


def _identity(recording: Recording, described: Domain, steps: int, seed: int) -> dict[str, Any]:
    return {
        "kind": "active",
        "domain": described.name,
        "map_version": described.map_version,
        "n_map_images": described.n_map_images,
        "recording": recording.name,
        "n_frames": len(recording.frames),
        "first_index": recording.frames[0].index,
        "last_index": recording.frames[-1].index,
        "steps": steps,
        "seed": seed,
        "truth_within_m": TRUTH_WITHIN_M,
    }


def _run(
    stage: Stage,
    planner: str,
    number: int,
    start: tuple[int, int],
    steps: int,
    clock: Callable[[], float],
    stopping: threading.Event,
) -> Episode:
    row, seed = start
    done: list[EpisodeStep] = []
    named = planner
    edges_m = (0.0, 0.0)
    with stage.session(planner, seed) as session:
        for seen, step in stage.play(session, row, steps, clock):
            if stopping.is_set():
                raise _Stopped
            done.append(step if number < EPISODES_WITH_MASS else replace(step, mass=()))
            edges = seen.answer.belief.histogram.edges_m
            edges_m = (edges[0], edges[-1])
            if seen.answer.next_best_view is not None:
                named = seen.answer.next_best_view.planner
    return Episode(planner, named, number, seed, edges_m, tuple(done))
