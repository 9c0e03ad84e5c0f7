"""What a replay came to: figures, the file they go into, and a table for people."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from deepsimbad_client.replay import Replay
from deepsimbad_client.step_log import Step


def summarise(replay: Replay) -> dict[str, Any]:
    """Figures of a replay, flat and JSON-ready; those that nothing was counted for are None.

    `anr` is the averaged normalised rank in percent: 0 is perfect, 50 chance. Queries without a right answer in the
    map are left out of it and counted in `n_left_out`.
    """
    steps = replay.steps
    asked = [step for step in steps if step.broken is None]
    scored = [step for step in asked if step.rank is not None]
    errors = [step.error_m for step in scored if step.error_m is not None]
    latencies = [step.latency_ms for step in asked if step.latency_ms is not None]
    return {
        "anr": _mean([step.rank_percent for step in scored]),
        "recall_at_1": recall_at(scored, 1),
        "recall_at_5": recall_at(scored, 5),
        "n_queries": len(scored),
        "n_left_out": len(asked) - len(scored),
        "n_broken": dict(Counter(step.broken for step in steps if step.broken is not None)),
        "n_map_images": replay.route.n_images,
        "error_m": {"median": _quantile(errors, 0.5), "p90": _quantile(errors, 0.9)},
        "within_5_m": _share([error <= 5 for error in errors]),
        "within_10_m": _share([error <= 10 for error in errors]),
        "latency_ms": {"median": _quantile(latencies, 0.5), "p95": _quantile(latencies, 0.95)},
        "config": dict(replay.identity),
        "seconds": round(replay.seconds, 3),
    }


def write_summary(summary: dict[str, Any], folder: Path) -> Path:
    """Write `summary.json`."""
    path = folder / "summary.json"
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return path


def recall_at(scored: Sequence[Step], k: int) -> float | None:
    """R@k in percent: queries with a right answer among the first k, ties counted half."""
    return _share([step.rank is not None and step.rank < k for step in scored])


def table(summary: dict[str, Any]) -> Table:
    """The figures as a table."""
    config = summary["config"]
    made = Table(
        title=f"{config['recording']} against {config['domain']}, map {config['map_version']}",
        caption="ANR: 0 is perfect, 50 is chance. Stateless calls: the map's statistics alone.",
        title_justify="left",
        caption_justify="left",
    )
    made.add_column("figure")
    made.add_column("value", justify="right")
    tolerance = f"within {config['tolerance_m']:g} m"
    made.add_row("ANR", _percent(summary["anr"], 2), style="bold")
    made.add_row(f"R@1 {tolerance}", _percent(summary["recall_at_1"]))
    made.add_row(f"R@5 {tolerance}", _percent(summary["recall_at_5"]))
    made.add_row("median error of the best match", _number(summary["error_m"]["median"], "m"))
    made.add_row("best match within 5 m", _percent(summary["within_5_m"]))
    made.add_row("best match within 10 m", _percent(summary["within_10_m"]))
    made.add_row("time an answer takes, median", _number(summary["latency_ms"]["median"], "ms"))
    made.add_row("time an answer takes, 95 %", _number(summary["latency_ms"]["p95"], "ms"), end_section=True)
    made.add_row("queries scored", str(summary["n_queries"]))
    made.add_row("left out: no right answer in the map", str(summary["n_left_out"]))
    for reason, count in summary["n_broken"].items():
        made.add_row(f"left out: {reason}", str(count))
    made.add_row("map images", str(summary["n_map_images"]))
    return made


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _share(hits: Sequence[bool]) -> float | None:
    return 100 * sum(hits) / len(hits) if hits else None


def _quantile(values: Sequence[float], q: float) -> float | None:
    return round(float(np.quantile(values, q)), 3) if values else None


def _percent(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f} %"


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.1f} {unit}"
