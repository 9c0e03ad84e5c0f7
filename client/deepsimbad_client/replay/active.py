"""Active replays: a robot asks where to look next, goes there along a recording, looks, and is scored by the truth."""

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
    Viewer,
    ViewOutcome,
    changed_map,
    write_lines,
)

EPISODES = 20
STEPS = 10
EPISODES_WITH_MASS = 10
"""Episodes whose beliefs along the route are kept for pictures; those of thousands would fill the memory."""
TRUTH_WITHIN_M = 10.0  # A frame farther than this from every map image is off the map and has no right answer
_LONGEST_ACTION_M = 10.0


@dataclass(frozen=True)
class EpisodeStep:
    """One view of an episode, and how well the belief after it knows where the robot is; None where unknown."""

    step: int  # 0 for the first view, then the number of moves made
    index: int  # the frame's place in the whole recording
    name: str
    position_m: float  # along the recording's own route
    x_m: float | None
    y_m: float | None
    commanded_m: float | None  # the move asked for; None before the first
    action_m: float  # metres really moved
    travelled_m: float  # since the episode's start, forward or backward
    forgot: bool  # the belief had no room for the move and was set back to knowing nothing
    true_map_image: int | None  # the one nearest to the truth; None where the map does not hold the place
    true_route_m: float | None  # position of the true map image along the map's route
    rank: float | None  # number of map images that the belief places before the true one, ties half
    rank_percent: float | None  # the rank in percent of the map's images
    mode_m: float  # the likeliest place along the map's route
    low_m: float  # lower end of the interval with 95 % of the belief
    high_m: float  # its upper end
    error_m: float | None  # from the truth to the likeliest place
    entropy_bits: float  # of the belief
    off_route: float | None  # probability that the robot is lost: off the route, or carried along it
    next_action_m: float | None  # the move that the service asks for next
    latency_ms: float  # from posting the view to the answer
    confident: bool = False  # whether enough of the belief is within 5 m of the likeliest place
    mass: tuple[float, ...] = ()  # the belief in equal stretches of the map's route; of the first few episodes alone


@dataclass(frozen=True)
class Episode:
    """One episode from its start to its last move."""

    planner: str  # as the caller named it
    planner_named: str  # as the service names it
    episode: int  # number; all planners' episodes of one number start from the same place
    seed: int  # of its session
    edges_m: tuple[float, float]  # where the first stretch of `EpisodeStep.mass` begins and the last ends
    steps: tuple[EpisodeStep, ...]


@dataclass(frozen=True)
class ActiveReplay:
    """A finished active replay."""

    folder: Path  # of its files
    planners: tuple[str, ...]  # as the caller named them; the others are compared with the first
    episodes: dict[str, list[Episode]]  # for each planner, in order; the same numbers for all
    identity: dict[str, Any]  # of its scene, and its options
    seconds: float  # that this run took


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
    on_progress: Callable[[Episode, int], None] = lambda *_: None,
) -> ActiveReplay:
    """Drive episodes from random starts, for planners that are to be compared.

    Every planner starts from the same places with the same session seeds; each step takes the recorded frame nearest
    to the commanded place and tells the service the metres really moved. Of `planners` (names the service knows)
    `default` is the service's default. `folder` takes `replay.json`, `episodes.jsonl` and `steps.jsonl`; interrupted at
    any moment, the same call goes on after the last episode written, and more planners and episodes can be added later;
    `restart` throws away an earlier replay. `concurrency` episodes are under way at once, with `viewers` one;
    `on_progress` is called with every finished episode and the number of them. Raises ReplayError, ApiError,
    TransportError.
    """
    start_s = time.perf_counter()
    concurrency = 1 if viewers else concurrency
    stage = Stage(client, recording, domain, viewers)
    starts = [stage.start(steps, seed, episode) for episode in range(episodes)]
    planners = tuple(dict.fromkeys(planners))
    identity = {"kind": "active", **stage.scene.identity, "steps": steps, "seed": seed}
    identity |= {"truth_within_m": TRUTH_WITHIN_M}
    with Journal(folder, "episodes.jsonl", identity, TypeAdapter(Episode), "episode", restart=restart) as journal:
        keys = [(planner, episode) for episode in range(episodes) for planner in planners]
        episode_of = {(episode.planner, episode.episode): episode for episode in journal.earlier}
        earlier_keys = [key for key in keys if key in episode_of]

        def drive(key: tuple[str, int]) -> Episode:
            return stage.drive(*key, *starts[key[1]], steps)

        for n_done, key in enumerate(earlier_keys, 1):
            on_progress(episode_of[key], n_done)
        open_keys = [key for key in keys if key not in episode_of]
        for n_done, (key, episode) in enumerate(in_order(drive, open_keys, concurrency), len(earlier_keys) + 1):
            journal.append(asdict(episode))
            episode_of[key] = episode
            on_progress(episode, n_done)
        if client.domain(domain).map_version != stage.scene.domain.map_version:
            raise changed_map(domain)
    by_planner = {name: [episode_of[name, number] for number in range(episodes)] for name in planners}
    lines = (
        {"planner": name, "episode": episode.episode, **asdict(step)}
        for name in planners
        for episode in by_planner[name]
        for step in episode.steps
    )
    write_lines(folder / "steps.jsonl", lines)
    identity |= {"planners": list(planners), "n_episodes": episodes}
    return ActiveReplay(folder, planners, by_planner, identity, time.perf_counter() - start_s)


