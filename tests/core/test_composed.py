"""`composed`: every kind of view, and what two seasons and one teach: `test_vpr` has the definition."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core import composed
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.composed import Moments, compose, principal_directions, unit
from deepsimbad.core.descriptor import rank_landmarks, ranks_from_ranked_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import products_with_landmarks, relevances
from deepsimbad.core.landmark_model import farthest_first
from deepsimbad.core.rehearsal import novelty_curve
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.errors import InvalidInputError, InvalidMapConfigError, TooFewCandidatesError
from deepsimbad.jobs.append import append_drive

PLAN = MapPlan(Relevance.COMPOSED, 4, (1.0, 2.0, 5.0), same_route=True)
WEIGHTS = (1.0, 0.8, 0.65, 0.5)


def drive_of(encodings, position_m=None):
    position_m = np.arange(float(len(encodings))) if position_m is None else position_m
    return Drive(position_m=position_m, encodings=np.asarray(encodings, np.float32))


@pytest.fixture(scope="module")
def seasons():
    """[n, d] encodings of one route in three seasons, each with its own shift and scale."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(160, 24))
    return [
        rng.normal(size=24) + rng.uniform(0.5, 2, 24) * (place + 0.4 * rng.normal(size=place.shape)) for _ in range(3)
    ]


# --- lists and relevance -------------------------------------------------------------------------------------------


def test_barred_landmarks_are_listed_last():
    rng = np.random.default_rng(1)
    places, landmarks = unit(rng.normal(size=(5, 6))), unit(rng.normal(size=(6, 6)))
    barred = np.zeros((5, 6), bool)
    barred[:, :2] = True
    assert not (compose(places, landmarks, 4, barred) < 2).any()
    assert (np.sort(compose(places, landmarks, 6, barred)[-2:], axis=0).T == [0, 1]).all()


# --- every kind of view --------------------------------------------------------------------------------------------


def views_of(map_, encoding):
    """The same view in every form in which it may be sent."""
    full_query = Query(np.arange(1.0, map_.n_landmarks + 1, dtype=np.float32), encoding=encoding)
    dissimilarities = (2 - 2 * products_with_landmarks(map_, full_query)).astype(np.float32)
    ranks = rank_landmarks(dissimilarities)
    nearest = ranks_from_ranked_landmarks(np.argsort(dissimilarities)[:15].tolist(), map_.n_landmarks)
    return {
        "encoding": full_query,
        "dissimilarities": Query(ranks, dissimilarities),
        "ranks": Query(ranks),
        "nearest": Query(nearest),
    }


def test_every_kind_of_view_finds_its_place(seasons):
    map_ = compose_map(PLAN, drive_of(seasons[1]), drive_of(seasons[0]), None, 100).map
    least_hits = {"encoding": 140, "dissimilarities": 140, "ranks": 130, "nearest": 110}
    hits, live = dict.fromkeys(least_hits, 0), dict.fromkeys(least_hits, map_.live_statistics)
    for place, row in enumerate(seasons[2].astype(np.float32)):
        for kind, query in views_of(map_, row).items():
            live[kind] = live[kind].observing(query)
            hits[kind] += int(relevances(map_, query, live[kind]).argmax()) == place
    assert {kind for kind in hits if hits[kind] > least_hits[kind]} == hits.keys(), hits


def test_of_ranks_the_one_vector_counts_that_fits_all_scores_best(seasons):
    map_ = compose_map(PLAN, drive_of(seasons[1]), drive_of(seasons[0]), None, 100).map
    landmarks, statistics, errors = map_.landmark_model["prototypes"].astype(np.float64), map_.live_statistics, []
    for row in seasons[2].astype(np.float32):
        exact = products_with_landmarks(map_, Query(np.ones(100, np.float32), encoding=row))
        ranks = rank_landmarks(2 - 2 * exact)
        scores = statistics.products.mean - statistics.products.std * statistics.ranks.standardise(ranks)
        products = products_with_landmarks(map_, Query(ranks))
        assert products == pytest.approx(landmarks @ np.linalg.lstsq(landmarks, scores)[0], abs=0.02)
        errors.append([np.linalg.norm(estimates - exact) for estimates in (products, scores)])
    fitted_error, scores_error = np.mean(errors, axis=0)
    assert fitted_error < 0.95 * scores_error


