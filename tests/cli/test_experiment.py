"""`deepsimbad experiment vpr` and `nbv`: their tables, their JSON, their options."""

import json
import re
import shutil

import numpy as np
import pytest

READY = ("--evaluator", "feature_l2:none", "--n-landmarks", 40)
QUICK = (*READY, "--episodes", 6, "--training-episodes", 20)
KEYS = {
    *(
        "anr",
        "recall_at_1",
        "recall_at_5",
        "recall_at_10",
        "default",
        "n_queries",
        "n_left_out",
        "index_bits_per_map_image",
        "seconds",
    ),
    *("passive", "second_season", "config", "warnings", "encoding_dim", "bytes_per_encoding", "encode_ms"),
}
SEVEN = {"composed", "brute_force_u", "standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force"}
PLANNERS = {"random", "clairvoyant", "nnql", "informed", *(f"constant_{action_m}" for action_m in range(1, 11))}


def triplet_of(folder, test="winter"):
    roles = {"--landmarks": "landmarks", "--training": "summer", "--test": test}
    return [part for role, name in roles.items() for part in (role, folder / f"{name}.npy")]


@pytest.fixture
def triplet(drives):
    return triplet_of(drives)


@pytest.fixture(scope="session")
def route(tmp_path_factory):
    """Three drives of one route of 130 m, long enough for ten moves of ten metres."""
    folder, rng = tmp_path_factory.mktemp("route"), np.random.default_rng(11)
    places = rng.normal(size=(130, 16))
    for name, noise in (("landmarks", 0.3), ("summer", 0.1), ("winter", 0.8)):
        np.save(folder / f"{name}.npy", (places + noise * rng.normal(size=places.shape)).astype(np.float32))
    return triplet_of(folder)