class Stage:
    """A recording driven as an active robot drives; raises ReplayError where positions go backwards."""

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

    def nearest(self, here_m: float, commanded_m: float, broken_rows: frozenset[int]) -> int:
        """The row of the frame, not `broken`, nearest to where a move leads; raises ReplayError where all are broken.

        Frames ahead in the move's direction come first: a robot told to move does move, though the next frame may be
        farther than it was told, and does not look at the same picture twice.
        """
        usable = np.delete(np.arange(len(self.position_m)), sorted(broken_rows))
        if not usable.size:
            raise ReplayError(f"none of the frames of {self.scene.recording.name} can be used")
        rows_ahead = usable[(self.position_m[usable] - here_m) * commanded_m > 0]
        usable = rows_ahead if rows_ahead.size else usable
        return int(usable[np.abs(self.position_m[usable] - here_m - commanded_m).argmin()])

    def play(self, session: Session, row: int, steps: int) -> Iterator[tuple[ViewOutcome, EpisodeStep]]:
        """Drive one episode: look, ask for the next-best view, move there, look again; score every view.

        Yields `steps` + 1 views, the first without a move; a frame that cannot be used is passed over for the nearest
        that can. Raises ReplayError (no frame can be used, or the service names no next move), ApiError,
        TransportError.
        """
        broken_rows: frozenset[int] = frozenset()
        here_m, travelled_m, commanded_m = float(self.position_m[row]), 0.0, None
        for step in range(steps + 1):
            while True:
                action_m = float(self.position_m[row]) - here_m
                view = self.scene.view(row)
                outcome = (
                    view if isinstance(view, str) else self.scene.look(session, row, view, action_m if step else None)
                )
                if not isinstance(outcome, str):
                    break
                broken_rows |= {row}
                row = self.nearest(here_m, commanded_m or 0.0, broken_rows)
            action_m = action_m if step else 0.0
            travelled_m += abs(action_m)
            moves = {"step": step, "commanded_m": commanded_m, "action_m": action_m, "travelled_m": travelled_m}
            yield outcome, self._score(row, outcome, session, moves)
            if step == steps:
                return
            plan = outcome.answer.next_best_view
            if plan is None:
                raise ReplayError(
                    f"the map of {session.domain} names no next-best view for this planner: remap with training "
                    "episodes"
                )
            here_m, commanded_m = float(self.position_m[row]), plan.action_m
            row = self.nearest(here_m, commanded_m, broken_rows)

    def drive(self, planner: str, number: int, row: int, seed: int, steps: int) -> Episode:
        """Drive one whole episode in a session of its own; raises as `play`."""
        views: list[EpisodeStep] = []
        planner_named, edges_m = planner, (0.0, 0.0)
        with self.scene.session(planner, seed) as session:
            for outcome, step in self.play(session, row, steps):
                views.append(step if number < EPISODES_WITH_MASS else replace(step, mass=()))
                edges = outcome.answer.belief.histogram.edges_m
                edges_m = (edges[0], edges[-1])
                if outcome.answer.next_best_view is not None:
                    planner_named = outcome.answer.next_best_view.planner
        return Episode(planner, planner_named, number, seed, edges_m, tuple(views))

    def _score(self, row: int, outcome: ViewOutcome, session: Session, moves: dict[str, Any]) -> EpisodeStep:
        """The step of a view: how well the belief after it knows where the robot truly is."""
        scene, frame, route = self.scene, self.scene.recording.frames[row], self.scene.route
        true_image = scene.nearest_right(row)
        rank = None if true_image is None else rank_of_truth(session.belief_masses(), np.array([true_image]))
        belief, plan = outcome.answer.belief, outcome.answer.next_best_view
        mode_image = int(np.abs(route.position_m - belief.mode_m).argmin())
        return EpisodeStep(
            **moves,
            index=frame.index,
            name=frame.name,
            position_m=frame.position_m,
            x_m=frame.x_m,
            y_m=frame.y_m,
            forgot=outcome.forgot,
            true_map_image=true_image,
            true_route_m=None if true_image is None else float(route.position_m[true_image]),
            rank=rank,
            rank_percent=None if rank is None else 100 * rank / route.n_images,
            mode_m=belief.mode_m,
            low_m=belief.credible_95_m[0],
            high_m=belief.credible_95_m[1],
            error_m=None if true_image is None else float(scene.apart_m(row, np.array([mode_image]))[0]),
            entropy_bits=belief.entropy_bits,
            off_route=belief.off_route,
            confident=belief.confident,
            next_action_m=None if plan is None else plan.action_m,
            latency_ms=outcome.latency_ms,
            mass=tuple(round(share, MASS_DIGITS) for share in belief.histogram.mass),
        )