def test_without_a_session_dissimilarities_answer_as_their_encoding_does(seasons):
    map_ = compose_map(PLAN, drive_of(seasons[1]), None, None, 50).map
    views = views_of(map_, seasons[2][7].astype(np.float32))
    np.testing.assert_allclose(
        relevances(map_, views["dissimilarities"]), relevances(map_, views["encoding"]), atol=1e-5
    )
    foreign = Query(views["ranks"].ranks, 1000 * views["dissimilarities"].dissimilarities)
    assert foreign.products is None, "no squared distances of unit vectors: their ranks count"
    np.testing.assert_array_equal(relevances(map_, foreign), relevances(map_, views["ranks"]))


def test_an_encoding_of_another_length_is_refused(seasons):
    map_ = compose_map(PLAN, drive_of(seasons[1]), None, None, 50).map
    with pytest.raises(InvalidInputError, match="7 numbers; the map's have 24"):
        relevances(map_, Query(np.arange(1.0, 51, dtype=np.float32), encoding=np.ones(7, np.float32)))


# --- landmarks, projections, seasons -------------------------------------------------------------------------------


def test_long_encodings_are_projected_and_keep_their_neighbours():
    rng = np.random.default_rng(6)
    place = rng.normal(size=(200, 20)) @ rng.normal(size=(20, 500))
    first, second = (place + rng.normal(size=place.shape) for _ in range(2))
    assert principal_directions(rng.normal(size=(50, 96)).astype(np.float32)) is None
    map_ = compose_map(PLAN, drive_of(first), None, None, 100).map
    assert map_.landmark_model["projection"].shape == (500, 96)
    hits = [
        int(relevances(map_, Query(np.arange(1.0, 101, dtype=np.float32), encoding=row)).argmax()) == place
        for place, row in enumerate(second.astype(np.float32))
    ]
    assert np.mean(hits) > 0.9
    short = compose_map(PLAN, drive_of(first[:9]), None, None, 5).map
    assert short.landmark_model["projection"].shape == (500, 8)


def test_numbers_that_hardly_differ_count_little():
    """Where they counted as much as those that show places, their noise would drown them."""
    rng = np.random.default_rng(3)
    places = rng.normal(size=(120, 24))
    first, second = (np.hstack([places, 0.1 * rng.normal(size=(120, 1500))]).astype(np.float32) for _ in range(2))
    projection = principal_directions(first)
    u, v = (composed.described(drive, Moments.of(drive), projection) for drive in (first, second))
    assert np.mean((u @ v.T).argmax(axis=0) == np.arange(120)) > 0.95
    flat = [unit((drive - drive.mean(axis=0)) / drive.std(axis=0)) for drive in (first, second)]
    assert np.mean((flat[0] @ flat[1].T).argmax(axis=0) == np.arange(120)) < 0.5


def test_two_seasons_teach_and_one_does_not(seasons):
    of_one_season = compose_map(PLAN, drive_of(seasons[1]), None, None, 60)
    of_two_seasons = compose_map(PLAN, drive_of(seasons[1]), drive_of(seasons[0]), None, 60)
    assert of_one_season.map.likelihood_scale is None
    assert of_two_seasons.map.likelihood_scale[0] > 2
    assert of_two_seasons.second is not None
    assert not np.array_equal(of_two_seasons.map.lists, of_two_seasons.rehearsal.lists), (
        "the rehearsal does not know the second season"
    )
    mean = np.mean([season.astype(np.float32).mean(axis=0) for season in seasons[:2]], axis=0)
    np.testing.assert_allclose(of_two_seasons.map.usual_encoding[0], mean, atol=1e-4)
    for outcome in (of_one_season, of_two_seasons):
        assert outcome.map.novelty[0] == 1
        assert (np.diff(outcome.map.novelty) <= 0).all()
        assert np.isfinite(outcome.map.view_bits).all()
        outcome.map.check()


