"""Show one session live in a terminal: one driven along a recording, or another robot's."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live

from deepsimbad_client.episode_log import EpisodeStep
from deepsimbad_client.errors import GoneError
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import SessionState
from deepsimbad_client.stage import Stage
from deepsimbad_client.story import pictured, told


def watch_episode(
    stage: Stage,
    console: Console,
    *,
    planner: str,
    steps: int,
    seed: int,
    pause_s: float,
    sleep: Callable[[float], None] = time.sleep,
) -> list[EpisodeStep]:
    """Drive one episode and show it as it goes: a moving picture on a terminal, else a line for each view.

    Args:
        stage: What it is played on.
        console: Where it is shown.
        planner: Who chooses the moves.
        steps: How many moves.
        seed: Of the start and the session.
        pause_s: Seconds between views, for the eye.
        sleep: Waits.

    Returns:
        The views.
    """
    row, session_seed = stage.start(steps, seed, 0)
    done: list[EpisodeStep] = []
    with stage.session(planner, session_seed) as session, _live(console) as live:
        name = stage.walk.recording.name
        heading = f"{name} against {session.domain}, map {session.map_version}: session {session.session_id}"
        for seen, step in stage.play(session, row, steps):
            if done:
                sleep(pause_s)
            done.append(step)
            if live is None:
                console.print(told(step), soft_wrap=True)
                continue
            picture = pictured(
                f"{heading}, {step.name}",
                seen.answer.belief,
                seen.answer.next_best_view,
                console.width,
                n_observations=seen.step + 1,
                moved_m=seen.action_m if seen.step else None,
                true_route_m=step.true_route_m,
            )
            live.update(picture, refresh=True)
    return done


def watch_session(
    client: Client,
    session_id: str,
    console: Console,
    *,
    every_s: float,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Show a session that another robot drives, until it ends.

    Args:
        client: The client.
        session_id: The session; it is left as it is.
        console: Where it is shown.
        every_s: Seconds from asking to asking.
        sleep: Waits.

    Returns:
        How many changes were seen.

    Raises:
        UnknownSessionError: There is no such session.
        GoneError: It had ended before.
    """
    session = client.attach_session(session_id)
    state = session.opened
    n_changes = 0
    shown: SessionState | None = None
    with _live(console) as live:
        while True:
            if shown is None or _differs(state, shown):
                n_changes += 1
                shown = state
                _show(state, console, live)
            sleep(every_s)
            try:
                state = session.state()
            except GoneError:
                return n_changes


def _differs(state: SessionState, shown: SessionState) -> bool:
    return state.n_observations != shown.n_observations or state.belief != shown.belief


def _show(state: SessionState, console: Console, live: Live | None) -> None:
    belief = state.belief
    if live is None:
        low, high = belief.credible_95_m
        asked = "" if state.next_best_view is None else f", asks for {state.next_best_view.action_m:g} m"
        views = "1 view" if state.n_observations == 1 else f"{state.n_observations} views"
        console.print(
            f"{views}: likeliest at {belief.mode_m:.1f} m, 95 % within {low:.0f} .. {high:.0f} m, "
            f"{belief.entropy_bits:.1f} bits of doubt{asked}",
            soft_wrap=True,
        )
        return
    heading = f"{state.domain}, map {state.map_version}: session {state.session_id}"
    picture = pictured(heading, belief, state.next_best_view, console.width, n_observations=state.n_observations)
    live.update(picture, refresh=True)


@contextmanager
def _live(console: Console) -> Iterator[Live | None]:
    """A moving picture where there is a terminal; its last state stays."""
    if not console.is_terminal:
        yield None
        return
    with Live(console=console, auto_refresh=False) as live:
        yield live
