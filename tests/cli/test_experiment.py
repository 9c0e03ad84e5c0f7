"""`deepsimbad experiment vpr` and `nbv`: their tables, their JSON, their options."""

import json
import re
import shutil
from functools import cache

import numpy as np
import pytest

from ..commands import run_command

READY = ("--evaluator", "feature_l2:none", "--n-landmarks", 40)
QUICK = (*READY, "--episodes", 6, "--training-episodes", 20)
RRF, SIMBAD, COMPOSED = (("--relevance", name) for name in ("rrf", "simbad", "composed"))
KEYS = set(
    """
    anr recall_at_1 recall_at_5 recall_at_10 default n_queries n_left_out index_bits_per_map_image seconds passive
    second_season config warnings encoding_dim bytes_per_encoding encode_ms
    """.split()  # noqa: SIM905
)
SEVEN = {"composed", "brute_force_u", "standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force"}
PLANNERS = {"random", "clairvoyant", "nnql", "informed", *(f"constant_{action_m}" for action_m in range(1, 11))}


def triplet_of(landmarks, training, test):
    return ("--landmarks", landmarks, "--training", training, "--test", test)


@pytest.fixture(scope="session")
def triplet(drives):
    return triplet_of(*(drives / f"{name}.npy" for name in ("landmarks", "summer", "winter")))


