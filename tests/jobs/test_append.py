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
from deepsimbad.jobs.versions import import_map
from deepsimbad.store.traverses import Traverse

from .conftest import DOMAIN, READY


@pytest.fixture
def first(drive, run):
    """A map of 40 images a metre apart, and a traverse `more` of 10 between and 5 behind them."""

    def make(**config):
        drive("landmarks", 30, seed=1)
        old = drive("drive", 40, seed=2)
        run("drive", landmark_traverse="landmarks", n_landmarks=12, **config)
        return old, drive("more", 15, seed=3, position_m=np.r_[np.arange(10) + 20.25, np.arange(5) + 45.0])

    return make


def digests(encodings):
    return Drive(position_m=np.arange(len(encodings)), encodings=encodings).digests().tolist()


@pytest.mark.parametrize("relevance", list(Relevance))
def test_old_images_stay_and_appended_places_are_found(first, run, catalog, contents, evaluator, relevance):
    """As `test_appended_frames` has it for lists, here with what a file holds, without the old drives' frames."""
    old, new = first(relevance=relevance, training_episodes=0)
    for name in ("drive", "landmarks"):
        Traverse.delete(catalog.data_dir, DOMAIN, name)
    result = run("more", append=True)
    assert (result["active"], result["metrics"]["n_map_images"]) == (True, 55)
    old_map, new_map = contents(1), contents(2)
    is_old = np.isin(new_map.position_m, np.arange(40.0))
    assert np.array_equal(new_map.lists[:, is_old], old_map.lists)
    assert np.array_equal(new_map.landmark_model["prototypes"], old_map.landmark_model["prototypes"])
    for name in ("likelihood_scale", "novelty"):
        assert np.array_equal(getattr(new_map, name), getattr(old_map, name))
    if relevance is Relevance.COMPOSED:
        assert np.array_equal(new_map.landmark_model["usual"], new_map.usual_encoding)
        encodings = np.concatenate([old, new]).astype(np.float64)
        mean_std = np.stack([encodings.mean(axis=0), encodings.std(axis=0)])
        assert new_map.usual_encoding == pytest.approx(mean_std, rel=1e-4)
        assert not np.array_equal(new_map.usual_product, old_map.usual_product)
        assert "drive are not stored here" in result["metrics"]["fused"]["why"]
    snapshot, ranks = load_snapshot(catalog, DOMAIN, 2), []
    for encoding, image in zip(new, np.flatnonzero(~is_old), strict=True):
        dissimilarities = evaluator.dissimilarities(encoding[np.newaxis], snapshot.landmark_model)[0]
        relevance_of = relevances(snapshot, Query(rank_landmarks(dissimilarities), dissimilarities, encoding))
        ranks.append(np.count_nonzero(relevance_of > relevance_of[image]))
    assert np.mean(ranks) < 3  # of 55 images


def test_the_config_records_what_was_appended(first, run, catalog, contents, drive):
    first(training_episodes=100, list_length=3)
    run("more", append=True)
    drive("third", 5, seed=4)
    run("third", append=True, check_traverse="more", gate_margin=100.0)
    for config in (catalog.map(DOMAIN, 3).config, contents(3).config):
        expected = {"training_traverse": "drive", "landmark_traverse": "landmarks", "list_length": 3, "n_landmarks": 12}
        expected |= {"relevance": "composed", "append": True, "check_traverse": "more", "gate_margin": 100.0}
        assert {name: config[name] for name in expected} == expected
        assert config["appended"] == [
            {"traverse": "more", "n_frames": 15, "to_version": 1, "fused": False},
            {"traverse": "third", "n_frames": 5, "to_version": 2, "fused": False},
        ]
    assert catalog.map(DOMAIN, 3).metrics["training"] == catalog.map(DOMAIN, 1).metrics["training"]
    assert contents(3).n_images == 60
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
    expected = f"map 2, which serves, holds traverse {again} already.*Append another drive"
    with pytest.raises(InvalidMapConfigError, match=expected) as refused:
        run(again, append=True, gate_margin=2.0)
    assert refused.value.hints == {"traverse": again, "map_version": 2}
    assert [record.version for record in catalog.maps(DOMAIN)] == [1, 2]
    catalog.activate(DOMAIN, 1, 2)
    assert (again == "drive") or run(again, append=True)["map_version"] == 3, "map 1 is made of the other one alone"


def test_the_same_frames_are_not_appended_under_another_name(first, run, drive):
    first(training_episodes=0)
    drive("again", 40, seed=2, position_m=np.arange(40) + 0.1)
    with pytest.raises(InvalidMapConfigError, match="holds every frame of traverse again already, under another name"):
        run("again", append=True)
    drive("longer", 41, seed=2)  # the first 40 are the same; one is new
    run("longer", append=True)
    with pytest.raises(InvalidMapConfigError, match="map 2, which serves, holds every frame of traverse again"):
        run("again", append=True)


