"""`deepsimbad experiment paper`: section III on what drives there are, kept, and told on one page."""

import csv
import json
import re

import cv2
import numpy as np
import pytest

import deepsimbad.jobs.experiments.paper as job
import deepsimbad.jobs.progress as progress
from deepsimbad.cli.paper_page import METHODS
from deepsimbad.errors import CancelledError
from deepsimbad.evaluators.feature_l2 import FeatureL2

QUICK = ("--evaluator", "feature_l2:none", "--n-landmarks", 8, "--training-episodes", 20, "--episodes", 2)
DATES = {"landmarks": "2012-01-22", "training": "2012-03-31", "test": "2012-08-04"}


@pytest.fixture(scope="module")
def encodings(tmp_path_factory):
    """Three of the four drives, ready encoded; autumn is not there."""
    folder = tmp_path_factory.mktemp("nclt")
    rng = np.random.default_rng(2)
    places = rng.normal(size=(112, 12))
    for date in DATES.values():
        season = rng.normal(size=12)
        np.save(folder / f"{date}.npy", (places + season + 0.5 * rng.normal(size=places.shape)).astype(np.float32))
    return folder


def paper(deepsimbad, encodings, *options):
    return deepsimbad("experiment", "paper", "--nclt", encodings, "--out", "out", *QUICK, *options)


@pytest.mark.slow
def test_figures_are_those_of_the_single_experiments_and_the_page_holds_them(deepsimbad, encodings, tmp_path):
    ran = paper(deepsimbad, encodings, "--json", "paper.json")
    assert ran.code == 0, ran.err
    assert "AU is missing: 2012-11-17: no images of NCLT" in ran.err
    document = json.loads((tmp_path / "paper.json").read_text())
    assert list(document["by_triplet"]) == ["WI-SP-SU", "SP-SU-WI"]
    assert set(document["not_run"]) == {"WI-SP-AU", "SP-SU-AU", "SU-AU-WI", "SU-AU-SP", "AU-WI-SP", "AU-WI-SU"}
    assert list(document["anr"]) == ["1", "2", "4", "8"], "no list is longer than there are landmarks"

    sources = [part for role, date in DATES.items() for part in (f"--{role}", encodings / f"{date}.npy")]
    arguments = (*sources, "--evaluator", "feature_l2:none", "--n-landmarks", 8)
    triplet = document["by_triplet"]["WI-SP-SU"]
    for h in (2, 4):
        single = json.loads(deepsimbad("experiment", "vpr", *arguments, "--list-length", h, "--json").out)
        assert triplet["anr"][str(h)] == {name: single["anr"][name] for name in triplet["anr"][str(h)]}
    assert triplet["recall"]["2"]["rrf"]["10"] == single["recall_at_10"]["rrf"]
    assert document["index_bits_per_map_image"]["composed"] > 0
    active = json.loads(deepsimbad("experiment", "nbv", *arguments, *QUICK[4:], "--json").out)
    for setup, part in (("ours", "anr"), ("paper", "anr_paper")):
        assert triplet["active"][setup] == {name: active[part][name] for name in triplet["active"][setup]}
        assert set(active[part]) - set(triplet["active"][setup]) == {"clairvoyant"}
    assert triplet["views_to_confident"]["informed"] == active["views_to_confident"]["informed"]

    mean = np.mean([triplet_document["anr"]["4"]["rrf"] for triplet_document in document["by_triplet"].values()])
    assert document["anr"]["4"]["rrf"]["mean"] == pytest.approx(mean)
    claim = document["claims"][0]
    low, high = claim["difference"]["stretches"]
    assert low <= claim["values"]["brute_force"] - claim["values"]["rrf"] <= high
    verdicts = {"holds": high < 0, "does not hold": low > 0}
    assert all(is_so for verdict, is_so in verdicts.items() if verdict == claim["verdict"])

    page = (tmp_path / "out" / "index.html").read_text()
    assert re.findall(r"(?:src|href)=\"(?!#)", page) == []
    assert "<script" not in page
    assert "prefers-color-scheme: dark" in page
    assert all(label in page for label in METHODS.values())
    assert "AU is missing" in page
    rows = list(csv.DictReader((tmp_path / "out" / "figures.csv").read_text().splitlines()))
    figure_rows = [
        row for row in rows if row["figure"] == "anr" and row["method"] == "rrf" and row["list_length"] == "4"
    ]
    assert {row["triplet"]: float(row["value"]) for row in figure_rows}["WI-SP-SU"] == triplet["anr"]["4"]["rrf"]
    assert "| RRF |" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_and_nothing_stale_is_taken(deepsimbad, encodings, monkeypatch):
    calls, score = [], job.score_maps

    def stopped_at_the_third(*arguments, **options):
        if len(calls) == 3:
            raise CancelledError("cancelled")
        calls.append(1)
        return score(*arguments, **options)

    monkeypatch.setattr(progress, "available_cores", lambda: 1)
    monkeypatch.setattr(job, "score_maps", stopped_at_the_third)
    ran = paper(deepsimbad, encodings)
    assert (ran.code, "goes on where it stopped" in ran.err) == (130, True)
    counted = []
    monkeypatch.setattr(job, "score_maps", lambda *a, **o: counted.append(1) or score(*a, **o))
    assert paper(deepsimbad, encodings).code == 0
    assert len(counted) == 2 * 4 - 3, "two triplets at four list lengths, less what was kept"
    builds, build = [], job.build_maps
    monkeypatch.setattr(job, "build_maps", lambda *arguments: builds.append(1) or build(*arguments))
    assert paper(deepsimbad, encodings).code == 0
    assert not builds, "nothing was left to measure"
    assert paper(deepsimbad, encodings, "--tolerance", 3).code == 0
    assert len(builds) == 2, "another tolerance is measured anew, on a map of each pair"


