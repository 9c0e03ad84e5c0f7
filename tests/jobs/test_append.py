"""Appending a drive to the active map: what stays, what is new, what is refused."""

import shutil

import numpy as np
import pytest

from deepsimbad.core.composed import list_weights, unit
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.jobs.append import KnownDrives, fuse
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig
from deepsimbad.jobs.versions import import_map
from deepsimbad.store.map_file import read_map
from deepsimbad.store.traverses import Traverse

DOMAIN = "route"


@pytest.fixture
def run(catalog, evaluator):
    def run(training, **config):
        return remap(catalog, DOMAIN, RemapConfig(training, **config), evaluator, Progress(REMAP_STAGES))

    return run


@pytest.fixture
def first(drive, run):
    """A map of 40 images a metre apart, and a traverse `more` of 10 between and 5 behind them."""

    def make(**config):
        drive("landmarks", 30, seed=1)
        old = drive("drive", 40, seed=2)
        run("drive", landmark_traverse="landmarks", n_landmarks=12, **config)
        new = drive("more", 15, seed=3, position_m=np.r_[np.arange(10) + 20.25, np.arange(5) + 45.0])
        return old, new

    return make


def digests(encodings):
    return Drive(position_m=np.arange(len(encodings)), encodings=encodings).digests().tolist()


def contents(catalog, version):
    return read_map(catalog.map_path(DOMAIN, version))


@pytest.mark.parametrize("relevance", list(Relevance))
def test_old_images_stay_and_appended_places_are_found(first, run, catalog, evaluator, relevance):
    old, new = first(relevance=relevance, training_episodes=0)
    for name in ("drive", "landmarks"):
        Traverse.delete(catalog.data_dir, DOMAIN, name)  # what they hold is not read again
    result = run("more", append=True)
    assert (result["active"], result["metrics"]["n_map_images"]) == (True, 55)
    old_map, new_map = contents(catalog, 1), contents(catalog, 2)
    is_old = np.isin(new_map.position_m, np.arange(40.0))
    assert is_old.sum() == 40
    assert (np.diff(new_map.position_m) >= 0).all()
    assert np.array_equal(new_map.lists[:, is_old], old_map.lists)
    assert np.array_equal(new_map.landmark_model["prototypes"], old_map.landmark_model["prototypes"])
    if relevance is Relevance.COMPOSED:
        assert np.array_equal(new_map.landmark_model["usual"], new_map.usual_encoding)
        encodings = np.concatenate([old, new]).astype(np.float64)
        assert new_map.usual_encoding == pytest.approx(
            np.stack([encodings.mean(axis=0), encodings.std(axis=0)]), rel=1e-4
        )
        assert not np.array_equal(new_map.usual_product, old_map.usual_product)
        assert "drive are not stored here" in result["metrics"]["fused"]["why"]
    for name in ("likelihood_scale", "novelty"):
        assert np.array_equal(getattr(new_map, name), getattr(old_map, name))
    for name in ("values", "encodings"):
        old_array, new_array = getattr(old_map, name), getattr(new_map, name)
        assert (old_array is None) == (new_array is None)
    if relevance is Relevance.SIMBAD:
        assert np.array_equal(new_map.values[:, is_old], old_map.values)
    if relevance is Relevance.BRUTE_FORCE:
        assert np.array_equal(new_map.encodings[is_old], old)
        assert np.array_equal(new_map.encodings[~is_old], new)
    snapshot = load_snapshot(catalog, DOMAIN, 2)
    ranks = [
        rank(snapshot, evaluator, encoding, image) for encoding, image in zip(new, np.flatnonzero(~is_old), strict=True)
    ]
    assert np.mean(ranks) < 3  # of 55 images


def rank(snapshot, evaluator, encoding, image):
    dissimilarities = evaluator.dissimilarities(encoding[np.newaxis], snapshot.landmark_model)[0]
    relevance = relevances(snapshot, Query(rank_landmarks(dissimilarities), dissimilarities, encoding))
    return np.count_nonzero(relevance > relevance[image])


