"""Pictures of a replay, drawn without a screen."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from deepsimbad_client.map_route import Truth, path_of_frames
from deepsimbad_client.plot_style import CHANCE, DOT, GRID, INK, LINE, new_figure, quiet, saved
from deepsimbad_client.recordings.recording import Frame
from deepsimbad_client.replay import Replay
from deepsimbad_client.step_log import Step

LEAST_PERCENT = 0.01
"""Ranks are drawn on a logarithmic axis; a perfect 0 stands at its foot."""
PERCENT_TICKS = (0.01, 0.1, 1, 10, 50, 100)


def draw_all(replay: Replay, folder: Path) -> list[Path]:
    """Draw every picture that the replay has numbers for; returns the PNG files."""
    scored = [step for step in replay.steps if step.rank_percent is not None]
    if not scored:
        return []
    title = f"{replay.identity['recording']}  against  {replay.identity['domain']}"
    drawn = [
        rank_along_route(scored, title, folder / "rank_along_route.png"),
        rank_distribution(scored, title, folder / "rank_distribution.png"),
    ]
    if np.isfinite(replay.heat.values).any():
        drawn.append(relevance_heat(replay, title, folder / "relevance_heat.png"))
    if replay.route.path.knows_xy and any(step.x_m is not None for step in scored):
        drawn.append(route_map(replay, scored, title, folder / "route_map.png"))
    return drawn


def rank_along_route(scored: Sequence[Step], title: str, path: Path) -> Path:
    """Draw the rank of the truth at every query, with a running median over it."""
    position_m = np.array([step.position_m for step in scored])
    percent = _ranks(scored)
    order = np.argsort(position_m, kind="stable")
    figure, axes = new_figure(title, "Rank of the true place along the route", (11, 4.6))
    axes.scatter(position_m, np.maximum(percent, LEAST_PERCENT), s=11, color=DOT, alpha=0.75, lw=0, label="query")
    window = max(5, len(scored) // 40) | 1
    smooth = _running_median(percent[order], window)
    axes.plot(
        position_m[order],
        np.maximum(smooth, LEAST_PERCENT),
        color=LINE,
        lw=2,
        label=f"median of {window} neighbours",
    )
    _percent_axis(axes.yaxis.axes, "y")
    axes.axhline(50, color=CHANCE, lw=1.2, ls=(0, (5, 3)), label="chance (50 %)")
    anr = float(percent.mean())
    axes.axhline(max(anr, LEAST_PERCENT), color=INK, lw=1.2, ls=(0, (1, 2)), label=f"ANR {anr:.2f} %")
    axes.set_xlabel("true position along the route [m]")
    axes.set_ylabel("map images placed before the truth [%]")
    axes.margins(x=0.01)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncol=4, frameon=False, fontsize=9)
    return saved(figure, path)


def rank_distribution(scored: Sequence[Step], title: str, path: Path) -> Path:
    """Draw how many queries came how near the top: a histogram and, over it, the share up to each rank."""
    percent = np.maximum(_ranks(scored), LEAST_PERCENT)
    figure, axes = new_figure(title, "How near the top the true place comes", (8.6, 4.6))
    bins = np.geomspace(LEAST_PERCENT, 100, 33)
    axes.hist(percent, bins=bins.tolist(), color=DOT, edgecolor="white", lw=0.6)
    axes.set_ylabel("queries", color=DOT)
    axes.set_xlabel("map images placed before the truth [%]  (0 stands at the left edge)")
    _percent_axis(axes, "x")
    share = axes.twinx()
    ordered = np.sort(percent)
    cumulative = 100 * np.arange(1, len(ordered) + 1) / len(ordered)
    share.step(np.append(ordered, 100), np.append(cumulative, 100), where="post", color=LINE, lw=2)
    share.set_ylim(0, 103)
    share.set_ylabel("queries up to this rank [%]", color=LINE)
    quiet(share)
    share.spines["right"].set_visible(True)
    share.spines["right"].set_color(GRID)
    share.grid(visible=False)
    for mark in (1, 10):
        reached = 100 * float((percent <= mark).mean())
        share.plot([mark, mark], [0, reached], color=INK, lw=0.9, ls=(0, (2, 2)))
        share.annotate(
            f"{reached:.0f} % within the first {mark} %",
            (mark, reached),
            xytext=(7, -13),
            textcoords="offset points",
            fontsize=9,
            color=INK,
        )
    return saved(figure, path)


def relevance_heat(replay: Replay, title: str, path: Path) -> Path:
    """Draw how relevant every stretch of the map is to every query, with the truth between two lines."""
    values = np.asarray(replay.heat.values, np.float32)
    n_rows = len(values)
    n_images = replay.route.n_images
    figure, axes = new_figure(title, "Relevance of the map to every query", (8.4, 7.2))
    known = values[np.isfinite(values)]
    low, high = float(np.quantile(known, 0.5)), float(np.quantile(known, 0.999))
    picture = axes.imshow(
        values,
        aspect="auto",
        cmap="magma",
        vmin=low,
        vmax=max(high, low + 1e-3),
        interpolation="antialiased",
        extent=(0, n_images, n_rows * replay.heat.every, 0),
    )
    axes.grid(visible=False)
    aside = 0.02 * n_images
    dot = float(np.clip(700 / max(1, n_rows), 1.6, 5))
    for side in (-aside, aside):
        queries, images = _true_places(replay)
        axes.plot(images + side, queries, color="#35d0ba", lw=0, marker=".", ms=dot, alpha=0.9)
    axes.plot([], [], color="#35d0ba", lw=1.6, label="the truth lies between these")
    axes.set_xlim(0, n_images)
    axes.set_ylim(n_rows * replay.heat.every, 0)
    axes.set_xlabel("map image, in route order")
    axes.set_ylabel("query")
    bar = figure.colorbar(picture, ax=axes, pad=0.02, shrink=0.85)
    bar.set_label("standard deviations above the query's mean", color=INK)
    bar.outline.set_visible(False)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), frameon=False, fontsize=9)
    return saved(figure, path)


def route_map(replay: Replay, scored: Sequence[Step], title: str, path: Path) -> Path:
    """Draw the route from above: every query where it truly was, coloured by its error, joined to a far best match."""
    placed = [step for step in scored if step.x_m is not None and step.y_m is not None]
    x = np.array([step.x_m for step in placed], float)
    y = np.array([step.y_m for step in placed], float)
    error = np.array([step.error_m for step in placed], float)
    route = replay.route.path
    figure, axes = new_figure(title, "Where the best match misses", (8.6, 7.2))
    axes.plot(route.x_m, route.y_m, color="#c9d2d9", lw=5, solid_capstyle="round", zorder=1, label="map")
    tolerance = float(replay.identity["tolerance_m"])
    far = [step for step in placed if (step.error_m or 0) > 5 * tolerance and step.best_x_m is not None]
    segments = [[(step.x_m, step.y_m), (step.best_x_m, step.best_y_m)] for step in far]
    lines = LineCollection(segments, colors=CHANCE, linewidths=0.5, alpha=0.3, zorder=2)  # type: ignore[arg-type]
    axes.add_collection(lines)
    axes.plot([], [], color=CHANCE, lw=1, alpha=0.6, label=f"to a best match over {5 * tolerance:g} m off")
    norm = LogNorm(vmin=max(tolerance / 2, 0.1), vmax=max(100.0, 20 * tolerance), clip=True)
    worst_last = np.argsort(error)
    dots = axes.scatter(
        x[worst_last],
        y[worst_last],
        c=np.maximum(error[worst_last], 1e-3),
        s=16,
        cmap="viridis_r",
        norm=norm,
        lw=0,
        zorder=3,
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    bar = figure.colorbar(dots, ax=axes, pad=0.02, shrink=0.85, extend="both")
    bar.set_label("error of the best match [m]", color=INK)
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.outline.set_visible(False)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncol=2, frameon=False, fontsize=9)
    return saved(figure, path)


def _true_places(replay: Replay) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The queries of the heat's rows and, of their right answers, the nearest."""
    frames = [Frame(step.index, step.name, step.position_m, x_m=step.x_m, y_m=step.y_m) for step in replay.steps]
    truth = Truth(path_of_frames(frames), replay.route, float(replay.identity["tolerance_m"]))
    queries, images = [], []
    for row, step in enumerate(replay.steps):
        if step.query % replay.heat.every == 0 and step.n_true:
            true_images = truth.true_images(row)
            queries.append(step.query + 0.5)
            images.append(true_images[truth.apart_m(row)[true_images].argmin()] + 0.5)
    return np.array(queries, float), np.array(images, float)


def _ranks(scored: Sequence[Step]) -> NDArray[np.float64]:
    return np.array([step.rank_percent for step in scored], np.float64)


def _running_median(values: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    half = window // 2
    return np.array([np.median(values[max(0, at - half) : at + half + 1]) for at in range(len(values))])


def _percent_axis(axes: Axes, which: str) -> None:
    axis = axes.xaxis if which == "x" else axes.yaxis
    if which == "x":
        axes.set_xscale("log")
        axes.set_xlim(LEAST_PERCENT * 0.85, 118)
    else:
        axes.set_yscale("log")
        axes.set_ylim(LEAST_PERCENT * 0.7, 140)
    axis.set_major_locator(FixedLocator(PERCENT_TICKS))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: "0" if value <= LEAST_PERCENT else f"{value:g}"))
