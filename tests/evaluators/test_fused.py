"""Two evaluators of one domain: what their weight is learnt from, and what a half alone is worth."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.composed import Moments, unit
from deepsimbad.core.drive import Drive
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.errors import InvalidEncodingError
from deepsimbad.evaluators.base import Lesson
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.fused import Fused
from deepsimbad.jobs.append import append_drive
from deepsimbad.jobs.build import measure_drive
from deepsimbad.jobs.experiments.vpr import DriveViews, VprConfig, build_maps, score_maps, vpr_stages
from deepsimbad.jobs.fitting import Fitter
from deepsimbad.jobs.progress import Progress

N, D, SPREAD = 150, 120, 5.0


class Half(FeatureL2):
    """A half that takes ready encodings of a known length."""

    encoding_dim = D


FUSED, ALONE = Fused([Half("none"), Half("none")]), FeatureL2("none")


def season(number, *noise):
    """A drive of 150 m: halves [N, D] of unit length, with `noise` each; a season shifts every number."""
    halves = []
    for half, amount in enumerate(noise):
        place_rng, noise_rng = np.random.default_rng(half), np.random.default_rng(10 * number + half)
        views = (
            place_rng.normal(size=(N, D)) + amount * noise_rng.normal(size=(N, D)) + SPREAD * place_rng.normal(size=D)
        )
        halves.append(unit(views + noise_rng.normal(size=D)))
    return Drive(position_m=np.arange(float(N)), encodings=np.hstack(halves))


def with_one_half(drive, half):
    """The drive with one half alone, as `encode` gives it."""
    encodings = np.zeros_like(drive.encodings)
    encodings[:, half * D : (half + 1) * D] = drive.encodings[:, half * D : (half + 1) * D]
    return replace(drive, encodings=encodings)


def part(drive, half):
    return replace(drive, encodings=np.ascontiguousarray(drive.encodings[:, half * D : (half + 1) * D]))


def score(relevance, evaluator, landmarks, training, *tests):
    config = VprConfig(60, relevances=(relevance,))
    maps = build_maps(config, Fitter(evaluator), evaluator, landmarks, training)
    truth = true_images_of(training.route(), training.route(), 2.0)
    progress = Progress(vpr_stages(config))
    scores = [
        score_maps(config, maps, DriveViews(test, evaluator), [truth], progress, bound=False)[0] for test in tests
    ]
    return maps[relevance], [anrs[relevance].anr for anrs in scores]


@pytest.mark.parametrize("worse", [0, 1])
def test_the_weight_is_learnt_where_the_other_drive_saw_the_same_places(worse):
    noise = [1.0, 1.0]
    noise[worse] = 2.0
    built_map, _ = score(Relevance.RRF, FUSED, season(1, *noise), season(2, *noise))
    weight, fitting = float(built_map.map.landmark_model["fused_weight"][0]), built_map.fitting
    assert (weight < 0.5) == (worse == 0)
    assert (fitting["weight"], fitting["n_shared_places"]) == (pytest.approx(weight), N)
    assert fitting["anr"][f"{weight:.1f}"] == min(fitting["anr"].values())
    assert fitting["anr"][f"{worse}.0"] < fitting["anr"][f"{1 - worse}.0"], "either half alone is among what was tried"
    lesson = Lesson(season(1, *noise).encodings, np.arange(N))
    assert FUSED.fit(lesson).model["fused_weight"] == 0.5


def test_a_half_that_tells_no_frame_from_another_is_no_better_than_chance():
    first, second = (with_one_half(season(number, 1.0, 1.0), 1).encodings for number in (1, 2))
    fitted = FUSED.fit(Lesson(first, np.arange(N), other=second, places=np.tile(np.arange(N), (2, 1)).T))
    assert fitted.metrics["anr"]["1.0"] == pytest.approx(100 * 0.5 * (N - 1) / N)
    assert fitted.metrics["anr"]["0.0"] < 20
    assert fitted.metrics["weight"] < 1


def test_a_half_alone_is_answered_as_its_own_evaluator_would_and_both_are_better():
    noise = (2.0, 2.0)
    landmarks, training, test = (season(number, *noise) for number in (1, 2, 3))
    composed, (whole_anr, first, second) = score(
        Relevance.COMPOSED, FUSED, landmarks, training, test, with_one_half(test, 0), with_one_half(test, 1)
    )
    for half, half_anr in enumerate((first, second)):
        _, (own_anr,) = score(Relevance.COMPOSED, ALONE, *(part(drive, half) for drive in (landmarks, training, test)))
        assert own_anr > 1, "else there is nothing to lose"
        assert whole_anr < half_anr < 1.4 * own_anr
    view = DriveViews(with_one_half(test, 0), FUSED).by(composed.map.landmark_model).at(0)
    map_statistics = composed.map.live_statistics
    live_statistics = map_statistics.observing(view)
    np.testing.assert_array_equal(
        live_statistics.encodings.std[D:], map_statistics.encodings.std[D:], "what was not told taught something"
    )
    assert (live_statistics.encodings.mean[:D] != map_statistics.encodings.mean[:D]).all()


def test_a_half_that_frames_of_the_map_lack_is_the_usual_one():
    """As one that a live view lacks; with zeros in its place the ANR is 9.0, and 4.7 where none lacks any."""
    training, test = season(2, 2.0, 2.0), season(3, 2.0, 2.0)
    lacking = np.random.default_rng(0).random(N) < 0.5
    training.encodings[lacking, D:] = 0
    composed, (anr,) = score(Relevance.COMPOSED, FUSED, None, training, test)
    np.testing.assert_allclose(
        composed.map.usual_encoding[0, D:], training.encodings[~lacking, D:].mean(axis=0), atol=1e-6
    )
    assert anr < 7


def test_a_frame_without_one_half_can_be_appended():
    """As one in which a detector finds nothing."""
    first_map = score(Relevance.COMPOSED, FUSED, None, season(1, 1.0, 1.0))[0].map
    drive = season(2, 1.0, 1.0).at(np.arange(20))
    drive.encodings[5, D:] = 0
    longer_map = append_drive(first_map, measure_drive(drive, first_map.landmark_model, FUSED))
    longer_map.check()
    means = (N * first_map.usual_encoding[0, D:] + 20 * drive.encodings[:, D:].mean(axis=0)) / (N + 20)
    means += first_map.usual_encoding[0, D:] / (N + 20)  # stands for what is not known
    np.testing.assert_allclose(longer_map.usual_encoding[0, D:], means, atol=1e-5)


def test_what_an_encoder_broke_does_not_pass_for_a_half_that_is_missing():
    composed, _ = score(Relevance.COMPOSED, FUSED, season(1, 1.0, 1.0), season(2, 1.0, 1.0))
    model, broken = composed.map.landmark_model, season(3, 1.0, 1.0).encodings[:2].copy()
    broken[0, D:] = np.nan
    with pytest.raises(InvalidEncodingError):
        FUSED.dissimilarities(broken, model)
    with pytest.raises(InvalidEncodingError):
        ALONE.dissimilarities(broken, model)


def test_of_numbers_some_of_which_are_not_told_the_others_count():
    moments = Moments.of(np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32))
    partial = moments.observing(np.array([1.0, np.nan, 2.0], np.float32))
    complete = moments.observing(np.array([1.0, 0.0, 2.0], np.float32))
    assert (partial.mean[[0, 2]] == complete.mean[[0, 2]]).all()
    assert (partial.mean[1], partial.square[1]) == (moments.mean[1], moments.square[1])
