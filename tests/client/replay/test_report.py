"""Figures, intervals and tables of active replays, against slow references."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from deepsimbad_client.replay.active import ActiveReplay, Episode, EpisodeStep
from deepsimbad_client.replay.plots import draw_active
from deepsimbad_client.replay.report import active_tables, interval_95, summarise_active


def step(number, rank, action_m, travelled_m):
    place, error_m = 10.0 + travelled_m, None if rank is None else 2 * rank
    values = {
        "step": number,
        "action_m": action_m,
        "travelled_m": travelled_m,
        "forgot": False,
        "latency_ms": 2.0,
        "x_m": place,
        "y_m": 1.0,
        "true_route_m": None if rank is None else place,
        "next_action_m": action_m,
        "rank": rank,
        "rank_percent": rank,
        "error_m": error_m,
        "entropy_bits": 5.0 - number,
        "mode_m": place + (error_m or 0),
    }
    unknown = dict.fromkeys(field.name for field in fields(EpisodeStep))
    return EpisodeStep(**unknown | values | {"mass": (0.25, 0.5, 0.125, 0.125)})


def episode(planner, number, ranks, action_m):
    steps = tuple(
        step(n_moves, rank, action_m if n_moves else 0.0, n_moves * action_m) for n_moves, rank in enumerate(ranks)
    )
    return Episode(planner, "informed" if planner == "default" else planner, number, number, (0.0, 99.0), steps)


def replay_of(**ranks):
    """A replay of planners' ranks [episode][step]; `default` moves 2 m, the others 5 m."""
    moves = {name: 2.0 if name == "default" else 5.0 for name in ranks}
    episodes = {
        name: [episode(name, number, row, moves[name]) for number, row in enumerate(rows)]
        for name, rows in ranks.items()
    }
    identity: dict[str, Any] = {
        "recording": "drive",
        "domain": "route",
        "map_version": 1,
        "steps": 2,
        "seed": 0,
        "n_map_images": 100,
    }
    return ActiveReplay(Path(), tuple(ranks), episodes, identity | {"planners": list(ranks)}, 1.0)


@pytest.fixture
def two_planners():
    return replay_of(default=[[50.0, 1.0, 2.0], [40.0, 3.0, None]], random=[[50.0, 8.0, 6.0], [40.0, 3.0, 3.0]])


def test_figures_by_hand(two_planners):
    summary = summarise_active(two_planners)
    assert summary["anr"] == {"default": 2.0, "random": 5.0}  # the first view does not count
    assert summary["n_frames"] == {"default": 3, "random": 4}
    assert summary["n_left_out"] == {"default": 1, "random": 0}
    assert summary["against"]["random"]["anr"] == -3.0
    low, high = summary["against"]["random"]["interval_95"]
    assert low < -3 < high == 0.0
    by_step = summary["by_step"]["default"]
    assert by_step["anr"] == [45.0, 2.0, 2.0]
    assert by_step["error_m"] == [90.0, 4.0, 4.0]
    assert by_step["within_5_m"] == [0.0, 50.0, 100.0]
    assert by_step["within_10_m"] == [0.0, 100.0, 100.0]
    assert by_step["travelled_m"] == [0.0, 2.0, 4.0]
    assert summary["planner_named"] == {"default": "informed", "random": "random"}
    json.dumps(summary, allow_nan=False)


def test_intervals_against_a_bootstrap_by_hand():
    rng = np.random.default_rng(3)
    first, second = rng.normal(0, 1, (30, 4)), rng.normal(0.5, 1, (30, 4))
    first[3, 2] = np.nan
    drawn = []
    for _ in range(4000):
        rows = rng.integers(30, size=30)
        drawn.append(np.nanmean(first[rows]) - np.nanmean(second[rows]))
    expected = np.percentile(drawn, [2.5, 97.5])
    assert interval_95(first - second) == pytest.approx(list(expected), abs=0.03)
    assert interval_95(first) == interval_95(first)


def test_pairing_takes_out_what_the_starts_have_in_common():
    rng = np.random.default_rng(0)
    start = rng.normal(0, 10, (50, 1))
    paired = interval_95(start + 1.0 - start)
    alone = interval_95(start)
    assert paired == pytest.approx([1.0, 1.0])
    assert alone is not None
    assert alone[1] - alone[0] > 3


def test_nothing_known_is_none_and_never_nan(tmp_path):
    replay = replay_of(default=[[None, None, None]], random=[[None, None, None]])
    summary = summarise_active(replay)
    json.dumps(summary, allow_nan=False)
    assert summary["anr"] == {"default": None, "random": None}
    assert summary["interval_95"]["default"] is None
    assert summary["against"]["random"] == {"anr": None, "interval_95": None}
    for table in active_tables(summary):
        Console(quiet=True).print(table)
    assert len(draw_active(replay, summary, tmp_path)) == 1


def test_tables_name_every_planner_and_every_picture_is_drawn(two_planners, tmp_path, capsys):
    summary = summarise_active(two_planners)
    console = Console(width=80)
    for table in active_tables(summary):
        console.print(table)
    printed = capsys.readouterr().out
    assert printed.count("informed (default)") == 2
    assert printed.count("random") == 2
    assert "3.00" in printed  # how much better the first is
    assert "…" not in printed
    drawn = draw_active(two_planners, summary, tmp_path)
    assert [path.name for path in drawn] == ["belief_by_step.png", "by_step.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in drawn)
