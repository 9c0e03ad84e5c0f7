"""A session in a terminal, and an episode in words."""

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from deepsimbad_client import errors
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.replay.active import Stage
from deepsimbad_client.replay.watch import BLOCKS, belief_blocks, resampled, watch_episode, watch_session


def console(*, terminal: bool) -> tuple[Console, io.StringIO]:
    written = io.StringIO()
    return Console(file=written, force_terminal=terminal, width=80, highlight=False, markup=False), written


def test_an_episode_off_a_terminal_is_a_line_for_each_view(fake: Any, drive: Recording) -> None:
    shown, written = console(terminal=False)
    slept: list[float] = []
    with fake.client() as client:
        stage = Stage(client, drive, "route")
        steps = watch_episode(stage, shown, planner="constant:7", steps=4, seed=2, pause_s=0.5, sleep=slept.append)
    lines = written.getvalue().splitlines()
    assert len(lines) == len(steps) == 5
    assert lines[0].startswith(f"It looks and sees {steps[0].name}. It is likeliest at ")
    assert "Move 4: it goes 7.0 m (asked: 7 m)" in lines[4]
    assert all("Truly it is by" in line for line in lines)
    assert slept == [0.5] * 4
    assert all(session.ended for session in fake.sessions.values())


def test_an_episode_on_a_terminal_shows_belief_moves_and_truth(fake: Any, drive: Recording) -> None:
    shown, written = console(terminal=True)
    with fake.client() as client:
        stage = Stage(client, drive, "route")
        steps = watch_episode(stage, shown, planner="default", steps=2, seed=0, pause_s=0, sleep=lambda _: None)
    text = written.getvalue()
    for expected in (
        "▲ likeliest",
        "● truth",
        "asks for",
        "7 m (telling)",
        "session s0",
        "█",
        f"{steps[-1].true_route_m:.1f} m",
    ):
        assert expected in text


def test_another_robots_session_is_watched_until_it_ends(fake: Any) -> None:
    shown, written = console(terminal=False)
    with fake.client() as client:
        robot = client.session("route", keep=True)
        polls = iter(range(100))

        def meanwhile(seconds: float) -> None:
            poll = next(polls)
            if poll in {1, 3}:
                robot.observe(encoding=[50.0 + poll, 3.0], action_m=2)
            if poll == 5:
                robot.delete()

        assert watch_session(client, robot.session_id, shown, every_s=0.1, sleep=meanwhile) == 3
        with pytest.raises(errors.EndedSessionError):
            watch_session(client, robot.session_id, shown, every_s=0.1)
    lines = written.getvalue().splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1", "2"]
    assert "asks for 7 m" in lines[2]


def test_watching_leaves_the_session_alone(fake: Any) -> None:
    shown, written = console(terminal=True)
    with fake.client() as client:
        robot = client.session("route", keep=True)

        def stop(seconds: float) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            watch_session(client, robot.session_id, shown, every_s=0.1, sleep=stop)
    assert not fake.sessions["s0"].ended
    assert "route, map 3: session s0" in written.getvalue()


@given(st.lists(st.floats(0, 1), min_size=1, max_size=200), st.integers(1, 300))
def test_a_histogram_keeps_its_mass_in_other_columns(mass: list[float], width: int) -> None:
    columns = resampled(mass, width)
    assert columns.shape == (width,)
    assert columns.sum() == pytest.approx(sum(mass), abs=1e-9)
    assert (columns >= -1e-12).all()
    assert len(belief_blocks(mass, width)) == width


def test_blocks_are_as_high_as_the_belief() -> None:
    line = belief_blocks([0.0, 0.001, 0.25, 1.0], 4)
    assert line[0] == line[1] == " "
    assert line[3] == BLOCKS[-1]
    assert BLOCKS.index(line[2]) == 4
    assert belief_blocks([0.0, 0.0], 3) == "   "
