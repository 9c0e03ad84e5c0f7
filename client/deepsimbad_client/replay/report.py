"""Reports of replays: figures, the file that holds them, tables for people, and one page of all."""

import base64
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from deepsimbad.core.metrics import mean_interval
from deepsimbad_client.replay import DEFAULT_PLANNER
from deepsimbad_client.replay.active import ActiveReplay, Episode
from deepsimbad_client.replay.passive import Replay

NEAR_M = (5.0, 10.0)
_DIGITS = 4

Reals = NDArray[np.float64]


def summarise(replay: Replay) -> dict[str, Any]:
    """Figures of a passive replay, flat and JSON-ready; a figure without a query to count is None.

    `anr` is the averaged normalised rank in percent: 0 is perfect, 50 chance. Queries without a right answer in the
    map are left out of it and counted in `n_left_out`.
    """
    answered_steps = [step for step in replay.steps if step.broken is None]
    scored_steps = [step for step in answered_steps if step.rank is not None]
    errors = [step.error_m for step in scored_steps if step.error_m is not None]
    latencies = [step.latency_ms for step in answered_steps if step.latency_ms is not None]
    ranks = [step.rank for step in scored_steps if step.rank is not None]

    def share(hits: Sequence[bool]) -> float | None:
        return 100 * sum(hits) / len(hits) if hits else None

    def quantile(values: Sequence[float], q: float) -> float | None:
        return round(float(np.quantile(values, q)), 3) if values else None

    return {
        "anr": math.fsum(step.rank_percent or 0.0 for step in scored_steps) / len(scored_steps)
        if scored_steps
        else None,
        "recall_at_1": share([rank < 1 for rank in ranks]),
        "recall_at_5": share([rank < 5 for rank in ranks]),
        "n_queries": len(scored_steps),
        "n_left_out": len(answered_steps) - len(scored_steps),
        "n_broken": dict(Counter(step.broken for step in replay.steps if step.broken is not None)),
        "left_out": {reason: len(names) for reason, names in replay.left_out_names.items()},
        "n_map_images": replay.route.n_images,
        "error_m": {"median": quantile(errors, 0.5), "p90": quantile(errors, 0.9)},
        "within_5_m": share([error <= 5 for error in errors]),
        "within_10_m": share([error <= 10 for error in errors]),
        "latency_ms": {"median": quantile(latencies, 0.5), "p95": quantile(latencies, 0.95)},
        "config": dict(replay.identity),
        "seconds": round(replay.seconds, 3),
    }


def write_summary(summary: dict[str, Any], folder: Path) -> Path:
    """Write `summary.json`."""
    path = folder / "summary.json"
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return path


def table(summary: dict[str, Any]) -> Table:
    """The figures of a passive replay as a table."""
    config = summary["config"]
    rows = _table(
        f"{config['recording']} against {config['domain']}, map {config['map_version']}",
        "figure",
        ["value"],
        caption="ANR: 0 is perfect, 50 is chance. One session: statistics are its own.",
    )
    tolerance = f"within {config['tolerance_m']:g} m"
    rows.add_row("ANR", _format(summary["anr"], ".2f", " %"), style="bold")
    for label, value, unit in (
        (f"R@1 {tolerance}", summary["recall_at_1"], "%"),
        (f"R@5 {tolerance}", summary["recall_at_5"], "%"),
        ("median error of the best match", summary["error_m"]["median"], "m"),
        ("best match within 5 m", summary["within_5_m"], "%"),
        ("best match within 10 m", summary["within_10_m"], "%"),
        ("time an answer takes, median", summary["latency_ms"]["median"], "ms"),
        ("time an answer takes, 95 %", summary["latency_ms"]["p95"], "ms"),
    ):
        rows.add_row(label, _format(value, ".1f", f" {unit}"))
    rows.add_section()
    counts = {"queries scored": summary["n_queries"], "left out: no right answer in the map": summary["n_left_out"]}
    counts |= {f"left out: {reason}": count for reason, count in summary["left_out"].items()}
    for label, count in (counts | {"map images": summary["n_map_images"]}).items():
        rows.add_row(label, str(count))
    return rows


def interval_95(values: Reals, seed: int = 0) -> list[float] | None:
    """The 95 % interval of the mean of `values` [e, ...] over resampled episodes; NaN is unknown, None: all are."""
    is_known, episode = np.isfinite(values), np.indices(values.shape)[0]
    if not is_known.any():
        return None
    return [round(end, _DIGITS) for end in mean_interval(values[is_known], seed, episode[is_known])]


