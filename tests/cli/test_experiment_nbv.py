"""`deepsimbad experiment nbv`: its table, its JSON, its options."""

import json

import numpy as np
import pytest

QUICK = ("--evaluator", "feature_l2:none", "--n-landmarks", 40, "--episodes", 6, "--training-episodes", 20)
PLANNERS = {"random", "clairvoyant", "nnql", "telling", *(f"constant_{action_m}" for action_m in range(1, 11))}
PROMISED = {"anr", "default", "anr_paper", "interval_95", "config"}


@pytest.fixture(scope="session")
def route(tmp_path_factory):
    """Three drives of one route of 130 m, long enough for ten moves of ten metres."""
    folder = tmp_path_factory.mktemp("route")
    rng = np.random.default_rng(11)
    places = rng.normal(size=(130, 16))
    for name, noise in (("landmarks", 0.3), ("summer", 0.1), ("winter", 0.8)):
        np.save(folder / f"{name}.npy", (places + noise * rng.normal(size=places.shape)).astype(np.float32))
    roles = {"--landmarks": "landmarks", "--training": "summer", "--test": "winter"}
    return [part for role, name in roles.items() for part in (role, folder / f"{name}.npy")]


def document_of(ran):
    assert (ran.code, ran.err) == (0, "")
    return json.loads(ran.out, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))


def test_json_is_one_document_with_the_stable_keys(deepsimbad, route):
    document = document_of(deepsimbad("experiment", "nbv", *route, *QUICK, "--json"))
    assert set(document) >= PROMISED
    assert set(document["anr"]) == set(document["anr_paper"]) == set(document["interval_95"]) == PLANNERS
    assert document["default"] == "telling"
    assert all(0 <= anr < 60 for anr in (*document["anr"].values(), *document["anr_paper"].values()))
    for name, (low, high) in document["interval_95"].items():
        assert low <= document["anr"][name] <= high
    config = document["config"]
    assert (config["relevance"], config["update"]) == ("calibrated", "log_likelihood")
    assert (config["n_landmarks"], config["list_length"], config["seed"]) == (40, 4, 0)
    assert (config["episodes"], config["training_episodes"], config["n_steps"]) == (6, 20, 10)
    assert config["actions_m"] == list(range(1, 11))
    assert config["spacing_m"] == 1.0
    assert config["test"].endswith("winter.npy")
    assert set(document["anr_at_distance_m"]["constant_1"]) == {"10", "20", "50"}
    assert document["anr_at_distance_m"]["constant_1"]["50"] is None, "ten moves of a metre go ten metres"


def test_json_into_a_file_leaves_the_table_to_people(deepsimbad, route, tmp_path):
    ran = deepsimbad("experiment", "nbv", *route, *QUICK, "--json", tmp_path / "nbv.json")
    assert (ran.code, ran.err) == (0, "")
    document = json.loads((tmp_path / "nbv.json").read_text())
    for name, anr in document["anr"].items():
        (row,) = [line for line in ran.out.splitlines() if f" {name} " in line and "paired" not in line]
        assert f"{anr:.3f}" in row
    assert "telling (default)" in ran.out
    assert "telling - random" in ran.out


def test_every_option_is_heeded(deepsimbad, route):
    options = ("--relevance", "rrf", "--seed", 7, "--list-length", 3, "--spacing-m", 2)
    document = document_of(deepsimbad("experiment", "nbv", *route, *QUICK, *options, "--json"))
    config = document["config"]
    assert (config["relevance"], config["update"]) == ("rrf", "additive_relevance"), "an update that suits it"
    assert (config["seed"], config["list_length"], config["spacing_m"]) == (7, 3, 2.0)
    other = document_of(
        deepsimbad("experiment", "nbv", *route, *QUICK, *options, "--update", "additive_reciprocal_rank", "--json")
    )
    assert other["config"]["update"] == "additive_reciprocal_rank"
    assert other["anr"]["constant_1"] != document["anr"]["constant_1"]
    assert other["anr_paper"]["constant_1"] == document["anr_paper"]["constant_1"], "the paper's is always the paper's"


def test_named_errors(deepsimbad, route):
    short = [*route[:-1], f"{route[-1]}#:90"]
    for sources, more in ((short, ()), (route, ("--n-landmarks", 131)), (route, ("--list-length", 41))):
        ran = deepsimbad("experiment", "nbv", *sources, *QUICK, *more)
        assert (ran.code, ran.out) == (1, "")
        assert len(ran.err.splitlines()) == 1, ran.err
    for more in (("--episodes", 1), ("--seed", -1), ("--update", "none"), ("--relevance", "none")):
        assert deepsimbad("experiment", "nbv", *route, *QUICK, *more).code == 2