def test_the_config_records_what_was_appended(first, run, catalog, drive):
    first(training_episodes=100, list_length=3)
    run("more", append=True)
    drive("third", 5, seed=4)
    run("third", append=True, check_traverse="more", gate_margin=100.0)
    for config in (catalog.map(DOMAIN, 3).config, contents(catalog, 3).config):
        assert config["training_traverse"] == "drive"
        assert config["landmark_traverse"] == "landmarks"
        assert (config["list_length"], config["n_landmarks"], config["relevance"]) == (3, 12, "composed")
        assert config["appended"] == [
            {"traverse": "more", "n_frames": 15, "to_version": 1, "fused": False},
            {"traverse": "third", "n_frames": 5, "to_version": 2, "fused": False},
        ]
        assert (config["append"], config["check_traverse"], config["gate_margin"]) == (True, "more", 100.0)
    assert catalog.map(DOMAIN, 3).metrics["training"] == catalog.map(DOMAIN, 1).metrics["training"]
    assert contents(catalog, 3).n_images == 60
    # The next remap that keeps the landmarks learns from what the map was first made of.
    drive("fourth", 40, seed=5)
    assert run("fourth", training_episodes=0)["map_version"] == 4


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"n_landmarks": 11}, "has 12 landmarks, not 11"),
        ({"list_length": 5}, "list_length 3, not 5"),
        ({"relevance": Relevance.RRF}, "relevance composed, not rrf"),
    ],
)
def test_what_is_appended_must_be_alike(first, run, catalog, wrong, match):
    first(training_episodes=0, list_length=3)
    with pytest.raises(InvalidMapConfigError, match=match):
        run("more", append=True, **wrong)
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]


@pytest.mark.parametrize("again", ["drive", "more"])
def test_no_traverse_is_appended_twice(first, run, catalog, drive, again):
    """Whatever frames are in it by now: with its old images left in, the new map would find the frames themselves."""
    first(training_episodes=0)
    run("more", append=True)
    Traverse.delete(catalog.data_dir, DOMAIN, again)
    drive(again, 15, seed=7)
    with pytest.raises(InvalidMapConfigError, match=f"map 2, which serves, holds traverse {again} already") as refused:
        run(again, append=True, gate_margin=2.0)
    assert "Append another drive" in refused.value.message
    assert refused.value.hints == {"traverse": again, "map_version": 2}
    assert [record.version for record in catalog.maps(DOMAIN)] == [1, 2]
    catalog.activate(DOMAIN, 1, 2)
    assert (again == "drive") or run(again, append=True)["map_version"] == 3, "map 1 is made of the other one alone"


def test_the_same_frames_are_not_appended_under_another_name(first, run, catalog, drive):
    first(training_episodes=0)
    drive("again", 40, seed=2, position_m=np.arange(40) + 0.1)
    with pytest.raises(InvalidMapConfigError, match="holds every frame of traverse again already, under another name"):
        run("again", append=True)
    drive("longer", 41, seed=2)  # the first 40 are the same; one is new
    run("longer", append=True)
    with pytest.raises(InvalidMapConfigError, match="map 2, which serves, holds every frame of traverse again"):
        run("again", append=True)


def test_a_map_knows_the_frames_it_is_made_of(first, run, catalog):
    old, new = first(training_episodes=0)
    run("more", append=True)
    assert contents(catalog, 1).frame_digest.tolist() == digests(old)
    map_ = contents(catalog, 2)
    is_old = np.isin(map_.position_m, np.arange(40.0))
    assert map_.frame_digest[is_old].tolist() == digests(old)
    assert map_.frame_digest[~is_old].tolist() == digests(new)
    assert map_.frame_name[is_old].tolist() == [f"drive{i}.png" for i in range(40)]
    assert map_.frame_name[~is_old].tolist() == [f"more{i}.png" for i in range(15)]
    assert (map_.frame_drive == np.where(is_old, "drive", "more")).all()
    assert map_.landmark_digest.tolist() == contents(catalog, 1).landmark_digest.tolist(), "landmarks stay"


def test_digests_stay_as_they_are():
    """They are compared with those in map files of other releases."""
    frames = np.array([[1.0, 2.0], [0.0, -1.5]], np.float32)
    assert digests(frames) == [7373934272132878346, 14435273145991011183]


def test_an_imported_map_is_appended_to_under_the_names_of_here(first, run, catalog, drive, tmp_path):
    """Its file names traverses of another server; its frames are known all the same."""
    first(training_episodes=0)
    run("more", append=True)
    shutil.copy(catalog.map_path(DOMAIN, 2), tmp_path / "exported")
    import_map(catalog, tmp_path / "exported", DOMAIN)
    with pytest.raises(InvalidMapConfigError, match="map 3, which serves, holds every frame of traverse more already"):
        run("more", append=True)
    Traverse.delete(catalog.data_dir, DOMAIN, "more")
    drive("more", 15, seed=8)
    assert run("more", append=True)["map_version"] == 4
    for config in (catalog.map(DOMAIN, 4).config, contents(catalog, 4).config):
        assert (config["training_traverse"], config["imported"]["version"]) == (None, 2)
        assert config["appended"] == [{"traverse": "more", "n_frames": 15, "to_version": 3, "fused": False}]


