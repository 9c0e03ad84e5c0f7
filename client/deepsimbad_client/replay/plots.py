"""Pictures of replays, drawn without a screen."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from deepsimbad_client.replay.active import ActiveReplay, Episode
from deepsimbad_client.replay.passive import Replay, Step
from deepsimbad_client.replay.report import planner_label

INK, QUIET, GRID = "#22303c", "#8a97a3", "#e3e8ec"
DOT, LINE, CHANCE, TRUTH = "#7fa3cf", "#1f4e8c", "#d1495b", "#35d0ba"
PLANNER_COLOURS = (LINE, CHANCE, "#e0a030", "#5b9a6b", "#8a5fa8", "#4aa3b5", "#a3684a", QUIET)
EDGE = withStroke(linewidth=3, foreground=INK)
LEAST_PERCENT = 0.01  # foot of the logarithmic axis of ranks, where a perfect 0 is drawn
PERCENT_TICKS = (0.01, 0.1, 1, 10, 50, 100)
STRIPS = 3
VIEWS = (
    ("anr", "anr_interval_95", "map images placed before the truth [%]"),
    ("error_m", "error_interval_95", "mean error of the likeliest place [m]"),
    ("within_5_m", "within_5_m_interval_95", "episodes localized within 5 m [%]"),
)

Reals = NDArray[np.float64]


def draw_passive(replay: Replay, folder: Path) -> list[Path]:
    """Draw every picture that a passive replay has numbers for; returns the PNG files."""
    scored_steps = [step for step in replay.steps if step.rank_percent is not None]
    if not scored_steps:
        return []
    title = f"{replay.identity['recording']}  against  {replay.identity['domain']}"
    pictures = [
        _rank_along_route(scored_steps, title, folder / "rank_along_route.png"),
        _belief_along_drive(replay, title, folder / "belief_along_drive.png"),
    ]
    if replay.route.x_m is not None and any(step.x_m is not None for step in scored_steps):
        pictures.append(_route_map(replay, scored_steps, title, folder / "route_map.png"))
    return pictures


def draw_active(replay: ActiveReplay, summary: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw every picture that an active replay has numbers for; returns the PNG files."""
    title = f"{replay.identity['recording']}  against  {replay.identity['domain']}"
    pictures = [_belief_strips(replay.episodes[replay.planners[0]][:STRIPS], title, folder / "belief_by_step.png")]
    if any(value is not None for value in summary["anr"].values()):
        pictures.append(_planner_curves(summary, title, folder / "by_step.png"))
    return pictures


def _rank_along_route(scored_steps: Sequence[Step], title: str, path: Path) -> Path:
    """Draw the rank of the truth at every query, with a running median over it."""
    position_m = np.array([step.position_m for step in scored_steps])
    percent = np.array([step.rank_percent for step in scored_steps], np.float64)
    order = np.argsort(position_m, kind="stable")
    figure, axes = _figure(title, "Rank of the true place along the route", (11, 4.6))
    axes.scatter(position_m, np.maximum(percent, LEAST_PERCENT), s=11, color=DOT, alpha=0.75, lw=0, label="query")
    window = max(5, len(scored_steps) // 40) | 1
    ordered_percent, half = percent[order], window // 2
    smooth = np.array(
        [np.median(ordered_percent[max(0, row - half) : row + half + 1]) for row in range(len(ordered_percent))]
    )
    label = f"median of {window} neighbours"
    axes.plot(position_m[order], np.maximum(smooth, LEAST_PERCENT), color=LINE, lw=2, label=label)
    axes.set_yscale("log")
    axes.set_ylim(LEAST_PERCENT * 0.7, 140)
    axes.yaxis.set_major_locator(FixedLocator(PERCENT_TICKS))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: "0" if value <= LEAST_PERCENT else f"{value:g}"))
    axes.axhline(50, color=CHANCE, lw=1.2, ls=(0, (5, 3)), label="chance (50 %)")
    anr = float(percent.mean())
    axes.axhline(max(anr, LEAST_PERCENT), color=INK, lw=1.2, ls=(0, (1, 2)), label=f"ANR {anr:.2f} %")
    axes.set_xlabel("true position along the route [m]")
    axes.set_ylabel("map images placed before the truth [%]")
    axes.margins(x=0.01)
    _legend(axes, -0.16, 4)
    return _save(figure, path)


