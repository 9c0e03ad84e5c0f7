"""Remapping: what the map file holds, what stays when it fails; what it is asked for, and how its stages weigh."""

import json
from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import CancelledError, InvalidEncodingError, InvalidMapConfigError
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig, remap_stages, stages_in
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.map_file import verify
from deepsimbad.store.records import MapState
from deepsimbad.store.traverses import Traverse

from .conftest import DOMAIN


@pytest.fixture
def remapped(run):
    """Makes a map of `drive` with landmarks from `other`, unless told otherwise."""

    def make(training="drive", **config):
        return run(training, **{"landmark_traverse": "other", "n_landmarks": 8, **config})

    return make


KEPT = {"landmark_traverse": None, "n_landmarks": None}


def nearest_first(encoding, prototypes):
    return sorted(range(len(prototypes)), key=lambda i: (float(np.sum((encoding - prototypes[i]) ** 2)), i))


def test_a_map_is_sealed_active_and_holds_the_lists_of_its_landmarks(catalog, drive, remapped, contents):
    candidates = drive("other", 30, seed=1)
    plane = {"x_m": np.arange(12) * 1.0, "y_m": np.zeros(12)}
    encodings = drive("drive", 12, position_m=np.arange(12) * 1.5, **plane)
    result = remapped(relevance=Relevance.RRF)
    assert (result["map_version"], result["active"], result["metrics"]["n_map_images"]) == (1, True, 12)
    assert result["metrics"]["index_bits_per_map_image"] > 0
    record = catalog.map(DOMAIN, 1)
    assert (record.state, catalog.domain(DOMAIN).active_version) == (MapState.ACTIVE, 1)
    verify(catalog.map_path(DOMAIN, 1), record.sha256)
    map_ = contents(1)
    prototypes = map_.landmark_model["prototypes"]
    candidate_rows = [int(name.removeprefix("other").removesuffix(".png")) for name in map_.landmark_frame]
    assert (prototypes == candidates[candidate_rows]).all()
    assert map_.landmark_drive.tolist() == 8 * ["other"]
    assert map_.lists.T.tolist() == [nearest_first(encoding, prototypes)[:4] for encoding in encodings]
    assert map_.position_m.tolist() == (np.arange(12) * 1.5).tolist()
    assert (map_.x_m.tolist(), map_.timestamp_us) == (list(range(12)), None)
    assert (map_.config["n_landmarks"], map_.config["landmark_traverse"]) == (8, "other")


def test_kept_landmarks_have_the_number_they_have(catalog, two_drives, remapped):
    remapped()
    with pytest.raises(InvalidMapConfigError, match="has 8 landmarks, not 9") as raised:
        remapped(landmark_traverse=None, n_landmarks=9)
    assert raised.value.hints == {"n_landmarks": 8}
    with pytest.raises(InvalidMapConfigError, match="list_length 9"):
        remapped(**KEPT, list_length=9)
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]


def test_the_active_maps_landmarks_may_come_from_another_encoder(drive, run):
    drive("summer", 8)
    drive("winter", 8, d=4)
    run("summer", landmark_traverse="summer", n_landmarks=5)
    with pytest.raises(InvalidEncodingError, match="4 numbers cannot be compared with landmarks of 6"):
        run("winter")


@pytest.mark.parametrize("relevance", sorted(set(Relevance) - {Relevance.COMPOSED}))
def test_a_map_keeps_what_its_relevance_needs_and_no_more(two_drives, remapped, contents, relevance):
    remapped(relevance=relevance)
    map_ = contents(1)
    assert map_.config["relevance"] == relevance.value
    arrays = {"standardised": "statistics", "simbad": "values", "brute_force": "encodings"}
    in_file = [name for name in arrays.values() if getattr(map_, name) is not None]
    assert in_file == ([arrays[relevance]] if relevance in arrays else [])


