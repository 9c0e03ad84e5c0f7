"""Pictures of an active replay, drawn without a screen."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from deepsimbad_client.active_replay import ActiveReplay
from deepsimbad_client.active_report import shown_name
from deepsimbad_client.episode_log import Episode
from deepsimbad_client.map_route import RoutePath
from deepsimbad_client.plot_style import CHANCE, GRID, INK, LINE, QUIET, blank_figure, head, new_figure, quiet, saved

TRUTH = "#35d0ba"
PLANNER_COLOURS = (LINE, CHANCE, "#e0a030", "#5b9a6b", "#8a5fa8", "#4aa3b5", "#a3684a", QUIET)
STRIPS = 3
EDGE = withStroke(linewidth=3, foreground=INK)


def draw_active(replay: ActiveReplay, summary: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw every picture that the replay has numbers for; returns the PNG files."""
    title = f"{replay.identity['recording']}  against  {replay.identity['domain']}"
    first = replay.planners[0]
    shown = replay.episodes[first][:STRIPS]
    drawn = [belief_strips(shown, title, folder / "belief_by_step.png")]
    if any(value is not None for value in summary["anr"].values()):
        drawn += [by_step(summary, title, folder / "by_step.png"), by_distance(summary, title, folder)]
    placed = [each for each in replay.episodes[first] if any(step.x_m is not None for step in each.steps)]
    if replay.route.path.knows_xy and placed:
        drawn.append(walk_map(max(placed, key=_astray_m), replay.route.path, title, folder / "walk.png"))
    return drawn


def belief_strips(episodes: Sequence[Episode], title: str, path: Path) -> Path:
    """Draw what the robot believes after every move, a row for each, with the truth and the next move on it."""
    figure = blank_figure((10.5, 0.9 + 2.9 * len(episodes)))
    rows = np.atleast_1d(np.asarray(figure.subplots(len(episodes), 1, sharex=True)))
    for axes, episode in zip(rows, episodes, strict=True):
        _strip(axes, episode)
    first = episodes[0]
    head(rows[0], f"{title}   planner {shown_name(first.planner, first.planner_named)}", "What the robot believes")
    rows[-1].set_xlabel("along the map's route [m]")
    rows[-1].plot([], [], color=TRUTH, marker="o", ms=5, mfc="none", lw=0, label="where it truly is")
    rows[-1].plot([], [], color=QUIET, marker="|", ms=9, mew=1.6, lw=0, label="likeliest place")
    rows[-1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.24), ncol=2, frameon=False, fontsize=9)
    return saved(figure, path)


def _strip(axes: Axes, episode: Episode) -> None:
    masses = np.array([step.mass for step in episode.steps])
    low_m, high_m = episode.edges_m
    n_rows = len(masses)
    axes.imshow(
        masses,
        aspect="auto",
        cmap="magma",
        norm=PowerNorm(0.4, vmin=0, vmax=max(float(masses.max()), 1e-6)),
        interpolation="nearest",
        extent=(low_m, high_m, n_rows, 0),
    )
    quiet(axes)
    axes.grid(visible=False)
    middles = np.arange(n_rows) + 0.5
    true_m = [np.nan if step.true_route_m is None else step.true_route_m for step in episode.steps]
    mode_m = [step.mode_m for step in episode.steps]
    axes.scatter(mode_m, middles, marker="|", s=90, color="white", lw=1.8, zorder=3, path_effects=[EDGE])
    axes.scatter(true_m, middles, s=34, facecolors="none", edgecolors=TRUTH, lw=1.5, zorder=4, path_effects=[EDGE])
    axes.set_yticks(middles, [str(step.step) for step in episode.steps], fontsize=8)
    axes.set_ylabel(f"episode {episode.episode}\nviews after moves", color=INK, fontsize=9)
    axes.set_xlim(low_m, high_m)
    for step, middle in zip(episode.steps[:-1], middles, strict=False):
        if step.next_action_m is not None:
            axes.annotate(
                f"+{step.next_action_m:g} m",
                (1.008, 1 - (middle + 0.5) / n_rows),
                xycoords="axes fraction",
                fontsize=8,
                color=QUIET,
                va="center",
                annotation_clip=False,
            )


def by_step(summary: Mapping[str, Any], title: str, path: Path) -> Path:
    """Draw how rank, error and the share localized go on from move to move, with 95 % bands."""
    figure = blank_figure((13.5, 4.9))
    panels = figure.subplots(1, 3)
    head(panels[0], title, "From move to move")
    views = [
        ("anr", "anr_interval_95", "map images placed before the truth [%]"),
        ("error_m", "error_interval_95", "mean error of the likeliest place [m]"),
        ("within_5_m", "within_5_m_interval_95", "episodes localized within 5 m [%]"),
    ]
    for axes, (figure_name, interval, label) in zip(panels, views, strict=True):
        quiet(axes)
        for name, colour in _colours(summary):
            steps = summary["by_step"][name]
            _banded(axes, range(len(steps[figure_name])), steps[figure_name], steps[interval], colour, name, summary)
        axes.set_ylabel(label, color=INK)
        axes.set_xlabel("moves made")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[2].set_ylim(0, 103)
    _below(figure, panels[1])
    return saved(figure, path)


