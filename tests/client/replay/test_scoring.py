"""Truth, ranks and what is kept of them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.errors import ReplayError
from deepsimbad_client.heat import RelevanceHeat
from deepsimbad_client.map_route import MapRoute, RoutePath, Truth, path_of_frames
from deepsimbad_client.recordings.recording import Frame
from deepsimbad_client.replay import Replay, rank_of_truth
from deepsimbad_client.report import summarise
from deepsimbad_client.step_log import Step, StepLog


def straight(n: int, *, closed: bool = False, length_m: float = 0.0) -> MapRoute:
    unknown = np.full(n, np.nan)
    return MapRoute(1, RoutePath(np.arange(n, dtype=float), unknown, unknown), closed, length_m)


def along(*positions: float) -> RoutePath:
    return path_of_frames([Frame(i, str(i), position) for i, position in enumerate(positions)])


@given(st.lists(st.integers(-3, 3), min_size=1, max_size=30), st.data())
def test_rank_against_its_definition(relevance: list[int], data: st.DataObject) -> None:
    true = data.draw(st.lists(st.sampled_from(range(len(relevance))), min_size=1, unique=True))
    placed = []
    for candidate in true:
        better = sum(other > relevance[candidate] for other in relevance)
        tied = sum(other == relevance[candidate] for other in relevance) - 1
        placed.append(better + tied / 2)
    assert rank_of_truth(np.array(relevance, np.float32), np.array(true)) == min(placed)


def test_truth_along_an_open_and_a_closed_route() -> None:
    queries = along(0.0, 9.0)
    assert Truth(queries, straight(10), 1.0).true_images(0).tolist() == [0, 1]
    closed = straight(10, closed=True, length_m=10.0)
    assert Truth(queries, closed, 1.0).true_images(0).tolist() == [0, 1, 9]
    assert Truth(queries, closed, 1.0).apart_m(1)[0] == 1.0
    assert Truth(along(25.0), straight(10), 2.0).true_images(0).size == 0


def test_truth_in_the_plane_where_both_sides_know_it() -> None:
    x, y = np.array([0.0, 1.0, 2.0, np.nan]), np.array([0.0, 0.0, 0.0, np.nan])
    route = MapRoute(1, RoutePath(np.array([0.0, 1.0, 2.0, 3.0]), x, y), False, 3.0)
    frames = [Frame(0, "0", 3.0, x_m=0.0, y_m=0.5), Frame(1, "1", 3.0)]
    truth = Truth(path_of_frames(frames), route, 0.6)
    assert truth.true_images(0).tolist() == [0, 3]  # the last by its position: it has no x and y
    assert truth.true_images(1).tolist() == [3]


def test_a_place_driven_the_other_way_is_no_right_answer() -> None:
    there_and_back = np.concatenate([np.arange(0, 10.0), np.arange(9, -1.0, -1)])
    route = MapRoute(1, RoutePath(np.arange(20.0), there_and_back, np.zeros(20)), False, 19.0)
    frames = [Frame(i, str(i), float(i), x_m=float(i), y_m=0.0) for i in range(10)]
    truth = Truth(path_of_frames(frames), route, 0.5)
    assert truth.true_images(4).tolist() == [4]
    backwards = Truth(path_of_frames(frames[::-1]), route, 0.5)  # the views still look forwards
    assert backwards.true_images(5).tolist() == [4]


def test_summary_counts_what_it_leaves_out() -> None:
    steps = [
        Step(0, 0, "a", 0.0, None, None, n_true=1, rank=0.0, rank_percent=0.0, error_m=0.0, latency_ms=2.0),
        Step(1, 1, "b", 1.0, None, None, n_true=1, rank=1.0, rank_percent=10.0, error_m=7.0, latency_ms=4.0),
        Step(2, 2, "c", 2.0, None, None, n_true=0, error_m=50.0, latency_ms=3.0),
        Step(3, 3, "d", 3.0, None, None, broken="undecodable"),
    ]
    heat = RelevanceHeat(np.empty((4, 1), np.float16), 1, np.zeros(10, np.intp))
    summary = summarise(Replay(Path(), steps, straight(10), heat, {"domain": "d"}, 1.0))
    assert (summary["anr"], summary["recall_at_1"], summary["recall_at_5"]) == (5.0, 50.0, 100.0)
    assert (summary["n_queries"], summary["n_left_out"], summary["n_broken"]) == (2, 1, {"undecodable": 1})
    assert (summary["within_5_m"], summary["within_10_m"]) == (50.0, 100.0)
    empty = summarise(Replay(Path(), steps[3:], straight(10), heat, {}, 1.0))
    assert empty["anr"] is None
    json.dumps(empty, allow_nan=False)


STEPS = [Step(i, i, f"{i}.jpg", float(i), None, None, rank=float(i)) for i in range(3)]


def test_a_log_goes_on_after_a_torn_line(tmp_path: Path) -> None:
    with StepLog(tmp_path / "new", {"a": 1}) as log:
        log.append(STEPS[0])
        log.append(STEPS[1])
    file = tmp_path / "new" / "steps.jsonl"
    file.write_bytes(file.read_bytes()[:-7])
    with StepLog(tmp_path / "new", {"a": 1}) as log:
        assert log.done == {0: STEPS[0]}
        log.append(STEPS[1])
        log.append(STEPS[2])
    with StepLog(tmp_path / "new", {"a": 1}) as log:
        assert log.steps() == STEPS


def test_a_log_of_another_replay_is_not_mixed_with_this_one(tmp_path: Path) -> None:
    with StepLog(tmp_path, {"map_version": 1, "domain": "d"}) as log:
        log.append(STEPS[0])
    with pytest.raises(ReplayError, match="map_version 1, now 2"):
        StepLog(tmp_path, {"map_version": 2, "domain": "d"})
    with StepLog(tmp_path, {"map_version": 2, "domain": "d"}, restart=True) as log:
        assert log.done == {}


@pytest.mark.parametrize("damage", [b"{}\n", b"\0\0\n", b"[]\n", b"\xff\n"])
def test_a_log_with_a_damaged_line_is_named(tmp_path: Path, damage: bytes) -> None:
    StepLog(tmp_path, {}).close()
    (tmp_path / "steps.jsonl").write_bytes(damage)
    with pytest.raises(ReplayError, match="line 1"):
        StepLog(tmp_path, {})


@pytest.mark.parametrize("damage", [b"", b"\0\0\0", b"[]"])
def test_a_folder_whose_identity_is_damaged(tmp_path: Path, damage: bytes) -> None:
    (tmp_path / "replay.json").write_bytes(damage)
    with pytest.raises(ReplayError):
        StepLog(tmp_path, {"a": 1})


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ReplayError, match="cannot write"):
        StepLog(tmp_path / "file" / "below", {})


def test_heat_keeps_the_best_of_every_stretch_and_survives(tmp_path: Path) -> None:
    path = tmp_path / "heat.npy"
    n_images, n_queries = 4000, 2500
    heat = RelevanceHeat.open(path, n_queries, n_images, go_on=False)
    assert heat.every == math.ceil(n_queries / 1200)
    relevance = np.zeros(n_images, np.float32)
    relevance[1234] = 1.0
    heat.add(0, relevance)
    heat.add(1, relevance)  # has no row
    heat.flush()
    again = RelevanceHeat.open(path, n_queries, n_images, go_on=True)
    assert again.values[0].argmax() == again.column_of[1234]
    assert np.isnan(again.values[1:]).all()
    path.write_bytes(b"torn")
    assert np.isnan(RelevanceHeat.open(path, n_queries, n_images, go_on=True).values).all()
