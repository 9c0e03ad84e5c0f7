"""The check of a new map against the active one, and the gate that it keeps."""

import errno

import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.errors import (
    InvalidEncodingError,
    InvalidMapConfigError,
    InvalidRouteError,
    UnavailableError,
    UnknownTraverseError,
)
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import REMAP_STAGES
from deepsimbad.store import catalog_maps, map_file
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.records import MapState
from deepsimbad.store.traverses import Traverse

from .conftest import DOMAIN

PLACES, DIM = 60, 8
ALONG_M = np.arange(PLACES)


def season(noise, seed):
    """The same places, of which neighbours look alike, seen through some noise."""
    places = np.random.default_rng(99).normal(size=(PLACES + 2, DIM))
    places = (places[:-2] + places[1:-1] + places[2:]) / np.sqrt(3)
    return (places + noise * np.random.default_rng(seed).normal(size=(PLACES, DIM))).astype(np.float32)


def unordered(n, seed=0, d=DIM):
    """Encodings without any order: whoever finds its own image is first, whoever must not is anywhere."""
    return np.random.default_rng(seed).normal(size=(n, d))


NOISE = unordered(310)
# Name -> what is stored of it: `good` and `bad` drives of one route, another one, `day`, to check them on, and more.
DRIVES = {
    "landmarks": {"encodings": season(0.2, 1)},
    "good": {"encodings": season(0.2, 2)},
    "bad": {"encodings": season(4.0, 3)},
    "day": {"encodings": season(0.2, 4)},
    "half": {"encodings": season(0.2, 5)[:30]},
    "one": {"encodings": season(0.2, 2)[:1]},
    "elsewhere": {"encodings": season(0.2, 5), "position_m": 1000.0 + ALONG_M},
    "backwards": {"encodings": season(0.2, 5), "position_m": ALONG_M[::-1]},
    "planned": {"encodings": season(0.2, 2), "x_m": 1.0 * ALONG_M, "y_m": np.zeros(PLACES)},
    "shifted": {
        "encodings": season(0.2, 5),
        "position_m": 1000.0 + ALONG_M,
        "x_m": 1.0 * ALONG_M,
        "y_m": np.zeros(PLACES),
    },
    "short": {"encodings": np.eye(5, DIM - 1)},
    "new-encoder": {"encodings": unordered(PLACES, d=DIM + 1)},
    "its-landmarks": {"encodings": unordered(PLACES, d=DIM + 1) + 0.1},
    "noise": {"encodings": NOISE[:300]},
    "longer": {"encodings": NOISE},
    "stops": {"encodings": np.repeat(NOISE[:200], 2, axis=0), "position_m": np.repeat(np.arange(200.0), 2)},
    **{f"noise-{seed}": {"encodings": unordered(100, seed)} for seed in range(3)},
    "long": {"encodings": unordered(2500)},
    "long-again": {"encodings": unordered(2500), "position_m": np.arange(2500) + 0.5},
    "longest": {"encodings": unordered(3000, 1)},
}


@pytest.fixture
def remapped(run, store, catalog):
    """Makes a map of one of DRIVES, and stores the drives that are named first; returns the job's result."""

    def make(training, **config):
        config = {"landmark_traverse": "landmarks", "n_landmarks": 20, "training_episodes": 0, **config}
        for name in {training, config["landmark_traverse"], config.get("check_traverse")} & DRIVES.keys():
            if name not in Traverse.list(catalog.data_dir, DOMAIN):
                store(name, **DRIVES[name])
        return run(training, **config)

    return make


@pytest.fixture
def check(remapped):
    """What the check of such a map says."""
    return lambda training, **config: remapped(training, **config)["metrics"]["check"]


# --- what is measured ----------------------------------------------------------------------------------------------


def test_the_first_map_has_nothing_to_be_compared_with(remapped):
    result = remapped("good", gate_margin=0.0)
    assert result["active"] is True
    document = result["metrics"]["check"]
    assert document.pop("anr") < 20
    assert document == {
        "frames": "held_out",
        "traverse": None,
        "n_queries": 6,
        "n_left_out": 0,
        "tolerance_m": 2,
        "anr_active": None,
        "active_version": None,
        "gate_margin": 0.0,
        "passed": True,
        "why": "no map serves yet that the new one could be compared with",
        "warnings": [],
    }


def test_without_a_gate_nothing_is_judged(remapped):
    remapped("good")
    result = remapped("bad", check_traverse="day")
    document = result["metrics"]["check"]
    expected = {"passed": None, "gate_margin": None, "why": None, "active_version": 1}
    assert {name: document[name] for name in expected} == expected
    assert (result["active"], document["anr"] > document["anr_active"] + 1) == (True, True)


