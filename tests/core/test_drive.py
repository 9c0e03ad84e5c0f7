"""Whether two drives saw one route: on drives with slow drifts, trends, stops, gaps and errors in their positions."""

import numpy as np
import pytest

from deepsimbad.core.drive import (
    LEAST_CORRELATION,
    LEAST_PLACES,
    LIKE_ONE_DAY,
    ONE_RECORDING,
    SIGNIFICANCE,
    Drive,
    judge,
)
from deepsimbad.core.route import Route, same_places

R = 40


def scenery(rng, n, slowness_m=8.0, dims=12):
    """[n, dims] views along a route, one a metre: a random drift that forgets itself over `slowness_m`."""
    memory = np.exp(-1 / slowness_m)
    rows = np.empty((n, dims))
    rows[0] = rng.normal(size=dims)
    for row in range(1, n):
        rows[row] = memory * rows[row - 1] + np.sqrt(1 - memory**2) * rng.normal(size=dims)
    return rows


def dissimilarities(rng, *drives, noise=0.5):
    """Dissimilarities [n, r] of every drive, with noise of its own, to landmarks of the last one."""
    noisy_drives = [drive + noise * rng.normal(size=drive.shape) for drive in drives]
    landmarks = noisy_drives[-1][rng.permutation(len(noisy_drives[-1]))[:R]]
    return [((views[:, np.newaxis] - landmarks) ** 2).sum(axis=2).astype(np.float32) for views in noisy_drives]


def diagonal(n):
    return np.stack([np.arange(n), np.arange(n)], axis=1)


def verdict(rng, first, second, places=None, position_m=None, noise=0.5):
    first_dissimilarities, second_dissimilarities = dissimilarities(rng, first, second, noise=noise)
    n = min(len(first), len(second))
    position_m = np.arange(len(first), dtype=float) if position_m is None else position_m
    return judge(first_dissimilarities, second_dissimilarities, diagonal(n) if places is None else places, position_m)


@pytest.mark.parametrize("n", [60, 150])
@pytest.mark.parametrize("slowness_m", [1.0, 8.0, 20.0])
def test_drives_of_one_route_are_told_from_those_of_two(n, slowness_m):
    rng = np.random.default_rng(n)
    unrelated = [verdict(rng, *(scenery(rng, n, slowness_m) for _ in range(2))).accepted for _ in range(30)]
    related = [verdict(rng, place, place).accepted for place in (scenery(rng, n, slowness_m) for _ in range(15))]
    assert sum(unrelated) <= 1
    assert sum(related) >= 14


def test_the_significance_is_what_it_says():
    """About a tenth of unrelated drives reach a significance of 0.1."""
    rng = np.random.default_rng(5)
    significances = [verdict(rng, scenery(rng, 80), scenery(rng, 80)).significance for _ in range(300)]
    assert 0.05 < np.mean(np.array(significances) <= 0.1) < 0.17


def test_a_verdict_tells_its_reasons():
    rng = np.random.default_rng(1)
    place = scenery(rng, 120)
    accepted, refused = verdict(rng, place, place), verdict(rng, place, scenery(rng, 120))
    assert (accepted.accepted, accepted.why, accepted.n_pairs) == (True, None, 120)
    assert accepted.significance <= SIGNIFICANCE < refused.significance
    assert accepted.statistic > 3 > refused.statistic
    assert accepted.correlation > 0.5 > 0.2 > refused.correlation
    assert (refused.accepted, refused.n_pairs) == (False, 120)
    assert "agree no better than where one is shifted" in refused.why
    assert set(refused.as_dict()) == {"accepted", "why", "n_pairs", "correlation", "statistic", "significance"}


def trends(rng):
    """The light goes, in both drives, and changes as much as the scenery does."""
    trend = np.linspace(-1.5, 1.5, 120)[:, np.newaxis] * rng.normal(size=12)
    return scenery(rng, 120) + trend, scenery(rng, 120) + trend


def tunnels(rng):
    """A few places at the same position of two routes are unlike all others, and do not decide."""
    pair = scenery(rng, 120, 2.0), scenery(rng, 120, 2.0)
    for rows in pair:
        rows[50:55] = 20.0
    return pair


def backwards(rng):
    place = scenery(rng, 120)
    return place, place[::-1]


def begun_elsewhere(rng):
    place = scenery(rng, 160)
    return place[:120], place[40:]


