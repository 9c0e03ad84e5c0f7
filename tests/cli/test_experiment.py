"""`deepsimbad experiment vpr`: its table, its JSON, its options."""

import json
import subprocess

import numpy as np
import pytest

READY = ("--evaluator", "feature_l2:none", "--n-landmarks", 40)
KEYS = {
    "anr",
    "recall_at_1",
    "recall_at_5",
    "default",
    "n_queries",
    "n_left_out",
    "index_bits_per_map_image",
    "second_season",
    "config",
    "seconds",
    "encoding_dim",
    "bytes_per_encoding",
    "encode_ms",
}
SIX = {"calibrated", "standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force"}


@pytest.fixture
def triplet(drives):
    roles = {"--landmarks": "landmarks", "--training": "summer", "--test": "winter"}
    return [part for role, name in roles.items() for part in (role, drives / f"{name}.npy")]


def test_json_is_one_document_with_the_stable_keys(deepsimbad, triplet):
    ran = deepsimbad("experiment", "vpr", *triplet, *READY, "--json")
    assert (ran.code, ran.err) == (0, "")
    document = json.loads(ran.out)
    assert set(document) == KEYS
    assert set(document["anr"]) == set(document["recall_at_1"]) == set(document["recall_at_5"]) == SIX
    assert all(0 <= anr < 20 for anr in document["anr"].values()), document["anr"]
    assert document["default"] == "calibrated"
    assert (document["n_queries"], document["n_left_out"]) == (80, 0)
    assert document["config"]["n_landmarks"] == 40
    assert document["config"]["list_length"] == 4
    assert document["config"]["tolerance_m"] == 2.0
    assert document["config"]["spacing_m"] == 1.0
    assert document["config"]["training"].endswith("summer.npy")
    assert all(seconds >= 0 for seconds in document["seconds"].values())


def test_json_into_a_file_leaves_the_table_to_people(deepsimbad, triplet, tmp_path):
    ran = deepsimbad("experiment", "vpr", *triplet, *READY, "--json", tmp_path / "vpr.json")
    assert (ran.code, ran.err) == (0, "")
    document = json.loads((tmp_path / "vpr.json").read_text())
    assert set(document) == KEYS
    for name, anr in document["anr"].items():
        (row,) = [line for line in ran.out.splitlines() if f" {name} " in line]
        assert f"{anr:.2f}" in row
    assert "80 queries scored" in ran.out


def test_only_the_relevances_asked_for(deepsimbad, triplet):
    ran = deepsimbad("experiment", "vpr", *triplet, *READY, "--relevance", "rrf", "--relevance", "simbad", "--json")
    assert set(json.loads(ran.out)["anr"]) == {"rrf", "simbad"}


def test_every_option_is_heeded(deepsimbad, triplet):
    usual = json.loads(deepsimbad("experiment", "vpr", *triplet, *READY, "--json").out)
    wide = json.loads(deepsimbad("experiment", "vpr", *triplet, *READY, "--tolerance", 9, "--json").out)
    assert wide["anr"]["rrf"] < usual["anr"]["rrf"]
    long = json.loads(deepsimbad("experiment", "vpr", *triplet, *READY, "--list-length", 12, "--json").out)
    assert long["config"]["list_length"] == 12
    assert long["anr"]["rrf"] != usual["anr"]["rrf"]
    far = json.loads(deepsimbad("experiment", "vpr", *triplet, *READY, "--spacing-m", 3, "--json").out)
    assert far["config"]["spacing_m"] == 3.0
    assert far["anr"]["rrf"] > usual["anr"]["rrf"], "three metres apart, the neighbours are no longer right"


def test_slices_pick_frames_that_keep_their_places(deepsimbad, drives):
    triplet = (
        *("--landmarks", drives / "landmarks.npy"),
        *("--training", f"{drives / 'summer.npy'}#0:40"),
        *("--test", f"{drives / 'winter.npy'}#30:60:2"),
    )
    document = json.loads(deepsimbad("experiment", "vpr", *triplet, *READY, "--json").out)
    assert (document["n_queries"], document["n_left_out"]) == (6, 9), "30..40 lie within 2 m of the map, 42..58 do not"


