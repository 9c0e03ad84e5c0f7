"""Active replays against the real service: what is driven, what is scored, and how they go on."""

import json
from dataclasses import replace
from typing import Any

import httpx2
import numpy as np
import pytest

from deepsimbad_client import errors
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.active import Stage, active_replay

PLANNERS = ("default", "random", "constant:3")
SESSIONS = "/v1/domains/route/sessions"


@pytest.fixture
def drive(encodings):
    return open_source(str(encodings / "winter.npy"))


@pytest.fixture
def drive_actively(client, drive, tmp_path):
    def drive_actively(recording=drive, folder="out", **options):
        wishes: dict[str, Any] = {"planners": PLANNERS, "episodes": 4, "steps": 5, "concurrency": 2, "seed": 5}
        return active_replay(client, recording, "route", tmp_path / folder, **wishes | options)

    return drive_actively


@pytest.fixture
def stage(client, drive):
    return Stage(client, drive, "route")


def test_every_planner_starts_from_the_same_places_and_goes_where_it_is_sent(client, drive_actively, link):
    replay = drive_actively()
    for value in (lambda episode: episode.steps[0].index, lambda episode: episode.seed):
        default, random, constant = ([value(episode) for episode in episodes] for episodes in replay.episodes.values())
        assert default == random == constant
        assert len(set(default)) > 1
    assert max(episode.steps[0].index for episode in replay.episodes["default"]) + 5 * 10 <= 119
    paths = [request.url.path for request in link.requests if request.method in {"POST", "DELETE"}]
    assert paths.count(SESSIONS) == 12
    assert len([path for path in paths if path.startswith("/v1/sessions/") and path.count("/") == 3]) == 12
    for episode in replay.episodes["constant:3"]:
        assert (episode.planner_named, episode.edges_m) == ("constant:3", (0.0, 119.0))
        first, *moves = episode.steps
        assert (first.step, first.commanded_m, first.action_m, first.travelled_m) == (0, None, 0.0, 0.0)
        assert [step.action_m for step in moves] == [3.0] * 5
        assert [step.position_m for step in moves] == [first.position_m + 3 * n for n in range(1, 6)]
        assert [step.travelled_m for step in moves] == [3.0, 6.0, 9.0, 12.0, 15.0]
        assert {step.next_action_m for step in episode.steps} == {3.0}


def test_moves_between_sparse_frames_are_told_as_they_were(drive_actively, drive, link):
    every_fourth = drive.sliced(slice(0, None, 4))
    (episode,) = drive_actively(every_fourth, planners=["constant:7"], episodes=1).episodes["constant:7"]
    assert [step.action_m for step in episode.steps[1:]] == [8.0] * 5
    assert {step.commanded_m for step in episode.steps[1:]} == {7.0}
    posted = [request for request in link.requests if request.url.path.endswith("observations")]
    assert [request.url.params.get("action_m") for request in posted[1:]] == ["8.0"] * 5


def test_ranks_and_errors_against_a_slow_reference(drive_actively, drive, client, views):
    views = views + np.random.default_rng(0).normal(0, 2, views.shape).astype(np.float32)
    (episode,) = drive_actively(replace(drive, encodings=views), planners=["constant:7"], episodes=1).episodes[
        "constant:7"
    ]
    ranks = []
    with client.session("route", planner="constant:7", seed=episode.seed) as session:
        for step in episode.steps:
            observed = session.observe(encoding=views[step.index], action_m=step.action_m)
            mass, true_image = session.belief_masses(), step.index
            n_better = sum(mass[other] > mass[true_image] for other in range(120))
            n_tied = sum(mass[other] == mass[true_image] for other in range(120)) - 1
            ranks.append(n_better + n_tied / 2)
            assert step.rank == n_better + n_tied / 2
            assert step.rank_percent == pytest.approx(100 * step.rank / 120)
            assert (step.true_map_image, step.error_m) == (true_image, abs(round(observed.belief.mode_m) - true_image))
            assert sum(step.mass) == pytest.approx(1, abs=1e-3)
    assert max(ranks) > 0, "else nothing is shown"


def essence(replay):
    return [
        (episode.planner, episode.episode, episode.seed, [(step.index, step.rank, step.mass) for step in episode.steps])
        for episodes in replay.episodes.values()
        for episode in episodes
    ]


def test_a_replay_goes_on_where_it_was_stopped_however_often(drive_actively, tmp_path):
    full_replay = drive_actively(folder="whole", concurrency=1)
    file = tmp_path / "parts" / "episodes.jsonl"
    for stop_after in (1, 5, 11):

        def stop(_, n_done, stop_after=stop_after):
            if n_done == stop_after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            drive_actively(folder="parts", on_progress=stop)
        assert len(file.read_text().splitlines()) == stop_after
        with file.open("ab") as torn:
            torn.write(b'{"planner": "default", "epi')
    heard: list[int] = []
    resumed = drive_actively(folder="parts", on_progress=lambda _, n_done: heard.append(n_done))
    assert essence(resumed) == essence(full_replay)
    assert heard == list(range(1, 13))
    lines = [json.loads(line) for line in (tmp_path / "parts" / "steps.jsonl").read_text().splitlines()]
    assert len(lines) == 12 * 6
    assert "mass" not in lines[0]
    assert {line["planner"] for line in lines} == set(PLANNERS)