def test_a_map_knows_the_frames_it_is_made_of(first, run, contents):
    drives = first(training_episodes=0)
    run("more", append=True)
    first_map, map_ = contents(1), contents(2)
    assert first_map.frame_digest.tolist() == digests(drives[0])
    is_old = np.isin(map_.position_m, np.arange(40.0))
    for name, encodings, images in zip(("drive", "more"), drives, (is_old, ~is_old), strict=True):
        assert map_.frame_digest[images].tolist() == digests(encodings)
        assert map_.frame_name[images].tolist() == [f"{name}{i}.png" for i in range(len(encodings))]
        assert (map_.frame_drive[images] == name).all()
    assert map_.landmark_digest.tolist() == first_map.landmark_digest.tolist(), "landmarks stay"


def test_digests_stay_as_they_are():
    """They are compared with those in map files of other releases."""
    frames = np.array([[1.0, 2.0], [0.0, -1.5]], np.float32)
    assert digests(frames) == [7373934272132878346, 14435273145991011183]


def test_an_imported_map_is_appended_to_under_the_names_of_here(first, run, catalog, contents, drive, tmp_path):
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
    for config in (catalog.map(DOMAIN, 4).config, contents(4).config):
        assert (config["training_traverse"], config["imported"]["version"]) == (None, 2)
        assert config["appended"] == [{"traverse": "more", "n_frames": 15, "to_version": 3, "fused": False}]


def test_a_loop_takes_the_frames_of_any_turn(catalog, run, contents, drive):
    catalog.delete_domain(DOMAIN)
    catalog.create_domain(DOMAIN, READY, True, (1.0, 2.0))
    drive("drive", 40, seed=2)
    run("drive", landmark_traverse="drive", n_landmarks=12, training_episodes=50)
    drive("lap", 30, seed=3, position_m=np.arange(30) + 30.5)  # past the start after 10 m
    run("lap", append=True)
    map_ = contents(2)
    assert (map_.n_images, map_.position_m.max()) == (70, 39.5)
    assert load_snapshot(catalog, DOMAIN, 2).route.length_m == pytest.approx(40.0, abs=0.51)


# --- the same route again ------------------------------------------------------------------------------------------

PLACES = 160


@pytest.fixture(params=[16, 130], ids=["whole", "projected"])
def season(store, request):
    """Stores a drive of one route in a season of its own, some places of it; returns its encodings."""
    d = request.param
    route = np.random.default_rng(0).normal(size=(PLACES + 20, d))

    def put(name, seed, places=range(PLACES), weight=1.2):
        rng = np.random.default_rng(seed)
        changes = weight * rng.normal(size=(len(places), d)) * (np.arange(d) % 4 == 0)  # these numbers are a season's
        shift, scale = rng.normal(size=d), rng.uniform(0.5, 2, d)
        noise = 0.2 * rng.normal(size=changes.shape)
        encodings = (shift + scale * (route[places] + changes + noise)).astype(np.float32)
        store(name, encodings, places)
        return encodings

    return put


@pytest.fixture
def append(run):
    """Appends a drive; returns what the new map's metrics say."""
    return lambda training, **config: run(training, append=True, **config)["metrics"]


def hits(map_, encodings):
    """How many views of a season are placed within a metre, each taken by itself."""
    query = Query(np.ones((len(encodings), map_.n_landmarks), np.float32), encoding=encodings)
    images = relevances(map_, query, map_.live_statistics).argmax(axis=1)
    return np.sum(np.abs(map_.position_m[images] - np.arange(len(encodings))) <= 1)


def test_places_seen_again_become_the_mean_of_their_seasons(season, run, append, contents):
    """At the same bits, and as well as if all seasons had been known from the start."""
    for seed, (name, n_places) in enumerate((("summer", PLACES), ("winter", PLACES + 20), ("spring", PLACES)), 1):
        season(name, seed, range(n_places))
    live = season("live", 4)
    run("summer", n_landmarks=60, training_episodes=50)
    for name, n_new in (("winter", 18), ("spring", 0)):  # the last two of the map are near the first two that it lacks
        metrics = append(name)
        assert metrics["n_map_images"] == PLACES + 18
        assert (metrics["fused"]["accepted"], metrics["fused"]["n_new_images"]) == (True, n_new)
    map_1, map_2, map_3 = (contents(version) for version in (1, 2, 3))
    assert (map_3.list_length, map_3.q_values.shape) == (map_1.list_length, (PLACES + 18, 2))
    assert np.array_equal(map_3.frame_digest[:PLACES], map_1.frame_digest), "images stay"
    prototypes = [map_.landmark_model["prototypes"] for map_ in (map_1, map_2, map_3)]
    assert prototypes[2].shape == prototypes[0].shape
    nearness = np.einsum("rk,rk->r", prototypes[2], prototypes[1])
    assert nearness.min() > 0.5, "landmarks move with the space, and towards what was seen"
    assert np.array_equal(map_3.landmark_model["usual"], map_3.usual_encoding)
    run("summer", landmark_traverse="winter", n_landmarks=60, training_episodes=0, same_route=True)
    n_hits = [hits(map_, live) for map_ in (map_1, map_2, map_3, contents(4))]
    assert n_hits[0] + 10 < n_hits[1] < n_hits[2]
    assert n_hits[1] > n_hits[3] - 10


