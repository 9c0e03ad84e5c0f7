"""The episodes of an active replay as lines of JSON."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from deepsimbad_client.journal import Journal

EPISODES_FILE = "episodes.jsonl"


@dataclass(frozen=True)
class EpisodeStep:
    """One view of an episode, and how well the belief after it knows where the robot is.

    Attributes:
        step: 0 for the first view, then the number of moves made.
        index: The frame's place in the whole recording.
        name: The frame's name.
        position_m: True distance along the recording's own route.
        x_m: True place; None where unknown.
        y_m: True place; None where unknown.
        commanded_m: The move asked for; None before the first.
        action_m: Metres really moved.
        travelled_m: Metres moved since the episode's start.
        forgot: The belief had no room left for the move and was set back to knowing nothing.
        true_map_image: The map image nearest to the truth; None where the map does not hold the place.
        true_route_m: Where that lies along the map's route.
        rank: Map images that the belief places before it, ties half; None without it.
        rank_percent: `rank` in percent of the map's images.
        mode_m: The likeliest place along the map's route.
        mode_x_m: That place in the plane; None where unknown.
        mode_y_m: That place in the plane; None where unknown.
        low_m: 95 % of the belief lie from here
        high_m: to here.
        error_m: Distance from the truth to the likeliest place; None where the map does not hold the truth.
        entropy_bits: How much is open.
        off_route: Probability that the robot is nowhere on the route; None where not told.
        next_action_m: The move asked for next; None where none was named.
        latency_ms: Time from posting the view to the answer.
        mass: The belief in equal stretches of the map's route; of the first few episodes alone.
    """

    step: int
    index: int
    name: str
    position_m: float
    x_m: float | None
    y_m: float | None
    commanded_m: float | None
    action_m: float
    travelled_m: float
    forgot: bool
    true_map_image: int | None
    true_route_m: float | None
    rank: float | None
    rank_percent: float | None
    mode_m: float
    mode_x_m: float | None
    mode_y_m: float | None
    low_m: float
    high_m: float
    error_m: float | None
    entropy_bits: float
    off_route: float | None
    next_action_m: float | None
    latency_ms: float
    mass: tuple[float, ...] = ()


@dataclass(frozen=True)
class Episode:
    """One episode from its start to its last move.

    Attributes:
        planner: As it was asked for.
        planner_named: What the service calls it.
        episode: Its number: every planner's episode of a number starts from the same place.
        seed: Of its session.
        edges_m: Where the first stretch of `EpisodeStep.mass` begins and the last ends.
        steps: The views.
    """

    planner: str
    planner_named: str
    episode: int
    seed: int
    edges_m: tuple[float, float]
    steps: tuple[EpisodeStep, ...]


_FIELDS = frozenset(field.name for field in fields(EpisodeStep))


class EpisodeLog:
    """An active replay's folder: `replay.json` says what is replayed, `episodes.jsonl` what came back so far.

    Args:
        folder: Made when it does not exist.
        identity: What must be the same for the replay to go on.
        restart: Throw away what an earlier replay left.

    Attributes:
        done: Episodes by planner and number.

    Raises:
        ReplayError: The folder holds another replay, or cannot be written.
    """

    def __init__(self, folder: Path, identity: dict[str, Any], *, restart: bool = False) -> None:
        self._journal = Journal(folder, EPISODES_FILE, identity, _episode, "episode", restart=restart)
        self.done = {(episode.planner, episode.episode): episode for episode in self._journal.earlier}

    def append(self, episode: Episode) -> None:
        """Write an episode down."""
        self._journal.append(asdict(episode))
        self.done[episode.planner, episode.episode] = episode

    def close(self) -> None:
        """Close the file."""
        self._journal.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def write_steps(episodes: Iterable[Episode], folder: Path) -> Path:
    """Write `steps.jsonl`: every view of every episode on a line of its own, without the belief's masses."""
    path = folder / "steps.jsonl"
    with path.open("w") as stream:
        for episode in episodes:
            for step in episode.steps:
                line = {"planner": episode.planner, "episode": episode.episode} | asdict(step)
                del line["mass"]
                stream.write(json.dumps(line, allow_nan=False) + "\n")
    return path


def _episode(document: dict[str, Any]) -> Episode:
    steps = tuple(
        EpisodeStep(**{key: value for key, value in step.items() if key in _FIELDS} | {"mass": tuple(step["mass"])})
        for step in document["steps"]
    )
    low_m, high_m = document["edges_m"]
    return Episode(
        planner=document["planner"],
        planner_named=document["planner_named"],
        episode=document["episode"],
        seed=document["seed"],
        edges_m=(low_m, high_m),
        steps=steps,
    )
