"""The NCLT reader on NCLT's own frames and tracks."""

import gzip

import cv2
import numpy as np
import pytest

from deepsimbad_client.recording import nearest_frame, positions_m
from deepsimbad_client.sources import open_source

pytestmark = pytest.mark.real_data


def decoded(encoded):
    return cv2.imdecode(np.frombuffer(encoded.body, np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture
def front(real_data, nclt_tree):
    """The real front camera's frame at its true size in a tree of one second."""
    sample = cv2.imread(str(real_data / "nclt" / "frames" / "cam5_sample.jpg"), cv2.IMREAD_COLOR)
    assert sample.shape == (616, 808, 3), "half the resolution, as stored"
    stored = cv2.resize(sample, (1616, 1232), interpolation=cv2.INTER_CUBIC)
    nclt_tree.image_file(nclt_tree.start_us + 500_000, nclt_tree.tiff(stored))
    nclt_tree.truth(nclt_tree.walk_north(1))
    return open_source(nclt_tree.source)


def test_the_front_camera_is_upright_sky_up_ground_down(front):
    image = decoded(front.image(front.frames[0], None)).astype(float)
    assert image.shape == (1616, 1232, 3)
    top, bottom = image[: 1616 // 3], image[-1616 // 3 :]
    assert top.mean() > 1.2 * bottom.mean(), "the sky is brighter than the ground"
    # One turned the wrong way, or mirrored, is told by the sun: it stands high and right of the middle.
    sun_row, sun_column = np.unravel_index(cv2.blur(image.mean(axis=2), (101, 101)).argmax(), image.shape[:2])
    assert sun_row < 1616 / 3
    assert sun_column > 1232 / 2


def test_what_travels_is_small(front):
    sent = front.image(front.frames[0], (320, 240))
    assert decoded(sent).shape == (240, 320, 3)
    assert len(sent.body) < 40_000


@pytest.mark.parametrize(("date", "length_km"), [("2012-01-08", 6.5), ("2012-08-04", 5.5)])
def test_a_real_drive(real_data, nclt_tree, date, length_km):
    with gzip.open(real_data / "nclt" / "trajectories" / f"{date}.tum.txt.gz", "rt") as text:
        track = np.loadtxt(text)
    time_us = np.round(track[:, 0] * 1e6).astype(np.int64)
    x, y = track[:, 1], track[:, 2]
    # The files change from quaternions to roll, pitch, yaw in the middle; their w is 0 from there on.
    yaw = np.where(track[:, 7] == 0, track[:, 6], 2 * np.arctan2(track[:, 6], track[:, 7]))
    # As published: 100 rows a second, unfinished ones among them, and the pose trembling by a centimetre.
    dense_us = np.arange(time_us[0], time_us[-1], 10_000)
    rng = np.random.default_rng(0)
    dense_x, dense_y = (np.interp(dense_us, time_us, axis) + rng.normal(0, 0.01, len(dense_us)) for axis in (x, y))
    dense_yaw = np.interp(dense_us, time_us, np.unwrap(yaw))
    broken = rng.random(len(dense_us)) < 0.01
    rows = [
        f"{t},NaN,NaN,NaN,NaN,NaN,NaN" if nan else nclt_tree.row(t, *pose)
        for t, nan, *pose in zip(dense_us.tolist(), broken, dense_x, dense_y, dense_yaw, strict=True)
    ]
    nclt_tree.truth(rows)
    asked_us = np.arange(time_us[0] - 2_000_000, time_us[-1] + 2_000_000, 200_000)
    for utime in asked_us.tolist():
        nclt_tree.image_file(utime, b"")
    recording = open_source(nclt_tree.source)

    assert len(recording.frames) + recording.left_out["before or after the ground truth"] == len(asked_us)
    assert 19 <= recording.left_out["before or after the ground truth"] <= 21
    position = positions_m(recording)
    assert np.all(np.diff(position) >= 0)
    assert position[-1] == pytest.approx(1000 * length_km, rel=0.01)
    steps = np.hypot(np.diff(dense_x), np.diff(dense_y)).sum()
    assert steps > 1.5 * position[-1], "summed as they are the poses go half as far again"

    frames_us = np.array([frame.timestamp_us for frame in recording.frames])
    frame_x, frame_y = (np.array([getattr(frame, axis) for frame in recording.frames]) for axis in ("x_m", "y_m"))
    assert np.abs(frame_x - np.interp(frames_us, time_us, x)).max() < 0.06
    assert np.abs(frame_y - np.interp(frames_us, time_us, y)).max() < 0.06
    # Where the robot moves, it looks where it goes.
    moving = np.flatnonzero(np.diff(position, prepend=0) > 0.15)
    course = np.arctan2(np.gradient(frame_y), np.gradient(frame_x))
    heading = np.array([frame.heading_rad for frame in recording.frames])
    assert np.mean(np.cos(heading - course)[moving] > 0) > 0.97
    # A robot sent on by three metres finds a frame within a step of there.
    for at in range(0, len(position) - 1000, 997):
        there = nearest_frame(position, position[at] + 3)
        assert position[there] == pytest.approx(position[at] + 3, abs=0.25)