def test_a_season_counts_at_a_place_by_all_its_frames_there(seasons):
    twice_m = np.repeat(np.arange(160.0), 2)
    pairs = np.stack([seasons[0], seasons[2]])  # of frames at every place, in one order and in the other
    first, second = (
        compose_map(
            PLAN, drive_of(seasons[1]), drive_of(np.concatenate(frames, axis=1).reshape(-1, 24), twice_m), None, 100
        )
        for frames in (pairs, pairs[::-1])
    )
    assert first.places == pytest.approx(second.places, abs=1e-5)


def test_places_that_look_alike_tell_less(seasons):
    """A stretch that comes again stands out less than one that does not, by two seasons and by one."""
    twice = [np.concatenate([season[:40], season[:120]]) for season in seasons[:2]]
    for second, least_bits in ((None, 0.1), (drive_of(twice[0]), 0.3)):
        bits = compose_map(PLAN, drive_of(twice[1]), second, None, 60).map.view_bits
        assert bits[80:].mean() > bits[:80].mean() + least_bits


def test_a_places_own_landmark_is_barred_from_the_rehearsal(seasons):
    second = drive_of(seasons[0])
    outcome = compose_map(PLAN, drive_of(seasons[1]), second, second, 160)
    frames, landmarks = _frames_of(outcome, second), np.arange(160)
    assert not (outcome.rehearsal.lists[:, frames] == landmarks).any()
    assert (outcome.map.lists[:, frames] == landmarks).any(axis=0).mean() > 0.5


@pytest.mark.parametrize("landmarks", ["of the second drive", "of its own"])
def test_own_places_landmarks_can_be_barred_from_all_lists(seasons, landmarks):
    second = drive_of(seasons[0])
    candidates = second if landmarks == "of the second drive" else None
    plan = replace(PLAN, bars_own_place=True)
    outcome = compose_map(plan, training := drive_of(seasons[1]), second, candidates, 120)
    frames = _frames_of(outcome, training if candidates is None else second)
    for lists in (outcome.map.lists, outcome.rehearsal.lists):
        assert (np.abs(frames[lists] - np.arange(160)) > 2).all()
    unbarred_outcome = compose_map(PLAN, training, second, candidates, 120)
    assert (np.abs(frames[unbarred_outcome.map.lists] - np.arange(160)) <= 2).any()


def _frames_of(outcome, second):
    """[r] the frame of the second drive that each landmark was chosen as; in the rehearsal it still is."""
    model = outcome.rehearsal.landmark_model
    u = unit(composed.described(second.encodings, Moments.of(second.encodings), None) @ model["projection"])
    return (model["prototypes"] @ u.T).argmax(axis=1)


def test_landmarks_move_to_where_their_sums_come_nearer_to_places(seasons):
    drive, r = drive_of(seasons[1]), 40
    outcome = compose_map(PLAN, drive, None, None, r)
    u = composed.described(drive.encodings, Moments.of(drive.encodings), None)
    frames, learnt = u[farthest_first(u, r)], outcome.map.landmark_model["prototypes"]

    def nearness(lists, landmarks):
        sums = sum(weight * landmarks[ids] for weight, ids in zip(WEIGHTS, lists, strict=True))
        return (unit(sums) * outcome.places).sum(axis=1).mean()

    assert nearness(outcome.map.lists, learnt) > nearness(compose(u, frames, 4), frames) + 0.05
    np.testing.assert_allclose(np.linalg.norm(learnt, axis=1), 1, atol=1e-5)


