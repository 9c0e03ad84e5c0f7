"""A session in a terminal, and an episode in words."""

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from deepsimbad_client import errors
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.active import Stage
from deepsimbad_client.replay.watch import BLOCKS, belief_blocks, resampled, watch_episode, watch_session


def console(*, terminal):
    stream = io.StringIO()
    return Console(file=stream, force_terminal=terminal, width=80, highlight=False, markup=False), stream


@pytest.fixture
def stage(client, encodings):
    return Stage(client, open_source(str(encodings / "winter.npy")), "route")


@pytest.mark.parametrize("kind", [None, "dumb"])
def test_where_no_picture_can_move_an_episode_is_a_line_for_each_view(stage, monkeypatch, kind):
    monkeypatch.setenv("TERM", kind or "xterm")
    screen, stream = console(terminal=kind is not None)
    slept: list[float] = []
    steps = watch_episode(stage, screen, planner="constant:7", steps=4, seed=2, pause_s=0.5, sleep=slept.append)
    lines = stream.getvalue().splitlines()
    assert len(lines) == len(steps) == 5
    assert lines[0].startswith(f"It looks and sees {steps[0].name}. It is likeliest at ")
    assert "Move 4: it goes 7.0 m (asked: 7 m)" in lines[4]
    assert all("Truly it is by" in line for line in lines)
    assert slept == [0.5] * 4


def test_an_episode_on_a_terminal_shows_belief_moves_and_truth(stage, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    screen, stream = console(terminal=True)
    steps = watch_episode(stage, screen, planner="default", steps=2, seed=0, pause_s=0, sleep=lambda _: None)
    figures = ("asks for", "m (informed)", "lost", "confident", "may stop", f"{steps[-1].true_route_m:.1f} m")
    for words in ("▲ likeliest", "● truth", "█", *figures):
        assert words in stream.getvalue()


def test_another_robots_session_is_watched_until_it_ends_and_left_alone(client, views):
    screen, stream = console(terminal=False)
    robot = client.session("route", confidence=0.5, keep=True)
    polls = iter(range(100))

    def meanwhile(seconds):
        poll = next(polls)
        if poll in {1, 3}:
            robot.observe(encoding=views[50 + poll], action_m=2)
        if poll == 5:
            robot.delete()

    assert watch_session(client, robot.session_id, screen, every_s=0.1, sleep=meanwhile) == 3
    with pytest.raises(errors.EndedSessionError):
        watch_session(client, robot.session_id, screen, every_s=0.1)
    lines = stream.getvalue().splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1", "2"]
    assert "asks for" in lines[2]
    assert [", confident" in line for line in lines][::2] == [False, True]
    assert not any(", lost with" in line for line in lines)

    def stop(seconds):
        raise KeyboardInterrupt

    screen, stream = console(terminal=True)
    with client.session("route") as watched:
        with pytest.raises(KeyboardInterrupt):
            watch_session(client, watched.session_id, screen, every_s=0.1, sleep=stop)
        assert watched.state().n_observations == 0
    assert f"route, map 1: session {watched.session_id[:8]}" in stream.getvalue()


def test_the_command(encodings, command, out):
    lines = out("watch", encodings / "winter.npy", "--domain", "route", "--steps", "3", "--pause", "0").splitlines()
    assert len(lines) == 4
    refused = ([], ["--session", "s", "--domain", "route"], ["--session", "nowhere"])
    assert [command("watch", *words).code for words in refused] == [2, 2, 1]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=200), st.integers(1, 300))
def test_a_histogram_keeps_its_mass_in_other_columns(mass, width):
    columns = resampled(mass, width)
    assert columns.shape == (width,)
    assert columns.sum() == pytest.approx(sum(mass), abs=1e-9)
    assert (columns >= -1e-12).all()
    assert len(belief_blocks(mass, width)) == width


def test_blocks_are_as_high_as_the_belief():
    line = belief_blocks([0.0, 0.001, 0.25, 1.0], 4)
    assert line[0] == line[1] == " "
    assert line[3] == BLOCKS[-1]
    assert BLOCKS.index(line[2]) == 4
    assert belief_blocks([0.0, 0.0], 3) == "   "