def test_a_loop_takes_the_frames_of_any_turn(catalog, evaluator, drive):
    catalog.delete_domain(DOMAIN)
    catalog.create_domain(DOMAIN, {"kind": "feature_l2", "extractor": "none"}, True, (1.0, 2.0))
    drive("drive", 40, seed=2)
    parameters = {"landmark_traverse": "drive", "n_landmarks": 12, "training_episodes": 50}
    remap(catalog, DOMAIN, RemapConfig("drive", **parameters), evaluator, Progress(REMAP_STAGES))
    drive("lap", 30, seed=3, position_m=np.arange(30) + 30.5)  # past the start after 10 m
    remap(catalog, DOMAIN, RemapConfig("lap", append=True), evaluator, Progress(REMAP_STAGES))
    map_ = contents(catalog, 2)
    assert map_.n_images == 70
    assert map_.position_m.max() == 39.5
    snapshot = load_snapshot(catalog, DOMAIN, 2)
    assert snapshot.route.length_m == pytest.approx(40.0, abs=0.51)


# --- the same route again ------------------------------------------------------------------------------------------

PLACES = 160


@pytest.fixture(params=[16, 130], ids=["whole", "projected"])
def season(catalog, request):
    """Stores a drive of one route in a season of its own, some places of it; returns its encodings."""
    d = request.param
    place = np.random.default_rng(0).normal(size=(PLACES + 20, d))

    def store(name, seed, places=range(PLACES), weight=1.2):
        rng = np.random.default_rng(seed)
        season_places = place[places] + weight * rng.normal(size=(len(places), d)) * (
            np.arange(d) % 4 == 0
        )  # a season changes these
        encodings = (
            rng.normal(size=d) + rng.uniform(0.5, 2, d) * (season_places + 0.2 * rng.normal(size=season_places.shape))
        ).astype(np.float32)
        with Traverse.create(catalog.data_dir, DOMAIN, name) as traverse:
            traverse.put_frames(Drive(position_m=np.array(places, float), encodings=encodings))
        return encodings

    return store


def stored(catalog, name):
    with Traverse.open(catalog.data_dir, DOMAIN, name) as traverse:
        return traverse.read()


def hits(map_, encodings):
    """How many views of a season are placed within a metre, each taken by itself."""
    relevance = relevances(
        map_, Query(np.ones((len(encodings), map_.n_landmarks), np.float32), encoding=encodings), map_.live_statistics
    )
    return np.sum(np.abs(map_.position_m[relevance.argmax(axis=1)] - np.arange(len(encodings))) <= 1)


def test_places_seen_again_become_the_mean_of_their_seasons(season, run, catalog):
    """At the same bits, and as well as if all seasons had been known from the start."""
    season("summer", 1)
    season("winter", 2, range(PLACES + 20))
    season("spring", 3)
    live = season("live", 4)
    run("summer", n_landmarks=60, training_episodes=50)
    second = run("winter", append=True)["metrics"]
    assert (second["n_map_images"], second["fused"]["accepted"], second["fused"]["n_new_images"]) == (
        PLACES + 18,  # the last two of the map are within 2 m of the first two that it lacks
        True,
        18,
    )
    third = run("spring", append=True)["metrics"]
    assert (third["n_map_images"], third["fused"]["accepted"], third["fused"]["n_new_images"]) == (PLACES + 18, True, 0)
    map_1, map_2, map_3 = (contents(catalog, version) for version in (1, 2, 3))
    assert map_3.list_length == map_1.list_length
    assert np.array_equal(map_3.frame_digest[:PLACES], map_1.frame_digest), "images stay"
    assert map_3.q_values.shape == (PLACES + 18, 2)
    assert map_3.landmark_model["prototypes"].shape == map_1.landmark_model["prototypes"].shape
    nearness = np.einsum("rk,rk->r", map_3.landmark_model["prototypes"], map_2.landmark_model["prototypes"])
    assert nearness.min() > 0.5, "landmarks move with the space, and towards what was seen"
    assert np.array_equal(map_3.landmark_model["usual"], map_3.usual_encoding)
    run("summer", landmark_traverse="winter", n_landmarks=60, training_episodes=0, same_route=True)
    n_hits = [hits(map_, live) for map_ in (map_1, map_2, map_3, contents(catalog, 4))]
    assert n_hits[0] + 10 < n_hits[1] < n_hits[2]
    assert n_hits[1] > n_hits[3] - 10