@pytest.mark.parametrize("last_stage", ["", *list(REMAP_STAGES)[:-1]])
def test_cancelled_at_any_stage_it_leaves_nothing_behind(catalog, two_drives, remapped, last_stage):
    """A cancel that comes with the report of a stage stops the work at the next."""
    stages = [""]
    progress = Progress(REMAP_STAGES, lambda state: stages.append(state.stage), lambda: stages[-1] == last_stage)
    with pytest.raises(CancelledError):
        remapped(progress=progress)
    folder = catalog.map_path(DOMAIN, 1).parent
    assert (catalog.maps(DOMAIN), catalog.domain(DOMAIN).active_version) == ([], None)
    assert not folder.exists() or list(folder.iterdir()) == []


# --- whether a second drive is learnt from -------------------------------------------------------------------------

PLACES = 120


@pytest.fixture
def route(store):
    """Stores drives of 120 places: `drive` and `other` of the same ones, `strange` of others, x and y where asked."""

    def put(plane=False):
        rng = np.random.default_rng(3)
        places = rng.normal(size=(PLACES, 16))
        fields = {"x_m": np.arange(float(PLACES)), "y_m": np.zeros(PLACES)} if plane else {}
        for name, season_places in (("drive", places), ("other", places), ("strange", rng.normal(size=places.shape))):
            store(name, season_places + 0.3 * rng.normal(size=season_places.shape), **fields)

    return put


@pytest.mark.parametrize(
    ("relevance", "plane", "config", "accepted", "reason"),
    [
        (Relevance.COMPOSED, False, {}, False, "without x, y of both drives nothing says"),
        (Relevance.COMPOSED, False, {"same_route": True}, True, None),
        (Relevance.COMPOSED, True, {}, True, None),
        (Relevance.COMPOSED, True, {"same_route": False}, False, "are said not to share their positions"),
        (Relevance.COMPOSED, False, {"same_route": True, "landmark_traverse": "strange"}, False, "agree no better"),
        (Relevance.STANDARDISED, True, {}, True, None),
        (Relevance.STANDARDISED, True, {"landmark_traverse": "strange"}, False, "agree no better"),
        (Relevance.RRF, True, {}, True, None),
    ],
)
def test_a_second_drive_is_learnt_from_only_on_the_same_route(
    catalog, route, remapped, contents, relevance, plane, config, accepted, reason
):
    """One verdict holds for the likelihood, for whitening, and for the live images of training."""
    route(plane)
    metrics = remapped(n_landmarks=60, training_episodes=20, relevance=relevance, **config)["metrics"]
    season = metrics["second_season"]
    assert season["accepted"] is accepted
    assert season["why"] is None if reason is None else reason in season["why"]
    was_judged = reason is None or "agree" in reason
    assert (season["significance"] is not None, season["n_pairs"] > 0) == (was_judged, was_judged)
    assert metrics["training"]["live_images"] == ("landmark_traverse" if accepted else "held_out_frames")
    assert catalog.map(DOMAIN, 1).metrics["second_season"] == season
    map_, learns = contents(1), relevance is not Relevance.RRF
    assert (map_.view_bits is not None, map_.novelty is not None) == (learns, learns)
    fused = accepted and relevance is Relevance.COMPOSED
    assert (map_.likelihood_scale is not None, "projection" in map_.landmark_model) == (fused, fused)


def test_without_a_second_drive_there_is_no_verdict(two_drives, remapped):
    assert remapped(landmark_traverse="drive")["metrics"]["second_season"] is None


def test_where_landmarks_stay_the_active_maps_drive_is_judged(route, remapped):
    route()
    for training, accepted in (("strange", False), ("other", True)):
        remapped(training_episodes=0)
        metrics = remapped(training, **KEPT, training_episodes=0, same_route=True)["metrics"]
        assert metrics["second_season"]["accepted"] is accepted


# --- what is asked for ----------------------------------------------------------------------------------------------

