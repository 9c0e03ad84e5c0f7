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
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig
from deepsimbad.store import catalog_maps, map_file
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.records import MapState
from deepsimbad.store.traverses import Traverse

DOMAIN = "route"
PLACES, DIM = 60, 8


def season(noise, seed):
    """The same places, of which neighbours look alike, seen through some noise."""
    places = np.random.default_rng(99).normal(size=(PLACES + 2, DIM))
    places = (places[:-2] + places[1:-1] + places[2:]) / np.sqrt(3)
    return (places + noise * np.random.default_rng(seed).normal(size=(PLACES, DIM))).astype(np.float32)


@pytest.fixture
def store(catalog):
    def put(name, encodings, position_m=None, x_m=None):
        n = len(encodings)
        frames = Drive(
            position_m=np.arange(n, dtype=float) if position_m is None else np.asarray(position_m, float),
            x_m=None if x_m is None else np.asarray(x_m, float),
            y_m=None if x_m is None else np.zeros(n),
            encodings=np.asarray(encodings, np.float32),
        )
        with Traverse.create(catalog.data_dir, DOMAIN, name) as traverse:
            traverse.put_frames(frames)

    return put


@pytest.fixture
def remapped(catalog, evaluator):
    def run(**config):
        parameters = {"landmark_traverse": "landmarks", "n_landmarks": 20, "training_episodes": 0} | config
        return remap(catalog, DOMAIN, RemapConfig(**parameters), evaluator, Progress(REMAP_STAGES))

    return run


@pytest.fixture
def seasons(store):
    """`good` and `bad` drives of one route, another drive `day` to check them on, and one to take landmarks from."""
    store("landmarks", season(0.2, 1))
    store("good", season(0.2, 2))
    store("bad", season(4.0, 3))
    store("day", season(0.2, 4))


