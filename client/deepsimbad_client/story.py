"""One view of an active episode in words, and as a picture in a terminal."""

from collections.abc import Sequence

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from deepsimbad_client.episode_log import EpisodeStep
from deepsimbad_client.http.models import Belief, NextBestView

BLOCKS = " ▁▂▃▄▅▆▇█"
_LEAST_SHOWN = 0.004
"""A column with a smaller share of the fullest one stays empty."""


def told(step: EpisodeStep) -> str:
    """What was seen, where the robot believes it is, what it asks for, and the truth: one sentence each."""
    if step.step == 0:
        seen = f"It looks and sees {step.name}."
    else:
        seen = f"Move {step.step}: it goes {step.action_m:.1f} m (asked: {step.commanded_m:g} m) and sees {step.name}."
    if step.forgot:
        seen += " Its belief had no room for that move, so it begins anew."
    believes = (
        f"It is likeliest at {step.mode_m:.1f} m, 95 % within {step.low_m:.0f} .. {step.high_m:.0f} m, "
        f"{step.entropy_bits:.1f} bits of doubt."
    )
    if step.true_route_m is None or step.error_m is None:
        truth = "Truly it is where the map knows no place."
    else:
        truth = f"Truly it is by {step.true_route_m:.1f} m, on the ground {step.error_m:.1f} m from there."
    asks = "" if step.next_action_m is None else f" It asks to see what is {step.next_action_m:g} m ahead."
    return f"{seen} {believes} {truth}{asks}"


def belief_blocks(mass: Sequence[float], width: int) -> str:
    """The belief along the route as one line of blocks, as high as its fullest column."""
    columns = resampled(mass, width)
    most = columns.max()
    if most <= 0:
        return " " * width
    share = columns / most
    heights = np.where(share < _LEAST_SHOWN, 0, 1 + (np.sqrt(share) * (len(BLOCKS) - 1) - 1e-9).astype(int))
    return "".join(BLOCKS[min(height, len(BLOCKS) - 1)] for height in heights)


def resampled(mass: Sequence[float], width: int) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
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
    """A session as a terminal shows it: the belief along the route, the likeliest places, the last move and the next.

    Args:
        heading: Which session of what.
        belief: What it believes.
        next_best_view: What it asks for.
        width: Columns of the terminal.
        n_observations: Views so far.
        moved_m: The last move, where known.
        true_route_m: Where the robot truly is along the map's route, where known.
    """
    columns = max(20, width - 4)
    edges_m = belief.histogram.edges_m
    low_m, high_m = edges_m[0], edges_m[-1]
    marks = [" "] * columns
    for place_m, mark in ((belief.mode_m, "▲"), (true_route_m, "●")):
        if place_m is not None and high_m > low_m:
            marks[int(np.clip((place_m - low_m) / (high_m - low_m) * columns, 0, columns - 1))] = mark
    ends = f"{low_m:.0f} m".ljust(columns - len(f"{high_m:.0f} m")) + f"{high_m:.0f} m"
    low, high = belief.credible_95_m
    figures = Table.grid(padding=(0, 3))
    figures.add_row("likeliest", f"{belief.mode_m:.1f} m", "95 % within", f"{low:.0f} .. {high:.0f} m")
    figures.add_row("doubt", f"{belief.entropy_bits:.1f} bits", "off the route", _percent(belief.off_route))
    figures.add_row("views", str(n_observations), "last move", "-" if moved_m is None else f"{moved_m:.1f} m")
    asked = "-" if next_best_view is None else f"{next_best_view.action_m:g} m ({next_best_view.planner})"
    truth = "-" if true_route_m is None else f"{true_route_m:.1f} m"
    figures.add_row("asks for", asked, "truly at", truth)
    places = Table("place [m]", "mass", box=None, padding=(0, 3), header_style="dim")
    for place in belief.top[:5]:
        places.add_row(f"{place.route_position_m:.1f}", f"{100 * place.mass:.1f} %")
    known = "▲ likeliest" + ("" if true_route_m is None else "   ● truth")
    return Group(
        Text(heading, style="bold"),
        Text(),
        Text(belief_blocks(belief.histogram.mass, columns), style="magenta"),
        Text("".join(marks), style="cyan"),
        Text(ends, style="dim"),
        Text(known, style="dim"),
        Text(),
        figures,
        Text(),
        places,
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"
