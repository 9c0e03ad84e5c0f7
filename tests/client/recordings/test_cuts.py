import dataclasses
import math

import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import Frame, LeftOut, Recording
from deepsimbad_client.recordings.sources import check_one_drive, one_turn, thinned


def loop(n, noise_m=0.0):
    """A recording of a circle of 100 m, a frame every metre."""
    radius = 100 / (2 * math.pi)
    noise = np.random.default_rng(0).normal(0, noise_m, (n, 2))
    return Recording(
        "loop",
        tuple(
            Frame(k, str(k), float(k), k, radius * math.cos(k / radius) + dx, radius * math.sin(k / radius) + dy)
            for k, (dx, dy) in enumerate(noise)
        ),
    )


@pytest.mark.parametrize(("n", "n_kept"), [(95, 95), (101, 101), (125, 101), (330, 101)])
def test_a_closed_route_is_driven_once(n, n_kept):
    turn = one_turn(loop(n))
    assert len(turn.frames) == n_kept
    assert bool(turn.remarks) == (n_kept < n)
    assert abs(len(one_turn(loop(n, noise_m=0.2)).frames) - n_kept) <= 2
    assert turn.left_out == {}
    assert turn.n_whole == n


def test_a_way_back_through_the_start_is_no_turn():
    frames = [Frame(k, str(k), float(k), None, float(x), 0.0) for k, x in enumerate([*range(40), *range(40, -40, -1)])]
    assert len(one_turn(Recording("r", frames)).frames) == 120
    unknown = [dataclasses.replace(frame, x_m=None) for frame in loop(130).frames]
    assert len(one_turn(Recording("r", unknown)).frames) == 130


def paused(hours, apart_m):
    pause_us = int(hours * 3600e6)
    return Recording(
        "r",
        [
            Frame(k, f"{k}.png", float(k), 200_000 * k + pause_us * (k >= 40), k + apart_m * (k >= 40), 0.0)
            for k in range(60)
        ],
    )


def test_several_drives_in_one_recording_are_refused_and_a_rest_is_not():
    with pytest.raises(SourceError, match=r"between 39\.png and 40\.png pass 24\.0 hours.*#:40 or #40:"):
        check_one_drive(paused(24, 300))
    for hours, apart_m in ((0.5, 300), (24, 3)):
        check_one_drive(paused(hours, apart_m))
    check_one_drive(paused(24, 300).sliced(slice(40, None)))


def test_what_is_left_out_is_measured_against_all_frames_not_those_taken():
    recording = dataclasses.replace(loop(95), left_out_names={"lost": list("abc")})
    sparse = thinned(recording, None, 10)
    assert len(sparse.frames) == 10
    assert LeftOut(sparse, allow_missing=False).names == {"lost": list("abc")}


def test_names_of_two_kinds_placed_by_their_order_are_two_drives():
    names = [f"{drive}_{k}.png" for drive in ("summer", "winter") for k in range(30)]
    two_drives = Recording("r", [Frame(k, name, 0.5 * k) for k, name in enumerate(names)])
    with pytest.raises(SourceError, match=r"summer_29\.png and winter_0\.png.*#:30 or #30:"):
        check_one_drive(two_drives)
    check_one_drive(two_drives.sliced(slice(30, None)))
    with pytest.raises(SourceError, match=r"0_left\.png and 0_right\.png are names of several kinds by turns"):
        check_one_drive(
            Recording("r", [Frame(k, f"{k // 2}_{('left', 'right')[k % 2]}.png", 0.5 * k) for k in range(60)])
        )
    timed = [Frame(k, f"{1e9 + k / 2}_{'lr'[k % 2]}.png", 0.5 * k, (10**9 + k) * 10**6) for k in range(60)]
    with pytest.raises(SourceError, match=r"0_l\.png and 1000000000\.5_r\.png are names of several kinds by turns"):
        check_one_drive(Recording("r", timed))
    check_one_drive(Recording("r", [Frame(k, f"part{k // 30}_{k % 30}.png", 0.5 * k) for k in range(60)]))
    frames = [Frame(k, name, k + 0.1 * (k % 3)) for k, name in enumerate(names)]
    check_one_drive(Recording("r", frames))


@pytest.mark.parametrize(
    ("first", "second", "says"),
    [
        ("2012-01-22_{:03}.png", "2012-08-04_{:03}.png", "count anew"),
        ("run 1, {}.png", "run 2, {}.png", "count anew"),
        ("cam0_{:03}.png", "cam1_{:03}.png", "count anew"),
        ("IMG_20120122_0830{:02}.jpg", "IMG_20120804_0830{:02}.jpg", "pass 4680.0 hours"),
        ("2012-01-22T08-30-{:02}Z.png", "2012-01-22T12-30-{:02}Z.png", "pass 4.0 hours"),
        ("08-30-{:02}.png", "08-31-{:02}.png", None),  # a clock
        ("2012-01-22 08.30.{:02}.png", "2012-01-22 08.31.{:02}.png", None),
        ("0_{:03}.png", "1_{:03}.png", None),  # 39 frames of parts of 1000
        ("12.{:02}.png", "13.{:02}.png", None),  # a number's digits
        ("20120122_2359{:02}.png", "20120123_0000{:02}.png", None),
        ("chunk_1_{}.png", "chunk_2_{}.png", None),
    ],
)
def test_names_that_count_anew_or_are_of_several_days_are_two_drives(first, second, says):
    n = 40 if says else 10
    numbers = [*range(959, 999), 999] if first.startswith("0_") else range(n)
    names = [form.format(number) for form in (first, second) for number in numbers]
    two_drives = Recording("r", [Frame(k, name, 0.5 * k) for k, name in enumerate(names)])
    if says is None:
        check_one_drive(two_drives)
        return
    with pytest.raises(SourceError, match=rf"r: .*{says}.*#:40 or #40:"):
        check_one_drive(two_drives)