def test_the_first_map_has_nothing_to_be_compared_with(seasons, remapped):
    result = remapped(training_traverse="good", gate_margin=0.0)
    check = result["metrics"]["check"]
    assert result["active"] is True
    assert check["anr"] < 20
    assert {name: check[name] for name in check if name != "anr"} == {
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


def test_without_a_gate_nothing_is_judged(seasons, remapped):
    remapped(training_traverse="good")
    result = remapped(training_traverse="bad", check_traverse="day")
    assert result["active"] is True
    check = result["metrics"]["check"]
    assert (check["passed"], check["gate_margin"], check["why"]) == (None, None, None)
    assert check["anr"] > check["anr_active"] + 1
    assert check["active_version"] == 1


@pytest.mark.parametrize("relevance", list(Relevance))
def test_the_figure_is_that_of_localizations_one_by_one(seasons, remapped, catalog, evaluator, relevance):
    """Against the slow obvious way: every frame of the drive by itself, on the map as it is served."""
    remapped(training_traverse="bad", relevance=relevance)
    check = remapped(training_traverse="good", relevance=relevance, check_traverse="day")["metrics"]["check"]
    for version, figure in ((1, check["anr_active"]), (2, check["anr"])):
        snapshot = load_snapshot(catalog, DOMAIN, version)
        shares = []
        for place, encoding in enumerate(season(0.2, 4)):
            dissimilarities = evaluator.dissimilarities(encoding[np.newaxis], snapshot.landmark_model)[0]
            relevance_of = relevances(snapshot, Query(rank_landmarks(dissimilarities), dissimilarities, encoding))
            near = np.flatnonzero(np.abs(np.arange(PLACES) - place) <= 2)
            shares.append(rank_of_truth(relevance_of, near) / PLACES)
        assert figure == pytest.approx(100 * np.mean(shares), rel=1e-6)


def test_held_out_frames_are_not_found_as_themselves(store, remapped):
    """Encodings without any order: whoever finds its own image is first, whoever must not is anywhere."""
    store("landmarks", season(0.2, 1))
    store("noise", np.random.default_rng(0).normal(size=(300, DIM)))
    check = remapped(training_traverse="noise", relevance=Relevance.BRUTE_FORCE)["metrics"]["check"]
    assert check["n_queries"] == 30
    assert 8 < check["anr"] < 50  # of the best of four neighbours; 0 with the frame itself


def test_the_same_traverse_again_is_no_worse_than_itself(seasons, remapped):
    remapped(training_traverse="good")
    result = remapped(training_traverse="good", gate_margin=0.0)
    check = result["metrics"]["check"]
    assert check["anr"] == pytest.approx(check["anr_active"])  # neither map may find the frames themselves
    assert result["active"] is True


def test_frames_taken_where_a_held_out_one_stood_are_held_out_with_it(store, remapped):
    store("landmarks", season(0.2, 1))
    noise = np.random.default_rng(0).normal(size=(200, DIM))
    still = np.repeat(noise, 2, axis=0)  # every view twice, from the same place
    store("stops", still, np.repeat(np.arange(200.0), 2))
    check = remapped(training_traverse="stops", relevance=Relevance.BRUTE_FORCE)["metrics"]["check"]
    assert check["n_queries"] == 40
    assert check["anr"] > 8


def test_frames_do_not_find_what_the_map_has_of_them_under_another_name(store, remapped):
    """Neither held-out frames of a drive appended again with a few new ones, nor a check traverse appended before."""
    store("landmarks", season(0.2, 1))
    noise = np.random.default_rng(0).normal(size=(310, DIM))
    store("noise", noise[:300])
    remapped(training_traverse="noise", relevance=Relevance.BRUTE_FORCE)
    store("longer", noise)
    parameters = {"landmark_traverse": None, "append": True, "relevance": Relevance.BRUTE_FORCE, "gate_margin": 0.0}
    check = remapped(training_traverse="longer", n_landmarks=None, **parameters)["metrics"]["check"]
    assert check["frames"] == "held_out"
    assert check["anr"] > 8, "0 would say that every frame found itself"
    assert check["anr_active"] > 8


def test_a_check_traverse_that_both_maps_have_among_others_is_asked_of_the_others(store, remapped):
    store("landmarks", season(0.2, 1))
    noise = np.random.default_rng(0).normal(size=(100, DIM))
    store("noise", noise)
    store("other", np.random.default_rng(1).normal(size=(100, DIM)))
    store("third", np.random.default_rng(2).normal(size=(100, DIM)))
    remapped(training_traverse="other", relevance=Relevance.BRUTE_FORCE)
    parameters = {"landmark_traverse": None, "append": True, "n_landmarks": None, "relevance": Relevance.BRUTE_FORCE}
    remapped(training_traverse="noise", **parameters)
    check = remapped(training_traverse="third", check_traverse="noise", **parameters)["metrics"]["check"]
    assert (check["frames"], check["n_queries"], check["active_version"]) == ("traverse", 100, 2)
    assert check["anr"] > 4, "of the best of nine neighbours"
    assert check["anr_active"] > 4


def test_a_check_on_the_frames_that_the_new_map_is_made_of_says_so(store, remapped, seasons):
    """Of a long drive only some are asked; what is between them was seen a moment before or after."""
    remapped(training_traverse="good")
    drive = np.random.default_rng(0).normal(size=(2500, DIM))
    store("long", drive)
    store("long-again", drive, np.arange(2500) + 0.5)
    result = remapped(training_traverse="long", check_traverse="long-again", gate_margin=100.0)
    check = result["metrics"]["check"]
    assert (check["anr"], check["passed"], result["active"]) == (None, False, False)
    assert check["why"] == "the new map was made of the frames of traverse long-again itself: check on another drive"


def test_a_map_without_digests_is_known_by_the_names_of_its_traverses(remapped, seasons, monkeypatch):
    """As maps of before are: the active one has its frames at the same places under the same name."""
    with monkeypatch.context() as of_before:
        of_before.setattr(Drive, "digests", lambda drive: None)
        remapped(training_traverse="good")
    check = remapped(training_traverse="good", gate_margin=0.0)["metrics"]["check"]
    assert check["anr"] == pytest.approx(check["anr_active"])
    check = remapped(training_traverse="bad", check_traverse="good", gate_margin=0.0)["metrics"]["check"]
    assert "was made of traverse good itself" in check["why"]


def test_a_drive_of_the_same_name_is_another_where_its_frames_are(store, remapped, seasons, catalog):
    remapped(training_traverse="good")
    Traverse.delete(catalog.data_dir, DOMAIN, "good")
    store("good", season(0.2, 7))
    check = remapped(training_traverse="bad", check_traverse="good")["metrics"]["check"]
    assert check["anr_active"] < check["anr"]
    assert check["n_left_out"] == 0


def test_only_places_that_both_maps_hold_count(store, remapped, seasons):
    remapped(training_traverse="good")
    store("half", season(0.2, 5)[:30])
    check = remapped(training_traverse="half", check_traverse="day")["metrics"]["check"]
    assert (check["n_queries"], check["n_left_out"]) == (32, 28)  # 30 places, and 2 m behind them
    assert check["anr_active"] is not None


def test_maps_of_different_stretches_cannot_be_compared(store, remapped, seasons):
    remapped(training_traverse="good")
    store("elsewhere", season(0.2, 5), 1000.0 + np.arange(PLACES))
    result = remapped(training_traverse="elsewhere", gate_margin=0.0)
    check = result["metrics"]["check"]
    assert (check["anr_active"], check["passed"], result["active"]) == (None, False, False)
    assert "share no place of traverse elsewhere" in check["why"]
    assert check["anr"] is not None


def test_a_check_on_the_drive_that_the_active_map_is_made_of_says_so(remapped, seasons):
    remapped(training_traverse="good")
    result = remapped(training_traverse="bad", check_traverse="good", gate_margin=0.0)
    check = result["metrics"]["check"]
    assert (check["anr_active"], check["active_version"]) == (None, 1)
    assert (check["passed"], result["active"]) == (False, False)
    assert "map 1, which serves, was made of traverse good itself" in check["why"]
    assert "check on another drive" in check["why"]


def test_a_check_on_the_drive_that_gave_a_map_its_landmarks_is_a_warning_by_name(remapped, seasons):
    def warned(**config):
        return remapped(training_traverse="good", **config)["metrics"]["check"]["warnings"]

    assert warned() == warned(check_traverse="day") == []
    (of_active,) = warned(check_traverse="landmarks", landmark_traverse=None)
    assert of_active.startswith("check_drive_known: map 2, which serves took its landmarks from traverse landmarks")
    assert len(warned(check_traverse="landmarks")) == 1, "the map before kept its landmarks, and chose none"


def test_a_map_without_any_place_of_the_check_traverse_loses_its_gate(store, remapped, seasons, catalog):
    remapped(training_traverse="good")
    store("elsewhere", season(0.2, 5), 1000.0 + np.arange(PLACES))
    result = remapped(training_traverse="elsewhere", check_traverse="day", gate_margin=100.0)
    check = result["metrics"]["check"]
    assert (check["anr"], check["anr_active"], check["passed"], result["active"]) == (None, None, False, False)
    assert (check["n_queries"], check["n_left_out"]) == (0, PLACES)
    assert check["why"] == "the new map holds no place within 2 m of a frame of traverse day"
    assert catalog.domain(DOMAIN).active_version == 1


def test_positions_in_the_plane_count_where_both_know_them(store, remapped, seasons):
    """Along the route the two are a kilometre apart, in the plane they are the same."""
    store("planned", season(0.2, 2), x_m=np.arange(PLACES))
    remapped(training_traverse="planned")
    store("shifted", season(0.2, 5), 1000.0 + np.arange(PLACES), x_m=np.arange(PLACES))
    check = remapped(training_traverse="shifted")["metrics"]["check"]
    assert check["anr_active"] is not None
    assert check["n_queries"] == 6


def test_an_active_map_of_another_encoder_cannot_be_compared(store, remapped, seasons):
    remapped(training_traverse="good")
    other = np.random.default_rng(0).normal(size=(PLACES, DIM + 1))
    store("new-encoder", other)
    store("its-landmarks", other + 0.1)
    result = remapped(training_traverse="new-encoder", landmark_traverse="its-landmarks", gate_margin=0.0)
    check = result["metrics"]["check"]
    assert (check["anr_active"], check["active_version"], check["passed"]) == (None, 1, False)
    assert "another length" in check["why"]


def test_a_damaged_active_map_does_not_keep_its_remedy_away(remapped, seasons, catalog):
    remapped(training_traverse="good")
    path = catalog.map_path(DOMAIN, 1)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1])
    result = remapped(training_traverse="good", gate_margin=0.0)
    assert result["active"] is True
    assert "damaged" in result["metrics"]["check"]["why"]


