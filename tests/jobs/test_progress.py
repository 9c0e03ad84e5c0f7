"""Stages of known weight become one share of the whole."""

import pytest

from deepsimbad.errors import CancelledError
from deepsimbad.jobs.progress import Progress


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def seen():
    return []


def test_a_stage_counts_by_its_weight(clock, seen):
    progress = Progress({"read": 1.0, "work": 3.0}, seen.append, interval_s=0, clock=clock)
    progress.stage("read")
    progress.update(0.5)
    progress.stage("work")
    progress.update(0.5)
    progress.update(1.0)
    assert [(state.stage, state.progress) for state in seen] == [
        ("read", 0.0),
        ("read", 0.125),
        ("work", 0.25),
        ("work", 0.625),
        ("work", 1.0),
    ]


def test_a_stage_left_out_counts_as_done(clock, seen):
    progress = Progress({"read": 1.0, "work": 3.0}, seen.append, clock=clock)
    progress.stage("work")
    assert seen[-1].progress == 0.25


def test_the_time_left_is_that_spent_per_share(clock, seen):
    progress = Progress({"work": 1.0}, seen.append, interval_s=0, clock=clock)
    progress.stage("work")
    assert seen[-1].eta_s is None
    clock.now_s += 10
    progress.update(0.005)
    assert seen[-1].eta_s is None, "too early to tell"
    progress.update(0.25)
    assert seen[-1].eta_s == pytest.approx(30.0)
    progress.update(1.0)
    assert seen[-1].eta_s == pytest.approx(0.0)


def test_within_a_stage_it_is_told_at_most_so_often_but_every_stage_is(clock, seen):
    progress = Progress({"read": 1.0, "work": 1.0}, seen.append, interval_s=0.2, clock=clock)
    progress.stage("read")
    for _ in range(10):
        clock.now_s += 0.05
        progress.update(0.5)
    progress.stage("work")
    assert [state.stage for state in seen] == ["read", "read", "read", "work"]


def test_cancelling_stops_the_work_at_its_next_report_even_one_that_is_not_told(clock, seen):
    asked = []
    progress = Progress({"work": 1.0}, seen.append, lambda: bool(asked), interval_s=1e9, clock=clock)
    progress.stage("work")
    progress.update(0.1)
    asked.append("cancel")
    with pytest.raises(CancelledError, match="cancelled while it was at: work"):
        progress.update(0.2)
    assert len(seen) == 1


def test_a_stage_that_was_not_announced_is_a_mistake():
    with pytest.raises(ValueError, match="wrok"):
        Progress({"work": 1.0}).stage("wrok")


def test_a_check_raises_and_reports_nothing(seen):
    asked = iter([False, True])
    progress = Progress({"work": 1.0}, seen.append, lambda: next(asked))
    progress.check()
    with pytest.raises(CancelledError):
        progress.check()
    assert seen == []


def test_a_stage_that_takes_longer_than_expected_tells_so_by_its_own_pace(clock, seen):
    progress = Progress({"select": 6.0, "train": 3.0, "seal": 1.0}, seen.append, interval_s=0, clock=clock)
    progress.stage("select")
    clock.now_s += 6
    progress.stage("train")
    assert seen[-1].eta_s == pytest.approx(4.0), "nothing is known of it yet but its weight"
    clock.now_s += 30
    progress.update(0.1)
    assert seen[-1].eta_s == pytest.approx(270 + 36 / 0.63 * 0.1)
    progress.update(1.0)
    assert seen[-1].eta_s == pytest.approx(36 / 0.9 * 0.1)
