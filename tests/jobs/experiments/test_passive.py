"""A drive in order against sums written out, and what is compared with what."""

import numpy as np
import pytest

from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.relevance import Relevance
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.jobs.experiments import passive

N = 60


@pytest.fixture(scope="module")
def passive_drive(evaluator):
    """Scores of a drive that is 1.5 m apart on a map of 1 m, and what every view said of every map image."""
    rng = np.random.default_rng(1)
    place = rng.normal(size=(N, 12))
    place_of_view = np.repeat(np.arange(0, N, 3), 2)  # every third place and the middle of the next two
    mixed = np.where(
        np.arange(place_of_view.size)[:, np.newaxis] % 2,
        (place[place_of_view + 1] + place[place_of_view + 2]) / 2,
        place[place_of_view],
    )
    test = drive_of(mixed + rng.normal(size=mixed.shape), 1.5)
    map_ = compose_map(MapPlan(Relevance.COMPOSED, 4, (1.0, 2.0)), drive_of(place, 1.0), None, None, 40).map
    views = views_of(measure_drive(test, map_.landmark_model, evaluator))
    truth = [np.flatnonzero(np.abs(map_.position_m - at_m) <= 1.0) for at_m in test.position_m]
    live, rows = map_.live_statistics, []
    for frame in range(test.n_frames):
        live = live.observing(views.at(frame))
        rows.append(relevances(map_, views.at(frame), live))
    by_all = rng.normal(size=(test.n_frames, N))
    shares = []
    scores = passive.drive_in_order(map_, views, test.position_m, by_all, truth, shares.append)
    return scores, np.array(rows), by_all, truth, shares


def drive_of(encodings, spacing_m):
    return Drive(position_m=spacing_m * np.arange(len(encodings)), encodings=encodings.astype(np.float32))


def slow_sums(rows, frame, n_views, speed):
    """[n] where each view's relevance is looked up where the robot was then; off the route it says nothing."""
    total = np.zeros(N)
    for back in range(n_views):
        centred = rows[frame - back] - rows[frame - back].mean()
        for image in range(N):
            then_m = image - speed * 1.5 * back
            if then_m >= 0:
                low = int(then_m)
                high = min(low + 1, N - 1)
                total[image] += centred[low] + (then_m - low) * (centred[high] - centred[low])
    return total


def slow_anr(sums, truth):
    ranks = [
        (row > row[true].max()).sum() + 0.5 * ((row == row[true].max()).sum() - 1)
        for row, true in zip(sums, truth, strict=True)
    ]
    return 100 * np.mean(ranks) / N


@pytest.mark.parametrize("n_views", passive.WINDOWS)
def test_sums_are_of_the_last_views_along_the_odometry(passive_drive, n_views):
    scores, rows, by_all, truth, _ = passive_drive
    frames = range(n_views - 1, len(rows))
    true = truth[n_views - 1 :]
    for name, of, speeds in (
        (passive.SUM, rows, (1.0,)),
        (passive.SUM_BRUTE_FORCE_U, by_all, (1.0,)),
        (passive.SUM_ANY_SPEED, rows, (0.8, 0.9, 1.0, 1.1, 1.2)),
    ):
        sums = [np.max([slow_sums(of, frame, n_views, speed) for speed in speeds], axis=0) for frame in frames]
        assert scores.by_window[name][n_views].anr == pytest.approx(slow_anr(sums, true), abs=0.05), name
        assert scores.by_window[name][n_views].n_queries == len(frames)


def test_a_belief_of_one_view_ranks_as_its_relevance_does_and_more_views_help(passive_drive):
    scores, *_, shares = passive_drive
    of_filter, of_sum = scores.by_window[passive.FILTER], scores.by_window[passive.SUM]
    assert of_filter[1].normalised_ranks.tolist() == of_sum[1].normalised_ranks.tolist()
    assert of_filter[10].anr < 0.5 * of_filter[1].anr
    assert scores.whole_drive.anr < 0.5 * of_filter[1].anr
    assert scores.whole_drive.n_queries == of_filter[1].n_queries
    assert shares[-1] == 1.0


def test_of_a_long_drive_some_windows_are_compared(monkeypatch, evaluator):
    rng = np.random.default_rng(2)
    monkeypatch.setattr(passive, "_MOST_WINDOWS", 5)
    map_ = compose_map(
        MapPlan(Relevance.COMPOSED, 4, (1.0,)), drive := drive_of(rng.normal(size=(N, 12)), 1.0), None, None, 20
    ).map
    views = views_of(measure_drive(drive, map_.landmark_model, evaluator))
    truth = [np.array([frame]) for frame in range(N)]
    scores = passive.drive_in_order(map_, views, drive.position_m, np.zeros((N, N)), truth, lambda _: None)
    assert [scores.by_window[passive.FILTER][n].n_queries for n in passive.WINDOWS] == [5, 4, 4, 4, 3]
    assert scores.whole_drive.n_queries == N