@pytest.fixture
def measure(deepsimbad):
    """The one JSON document of an experiment."""

    def run(*arguments):
        ran = deepsimbad("experiment", *arguments, "--json")
        document = json.loads(ran.out, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
        expected = "".join(f"warning: {warning}\n" for warning in document["warnings"])
        assert (ran.code, ran.err) == (0, expected)
        return document

    return run


def test_vpr_is_one_document_with_the_stable_keys(measure, triplet):
    document = measure("vpr", *triplet, *READY)
    assert set(document) == KEYS
    assert set(document["anr"]) == set(document["recall_at_1"]) == set(document["recall_at_5"]) == SEVEN
    assert all(0 <= anr < 20 for anr in document["anr"].values()), document["anr"]
    assert (document["default"], document["n_queries"], document["n_left_out"]) == ("composed", 80, 0)
    config = document["config"]
    assert (config["n_landmarks"], config["list_length"], config["tolerance_m"], config["spacing_m"]) == (40, 4, 2, 1)
    assert config["training"].endswith("summer.npy")
    assert all(seconds >= 0 for seconds in document["seconds"].values())


def test_vpr_drives_in_order_unless_every_view_is_by_itself(measure, deepsimbad, triplet):
    passive = measure("vpr", *triplet, *READY, "--relevance", "composed")["passive"]
    sums = {"filter", "sum", "sum_any_speed", "sum_brute_force_u"}
    for of in ("anr", "recall_at_1"):
        assert set(passive[of]) == sums
        assert all(set(by_window) == {"1", "2", "5", "10", "20"} for by_window in passive[of].values())
    assert passive["n_queries"] == {"1": 80, "2": 79, "5": 76, "10": 71, "20": 61}
    assert passive["whole_drive"]["recall_at_1"] > 95
    output = deepsimbad("experiment", "vpr", *triplet, *READY, "--relevance", "composed").out
    (row,) = [line for line in output.splitlines() if " sum_any_speed " in line]
    assert f"{passive['anr']['sum_any_speed']['5']:.2f} / {passive['recall_at_1']['sum_any_speed']['5']:.1f}" in row
    for options in (("--stateless", "--relevance", "composed"), ("--relevance", "rrf")):
        assert measure("vpr", *triplet, *READY, *options)["passive"] is None


def test_how_much_lists_owe_to_their_own_places_landmarks(measure, deepsimbad, route):
    arguments = (*route, *READY[:2], "--n-landmarks", 60, "--relevance", "composed")
    document, barred_document = measure("vpr", *arguments), measure("vpr", *arguments, "--bar-own-place")
    assert set(barred_document["anr"]) == {"composed", "brute_force_u"}
    assert barred_document["anr"]["composed"] > document["anr"]["composed"]
    assert barred_document["recall_at_1"]["brute_force_u"] == document["recall_at_1"]["brute_force_u"]
    assert deepsimbad("experiment", "vpr", *route, *READY, "--relevance", "rrf", "--bar-own-place").code == 2


def test_nbv_is_one_document_with_the_stable_keys(measure, route):
    document = measure("nbv", *route, *QUICK)
    assert set(document) >= {"anr", "default", "anr_paper", "interval_95", "config"}
    assert set(document["anr"]) == set(document["anr_paper"]) == set(document["interval_95"]) == PLANNERS
    assert document["default"] == "informed"
    assert all(0 <= anr < 60 for anr in (*document["anr"].values(), *document["anr_paper"].values()))
    for name, (low, high) in document["interval_95"].items():
        assert low <= document["anr"][name] <= high
    config = document["config"]
    assert (config["relevance"], config["update"]) == ("composed", "mixture")
    assert (config["n_landmarks"], config["list_length"], config["seed"]) == (40, 4, 0)
    assert (config["episodes"], config["training_episodes"], config["n_steps"]) == (6, 20, 10)
    assert (config["actions_m"], config["spacing_m"]) == (list(range(1, 11)), 1.0)
    assert document["anr_at_distance_m"]["constant_1"]["50"] is None, "ten moves of a metre go ten metres"


@pytest.mark.parametrize("kind", ["vpr", "nbv"])
def test_json_into_a_file_leaves_the_table_to_people(deepsimbad, triplet, route, tmp_path, kind):
    arguments = (*triplet, *READY) if kind == "vpr" else (*route, *QUICK)
    ran = deepsimbad("experiment", kind, *arguments, "--json", tmp_path / "out.json")
    assert (ran.code, ran.err) == (0, "")
    for name, anr in json.loads((tmp_path / "out.json").read_text())["anr"].items():
        (row,) = [line for line in ran.out.splitlines() if f" {name} " in line and "paired" not in line]
        assert f"{anr:.2f}" in row if kind == "vpr" else f"{anr:.3f}" in row
    assert ("80 queries scored" if kind == "vpr" else "informed (default)") in ran.out


def test_every_option_of_vpr_is_heeded(measure, triplet, drives):
    only = ("--relevance", "rrf", "--relevance", "simbad")
    document = measure("vpr", *triplet, *READY, *only)
    assert set(document["anr"]) == {"rrf", "simbad"}
    assert measure("vpr", *triplet, *READY, *only, "--tolerance", 9)["anr"]["rrf"] < document["anr"]["rrf"]
    long = measure("vpr", *triplet, *READY, *only, "--list-length", 12)
    assert long["config"]["list_length"] == 12
    assert long["anr"]["rrf"] != document["anr"]["rrf"]
    far = measure("vpr", *triplet, *READY, *only, "--spacing-m", 3)
    assert far["anr"]["rrf"] > document["anr"]["rrf"], "three metres apart, the neighbours are no longer right"
    sliced = ("--training", f"{drives / 'summer.npy'}#0:40", "--test", f"{drives / 'winter.npy'}#30:60:2")
    part = measure("vpr", *triplet[:2], *sliced, *READY, *only)
    assert (part["n_queries"], part["n_left_out"]) == (6, 9), "30..40 lie within 2 m of the map, 42..58 do not"
    sources = ("--training", f"{drives / 'summer.npy'}#:20", "--test", f"{drives / 'winter.npy'}#60:")
    none = measure("vpr", *triplet[:2], *sources, *READY, *only)
    assert (none["n_queries"], set(none["anr"].values())) == (0, {None}), "a number that JSON lacks becomes null"


def test_every_option_of_nbv_is_heeded(measure, route):
    options = ("--relevance", "rrf", "--seed", 7, "--list-length", 3, "--spacing-m", 2)
    document = measure("nbv", *route, *QUICK, *options)
    config = document["config"]
    assert (config["relevance"], config["update"]) == ("rrf", "additive_relevance"), "an update that suits it"
    assert (config["seed"], config["list_length"], config["spacing_m"]) == (7, 3, 2.0)
    other = measure("nbv", *route, *QUICK, *options, "--update", "additive_reciprocal_rank")
    assert other["config"]["update"] == "additive_reciprocal_rank"
    assert other["anr"]["constant_1"] != document["anr"]["constant_1"]
    assert other["anr_paper"]["constant_1"] == document["anr_paper"]["constant_1"], "the paper's is always the paper's"


def test_ground_truth_replaces_the_tolerance(measure, triplet, tmp_path):
    np.save(tmp_path / "truth.npy", np.array([[(place + 40) % 80] if place else [-1] for place in range(80)]))
    document = measure("vpr", *triplet, *READY, "--ground-truth", tmp_path / "truth.npy")
    assert (document["n_queries"], document["n_left_out"]) == (79, 1)
    assert document["anr"]["brute_force"] > 30, "half a route away is about chance"
    assert document["config"]["ground_truth"] == str(tmp_path / "truth.npy")


def test_landmarks_of_another_season_are_told_from_those_of_elsewhere(measure, drives, tmp_path):
    """Positions count as comparable unless something else is said, or other truths are given."""
    np.save(tmp_path / "truth.npy", np.arange(80)[:, np.newaxis])
    truth = ("--ground-truth", tmp_path / "truth.npy")

    def season(landmarks, *options):
        triplet = ("--landmarks", drives / f"{landmarks}.npy", *triplet_of(drives, "summer")[2:])
        return measure("vpr", *triplet, *READY, "--relevance", "composed", *options)["second_season"]

    assert season("winter")["accepted"]
    assert not season("landmarks")["accepted"]
    assert "are said not to share" in season("winter", "--no-same-route")["why"]
    assert "without x, y" in season("winter", *truth)["why"]
    assert season("winter", *truth, "--same-route")["accepted"]


def test_frames_left_out_are_told(measure, pictures, tmp_path):
    copy = tmp_path / "pictures"
    copy.mkdir()
    for file in pictures.iterdir():
        (copy / file.name).write_bytes(b"broken" if file.name == "4.png" else file.read_bytes())
    triplet = ("--landmarks", pictures, "--training", copy, "--test", pictures)
    document = measure("vpr", *triplet, "--n-landmarks", 20)
    left_out = document["config"]["left_out"]
    assert left_out["landmarks"] == left_out["test"] == {}
    assert list(left_out["training"].values()) == [1]
    assert "training: left out: 1 undecodable (4.png)" in document["warnings"]
    assert (document["n_queries"], document["n_left_out"]) == (29, 1)


def test_as_many_landmarks_are_taken_as_fit_and_the_number_is_told(deepsimbad, measure, triplet):
    by_itself = ("--evaluator", "feature_l2:none", "--relevance", "rrf")
    assert measure("vpr", *triplet, *by_itself)["config"]["n_landmarks"] == 60, "every frame of the landmark drive"
    assert "60 landmarks" in deepsimbad("experiment", "vpr", *triplet, *by_itself).out


def test_a_test_drive_that_was_learnt_from_is_warned_of_whatever_it_is_called(measure, drives, tmp_path):
    np.save(tmp_path / "copy.npy", np.load(drives / "winter.npy"))

    def ran(landmarks, training):
        sources = ("--landmarks", landmarks, "--training", training, "--test", drives / "winter.npy")
        document = measure("vpr", *sources, *READY, "--relevance", "composed")
        return [
            re.findall(r"^test_drive_known: .* the (\w+) drive", warning) for warning in document["warnings"]
        ], document

    assert ran(drives / "landmarks.npy", drives / "summer.npy")[0] == []
    assert ran("copy.npy", drives / "summer.npy")[0] == [["landmarks"]]
    assert ran(drives / "landmarks.npy", "copy.npy")[0] == [["training"]]
    warned, document = ran(drives / "winter.npy", "copy.npy")
    assert warned == [["landmarks"], ["training"]]
    assert document["second_season"] is None, "one drive under two names is one season"


def test_named_errors(deepsimbad, triplet, route, tmp_path):
    short = [*route[:-1], f"{route[-1]}#:90"]
    for kind, sources, options in (
        *(("vpr", (*triplet, *READY), options) for options in (("--n-landmarks", 99), ("--list-length", 41))),
        ("vpr", (*triplet, *READY), ("--ground-truth", tmp_path / "nowhere.npy")),
        ("nbv", (*short, *QUICK), ()),
        *(("nbv", (*route, *QUICK), options) for options in (("--n-landmarks", 131), ("--list-length", 41))),
    ):
        ran = deepsimbad("experiment", kind, *sources, *options)
        assert (ran.code, ran.out, len(ran.err.splitlines())) == (1, "", 1), ran.err
    for options in (("--episodes", 1), ("--seed", -1), ("--update", "none"), ("--relevance", "none")):
        assert deepsimbad("experiment", "nbv", *route, *QUICK, *options).code == 2


def test_an_experiment_makes_no_data_directory(deepsimbad, tmp_path):
    arguments = ("--landmarks", "a.npy", "--training", "b.npy", "--test", "c.npy", "--data-dir", "some")
    ran = deepsimbad("experiment", "vpr", *arguments)
    assert ran.code == 1
    assert "a.npy" in ran.err
    assert not (tmp_path / "some").exists()


@pytest.mark.slow
@pytest.mark.real_data
def test_the_corridor_by_its_own_ground_truth_as_a_process(process, real_data):
    corridor = real_data / "corridor"
    running = process(
        *("experiment", "vpr", "--landmarks", f"{corridor / 'query'}", "--training", corridor / "ref"),
        *("--test", corridor / "query", "--n-landmarks", 100),
        *("--ground-truth", corridor / "ground_truth_new.npy", "--json"),
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
    arguments = ("experiment", "vpr", "--landmarks", left, "--training", left, "--test", right, "--relevance", "rrf")
    arguments = (*arguments, "--evaluator", "feature_l2:gradient_grid", "--n-landmarks", 8)
    ran = deepsimbad(*arguments)
    assert ran.code == 0, ran.err
    assert "true within 2.5 m" in ran.out
    assert "R@10" in ran.out
    assert "test: Gardens Point: 12 frames, true within 2 frames unless --tolerance says otherwise" in ran.err
    assert json.loads(deepsimbad(*arguments, "--tolerance", 0, "--json").out)["config"]["tolerance_m"] == 0


def test_an_evaluator_that_is_fitted_tells_how(measure, route):
    only = ("--relevance", "rrf", "--relevance", "composed")
    document = measure("vpr", *route, "--evaluator", "autoencoder:none", "--n-landmarks", 40, *only)
    assert document["config"]["evaluator"] == {"kind": "autoencoder", "extractor": "none"}
    assert document["fitting"]["n_shared_places"] == 130
    assert set(document["fitting"]["held_out"]) == {"autoencoder", "l2"}
    assert max(document["anr"][name] for name in ("rrf", "composed")) < 10
