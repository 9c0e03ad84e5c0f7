"""Passive replays against the real service: what is scored, what is kept, and how they go on."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from deepsimbad.core.route import Route
from deepsimbad_client import errors
from deepsimbad_client.http.admin import remap
from deepsimbad_client.recordings import Frame, Recording
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay import Journal, right_answers
from deepsimbad_client.replay.passive import Replay, Step, replay
from deepsimbad_client.replay.report import summarise

from ..conftest import ENCODINGS, make_map


def slow_ranks(client, recording, tolerance_m):
    """Ranks by the definition, from the answers of another session; map image i lies at i metres."""
    ranks = []
    with client.session("route") as session:
        last_m = recording.frames[0].position_m
        for row, frame in enumerate(recording.frames):
            moved_m = max(0.0, frame.position_m - last_m)
            answer = session.observe(**recording.view(row, None), action_m=moved_m, shortlist=120)
            last_m = frame.position_m
            values = {place.map_image: place.relevance for place in answer.retrieval}
            true_ranks = [
                sum(other > values[image] for other in values.values())
                + (sum(other == values[image] for other in values.values()) - 1) / 2
                for image in values
                if abs(image - frame.position_m) <= tolerance_m
            ]
            ranks.append(min(true_ranks))
    return ranks


def essence(steps):
    return [(step.query, step.name, step.rank, step.best_map_image, step.error_m, step.true_route_m) for step in steps]


def test_one_session_in_order_is_ranked_by_the_service(client, link, encodings, tmp_path):
    winter = np.load(encodings / "winter.npy")
    harsh = winter + 0.8 * winter.std() * np.random.default_rng(5).normal(size=winter.shape)
    np.save(tmp_path / "harsh.npy", harsh.astype(np.float32))
    recording = open_source(f"{tmp_path / 'harsh.npy'}#20:63")
    result = replay(client, recording, "route", tmp_path, tolerance_m=2)
    assert max(len(request.content) for request in link.requests) < 4_000
    assert [step.rank for step in result.steps] == slow_ranks(client, recording, 2)
    assert len({step.rank for step in result.steps}) > 2, "else nothing is shown"
    with pytest.raises(errors.GoneError):
        client.attach_session(json.loads((tmp_path / "replay.json").read_text())["session_id"])
    for step in result.steps:
        assert (step.n_true, step.true_route_m, step.forgot) == (5, step.position_m, False)
        assert step.error_m == abs((step.best_map_image or 0) - step.position_m)
        assert step.rank_percent == pytest.approx(100 * (step.rank or 0) / 120)
        assert sum(step.mass) == pytest.approx(1, abs=0.001)
    lines = [json.loads(line) for line in (tmp_path / "steps.jsonl").read_text().splitlines()]
    assert [line["rank"] for line in lines] == [step.rank for step in result.steps]
    assert "mass" not in lines[0]


def n_observations(link):
    return sum(request.url.path.endswith("/observations") for request in link.requests)


@pytest.mark.parametrize("is_written", [True, False], ids=["between two views", "an answer that was not written down"])
def test_a_replay_goes_on_where_it_was_stopped(client, link, encodings, tmp_path, monkeypatch, is_written):
    recording = open_source(f"{encodings / 'winter.npy'}#20:65")
    full_replay = replay(client, recording, "route", tmp_path / "whole", concurrency=3)
    assert [step.index for step in full_replay.steps] == list(range(20, 65))
    append = Journal.append

    def append_or_stop(journal, document):
        is_last = isinstance(document, dict) and document["query"] == 31
        if is_written or not is_last:
            append(journal, document)
        if is_last:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "append", append_or_stop)
        with pytest.raises(KeyboardInterrupt):
            replay(client, recording, "route", tmp_path / "parts", concurrency=3)
    link.requests.clear()
    heard: list[tuple[int, float | None]] = []
    resumed = replay(
        *(client, recording, "route", tmp_path / "parts"),
        on_progress=lambda step, n_done: heard.append((n_done, step.rank)),
    )
    assert n_observations(link) == 45 - (32 if is_written else 31)
    assert essence(resumed.steps) == essence(full_replay.steps)
    assert heard == [(row + 1, step.rank) for row, step in enumerate(full_replay.steps)]
    link.requests.clear()
    assert essence(replay(client, recording, "route", tmp_path / "parts").steps) == essence(full_replay.steps)
    assert not n_observations(link), "nothing was left to ask"


def test_a_session_or_a_map_that_is_another_meanwhile_is_named(client, encodings, tmp_path):
    recording = open_source(f"{encodings / 'winter.npy'}#:50")

    def stop(step, n_done):
        raise KeyboardInterrupt

    make_map(client, "ended", encodings)
    with pytest.raises(KeyboardInterrupt):
        replay(client, recording, "ended", tmp_path, on_progress=stop)
    client.attach_session(json.loads((tmp_path / "replay.json").read_text())["session_id"]).delete()
    with pytest.raises(errors.ReplayError, match=r"ended meanwhile .*restart"):
        replay(client, recording, "ended", tmp_path)
    assert len(replay(client, recording, "ended", tmp_path, restart=True).steps) == 50
    remap(client, "ended", "summer", training_episodes=0)
    with pytest.raises(errors.ReplayError, match="map_version 1, now 2"):
        replay(client, recording, "ended", tmp_path)


def test_jumps_and_drives_backwards_begin_anew(client, encodings, tmp_path):
    backwards = open_source(f"{encodings / 'winter.npy'}#30:10:-1")
    result = replay(client, backwards, "route", tmp_path / "back")
    assert [step.forgot for step in result.steps] == [False] + [True] * 19
    assert summarise(result)["recall_at_5"] > 50
    views = np.load(encodings / "winter.npy")
    frames = tuple(Frame(i, str(i), 3.0 * i) for i in (0, 1, 38))
    result = replay(client, Recording("jumping", frames, encodings=views[[0, 3, 114]]), "route", tmp_path / "jump")
    assert [step.forgot for step in result.steps] == [False, False, True]
    assert [step.true_route_m for step in result.steps] == [0.0, 3.0, 114.0]


def test_a_view_that_began_anew_still_counts_where_the_replay_goes_on(client, encodings, tmp_path, monkeypatch):
    rows = [0, 3, 114, 115, 116, 117]
    frames = tuple(Frame(i, str(i), float(row)) for i, row in enumerate(rows))
    recording = Recording("jumping", frames, encodings=np.load(encodings / "winter.npy")[rows])
    full_replay = replay(client, recording, "route", tmp_path / "whole")
    append = Journal.append

    def stop(journal, document):
        if isinstance(document, dict) and document["forgot"]:
            raise KeyboardInterrupt
        append(journal, document)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "append", stop)
        with pytest.raises(KeyboardInterrupt):
            replay(client, recording, "route", tmp_path / "parts")
    resumed = replay(client, recording, "route", tmp_path / "parts")
    assert [(step.forgot, step.mass) for step in resumed.steps] == [
        (step.forgot, step.mass) for step in full_replay.steps
    ]


def test_a_domain_without_a_map_cannot_be_replayed_against(client, encodings, tmp_path):
    client.admin.put_domain("bare", ENCODINGS)
    with pytest.raises(errors.ReplayError, match="remap"):
        replay(client, open_source(str(encodings / "winter.npy")), "bare", tmp_path)


# The truth


def test_a_place_driven_the_other_way_is_no_right_answer_and_frames_taken_backwards_look_forwards():
    there_and_back = np.concatenate([np.arange(0, 10.0), np.arange(9, -1.0, -1)])
    route = Route(np.arange(20.0), False, there_and_back, np.zeros(20))
    frames = [Frame(i, str(i), float(i), x_m=float(i), y_m=0.0) for i in range(10)]
    assert right_answers(Recording("r", frames), route, 0.5)[4].tolist() == [4]
    assert right_answers(Recording("r", frames[::-1]), route, 0.5)[5].tolist() == [4]


# What is kept, and what it comes to


def test_summary_counts_what_it_leaves_out():
    steps = [
        Step(0, 0, "a", 0.0, None, None, n_true=1, rank=0.0, rank_percent=0.0, error_m=0.0, latency_ms=2.0),
        Step(1, 1, "b", 1.0, None, None, n_true=1, rank=1.0, rank_percent=10.0, error_m=7.0, latency_ms=4.0),
        Step(2, 2, "c", 2.0, None, None, n_true=0, error_m=50.0, latency_ms=3.0),
        Step(3, 3, "d", 3.0, None, None, broken="undecodable"),
    ]
    route = Route(np.arange(10.0))
    summary = summarise(Replay(Path(), steps, route, {"domain": "d"}, {"undecodable": ["3.png"]}, 1.0))
    assert (summary["anr"], summary["recall_at_1"], summary["recall_at_5"]) == (5.0, 50.0, 100.0)
    assert (summary["n_queries"], summary["n_left_out"], summary["n_broken"]) == (2, 1, {"undecodable": 1})
    assert (summary["within_5_m"], summary["within_10_m"]) == (50.0, 100.0)
    empty = summarise(Replay(Path(), steps[3:], route, {}, {}, 1.0))
    assert empty["anr"] is None
    json.dumps(empty, allow_nan=False)


@dataclass
class Number:
    n: int


def journal(folder, identity, *, restart=False):
    return Journal(folder, "records.jsonl", identity, TypeAdapter(Number), "number", restart=restart)


def test_a_journal_goes_on_after_a_torn_line_and_is_not_mixed_with_another_replays(tmp_path):
    with journal(tmp_path / "new", {"a": 1}) as log:
        log.note(session_id="s1")
        log.append({"n": 1})
        log.append({"n": 2})
    file = tmp_path / "new" / "records.jsonl"
    file.write_bytes(file.read_bytes()[:-3])
    with journal(tmp_path / "new", {"a": 1}) as log:
        assert (log.earlier, log.document) == ([Number(1)], {"a": 1, "session_id": "s1"})
        log.append({"n": 3})
    with journal(tmp_path / "new", {"a": 1}) as log:
        assert log.earlier == [Number(1), Number(3)]
    with pytest.raises(errors.ReplayError, match="a 1, now 2"):
        journal(tmp_path / "new", {"a": 2})
    with journal(tmp_path / "new", {"a": 2}, restart=True) as log:
        assert log.earlier == []


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        *(("records.jsonl", line, r"line 1 of .* is no number") for line in (b"{}\n", b"\0\0\n", b"[]\n", b"\xff\n")),
        *(("replay.json", text, "another replay") for text in (b"", b"\0\0\0", b"[]")),
    ],
)
def test_damage_is_named(tmp_path, name, damage, words):
    with journal(tmp_path, {"a": 1}):
        pass
    (tmp_path / name).write_bytes(damage)
    with pytest.raises(errors.ReplayError, match=words):
        journal(tmp_path, {"a": 1})
    with pytest.raises(errors.ReplayError, match="cannot write"):
        journal(tmp_path / name / "below", {"a": 1})