def figures(episodes: Sequence[Episode], name: str) -> Reals:
    """One figure of every step: [episodes, steps + 1] float64, NaN where unknown."""
    return np.array([[getattr(step, name) for step in episode.steps] for episode in episodes], np.float64)


def summarise_active(replay: ActiveReplay) -> dict[str, Any]:
    """Figures of an active replay, JSON-ready; a figure without a frame to count is None.

    `anr` is in percent over all frames after each action, the first view left out; `against` holds the first planner's
    `anr` less each other's, and the interval of that where both know the rank: below 0 the first is better.
    """
    first, *other_planners = replay.planners
    interval = partial(interval_95, seed=int(replay.identity["seed"]))

    def of_planners(figure: Callable[[list[Episode]], Any]) -> dict[str, Any]:
        return {name: figure(episodes) for name, episodes in replay.episodes.items()}

    rank_percent = of_planners(lambda episodes: figures(episodes, "rank_percent")[:, 1:])
    anr: dict[str, Any] = {name: _average(ranks) for name, ranks in rank_percent.items()}
    return {
        "anr": anr,
        "interval_95": {name: interval(ranks) for name, ranks in rank_percent.items()},
        "against": {
            name: {
                "anr": None if None in {anr[first], anr[name]} else round(anr[first] - anr[name], _DIGITS),
                "interval_95": interval(rank_percent[first] - rank_percent[name]),
            }
            for name in other_planners
        },
        "by_step": of_planners(lambda episodes: _by_step(episodes, interval)),
        "travelled_m": of_planners(lambda episodes: _average(figures(episodes, "travelled_m")[:, -1])),
        "planner_named": of_planners(lambda episodes: episodes[0].planner_named),
        "n_episodes": len(replay.episodes[first]),
        "n_frames": {name: int(np.isfinite(ranks).sum()) for name, ranks in rank_percent.items()},
        "n_left_out": {name: int(np.isnan(ranks).sum()) for name, ranks in rank_percent.items()},
        "n_forgot": of_planners(lambda episodes: int(figures(episodes, "forgot").sum())),
        "n_map_images": replay.identity["n_map_images"],
        "latency_ms": of_planners(lambda episodes: _average(figures(episodes, "latency_ms"), np.median)),
        "config": dict(replay.identity),
        "seconds": round(replay.seconds, 3),
    }


def active_tables(summary: dict[str, Any]) -> list[Table]:
    """Two tables: the planners compared, and how far from the truth they are after their last move."""
    config = summary["config"]
    names = config["planners"]
    first = names[0]
    labels = {name: planner_label(name, summary["planner_named"][name]) for name in names}
    comparison = _table(
        f"{config['recording']} against {config['domain']}, map {config['map_version']}: "
        f"{summary['n_episodes']} episodes of {config['steps']} moves",
        "planner",
        ["ANR %", "95 %", f"{first} gains", "95 %"],
        caption="ANR after each move: 0 is perfect, 50 is chance. 95 %: over resampled starts, the same for all.",
    )
    localization = _table(
        f"after {config['steps']} moves: how far from the truth",
        "planner",
        ["median", "within 5 m", "within 10 m", "moved", "forgot"],
    )
    for name in names:
        against = summary["against"].get(name, {"anr": None, "interval_95": None})
        gain = _format(None if against["anr"] is None else -against["anr"], "z.2f")
        comparison.add_row(
            labels[name],
            _format(summary["anr"][name], ".2f"),
            _ends(summary["interval_95"][name]),
            "" if name == first else gain,
            "" if name == first else _ends(against["interval_95"], -1),
        )
        last = {figure: values[-1] for figure, values in summary["by_step"][name].items()}
        localization.add_row(
            labels[name],
            _format(last["median_error_m"], ".1f", " m"),
            _format(last["within_5_m"], ".0f", " %"),
            _format(last["within_10_m"], ".0f", " %"),
            _format(summary["travelled_m"][name], ".0f", " m"),
            str(summary["n_forgot"][name]),
        )
    return [comparison, localization]


def planner_label(name: str, service_name: str) -> str:
    """A planner's name for people: for `default` the name of the planner that the service used."""
    return f"{service_name} (default)" if name == DEFAULT_PLANNER and service_name != DEFAULT_PLANNER else name


