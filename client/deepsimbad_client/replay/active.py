"""Drive a recording as an active robot: ask where to look next, go there, look, and be scored against the truth."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from deepsimbad.core.metrics import rank_of_truth
from deepsimbad_client.errors import ReplayError
from deepsimbad_client.http.client import Client, Session
from deepsimbad_client.http.upload import CONCURRENCY, in_order
from deepsimbad_client.recordings import Recording
from deepsimbad_client.replay import (
    DEFAULT_PLANNER,
    MASS_DIGITS,
    Journal,
    Scene,
    Seen,
    Viewer,
    changed_map,
    write_lines,
)

EPISODES = 20
STEPS = 10
EPISODES_WITH_MASS = 10
"""Of so many the belief along the route is kept for pictures; of thousands it would fill the memory."""
TRUTH_WITHIN_M = 10.0  # A frame farther than this from every map image is off the map and has no right answer
_LONGEST_ACTION_M = 10.0


@dataclass(frozen=True)
class EpisodeStep:
    """One view of an episode, and how well the belief after it knows where the robot is; None: not known."""

    step: int  # 0 for the first view, then the number of moves made
    index: int  # the frame's place in the whole recording
    name: str
    position_m: float  # along the recording's own route
    x_m: float | None
    y_m: float | None
    commanded_m: float | None  # the move asked for; None before the first
    action_m: float  # metres really moved
    travelled_m: float  # since the episode's start, forward or backward
    forgot: bool  # the belief had no room left for the move and was set back to knowing nothing
    true_map_image: int | None  # the one nearest to the truth; None where the map does not hold the place
    true_route_m: float | None  # where that lies along the map's route
    rank: float | None  # map images that the belief places before it, ties half
    rank_percent: float | None  # the same in percent of the map's images
    mode_m: float  # the likeliest place along the map's route
    low_m: float  # 95 % of the belief lie from here
    high_m: float  # to here
    error_m: float | None  # from the truth to the likeliest place
    entropy_bits: float  # how much is open
    off_route: float | None  # probability that the robot is lost: off the route, or carried along it
    next_action_m: float | None  # the move asked for next
    latency_ms: float  # from posting the view to the answer
    confident: bool = False  # whether enough of the belief is within 5 m of the likeliest place
    mass: tuple[float, ...] = ()  # the belief in equal stretches of the map's route; of the first few episodes alone


@dataclass(frozen=True)
class Episode:
    """One episode from its start to its last move."""

    planner: str  # as it was asked for
    planner_named: str  # what the service calls it
    episode: int  # every planner's episode of a number starts from the same place
    seed: int  # of its session
    edges_m: tuple[float, float]  # where the first stretch of `EpisodeStep.mass` begins and the last ends
    steps: tuple[EpisodeStep, ...]


@dataclass(frozen=True)
class ActiveReplay:
    """An active replay that has come to its end."""

    folder: Path  # of its files
    planners: tuple[str, ...]  # as they were asked for; the first is the one the others are compared with
    episodes: dict[str, list[Episode]]  # for each planner, in order; the same numbers for all
    identity: dict[str, Any]  # what was replayed against what
    seconds: float  # how long this run took


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
    viewers: Sequence[Viewer] = (),
    on_progress: Callable[[Episode, int], None] | None = None,
) -> ActiveReplay:
    """Drive episodes from random starts and compare what planners come to know.

    Every planner starts from the same places with the same session seeds; each step takes the recorded frame nearest
    to the commanded place and tells the service the metres really moved. Of `planners` (names the service knows)
    `default` is the one that ships. `folder` takes `replay.json`, `episodes.jsonl` and `steps.jsonl`; interrupted at
    any moment, the same call goes on after the last episode written down, and more planners and episodes can be added
    later; `restart` throws away what is there. `concurrency` episodes are under way at once, and `on_progress` is told
    of every one, and how many there are; where there are `viewers`, one episode is under way at a time. Raises
    ReplayError, ApiError, TransportError.
    """
    started = time.perf_counter()
    concurrency = 1 if viewers else concurrency
    stage = Stage(client, recording, domain, viewers)
    starts = [stage.start(steps, seed, episode) for episode in range(episodes)]
    planners = tuple(dict.fromkeys(planners))
    identity = {"kind": "active", **stage.scene.identity, "steps": steps, "seed": seed}
    identity |= {"truth_within_m": TRUTH_WITHIN_M}
    with Journal(folder, "episodes.jsonl", identity, TypeAdapter(Episode), "episode", restart=restart) as journal:
        wanted = [(planner, episode) for episode in range(episodes) for planner in planners]
        done = {(episode.planner, episode.episode): episode for episode in journal.earlier}
        earlier = [key for key in wanted if key in done]

        def drive(key: tuple[str, int]) -> Episode:
            return stage.drive(*key, *starts[key[1]], steps)

        if on_progress is not None:
            for n_done, key in enumerate(earlier, 1):
                on_progress(done[key], n_done)
        todo = [key for key in wanted if key not in done]
        for n_done, (key, episode) in enumerate(in_order(drive, todo, concurrency), len(earlier) + 1):
            journal.append(asdict(episode))
            done[key] = episode
            if on_progress is not None:
                on_progress(episode, n_done)
        if client.domain(domain).map_version != stage.scene.domain.map_version:
            raise changed_map(domain)
    by_planner = {name: [done[name, number] for number in range(episodes)] for name in planners}
    lines = (
        {"planner": name, "episode": episode.episode, **asdict(step)}
        for name in planners
        for episode in by_planner[name]
        for step in episode.steps
    )
    write_lines(folder / "steps.jsonl", lines)
    identity |= {"planners": list(planners), "n_episodes": episodes}
    return ActiveReplay(folder, planners, by_planner, identity, time.perf_counter() - started)


class Stage:
    """A recording driven as an active robot drives: where it may start, where it comes to, what it sees."""

    def __init__(self, client: Client, recording: Recording, domain: str, viewers: Sequence[Viewer] = ()) -> None:
        self.scene = Scene.of(client, recording, domain, TRUTH_WITHIN_M, viewers)
        self.position_m = self.scene.position_m
        if (np.diff(self.position_m) < 0).any():
            raise ReplayError(f"the positions of {recording.name} go backwards: a robot cannot drive along it")

    def start(self, steps: int, seed: int, episode: int) -> tuple[int, int]:
        """Draw the row where an episode starts, uniform over those from which all its moves fit, and a session's seed.

        The draw depends on `seed` and `episode` alone, so every planner starts from the same places. Raises ReplayError
        (the recording is too short).
        """
        actions_m = self.scene.domain.actions_m or (_LONGEST_ACTION_M,)
        back_m, ahead_m = min(0.0, *actions_m), max(0.0, *actions_m)
        first = int(np.searchsorted(self.position_m, self.position_m[0] - steps * back_m))
        stop = int(np.searchsorted(self.position_m, self.position_m[-1] - steps * ahead_m, side="right"))
        if stop <= first:
            length_m = float(self.position_m[-1] - self.position_m[0])
            raise ReplayError(
                f"{steps} moves of up to {max(-back_m, ahead_m):g} m do not fit the {length_m:g} m of "
                f"{self.scene.recording.name}: ask for fewer steps"
            )
        rng = np.random.default_rng([seed, episode])
        return int(rng.integers(first, stop)), int(rng.integers(2**31))

    def nearest(self, here_m: float, commanded_m: float, broken: frozenset[int]) -> int:
        """The row recorded nearest to where a move leads, of those that are not broken; ReplayError where all are.

        Only frames farther that way, where there are any: a robot told to move does move, though the next frame may be
        farther than it was told, and does not look at the same picture twice.
        """
        usable = np.delete(np.arange(len(self.position_m)), sorted(broken))
        if not usable.size:
            raise ReplayError(f"none of the frames of {self.scene.recording.name} can be used")
        that_way = usable[(self.position_m[usable] - here_m) * commanded_m > 0]
        usable = that_way if that_way.size else usable
        return int(usable[np.abs(self.position_m[usable] - here_m - commanded_m).argmin()])

    def play(self, session: Session, row: int, steps: int) -> Iterator[tuple[Seen, EpisodeStep]]:
        """Drive one episode: look, ask for the next-best view, move there, look again; judge every view.

        Yields `steps` + 1 views, the first without a move; a frame that cannot be used is passed over for the nearest
        that can. Raises ReplayError (no frame can be used, or no next move is named), ApiError, TransportError.
        """
        broken: frozenset[int] = frozenset()
        here_m, travelled_m, commanded_m = float(self.position_m[row]), 0.0, None
        for step in range(steps + 1):
            while True:
                action_m = float(self.position_m[row]) - here_m
                view = self.scene.view(row)
                seen = (
                    view if isinstance(view, str) else self.scene.look(session, row, view, action_m if step else None)
                )
                if not isinstance(seen, str):
                    break
                broken |= {row}
                row = self.nearest(here_m, commanded_m or 0.0, broken)
            action_m = action_m if step else 0.0
            travelled_m += abs(action_m)
            moves = {"step": step, "commanded_m": commanded_m, "action_m": action_m, "travelled_m": travelled_m}
            yield seen, self._judged(row, seen, session, moves)
            if step == steps:
                return
            plan = seen.answer.next_best_view
            if plan is None:
                raise ReplayError(
                    f"the map of {session.domain} names no next-best view for this planner: remap with training "
                    "episodes"
                )
            here_m, commanded_m = float(self.position_m[row]), plan.action_m
            row = self.nearest(here_m, commanded_m, broken)

    def drive(self, planner: str, number: int, row: int, seed: int, steps: int) -> Episode:
        """One whole episode in a session of its own."""
        views: list[EpisodeStep] = []
        named, edges_m = planner, (0.0, 0.0)
        with self.scene.session(planner, seed) as session:
            for seen, step in self.play(session, row, steps):
                views.append(step if number < EPISODES_WITH_MASS else replace(step, mass=()))
                edges = seen.answer.belief.histogram.edges_m
                edges_m = (edges[0], edges[-1])
                if seen.answer.next_best_view is not None:
                    named = seen.answer.next_best_view.planner
        return Episode(planner, named, number, seed, edges_m, tuple(views))

    def _judged(self, row: int, seen: Seen, session: Session, moves: dict[str, Any]) -> EpisodeStep:
        """How well the belief after a view knows where the robot truly is."""
        scene, frame, route = self.scene, self.scene.recording.frames[row], self.scene.route
        true = scene.nearest_right(row)
        rank = None if true is None else rank_of_truth(session.belief_masses(), np.array([true]))
        belief, plan = seen.answer.belief, seen.answer.next_best_view
        mode = int(np.abs(route.position_m - belief.mode_m).argmin())
        return EpisodeStep(
            **moves,
            index=frame.index,
            name=frame.name,
            position_m=frame.position_m,
            x_m=frame.x_m,
            y_m=frame.y_m,
            forgot=seen.forgot,
            true_map_image=true,
            true_route_m=None if true is None else float(route.position_m[true]),
            rank=rank,
            rank_percent=None if rank is None else 100 * rank / route.n_images,
            mode_m=belief.mode_m,
            low_m=belief.credible_95_m[0],
            high_m=belief.credible_95_m[1],
            error_m=None if true is None else float(scene.apart_m(row, np.array([mode]))[0]),
            entropy_bits=belief.entropy_bits,
            off_route=belief.off_route,
            confident=belief.confident,
            next_action_m=None if plan is None else plan.action_m,
            latency_ms=seen.latency_ms,
            mass=tuple(round(share, MASS_DIGITS) for share in belief.histogram.mass),
        )