def _belief_along_drive(replay: Replay, title: str, path: Path) -> Path:
    """Draw the session's belief after every few views, with the truth between two lines."""
    rows = [step for step in replay.steps if step.mass]
    every = max(1, rows[1].query - rows[0].query) if len(rows) > 1 else 1
    start_m, length_m = replay.route.start_m, replay.route.length_m
    figure, axes = _figure(title, "What the robot believes along the drive", (8.4, 7.2))
    last = rows[-1].query + every
    picture = _belief_image(axes, [step.mass for step in rows], (start_m, start_m + length_m, last, rows[0].query))
    truths = [(step.true_route_m, step.query + every / 2) for step in rows if step.true_route_m is not None]
    dot = float(np.clip(700 / len(rows), 1.6, 5))
    if truths:
        true_m, query = np.array(truths).T
        for side_m in (-0.02 * length_m, 0.02 * length_m):
            axes.plot(true_m + side_m, query, color=TRUTH, lw=0, marker=".", ms=dot, alpha=0.9)
    axes.plot([], [], color=TRUTH, lw=1.6, label="the truth lies between these")
    axes.set_xlim(start_m, start_m + length_m)
    axes.set_ylim(last, rows[0].query)
    axes.set_xlabel("along the map's route [m]")
    axes.set_ylabel("query")
    figure.colorbar(picture, ax=axes, pad=0.02, shrink=0.85, label="belief of an equal stretch of the route")
    _legend(axes, -0.08, 1)
    return _save(figure, path)


def _route_map(replay: Replay, scored_steps: Sequence[Step], title: str, path: Path) -> Path:
    """Draw the route from above: every query at its true place, coloured by its error, joined to a far best match."""
    placed_steps = [step for step in scored_steps if step.x_m is not None and step.y_m is not None]
    x, y, error = np.array([(step.x_m, step.y_m, step.error_m) for step in placed_steps], float).T
    tolerance = float(replay.identity["tolerance_m"])
    figure, axes = _figure(title, "Where the best match misses", (8.6, 7.2))
    map_x, map_y = np.asarray(replay.route.x_m), np.asarray(replay.route.y_m)
    axes.plot(map_x, map_y, color="#d0d8de", lw=5, solid_capstyle="round", zorder=1, label="map")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    far_steps = [step for step in placed_steps if (step.error_m or 0) > 5 * tolerance and step.best_x_m is not None]
    segments = [[(step.x_m, step.y_m), (step.best_x_m, step.best_y_m)] for step in far_steps]
    lines = LineCollection(segments, colors=CHANCE, linewidths=0.5, alpha=0.3, zorder=2)  # type: ignore[arg-type]
    axes.add_collection(lines)
    axes.plot([], [], color=CHANCE, lw=1, alpha=0.6, label=f"to a best match over {5 * tolerance:g} m off")
    norm = LogNorm(vmin=max(tolerance / 2, 0.1), vmax=max(100.0, 20 * tolerance), clip=True)
    last = np.argsort(error)  # the worst are drawn last
    colour = np.maximum(error[last], 1e-3)
    dots = axes.scatter(x[last], y[last], c=colour, s=16, cmap="viridis_r", norm=norm, lw=0, zorder=3)
    bar = figure.colorbar(dots, ax=axes, pad=0.02, shrink=0.85, extend="both", label="error of the best match [m]")
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    _legend(axes, -0.08, 2)
    return _save(figure, path)


def _belief_strips(episodes: Sequence[Episode], title: str, path: Path) -> Path:
    """Draw the robot's belief after every move, a row for each, with the truth and the next move."""
    figure = _blank((10.5, 0.9 + 2.9 * len(episodes)))
    panels = np.atleast_1d(np.asarray(figure.subplots(len(episodes), 1, sharex=True)))
    for axes, episode in zip(panels, episodes, strict=True):
        _strip(axes, episode)
    first = episodes[0]
    _head(
        panels[0], f"{title}   planner {planner_label(first.planner, first.planner_named)}", "What the robot believes"
    )
    panels[-1].set_xlabel("along the map's route [m]")
    panels[-1].plot([], [], color=TRUTH, marker="o", ms=5, mfc="none", lw=0, label="where it truly is")
    panels[-1].plot([], [], color=QUIET, marker="|", ms=9, mew=1.6, lw=0, label="likeliest place")
    _legend(panels[-1], -0.24, 2)
    return _save(figure, path)


