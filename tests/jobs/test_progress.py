"""Stages of known weight become one share of the whole."""

import pytest

from deepsimbad.errors import CancelledError
from deepsimbad.jobs.progress import Progress


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s

    def wait(self, seconds):
        self.now_s += seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def states():
    return []


def test_a_stage_counts_by_its_weight(clock, states):
    progress = Progress({"read": 1.0, "nothing": 1.0, "work": 2.0}, states.append, clock=clock)
    progress.stage("read")
    clock.wait(1)
    progress.update(0.5)
    progress.stage("work")  # what is left out counts as done
    for share in (0.5, 1.0):
        clock.wait(1)
        progress.update(share)
    assert [(state.stage, state.progress) for state in states] == [
        ("read", 0.0),
        ("read", 0.125),
        ("work", 0.5),
        ("work", 0.75),
        ("work", 1.0),
    ]
    clock.wait(3)
    assert progress.seconds({"read", "work"}) == {"read": 1.0, "work": 5.0}


def test_the_time_left_is_that_spent_per_share(clock, states):
    progress = Progress({"work": 1.0}, states.append, clock=clock)
    progress.stage("work")
    assert states[-1].eta_s is None
    clock.wait(9)
    progress.update(0.005)
    assert states[-1].eta_s is None, "too early to tell"
    clock.wait(1)
    progress.update(0.25)
    assert states[-1].eta_s == pytest.approx(30.0)
    clock.wait(1)
    progress.update(1.0)
    assert states[-1].eta_s == pytest.approx(0.0)


def test_a_stage_that_takes_longer_than_expected_tells_so_by_its_own_pace(clock, states):
    progress = Progress({"select": 6.0, "train": 3.0, "seal": 1.0}, states.append, clock=clock)
    progress.stage("select")
    clock.wait(6)
    progress.stage("train")
    assert states[-1].eta_s == pytest.approx(4.0), "nothing is known of it yet but its weight"
    clock.wait(30)
    progress.update(0.1)
    assert states[-1].eta_s == pytest.approx(270 + 36 / 0.63 * 0.1)


def test_within_a_stage_it_is_told_now_and_then_but_every_stage_is(clock, states):
    progress = Progress({"read": 1.0, "work": 1.0}, states.append, clock=clock)
    progress.stage("read")
    for _ in range(10):
        clock.wait(0.06)
        progress.update(0.5)
    progress.stage("work")
    assert [state.stage for state in states] == ["read", "read", "read", "work"]
    with pytest.raises(ValueError, match="wrok"):
        progress.stage("wrok")


def test_cancelling_stops_the_work_at_its_next_report_even_one_that_is_not_told(clock, states):
    commands = []
    progress = Progress({"work": 1.0}, states.append, lambda: bool(commands), clock=clock)
    progress.check()
    progress.stage("work")
    progress.update(0.1)
    commands.append("cancel")
    with pytest.raises(CancelledError, match="cancelled while it was at: work"):
        progress.update(0.2)
    with pytest.raises(CancelledError):
        progress.check()
    assert len(states) == 1