@pytest.mark.parametrize("relevance", list(Relevance))
def test_the_figure_is_that_of_localizations_one_by_one(remapped, check, catalog, evaluator, relevance):
    """Against the slow obvious way: every frame of the drive by itself, on the map as it is served."""
    remapped("bad", relevance=relevance)
    document = check("good", relevance=relevance, check_traverse="day")
    for version, figure in ((1, document["anr_active"]), (2, document["anr"])):
        snapshot = load_snapshot(catalog, DOMAIN, version)
        shares = []
        for place, encoding in enumerate(DRIVES["day"]["encodings"]):
            dissimilarities = evaluator.dissimilarities(encoding[np.newaxis], snapshot.landmark_model)[0]
            relevance_of = relevances(snapshot, Query(rank_landmarks(dissimilarities), dissimilarities, encoding))
            near = np.flatnonzero(np.abs(ALONG_M - place) <= 2)
            shares.append(rank_of_truth(relevance_of, near) / PLACES)
        assert figure == pytest.approx(100 * np.mean(shares), rel=1e-6)


APPEND = {"landmark_traverse": None, "n_landmarks": None, "append": True}


@pytest.mark.parametrize(
    ("steps", "frames", "n_queries", "least_anr"),
    [
        pytest.param([("noise", {})], "held_out", 30, 8, id="held out"),  # of the best of four neighbours
        pytest.param([("stops", {})], "held_out", 40, 8, id="taken where a held-out frame stood"),
        pytest.param([("noise", {}), ("longer", {**APPEND, "gate_margin": 0.0})], "held_out", 31, 8, id="known before"),
        pytest.param(
            [("noise-1", {}), ("noise-0", APPEND), ("noise-2", {**APPEND, "check_traverse": "noise-0"})],
            *("traverse", 100, 4),  # of the best of nine neighbours
            id="a check traverse that both maps have among others",
        ),
    ],
)
def test_frames_are_not_found_as_themselves(check, steps, frames, n_queries, least_anr):
    for training, config in steps:
        document = check(training, relevance=Relevance.BRUTE_FORCE, **config)
    assert (document["frames"], document["n_queries"]) == (frames, n_queries)
    assert document["active_version"] == (len(steps) - 1 or None)
    for figure in {document["anr"], document["anr_active"]} - {None}:
        assert least_anr < figure < 50, "0 would say that every frame found itself"


def test_the_same_traverse_again_is_no_worse_than_itself(remapped):
    remapped("good")
    result = remapped("good", gate_margin=0.0)
    document = result["metrics"]["check"]
    assert document["anr"] == pytest.approx(document["anr_active"])  # neither map may find the frames themselves
    assert result["active"] is True


def test_a_map_without_digests_is_known_by_the_names_of_its_traverses(check, store, monkeypatch):
    """As maps of before are: the active one has its frames at the same places under the same name."""
    for name in ("landmarks", "good"):
        store(name, **DRIVES[name])
    with monkeypatch.context() as of_before:
        of_before.setattr(Drive, "digests", lambda drive: None)
        check("good")
    document = check("good", gate_margin=0.0)
    assert document["anr"] == pytest.approx(document["anr_active"])
    assert "was made of traverse good itself" in check("bad", check_traverse="good", gate_margin=0.0)["why"]


def test_a_drive_of_the_same_name_is_another_where_its_frames_are(check, store, catalog):
    check("good")
    Traverse.delete(catalog.data_dir, DOMAIN, "good")
    store("good", season(0.2, 7))
    document = check("bad", check_traverse="good")
    assert (document["anr_active"] < document["anr"], document["n_left_out"]) == (True, 0)


@pytest.mark.parametrize(
    ("drives", "config", "n_queries", "n_left_out"),
    [
        pytest.param(["good", "half"], {"check_traverse": "day"}, 32, 28, id="30 places, and 2 m behind them"),
        pytest.param(["planned", "shifted"], {}, 6, 0, id="the same in the plane, a kilometre apart along the route"),
        pytest.param(["longest"], {"check_traverse": "long"}, 834, 0, id="a thousand frames at most"),
        pytest.param(["longest"], {}, 300, 0, id="a tenth of a long drive"),
    ],
)
def test_only_places_that_both_maps_hold_count(check, drives, config, n_queries, n_left_out):
    *_, document = [check(training, **config) for training in drives]
    assert (document["n_queries"], document["n_left_out"]) == (n_queries, n_left_out)
    assert (document["anr_active"] is not None) == (len(drives) > 1)


def test_a_map_of_one_image_has_nothing_to_hold_out(remapped):
    result = remapped("one", gate_margin=0.0)
    expected = {"anr": None, "n_queries": 0, "n_left_out": 1, "passed": True}
    assert {name: result["metrics"]["check"][name] for name in expected} == expected
    assert result["active"] is True