def by_distance(summary: Mapping[str, Any], title: str, folder: Path) -> Path:
    """Draw rank and error against the metres travelled: a planner that moves far has no advantage here."""
    figure = blank_figure((9.6, 4.9))
    panels = figure.subplots(1, 2)
    head(panels[0], title, "At equal distance travelled")
    views = [
        ("anr", "anr_interval_95", "map images placed before the truth [%]"),
        ("error_m", "error_interval_95", "mean error of the likeliest place [m]"),
    ]
    for axes, (figure_name, interval, label) in zip(panels, views, strict=True):
        quiet(axes)
        for name, colour in _colours(summary):
            at = summary["by_distance"][name]
            _banded(axes, at["travelled_m"], at[figure_name], at[interval], colour, name, summary)
        axes.set_ylabel(label, color=INK)
        axes.set_xlabel("metres travelled")
        axes.set_ylim(bottom=0)
    _below(figure, panels[0])
    return saved(figure, folder / "by_distance.png")


def walk_map(episode: Episode, route: RoutePath, title: str, path: Path) -> Path:
    """Draw the route from above with one episode's walk on it, joined to where the belief put it."""
    steps = [step for step in episode.steps if step.x_m is not None and step.y_m is not None]
    x, y = (np.array([getattr(step, name) for step in steps], float) for name in ("x_m", "y_m"))
    figure, axes = new_figure(title, f"A walk and where it was believed to be (episode {episode.episode})", (8.6, 7.2))
    axes.plot(route.x_m, route.y_m, color="#d5dce1", lw=5, solid_capstyle="round", zorder=1, label="map")
    wrong = [[(step.x_m, step.y_m), (step.mode_x_m, step.mode_y_m)] for step in steps if step.mode_x_m is not None]
    axes.add_collection(LineCollection(wrong, colors=CHANCE, linewidths=1, alpha=0.6, zorder=2))  # type: ignore[arg-type]
    axes.plot([], [], color=CHANCE, lw=1, label="from the truth to the likeliest place")
    axes.plot(x, y, color=LINE, lw=1, zorder=3)
    dots = axes.scatter(
        x, y, c=[step.entropy_bits for step in steps], s=70, cmap="viridis_r", edgecolors="white", lw=1, zorder=4
    )
    modes = [(step.mode_x_m, step.mode_y_m) for step in steps if step.mode_x_m is not None]
    if modes:
        mode_x, mode_y = zip(*modes, strict=True)
        axes.scatter(mode_x, mode_y, marker="x", s=26, color=CHANCE, lw=1.2, zorder=3)
    for step in (steps[0], steps[-1]):
        axes.annotate(
            "start" if step is steps[0] else f"after {step.step} moves",
            (step.x_m or 0.0, step.y_m or 0.0),
            xytext=(8, 8),
            textcoords="offset points",
            fontsize=9,
            color=INK,
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    bar = figure.colorbar(dots, ax=axes, pad=0.02, shrink=0.85)
    bar.set_label("doubt left in the belief [bits]", color=INK)
    bar.outline.set_visible(False)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncol=2, frameon=False, fontsize=9)
    return saved(figure, path)


def _astray_m(episode: Episode) -> float:
    """How far off the belief was in all: the walk that was hardest to find out about is the one worth a picture."""
    return sum(step.error_m or 0.0 for step in episode.steps)


def _colours(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Planners and their colours, the first one last so that it is drawn on top."""
    names = summary["config"]["planners"]
    coloured = [(name, PLANNER_COLOURS[at % len(PLANNER_COLOURS)]) for at, name in enumerate(names)]
    return coloured[1:] + coloured[:1]


def _banded(
    axes: Axes,
    at: Sequence[float],
    values: Sequence[float | None],
    intervals: Sequence[Sequence[float] | None],
    colour: str,
    name: str,
    summary: Mapping[str, Any],
) -> None:
    known = [(x, y, ends or (y, y)) for x, y, ends in zip(at, values, intervals, strict=True) if y is not None]
    if not known:
        return
    x, y, ends = zip(*known, strict=True)
    first = name == summary["config"]["planners"][0]
    low, high = np.array(ends).T
    axes.fill_between(x, low, high, color=colour, alpha=0.16, lw=0)
    axes.plot(
        x,
        y,
        color=colour,
        lw=2.4 if first else 1.6,
        marker="o",
        ms=4 if first else 3,
        label=shown_name(name, summary["planner_named"][name]),
    )


def _below(figure: Figure, axes: Axes) -> None:
    """One legend for all panels, below them."""
    handles, labels = axes.get_legend_handles_labels()
    handles, labels = handles[-1:] + handles[:-1], labels[-1:] + labels[:-1]
    made = figure.legend(
        handles, labels, loc="outside lower center", ncol=min(6, len(labels)), frameon=False, fontsize=9
    )
    made.get_frame().set_edgecolor(GRID)