CONFIG = RemapConfig("drive", "other")
SIZE = (12_000, 12_000, 512)


def test_the_stages_stay_the_same_and_none_weighs_nothing():
    for parameters in (CONFIG, replace(CONFIG, training_episodes=0), RemapConfig("drive", append=True)):
        for size in (SIZE, (0, 0, 0)):
            stages = remap_stages(parameters, *size)
            assert list(stages) == list(REMAP_STAGES)
            assert min(stages.values()) > 0


def test_stages_weigh_by_what_they_have_to_do():
    def trained(n_episodes, n_frames=12_000, **changes):
        parameters = replace(CONFIG, training_episodes=n_episodes, **changes)
        return remap_stages(parameters, n_frames, 12_000, 512)["train"]

    assert trained(300_000) == pytest.approx(30 * trained(10_000), rel=0.01)
    assert trained(10_000_000) == trained(25 * 12_000), "a map takes so many"
    assert trained(300_000, 100) == trained(2_500, 100)
    assert trained(10_000, append=True, landmark_traverse=None) < 0.1 < trained(10_000)
    assert trained(10_000, relevance=Relevance.BRUTE_FORCE) < 0.1
    stages = remap_stages(RemapConfig("drive"), 12_000, 0, 512)
    assert 0.1 < stages["describe"] < 0.6 * remap_stages(CONFIG, *SIZE)["describe"]


def test_the_size_is_that_of_the_traverses(catalog, drive):
    drive("drive", 12)
    drive("other", 30)
    drive("empty", 0)
    for parameters, size in (
        (CONFIG, (12, 30, 6)),
        (RemapConfig("drive"), (12, 0, 6)),
        (RemapConfig("empty", "drive"), (0, 12, 0)),
    ):
        assert stages_in(catalog.data_dir, DOMAIN, parameters) == remap_stages(parameters, *size)


def test_contradictions_are_named():
    with pytest.raises(InvalidMapConfigError):
        RemapConfig("drive", list_length=5, n_landmarks=4)


def test_it_survives_its_json_form():
    config = RemapConfig("drive", "other", 40, 3, Relevance.RRF, 5, 6, activate=False, same_route=True)
    assert RemapConfig.from_dict(json.loads(json.dumps(config.as_dict()))) == config


# --- a job that was interrupted ------------------------------------------------------------------------------------


class DiedError(BaseException):
    """Stands for the end of the process."""


@pytest.fixture
def job(remapped, two_drives):
    """One start of one job, until its end or until a stage begins."""

    def start(dies_at=None, **config):
        def on_change(state):
            if state.stage == dies_at:
                raise DiedError(dies_at)

        return remapped(progress=Progress(REMAP_STAGES, on_change), job_id="0123456789abcdef" * 2, **config)

    return start


def test_a_sealed_map_is_only_activated(catalog, job):
    with pytest.raises(DiedError):
        job(dies_at="activate")
    assert catalog.map(DOMAIN, 1).state is MapState.SEALED
    Traverse.delete(catalog.data_dir, DOMAIN, "drive")  # nothing is read any more
    assert job() == {"map_version": 1, "active": True, "metrics": catalog.map(DOMAIN, 1).metrics}
    assert [record.state for record in catalog.maps(DOMAIN)] == [MapState.ACTIVE]


def test_a_rollback_before_the_job_ended_is_not_undone(catalog, job, remapped):
    remapped()
    job()  # its process dies before the row says that it ended
    catalog.activate(DOMAIN, 1, ANY)
    assert job()["map_version"] == 2
    assert (catalog.domain(DOMAIN).active_version, len(catalog.maps(DOMAIN))) == (1, 2)


def test_a_map_that_is_not_to_serve_stays_sealed(catalog, job):
    for _ in range(2):
        result = job(activate=False)
        assert (result["map_version"], result["active"]) == (1, False)
    assert [record.state for record in catalog.maps(DOMAIN)] == [MapState.SEALED]
