"""A session shown live in a terminal, driven along a recording or by another robot: in words or as a picture."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from deepsimbad_client.errors import GoneError
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Belief, NextBestView, SessionState
from deepsimbad_client.replay.active import EpisodeStep, Stage

BLOCKS = " ▁▂▃▄▅▆▇█"
_LEAST_SHOWN = 0.004  # a column with a smaller share of the fullest one stays empty
_LEAST_LOST = 0.05  # probability that is worth a word


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

    Between views it waits `pause_s` seconds, for the eye; the start and the session are drawn by `seed`. Returns the
    steps.
    """
    row, session_seed = stage.start(steps, seed, 0)
    views: list[EpisodeStep] = []
    with stage.scene.session(planner, session_seed) as session, _live(console) as live:
        name = stage.scene.recording.name
        heading = f"{name} against {session.domain}, map {session.map_version}: session {session.session_id}"
        for outcome, step in stage.play(session, row, steps):
            if views:
                sleep(pause_s)
            views.append(step)
            if live is None:
                console.print(describe_step(step), soft_wrap=True)
                continue
            picture = session_picture(
                f"{heading}, {step.name}",
                outcome.answer.belief,
                outcome.answer.next_best_view,
                console.width,
                n_observations=step.step + 1,
                moved_m=step.action_m if step.step else None,
                true_route_m=step.true_route_m,
            )
            live.update(picture, refresh=True)
    return views


def watch_session(
    client: Client, session_id: str, console: Console, *, every_s: float, sleep: Callable[[float], None] = time.sleep
) -> int:
    """Show a session that another robot drives, until it ends; returns how many changes were shown.

    Raises UnknownSessionError, GoneError (it had ended before).
    """
    session = client.attach_session(session_id)
    state, shown_belief, n_changes = session.opened, None, 0
    with _live(console) as live:
        while True:
            if (state.n_observations, state.belief) != shown_belief:
                n_changes += 1
                shown_belief = (state.n_observations, state.belief)
                _show(state, console, live)
            sleep(every_s)
            try:
                state = session.state()
            except GoneError:
                return n_changes


def _show(state: SessionState, console: Console, live: Live | None) -> None:
    belief = state.belief
    if live is not None:
        heading = f"{state.domain}, map {state.map_version}: session {state.session_id}"
        picture = session_picture(
            heading, belief, state.next_best_view, console.width, n_observations=state.n_observations
        )
        live.update(picture, refresh=True)
        return
    belief_text = _belief_text(
        belief.mode_m, *belief.credible_95_m, belief.entropy_bits, belief.off_route, belief.confident
    )
    request = "" if state.next_best_view is None else f", asks for {state.next_best_view.action_m:g} m"
    views = "1 view" if state.n_observations == 1 else f"{state.n_observations} views"
    console.print(f"{views}: {belief_text}{request}", soft_wrap=True)


@contextmanager
def _live(console: Console) -> Iterator[Live | None]:
    """A moving picture, whose last state stays; None where no terminal can show one."""
    if not console.is_interactive:
        yield None
        return
    with Live(console=console, auto_refresh=False) as live:
        yield live


def describe_step(step: EpisodeStep) -> str:
    """A step in sentences: the view, where the robot believes it is, the truth, and the move it asks for."""
    if step.step == 0:
        view_text = f"It looks and sees {step.name}."
    else:
        view_text = (
            f"Move {step.step}: it goes {step.action_m:.1f} m (asked: {step.commanded_m:g} m) and sees {step.name}."
        )
    if step.forgot:
        view_text += " Its belief had no room for that move, so it begins anew."
    belief_text = _belief_text(step.mode_m, step.low_m, step.high_m, step.entropy_bits, step.off_route, step.confident)
    if step.true_route_m is None or step.error_m is None:
        truth_text = "Truly it is where the map knows no place."
    else:
        truth_text = f"Truly it is by {step.true_route_m:.1f} m, on the ground {step.error_m:.1f} m from there."
    return f"{view_text} It is {belief_text}. {truth_text}{_request_text(step.next_action_m)}"


