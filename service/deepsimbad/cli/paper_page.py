"""The report of the paper's section III: a page, markdown, CSV and JSON."""

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepsimbad.cli.terminal import render, write_json
from deepsimbad.core.planners import DEFAULT_PLANNER, NNQL
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.jobs.experiments.paper import Document
from deepsimbad.jobs.experiments.paper_report import HOLDS, display_name
from deepsimbad.jobs.experiments.vpr import BRUTE_FORCE_U, RANKS

# Names on the page, the paper's and ours, by relevance, which the page's colours go by
METHODS = {
    Relevance.BRUTE_FORCE.value: "Brute force",
    Relevance.SIMBAD.value: "SIMBAD",
    Relevance.BAG_OF_LANDMARKS.value: "Bag of landmarks",
    Relevance.RRF.value: "RRF",
    Relevance.STANDARDISED.value: "Standardised, ours",
    Relevance.COMPOSED.value: "Composed, ours",
}
_BOUND = "Whole vectors, standardised"  # `brute_force_u`
_CHANCE = 50.0


def write_report(out: Path, document: Document) -> list[Path]:
    """Write all files of the report; returns them, the page first."""
    lengths = [int(h) for h in document["anr"]]
    by_length = {name: [document["anr"][str(h)].get(name) for h in lengths] for name in METHODS}
    means = [figure["mean"] for figure in document["anr"][str(document["list_length"])].values()]
    means += [figure["mean"] for figures in by_length.values() for figure in figures if figure]
    means += [
        value
        for triplet_document in document["by_triplet"].values()
        for value in _anr(document, triplet_document).values()
    ]
    scale = Scale([value for value in means if value > 0] or [1.0])
    values = {
        **document,
        "methods_shown": METHODS,
        "shown_name": display_name,
        "rows": list(_method_rows(document)),
        "encode_ms": _encode_ms(document),
    }
    page = render(
        out / "index.html",
        "paper_page.html",
        **values,
        bound=_BOUND,
        default=DEFAULT_RELEVANCE.value,
        curves={name: _curve(figures, len(lengths), scale) for name, figures in by_length.items()},
        lengths=lengths,
        scale=scale,
        dots={
            triplet: {
                name: (value, scale(value))
                for name, value in _anr(document, triplet_document).items()
                if name in METHODS
            }
            for triplet, triplet_document in document["by_triplet"].items()
        },
        panels=_panels(document),
        trajectories=_trajectories(document["seasons"]),
        ranks=RANKS,
        n_hold={
            claimant: sum(claim["verdict"] == HOLDS for claim in document["claims"] if claim["said_by"] == claimant)
            for claimant in ("paper", "us")
        },
    )
    text = render(out / "report.md", "paper_report.md", **values)
    table, json_file = out / "figures.csv", out / "paper.json"
    table.write_text(_csv(document), encoding="utf-8")
    write_json(document, json_file)
    return [page, text, table, json_file]


class Scale:
    """ANR as a share of a logarithmic axis, 0 at its least decade and 1 at chance or above."""

    def __init__(self, values: Sequence[float]) -> None:
        self._low = math.floor(max(-3.0, math.log10(min(values))))
        self._high = math.log10(max(_CHANCE, *values))
        self.ticks = [10.0**power for power in range(self._low, 2)] + [_CHANCE]

    def __call__(self, value: float) -> float:
        """The place of an ANR on the axis, in percent."""
        share = (math.log10(max(value, 10.0**self._low)) - self._low) / (self._high - self._low)
        return round(100 * min(1.0, share), 2)


def _anr(document: Document, triplet: Document) -> dict[str, float]:
    anr: dict[str, float] = triplet["anr"][str(document["list_length"])]
    return anr


def _curve(figures: Sequence[Document | None], n: int, scale: Scale) -> dict[str, str]:
    """A line over list lengths, and the area of its interval; brute force has one value for all."""
    only_figure = next((figure for figure in figures if figure), None)
    is_flat = sum(figure is not None for figure in figures) == 1
    drawn_figures = [only_figure if is_flat else figure for figure in figures]
    points_at = [
        (100 * place / max(1, n - 1), figure) for place, figure in enumerate(drawn_figures) if figure is not None
    ]

    def points(value_of: Callable[[Document], float], placed_figures: Sequence[tuple[float, Document]]) -> list[str]:
        return [f"{x:.2f},{100 - scale(value_of(figure)):.2f}" for x, figure in placed_figures]

    area = points(lambda figure: figure["drives"][0], points_at) + points(
        lambda figure: figure["drives"][1], points_at[::-1]
    )
    return {"line": " ".join(points(lambda figure: figure["mean"], points_at)), "area": " ".join(area)}


