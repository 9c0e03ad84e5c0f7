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
READY = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "none"}))


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


@pytest.fixture
def encoded(judge):
    """Encodes a recording, or the source of one."""

    def encode(recording, evaluator=judge, max_pixels=MAX_PIXELS, on_progress=lambda _: None, **options):
        recording = recording if isinstance(recording, Recording) else open_source(str(recording))
        return encode_recording(recording, evaluator, max_pixels, on_progress, **options)

    return encode


def test_images_are_encoded_as_the_service_would_encode_what_is_posted(folder, judge, encoded):
    recording, shares = open_source(str(folder), spacing_m=2.5), []
    encoding = encoded(recording, on_progress=shares.append)
    assert shares == [place / 6 for place in range(1, 7)], "every frame is reported, broken or not"
    assert list(encoding.left_out.values()) == [1]
    drive = encoding.drive
    assert drive.index.tolist() == [0, 1, 3, 4, 5]
    assert drive.position_m.tolist() == drive.route().position_m.tolist() == [0.0, 2.5, 7.5, 10.0, 12.5]
    for row, place in enumerate(drive.index):
        posted = recording.image(recording.frames[place], judge.input_size).body
        assert np.array_equal(drive.encodings[row], judge.encode([decode_image(posted, MAX_PIXELS)])[0])


def test_the_readers_own_count_is_kept(folder, encoded):
    (folder / "positions.csv").write_text("name,position_m\n0.png,0\n1.png,1\n2.png,2\n9.png,9\n")
    encoding = encoded(folder)
    assert encoding.drive.index.tolist() == [0, 1]
    reasons = ("not in positions.csv", "in positions.csv without an image")
    assert [encoding.left_out[reason] for reason in reasons] == [3, 1]
    assert sum(encoding.left_out.values()) == 5


def test_what_an_earlier_run_kept_says_which_images_show_nothing_too(folder, encoded, tmp_path_factory):
    cv2.imwrite(str(folder / "4.png"), np.zeros((90, 160, 3), np.uint8))
    out = tmp_path_factory.mktemp("out")
    for is_first in (True, False):
        with open_encoding_cache(out, "queries", source=str(folder)) as cache:
            encoding = encoded(folder, encoding_cache=cache)
        assert (encoding.encode_ms is not None) == is_first, "nothing is encoded twice"
        assert encoding.drive.shows_nothing.tolist() == [False, False, False, True, False]


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


@pytest.mark.parametrize(
    ("part", "changes", "error", "says"),
    [
        ("#2:3", {}, InvalidSourceError, "no frame that can be used"),
        ("", {"max_pixels": 100}, ImageTooLargeError, "pixels"),
        ("", {"evaluator": READY}, InvalidSourceError, "^test_what.*: this evaluator takes ready encodings alone"),
    ],
    ids=["broken frames alone", "an image over the limit", "no extractor"],
)
def test_what_cannot_be_encoded_is_named(folder, encoded, part, changes, error, says):
    with pytest.raises(error, match=says):
        encoded(f"{folder}{part}", **changes)


def test_ready_encodings_are_taken_as_they_are(tmp_path, encoded):
    rows = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
    np.save(tmp_path / "drive.npy", rows)
    drive = encoded(f"{tmp_path / 'drive.npy'}#2:9:3").drive
    assert np.array_equal(drive.encodings, rows[2:9:3])
    assert (drive.index.tolist(), drive.position_m.tolist()) == ([2, 5, 8], [2.0, 5.0, 8.0])
    assert (drive.timestamp_us == UNKNOWN_TIMESTAMP).all()
    assert np.isnan(drive.x_m).all()
    assert drive.route().x_m is None


def recording_at(*positions_m):
    """A recording that knows the ground coordinates of some frames."""
    frames = tuple(
        Frame(i, str(i), at, timestamp_us=i, x_m=None if i == 1 else 1.0 * i, y_m=2.0)
        for i, at in enumerate(positions_m)
    )
    return Recording("placed", frames, encodings=np.eye(3, dtype=np.float32))


def test_ground_coordinates_and_times_are_kept_and_positions_that_go_backwards_named(encoded):
    drive = encoded(recording_at(0, 1, 2)).drive
    assert drive.timestamp_us.tolist() == [0, 1, 2]
    np.testing.assert_array_equal([drive.route().x_m, drive.route().y_m], [[0.0, np.nan, 2.0], [2.0, 2.0, 2.0]])
    with pytest.raises(InvalidRouteError, match="frame 2"):
        encoded(recording_at(0, 2, 1))


def test_a_frame_that_is_told_wrongly_is_named(folder, encoded):
    scenes = {"0.png": [], "1.png": [{"label": "car", "box": [10, 20, 100, 200]}]}
    lines = (json.dumps({"name": name, "objects": scene}) for name, scene in scenes.items())
    (folder / "detections.jsonl").write_text("\n".join(lines))
    with pytest.raises(InvalidSceneError, match=r"^1\.png: object 0: a box is"):
        encoded(as_taken(open_source(str(folder)), {"objects"}), make_evaluator(evaluator_config({"kind": "objects"})))


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
