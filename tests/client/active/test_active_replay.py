"""Active replays against a small service: what is driven, what is scored, and how they go on."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from deepsimbad_client import errors
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.replay.active import ActiveReplay, Episode, Stage, active_replay

PLANNERS = ("default", "random", "constant:3")


def driven(fake: Any, drive: Recording, folder: Path, **options: Any) -> ActiveReplay:
    wishes: dict[str, Any] = {"planners": PLANNERS, "episodes": 4, "steps": 5, "concurrency": 2, "seed": 5}
    with fake.client() as client:
        return active_replay(client, drive, "route", folder, **wishes | options)


def test_every_planner_starts_from_the_same_places(fake: Any, drive: Recording, tmp_path: Path) -> None:
    replay = driven(fake, drive, tmp_path)
    starts = {name: [episode.steps[0].index for episode in each] for name, each in replay.episodes.items()}
    assert starts["default"] == starts["random"] == starts["constant:3"]
    assert len(set(starts["default"])) > 1
    assert max(starts["default"]) + 5 * 10 <= 149
    seeds = {name: [episode.seed for episode in each] for name, each in replay.episodes.items()}
    assert seeds["default"] == seeds["random"]
    assert {session.ended for session in fake.sessions.values()} == {True}
    assert len(fake.sessions) == 12


def test_the_robot_goes_where_it_is_sent(fake: Any, drive: Recording, tmp_path: Path) -> None:
    for episode in driven(fake, drive, tmp_path).episodes["constant:3"]:
        assert (episode.planner_named, episode.edges_m) == ("constant:3", (0.0, 149.0))
        first, *moved = episode.steps
        assert (first.step, first.commanded_m, first.action_m, first.travelled_m) == (0, None, 0.0, 0.0)
        assert [step.action_m for step in moved] == [3.0] * 5
        assert [step.position_m for step in moved] == [first.position_m + 3 * n for n in range(1, 6)]
        assert [step.travelled_m for step in moved] == [3.0, 6.0, 9.0, 12.0, 15.0]
        assert {step.next_action_m for step in episode.steps} == {3.0}


def test_moves_between_sparse_frames_are_told_as_they_were(fake: Any, drive: Recording, tmp_path: Path) -> None:
    every_fourth = drive.sliced(slice(0, None, 4))
    (episode,) = driven(fake, every_fourth, tmp_path, planners=["constant:7"], episodes=1).episodes["constant:7"]
    assert [step.action_m for step in episode.steps[1:]] == [8.0] * 5
    moves = [path for path in fake.asked if path.endswith("observations")]
    assert len(moves) == 6
    assert {step.commanded_m for step in episode.steps[1:]} == {7.0}


def test_ranks_and_errors_against_a_slow_reference(fake: Any, drive: Recording, tmp_path: Path) -> None:
    (episode,) = driven(fake, drive, tmp_path, planners=["constant:7"], episodes=1).episodes["constant:7"]
    mass = np.full(150, 1 / 150)
    views = np.asarray(drive.encodings)
    for step in episode.steps:
        if step.step:
            mass = np.concatenate([np.zeros(7), mass[:-7]])
        place, spread = (float(value) for value in views[step.index])
        for image in range(150):
            mass[image] *= np.exp(-0.5 * ((image - place) / spread) ** 2) + 0.02
        mass = mass / mass.sum()
        kept = mass.astype(np.float32)
        true = step.index
        better = sum(kept[other] > kept[true] for other in range(150))
        tied = sum(kept[other] == kept[true] for other in range(150)) - 1
        assert step.rank == better + tied / 2
        assert step.rank_percent == pytest.approx(100 * (better + tied / 2) / 150)
        assert (step.true_map_image, step.error_m) == (true, abs(int(mass.argmax()) - true))
        assert len(step.mass) == 50


def essence(replay: ActiveReplay) -> list[Any]:
    return [
        (each.planner, each.episode, each.seed, [(step.index, step.rank, step.mass) for step in each.steps])
        for episodes in replay.episodes.values()
        for each in episodes
    ]


@pytest.mark.parametrize("stop_after", [1, 5, 11])
def test_a_replay_goes_on_where_it_was_stopped(fake: Any, drive: Recording, tmp_path: Path, stop_after: int) -> None:
    whole = driven(fake, drive, tmp_path / "whole")

    def stop(episode: Episode, n_done: int) -> None:
        if n_done == stop_after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        driven(fake, drive, tmp_path / "parts", on_progress=stop)
    assert all(session.ended for session in fake.sessions.values())
    file = tmp_path / "parts" / "episodes.jsonl"
    assert len(file.read_text().splitlines()) == stop_after
    with file.open("ab") as torn:
        torn.write(b'{"planner": "default", "epi')
    heard: list[int] = []
    resumed = driven(fake, drive, tmp_path / "parts", on_progress=lambda _, n_done: heard.append(n_done))
    assert essence(resumed) == essence(whole)
    assert heard == list(range(1, 13))
    lines = [json.loads(line) for line in (tmp_path / "parts" / "steps.jsonl").read_text().splitlines()]
    assert len(lines) == 12 * 6
    assert "mass" not in lines[0]
    assert {line["planner"] for line in lines} == set(PLANNERS)


def test_planners_and_episodes_can_be_added(fake: Any, drive: Recording, tmp_path: Path) -> None:
    driven(fake, drive, tmp_path, planners=["random"], episodes=2)
    n_sessions = len(fake.sessions)
    replay = driven(fake, drive, tmp_path, planners=["random", "constant:3"], episodes=3)
    assert len(fake.sessions) - n_sessions == 1 + 3
    assert [len(each) for each in replay.episodes.values()] == [3, 3]
    with pytest.raises(errors.ReplayError, match="seed 5, now 6"):
        driven(fake, drive, tmp_path, seed=6)
    assert len(driven(fake, drive, tmp_path, seed=6, episodes=1, restart=True).episodes["default"]) == 1


def test_a_recording_too_short_for_its_moves(fake: Any, drive: Recording, tmp_path: Path) -> None:
    with pytest.raises(errors.ReplayError, match="fewer steps"):
        driven(fake, drive.sliced(slice(0, 50)), tmp_path)
    assert fake.sessions == {}
    with fake.client() as client:
        stage = Stage(client, drive.sliced(slice(0, 51)), "route")
    assert {stage.start(5, 0, episode)[0] for episode in range(20)} == {0}


def test_starts_are_uniform_and_do_not_depend_on_how_many_there_are(fake: Any, drive: Recording) -> None:
    with fake.client() as client:
        stage = Stage(client, drive, "route")
    rows = [stage.start(10, 0, episode)[0] for episode in range(3000)]
    assert set(rows) == set(range(50))
    assert max(np.bincount(rows)) < 100
    assert rows[:5] == [stage.start(10, 0, episode)[0] for episode in range(5)]
    assert rows[:5] != [stage.start(10, 1, episode)[0] for episode in range(5)]


def test_frames_that_cannot_be_used_are_passed_over(fake: Any, drive: Recording, tmp_path: Path) -> None:
    views = np.asarray(drive.encodings)
    torn: Any = [row if at % 3 else row[:1] for at, row in enumerate(views)]  # those are refused as undecodable
    replay = driven(fake, replace(drive, encodings=torn), tmp_path, planners=["constant:3"], episodes=3)
    for episode in replay.episodes["constant:3"]:
        assert all(step.index % 3 for step in episode.steps)
        assert all(step.action_m >= 0 for step in episode.steps)
    with pytest.raises(errors.ReplayError, match="none of the"):
        driven(fake, replace(drive, encodings=views[:, :1]), tmp_path / "none", planners=["constant:3"], episodes=1)


def test_a_belief_without_room_for_the_move_is_given_up(fake: Any, drive: Recording, tmp_path: Path) -> None:
    misleading = replace(drive, encodings=np.tile(np.array([148.0, 0.5], np.float32), (150, 1)))  # the end everywhere
    fake.doubt = 1e-6
    (episode,) = driven(fake, misleading, tmp_path, planners=["constant:10"], episodes=1).episodes["constant:10"]
    assert any(step.forgot for step in episode.steps)
    assert len(episode.steps) == 6


def test_without_a_next_best_view_there_is_no_active_robot(fake: Any, drive: Recording, tmp_path: Path) -> None:
    fake.plans = False
    with pytest.raises(errors.ReplayError, match="training"):
        driven(fake, drive, tmp_path)


def test_an_unknown_planner_is_the_services_to_refuse(fake: Any, drive: Recording, tmp_path: Path) -> None:
    with pytest.raises(errors.InvalidInputError):
        driven(fake, drive, tmp_path, planners=["nonsense"])


def test_a_map_switched_meanwhile(fake: Any, drive: Recording, tmp_path: Path) -> None:
    def switch(request: httpx2.Request) -> bool:
        if request.url.path.endswith("/observations"):
            fake.map_version = 4
        return False

    fake.lose_answers = switch
    with pytest.raises(errors.ReplayError, match="changed during the replay"):
        driven(fake, drive, tmp_path)


def test_of_many_episodes_few_keep_their_whole_belief(fake: Any, drive: Recording, tmp_path: Path) -> None:
    episodes = driven(fake, drive, tmp_path, planners=["random"], episodes=12).episodes["random"]
    assert [bool(episode.steps[0].mass) for episode in episodes] == [True] * 10 + [False] * 2
