"""How every picture looks: colours, quiet axes, a heading over a title."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK = "#22303c"
QUIET = "#8a97a3"
GRID = "#e3e8ec"
DOT = "#7fa3cf"
LINE = "#1f4e8c"
CHANCE = "#d1495b"


def new_figure(title: str, heading: str, size: tuple[float, float]) -> tuple[Figure, Axes]:
    """A figure of one pair of axes, drawn without a screen."""
    figure = blank_figure(size)
    axes = figure.subplots()
    head(axes, title, heading)
    quiet(axes)
    return figure, axes


def blank_figure(size: tuple[float, float]) -> Figure:
    """A figure without axes."""
    figure = Figure(figsize=size, dpi=130, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def head(axes: Axes, title: str, heading: str) -> None:
    """Write the heading over the axes, the title small below it."""
    axes.set_title(heading, loc="left", fontsize=14, fontweight="bold", color=INK, pad=24)
    axes.text(0, 1.025, title, transform=axes.transAxes, fontsize=10, color=QUIET, parse_math=False)


def quiet(axes: Axes) -> None:
    """Take the ink out of the frame."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=INK, which="both", color=GRID)
    axes.xaxis.label.set_color(INK)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)


def saved(figure: Figure, path: Path) -> Path:
    """Write the picture."""
    figure.savefig(path)
    return path
