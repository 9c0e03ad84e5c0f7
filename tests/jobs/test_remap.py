"""Remapping: what the map file holds, what stays when it fails; what it is asked for, and how its stages weigh."""

import json
from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import CancelledError, InvalidEncodingError, InvalidMapConfigError
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig, remap_stages, stages_in
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.map_file import read_map, verify
from deepsimbad.store.records import MapState
from deepsimbad.store.traverses import Traverse

DOMAIN = "route"


def config(**changes):
    return RemapConfig(**{"training_traverse": "drive", "landmark_traverse": "other", "n_landmarks": 8} | changes)


def files_of(catalog):
    folder = catalog.map_path(DOMAIN, 1).parent
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def nearest_first(encoding, prototypes):
    return sorted(range(len(prototypes)), key=lambda i: (float(np.sum((encoding - prototypes[i]) ** 2)), i))


def test_a_map_is_sealed_active_and_holds_the_lists_of_its_landmarks(catalog, drive, evaluator, quiet):
    candidates = drive("other", 30, seed=1)
    encodings = drive("drive", 12, position_m=np.arange(12) * 1.5, x_m=np.arange(12) * 1.0, y_m=np.zeros(12))
    result = remap(catalog, DOMAIN, config(relevance=Relevance.RRF), evaluator, quiet)
    assert result["map_version"] == 1
    assert result["active"] is True
    assert result["metrics"]["n_map_images"] == 12
    assert result["metrics"]["index_bits_per_map_image"] > 0
    assert catalog.domain(DOMAIN).active_version == 1
    record = catalog.map(DOMAIN, 1)
    assert record.state is MapState.ACTIVE
    verify(catalog.map_path(DOMAIN, 1), record.sha256)
    contents = read_map(catalog.map_path(DOMAIN, 1))
    prototypes = contents.landmark_model["prototypes"]
    candidate_rows = [int(name.removeprefix("other").removesuffix(".png")) for name in contents.landmark_frame]
    assert (prototypes == candidates[candidate_rows]).all()
    assert contents.landmark_drive.tolist() == 8 * ["other"]
    for image, encoding in enumerate(encodings):
        assert contents.lists[:, image].tolist() == nearest_first(encoding, prototypes)[:4]
    assert contents.position_m.tolist() == (np.arange(12) * 1.5).tolist()
    assert contents.x_m.tolist() == list(range(12))
    assert contents.timestamp_us is None
    assert contents.config["n_landmarks"] == 8
    assert contents.config["landmark_traverse"] == "other"


def test_kept_landmarks_have_the_number_they_have(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 12)
    remap(catalog, DOMAIN, config(), evaluator, quiet)
    with pytest.raises(InvalidMapConfigError, match="has 8 landmarks, not 9") as raised:
        remap(catalog, DOMAIN, config(landmark_traverse=None, n_landmarks=9), evaluator, Progress(REMAP_STAGES))
    assert raised.value.hints == {"n_landmarks": 8}
    too_long = config(landmark_traverse=None, n_landmarks=None, list_length=9)
    with pytest.raises(InvalidMapConfigError, match="list_length 9"):
        remap(catalog, DOMAIN, too_long, evaluator, Progress(REMAP_STAGES))
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]


def test_the_active_maps_landmarks_may_come_from_another_encoder(catalog, drive, evaluator, quiet):
    drive("summer", 8)
    drive("winter", 8, d=4)
    remap(catalog, DOMAIN, RemapConfig("summer", "summer", n_landmarks=5), evaluator, quiet)
    with pytest.raises(InvalidEncodingError, match="4 numbers cannot be compared with landmarks of 6"):
        remap(catalog, DOMAIN, RemapConfig("winter"), evaluator, quiet)