def test_a_check_on_the_drive_that_gave_a_map_its_landmarks_is_a_warning_by_name(check):
    def warnings(**config):
        return check("good", **config)["warnings"]

    assert warnings() == warnings(check_traverse="day") == []
    (of_active,) = warnings(check_traverse="landmarks", landmark_traverse=None)
    assert of_active.startswith("check_drive_known: map 2, which serves took its landmarks from traverse landmarks")
    assert len(warnings(check_traverse="landmarks")) == 1, "the map before kept its landmarks, and chose none"


# --- the gate ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("training", "config", "unknown", "reason"),
    [
        ("elsewhere", {}, ["anr_active"], "share no place of traverse elsewhere"),
        ("elsewhere", {"check_traverse": "day"}, ["anr", "anr_active"], "holds no place within 2 m of a frame of tr"),
        ("bad", {"check_traverse": "good"}, ["anr_active"], "was made of traverse good itself, so the two were not"),
        ("long", {"check_traverse": "long-again"}, ["anr", "anr_active"], "made of the frames of traverse long-again"),
        ("new-encoder", {"landmark_traverse": "its-landmarks"}, ["anr_active"], "another length"),
    ],
)
def test_what_cannot_be_compared_loses_its_gate(remapped, catalog, training, config, unknown, reason):
    remapped("good")
    result = remapped(training, gate_margin=100.0, **config)
    document = result["metrics"]["check"]
    assert [name for name in ("anr", "anr_active") if document[name] is None] == unknown
    assert reason in document["why"]
    assert (document["passed"], document["active_version"], result["active"]) == (False, 1, False)
    assert catalog.domain(DOMAIN).active_version == 1
    if "anr" in unknown:
        n_frames = {"day": PLACES, "long-again": 834}[config["check_traverse"]]
        assert (document["n_queries"], document["n_left_out"]) == (0, n_frames)


def test_a_damaged_active_map_does_not_keep_its_remedy_away(remapped, catalog):
    remapped("good")
    path = catalog.map_path(DOMAIN, 1)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1])
    result = remapped("good", gate_margin=0.0)
    assert (result["active"], "damaged" in result["metrics"]["check"]["why"]) == (True, True)


@pytest.mark.parametrize(
    ("module", "name", "error", "reason"),
    [
        (catalog_maps, "verify", OSError(errno.EIO, "Input/output error"), "io_error"),
        (map_file, "unpack_lists", MemoryError(), "out_of_memory"),
    ],
)
def test_no_gate_opens_because_a_sound_map_could_not_be_read(
    remapped, catalog, monkeypatch, module, name, error, reason
):
    def fail(*_):
        raise error

    remapped("good")
    monkeypatch.setattr(module, name, fail)
    with pytest.raises(UnavailableError, match="map 1 of domain route could not be read") as caught:
        remapped("bad", check_traverse="day", gate_margin=1.0)
    assert (caught.value.code, caught.value.hints["reason"]) == ("unavailable", reason)
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]
    assert catalog.domain(DOMAIN).active_version == 1


@pytest.mark.parametrize(
    ("check_traverse", "error", "says"),
    [
        ("nowhere", UnknownTraverseError, "nowhere"),
        ("short", InvalidEncodingError, "short holds encodings of 7"),
        ("backwards", InvalidRouteError, "backwards at frame 1"),
        ("good", InvalidMapConfigError, "another check_traverse"),
    ],
)
def test_an_unsuitable_check_traverse_is_named_before_anything_is_built(remapped, catalog, check_traverse, error, says):
    with pytest.raises(error, match=says):
        remapped("good", check_traverse=check_traverse)
    assert catalog.maps(DOMAIN) == []


@pytest.mark.parametrize(("gate_margin", "active_version"), [(None, 3), (0.0, 1)], ids=["no gate", "a gate"])
def test_a_rollback_during_the_remap(remapped, catalog, gate_margin, active_version):
    """Without a gate the last word wins; one that compared with another map does not open.

    Compared with the bad map the new one passes; an operator has gone back to the good one meanwhile.
    """
    for training in ("good", "bad"):
        remapped(training)

    rollbacks = []

    def roll_back(state):
        if state.stage == "seal" and not rollbacks:
            rollbacks.append(catalog.activate(DOMAIN, 1, ANY))

    config = {"gate_margin": gate_margin, "check_traverse": None if gate_margin is None else "good"}
    result = remapped("day", progress=Progress(REMAP_STAGES, roll_back), training_episodes=10, **config)
    assert rollbacks
    assert (result["active"], catalog.domain(DOMAIN).active_version) == (active_version == 3, active_version)
    if gate_margin is not None:
        document = result["metrics"]["check"]
        assert (document["active_version"], document["passed"]) == (2, True)
        assert "serves map version 1, not map version 2" in document["why"]
        assert catalog.map(DOMAIN, 3).state is MapState.SEALED
