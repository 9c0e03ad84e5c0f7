"""Ground truth files, VPR-Bench's among them; a pickle in one runs nothing."""

import os
import pickle

import numpy as np
import pytest

from deepsimbad.errors import InvalidSourceError
from deepsimbad.jobs.ground_truth import read_ground_truth


def lists(found):
    return [ids.tolist() for ids in found]


def saved(path, array, **how):
    np.save(path, array, **how)
    return path


def vpr_bench(rows):
    """[q, 2] object array of (query, list), as VPR-Bench writes it."""
    array = np.empty((len(rows), 2), object)
    for row, (query, truth) in zip(array, rows, strict=True):
        row[0], row[1] = query, truth
    return array


def test_pairs_of_a_query_and_its_list(tmp_path):
    path = saved(tmp_path / "truth.npy", vpr_bench([(0, [2, 1]), (1, np.array([0])), (2, [])]), allow_pickle=True)
    assert lists(read_ground_truth(path, np.arange(3), np.arange(3))) == [[1, 2], [0], []]


def test_the_pairs_may_come_in_any_order_and_with_gaps(tmp_path):
    path = saved(tmp_path / "truth.npy", vpr_bench([(7, [3]), (2, [1])]), allow_pickle=True)
    assert lists(read_ground_truth(path, np.array([2, 5, 7]), np.arange(4))) == [[1], [], [3]]


def test_lists_in_test_frame_order(tmp_path):
    array = np.empty(2, object)
    array[0], array[1] = [1], [0, 2]
    path = saved(tmp_path / "truth.npy", array, allow_pickle=True)
    assert lists(read_ground_truth(path, np.arange(2), np.arange(3))) == [[1], [0, 2]]


def test_numbers_padded_with_minus_one(tmp_path):
    path = saved(tmp_path / "truth.npy", np.array([[1, -1], [0, 2], [-1, -1]]))
    assert lists(read_ground_truth(path, np.arange(3), np.arange(3))) == [[1], [0, 2], []]


def test_frames_are_named_by_their_place_in_the_whole_recording(tmp_path):
    path = saved(tmp_path / "truth.npy", np.array([[10], [11], [12], [13]]))
    found = read_ground_truth(path, test_index=np.array([1, 3]), training_index=np.array([11, 12, 13]))
    assert lists(found) == [[0], [2]]


def test_a_training_frame_that_is_not_mapped_is_no_answer(tmp_path):
    path = saved(tmp_path / "truth.npy", np.array([[0, 99]]))
    assert lists(read_ground_truth(path, np.arange(1), np.arange(2))) == [[0]]


class Malice:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_a_malicious_pickle_runs_nothing(tmp_path):
    marker = tmp_path / "it ran"
    path = saved(tmp_path / "truth.npy", vpr_bench([(0, Malice(marker))]), allow_pickle=True)
    with pytest.raises(InvalidSourceError, match="mkdir"):
        read_ground_truth(path, np.arange(1), np.arange(1))
    assert not marker.exists()
    np.load(path, allow_pickle=True)
    assert marker.exists(), "the pickle would have run"


def test_a_bare_pickle_is_no_ground_truth(tmp_path):
    path = tmp_path / "truth.npy"
    path.write_bytes(pickle.dumps([[0]]))
    with pytest.raises(InvalidSourceError, match="no ground truth file"):
        read_ground_truth(path, np.arange(1), np.arange(1))


@pytest.mark.parametrize("body", [b"", b"words", b"\x93NUMPY\x01\x00"])
def test_what_is_no_array_is_named(tmp_path, body):
    path = tmp_path / "truth.npy"
    path.write_bytes(body)
    with pytest.raises(InvalidSourceError, match=r"truth\.npy"):
        read_ground_truth(path, np.arange(1), np.arange(1))


def test_a_truncated_array_is_named(tmp_path):
    path = saved(tmp_path / "truth.npy", vpr_bench([(0, [1, 2, 3])] * 5), allow_pickle=True)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InvalidSourceError):
        read_ground_truth(path, np.arange(1), np.arange(1))


def test_words_in_place_of_frame_numbers_are_named(tmp_path):
    path = saved(tmp_path / "truth.npy", vpr_bench([(0, ["a place"])]), allow_pickle=True)
    with pytest.raises(InvalidSourceError):
        read_ground_truth(path, np.arange(1), np.arange(1))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidSourceError, match="cannot read"):
        read_ground_truth(tmp_path / "nowhere.npy", np.arange(1), np.arange(1))


@pytest.mark.real_data
def test_the_corridor_of_vpr_bench(real_data):
    path = real_data / "corridor" / "ground_truth_new.npy"
    found = read_ground_truth(path, np.arange(111), np.arange(111))
    expected = {int(query): sorted(truth) for query, truth in np.load(path, allow_pickle=True)}
    assert len(found) == 111
    assert lists(found) == [expected[query] for query in range(111)]
    assert all(len(ids) for ids in found)