@pytest.mark.parametrize(
    "relevance",
    [Relevance.STANDARDISED, Relevance.RRF, Relevance.BAG_OF_LANDMARKS, Relevance.SIMBAD, Relevance.BRUTE_FORCE],
)
def test_a_map_keeps_what_its_relevance_needs_and_no_more(catalog, drive, evaluator, quiet, relevance):
    drive("other", 30, seed=1)
    drive("drive", 5)
    remap(catalog, DOMAIN, config(relevance=relevance), evaluator, quiet)
    contents = read_map(catalog.map_path(DOMAIN, 1))
    assert contents.config["relevance"] == relevance.value
    assert (contents.statistics is not None) == (relevance is Relevance.STANDARDISED)
    assert (contents.values is not None) == (relevance is Relevance.SIMBAD)
    assert (contents.encodings is not None) == (relevance is Relevance.BRUTE_FORCE)


@pytest.mark.parametrize("stage", list(REMAP_STAGES))
def test_cancelled_at_any_stage_it_leaves_nothing_behind(catalog, drive, evaluator, stage):
    drive("other", 30, seed=1)
    drive("drive", 5)
    at = []
    progress = Progress(REMAP_STAGES, lambda state: at.append(state.stage), lambda: at[-1:] == [previous_stage(stage)])
    with pytest.raises(CancelledError):
        remap(catalog, DOMAIN, config(), evaluator, progress if stage != "read frames" else cancelled())
    assert catalog.maps(DOMAIN) == []
    assert files_of(catalog) == []
    assert catalog.domain(DOMAIN).active_version is None


def previous_stage(stage):
    """The stage before one; a cancel that comes with its report stops the work at the next."""
    stages = list(REMAP_STAGES)
    return stages[max(0, stages.index(stage) - 1)]


def cancelled():
    return Progress(REMAP_STAGES, None, lambda: True)


# --- whether a second drive is learnt from -------------------------------------------------------------------------

PLACES = 120


@pytest.fixture
def route(catalog):
    """Stores drives of 120 places: `drive` and `other` of the same ones, `strange` of others, x and y where asked."""

    def store(plane=False):
        rng = np.random.default_rng(3)
        places = rng.normal(size=(PLACES, 16))
        known_m = np.arange(PLACES, dtype=float) if plane else np.full(PLACES, np.nan)
        for name, season_places in (("drive", places), ("other", places), ("strange", rng.normal(size=places.shape))):
            frames = Drive(
                position_m=np.arange(PLACES, dtype=float),
                x_m=known_m,
                y_m=0 * known_m,
                encodings=(season_places + 0.3 * rng.normal(size=season_places.shape)).astype(np.float32),
            )
            with Traverse.create(catalog.data_dir, DOMAIN, name) as traverse:
                traverse.put_frames(frames)

    return store


@pytest.mark.parametrize(
    ("relevance", "plane", "parameters", "accepted", "reason"),
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
    catalog, route, evaluator, relevance, plane, parameters, accepted, reason
):
    """One verdict holds for the likelihood, for whitening, and for the live images of training."""
    route(plane)
    parameters = config(n_landmarks=60, training_episodes=20, relevance=relevance, **parameters)
    metrics = remap(catalog, DOMAIN, parameters, evaluator, Progress(REMAP_STAGES))["metrics"]
    season = metrics["second_season"]
    assert season["accepted"] is accepted
    assert season["why"] is None if reason is None else reason in season["why"]
    assert (
        (season["significance"] is None) == (season["n_pairs"] == 0) == (reason is not None and "agree" not in reason)
    )
    assert metrics["training"]["live_images"] == ("landmark_traverse" if accepted else "held_out_frames")
    assert catalog.map(DOMAIN, 1).metrics["second_season"] == season
    contents = read_map(catalog.map_path(DOMAIN, 1))
    learns = relevance is not Relevance.RRF
    assert (contents.view_bits is not None) == (contents.novelty is not None) == learns
    fused = accepted and relevance is Relevance.COMPOSED
    assert (contents.likelihood_scale is not None) == ("projection" in contents.landmark_model) == fused


