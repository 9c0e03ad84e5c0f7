"""Remapping: what the map file holds, what stays when it fails."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import (
    CancelledError,
    InvalidEncodingError,
    InvalidMapConfigError,
    InvalidRouteError,
    TooFewCandidatesError,
    UnknownDomainError,
    UnknownTraverseError,
)
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import REMAP_STAGES, remap
from deepsimbad.jobs.remap_inputs import read_inputs
from deepsimbad.store.frames import UNKNOWN_TIMESTAMP, TraverseFrames
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import MapState
from deepsimbad.store.sealing import verify
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
    assert {tuple(row) for row in prototypes} <= {tuple(row) for row in candidates}
    for image, encoding in enumerate(encodings):
        assert contents.lists[:, image].tolist() == nearest_first(encoding, prototypes)[:4]
    assert contents.position_m.tolist() == (np.arange(12) * 1.5).tolist()
    assert contents.x_m.tolist() == list(range(12))
    assert contents.timestamp_us is None
    assert contents.config["n_landmarks"] == 8
    assert contents.config["landmark_traverse"] == "other"


def test_times_are_kept_where_they_are_known(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 5, timestamp_us=np.arange(5) + 7)
    remap(catalog, DOMAIN, config(), evaluator, quiet)
    assert read_map(catalog.map_path(DOMAIN, 1)).timestamp_us.tolist() == [7, 8, 9, 10, 11]


def test_without_a_landmark_traverse_the_active_maps_landmarks_stay(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 12)
    remap(catalog, DOMAIN, config(), evaluator, quiet)
    drive("later", 9, seed=2)
    again = config(training_traverse="later", landmark_traverse=None, n_landmarks=None)
    assert remap(catalog, DOMAIN, again, evaluator, Progress(REMAP_STAGES))["map_version"] == 2
    first, second = (read_map(catalog.map_path(DOMAIN, version)) for version in (1, 2))
    assert np.array_equal(first.landmark_model["prototypes"], second.landmark_model["prototypes"])
    assert second.lists.shape == (4, 9)
    assert second.config["n_landmarks"] == 8
    assert catalog.domain(DOMAIN).active_version == 2
    assert catalog.map(DOMAIN, 1).state is MapState.RETIRED


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


def test_a_first_map_needs_landmarks_from_somewhere(catalog, drive, evaluator, quiet):
    drive("drive", 12)
    with pytest.raises(InvalidMapConfigError, match="give a landmark_traverse"):
        remap(catalog, DOMAIN, config(landmark_traverse=None, n_landmarks=None), evaluator, quiet)


@pytest.mark.parametrize(("position_m", "frame"), [([0.0, 1.0, 0.5, 2.0, 3.0], 2), ([0.0, 1.0, 2.0, 3.0, 2.999], 4)])
def test_positions_that_go_backwards_leave_nothing_behind(catalog, drive, evaluator, quiet, position_m, frame):
    drive("other", 30, seed=1)
    drive("drive", 5, position_m=position_m)
    with pytest.raises(InvalidRouteError, match=f"backwards at frame {frame}"):
        remap(catalog, DOMAIN, config(), evaluator, quiet)
    assert catalog.maps(DOMAIN) == []
    assert files_of(catalog) == []
    assert catalog.domain(DOMAIN).active_version is None


def test_standing_still_is_no_going_backwards(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 4, position_m=[0, 0, 1, 1])
    assert remap(catalog, DOMAIN, config(), evaluator, quiet)["map_version"] == 1


@pytest.mark.parametrize("role", ["drive", "other"])
def test_a_traverse_without_frames_is_named(catalog, drive, evaluator, quiet, role):
    drive("other", 0 if role == "other" else 30, seed=1)
    drive("drive", 0 if role == "drive" else 5)
    with pytest.raises(InvalidMapConfigError, match=f"traverse {role} has no frames yet"):
        remap(catalog, DOMAIN, config(), evaluator, quiet)
    assert catalog.maps(DOMAIN) == []


def test_unknown_names_are_named(catalog, drive, evaluator, quiet):
    drive("drive", 5)
    with pytest.raises(UnknownTraverseError, match="other"):
        remap(catalog, DOMAIN, config(), evaluator, quiet)
    with pytest.raises(UnknownDomainError, match="elsewhere"):
        remap(catalog, "elsewhere", config(), evaluator, Progress(REMAP_STAGES))


def test_fewer_candidates_than_landmarks(catalog, drive, evaluator, quiet):
    drive("other", 7, seed=1)
    drive("drive", 5)
    with pytest.raises(TooFewCandidatesError) as raised:
        remap(catalog, DOMAIN, config(), evaluator, quiet)
    assert raised.value.hints == {"n_candidates": 7, "n_landmarks": 8}
    assert catalog.maps(DOMAIN) == []


def test_traverses_of_two_encoders_are_named(catalog, drive, evaluator, quiet):
    drive("winter", 8, d=4)
    drive("summer", 8)
    with pytest.raises(InvalidEncodingError, match="winter holds encodings of 4 numbers, traverse summer of 6"):
        remap(catalog, DOMAIN, RemapConfig("summer", "winter", n_landmarks=5), evaluator, quiet)
    assert catalog.domain(DOMAIN).active_version is None


def test_the_active_maps_landmarks_may_come_from_another_encoder(catalog, drive, evaluator, quiet):
    drive("summer", 8)
    drive("winter", 8, d=4)
    remap(catalog, DOMAIN, RemapConfig("summer", "summer", n_landmarks=5), evaluator, quiet)
    with pytest.raises(InvalidEncodingError, match="4 numbers cannot be compared with landmarks of 6"):
        remap(catalog, DOMAIN, RemapConfig("winter"), evaluator, quiet)


def test_a_map_of_one_image(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 1)
    assert remap(catalog, DOMAIN, config(), evaluator, quiet)["metrics"]["n_map_images"] == 1
    assert read_map(catalog.map_path(DOMAIN, 1)).lists.shape == (4, 1)


def test_a_map_need_not_serve_at_once(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 5)
    assert remap(catalog, DOMAIN, config(activate=False), evaluator, quiet)["active"] is False
    assert catalog.map(DOMAIN, 1).state is MapState.SEALED
    assert catalog.domain(DOMAIN).active_version is None


@pytest.mark.parametrize(
    "relevance",
    [
        Relevance.STANDARDISED,
        Relevance.RRF,
        Relevance.BAG_OF_LANDMARKS,
        Relevance.SIMBAD,
        Relevance.BRUTE_FORCE,
    ],
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
    progress = Progress(REMAP_STAGES, lambda state: at.append(state.stage), lambda: at[-1:] == [before(stage)])
    with pytest.raises(CancelledError):
        remap(catalog, DOMAIN, config(), evaluator, progress if stage != "read frames" else cancelled())
    assert catalog.maps(DOMAIN) == []
    assert files_of(catalog) == []
    assert catalog.domain(DOMAIN).active_version is None


def before(stage):
    """Once this stage was told, the next report stops the work."""
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
        known = np.arange(PLACES, dtype=float) if plane else np.full(PLACES, np.nan)
        for name, seen in (("drive", places), ("other", places), ("strange", rng.normal(size=places.shape))):
            frames = TraverseFrames(
                index=np.arange(PLACES),
                position_m=np.arange(PLACES, dtype=float),
                timestamp_us=np.full(PLACES, UNKNOWN_TIMESTAMP),
                x_m=known,
                y_m=0 * known,
                encodings=(seen + 0.3 * rng.normal(size=seen.shape)).astype(np.float32),
            )
            with Traverse.create(catalog.data_dir, DOMAIN, name) as traverse:
                traverse.put_frames(frames)

    return store


@pytest.mark.parametrize(
    ("plane", "asked", "accepted", "why"),
    [
        (False, {}, False, "without x, y of both drives nothing says"),
        (False, {"same_route": True}, True, None),
        (True, {}, True, None),
        (True, {"same_route": False}, False, "are said not to share their positions"),
        (False, {"same_route": True, "landmark_traverse": "strange"}, False, "agree no better"),
        (True, {"landmark_traverse": "strange"}, False, "agree no better"),
    ],
)
@pytest.mark.parametrize("relevance", [Relevance.CALIBRATED, Relevance.RRF])
def test_a_second_drive_is_learnt_from_only_on_the_same_route(
    catalog, route, evaluator, plane, asked, accepted, why, relevance
):
    """One verdict holds for trust, for telling places and off the route, and for the live images of training."""
    route(plane)
    asked = config(n_landmarks=60, training_episodes=20, relevance=relevance, **asked)
    metrics = remap(catalog, DOMAIN, asked, evaluator, Progress(REMAP_STAGES))["metrics"]
    season = metrics["second_season"]
    assert season["accepted"] is accepted
    assert season["why"] is None if why is None else why in season["why"]
    assert (season["significance"] is None) == (season["n_pairs"] == 0) == (why is not None and "agree" not in why)
    assert metrics["training"]["live_images"] == ("landmark_traverse" if accepted else "held_out_frames")
    assert catalog.map(DOMAIN, 1).metrics["second_season"] == season
    contents = read_map(catalog.map_path(DOMAIN, 1))
    learnt = accepted and relevance is Relevance.CALIBRATED
    assert (contents.telling_bits is not None) == (contents.off_route_model is not None) == learnt
    if relevance is Relevance.CALIBRATED:
        assert (set(contents.correlation.tolist()) != {0.6}) == accepted


def test_without_a_second_drive_there_is_no_verdict(catalog, drive, evaluator, quiet):
    drive("drive", 12)
    result = remap(catalog, DOMAIN, config(landmark_traverse="drive"), evaluator, quiet)
    assert result["metrics"]["second_season"] is None


def test_where_landmarks_stay_the_active_maps_drive_is_judged(catalog, route, evaluator):
    route()
    remap(catalog, DOMAIN, config(training_episodes=0), evaluator, Progress(REMAP_STAGES))
    later = config(training_traverse="strange", landmark_traverse=None, n_landmarks=None, training_episodes=0)
    told = remap(catalog, DOMAIN, replace(later, same_route=True), evaluator, Progress(REMAP_STAGES))
    assert told["metrics"]["second_season"]["accepted"] is False
    again = remap(catalog, DOMAIN, config(training_episodes=0), evaluator, Progress(REMAP_STAGES))
    back = config(training_traverse="other", landmark_traverse=None, n_landmarks=None, same_route=True)
    assert again["map_version"] == 3
    assert remap(catalog, DOMAIN, back, evaluator, Progress(REMAP_STAGES))["metrics"]["second_season"]["accepted"]


def test_what_is_said_of_the_positions_is_an_input(catalog, route, evaluator):
    route()
    digests = {read_inputs(catalog, DOMAIN, config(same_route=said)).digest() for said in (None, False, True)}
    assert len(digests) == 3
