"""The remap's section shows for every limit whether it is kept."""

from dataclasses import replace

import pytest

from bench.measurement import Limit, breaches
from bench.remap import RemapFigures, Remapped, RemapSize, report
from bench.robots import LiveRobot, Waits

STAGES = dict.fromkeys(("read_frames", "select_landmarks", "describe", "train", "check"), 1.0)
CALM = Waits([0.010] * 100, [], [1])


@pytest.fixture
def figures():
    robots = [LiveRobot("ranks", "bench", [b"{}"]), LiveRobot("pictures", "camera", [b""], "image/jpeg")]
    during = Waits([0.012] * 100, [], [1, 2])
    return RemapFigures(RemapSize(), Remapped(50.0, STAGES), Remapped(110.0, STAGES), robots, [CALM] * 2, [during] * 2)


def test_kept_limits_are_all_passed(figures):
    lines = list(report(figures))
    assert len([line for line in lines if line.endswith("| PASS |")]) == 8
    assert "| pictures: median ratio | 1.5 | 1.2 | PASS |" in lines
    assert "| ranks | 10 ms, 10 ms (100) | 12 ms, 12 ms (100) | 0 of 200 | 1 then 2 |" in lines
    assert breaches(figures.limits()) is None


@pytest.mark.parametrize(
    ("changes", "over"),
    [
        ({"alone": Remapped(61.0, STAGES)}, "remap, seconds: 61, at most 60"),
        ({"during": [CALM, Waits([0.016] * 100, [], [1])]}, "pictures: median ratio: 1.6, at most 1.5"),
        ({"during": [Waits([0.01] * 98 + [0.04] * 2, [], [1]), CALM]}, "ranks: p99 ratio: 4, at most 3"),
        ({"during": [CALM, Waits([0.01], ["503 overloaded"], [1])]}, "pictures: failures: 1, at most 0"),
    ],
)
def test_what_is_over_is_said(figures, changes, over):
    broken = replace(figures, **changes)
    assert len([line for line in report(broken) if line.endswith("| **over** |")]) == 1
    assert breaches(broken.limits()) == f"over the limit: {over}"


def test_a_figure_that_could_not_be_taken_is_over():
    assert breaches([Limit("ratio", float("nan"), 3.0)]) == "over the limit: ratio: nan, at most 3"
