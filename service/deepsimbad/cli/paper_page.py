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

# As the paper says them, and ours; and which of the page's colours each has
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
    """All files of the report; the page comes first."""
    lengths = [int(h) for h in document["anr"]]
    by_length = {name: [document["anr"][str(h)].get(name) for h in lengths] for name in METHODS}
    means = [each["mean"] for each in document["anr"][str(document["list_length"])].values()]
    means += [each["mean"] for some in by_length.values() for each in some if each]
    means += [value for each in document["by_triplet"].values() for value in _anr(document, each).values()]
    scale = Scale([value for value in means if value > 0] or [1.0])
    told = {
        **document,
        "methods_shown": METHODS,
        "shown_name": display_name,
        "rows": list(_method_rows(document)),
        "encode_ms": _encode_ms(document),
    }
    page = render(
        out / "index.html",
        "paper_page.html",
        **told,
        bound=_BOUND,
        default=DEFAULT_RELEVANCE.value,
        curves={name: _curve(some, len(lengths), scale) for name, some in by_length.items()},
        lengths=lengths,
        scale=scale,
        dots={
            triplet: {name: (value, scale(value)) for name, value in _anr(document, each).items() if name in METHODS}
            for triplet, each in document["by_triplet"].items()
        },
        panels=_panels(document),
        trajectories=_trajectories(document["seasons"]),
        ranks=RANKS,
        n_hold={
            who: sum(each["verdict"] == HOLDS for each in document["claims"] if each["said_by"] == who)
            for who in ("paper", "us")
        },
    )
    text = render(out / "report.md", "paper_report.md", **told)
    table, whole = out / "figures.csv", out / "paper.json"
    table.write_text(_csv(document), encoding="utf-8")
    write_json(document, whole)
    return [page, text, table, whole]


class Scale:
    """ANR as a share of a logarithmic axis, 0 at its least decade and 1 at chance or above."""

    def __init__(self, values: Sequence[float]) -> None:
        self._low = math.floor(max(-3.0, math.log10(min(values))))
        self._high = math.log10(max(_CHANCE, *values))
        self.ticks = [10.0**power for power in range(self._low, 2)] + [_CHANCE]

    def __call__(self, value: float) -> float:
        """In percent of the axis."""
        at = (math.log10(max(value, 10.0**self._low)) - self._low) / (self._high - self._low)
        return round(100 * min(1.0, at), 2)


def _anr(document: Document, triplet: Document) -> dict[str, float]:
    anr: dict[str, float] = triplet["anr"][str(document["list_length"])]
    return anr


def _curve(figures: Sequence[Document | None], n: int, scale: Scale) -> dict[str, str]:
    """A line over list lengths, and the area of its interval; brute force has one value for all."""
    only = next((each for each in figures if each), None)
    flat = sum(each is not None for each in figures) == 1
    shown = [only if flat else each for each in figures]
    at = [(100 * place / max(1, n - 1), each) for place, each in enumerate(shown) if each is not None]

    def points(of: Callable[[Document], float], which: Sequence[tuple[float, Document]]) -> list[str]:
        return [f"{x:.2f},{100 - scale(of(each)):.2f}" for x, each in which]

    area = points(lambda each: each["drives"][0], at) + points(lambda each: each["drives"][1], at[::-1])
    return {"line": " ".join(points(lambda each: each["mean"], at)), "area": " ".join(area)}


def _panels(document: Document) -> list[dict[str, Any]]:
    """Fig. 7: a row a planner, best first."""
    told = (
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
    for setup, title, text, unit in told:
        figures = document["active"][setup]
        rows = [(name, each) for name, each in figures.items() if setup != "paper" or name != DEFAULT_PLANNER]
        most = max(each[group][1] for _, each in rows for group in ("stretches", "drives")) or 1.0
        panels.append(
            {
                "title": title,
                "text": text,
                "unit": unit,
                "digits": 2 if most > 1 else 3,
                "rows": [
                    {
                        "name": name,
                        "mean": each["mean"],
                        **{key: [round(100 * end / most, 2) for end in each[key]] for key in ("stretches", "drives")},
                        "at": round(100 * each["mean"] / most, 2),
                        "is_ours": name == (NNQL if setup == "paper" else DEFAULT_PLANNER),
                    }
                    for name, each in sorted(rows, key=lambda row: float(row[1]["mean"]))
                ],
            }
        )
    return panels


def _trajectories(seasons: Mapping[str, Document]) -> dict[str, Any] | None:
    """Paths in one box, north up; None where no drive knows its x, y."""
    known = {season: np.array(each["trajectory"]) for season, each in seasons.items() if each["trajectory"]}
    if not known:
        return None
    every = np.concatenate(list(known.values()))  # x north, y east
    low, span = every.min(axis=0), np.maximum(np.ptp(every, axis=0), 1e-9)
    tall, wide = (span / span.max() * 100).tolist()
    paths = {
        season: " ".join(
            f"{wide * (y - low[1]) / span[1]:.2f},{tall - tall * (x - low[0]) / span[0]:.2f}" for x, y in points
        )
        for season, points in known.items()
    }
    metres = 10 ** math.floor(math.log10(span.max() / 2))
    return {"paths": paths, "wide": wide, "tall": tall, "bar": 100 * metres / span.max(), "metres": metres}


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
            "recall": {metres: each[name] for metres, each in document["recall"].items()},
            "anr_at": {metres: each[name] for metres, each in document["anr_at"].items()},
        }


def _encode_ms(document: Document) -> float | None:
    took = [each["encode_ms"] for each in document["seasons"].values() if each["encode_ms"] is not None]
    return float(np.median(took)) if took else None


def _csv(document: Document) -> str:
    """Every figure of every triplet, one a line."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["triplet", "figure", "method", "list_length", "tolerance_m", "value"])
    h, first_m = document["list_length"], f"{document['config']['tolerances_m'][0]:g}"
    for triplet, each in document["by_triplet"].items():
        for length, anr in each["anr"].items():
            writer.writerows([triplet, "anr", name, length, first_m, value] for name, value in anr.items())
        for metres, recall in each["recall"].items():
            for name, at in recall.items():
                writer.writerows([triplet, f"recall_at_{k}", name, h, metres, value] for k, value in at.items())
        for setup, anr in each["active"].items():
            writer.writerows([triplet, f"active_anr_{setup}", name, h, "", value] for name, value in anr.items())
        for name, value in each["views_to_confident"].items():
            writer.writerow([triplet, "views_to_confident", name, h, "", value])
    return text.getvalue()
