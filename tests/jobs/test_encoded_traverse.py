"""Recordings become encodings beside positions; what cannot be used is counted."""

import cv2
import numpy as np
import pytest

from deepsimbad.errors import ImageTooLargeError, InvalidRouteError, InvalidSourceError
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.encoded_traverse import encode_recording
from deepsimbad.store.frames import UNKNOWN_TIMESTAMP
from deepsimbad_client.recordings.recording import Frame, Recording
from deepsimbad_client.recordings.sources import open_source

MAX_PIXELS = 1_000_000


@pytest.fixture(scope="module")
def judge():
    return make_evaluator(evaluator_config({"kind": "feature_l2"}))


@pytest.fixture
def folder(tmp_path):
    """Six images, the third of them no image at all."""
    for place in range(6):
        coarse = np.random.default_rng(place).integers(0, 255, (6, 8, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{place}.png"), cv2.resize(coarse, (160, 90), interpolation=cv2.INTER_CUBIC))
    (tmp_path / "2.png").write_bytes(b"no image")
    return tmp_path


def ignore(_share):
    pass


def test_images_are_encoded_as_the_service_would_encode_what_is_posted(folder, judge):
    recording = open_source(str(folder), spacing_m=2.5)
    encoded = encode_recording(recording, judge, MAX_PIXELS, ignore)
    assert encoded.frames.index.tolist() == [0, 1, 3, 4, 5]
    assert encoded.frames.position_m.tolist() == [0.0, 2.5, 7.5, 10.0, 12.5]
    assert encoded.route.position_m.tolist() == [0.0, 2.5, 7.5, 10.0, 12.5]
    for row, place in enumerate([0, 1, 3, 4, 5]):
        posted = recording.image(recording.frames[place], judge.input_size).body
        assert np.array_equal(encoded.encodings[row], judge.encode([decode_image(posted, MAX_PIXELS)])[0])


def test_broken_frames_are_counted_by_reason(folder, judge):
    encoded = encode_recording(open_source(str(folder)), judge, MAX_PIXELS, ignore)
    assert sum(encoded.left_out.values()) == 1
    (reason,) = encoded.left_out
    assert reason


def test_the_readers_own_count_is_kept(folder, judge):
    (folder / "positions.csv").write_text("name,position_m\n0.png,0\n1.png,1\n2.png,2\n9.png,9\n")
    recording = open_source(str(folder))
    encoded = encode_recording(recording, judge, MAX_PIXELS, ignore)
    assert encoded.frames.index.tolist() == [0, 1]
    assert encoded.left_out["not in positions.csv"] == 3
    assert encoded.left_out["in positions.csv without an image"] == 1
    assert sum(encoded.left_out.values()) == 5


def test_every_frame_is_reported_broken_or_not(folder, judge):
    shares = []
    encode_recording(open_source(str(folder)), judge, MAX_PIXELS, shares.append)
    assert shares == [place / 6 for place in range(1, 7)]


def test_a_recording_of_broken_frames_alone_is_named(folder, judge):
    with pytest.raises(InvalidSourceError, match="no frame that can be used"):
        encode_recording(open_source(f"{folder}#2:3"), judge, MAX_PIXELS, ignore)


def test_an_image_over_the_limit_is_an_error_not_a_broken_frame(folder, judge):
    with pytest.raises(ImageTooLargeError):
        encode_recording(open_source(str(folder)), judge, 100, ignore)


def test_images_need_an_extractor(folder):
    ready = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "none"}))
    with pytest.raises(InvalidSourceError, match="ready encodings alone"):
        encode_recording(open_source(str(folder)), ready, MAX_PIXELS, ignore)


def test_ready_encodings_are_taken_as_they_are(tmp_path, judge):
    rows = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
    np.save(tmp_path / "drive.npy", rows)
    encoded = encode_recording(open_source(f"{tmp_path / 'drive.npy'}#2:9:3"), judge, MAX_PIXELS, ignore)
    assert np.array_equal(encoded.encodings, rows[2:9:3])
    assert encoded.frames.index.tolist() == [2, 5, 8]
    assert encoded.frames.position_m.tolist() == [2.0, 5.0, 8.0]
    assert (encoded.frames.timestamp_us == UNKNOWN_TIMESTAMP).all()
    assert np.isnan(encoded.frames.x_m).all()
    assert encoded.route.x_m is None


def placed(*positions_m):
    """A recording that knows the ground coordinates of some frames."""
    frames = tuple(
        Frame(i, str(i), at, timestamp_us=i, x_m=None if i == 1 else 1.0 * i, y_m=2.0)
        for i, at in enumerate(positions_m)
    )
    return Recording("placed", frames, encodings=np.eye(3, dtype=np.float32))


def test_ground_coordinates_and_times_are_kept(judge):
    encoded = encode_recording(placed(0, 1, 2), judge, MAX_PIXELS, ignore)
    assert encoded.frames.timestamp_us.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(encoded.route.x_m, [0.0, np.nan, 2.0])
    np.testing.assert_array_equal(encoded.route.y_m, [2.0, 2.0, 2.0])


def test_positions_that_go_backwards_are_named(judge):
    with pytest.raises(InvalidRouteError, match="frame 2"):
        encode_recording(placed(0, 2, 1), judge, MAX_PIXELS, ignore)