def _request_text(action_m: float | None) -> str:
    if action_m is None:
        return ""
    if action_m == 0:
        return " It asks to look again from where it is."
    return f" It asks to see what is {abs(action_m):g} m {'ahead' if action_m > 0 else 'behind'}."


def _belief_text(
    mode_m: float, low_m: float, high_m: float, entropy_bits: float, off_route: float | None, confident: bool
) -> str:
    lost = "" if off_route is None or off_route < _LEAST_LOST else f", lost with {100 * off_route:.0f} %"
    return (
        f"likeliest at {mode_m:.1f} m, 95 % within {low_m:.0f} .. {high_m:.0f} m, {entropy_bits:.1f} bits of doubt"
        f"{lost}{', confident' if confident else ''}"
    )


def belief_blocks(mass: Sequence[float], width: int) -> str:
    """The belief along the route as one line of blocks; the fullest column has the highest block."""
    columns = resampled(mass, width)
    peak = columns.max()
    if peak <= 0:
        return " " * width
    share = columns / peak
    heights = np.where(share < _LEAST_SHOWN, 0, 1 + (np.sqrt(share) * (len(BLOCKS) - 1) - 1e-9).astype(int))
    return "".join(BLOCKS[min(height, len(BLOCKS) - 1)] for height in heights)


def resampled(mass: Sequence[float], width: int) -> NDArray[np.float64]:
    """A histogram's masses in `width` equal columns, [width] float64 with the same sum."""
    total = np.concatenate([[0.0], np.cumsum(np.asarray(mass, np.float64))])
    edges = np.linspace(0, len(mass), width + 1)
    return np.asarray(np.diff(np.interp(edges, np.arange(len(total)), total)))


def session_picture(
    heading: str,
    belief: Belief,
    next_best_view: NextBestView | None,
    width: int,
    *,
    n_observations: int,
    moved_m: float | None = None,
    true_route_m: float | None = None,
) -> Group:
    """A session for a terminal of `width` columns: the belief along the route, the last move and the next.

    The last move and the true place along the map's route are shown where known.
    """
    columns = max(20, width - 4)
    edges_m = belief.histogram.edges_m
    low_m, high_m = edges_m[0], edges_m[-1]
    marks = [" "] * columns
    for place_m, mark in ((belief.mode_m, "▲"), (true_route_m, "●")):
        if place_m is not None and high_m > low_m:
            marks[int(np.clip((place_m - low_m) / (high_m - low_m) * columns, 0, columns - 1))] = mark
    low_end, high_end = f"{low_m:.0f} m", f"{high_m:.0f} m"
    low, high = belief.credible_95_m
    figures = Table.grid(padding=(0, 3))
    figures.add_row("likeliest", f"{belief.mode_m:.1f} m", "95 % within", f"{low:.0f} .. {high:.0f} m")
    lost = "-" if belief.off_route is None else f"{100 * belief.off_route:.0f} %"
    figures.add_row("doubt", f"{belief.entropy_bits:.1f} bits", "lost", lost)
    may_stop = "-" if next_best_view is None else "yes" if next_best_view.stop else "no"
    figures.add_row("confident", "yes" if belief.confident else "no", "may stop", may_stop)
    figures.add_row("views", str(n_observations), "last move", "-" if moved_m is None else f"{moved_m:.1f} m")
    request = "-" if next_best_view is None else f"{next_best_view.action_m:g} m ({next_best_view.planner})"
    truth = "-" if true_route_m is None else f"{true_route_m:.1f} m"
    figures.add_row("asks for", request, "truly at", truth)
    places = Table("place [m]", "mass", box=None, padding=(0, 3), header_style="dim")
    for place in belief.top[:5]:
        places.add_row(f"{place.route_position_m:.1f}", f"{100 * place.mass:.1f} %")
    return Group(
        Text(heading, style="bold"),
        Text(),
        Text(belief_blocks(belief.histogram.mass, columns), style="magenta"),
        Text("".join(marks), style="cyan"),
        Text(low_end.ljust(columns - len(high_end)) + high_end, style="dim"),
        Text("▲ likeliest" + ("" if true_route_m is None else "   ● truth"), style="dim"),
        Text(),
        figures,
        Text(),
        places,
    )