def _panels(document: Document) -> list[dict[str, Any]]:
    """Fig. 7: a row a planner, best first."""
    texts = (
        ("paper", "As in the paper", "ANR after each of ten moves: RRF, additive update, NNQL", "%"),
        ("ours", "Ours", "ANR after each of ten moves: composed, mixture update, informed", "%"),
        (
            "views",
            "Views until it is sure",
            "Ours: until 99 % sure of its place within 5 m; 20 more if wrong or never",
            "",
        ),
    )
    panels = []
    for setup, title, text, unit in texts:
        figures = document["active"][setup]
        rows = [(name, figure) for name, figure in figures.items() if setup != "paper" or name != DEFAULT_PLANNER]
        axis_end = max(figure[group][1] for _, figure in rows for group in ("stretches", "drives")) or 1.0
        panels.append(
            {
                "title": title,
                "text": text,
                "unit": unit,
                "digits": 2 if axis_end > 1 else 3,
                "rows": [
                    {
                        "name": name,
                        "mean": figure["mean"],
                        **{
                            key: [round(100 * end / axis_end, 2) for end in figure[key]]
                            for key in ("stretches", "drives")
                        },
                        "at": round(100 * figure["mean"] / axis_end, 2),
                        "is_ours": name == (NNQL if setup == "paper" else DEFAULT_PLANNER),
                    }
                    for name, figure in sorted(rows, key=lambda row: float(row[1]["mean"]))
                ],
            }
        )
    return panels


def _trajectories(seasons: Mapping[str, Document]) -> dict[str, Any] | None:
    """SVG paths of the drives in one box, north up; None where no drive knows its x, y."""
    trajectories = {
        season: np.array(document["trajectory"]) for season, document in seasons.items() if document["trajectory"]
    }
    if not trajectories:
        return None
    all_points = np.concatenate(list(trajectories.values()))  # x north, y east
    low, span = all_points.min(axis=0), np.maximum(np.ptp(all_points, axis=0), 1e-9)
    height, width = (span / span.max() * 100).tolist()
    paths = {
        season: " ".join(
            f"{width * (y - low[1]) / span[1]:.2f},{height - height * (x - low[0]) / span[0]:.2f}" for x, y in points
        )
        for season, points in trajectories.items()
    }
    metres = 10 ** math.floor(math.log10(span.max() / 2))
    return {"paths": paths, "wide": width, "tall": height, "bar": 100 * metres / span.max(), "metres": metres}


def _method_rows(document: Document) -> Iterator[dict[str, Any]]:
    """A row a method: what a map image takes, and its figures at the one list length."""
    bits = {**document["index_bits_per_map_image"]}
    bits |= {
        Relevance.BRUTE_FORCE.value: document["bits_per_encoding"],
        BRUTE_FORCE_U: document["bits_per_unit_vector"],
    }
    for name, label in {**METHODS, BRUTE_FORCE_U: _BOUND}.items():
        yield {
            "name": name,
            "label": label,
            "bits": bits[name],
            "anr": document["anr"][str(document["list_length"])][name],
            "recall": {metres: by_method[name] for metres, by_method in document["recall"].items()},
            "anr_at": {metres: by_method[name] for metres, by_method in document["anr_at"].items()},
        }


def _encode_ms(document: Document) -> float | None:
    times_ms = [season["encode_ms"] for season in document["seasons"].values() if season["encode_ms"] is not None]
    return float(np.median(times_ms)) if times_ms else None


def _csv(document: Document) -> str:
    """Every figure of every triplet as CSV, one a line."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["triplet", "figure", "method", "list_length", "tolerance_m", "value"])
    h, first_m = document["list_length"], f"{document['config']['tolerances_m'][0]:g}"
    for triplet, figures in document["by_triplet"].items():
        for length, anr in figures["anr"].items():
            writer.writerows([triplet, "anr", name, length, first_m, value] for name, value in anr.items())
        for metres, recall in figures["recall"].items():
            for name, recall_at in recall.items():
                writer.writerows([triplet, f"recall_at_{k}", name, h, metres, value] for k, value in recall_at.items())
        for setup, anr in figures["active"].items():
            writer.writerows([triplet, f"active_anr_{setup}", name, h, "", value] for name, value in anr.items())
        for name, value in figures["views_to_confident"].items():
            writer.writerow([triplet, "views_to_confident", name, h, "", value])
    return text.getvalue()