@pytest.mark.parametrize(
    ("module", "name", "error", "reason"),
    [
        (catalog_maps, "verify", OSError(errno.EIO, "Input/output error"), "io_error"),
        (map_file, "unpack_lists", MemoryError(), "out_of_memory"),
    ],
)
def test_no_gate_opens_because_a_sound_map_could_not_be_read(
    remapped, seasons, catalog, monkeypatch, module, name, error, reason
):
    def fail(*_):
        raise error

    remapped(training_traverse="good")
    monkeypatch.setattr(module, name, fail)
    with pytest.raises(UnavailableError, match="map 1 of domain route could not be read") as caught:
        remapped(training_traverse="bad", check_traverse="day", gate_margin=1.0)
    assert (caught.value.code, caught.value.hints["reason"]) == ("unavailable", reason)
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]
    assert catalog.domain(DOMAIN).active_version == 1


def test_a_map_of_one_image_has_nothing_to_hold_out(store, remapped):
    store("landmarks", season(0.2, 1))
    store("one", season(0.2, 2)[:1])
    result = remapped(training_traverse="one", gate_margin=0.0)
    check = result["metrics"]["check"]
    assert (check["anr"], check["n_queries"], check["n_left_out"], check["passed"]) == (None, 0, 1, True)
    assert result["active"] is True