@pytest.mark.slow
def test_nclt_as_downloaded_is_encoded_once_even_when_it_is_stopped(deepsimbad, tmp_path, monkeypatch):
    began_us = 1_326_030_975_000_000
    for number, date in enumerate(DATES.values()):
        folder = tmp_path / "nclt" / date / "lb3" / "Cam5"
        folder.mkdir(parents=True)
        for place in range(112):
            coarse = np.random.default_rng(place).integers(0, 200, (6, 8, 3), np.uint8) + np.uint8(20 * number)
            picture = cv2.resize(coarse, (64, 48), interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(folder / f"{began_us + 1_000_000 * place}.tiff"), picture)
        truth = tmp_path / "nclt" / "ground_truth" / f"groundtruth_{date}.csv"
        truth.parent.mkdir(exist_ok=True)
        rows = (f"{began_us + 100_000 * row},{row / 10},3,0,0,0,0" for row in range(1121))
        truth.write_text("\n".join(rows))
    encoded, encode = [], FeatureL2.encode

    def counted(self, images):
        if len(encoded) >= stop_at:
            raise CancelledError("cancelled")
        encoded.extend(images)
        return encode(self, images)

    stop_at = 150
    monkeypatch.setattr(FeatureL2, "encode", counted)
    monkeypatch.setattr(progress, "available_cores", lambda: 1)
    arguments = ("experiment", "paper", "--nclt", tmp_path / "nclt", "--out", "out", *QUICK[2:])
    assert deepsimbad(*arguments, "--evaluator", "feature_l2:gradient_grid").code == 130
    stop_at = 10_000
    ran = deepsimbad(*arguments, "--evaluator", "feature_l2:gradient_grid", "--json")
    assert ran.code == 0, ran.err
    assert len(encoded) == 3 * 112, "every image once"
    document = json.loads(ran.out)
    assert document["seasons"]["WI"]["length_m"] == pytest.approx(111, abs=1)
    assert document["seasons"]["WI"]["encode_ms"] > 0
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count('<polyline class="s-WI"') == 1, "where it drove is drawn"


def test_without_the_drives_of_a_triplet_it_says_which_are_missing(deepsimbad, tmp_path):
    ran = deepsimbad("experiment", "paper", "--nclt", tmp_path, *QUICK)
    assert ran.code == 1
    assert "has the drives of no triplet" in ran.err
    assert all(date in ran.err for date in DATES.values())
    for date in DATES.values():
        np.save(tmp_path / f"{date}.npy", np.random.default_rng(3).normal(size=(60, 12)))
    ran = deepsimbad("experiment", "paper", "--nclt", tmp_path, *QUICK)
    assert (ran.code, ran.err.count("it is 59 m long, and an episode takes 100 m")) == (1, 3)
