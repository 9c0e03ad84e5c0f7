"""Show one session live in a terminal, one driven along a recording or another robot's: in words or as a picture."""

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
_LEAST_SHOWN = 0.004  # A column with a smaller share of the fullest one stays empty
_LEAST_LOST = 0.05


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

    Between views it waits `pause_s` seconds, for the eye; `seed` is that of the start and the session.
    """
    row, session_seed = stage.start(steps, seed, 0)
    views: list[EpisodeStep] = []
    with stage.scene.session(planner, session_seed) as session, _live(console) as live:
        name = stage.scene.recording.name
        heading = f"{name} against {session.domain}, map {session.map_version}: session {session.session_id}"
        for seen, step in stage.play(session, row, steps):
            if views:
                sleep(pause_s)
            views.append(step)
            if live is None:
                console.print(in_words(step), soft_wrap=True)
                continue
            picture = pictured(
                f"{heading}, {step.name}",
                seen.answer.belief,
                seen.answer.next_best_view,
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
    """Show a session that another robot drives, until it ends; it is left as it is. Returns how many changes were seen.

    Raises UnknownSessionError, GoneError (it had ended before).
    """
    session = client.attach_session(session_id)
    state, shown, n_changes = session.opened, None, 0
    with _live(console) as live:
        while True:
            if (state.n_observations, state.belief) != shown:
                n_changes += 1
                shown = (state.n_observations, state.belief)
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
        picture = pictured(heading, belief, state.next_best_view, console.width, n_observations=state.n_observations)
        live.update(picture, refresh=True)
        return
    low, high = belief.credible_95_m
    asked = "" if state.next_best_view is None else f", asks for {state.next_best_view.action_m:g} m"
    views = "1 view" if state.n_observations == 1 else f"{state.n_observations} views"
    console.print(
        f"{views}: likeliest at {belief.mode_m:.1f} m, 95 % within {low:.0f} .. {high:.0f} m, "
        f"{belief.entropy_bits:.1f} bits of doubt{_lost(belief.off_route)}"
        f"{', confident' if belief.confident else ''}{asked}",
        soft_wrap=True,
    )


@contextmanager
def _live(console: Console) -> Iterator[Live | None]:
    """A moving picture where there is a terminal that can show it; its last state stays."""
    if not console.is_interactive:
        yield None
        return
    with Live(console=console, auto_refresh=False) as live:
        yield live


def in_words(step: EpisodeStep) -> str:
    """What was seen, where the robot believes it is, what it asks for, and the truth: one sentence each."""
    if step.step == 0:
        seen = f"It looks and sees {step.name}."
    else:
        seen = f"Move {step.step}: it goes {step.action_m:.1f} m (asked: {step.commanded_m:g} m) and sees {step.name}."
    if step.forgot:
        seen += " Its belief had no room for that move, so it begins anew."
    believes = (
        f"It is likeliest at {step.mode_m:.1f} m, 95 % within {step.low_m:.0f} .. {step.high_m:.0f} m, "
        f"{step.entropy_bits:.1f} bits of doubt{_lost(step.off_route)}{', confident' if step.confident else ''}."
    )
    if step.true_route_m is None or step.error_m is None:
        truth = "Truly it is where the map knows no place."
    else:
        truth = f"Truly it is by {step.true_route_m:.1f} m, on the ground {step.error_m:.1f} m from there."
    return f"{seen} {believes} {truth}{_asks(step.next_action_m)}"


def _asks(action_m: float | None) -> str:
    if action_m is None:
        return ""
    if action_m == 0:
        return " It asks to look again from where it is."
    return f" It asks to see what is {abs(action_m):g} m {'ahead' if action_m > 0 else 'behind'}."


def _lost(probability: float | None) -> str:
    """How probable it is that the robot is off its route or was carried, where that is worth a word."""
    return "" if probability is None or probability < _LEAST_LOST else f", lost with {100 * probability:.0f} %"


def belief_blocks(mass: Sequence[float], width: int) -> str:
    """The belief along the route as one line of blocks, as high as its fullest column."""
    columns = resampled(mass, width)
    most = columns.max()
    if most <= 0:
        return " " * width
    share = columns / most
    heights = np.where(share < _LEAST_SHOWN, 0, 1 + (np.sqrt(share) * (len(BLOCKS) - 1) - 1e-9).astype(int))
    return "".join(BLOCKS[min(height, len(BLOCKS) - 1)] for height in heights)


def resampled(mass: Sequence[float], width: int) -> NDArray[np.float64]:
    """A histogram's masses in another number of equal columns; the sum stays."""
    total = np.concatenate([[0.0], np.cumsum(np.asarray(mass, np.float64))])
    at = np.linspace(0, len(mass), width + 1)
    return np.asarray(np.diff(np.interp(at, np.arange(len(total)), total)))


def pictured(
    heading: str,
    belief: Belief,
    next_best_view: NextBestView | None,
    width: int,
    *,
    n_observations: int,
    moved_m: float | None = None,
    true_route_m: float | None = None,
) -> Group:
    """A session as a terminal of `width` columns shows it: the belief along the route, the last move and the next.

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
    asked = "-" if next_best_view is None else f"{next_best_view.action_m:g} m ({next_best_view.planner})"
    truth = "-" if true_route_m is None else f"{true_route_m:.1f} m"
    figures.add_row("asks for", asked, "truly at", truth)
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