def test_a_long_drive_is_checked_on_a_thousand_frames_at_most(store, remapped):
    store("landmarks", season(0.2, 1))
    rng = np.random.default_rng(0)
    store("drive", rng.normal(size=(3000, DIM)))
    store("day", rng.normal(size=(2500, DIM)))
    assert remapped(training_traverse="drive", check_traverse="day")["metrics"]["check"]["n_queries"] == 834
    assert remapped(training_traverse="drive")["metrics"]["check"]["n_queries"] == 300


def test_an_unknown_or_unsuitable_check_traverse_is_named_before_anything_is_built(store, remapped, seasons, catalog):
    with pytest.raises(UnknownTraverseError, match="nowhere"):
        remapped(training_traverse="good", check_traverse="nowhere")
    store("short", np.eye(5, DIM - 1))
    with pytest.raises(InvalidEncodingError, match="short holds encodings of 7"):
        remapped(training_traverse="good", check_traverse="short")
    store("backwards", season(0.2, 5), np.arange(PLACES)[::-1])
    with pytest.raises(InvalidRouteError, match="backwards at frame 1"):
        remapped(training_traverse="good", check_traverse="backwards")
    with pytest.raises(InvalidMapConfigError, match="another check_traverse"):
        remapped(training_traverse="good", check_traverse="good")
    assert catalog.maps(DOMAIN) == []


def test_a_rollback_during_the_remap_gives_way_to_the_new_map(seasons, catalog, evaluator, remapped):
    """Without a gate the last word wins."""
    remapped(training_traverse="good")
    remapped(training_traverse="bad")
    result = remap_while(catalog, evaluator, "seal", lambda: catalog.activate(DOMAIN, 1, ANY), gate_margin=None)
    assert result["active"] is True
    assert catalog.domain(DOMAIN).active_version == 3


def test_a_gate_that_compared_with_another_map_does_not_open(seasons, catalog, evaluator, remapped):
    """Compared with the bad map it would pass; an operator has gone back to the good one meanwhile."""
    remapped(training_traverse="good")
    remapped(training_traverse="bad")
    result = remap_while(
        catalog, evaluator, "seal", lambda: catalog.activate(DOMAIN, 1, ANY), gate_margin=0.0, check="good"
    )
    check = result["metrics"]["check"]
    assert check["active_version"] == 2
    assert check["passed"] is True
    assert result["active"] is False
    assert "serves map version 1, not map version 2" in check["why"]
    assert catalog.domain(DOMAIN).active_version == 1
    assert catalog.map(DOMAIN, 3).state is MapState.SEALED


def remap_while(catalog, evaluator, stage, meanwhile, gate_margin, check=None):
    results = []

    def at(state):
        if state.stage == stage and not results:
            results.append(meanwhile())

    parameters = {"landmark_traverse": "landmarks", "n_landmarks": 20, "training_episodes": 10}
    config = RemapConfig("day", check_traverse=check, gate_margin=gate_margin, **parameters)
    result = remap(catalog, DOMAIN, config, evaluator, Progress(REMAP_STAGES, at))
    assert results
    return result