@pytest.mark.parametrize("pair", [trends, tunnels, backwards, begun_elsewhere])
def test_what_only_looks_like_one_route_is_refused(pair):
    rng = np.random.default_rng(2)
    assert sum(verdict(rng, *pair(rng)).accepted for _ in range(40)) <= 1


def test_a_metre_of_error_in_positions_is_borne():
    rng = np.random.default_rng(7)
    for _ in range(10):
        place = scenery(rng, 150)
        position_m = np.maximum.accumulate(np.arange(150) + rng.normal(0, 1, 150))
        pairs = same_places(Route(position_m), Route(np.arange(150.0)))
        assert verdict(rng, place, place, pairs).accepted


def test_a_part_of_the_route_is_enough():
    rng = np.random.default_rng(8)
    place = scenery(rng, 200)
    pairs = np.stack([np.arange(110, 170), np.arange(60)], axis=1)
    assert verdict(rng, place, place[110:170], pairs).accepted
    with_gap = np.concatenate([diagonal(200)[:30], diagonal(200)[120:160]])
    assert verdict(rng, place, place, with_gap).accepted


def test_laps_of_one_loop_are_one_route():
    rng = np.random.default_rng(9)
    lap = scenery(rng, 80)
    assert verdict(rng, np.tile(lap, (3, 1)), np.tile(lap, (3, 1))).accepted


def test_frames_of_one_stop_are_one_place():
    """Two drives that stood at one place and then drove apart agree in a hundred frames of one place."""
    rng = np.random.default_rng(10)
    stop = rng.normal(size=12)
    stands = np.r_[np.zeros(100), np.arange(1, 61)]

    def with_stop():
        return np.concatenate([np.tile(stop, (100, 1)), scenery(rng, 60)])

    assert sum(verdict(rng, with_stop(), with_stop(), position_m=stands).accepted for _ in range(20)) <= 1
    of_one_stop = verdict(rng, rng.normal(size=(124, 12)), rng.normal(size=(124, 12)), position_m=np.zeros(124))
    assert (of_one_stop.accepted, of_one_stop.statistic, of_one_stop.significance) == (False, None, None)
    assert f"share 1 places by their positions, and {LEAST_PLACES} are the least" in of_one_stop.why


@pytest.mark.parametrize(("n", "accepted"), [(0, False), (29, False), (30, True)])
def test_thirty_places_are_the_least(n, accepted):
    rng = np.random.default_rng(11)
    place = rng.normal(size=(90, 12))
    judgement = verdict(rng, place, place, diagonal(n), noise=0.1)
    assert (judgement.accepted, judgement.n_pairs) == (accepted, n)


def test_recordings_of_one_day_are_no_two_seasons():
    rng = np.random.default_rng(19)
    place = rng.normal(size=(120, 12))
    copy, alike, other = (verdict(rng, place, place, noise=noise) for noise in (0.01, 0.1, 0.5))
    assert copy.correlation > ONE_RECORDING > alike.correlation > LIKE_ONE_DAY > other.correlation
    assert (copy.accepted, "copies of one recording" in copy.why) == (False, True)
    assert (alike.accepted, other.accepted) == (True, True)
    assert "look nearly the same (mean correlation 0.9" in alike.remarks()[0]
    assert copy.remarks() == other.remarks() == ()


def test_what_agrees_a_little_is_not_worth_learning_from():
    """Scenery that repeats agrees beyond chance on a long route; its landmarks would be trusted for nothing."""
    rng = np.random.default_rng(18)
    judgement = verdict(rng, *[rng.normal(size=(500, 12))] * 2, noise=2.5)
    assert (judgement.accepted, judgement.significance < SIGNIFICANCE) == (False, True)
    assert 0 < judgement.correlation < LEAST_CORRELATION
    assert "agree too little to learn from" in judgement.why


@pytest.mark.filterwarnings("error")
def test_what_never_changes_tells_nothing():
    constant = np.tile(np.arange(R, dtype=np.float32), (100, 1))
    varying = np.random.default_rng(12).normal(size=(100, R)).astype(np.float32)
    for map_rows, drive_rows in ((constant, constant), (constant, varying), (varying, constant)):
        judgement = judge(map_rows, drive_rows, diagonal(100), np.arange(100.0))
        assert (judgement.accepted, judgement.statistic, judgement.significance) == (False, 0.0, 0.5)
    of_one_landmark = judge(varying[:, :1], varying[:, :1], diagonal(100), np.arange(100.0))
    assert (of_one_landmark.accepted, of_one_landmark.statistic) == (False, 0.0), "one landmark is always the nearest"


