"""Recordings become encodings beside positions, and what cannot be used is counted; ground truth files run nothing."""

import json
import os
import pickle

import cv2
import numpy as np
import pytest

from deepsimbad.core.frames import UNKNOWN_TIMESTAMP
from deepsimbad.errors import ImageTooLargeError, InvalidRouteError, InvalidSceneError, InvalidSourceError
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.build import encode_recording
from deepsimbad.jobs.experiments import cache as cache_module
from deepsimbad.jobs.experiments.cache import open_encoding_cache
from deepsimbad.jobs.experiments.truth import read_ground_truth
from deepsimbad_client.recordings import Frame, Recording
from deepsimbad_client.recordings.annotations import as_taken
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


def test_images_are_encoded_as_the_service_would_encode_what_is_posted(folder, judge):
    recording, shares = open_source(str(folder), spacing_m=2.5), []
    encoded = encode_recording(recording, judge, MAX_PIXELS, shares.append)
    assert shares == [place / 6 for place in range(1, 7)], "every frame is reported, broken or not"
    assert list(encoded.left_out.values()) == [1]
    assert encoded.drive.index.tolist() == [0, 1, 3, 4, 5]
    assert encoded.drive.position_m.tolist() == [0.0, 2.5, 7.5, 10.0, 12.5]
    assert encoded.drive.route().position_m.tolist() == [0.0, 2.5, 7.5, 10.0, 12.5]
    for row, place in enumerate([0, 1, 3, 4, 5]):
        posted = recording.image(recording.frames[place], judge.input_size).body
        assert np.array_equal(encoded.drive.encodings[row], judge.encode([decode_image(posted, MAX_PIXELS)])[0])


def test_the_readers_own_count_is_kept(folder, judge):
    (folder / "positions.csv").write_text("name,position_m\n0.png,0\n1.png,1\n2.png,2\n9.png,9\n")
    recording = open_source(str(folder))
    encoded = encode_recording(recording, judge, MAX_PIXELS, lambda _: None)
    assert encoded.drive.index.tolist() == [0, 1]
    assert encoded.left_out["not in positions.csv"] == 3
    assert encoded.left_out["in positions.csv without an image"] == 1
    assert sum(encoded.left_out.values()) == 5


def test_what_an_earlier_run_kept_says_which_images_show_nothing_too(folder, judge, tmp_path_factory):
    cv2.imwrite(str(folder / "4.png"), np.zeros((90, 160, 3), np.uint8))
    recording, out = open_source(str(folder)), tmp_path_factory.mktemp("out")
    with open_encoding_cache(out, "queries", source=str(folder)) as cache:
        first = encode_recording(recording, judge, MAX_PIXELS, lambda _: None, encoding_cache=cache)
    with open_encoding_cache(out, "queries", source=str(folder)) as cache:
        again = encode_recording(recording, judge, MAX_PIXELS, lambda _: None, encoding_cache=cache)
    assert again.encode_ms is None, "nothing was encoded"
    assert again.drive.shows_nothing.tolist() == [False, False, False, True, False]
    assert first.drive.shows_nothing.tolist() == again.drive.shows_nothing.tolist()


def test_a_run_that_is_killed_has_kept_what_it_encoded_now_and_then(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_module, "_LEAST_NEW", 3)
    on_disk = []
    with open_encoding_cache(tmp_path, "queries", source="drive") as cache:
        for frame in range(17):
            cache[str(frame)] = np.full(4, frame, np.float32), False
            with open_encoding_cache(tmp_path, "queries", source="drive") as second_cache:
                on_disk.append(len(second_cache))
    assert on_disk == [0, 0, *[3] * 3, *[6] * 3, *[9] * 3, *[12] * 3, *[15] * 3]
    monkeypatch.setattr(cache_module, "_NEW_SHARE", 1)
    with open_encoding_cache(tmp_path, "queries", source="drive") as cache:
        assert len(cache) == 17
        for frame in range(17, 34):
            cache[str(frame)] = np.full(4, frame, np.float32), False
            with open_encoding_cache(tmp_path, "queries", source="drive") as second_cache:
                assert len(second_cache) == (34 if frame == 33 else 17), "twice as many before they are written anew"


def test_a_recording_of_broken_frames_alone_is_named(folder, judge):
    with pytest.raises(InvalidSourceError, match="no frame that can be used"):
        encode_recording(open_source(f"{folder}#2:3"), judge, MAX_PIXELS, lambda _: None)


def test_an_image_over_the_limit_is_an_error_not_a_broken_frame(folder, judge):
    with pytest.raises(ImageTooLargeError):
        encode_recording(open_source(str(folder)), judge, 100, lambda _: None)


def test_images_need_an_extractor(folder):
    ready = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "none"}))
    with pytest.raises(InvalidSourceError, match="ready encodings alone"):
        encode_recording(open_source(str(folder)), ready, MAX_PIXELS, lambda _: None)


def test_ready_encodings_are_taken_as_they_are(tmp_path, judge):
    rows = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
    np.save(tmp_path / "drive.npy", rows)
    encoded = encode_recording(open_source(f"{tmp_path / 'drive.npy'}#2:9:3"), judge, MAX_PIXELS, lambda _: None)
    assert np.array_equal(encoded.drive.encodings, rows[2:9:3])
    assert encoded.drive.index.tolist() == [2, 5, 8]
    assert encoded.drive.position_m.tolist() == [2.0, 5.0, 8.0]
    assert (encoded.drive.timestamp_us == UNKNOWN_TIMESTAMP).all()
    assert np.isnan(encoded.drive.x_m).all()
    assert encoded.drive.route().x_m is None


