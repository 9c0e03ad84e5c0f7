"""What active replays came to: figures by planner, by step and by distance, and tables for people."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from deepsimbad_client.active_replay import ActiveReplay
from deepsimbad_client.bootstrap import Interval, Resampling, mean_known
from deepsimbad_client.episode_log import Episode, EpisodeStep
from deepsimbad_client.stage import DEFAULT_PLANNER

NEAR_M = (5.0, 10.0)
_DIGITS = 4
_MOST_DISTANCES = 10


def figures(episodes: Sequence[Episode], name: str) -> NDArray[np.float64]:
    """One figure of every step: [episodes, steps + 1] float64, NaN where it is not known."""

    def value(step: EpisodeStep) -> float:
        found = getattr(step, name)
        return np.nan if found is None else float(found)

    return np.array([[value(step) for step in episode.steps] for episode in episodes], np.float64)


def at_distance(episodes: Sequence[Episode], name: str, metres: float) -> NDArray[np.float64]:
    """One figure as it stood when each episode had travelled so far: [episodes], NaN for one that ended before."""
    values, travelled_m = figures(episodes, name), figures(episodes, "travelled_m")
    last = (travelled_m <= metres).sum(1) - 1
    reached = travelled_m[:, -1] >= metres
    return np.where(reached, values[np.arange(len(values)), last], np.nan)


def distances_m(replay: ActiveReplay) -> list[float]:
    """Metres travelled at which planners are compared: as far as half of the episodes of any planner come."""
    furthest = max(float(np.median(figures(each, "travelled_m")[:, -1])) for each in replay.episodes.values())
    apart = max(1.0, float(np.ceil(furthest / _MOST_DISTANCES)))
    return [float(metres) for metres in np.arange(0, furthest + 1e-9, apart)]


def summarise_active(replay: ActiveReplay) -> dict[str, Any]:
    """Figures of an active replay, JSON-ready; those that nothing was counted for are None.

    `anr` is the averaged normalised rank in percent over all frames after each action, the first view left out: 0 is
    perfect, 50 chance. `against` holds how much better (negative) the first planner is than each other, with the 95 %
    interval of that difference over the same starts.
    """
    first, *others = replay.planners
    resampling = Resampling.of(len(replay.episodes[first]), int(replay.identity["seed"]))
    ranks = {name: figures(each, "rank_percent") for name, each in replay.episodes.items()}
    moved = {name: each[:, 1:] for name, each in ranks.items()}
    grid_m = distances_m(replay)
    against = {}
    for name in others:
        ours, theirs = mean_known(moved[first]), mean_known(moved[name])
        against[name] = {
            "anr": None if ours is None or theirs is None else _rounded(ours - theirs),
            "interval_95": _interval(resampling.difference(moved[first], moved[name])),
        }
    return {
        "anr": {name: _rounded(mean_known(each)) for name, each in moved.items()},
        "interval_95": {name: _interval(resampling.interval(each)) for name, each in moved.items()},
        "against": against,
        "by_step": {name: _by_step(each, resampling) for name, each in replay.episodes.items()},
        "by_distance": {name: _by_distance(each, grid_m, resampling) for name, each in replay.episodes.items()},
        "travelled_m": {
            name: _rounded(mean_known(figures(each, "travelled_m")[:, -1])) for name, each in replay.episodes.items()
        },
        "planner_named": {name: each[0].planner_named for name, each in replay.episodes.items()},
        "n_episodes": len(replay.episodes[first]),
        "n_frames": {name: int(np.isfinite(each).sum()) for name, each in moved.items()},
        "n_left_out": {name: int(np.isnan(each).sum()) for name, each in moved.items()},
        "n_forgot": {name: int(figures(each, "forgot").sum()) for name, each in replay.episodes.items()},
        "n_map_images": replay.route.n_images,
        "latency_ms": {
            name: _rounded(float(np.median(figures(each, "latency_ms")))) for name, each in replay.episodes.items()
        },
        "config": dict(replay.identity),
        "seconds": round(replay.seconds, 3),
    }


def planner_table(summary: dict[str, Any]) -> Table:
    """Planners against each other."""
    config = summary["config"]
    first = config["planners"][0]
    table = Table(
        title=f"{config['recording']} against {config['domain']}, map {config['map_version']}: "
        f"{summary['n_episodes']} episodes of {config['steps']} moves",
        caption="ANR after each move: 0 is perfect, 50 is chance. 95 %: over resampled starts, the same for all.",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("planner", style="bold", no_wrap=True)
    for heading in ("ANR %", "95 %", f"{first} gains", "95 %"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name in config["planners"]:
        against = summary["against"].get(name, {"anr": None, "interval_95": None})
        table.add_row(
            shown_name(name, summary["planner_named"][name]),
            _shown(summary["anr"][name], ".2f"),
            _ends(summary["interval_95"][name]),
            "" if name == first else _shown(None if against["anr"] is None else -against["anr"], "z.2f"),
            "" if name == first else _ends(against["interval_95"], -1),
        )
    return table


def localized_table(summary: dict[str, Any]) -> Table:
    """How well planners know where they are after their last move."""
    config = summary["config"]
    table = Table(title=f"after {config['steps']} moves", title_justify="left")
    table.add_column("planner", style="bold", no_wrap=True)
    for heading in ("median error", "within 5 m", "within 10 m", "moved", "forgot"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name in config["planners"]:
        last = {figure: values[-1] for figure, values in summary["by_step"][name].items()}
        table.add_row(
            shown_name(name, summary["planner_named"][name]),
            _shown(last["median_error_m"], ".1f", " m"),
            _shown(last["within_5_m"], ".0f", " %"),
            _shown(last["within_10_m"], ".0f", " %"),
            _shown(summary["travelled_m"][name], ".0f", " m"),
            str(summary["n_forgot"][name]),
        )
    return table


def distance_table(summary: dict[str, Any]) -> Table:
    """Planners at equal distance travelled."""
    table = Table(title="ANR % at equal distance travelled", title_justify="left")
    table.add_column("planner", style="bold")
    by_distance = summary["by_distance"]
    names = summary["config"]["planners"]
    metres = by_distance[names[0]]["travelled_m"]
    picked = sorted({round(at) for at in np.linspace(0, len(metres) - 1, min(6, len(metres)))}) if metres else []
    for at in picked:
        table.add_column(f"{metres[at]:g} m", justify="right")
    for name in names:
        values = by_distance[name]["anr"]
        table.add_row(shown_name(name, summary["planner_named"][name]), *(_shown(values[at], ".1f") for at in picked))
    return table


def shown_name(asked: str, named: str) -> str:
    """A planner for people: what `default` stands for is said."""
    return f"{named} (default)" if asked == DEFAULT_PLANNER and named != DEFAULT_PLANNER else asked


def _by_step(episodes: Sequence[Episode], resampling: Resampling) -> dict[str, list[Any]]:
    rank = figures(episodes, "rank_percent")
    error_m = figures(episodes, "error_m")
    columns = range(rank.shape[1])
    found: dict[str, list[Any]] = {
        "travelled_m": [_rounded(value) for value in figures(episodes, "travelled_m").mean(0)],
        "anr": [_rounded(mean_known(rank[:, at])) for at in columns],
        "anr_interval_95": [_interval(resampling.interval(rank[:, at])) for at in columns],
        "error_m": [_rounded(mean_known(error_m[:, at])) for at in columns],
        "error_interval_95": [_interval(resampling.interval(error_m[:, at])) for at in columns],
        "median_error_m": [_rounded(_median(error_m[:, at])) for at in columns],
        "entropy_bits": [_rounded(mean_known(column)) for column in figures(episodes, "entropy_bits").T],
    }
    for near_m in NEAR_M:
        share = 100 * _near(error_m, near_m)
        found[f"within_{near_m:g}_m"] = [_rounded(mean_known(share[:, at])) for at in columns]
        found[f"within_{near_m:g}_m_interval_95"] = [_interval(resampling.interval(share[:, at])) for at in columns]
    return found


def _by_distance(episodes: Sequence[Episode], grid_m: Sequence[float], resampling: Resampling) -> dict[str, list[Any]]:
    """Beyond where half of the episodes come nothing is told: those that do are no fair sample."""

    def column(name: str, metres: float) -> NDArray[np.float64]:
        values = at_distance(episodes, name, metres)
        far_enough = int((figures(episodes, "travelled_m")[:, -1] >= metres).sum())
        return values if 2 * far_enough >= len(episodes) else np.full_like(values, np.nan)

    ranks = [column("rank_percent", metres) for metres in grid_m]
    errors_m = [column("error_m", metres) for metres in grid_m]
    return {
        "travelled_m": list(grid_m),
        "anr": [_rounded(mean_known(each)) for each in ranks],
        "anr_interval_95": [_interval(resampling.interval(each)) for each in ranks],
        "error_m": [_rounded(mean_known(each)) for each in errors_m],
        "error_interval_95": [_interval(resampling.interval(each)) for each in errors_m],
        "n_episodes": [int(np.isfinite(each).sum()) for each in ranks],
    }


def _near(error_m: NDArray[np.float64], near_m: float) -> NDArray[np.float64]:
    return np.where(np.isfinite(error_m), error_m <= near_m, np.nan)


def _median(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), _DIGITS)


def _interval(interval: Interval) -> list[float] | None:
    return None if interval is None else [round(end, _DIGITS) for end in interval]


def _ends(interval: list[float] | None, sign: int = 1) -> str:
    if interval is None:
        return "-"
    low, high = sorted(sign * end for end in interval)
    return f"{low:z.2f} .. {high:z.2f}"


def _shown(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else format(value, form) + unit