def test_landmarks_that_stay_are_compared_with_what_is_usual_now(seasons):
    old_map = compose_map(PLAN, drive_of(seasons[0]), None, None, 60).map
    new_map = compose_map(PLAN, drive_of(seasons[1]), drive_of(seasons[0]), old_map.landmark_model, 60).map
    assert np.array_equal(new_map.landmark_model["prototypes"], old_map.landmark_model["prototypes"])
    assert np.array_equal(new_map.landmark_model["usual"], new_map.usual_encoding)
    assert not np.array_equal(new_map.usual_encoding, old_map.usual_encoding)


@pytest.mark.parametrize("numbers", [slice(3, 4), slice(None)], ids=["a number that stays", "frames alike"])
def test_degenerate_drives(numbers, seasons):
    encodings = seasons[1].copy()
    encodings[:, numbers] = encodings[0, numbers]
    map_ = compose_map(PLAN, drive_of(encodings), drive_of(seasons[0]), None, 60).map
    map_.check()
    query = Query(np.arange(1.0, 61, dtype=np.float32), encoding=map_.usual_encoding[0])
    assert np.isfinite(relevances(map_, query)).all()


def test_too_few_frames_are_named(seasons):
    for n_landmarks, error, says in ((10, TooFewCandidatesError, "9"), (3, InvalidMapConfigError, "list_length")):
        with pytest.raises(error, match=says):
            compose_map(PLAN, drive_of(seasons[1][:9]), None, None, n_landmarks)


def test_appended_frames_are_described_by_their_own_season(seasons):
    map_ = compose_map(PLAN, drive_of(seasons[1][:100]), None, None, 60).map
    model = map_.landmark_model
    drive = drive_of(seasons[0][100:], np.arange(100.0, 160.0))
    u = composed.described(drive.encodings, map_.live_statistics.encodings, model.get("projection"))
    longer_map = append_drive(map_, replace(drive, dissimilarities=np.clip(2 - 2 * u @ model["prototypes"].T, 0, 4)))
    assert np.array_equal(longer_map.lists[:, :100], map_.lists)
    hits, live = 0, longer_map.live_statistics
    for place in range(100, 160):
        query = Query(np.arange(1.0, 61, dtype=np.float32), encoding=seasons[2][place].astype(np.float32))
        live = live.observing(query)
        hits += abs(int(relevances(longer_map, query, live).argmax()) - place) <= 1
    assert hits > 40


def test_a_few_appended_frames_that_are_alike_mute_nothing(seasons):
    map_ = compose_map(PLAN, drive_of(seasons[1]), None, None, 60).map
    u = composed.described(drive_of(seasons[1][:1]).encodings, map_.live_statistics.encodings, None)
    drive = drive_of(seasons[1][:1], np.array([7.5]))
    longer_map = append_drive(map_, replace(drive, dissimilarities=np.clip(2 - 2 * u @ u.T, 0, 4).repeat(60, axis=1)))
    assert longer_map.usual_encoding == pytest.approx(map_.usual_encoding, abs=0.05)


def test_progress_is_told_in_small_steps_while_the_directions_are_found():
    """They take most of the time of a map of long encodings."""
    encodings = np.random.default_rng(0).normal(size=(120, 200)).astype(np.float32)
    shares = [0.0]
    compose_map(PLAN, drive_of(encodings), None, None, 20, shares.append)
    steps = np.diff(shares)
    assert 0 <= steps.min() < steps.max() < 0.3
    assert (shares[-1], len(shares) > 8) == (1, True)


def test_views_a_world_apart_take_no_more_room_than_views_out_of_sight():
    difference = np.random.default_rng(5).normal(size=(60, 4))
    near, far = (novelty_curve(gap_m * np.arange(60), difference, 10.0) for gap_m in (100.0, 3e7))
    assert np.array_equal(near, far)
