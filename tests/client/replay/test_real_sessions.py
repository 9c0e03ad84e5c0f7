"""Sessions, active replays and watching against the real service."""

import asyncio
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deepsimbad_client import AsyncClient, Client, errors
from deepsimbad_client.commands.group import run
from deepsimbad_client.http.jobs import follow_job, remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.active import active_replay
from deepsimbad_client.replay.report import summarise_active

PLANNERS = ["default", "nnql", "random", "constant:10"]


@pytest.fixture(scope="module")
def mapped(service: str, encodings: Path) -> Iterator[Client]:
    """A client of a service that has mapped the domain `active`."""
    with Client(service) as client:
        client.admin.put_domain("active", {"kind": "feature_l2", "extractor": "none"})
        for name in ("landmarks", "summer"):
            upload(client, open_source(str(encodings / f"{name}.npy")), "active", name)
        remap(
            client,
            "active",
            "summer",
            landmark_traverse="landmarks",
            n_landmarks=50,
            list_length=4,
            training_episodes=50,
        )
        yield client


@pytest.fixture
def winter(encodings: Path) -> Recording:
    return open_source(str(encodings / "winter.npy"))


def test_a_robot_finds_out_where_it_is(mapped: Client, winter: Recording) -> None:
    views = np.asarray(winter.encodings)
    with mapped.session("active", seed=3, planner="constant:4") as session:
        for at in range(40, 70, 4):
            answer = session.observe(encoding=views[at], action_m=4)
        assert abs(answer.belief.mode_m - 68) <= 2
        assert answer.n_observations == 8
        assert answer.next_best_view is not None
        assert answer.next_best_view.action_m == 4
        masses = session.belief_masses()
        assert masses.shape == (120,)
        assert masses.sum() == pytest.approx(1, abs=1e-5)
        assert session.state().belief == answer.belief
        assert session.next_best_view() == answer.next_best_view
        moved = session.set_prior(20.0, 3.0)
        assert moved.belief.mode_m == 20
        with mapped.attach_session(session.session_id) as again:
            assert again.opened.belief == moved.belief
    with pytest.raises(errors.EndedSessionError):
        mapped.attach_session(session.session_id)


def test_an_observation_counts_once_under_its_key(mapped: Client, winter: Recording) -> None:
    views = np.asarray(winter.encodings)
    with mapped.session("active") as session:
        first = session.observe(encoding=views[5], idempotency_key="k1")
        again = session.observe(encoding=views[5], idempotency_key="k1")
        assert again.belief == first.belief
        assert session.state().n_observations == 1
        with pytest.raises(errors.IdempotencyKeyReusedError):
            session.observe(encoding=views[6], idempotency_key="k1")


def test_what_the_service_refuses_has_its_class(mapped: Client, winter: Recording) -> None:
    view = np.asarray(winter.encodings)[110]
    with mapped.session("active", start_position_m=115, start_std_m=2) as session:
        session.observe(encoding=view)
        with pytest.raises(errors.InvalidMoveError):
            session.observe(encoding=view, action_m=-1)
        with pytest.raises(errors.InvalidMoveError):
            session.observe(encoding=view, action_m=1e6)
        with pytest.raises(errors.PastTheEndError):
            session.observe(encoding=view, action_m=90)
        with pytest.raises(errors.InvalidPriorError):
            session.set_prior(9999, 1)
        assert session.state().n_observations == 1
    with pytest.raises(errors.InvalidPriorError):
        mapped.session("active", start_position_m=-500)
    with pytest.raises(errors.InvalidInputError):
        mapped.session("active", planner="nonsense")
    with pytest.raises(errors.UnknownSessionError):
        mapped.attach_session("nowhere")
    with pytest.raises(errors.UnknownDomainError):
        mapped.session("nowhere")


def test_many_robots_at_once_on_the_async_client(mapped: Client, winter: Recording) -> None:
    views = np.asarray(winter.encodings)

    async def robot(client: AsyncClient, start: int) -> float:
        async with await client.session("active", seed=start) as session:
            for at in range(start, start + 30, 5):
                answer = await session.observe(encoding=views[at], action_m=5)
            assert (await session.state()).n_observations == 6
            return abs(answer.belief.mode_m - at)

    async def drive() -> list[float]:
        async with AsyncClient(mapped.url) as client:
            return await asyncio.gather(*(robot(client, start) for start in range(0, 80, 8)))

    assert sorted(asyncio.run(drive()))[7] <= 2  # most of them know