def test_a_season_that_a_map_knows_is_not_fused_into_it_again(season, store, run, append):
    """Views of it agree with the map far better than those of a season to come, and would be trusted as far."""
    season("summer", 1)
    store("copy", season("winter", 2), np.arange(PLACES) + 0.25)
    run("summer", landmark_traverse="winter", n_landmarks=60, training_episodes=0, same_route=True)
    for name in ("winter", "copy"):
        with pytest.raises(InvalidMapConfigError, match=f"traverse {name} already"):
            append(name)
    season("spring", 3)
    assert append("spring")["fused"]["accepted"]


def test_a_drive_is_fused_only_where_its_views_agree(season, store, run, append, catalog):
    season("summer", 1)
    season("later", 2)
    shuffled = season("elsewhere", 3, np.random.default_rng(9).permutation(PLACES))
    store("shuffled", shuffled, np.arange(PLACES) + 0.25)
    run("summer", n_landmarks=60, training_episodes=0)
    metrics = append("shuffled")
    assert (metrics["fused"]["accepted"], metrics["n_map_images"]) == (False, 2 * PLACES)
    assert "agree no better" in metrics["fused"]["why"]
    again = append("later")
    assert (again["fused"]["accepted"], again["n_map_images"]) == (True, 2 * PLACES), "with the images that agree"
    catalog.activate(DOMAIN, 1, 3)
    verdict = append("later", same_route=False)["fused"]
    assert (verdict["accepted"], "said not to share" in verdict["why"]) == (False, True)


def test_a_stretch_that_shares_too_few_places_is_fused_by_a_drive_that_shares_more(season, run, append, catalog):
    season("summer", 1, range(100))
    season("stretch", 2, range(90, 180))
    for seed, name in ((3, "winter"), (4, "spring")):
        season(name, seed, range(180))
    run("summer", n_landmarks=60, training_episodes=0)
    metrics = append("stretch")
    assert (metrics["fused"]["accepted"], metrics["n_map_images"]) == (False, 190)
    for name in ("winter", "spring"):
        metrics = append(name)
        assert (metrics["fused"]["accepted"], metrics["n_map_images"]) == (True, 190)
    entries = catalog.map(DOMAIN, 3).config["appended"]
    assert [(entry["traverse"], entry["fused"]) for entry in entries] == [("stretch", True), ("winter", True)]


def test_a_fused_frame_does_not_find_itself_when_the_map_is_checked(season, run, append, contents):
    encodings = [season(name, seed) for seed, name in enumerate(("summer", "winter", "spring"), 1)]
    run("summer", n_landmarks=60, training_episodes=0)
    held_out = append("winter")["check"]
    assert (held_out["n_queries"], held_out["anr"] < held_out["anr_active"]) == (PLACES // 10, True)
    old_map, new_map = contents(1), contents(2)
    summer, winter = (Drive(position_m=np.arange(float(PLACES)), encodings=rows) for rows in encodings[:2])
    fused, _ = fuse(old_map, KnownDrives.of(old_map, [(summer, True)], summer), winter, None)
    frames = np.arange(0, PLACES, 10)
    for map_ in (fused.map, fused.without(frames[:0])):
        assert np.array_equal(map_.lists, new_map.lists)

    def nearness(map_):
        """The mean cosine between the frames' units and the sums that stand for their places."""
        landmarks, weights = map_.landmark_model["prototypes"], list_weights(map_.list_length)
        sums = unit(np.tensordot(weights, landmarks[map_.lists[:, frames]], axes=1))
        return (sums * fused.u[frames]).sum(axis=1).mean()

    assert nearness(fused.without(frames)) < nearness(new_map) - 0.02
    of_itself = append("spring", check_traverse="winter")["check"]
    assert (of_itself["anr"], "made of the frames of traverse winter itself" in of_itself["why"]) == (None, True)


def test_what_was_deleted_or_changed_cannot_be_fused(season, run, append, catalog):
    season("summer", 1)
    season("winter", 2)
    run("summer", n_landmarks=60, training_episodes=0)
    Traverse.delete(catalog.data_dir, DOMAIN, "summer")
    season("summer", 7)
    metrics = append("winter")
    assert metrics["n_map_images"] == 2 * PLACES
    assert metrics["fused"]["why"] == "the drives that the map is made of hold other frames by now"