def test_ground_truth_replaces_the_tolerance(deepsimbad, triplet, tmp_path):
    np.save(tmp_path / "truth.npy", np.array([[(place + 40) % 80] if place else [-1] for place in range(80)]))
    ran = deepsimbad("experiment", "vpr", *triplet, *READY, "--ground-truth", tmp_path / "truth.npy", "--json")
    document = json.loads(ran.out)
    assert (document["n_queries"], document["n_left_out"]) == (79, 1)
    assert document["anr"]["brute_force"] > 30, "half a route away is about chance"
    assert document["config"]["ground_truth"] == str(tmp_path / "truth.npy")


def test_landmarks_of_another_season_are_told_from_those_of_elsewhere(deepsimbad, drives, tmp_path):
    """Positions count as comparable unless something else is said, or other truths are given."""
    np.save(tmp_path / "truth.npy", np.arange(80)[:, np.newaxis])
    truth = ("--ground-truth", tmp_path / "truth.npy")

    def season(landmarks, *said):
        roles = {"--landmarks": landmarks, "--training": "summer", "--test": "summer"}
        triplet = [part for role, name in roles.items() for part in (role, drives / f"{name}.npy")]
        ran = deepsimbad("experiment", "vpr", *triplet, *READY, "--relevance", "calibrated", *said, "--json")
        return json.loads(ran.out)["second_season"]

    assert season("winter")["accepted"]
    assert not season("landmarks")["accepted"]
    assert "are said not to share" in season("winter", "--no-same-route")["why"]
    assert "without x, y" in season("winter", *truth)["why"]
    assert season("winter", *truth, "--same-route")["accepted"]


def test_frames_left_out_are_told(deepsimbad, pictures, tmp_path):
    copy = tmp_path / "pictures"
    copy.mkdir()
    for file in pictures.iterdir():
        (copy / file.name).write_bytes(b"broken" if file.name == "4.png" else file.read_bytes())
    triplet = ("--landmarks", pictures, "--training", copy, "--test", pictures)
    document = json.loads(deepsimbad("experiment", "vpr", *triplet, "--n-landmarks", 20, "--json").out)
    left_out = document["config"]["left_out"]
    assert left_out["landmarks"] == left_out["test"] == {}
    assert list(left_out["training"].values()) == [1]
    assert (document["n_queries"], document["n_left_out"]) == (29, 1)


def test_named_errors(deepsimbad, triplet, tmp_path):
    for more in (("--n-landmarks", 99), ("--ground-truth", tmp_path / "nowhere.npy"), ("--list-length", 41)):
        ran = deepsimbad("experiment", "vpr", *triplet, *READY, *more)
        assert (ran.code, ran.out) == (1, "")
        assert len(ran.err.splitlines()) == 1, ran.err


def test_a_number_json_lacks_becomes_null(deepsimbad, drives):
    triplet = (
        *("--landmarks", drives / "landmarks.npy"),
        *("--training", f"{drives / 'summer.npy'}#:20"),
        *("--test", f"{drives / 'winter.npy'}#60:"),
    )
    ran = deepsimbad("experiment", "vpr", *triplet, *READY, "--json")
    assert ran.code == 0
    document = json.loads(ran.out, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    assert document["n_queries"] == 0
    assert set(document["anr"].values()) == {None}


@pytest.mark.slow
def test_as_a_process(process, triplet):
    running = process("experiment", "vpr", *triplet, *READY, "--json")
    out, err = running.communicate(timeout=120)
    assert (running.returncode, err) == (0, "")
    assert set(json.loads(out)) == KEYS


@pytest.mark.slow
@pytest.mark.real_data
def test_the_corridor_by_its_own_ground_truth(process, real_data):
    corridor = real_data / "corridor"
    running: subprocess.Popen[str] = process(
        *("experiment", "vpr", "--landmarks", f"{corridor / 'query'}", "--training", corridor / "ref"),
        *("--test", corridor / "query", "--n-landmarks", 100),
        *("--ground-truth", corridor / "ground_truth_new.npy", "--json"),
    )
    out, err = running.communicate(timeout=250)
    assert running.returncode == 0, err
    document = json.loads(out)
    assert (document["n_queries"], document["n_left_out"]) == (111, 0)
    assert document["anr"]["standardised"] < 20