def recording_at(*positions_m):
    """A recording that knows the ground coordinates of some frames."""
    frames = tuple(
        Frame(i, str(i), at, timestamp_us=i, x_m=None if i == 1 else 1.0 * i, y_m=2.0)
        for i, at in enumerate(positions_m)
    )
    return Recording("placed", frames, encodings=np.eye(3, dtype=np.float32))


def test_ground_coordinates_and_times_are_kept(judge):
    encoded = encode_recording(recording_at(0, 1, 2), judge, MAX_PIXELS, lambda _: None)
    assert encoded.drive.timestamp_us.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(encoded.drive.route().x_m, [0.0, np.nan, 2.0])
    np.testing.assert_array_equal(encoded.drive.route().y_m, [2.0, 2.0, 2.0])


def test_positions_that_go_backwards_are_named(judge):
    with pytest.raises(InvalidRouteError, match="frame 2"):
        encode_recording(recording_at(0, 2, 1), judge, MAX_PIXELS, lambda _: None)


# --- ground truth --------------------------------------------------------------------------------------------------


def objects(*rows):
    """Rows of an object array: lists, or (query, list), as VPR-Bench writes them."""
    array = np.empty((len(rows), 2) if isinstance(rows[0], tuple) else len(rows), object)
    for place, row in enumerate(rows):
        array[place] = row
    return array


@pytest.mark.parametrize(
    ("array", "test_index", "training_index", "expected"),
    [
        (objects((0, [2, 1]), (1, np.array([0])), (2, [])), [0, 1, 2], [0, 1, 2], [[1, 2], [0], []]),
        (objects((7, [3]), (2, [1])), [2, 5, 7], [0, 1, 2, 3], [[1], [], [3]]),
        (objects([1], [0, 2]), [0, 1], [0, 1, 2], [[1], [0, 2]]),
        (np.array([[1, -1], [0, 2], [-1, -1]]), [0, 1, 2], [0, 1, 2], [[1], [0, 2], []]),
        (np.array([[10], [11], [12], [13]]), [1, 3], [11, 12, 13], [[0], [2]]),
        (np.array([[0, 99]]), [0], [0, 1], [[0]]),
        (np.array([[False, True], [True, True], [False, False]]), [0, 1, 2], [0, 1], [[1], [0, 1], []]),
        (np.array([[0, 0, 1], [1, 0, 0]], np.uint8), [0, 1], [0, 1, 2], [[2], [0]]),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), [0, 1], [0, 1], [[0, 1], [0, 1]]),
    ],
    ids=[
        *("pairs", "any order, with gaps", "in frame order", "padded", "places in the recording", "not mapped"),
        *("true and false", "1 and 0", "two numbers"),
    ],
)
def test_every_form_of_ground_truth(tmp_path, array, test_index, training_index, expected):
    np.save(tmp_path / "truth.npy", array, allow_pickle=True)
    truths = read_ground_truth(tmp_path / "truth.npy", np.array(test_index), np.array(training_index))
    assert [truth.tolist() for truth in truths] == expected


def test_a_frame_that_is_told_wrongly_is_named(folder):
    objects = {"0.png": [], "1.png": [{"label": "car", "box": [10, 20, 100, 200]}]}
    lines = (json.dumps({"name": name, "objects": scene}) for name, scene in objects.items())
    (folder / "detections.jsonl").write_text("\n".join(lines))
    recording = as_taken(open_source(str(folder)), {"objects"})
    with pytest.raises(InvalidSceneError, match=r"^1\.png: object 0: a box is"):
        encode_recording(recording, make_evaluator(evaluator_config({"kind": "objects"})), MAX_PIXELS, lambda _: None)


class Malice:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_a_malicious_pickle_runs_nothing(tmp_path):
    path, marker = tmp_path / "truth.npy", tmp_path / "it ran"
    np.save(path, objects((0, Malice(marker))), allow_pickle=True)
    with pytest.raises(InvalidSourceError, match="mkdir"):
        read_ground_truth(path, np.arange(1), np.arange(1))
    assert not marker.exists()
    np.load(path, allow_pickle=True)
    assert marker.exists(), "the pickle would have run"


@pytest.mark.parametrize(
    "write",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"words"),
        lambda path: path.write_bytes(b"\x93NUMPY\x01\x00"),
        lambda path: path.write_bytes(pickle.dumps([[0]])),
        lambda path: np.save(path, objects((0, ["a place"])), allow_pickle=True),
        lambda path: np.save(path, np.array([[0.5, 1]])),
        lambda path: np.save(path, np.array([[np.nan]])),
        lambda path: path.mkdir(),
    ],
)
def test_what_is_no_ground_truth_is_named(tmp_path, write):
    write(tmp_path / "truth.npy")
    with pytest.raises(InvalidSourceError, match=r"truth\.npy"):
        read_ground_truth(tmp_path / "truth.npy", np.arange(1), np.arange(1))


@pytest.mark.real_data
def test_the_corridor_of_vpr_bench(real_data):
    path = real_data / "corridor" / "ground_truth_new.npy"
    truths = read_ground_truth(path, np.arange(111), np.arange(111))
    expected = {int(query): sorted(truth) for query, truth in np.load(path, allow_pickle=True)}
    assert [truth.tolist() for truth in truths] == [expected[query] for query in range(111)]