def _strip(axes: Axes, episode: Episode) -> None:
    low_m, high_m = episode.edges_m
    n_rows = len(episode.steps)
    _belief_image(axes, [step.mass for step in episode.steps], (low_m, high_m, n_rows, 0))
    _quiet(axes)
    axes.grid(visible=False)
    middles = np.arange(n_rows) + 0.5
    true_m = [np.nan if step.true_route_m is None else step.true_route_m for step in episode.steps]
    mode_m = [step.mode_m for step in episode.steps]
    axes.scatter(mode_m, middles, marker="|", s=90, color="white", lw=1.8, zorder=3, path_effects=[EDGE])
    axes.scatter(true_m, middles, s=34, facecolors="none", edgecolors=TRUTH, lw=1.5, zorder=4, path_effects=[EDGE])
    axes.set_yticks(middles, [str(step.step) for step in episode.steps], fontsize=8)
    axes.set_ylabel(f"episode {episode.episode}\nviews after moves", color=INK, fontsize=9)
    axes.set_xlim(low_m, high_m)
    style: dict[str, Any] = {"fontsize": 8, "color": QUIET, "va": "center", "annotation_clip": False}
    for step, middle in zip(episode.steps[:-1], middles, strict=False):
        if step.next_action_m is not None:
            xy = (1.008, 1 - (middle + 0.5) / n_rows)
            axes.annotate(f"{step.next_action_m:+g} m", xy, xycoords="axes fraction", **style)


def _planner_curves(summary: Mapping[str, Any], title: str, path: Path) -> Path:
    """Draw planners from move to move with their 95 % bands, a panel for each figure; the first planner is on top."""
    figure = _blank((4.5 * len(VIEWS) + 0.3, 4.9))
    panels = list(figure.subplots(1, len(VIEWS)))
    first, *other_planners = summary["config"]["planners"]
    for axes, (name, interval, label) in zip(panels, VIEWS, strict=True):
        _quiet(axes)
        for place, planner in [*enumerate(other_planners, 1), (0, first)]:
            row, colour = summary["by_step"][planner], PLANNER_COLOURS[place % len(PLANNER_COLOURS)]
            points = enumerate(zip(row[name], row[interval], strict=True))
            bands = [(step, mean, *(ends or (mean, mean))) for step, (mean, ends) in points if mean is not None]
            if not bands:
                continue
            step, mean, low, high = np.array(bands).T
            axes.fill_between(step, low, high, color=colour, alpha=0.16, lw=0)
            width, dot = (2.4, 4) if planner == first else (1.6, 3)
            planner_name = planner_label(planner, summary["planner_named"][planner])
            axes.plot(step, mean, color=colour, lw=width, marker="o", ms=dot, label=planner_name)
        axes.set_ylabel(label, color=INK)
        axes.set_xlabel("moves made")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[2].set_ylim(0, 103)
    _head(panels[0], title, "From move to move")
    handles, labels = panels[0].get_legend_handles_labels()
    handles, labels = handles[-1:] + handles[:-1], labels[-1:] + labels[:-1]
    n_columns = min(6, max(1, len(labels)))
    figure.legend(handles, labels, loc="outside lower center", ncol=n_columns, frameon=False, fontsize=9)
    return _save(figure, path)


def _belief_image(axes: Axes, rows: Sequence[Sequence[float]], extent: tuple[float, float, float, float]) -> Any:
    masses = np.array(rows)
    norm = PowerNorm(0.4, vmin=0, vmax=max(float(masses.max()), 1e-6))
    picture = axes.imshow(masses, aspect="auto", cmap="magma", norm=norm, interpolation="nearest", extent=extent)
    axes.grid(visible=False)
    return picture


def _figure(title: str, heading: str, size: tuple[float, float]) -> tuple[Figure, Axes]:
    figure = _blank(size)
    axes = figure.subplots()
    _head(axes, title, heading)
    _quiet(axes)
    return figure, axes


def _blank(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, dpi=130, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _head(axes: Axes, title: str, heading: str) -> None:
    """Write the heading over the axes, the title small below it."""
    axes.set_title(heading, loc="left", fontsize=14, fontweight="bold", color=INK, pad=24)
    axes.text(0, 1.025, title, transform=axes.transAxes, fontsize=10, color=QUIET, parse_math=False)


def _quiet(axes: Axes) -> None:
    """Style the axes with a quiet frame and a grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=INK, which="both", color=GRID)
    axes.xaxis.label.set_color(INK)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)


def _legend(axes: Axes, below: float, n_columns: int) -> None:
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, below), ncol=n_columns, frameon=False, fontsize=9)


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path)
    return path