def test_planners_and_episodes_can_be_added(drive_actively, link):
    drive_actively(planners=["random"], episodes=2)
    link.requests.clear()
    replay = drive_actively(planners=["random", "constant:3"], episodes=3)
    assert [request.url.path for request in link.requests].count(SESSIONS) == 1 + 3
    assert [len(episodes) for episodes in replay.episodes.values()] == [3, 3]
    with pytest.raises(errors.ReplayError, match="seed 5, now 6"):
        drive_actively(seed=6)
    assert len(drive_actively(seed=6, episodes=1, restart=True).episodes["default"]) == 1


def test_a_recording_too_short_for_its_moves(drive_actively, drive, client, link):
    with pytest.raises(errors.ReplayError, match="fewer steps"):
        drive_actively(drive.sliced(slice(0, 50)))
    assert SESSIONS not in [request.url.path for request in link.requests]
    stage = Stage(client, drive.sliced(slice(0, 51)), "route")
    assert {stage.start(5, 0, episode)[0] for episode in range(20)} == {0}


def test_starts_are_uniform_and_do_not_depend_on_how_many_there_are(stage):
    rows = [stage.start(7, 0, episode)[0] for episode in range(3000)]
    assert set(rows) == set(range(50))
    assert max(np.bincount(rows)) < 100
    assert rows[:5] == [stage.start(7, 0, episode)[0] for episode in range(5)]
    assert rows[:5] != [stage.start(7, 1, episode)[0] for episode in range(5)]


def test_frames_that_cannot_be_used_are_passed_over(drive_actively, drive, views, link, monkeypatch):
    answer = link.handle_request

    def refuse_zeros(request):
        is_torn = request.url.path.endswith(("observations", "localizations")) and b":[0.0,0.0," in request.content
        return httpx2.Response(422, json={"code": "undecodable_image"}) if is_torn else answer(request)

    monkeypatch.setattr(link, "handle_request", refuse_zeros)
    torn = np.where(np.arange(120)[:, None] % 3, views, 0)
    replay = drive_actively(replace(drive, encodings=torn), planners=["constant:3"], episodes=3)
    for episode in replay.episodes["constant:3"]:
        assert all(step.index % 3 for step in episode.steps)
        assert all(step.action_m >= 0 for step in episode.steps)
    with pytest.raises(errors.ReplayError, match="none of the"):
        drive_actively(
            replace(drive, encodings=np.zeros_like(views)), folder="none", planners=["constant:3"], episodes=1
        )


def test_without_a_next_best_view_or_with_another_map_there_is_no_replay(drive_actively, link, monkeypatch):
    answer, changes = link.handle_request, [("next_best_view", None)]

    def change(request):
        response = answer(request)
        if b"map_version" not in response.read():
            return response
        return httpx2.Response(response.status_code, json=response.json() | dict(changes))

    monkeypatch.setattr(link, "handle_request", change)
    with pytest.raises(errors.ReplayError, match="training"):
        drive_actively()

    def switch(request):
        if request.url.path.endswith("/observations"):
            changes[:] = [("map_version", 4)]
        return change(request)

    changes[:] = []
    monkeypatch.setattr(link, "handle_request", switch)
    with pytest.raises(errors.ReplayError, match="changed during the replay"):
        drive_actively(restart=True)


def test_an_unknown_planner_is_the_services_to_refuse(drive_actively):
    for planner in ("nonsense", "constant:99"):
        with pytest.raises(errors.InvalidInputError):
            drive_actively(planners=[planner])


def test_of_many_episodes_few_keep_their_whole_belief(drive_actively):
    episodes = drive_actively(planners=["random"], episodes=12, steps=1).episodes["random"]
    assert [bool(episode.steps[0].mass) for episode in episodes] == [True] * 10 + [False] * 2


def test_the_commands_end_to_end(encodings, tmp_path, command, out, ends):
    folder = tmp_path / "out"
    plain = ("replay", encodings / "winter.npy", "--domain", "route")
    words = (*plain, "--out", folder, "--planner", "default", "--planner", "random", "--steps", "5", "--seed")
    summary = out(*words, "1", "--episodes", "3", "--json")
    assert summary == json.loads((folder / "summary.json").read_text())
    assert set(summary["anr"]) == {"default", "random"}
    assert len((folder / "episodes.jsonl").read_text().splitlines()) == 6
    assert len((folder / "steps.jsonl").read_text().splitlines()) == 6 * 6
    assert (folder / "belief_by_step.png").read_bytes().startswith(b"\x89PNG")
    assert "informed (default)" in out(*words, "1", "--episodes", "4", "--no-plots")
    assert len((folder / "episodes.jsonl").read_text().splitlines()) == 8, "two more"
    ends(1, "seed 1, now 2", *words, "2")
    assert command(*plain, "--episodes", "3").code == 2
    assert command(*plain, "--planner", "random", "--tolerance", "3").code == 2
    assert command(*plain, "--planner", "nonsense", "--out", tmp_path / "no").code == 1
