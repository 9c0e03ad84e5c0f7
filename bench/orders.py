"""An experiment on three drives of one route in each of their six orders, and what the six come to.

    python -m bench.orders vpr|nbv|calibration DRIVE DRIVE DRIVE --keep FOLDER [-- OPTION ...]

Options go to `deepsimbad experiment`; MAP in one stands for the drive that is mapped. What an order came to is kept in
the folder, so that a run goes on where it ended.
"""

import itertools
import json
import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.measurement import Command, machine, markdown, print_page

Documents = Mapping[str, dict[str, Any]]  # by landmarks-map-test
READY = ("--evaluator", "feature_l2:none")  # of files of encodings


def measured(part: str, drives: list[str], folder: Path, options: list[str]) -> dict[str, dict[str, Any]]:
    """The experiment's document of every order, by its name; those in the folder are not run again."""
    folder.mkdir(parents=True, exist_ok=True)
    documents = {}
    for landmarks, training, test in itertools.permutations(drives):
        name = " ".join(Path(drive).stem for drive in (landmarks, training, test))
        path = folder / f"{part}-{name.replace(' ', '-')}.json"
        if not path.exists():
            arguments = ["--landmarks", landmarks, "--training", training, "--test", test]
            arguments += READY if test.endswith(".npy") else ()
            arguments += [option.replace("MAP", training) for option in options]
            command = [sys.executable, "-m", "deepsimbad", "experiment", part, *arguments, "--json", str(path)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own command
        documents[name] = json.loads(path.read_text(encoding="utf-8"))
        print(f"{len(documents)} of 6: {name}", file=sys.stderr)
    return documents


def vpr_lines(documents: Documents) -> Iterator[str]:
    """Tables by relevance, and of drives in order by window."""
    for title, of in (("R@1 %", "recall_at_1"), ("R@5 %", "recall_at_5")):
        rows = []
        for name in next(iter(documents.values()))["anr"]:
            anr = [document["anr"][name] for document in documents.values()]
            recall = [document[of][name] for document in documents.values()]
            rows.append([name, f"{np.mean(anr):.2f}", f"{np.mean(recall):.1f}", *(f"{value:.2f}" for value in anr)])
        yield from markdown(["relevance", "ANR %", title, *documents], rows)
        yield ""
    passive = [document["passive"] for document in documents.values() if document["passive"]]
    if passive:
        windows = passive[0]["n_queries"]
        rows = [[name, *(_of_window(passive, name, window) for window in windows)] for name in passive[0]["anr"]]
        yield from markdown(["ANR / R@1 in percent, views", *windows], rows)


def _of_window(passive: Sequence[dict[str, Any]], name: str, window: str) -> str:
    """Mean ANR and R@1 of a window, over all windows of all orders."""
    n_queries = [document["n_queries"][window] for document in passive]
    anr, recall = (
        np.average([document[of][name][window] for document in passive], weights=n_queries)
        for of in ("anr", "recall_at_1")
    )
    return f"{anr:.3f} / {recall:.1f}"


def nbv_lines(documents: Documents) -> Iterator[str]:
    """Tables by planner, and of the default against each order's best constant move."""
    tables = ("views_to_confident", "metres_to_confident", "wrong_when_confident", "anr", "anr_paper")
    planners = list(next(iter(documents.values()))["anr"])
    means = {
        of: {name: np.mean([document[of][name] for document in documents.values()]) for name in planners}
        for of in tables
    }
    rows = [
        [name, *(f"{means[of][name]:.{digits}f}" for of, digits in zip(tables, (2, 1, 1, 3, 2), strict=True))]
        for name in planners
    ]
    yield from markdown(["planner", "views", "metres", "sure and wrong, %", "ANR, %", "ANR as in the paper, %"], rows)
    yield ""
    rows, comparisons = [], []
    for order, document in documents.items():
        best, default, views = document["best_constant"], document["default"], document["views_to_confident"]
        low, high = document["views_difference_95"][f"{default} - {best}"]
        rows.append([order, best, f"{views[best]:.2f}", f"{views[default]:.2f}", f"{low:+.2f} .. {high:+.2f}"])
        comparisons.append((views[best], views[default], (high - low) / 2))
    constant_views, default_views, halves = np.array(comparisons).T
    difference, half = (
        float((default_views - constant_views).mean()),
        float(np.sqrt(np.square(halves).sum()) / len(halves)),
    )
    together = f"{difference - half:+.2f} .. {difference + half:+.2f}"
    rows.append(["all, as if independent", "", f"{constant_views.mean():.2f}", f"{default_views.mean():.2f}", together])
    yield from markdown(["order", "best constant", "views it takes", "the default", "difference, 95 %"], rows)


def calibration_lines(documents: Documents) -> Iterator[str]:
    """Tables of coverage by move length, of reliability, and of every other figure by order."""
    all_of, first = list(documents.values()), next(iter(documents.values()))
    views = list(next(iter(first["coverage_95"].values())))
    rows = []
    for move, wrong_of in zip(first["coverage_95"], first["wrong_when_confident"], strict=True):
        covered = {view: [document["coverage_95"][move][view] for document in all_of] for view in views}
        metres = {view: np.mean([document["set_m"][move][view] for document in all_of]) for view in views}
        wrong = [document["wrong_when_confident"][wrong_of] for document in all_of]
        rows.append(
            [
                f"{move} m",
                *(f"{np.mean(covered[view]):.1f}, {min(covered[view]):.1f}; {metres[view]:.0f} m" for view in views),
                f"{np.mean(wrong):.1f}, {max(wrong):.1f}",
            ]
        )
    yield from markdown(["moves", *(f"after {view}" for view in views), "wrong, %"], rows)
    yield ""
    held_masses, true_shares = (
        np.nanmean(np.array([document["reliability"][of] for document in all_of], float), axis=0)
        for of in ("near_mode", "within_5_m")
    )
    yield from markdown(
        ["held, %", *(f"{mass:.0f}" for mass in held_masses)], [["true, %", *(f"{share:.0f}" for share in true_shares)]]
    )
    yield ""
    rows = []
    for of in ("standing_coverage_95", "lost_their_place", "carried", "off_route", "odometry_coverage_95"):
        for key in first[of] if isinstance(first[of], dict) else [None]:
            figures = [document[of] if key is None else document[of][key] for document in all_of]
            name = of if key is None else f"{of}: {key}"
            row = [name, f"{np.mean(figures):.1f}", *(f"{figure:.1f}" for figure in figures)]
            rows.append(row)
    refused = [sum(document["views_refused"].values()) for document in all_of]
    rows.append(["views_refused", sum(refused), *refused])
    yield from markdown(["", "mean", *documents], rows)


TABLES = {"vpr": vpr_lines, "nbv": nbv_lines, "calibration": calibration_lines}


def lines(arguments: Namespace, options: list[str]) -> Iterator[str]:
    """The tables of a part, of experiments with these options."""
    yield from (machine(), "")
    yield from TABLES[arguments.part](measured(arguments.part, arguments.drives, arguments.keep, options))


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("part", choices=TABLES)
    command.add_argument("drives", nargs=3, metavar="DRIVE")
    command.add_argument("--keep", type=Path, required=True, metavar="FOLDER")
    words = [*sys.argv[1:], "--"]
    own_words, passed_on = words[: words.index("--")], words[words.index("--") + 1 : -1]
    command.run(lambda arguments: print_page(lines(arguments, passed_on)), own_words)
