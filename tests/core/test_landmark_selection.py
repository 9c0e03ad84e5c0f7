"""Landmark selection against the n x n matrix it avoids; what a landmark model's digest tells."""

import numpy as np
import pytest

from deepsimbad.core import landmark_model
from deepsimbad.core.landmark_model import landmark_model_digest, select_landmarks
from deepsimbad.errors import CancelledError, InvalidEncodingError, InvalidMapConfigError, TooFewCandidatesError


def slow_selection(candidates, n_landmarks):
    distances = ((candidates[:, None].astype(np.float64) - candidates[None]) ** 2).sum(-1)
    np.fill_diagonal(distances, np.inf)
    return np.argsort(-distances.min(axis=1), kind="stable")[:n_landmarks]


@pytest.mark.parametrize("n_candidates", [2, 7, 8, 9, 100])
def test_blocks_give_what_the_whole_matrix_gives(n_candidates, monkeypatch):
    monkeypatch.setattr(landmark_model, "_BLOCK", 8)
    candidates = np.random.default_rng(n_candidates).normal(size=(n_candidates, 12)).astype(np.float32)
    expected = slow_selection(candidates, n_candidates)
    np.testing.assert_array_equal(select_landmarks(candidates, n_candidates), expected)


def test_duplicates_come_last_and_ties_go_by_index():
    candidates = np.array([[0.0], [0.0], [5.0], [9.0], [14.0]], np.float32)
    np.testing.assert_array_equal(select_landmarks(candidates, 5), slow_selection(candidates, 5))


def test_too_few_candidates_and_bad_numbers_are_named():
    with pytest.raises(TooFewCandidatesError, match="3 candidates for 4"):
        select_landmarks(np.eye(3, dtype=np.float32), 4)
    with pytest.raises(InvalidMapConfigError):
        select_landmarks(np.eye(3, dtype=np.float32), 0)
    for bad in (np.nan, np.inf, 3e38):
        with pytest.raises(InvalidEncodingError):
            select_landmarks(np.array([[0.0], [bad]], np.float32), 1)


def test_progress_reaches_one_and_can_cancel(monkeypatch):
    monkeypatch.setattr(landmark_model, "_BLOCK", 4)
    candidates = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    shares = []
    select_landmarks(candidates, 2, shares.append)
    assert (shares, shares[-1]) == (sorted(shares), 1.0)

    def cancel(_):
        raise CancelledError("stop")

    with pytest.raises(CancelledError):
        select_landmarks(candidates, 2, cancel)


def test_a_digest_tells_names_types_shapes_and_numbers_and_not_how_they_lie_in_memory():
    numbers = np.arange(6.0).reshape(2, 3)
    variants = (numbers.astype("f4"), numbers.reshape(3, 2), -numbers)
    models = [{"a": numbers}, {"b": numbers}, *({"a": other} for other in variants)]
    assert len({landmark_model_digest(model) for model in models}) == len(models)
    alike = [{"a": np.asfortranarray(numbers)}, {"a": numbers.astype(">f8")}]
    assert {landmark_model_digest(model) for model in alike} == {landmark_model_digest(models[0])}