def test_a_season_that_a_map_knows_is_not_fused_into_it_again(season, run, catalog):
    """Views of it agree with the map far better than those of a season to come, and would be trusted as far."""
    season("summer", 1)
    season("winter", 2)
    run("summer", landmark_traverse="winter", n_landmarks=60, training_episodes=0, same_route=True)
    with Traverse.create(catalog.data_dir, DOMAIN, "copy") as traverse:
        traverse.put_frames(Drive(position_m=np.arange(PLACES) + 0.25, encodings=stored(catalog, "winter").encodings))
    for name in ("winter", "copy"):
        with pytest.raises(InvalidMapConfigError, match=f"traverse {name} already"):
            run(name, append=True)
    season("spring", 3)
    assert run("spring", append=True)["metrics"]["fused"]["accepted"]


def test_a_drive_is_fused_only_where_its_views_agree(season, run, catalog):
    season("summer", 1)
    season("later", 2)
    other = np.random.default_rng(9).permutation(PLACES)
    season("elsewhere", 3, other)
    run("summer", n_landmarks=60, training_episodes=0)
    encodings = stored(catalog, "elsewhere").encodings
    with Traverse.create(catalog.data_dir, DOMAIN, "shuffled") as traverse:
        traverse.put_frames(Drive(position_m=np.arange(PLACES) + 0.25, encodings=encodings))
    metrics = run("shuffled", append=True)["metrics"]
    assert (metrics["fused"]["accepted"], metrics["n_map_images"]) == (False, 2 * PLACES)
    assert "agree no better" in metrics["fused"]["why"]
    again = run("later", append=True)["metrics"]
    assert (again["fused"]["accepted"], again["n_map_images"]) == (True, 2 * PLACES), "with the images that agree"
    catalog.activate(DOMAIN, 1, 3)
    verdict = run("later", append=True, same_route=False)["metrics"]["fused"]
    assert (verdict["accepted"], "said not to share" in verdict["why"]) == (False, True)


def test_a_fused_frame_does_not_find_itself_when_the_map_is_checked(season, run, catalog):
    season("summer", 1)
    season("winter", 2)
    season("spring", 3)
    run("summer", n_landmarks=60, training_episodes=0)
    held_out = run("winter", append=True)["metrics"]["check"]
    assert (held_out["n_queries"], held_out["anr"] < held_out["anr_active"]) == (PLACES // 10, True)
    old_map, new_map = contents(catalog, 1), contents(catalog, 2)
    summer, winter = (stored(catalog, name) for name in ("summer", "winter"))
    fused, _ = fuse(old_map, KnownDrives.of(old_map, [(summer, True)], summer), winter, None)
    assert np.array_equal(fused.map.lists, new_map.lists)
    frames = np.arange(0, PLACES, 10)
    assert np.array_equal(fused.without(frames[:0]).lists, new_map.lists)

    def nearness(map_):
        """The mean cosine between the frames' units and the sums that stand for their places."""
        landmarks, weights = map_.landmark_model["prototypes"], list_weights(map_.list_length)
        sums = unit(np.tensordot(weights, landmarks[map_.lists[:, frames]], axes=1))
        return (sums * fused.u[frames]).sum(axis=1).mean()

    assert nearness(fused.without(frames)) < nearness(new_map) - 0.02
    of_itself = run("spring", append=True, check_traverse="winter")["metrics"]["check"]
    assert (of_itself["anr"], "made of the frames of traverse winter itself" in of_itself["why"]) == (None, True)


def test_what_was_deleted_or_changed_cannot_be_fused(season, run, catalog):
    season("summer", 1)
    season("winter", 2)
    run("summer", n_landmarks=60, training_episodes=0)
    Traverse.delete(catalog.data_dir, DOMAIN, "summer")
    season("summer", 7)
    metrics = run("winter", append=True)["metrics"]
    assert (metrics["n_map_images"], metrics["fused"]["why"]) == (
        2 * PLACES,
        "the drives that the map is made of hold other frames by now",
    )
