import gzip
import shutil

import cv2
import numpy as np
import pytest

from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings.nclt import read_nclt
from deepsimbad_client.recordings.sources import open_source

from .conftest import pixels_of


def fill(tree, seconds=4, rate_hz=5, **kwargs):
    utimes = [tree.start_us + 1_000_000 * i // rate_hz + 37 for i in range(seconds * rate_hz)]
    for utime in utimes:
        tree.image_file(utime, **kwargs)
    tree.truth(tree.walk_north(seconds))
    return utimes


@pytest.mark.parametrize(
    ("above", "truth_place"),
    [
        ("", "ground_truth/groundtruth_2012-01-22.csv"),
        ("images", "2012-01-22/groundtruth_2012-01-22.csv"),
        ("", "2012-01-22/groundtruth.csv"),
        ("images", "ground_truth/2012-01-22.csv"),
    ],
)
def test_every_layout_is_found(nclt_tree, above, truth_place):
    nclt_tree.image_file(nclt_tree.start_us + 500_000, above=above)
    nclt_tree.truth(nclt_tree.walk_north(1), truth_place)
    recording = open_source(nclt_tree.source)
    assert recording.name == "2012-01-22"
    assert [frame.name for frame in recording.frames] == [f"{nclt_tree.start_us + 500_000}.tiff"]
    assert (recording.left_out, recording.encodings) == ({}, None)


def test_frames_lie_where_the_ground_truth_was_when_they_were_taken(nclt_tree):
    utimes = fill(nclt_tree)
    frames = open_source(nclt_tree.source).frames
    assert [frame.index for frame in frames] == list(range(20))
    assert [frame.timestamp_us for frame in frames] == utimes
    for frame, utime in zip(frames, utimes, strict=True):
        since_start = (utime - nclt_tree.start_us) / 1e6
        assert frame.x_m == pytest.approx(since_start, abs=1e-6)
        assert frame.position_m == pytest.approx(since_start, abs=1e-6)
        assert (frame.y_m, frame.heading_rad) == pytest.approx((3.0, 0.0), abs=1e-9)


def test_frames_are_upright_and_resized_without_loss(nclt_tree):
    fill(nclt_tree, seconds=1)
    recording = open_source(nclt_tree.source)
    for input_size, shape in ((None, (64, 48)), ((48, 64), (64, 48)), ((200, 200), (64, 48)), ((20, 20), (20, 20))):
        encoded = recording.image(recording.frames[0], input_size)
        image, (height, width) = pixels_of(encoded), shape
        assert (encoded.content_type, image.shape) == ("image/png", (height, width, 3))
        top, lower = image[height // 4], image[3 * height // 4]
        assert top[:, 0].min() > 200, "blue above"
        assert lower[: width // 3, 1].min() > 200, "green at the lower left"
        assert lower[-(width // 3) :, 2].min() > 200, "red at the lower right"


def test_what_has_no_ground_truth_or_no_file_is_left_out_and_counted(nclt_tree):
    utimes = fill(nclt_tree)
    rows = nclt_tree.walk_north(4)
    for utime in [*utimes[:10], nclt_tree.start_us + 1, nclt_tree.start_us + 2]:
        nclt_tree.image_file(utime, b"", camera=1)
    (nclt_tree.root / "2012-01-22/lb3/Cam5/thumb.tiff").write_bytes(b"")
    (nclt_tree.root / "2012-01-22/lb3/Cam5/README.txt").write_bytes(b"")
    # 1.00..1.49 s and 3.00..3.49 s: 1.51 s between
    nclt_tree.truth([*rows[100:150], "1,2", *rows[300:350]])
    recording = open_source(nclt_tree.source)
    assert "1 rows of the ground truth are not used" in recording.remarks[0]
    seconds = [round((frame.timestamp_us - nclt_tree.start_us) / 1e6, 1) for frame in recording.frames]
    assert seconds == [1.0, 1.2, 1.4, 3.0, 3.2, 3.4]
    assert recording.left_out == {
        "before or after the ground truth": 5 + 2,
        "gap in the ground truth": 7,
        "missing in Cam5": 2,
        "file name is not a time": 1,
    }


def test_a_broken_frame_is_named_when_it_is_read_and_the_others_go_on(nclt_tree):
    utimes = fill(nclt_tree)
    body = nclt_tree.tiff(nclt_tree.picture())
    nclt_tree.image_file(utimes[3], body[: len(body) // 2])
    nclt_tree.image_file(utimes[4], b"not an image at all")
    nclt_tree.image_file(utimes[6], b"")
    nclt_tree.image_file(utimes[7], cv2.imencode(".tiff", np.zeros((48, 64), np.uint16))[1].tobytes())
    recording = open_source(nclt_tree.source)
    (nclt_tree.root / f"2012-01-22/lb3/Cam5/{utimes[8]}.tiff").unlink()
    assert len(recording.frames) == 20
    reasons = {}
    for frame in recording.frames:
        try:
            recording.image(frame, (32, 32))
        except BrokenFrameError as error:
            reasons[frame.index] = error.reason if frame.name in str(error) else "not named"
    expected = {3: "undecodable", 4: "undecodable", 6: "empty file", 8: "unreadable file"}
    assert reasons == expected


def test_any_camera(nclt_tree):
    fill(nclt_tree, seconds=1, camera=2)
    assert len(open_source(str(nclt_tree.root / "2012-01-22/lb3/Cam2")).frames) == 5
    with pytest.raises(SourceError, match=r"lb3/Cam5, .*images/2012-01-22/lb3/Cam5"):
        open_source(nclt_tree.source)


def test_errors_say_what_is_missing(nclt_tree):
    nclt_tree.image_file(5)
    with pytest.raises(SourceError, match=r"no ground truth .*groundtruth_2012-01-22\.csv.*groundtruth\.csv"):
        open_source(nclt_tree.source)
    nclt_tree.truth(nclt_tree.walk_north(1))
    with pytest.raises(SourceError, match=r"none of 1 images has a position: .* the ground truth of 2012-01-08T13:56"):
        open_source(nclt_tree.source)
    (nclt_tree.root / "2012-01-22/lb3/Cam5/5.tiff").unlink()
    with pytest.raises(SourceError, match=r"no image named <utime>\.tiff"):
        open_source(nclt_tree.source)
    with pytest.raises(SourceError, match="nclt:ROOT/DATE"):
        open_source("nclt:")


def test_a_standing_robot_stays_where_it_is(nclt_tree):
    rng = np.random.default_rng(0)
    x = np.concatenate((np.arange(0, 5, 0.01), np.full(3000, 5.0), np.arange(5, 10, 0.01)))
    x, y = x + rng.normal(0, 0.02, len(x)), rng.normal(0, 0.02, len(x))
    nclt_tree.truth(nclt_tree.row(nclt_tree.start_us + 10_000 * i, x[i], y[i]) for i in range(len(x)))
    for i in range(199):
        nclt_tree.image_file(nclt_tree.start_us + 200_000 * i)
    position = np.array([frame.position_m for frame in open_source(nclt_tree.source).frames])
    assert position[25 + 145] - position[30] < 0.05, "30 s of standing"
    assert position[-1] == pytest.approx(10, abs=0.6)
    assert np.all(np.diff(position) >= 0)


def test_undistortion_happens_as_stored_before_the_turn_by_a_table_of_the_size(nclt_tree, tmp_path):
    fill(nclt_tree, seconds=1)
    table = tmp_path / "U2D_Cam5_64X48.txt"
    # Every undistorted pixel looks 8 columns to the right in the stored image.
    lines = [f"{row} {column} {row:.4f} {column + 8:.4f}" for row in range(48) for column in range(64)]
    table.write_text("\n".join(["Size: 64,48", *lines]))
    recording = read_nclt(nclt_tree.root, nclt_tree.date, undistortion=tmp_path)
    upright = recording.upright(recording.frames[0])
    assert upright.shape == (64, 48, 3)
    # Stored columns run down the upright image, so it has moved up by 8 and its end is what was not seen.
    assert upright[-8:].max() == 0
    assert upright[20, 24, 0] > 200
    assert upright[26, 5, 1] > 200
    table.write_text("2,2\n0 0 0 0\n0 1 0 1\n1 0 1 0\n1 1 1 1\n")
    recording = read_nclt(nclt_tree.root, nclt_tree.date, undistortion=table)
    with pytest.raises(SourceError, match="2 x 2"):
        recording.image(recording.frames[0], None)


@pytest.mark.real_data
def test_the_front_camera_is_upright_sky_up_ground_down(real_data, nclt_tree):
    sample = cv2.imread(str(real_data / "nclt" / "frames" / "cam5_sample.jpg"), cv2.IMREAD_COLOR)
    assert sample.shape == (616, 808, 3), "half the resolution, as stored"
    stored = cv2.resize(sample, (1616, 1232), interpolation=cv2.INTER_CUBIC)
    nclt_tree.image_file(nclt_tree.start_us + 500_000, nclt_tree.tiff(stored))
    nclt_tree.truth(nclt_tree.walk_north(1))
    front = open_source(nclt_tree.source)
    image = pixels_of(front.image(front.frames[0], None)).astype(float)
    assert image.shape == (1616, 1232, 3)
    top, bottom = image[: 1616 // 3], image[-1616 // 3 :]
    assert top.mean() > 1.2 * bottom.mean(), "the sky is brighter than the ground"
    # One turned the wrong way, or mirrored, is told by the sun: it stands high and right of the middle.
    sun_row, sun_column = np.unravel_index(cv2.blur(image.mean(axis=2), (101, 101)).argmax(), image.shape[:2])
    assert sun_row < 1616 / 3
    assert sun_column > 1232 / 2


@pytest.mark.real_data
def test_a_real_drive(real_data, nclt_tree):
    with gzip.open(real_data / "nclt" / "trajectories" / "2012-08-04.tum.txt.gz", "rt") as text:
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
    asked_us = np.arange(time_us[0] - 10_000_000, time_us[-1] + 10_000_000, 1_000_000)
    for utime in asked_us.tolist():
        nclt_tree.image_file(utime, b"")
    recording = open_source(nclt_tree.source)

    assert len(recording.frames) + recording.left_out["before or after the ground truth"] == len(asked_us)
    assert 19 <= recording.left_out["before or after the ground truth"] <= 21
    position = np.array([frame.position_m for frame in recording.frames])
    assert np.all(np.diff(position) >= 0)
    assert position[-1] == pytest.approx(5500, rel=0.01)
    steps = np.hypot(np.diff(dense_x), np.diff(dense_y)).sum()
    assert steps > 1.5 * position[-1], "summed as they are the poses go half as far again"

    frames_us = np.array([frame.timestamp_us for frame in recording.frames])
    frame_x, frame_y = (np.array([getattr(frame, axis) for frame in recording.frames]) for axis in ("x_m", "y_m"))
    assert np.abs(frame_x - np.interp(frames_us, time_us, x)).max() < 0.06
    assert np.abs(frame_y - np.interp(frames_us, time_us, y)).max() < 0.06
    # Where the robot moves, it looks where it goes.
    moving = np.flatnonzero(np.diff(position, prepend=0) > 0.75)
    course = np.arctan2(np.gradient(frame_y), np.gradient(frame_x))
    heading = np.array([frame.heading_rad for frame in recording.frames])
    assert np.mean(np.cos(heading - course)[moving] > 0) > 0.97


@pytest.mark.parametrize("ending", ["jpg", "PNG", "tiff"])
def test_copies_in_another_format_are_read_unless_the_tiff_is_there(nclt_tree, ending):
    tiffs = [nclt_tree.root / f"2012-01-22/lb3/Cam5/{utime}.tiff" for utime in fill(nclt_tree, seconds=1)]
    for tiff in tiffs:
        cv2.imwrite(str(tiff.with_suffix(f".{ending}")), cv2.imread(str(tiff)))
    assert open_source(nclt_tree.source).frames[0].name == tiffs[0].name
    for tiff in tiffs if ending != "tiff" else ():
        tiff.unlink()
    recording = open_source(nclt_tree.source)
    assert {frame.name.partition(".")[2] for frame in recording.frames} == {ending}
    assert recording.upright(recording.frames[0]).shape == (64, 48, 3)


def test_undistorted_copies_that_stand_upright_already_are_not_turned(nclt_tree):
    folder = nclt_tree.root / "2012-01-22" / "lb3_undistorted" / "Cam5"
    folder.mkdir(parents=True)
    nclt_tree.truth(nclt_tree.walk_north(1))
    upright = cv2.rotate(nclt_tree.picture(), cv2.ROTATE_90_CLOCKWISE)
    cv2.imwrite(str(folder / f"{nclt_tree.start_us}.png"), upright)
    recording = open_source(nclt_tree.source)
    np.testing.assert_array_equal(recording.upright(recording.frames[0]), upright)


def bodies_of(recording):
    return [recording.image(frame, None).body for frame in recording.frames]


def test_a_cameras_folder_is_recognised_with_its_poses_and_without(nclt_tree):
    fill(nclt_tree, seconds=1)
    camera = nclt_tree.root / nclt_tree.date / "lb3" / "Cam5"
    recording, camera_recording = open_source(nclt_tree.source), open_source(str(camera))
    assert camera_recording.frames == recording.frames
    assert camera_recording.remarks == [f"NCLT's layout: read as {nclt_tree.source}, camera 5, upright"]
    assert open_source(str(camera), rotate=0).remarks[0].endswith("camera 5, turned by 0 degrees")
    with pytest.raises(SourceError, match="no undistortion table"):
        open_source(str(camera), undistortion=nclt_tree.root)
    nclt_tree.truth(["no", "numbers"])
    with pytest.raises(SourceError, match="fewer than 2 usable rows"):
        open_source(str(camera))
    shutil.rmtree(nclt_tree.root / "ground_truth")
    camera_recording = open_source(f"{camera}#:")
    assert "turned upright" in camera_recording.remarks[-1]
    assert bodies_of(camera_recording) == bodies_of(recording)
    assert camera_recording.frames[1].timestamp_us == recording.frames[1].timestamp_us


def test_nclts_images_anywhere_are_turned_upright_by_name_and_shape(nclt_tree, tmp_path):
    stored = cv2.resize(nclt_tree.picture(), (202, 154))
    upright = cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE)
    folder = tmp_path / "some"
    folder.mkdir()
    for place in range(3):
        cv2.imwrite(str(folder / f"{nclt_tree.start_us + 200_000 * place}.png"), stored)
    recording = open_source(str(folder))
    assert recording.remarks
    pixels = pixels_of(recording.image(recording.frames[1], None))
    assert pixels.shape == upright.shape
    assert np.abs(pixels.astype(int) - upright).mean() < 3
    assert open_source(str(folder), rotate=0).rotate == 0
    for place in range(3):
        (folder / f"{nclt_tree.start_us + 200_000 * place}.png").rename(folder / f"{place}.png")
    assert open_source(str(folder)).rotate == 0


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_camera_that_hangs_otherwise_is_turned_as_asked(tmp_path, nclt_tree, degrees):
    image = nclt_tree.picture()
    cv2.imwrite(str(tmp_path / "a.png"), np.rot90(image, degrees // 90))
    recording = open_source(str(tmp_path), rotate=degrees)
    pixels = pixels_of(recording.image(recording.frames[0], None))
    assert pixels.shape == image.shape
    assert np.abs(pixels.astype(int) - image).mean() < 3
