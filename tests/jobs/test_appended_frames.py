"""What a drive that is appended to a map becomes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.descriptor import LandmarkStatistics, nearest_landmarks, normal_scores, rank_landmarks
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import UNKNOWN_FRAME
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.jobs.append import append_drive, nearest_known

from ..core.conftest import a_drive, a_map

BUILT_FROM_DISSIMILARITIES = sorted(set(Relevance) - {Relevance.COMPOSED})

R, H = 12, 3


def random_rows(n, seed):
    return np.random.default_rng(seed).random((n, R)).astype(np.float32)


def old_map(relevance, n=20, seed=0, **fields):
    return a_map(relevance, random_rows(n, seed), H, actions_m=(1.0, 2.0), **fields)


def millimetres(least_m, most_m):
    """Positions that are no shorter a route than there may be."""
    return st.integers(1000 * least_m, 1000 * most_m).map(lambda position_mm: position_mm / 1000)


@pytest.mark.parametrize("relevance", BUILT_FROM_DISSIMILARITIES)
@given(
    old_m=st.lists(millimetres(0, 100), min_size=1, max_size=20),
    new_m=st.lists(millimetres(-20, 120), min_size=1, max_size=20),
    closed=st.booleans(),
)
def test_old_images_stay_as_they_are_and_all_lie_in_route_order(relevance, old_m, new_m, closed):
    old = old_map(relevance, len(old_m), closed=closed, position_m=np.sort(old_m))
    new_drive = a_drive(random_rows(len(new_m), 1), position_m=np.sort(new_m), timestamp_us=np.arange(len(new_m)))
    merged = append_drive(old, new_drive)
    n_old, route = len(old_m), old.route
    assert (np.diff(merged.position_m) >= 0).all()
    is_new = merged.frame_digest != UNKNOWN_FRAME
    assert np.array_equal(merged.lists[:, ~is_new], old.lists)
    assert np.array_equal(merged.position_m[~is_new], old.position_m)
    assert (merged.timestamp_us[~is_new] == -1).all()
    frames = [new_drive.digests().tolist().index(digest) for digest in merged.frame_digest[is_new].tolist()]
    assert sorted(frames) == list(range(len(new_m)))
    assert merged.timestamp_us[is_new].tolist() == frames
    if relevance is Relevance.SIMBAD:
        assert np.array_equal(merged.values[:, ~is_new], old.values)
        rows, lists = new_drive.dissimilarities[frames], merged.lists[:, is_new].T.astype(np.intp)
        assert np.array_equal(merged.values[:, is_new].T, np.take_along_axis(rows, lists, axis=1))
    if relevance is Relevance.BRUTE_FORCE:
        assert np.array_equal(merged.encodings[is_new], new_drive.encodings[frames])
    if not closed:
        assert np.array_equal(merged.position_m[is_new], new_drive.position_m[frames])
    elif route.length_m > 0:
        inside = merged.position_m[is_new] - route.start_m
        assert ((inside >= 0) & (inside < route.length_m + 1e-9)).all()
    assert merged.n_images == n_old + len(new_m)


@pytest.mark.parametrize("relevance", [Relevance.RRF, Relevance.BAG_OF_LANDMARKS, Relevance.SIMBAD])
def test_new_lists_are_the_nearest_landmarks_by_rank(relevance):
    merged = append_drive(old_map(relevance), a_drive(random_rows(7, 1), position_m=np.arange(7) + 0.5))
    lists = merged.lists[:, merged.frame_digest != UNKNOWN_FRAME]
    assert np.array_equal(lists, nearest_landmarks(rank_landmarks(random_rows(7, 1)), H))


def test_new_lists_come_from_the_new_drives_own_statistics():
    """A season that lifts one landmark everywhere does not put it in every list."""
    old = old_map(Relevance.STANDARDISED, 400)
    season = random_rows(4000, 1)
    season[:, 5] /= 100
    merged = append_drive(old, a_drive(season, position_m=np.arange(4000) / 10))
    lists = merged.lists[:, merged.frame_digest != UNKNOWN_FRAME]
    expected = nearest_landmarks(
        LandmarkStatistics.of_map(rank_landmarks(season)).standardise(rank_landmarks(season)), H
    )
    assert (lists == expected).mean() > 0.95  # the map's statistics count for a few frames among 4,000
    naive = nearest_landmarks(old.live_statistics.ranks.standardise(rank_landmarks(season)), H)
    assert (naive == 5).any(axis=0).mean() > 0.95
    assert (lists == 5).any(axis=0).mean() < 0.6


def test_one_frame_alone_is_described_too():
    """Its own statistics would call everything usual, and list landmarks 0, 1, 2."""
    merged = append_drive(old_map(Relevance.STANDARDISED, 400), a_drive(random_rows(1, 9), position_m=[7.25]))
    (image,) = np.flatnonzero(merged.frame_digest != UNKNOWN_FRAME)
    assert merged.position_m[image] == 7.25
    assert merged.lists[0, image] == np.argmin(random_rows(1, 9))
    relevance = relevances(merged, Query(rank_landmarks(random_rows(1, 9)[0])))
    assert relevance[image] > np.quantile(relevance, 0.95)


def test_the_maps_statistics_become_those_of_all_its_images():
    old = old_map(Relevance.STANDARDISED, 30)
    merged = append_drive(old, a_drive(random_rows(10, 1)))
    scores = normal_scores(rank_landmarks(np.concatenate([random_rows(30, 0), random_rows(10, 1)])), R)
    assert merged.statistics == pytest.approx(np.stack([scores.mean(axis=0), scores.std(axis=0)]))


def test_a_position_of_another_turn_lies_within_the_first():
    old = old_map(Relevance.RRF, 10, closed=True)  # once around is 10 m
    merged = append_drive(old, a_drive(random_rows(3, 1), position_m=[12.5, 19.75, 30.0]))
    assert merged.position_m[merged.frame_digest != UNKNOWN_FRAME].tolist() == [0.0, 2.5, 9.75]


@pytest.mark.parametrize(
    ("closed", "position_m", "image", "is_near"),
    [
        (False, 3.4, 3, True),
        (False, 10.0, 9, True),
        (False, 11.5, 9, False),
        (False, -2.5, 0, False),
        (True, 9.9, 0, True),  # the start is nearer behind the last image
        (True, 23.2, 3, True),
    ],
)
def test_the_nearest_old_image(closed, position_m, image, is_near):
    nearest, near = nearest_known(old_map(Relevance.RRF, 10, closed=closed), np.array([position_m]))
    assert (nearest[0], near[0]) == (image, is_near)


def test_a_new_image_knows_of_its_place_what_the_nearest_old_one_does():
    rng = np.random.default_rng(0)
    bits, q_values = rng.random(9).astype(np.float32), rng.random((9, 2)).astype(np.float32)
    old = replace(old_map(Relevance.RRF, 9), view_bits=bits, q_values=q_values)
    fields = {"timestamp_us": np.array([5, 6]), "x_m": np.array([1.0, np.nan]), "y_m": np.array([2.0, np.nan])}
    merged = append_drive(old, a_drive(random_rows(2, 1), position_m=[3.2, 90.0], **fields))
    assert np.flatnonzero(merged.frame_digest != UNKNOWN_FRAME).tolist() == [4, 10], "where the new ones are"
    assert merged.view_bits[[4, 10]] == pytest.approx([bits[3], bits.mean()])
    assert np.delete(merged.view_bits, [4, 10]).tolist() == bits.tolist()
    assert merged.q_values[[4, 10]].tolist() == [q_values[3].tolist(), [np.float32(1e-4)] * 2]
    assert merged.timestamp_us.tolist() == [-1, -1, -1, -1, 5, -1, -1, -1, -1, -1, 6]
    assert merged.x_m[4] == 1.0
    assert np.isnan(np.delete(merged.x_m, 4)).all()