@pytest.fixture(scope="session")
def route(tmp_path_factory):
    """Three drives of one route of 130 m, long enough for ten moves of ten metres."""
    folder, rng = tmp_path_factory.mktemp("route"), np.random.default_rng(11)
    places = rng.normal(size=(130, 16))
    for name, noise in (("landmarks", 0.3), ("summer", 0.1), ("winter", 0.8)):
        np.save(folder / f"{name}.npy", (places + noise * rng.normal(size=places.shape)).astype(np.float32))
    return triplet_of(*(folder / f"{name}.npy" for name in ("landmarks", "summer", "winter")))


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """An experiment's one JSON document and its table; the same experiment is run once."""
    path = tmp_path_factory.mktemp("experiment") / "out.json"

    @cache
    def run(*arguments):
        ran = run_command(["deepsimbad", "experiment", *arguments, "--json", path])
        assert ran.code == 0, ran.err
        document = json.loads(path.read_text(), parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
        assert ran.err == "".join(f"warning: {warning}\n" for warning in document["warnings"])
        return document, ran.out

    return run


@pytest.fixture(scope="module")
def measure(measured):
    """The document alone."""
    return lambda *arguments: measured(*arguments)[0]


def test_vpr_is_one_document_with_the_stable_keys(measured, triplet):
    document, table = measured("vpr", *triplet, *READY)
    assert set(document) == KEYS
    assert set(document["anr"]) == set(document["recall_at_1"]) == set(document["recall_at_5"]) == SEVEN
    assert all(0 <= anr < 20 for anr in document["anr"].values()), document["anr"]
    assert (document["default"], document["n_queries"], document["n_left_out"]) == ("composed", 80, 0)
    config = document["config"]
    assert (config["n_landmarks"], config["list_length"], config["tolerance_m"], config["spacing_m"]) == (40, 4, 2, 1)
    assert config["training"].endswith("summer.npy")
    assert all(seconds >= 0 for seconds in document["seconds"].values())
    for name, anr in document["anr"].items():
        assert f"{anr:.2f}" in row_of(table, name)
    assert "80 queries scored" in table


def row_of(table, name):
    (row,) = [line for line in table.splitlines() if f" {name} " in line and "paired" not in line]
    return row


def test_nbv_is_one_document_with_the_stable_keys(measured, route):
    document, table = measured("nbv", *route, *QUICK)
    assert set(document) >= {"anr", "default", "anr_paper", "interval_95", "config"}
    assert set(document["anr"]) == set(document["anr_paper"]) == set(document["interval_95"]) == PLANNERS
    assert document["default"] == "informed"
    assert all(0 <= anr < 60 for anr in (*document["anr"].values(), *document["anr_paper"].values()))
    for name, (low, high) in document["interval_95"].items():
        assert low <= document["anr"][name] <= high
        assert f"{document['anr'][name]:.3f}" in row_of(table, name)
    expected = {"relevance": "composed", "update": "mixture", "n_landmarks": 40, "list_length": 4, "seed": 0}
    expected |= {"episodes": 6, "training_episodes": 20, "n_steps": 10, "spacing_m": 1.0}
    expected |= {"actions_m": list(range(1, 11))}
    assert {name: document["config"][name] for name in expected} == expected
    assert document["anr_at_distance_m"]["constant_1"]["50"] is None, "ten moves of a metre go ten metres"
    assert "informed (default)" in table


def test_vpr_drives_in_order_unless_every_view_is_by_itself(measured, triplet):
    document, table = measured("vpr", *triplet, *READY, *COMPOSED)
    passive = document["passive"]
    for figures in (passive["anr"], passive["recall_at_1"]):
        assert set(figures) == {"filter", "sum", "sum_any_speed", "sum_brute_force_u"}
        assert all(set(by_window) == {"1", "2", "5", "10", "20"} for by_window in figures.values())
    assert passive["n_queries"] == {"1": 80, "2": 79, "5": 76, "10": 71, "20": 61}
    assert passive["whole_drive"]["recall_at_1"] > 95
    anr, recall = (passive[figure]["sum_any_speed"]["5"] for figure in ("anr", "recall_at_1"))
    assert f"{anr:.2f} / {recall:.1f}" in row_of(table, "sum_any_speed")
    for options in (("--stateless", *COMPOSED), RRF):
        assert measured("vpr", *triplet, *READY, *options)[0]["passive"] is None


def test_how_much_lists_owe_to_their_own_places_landmarks(measure, deepsimbad, route):
    arguments = ("vpr", *route, *READY[:2], "--n-landmarks", 60, *COMPOSED, "--stateless")
    document, barred_document = measure(*arguments), measure(*arguments, "--bar-own-place")
    assert set(barred_document["anr"]) == {"composed", "brute_force_u"}
    assert barred_document["anr"]["composed"] > document["anr"]["composed"]
    assert barred_document["recall_at_1"]["brute_force_u"] == document["recall_at_1"]["brute_force_u"]
    assert deepsimbad("experiment", "vpr", *route, *READY, *RRF, "--bar-own-place").code == 2


def test_every_option_of_vpr_is_heeded(measure, triplet, drives):
    def anr(*options):
        return measure("vpr", *triplet, *READY, *RRF, *SIMBAD, *options)["anr"]

    def scored(part_of_training, part_of_test):
        parts = (f"{drives / 'summer.npy'}{part_of_training}", f"{drives / 'winter.npy'}{part_of_test}")
        document = measure("vpr", *triplet_of(triplet[1], *parts), *READY, *RRF, *SIMBAD)
        return document["n_queries"], document["n_left_out"], document["anr"]["rrf"]

    assert set(anr()) == {"rrf", "simbad"}
    assert anr("--tolerance", 9)["rrf"] < anr()["rrf"]
    assert anr("--list-length", 12)["rrf"] != anr()["rrf"]
    assert anr("--spacing-m", 3)["rrf"] > anr()["rrf"], "three metres apart, the neighbours are no longer right"
    assert scored("#0:40", "#30:60:2")[:2] == (6, 9), "30..40 lie within 2 m of the map, 42..58 do not"
    assert scored("#:20", "#60:") == (0, 20, None), "a number that JSON lacks becomes null"


def test_every_option_of_nbv_is_heeded(measure, route):
    options = (*RRF, "--seed", 7, "--list-length", 3, "--spacing-m", 2)
    document = measure("nbv", *route, *QUICK, *options)
    expected = {"relevance": "rrf", "update": "additive_relevance", "seed": 7, "list_length": 3, "spacing_m": 2.0}
    assert {name: document["config"][name] for name in expected} == expected, "an update that suits the relevance"
    other = measure("nbv", *route, *QUICK, *options, "--update", "additive_reciprocal_rank")
    assert other["config"]["update"] == "additive_reciprocal_rank"
    assert other["anr"]["constant_1"] != document["anr"]["constant_1"]
    assert other["anr_paper"]["constant_1"] == document["anr_paper"]["constant_1"], "the paper's is always the paper's"


def test_ground_truth_replaces_the_tolerance(measure, triplet, tmp_path):
    truth = tmp_path / "truth.npy"
    np.save(truth, np.array([[(place + 40) % 80] if place else [-1] for place in range(80)]))
    document = measure("vpr", *triplet, *READY, "--relevance", "brute_force", "--ground-truth", truth)
    assert (document["n_queries"], document["n_left_out"], document["config"]["ground_truth"]) == (79, 1, str(truth))
    assert document["anr"]["brute_force"] > 30, "half a route away is about chance"


def test_landmarks_of_another_season_are_told_from_those_of_elsewhere(measure, drives, tmp_path):
    """Positions count as comparable unless something else is said, or other truths are given."""
    np.save(tmp_path / "truth.npy", np.arange(80)[:, np.newaxis])
    truth = ("--ground-truth", tmp_path / "truth.npy")

    def season(landmarks, *options):
        sources = triplet_of(*(drives / f"{name}.npy" for name in (landmarks, "summer", "summer")))
        return measure("vpr", *sources, *READY, *COMPOSED, "--stateless", *options)["second_season"]

    assert season("winter")["accepted"]
    assert not season("landmarks")["accepted"]
    assert "are said not to share" in season("winter", "--no-same-route")["why"]
    assert "without x, y" in season("winter", *truth)["why"]
    assert season("winter", *truth, "--same-route")["accepted"]


def test_frames_left_out_are_told(measure, pictures, tmp_path):
    drive = shutil.copytree(pictures, tmp_path / "pictures")
    (drive / "4.png").write_bytes(b"broken")
    document = measure("vpr", *triplet_of(pictures, drive, pictures), "--n-landmarks", 20, *RRF)
    assert {role: list(counts.values()) for role, counts in document["config"]["left_out"].items()} == {
        "landmarks": [],
        "training": [1],
        "test": [],
    }
    assert "training: left out: 1 undecodable (4.png)" in document["warnings"]
    assert (document["n_queries"], document["n_left_out"]) == (29, 1)


def test_as_many_landmarks_are_taken_as_fit_and_the_number_is_told(measured, triplet):
    document, table = measured("vpr", *triplet, *READY[:2], *RRF)
    assert document["config"]["n_landmarks"] == 60, "every frame of the landmark drive"
    assert "60 landmarks" in table


def test_a_test_drive_that_was_learnt_from_is_warned_of_whatever_it_is_called(measure, drives, tmp_path):
    landmarks, summer, winter = (drives / f"{name}.npy" for name in ("landmarks", "summer", "winter"))
    copy = shutil.copy(winter, tmp_path / "copy.npy")
    for sources, roles in (
        ((landmarks, summer), []),
        ((copy, summer), ["landmarks"]),
        ((landmarks, copy), ["training"]),
        ((winter, copy), ["landmarks", "training"]),
    ):
        document = measure("vpr", *triplet_of(*sources, winter), *READY, *COMPOSED, "--stateless")
        warnings = "\n".join(document["warnings"])
        assert re.findall(r"^test_drive_known: .* the (\w+) drive", warnings, re.MULTILINE) == roles
    assert document["second_season"] is None, "one drive under two names is one season"


@pytest.mark.parametrize(
    ("kind", "options", "code"),
    [
        *(("vpr", options, 1) for options in ("--n-landmarks 99", "--list-length 41", "--ground-truth nowhere.npy")),
        *(("nbv", options, 1) for options in ("--n-landmarks 131", "--list-length 41", "--test {test}#:90")),
        *(("nbv", options, 2) for options in ("--episodes 1", "--seed -1", "--update none", "--relevance none")),
        *(("vpr", options, 1) for options in ("--training a.npy", "--landmarks wide.npy", "--test wide.npy")),
    ],
)
def test_named_errors_and_wrong_usage(deepsimbad, triplet, route, tmp_path, kind, options, code):
    np.save(tmp_path / "wide.npy", np.random.default_rng(3).normal(size=(80, 99)))  # from another encoder
    sources = (*triplet, *READY) if kind == "vpr" else (*route, *QUICK)
    ran = deepsimbad("experiment", kind, *sources, *options.format(test=route[-1]).split(), "--data-dir", "some")
    assert (ran.code, ran.out) == (code, ""), ran.err
    assert code == 2 or len(ran.err.splitlines()) == 1, ran.err
    assert not (tmp_path / "some").exists(), "an experiment makes no data directory"


@pytest.mark.slow
@pytest.mark.real_data
def test_the_corridor_by_its_own_ground_truth_as_a_process(process, real_data):
    corridor = real_data / "corridor"
    running = process(
        *("experiment", "vpr", *triplet_of(corridor / "query", corridor / "ref", corridor / "query")),
        *("--n-landmarks", 100, "--ground-truth", corridor / "ground_truth_new.npy", "--json"),
    )
    out, err = running.communicate(timeout=250)
    assert running.returncode == 0, err
    assert err.startswith("warning: test_drive_known: most frames of the test drive are in the landmarks drive too")
    document = json.loads(out)
    assert set(document) == KEYS
    assert (document["n_queries"], document["n_left_out"]) == (111, 0)
    assert document["anr"]["standardised"] < 20


def test_a_known_set_is_scored_as_its_papers_do_unless_told(deepsimbad, pictures, tmp_path):
    for drive in ("day_left", "day_right"):
        (tmp_path / drive).mkdir()
        for place in range(12):
            shutil.copy(pictures / f"{place}.png", tmp_path / drive / f"Image{place:03d}.png")
    left, right = (f"gardens_point:{tmp_path}/{drive}" for drive in ("day_left", "day_right"))
    options = ("--evaluator", "feature_l2:gradient_grid", "--n-landmarks", 8)
    arguments = ("experiment", "vpr", *triplet_of(left, left, right), *RRF, *options)
    ran = deepsimbad(*arguments)
    assert ran.code == 0, ran.err
    assert "true within 2.5 m" in ran.out
    assert "R@10" in ran.out
    assert "test: Gardens Point: 12 frames, true within 2 frames unless --tolerance says otherwise" in ran.err
    assert json.loads(deepsimbad(*arguments, "--tolerance", 0, "--json").out)["config"]["tolerance_m"] == 0


def test_an_evaluator_that_is_fitted_tells_how(measure, route):
    arguments = ("--evaluator", "autoencoder:none", "--n-landmarks", 40, *RRF, *COMPOSED)
    document = measure("vpr", *route, *arguments)
    assert document["config"]["evaluator"] == {"kind": "autoencoder", "extractor": "none"}
    assert document["fitting"]["n_shared_places"] == 130
    assert set(document["fitting"]["held_out"]) == {"autoencoder", "l2"}
    assert max(document["anr"].values()) < 10
