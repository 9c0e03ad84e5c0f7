"""`experiment calibration`: every measure by hand, and the whole on a small made-up triplet."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.particles import FilterKind, ParticleFilter
from deepsimbad.core.building import MapPlan
from deepsimbad.core.drive import Drive
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.jobs.build import build, measure_drive, views_of
from deepsimbad.jobs.experiments.calibration import (
    CalibrationConfig,
    Sight,
    _Course,
    _course,
    calibration_stages,
    reliability,
    run_calibration,
    smallest_set,
    views_until_found,
    wrong_when_confident,
)
from deepsimbad.jobs.experiments.nbv import TestDrive as DrivenByTest
from deepsimbad.jobs.progress import Progress

from ...commands import run_command

QUICK = CalibrationConfig(n_landmarks=60, standing=3, carried=12)
N = 270


@pytest.fixture(scope="module")
def drives():
    """Landmarks, training, test: one route of 270 m in three seasons."""
    rng = np.random.default_rng(2)
    places = rng.normal(size=(N, 12))
    seasons = [places + noise * rng.normal(size=places.shape) for noise in (0.5, 0.2, 0.6)]
    return [Drive(position_m=np.arange(N, dtype=float), encodings=season.astype(np.float32)) for season in seasons]


@pytest.fixture(scope="module")
def report(drives, evaluator):
    return run_calibration(QUICK, evaluator, *drives, Progress(calibration_stages()))


@pytest.fixture(scope="module")
def document(report):
    return report.as_dict({"training": "here"})


@pytest.fixture(scope="module")
def localizer(drives, evaluator):
    landmarks, training, _ = drives
    plan = MapPlan(Relevance.COMPOSED, 4, (1.0, 3.0, 5.0, 10.0), same_route=True)
    map_ = build(plan, training, landmarks, landmarks, 60, evaluator).map
    return map_, ActiveLocalizer(map_, LocalizerConfig(planner="constant:5"))


def sight(**parts):
    shape = np.shape(next(iter(parts.values())))
    return Sight(*(np.array(parts.get(part, np.zeros(shape)), float) for part in Sight._fields))


# --- the measures, by hand -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass", "members"),
    [
        ([0.05, 0.9, 0.05], [True, True, True]),  # tied with the last one that is needed
        ([0.01, 0.95, 0.04], [False, True, False]),
        ([0.02, 0.6, 0.34, 0.04], [False, True, True, True]),
        ([0.25] * 4, [True] * 4),
    ],
)
def test_the_smallest_set_holds_95_percent(mass, members):
    assert smallest_set(np.array(mass)).tolist() == members


def test_reliability_counts_by_what_was_believed():
    believed, near = [[0.05, 0.55], [1.0, 0.95]], [[0, 1], [1, 0]]
    bins = reliability([sight(near_mode=believed, is_near=near)])
    assert bins["n_views"] == [1, 0, 0, 0, 0, 1, 0, 0, 0, 2]
    assert (bins["near_mode"][0], bins["near_mode"][9]) == (pytest.approx(5), pytest.approx(97.5))
    assert (bins["within_5_m"][0], bins["within_5_m"][5], bins["within_5_m"][9]) == (0, 100, 50)
    assert bins["near_mode"][3] is None


def test_only_the_first_sure_view_is_wrong_or_right():
    believed = [[0.5, 0.99, 1.0], [0.99, 0.2, 1.0], [0.9, 0.98, 0.5], [1.0, 1.0, 1.0]]
    near = [[1, 0, 1], [1, 0, 0], [0, 0, 0], [1, 1, 1]]
    assert wrong_when_confident(sight(near_mode=believed, is_near=near)) == 25, "the first robot alone"


def test_views_until_found():
    near = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 0]])
    assert views_until_found(near).tolist() == [3, 1, 5]


# --- the robots ----------------------------------------------------------------------------------------------------


def test_robots_look_where_they_are_and_report_their_moves(report, drives, evaluator, localizer):
    map_, algorithm = localizer
    views = views_of(measure_drive(drives[2], map_.landmark_model, evaluator))
    for stage, moved_m in (("moves of 3 m", 3.0), ("odometry times 0.9", 4.5), ("odometry times 1.1", 5.5)):
        sight, state, start = report.sights[stage], algorithm.start(), 4
        step_m = 3 if stage.startswith("moves") else 5
        for view in range(sight.set_m.shape[1]):
            state = algorithm.step(state, views.at(start + step_m * view), moved_m).state
            mass = state.belief.mass
            assert sight.set_m[start, view] == pytest.approx(map_.route.cell_m[smallest_set(mass)].sum())
            assert sight.is_covered[start, view] == smallest_set(mass)[start + step_m * view]
            assert sight.is_near[start, view] == (abs(int(mass.argmax()) - start - step_m * view) <= 5)
            assert sight.off_route[start, view] == pytest.approx(state.belief.doubt.off_route)


def test_how_many_robots_and_views_there_are(report):
    expected = {
        "moves of 1 m": (N - 10, 11),
        "moves of 10 m": (N - 100, 11),
        "standing": (3, 150),
        "tracked, then standing": (3, 11 + 150),
        "carried": (12, 11 + 30),
        "odometry times 0.9": (5, 53),
        "off the route": (12, 10),
        "on the route": (12, 10),
    }
    assert {stage: report.sights[stage].set_m.shape for stage in expected} == expected


def test_a_move_past_the_end_is_refused_and_changes_nothing(drives, evaluator, localizer):
    map_, algorithm = localizer
    views = views_of(measure_drive(drives[2], map_.landmark_model, evaluator))
    course = _Course(algorithm, DrivenByTest(views, drives[2].route(), np.arange(N)), QUICK)
    path_m = np.r_[N - 51 + 5.0 * np.arange(11), N - 1.0][np.newaxis]
    sight = course.drive_robots(path_m, np.r_[np.full(11, 5.0), N + 30.0], lambda _: None)
    assert sight.is_refused[0].tolist() == [0] * 11 + [1]
    assert sight.near_mode[0, 11] == sight.near_mode[0, 10]


def test_a_drive_too_short_is_named(drives, evaluator):
    landmarks, training, test = drives
    short = test.at(np.arange(240))
    with pytest.raises(InvalidMapConfigError, match="239 m"):
        run_calibration(QUICK, evaluator, landmarks, training, short, Progress(calibration_stages()))


# --- the whole -----------------------------------------------------------------------------------------------------


def test_the_document_tells_what_was_measured(document, report):
    assert set(document["coverage_95"]) == set(document["set_m"]) == {"1", "3", "5", "10"}
    of_5_m = report.sights["moves of 5 m"]
    for views in (1, 2, 3, 5, 10):
        covered, set_m = of_5_m.is_covered[:, views - 1], of_5_m.set_m[:, views - 1]
        assert document["coverage_95"]["5"][str(views)] == pytest.approx(100 * covered.mean())
        assert document["set_m"]["5"][str(views)] == pytest.approx(set_m.mean())
    assert document["config"]["training"] == "here"
    assert document["second_season"]["accepted"]
    assert sum(document["reliability"]["n_views"]) == 11 * sum(N - 10 * move for move in (1, 3, 5, 10))


def test_places_unlike_each_other_are_told_apart(document):
    assert all(coverage["10"] >= 95 for coverage in document["coverage_95"].values())
    assert document["set_m"]["10"]["10"] < min(5, document["set_m"]["10"]["1"])
    assert document["standing_coverage_95"]["tracked"] >= 95
    assert document["lost_their_place"] == 0
    assert document["carried"]["views_median"] <= 10
    assert document["off_route"]["off the route"] > 5 * document["off_route"]["on the route"]
    assert not any(document["views_refused"].values())


def test_who_was_carried_is_far_from_where_it_was_tracked_to(report):
    """A robot that was carried was tracked well before, and is at first believed to be there still."""
    tracked, carried, later = report.sights["carried"].is_near[:, [10, 11, -1]].mean(axis=0)
    assert carried < 0.5 < 0.8 < min(tracked, later)


def test_the_command_prints_a_table_and_writes_json(drives, report, tmp_path, monkeypatch):
    calls = []

    def run(config, evaluator, *drives_and_progress):
        calls.append((config, [drive.n_frames for drive in drives_and_progress[:3]]))
        return replace(report, config=config)

    monkeypatch.setattr(importlib.import_module("deepsimbad.cli.experiment"), "run_calibration", run)
    sources = []
    for role, drive in zip(("landmarks", "training", "test"), drives, strict=True):
        np.save(tmp_path / f"{role}.npy", drive.encodings[: -2 if role == "test" else None])
        sources += [f"--{role}", tmp_path / f"{role}.npy"]
    options = ("--evaluator", "feature_l2:none", "--n-landmarks", 60, "--list-length", 3, "--seed", 4)
    options += ("--filter", "particle", "--relevance", "standardised", "--json", tmp_path / "out.json")
    ran = run_command(["deepsimbad", "experiment", "calibration", *sources, *options])
    assert ran.code == 0, ran.err
    config = CalibrationConfig(60, 3, Relevance.STANDARDISED, FilterKind.PARTICLE, seed=4)
    assert calls == [(config, [N, N, N - 2])]
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["config"]["filter"] == "particle"
    (row,) = [line for line in ran.out.splitlines() if line.startswith("│ 10 ")]
    assert f"{document['coverage_95']['10']['5']:.1f} / {document['set_m']['10']['5']:.0f}" in row
    assert f"found after {document['carried']['views_median']:.0f} views" in ran.out


def test_the_filter_and_seed_asked_for_are_the_robots(drives, evaluator):
    landmarks, training, test = drives
    plan = MapPlan(Relevance.RRF, 4, (5.0,))
    map_build = build(plan, training, None, landmarks, 20, evaluator)
    for kind, belief in ((FilterKind.GRID, GridFilter), (FilterKind.PARTICLE, ParticleFilter)):
        config = CalibrationConfig(filter=kind, seed=5)
        start_belief = _course(config, evaluator, map_build, test, np.arange(N)).localizer.start().belief
        assert type(start_belief) is belief
        assert getattr(start_belief, "seed", 5) == 5