def test_an_active_replay_repeats_itself(mapped: Client, winter: Recording, tmp_path: Path) -> None:
    replays = [
        active_replay(mapped, winter, "active", tmp_path / name, planners=PLANNERS, episodes=4, steps=5, concurrency=at)
        for at, name in ((1, "one"), (4, "four"))
    ]
    summaries = [summarise_active(replay) for replay in replays]
    assert summaries[0]["anr"] == summaries[1]["anr"]
    assert summaries[0]["by_step"] == summaries[1]["by_step"]
    assert summaries[0]["planner_named"] == {"default": "telling"} | {name: name for name in PLANNERS[1:]}
    assert summaries[0]["anr"]["constant:10"] < 20
    starts = [[each.steps[0].index for each in episodes] for episodes in replays[0].episodes.values()]
    assert all(each == starts[0] for each in starts)
    with pytest.raises(errors.InvalidInputError):
        active_replay(mapped, winter, "active", tmp_path / "none", planners=["constant:99"], episodes=1, steps=5)


def test_the_active_commands_end_to_end(
    mapped: Client,
    encodings: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DEEPSIMBAD_URL", mapped.url)
    out = tmp_path / "out"
    command = ["replay", str(encodings / "winter.npy"), "--domain", "active", "--out", str(out)]
    command += ["--planner", "default", "--planner", "random", "--steps", "5", "--seed", "1"]
    assert run([*command, "--episodes", "3", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "summary.json").read_text())
    assert set(printed["anr"]) == {"default", "random"}
    assert len((out / "episodes.jsonl").read_text().splitlines()) == 6
    assert len((out / "steps.jsonl").read_text().splitlines()) == 6 * 6
    assert (out / "belief_by_step.png").read_bytes().startswith(b"\x89PNG")
    assert run([*command, "--episodes", "4", "--no-plots"]) == 0  # two more episodes
    assert "telling (default)" in capsys.readouterr().out
    assert len((out / "episodes.jsonl").read_text().splitlines()) == 8
    assert run([*command[:-1], "2"]) == 1
    assert "seed 1, now 2" in capsys.readouterr().err
    plain = ["replay", str(encodings / "winter.npy"), "--domain", "active"]
    assert run([*plain, "--episodes", "3"]) == 2
    assert run([*plain, "--planner", "random", "--tolerance", "3"]) == 2
    assert run([*plain, "--planner", "nonsense", "--out", str(tmp_path / "no")]) == 1
    capsys.readouterr()
    watch = ["watch", str(encodings / "winter.npy"), "--domain", "active", "--steps", "3", "--pause", "0"]
    assert run(watch) == 0
    assert len(capsys.readouterr().out.splitlines()) == 4
    assert run(["watch"]) == 2
    assert run(["watch", "--session", "s", "--domain", "active"]) == 2
    assert run(["watch", "--session", "nowhere"]) == 1


def test_what_became_known_later_improves_the_next_map(service: str, encodings: Path, winter: Recording) -> None:
    views = np.asarray(winter.encodings)
    with Client(service) as client:
        client.admin.put_domain("learning", {"kind": "feature_l2", "extractor": "none"})
        for name in ("landmarks", "summer"):
            upload(client, open_source(str(encodings / f"{name}.npy")), "learning", name)
        remap(client, "learning", "summer", landmark_traverse="landmarks", n_landmarks=50, training_episodes=20)
        with client.session("learning") as session:
            for at in (40, 43, 46):
                session.observe(encoding=views[at], action_m=3)
        job = client.admin.feed_experience("learning", session.session_id, [40.0, None, 46.0])
        done = follow_job(client, job.job_id)
        assert done.result is not None
        assert done.result["map_version"] == 2
        assert client.domain("learning").map_version == 2


def test_watching_another_robot(mapped: Client, winter: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    views = np.asarray(winter.encodings)
    robot = mapped.session("active", keep=True)
    robot.observe(encoding=views[10])
    ending = threading.Timer(0.4, robot.delete)
    ending.start()
    assert run(["watch", "--session", robot.session_id, "--pause", "0.05", "--server", mapped.url]) == 0
    ending.join()
    assert capsys.readouterr().out.startswith("1 view: likeliest at")