def test_without_a_second_drive_there_is_no_verdict(catalog, drive, evaluator, quiet):
    drive("drive", 12)
    result = remap(catalog, DOMAIN, config(landmark_traverse="drive"), evaluator, quiet)
    assert result["metrics"]["second_season"] is None


def test_where_landmarks_stay_the_active_maps_drive_is_judged(catalog, route, evaluator):
    route()
    remap(catalog, DOMAIN, config(training_episodes=0), evaluator, Progress(REMAP_STAGES))
    later = config(training_traverse="strange", landmark_traverse=None, n_landmarks=None, training_episodes=0)
    result = remap(catalog, DOMAIN, replace(later, same_route=True), evaluator, Progress(REMAP_STAGES))
    assert result["metrics"]["second_season"]["accepted"] is False
    again = remap(catalog, DOMAIN, config(training_episodes=0), evaluator, Progress(REMAP_STAGES))
    back = config(training_traverse="other", landmark_traverse=None, n_landmarks=None, same_route=True)
    assert again["map_version"] == 3
    assert remap(catalog, DOMAIN, back, evaluator, Progress(REMAP_STAGES))["metrics"]["second_season"]["accepted"]


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


@pytest.mark.parametrize(
    "wrong",
    [
        {"list_length": 0},
        {"list_length": 5, "n_landmarks": 4},
        {"n_landmarks": 0},
        {"n_landmarks": 65_536},
        {"training_episodes": -1},
        {"seed": -1},
    ],
)
def test_contradictions_are_named(wrong):
    with pytest.raises(InvalidMapConfigError):
        RemapConfig("drive", **wrong)


def test_it_survives_its_json_form():
    config = RemapConfig("drive", "other", 40, 3, Relevance.RRF, 5, 6, activate=False, same_route=True)
    assert RemapConfig.from_dict(json.loads(json.dumps(config.as_dict()))) == config


# --- a job that was interrupted ------------------------------------------------------------------------------------

JOB = "0123456789abcdef" * 2


class DiedError(BaseException):
    """Stands for the end of the process."""


def work(catalog, config, evaluator, dies_at=None):
    """One start of the job, until its end or until a stage begins."""

    def on_change(state):
        if state.stage == dies_at:
            raise DiedError(dies_at)

    return remap(catalog, DOMAIN, config, evaluator, Progress(REMAP_STAGES, on_change), job_id=JOB)


def test_a_sealed_map_is_only_activated(catalog, drive, evaluator):
    drive("other", 30, seed=1)
    drive("drive", 12)
    with pytest.raises(DiedError):
        work(catalog, config(), evaluator, dies_at="activate")
    assert catalog.map(DOMAIN, 1).state is MapState.SEALED
    Traverse.delete(catalog.data_dir, DOMAIN, "drive")  # nothing is read any more
    result = work(catalog, config(), evaluator)
    assert result == {"map_version": 1, "active": True, "metrics": catalog.map(DOMAIN, 1).metrics}
    assert [record.state for record in catalog.maps(DOMAIN)] == [MapState.ACTIVE]


def test_a_rollback_before_the_job_ended_is_not_undone(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 12)
    remap(catalog, DOMAIN, config(), evaluator, quiet)
    work(catalog, config(), evaluator)  # its process dies before the row says that it ended
    catalog.activate(DOMAIN, 1, ANY)
    assert work(catalog, config(), evaluator)["map_version"] == 2
    assert catalog.domain(DOMAIN).active_version == 1
    assert len(catalog.maps(DOMAIN)) == 2


def test_a_map_that_is_not_to_serve_stays_sealed(catalog, drive, evaluator):
    drive("other", 30, seed=1)
    drive("drive", 12)
    for _ in range(2):
        result = work(catalog, config(activate=False), evaluator)
        assert (result["map_version"], result["active"]) == (1, False)
    assert [record.state for record in catalog.maps(DOMAIN)] == [MapState.SEALED]