def _by_step(episodes: Sequence[Episode], interval: Callable[[Reals], list[float] | None]) -> dict[str, list[Any]]:
    error_m = figures(episodes, "error_m")
    shares = {near_m: 100 * np.where(np.isfinite(error_m), error_m <= near_m, np.nan) for near_m in NEAR_M}
    figures_with_bands = {"anr": figures(episodes, "rank_percent"), "error": error_m}
    figures_with_bands |= {f"within_{near_m:g}_m": share for near_m, share in shares.items()}
    by_step: dict[str, list[Any]] = {
        "travelled_m": list(map(_average, figures(episodes, "travelled_m").T)),
        "median_error_m": [_average(column, np.median) for column in error_m.T],
        "entropy_bits": list(map(_average, figures(episodes, "entropy_bits").T)),
    }
    for name, values in figures_with_bands.items():
        by_step["error_m" if name == "error" else name] = list(map(_average, values.T))
        by_step[f"{name}_interval_95"] = list(map(interval, values.T))
    return by_step


def _average(values: Reals, of: Callable[[Reals], Any] = np.mean) -> float | None:
    """The mean, or the median, of the values that are not NaN; None where all are."""
    finite = values[np.isfinite(values)]
    return round(float(of(finite)), _DIGITS) if finite.size else None


def _table(title: str, first: str, headings: Sequence[str], caption: str | None = None) -> Table:
    empty = Table(title=title, caption=caption, title_justify="left", caption_justify="left")
    empty.add_column(first, style=None if first == "figure" else "bold", no_wrap=True)
    for heading in headings:
        empty.add_column(heading, justify="right", no_wrap=True)
    return empty


def _ends(interval: list[float] | None, sign: int = 1) -> str:
    if interval is None:
        return "-"
    low, high = sorted(sign * end for end in interval)
    return f"{low:z.2f} .. {high:z.2f}"


def _format(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else format(value, form) + unit


# The page holds everything it shows, so that it can be sent on, or opened in the console.
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>
body {{ margin: 0 auto; max-width: 72rem; padding: clamp(1rem, 4vw, 2.5rem); font: 1rem/1.5 system-ui, sans-serif;
  background: light-dark(#f4f5f7, #0f1317); color: light-dark(#18212b, #e8edf2); }}
h1 {{ font-size: clamp(1.5rem, 4vw, 2.2rem); line-height: 1.2; margin: 0 0 1.5rem; text-wrap: balance; }}
section, figure {{ background: light-dark(#fff, #181e25); border: 1px solid light-dark(#d9dee4, #2c353f);
  border-radius: 10px; padding: 1rem 1.25rem; margin: 0 0 1.25rem; overflow-x: auto; }}
h2 {{ font-size: 1.05rem; margin: 0 0 .6rem; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ text-align: right; padding: .3rem 1.2rem .3rem 0; border-bottom: 1px solid light-dark(#d9dee4, #2c353f); }}
th:first-child, td:first-child {{ text-align: left; }}
th, p {{ font-weight: 500; color: light-dark(#55606c, #a5b1bd); font-size: .9rem; }}
figure {{ background: #fff; }}
img {{ display: block; max-width: 100%; height: auto; margin: 0 auto; }}
</style>
</head>
<body>
<main>
<h1>{title}</h1>
{parts}
</main>
</body>
</html>
"""


def write_page(folder: Path, title: str, tables: Sequence[Table], pictures: Sequence[Path]) -> Path:
    """Write `index.html` with the tables and the PNG files within it; returns its path."""
    parts = [*map(_section, tables), *map(_picture, pictures)]
    path = folder / "index.html"
    path.write_text(_PAGE.format(title=escape(title), parts="\n".join(parts)), encoding="utf-8")
    return path


def _section(table: Table) -> str:
    head = _row("th scope=col", (str(column.header) for column in table.columns))
    rows = [_row("td", map(str, cells)) for cells in zip(*(column.cells for column in table.columns), strict=True)]
    body = f"<table>\n<thead>{head}</thead>\n<tbody>{''.join(rows)}</tbody>\n</table>"
    caption = "" if table.caption is None else f"\n<p>{escape(str(table.caption))}</p>"
    return f"<section tabindex=0>\n<h2>{escape(str(table.title))}</h2>\n{body}{caption}\n</section>"


def _row(cell: str, texts: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<{cell}>{escape(text)}</{cell.split(maxsplit=1)[0]}>' for text in texts)}</tr>"


def _picture(path: Path) -> str:
    uri = f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
    return f'<figure><img src="{uri}" alt="{path.stem.replace("_", " ")}"></figure>'