def test_columns_that_never_change_do_no_harm():
    rng = np.random.default_rng(13)
    place = scenery(rng, 100)
    map_rows, drive_rows = dissimilarities(rng, place, place)
    map_rows[:, :5], drive_rows[:, 3:9] = 1e3, -1.0
    judgement = judge(map_rows, drive_rows, diagonal(100), np.arange(100.0))
    assert judgement.accepted
    assert np.isfinite([judgement.statistic, judgement.significance]).all()


def test_a_dense_recording_is_cut_into_places():
    """Half a metre a frame and ten frames a metre: not every frame is a trial of its own."""
    rng = np.random.default_rng(14)
    position_m = np.arange(600) / 10
    accepted = [
        verdict(rng, scenery(rng, 600, 60.0), scenery(rng, 600, 60.0), position_m=position_m).accepted
        for _ in range(20)
    ]
    assert sum(accepted) <= 1
    place = scenery(rng, 600, 60.0)
    assert verdict(rng, place, place, position_m=position_m).accepted


def test_a_long_route_is_judged_always_alike():
    rng = np.random.default_rng(15)
    map_rows = rng.random((6_000, 100), np.float32)
    drive_rows = (map_rows + 0.1 * rng.random(map_rows.shape, np.float32)).astype(np.float32)
    judgement = judge(map_rows, drive_rows, diagonal(6_000), np.arange(6_000.0))
    assert judgement.accepted
    assert judgement == judge(map_rows, drive_rows, diagonal(6_000), np.arange(6_000.0))


def test_pictures_of_nothing_and_of_a_camera_that_hung_are_told_by_name() -> None:
    names = np.array([f"{i}.png" for i in range(12)])
    encodings = np.random.default_rng(0).normal(size=(12, 5)).astype(np.float32)
    encodings[4:9] = encodings[3]  # it hung for five pictures, and stood for the last of them
    encodings[10:] = encodings[10]  # the lens was covered
    position_m = np.array([0.0, 1, 2, 3, 4, 5, 6, 7, 7, 8, 9, 10])
    shows_nothing = np.arange(12) >= 10
    drive = Drive(position_m=position_m, encodings=encodings, frame_name=names, shows_nothing=shows_nothing)
    assert drive.picture_warnings("of the map") == [
        "2 of 12 pictures of the map show nothing: one grey, noise or the dark (10.png, 11.png)",
        "4 of 12 pictures of the map are the very same as the one before, and the robot had moved on: "
        "did the camera hang? (4.png, 5.png, 6.png, ...)",
    ]
    assert drive.at(np.arange(4)).picture_warnings("of the map") == []


def test_frames_unlike_all_others_are_told_by_name() -> None:
    """Black with a clock in it is no picture of one grey, but its encoding is far from what is usual on the route."""
    rng = np.random.default_rng(0)
    encodings = rng.normal(size=(100, 400)).astype(np.float32)
    encodings[40:43] = rng.normal(0, 4, 400) + rng.normal(0, 0.1, (3, 400))
    names = np.array([f"{i}.png" for i in range(100)])
    drive = Drive(position_m=np.arange(100.0), encodings=encodings, frame_name=names)
    assert drive.picture_warnings("of the map") == [
        "3 of 100 pictures of the map are so unlike all others that they may show nothing of the route: glare, or the "
        "dark (40.png, 41.png, 42.png)"
    ]
    assert drive.at(np.arange(40)).picture_warnings("of the map") == []


def test_two_drives_of_other_extractors_are_told() -> None:
    """Encodings have a mean of their extractor's: their numbers in another order stand for those of another one."""
    rng = np.random.default_rng(0)
    mean, order = rng.normal(size=64), rng.permutation(64)
    summer, winter = ((mean + rng.normal(size=(80, 64))).astype(np.float32) for _ in range(2))

    def warnings(encodings: np.ndarray) -> list[str]:
        drives = (
            Drive(name=name, position_m=np.arange(80.0), encodings=e) for name, e in (("a", summer), ("b", encodings))
        )
        return next(drives).encoding_warnings(next(drives))

    (warning,) = warnings(winter[:, order])
    assert "the encodings of traverses a and b have little in common" in warning
    assert warnings(winter) == []
    assert warnings(rng.normal(size=(80, 64)).astype(np.float32)) == [], "without a mean nothing can be told"
