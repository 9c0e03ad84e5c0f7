"""The algorithm on one page against straight-line code; priors, views that say nothing."""

import functools
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.belief.evidence import ViewEvidence
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.motion import usual_errors
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.belief.summary import near_mode
from deepsimbad.core.building import MapPlan, build_from_dissimilarities, compose_map
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.planners import information_ahead
from deepsimbad.core.relevance import Query, Relevance, UpdateRule, shows_nothing
from deepsimbad.errors import InvalidInputError
from deepsimbad.evaluators.feature_l2 import FeatureL2

N_IMAGES, N_LANDMARKS, LIST_LENGTH, DIM = 150, 20, 4, 8
EVALUATOR = FeatureL2("none")
ACTIONS_M = (1.0, 2.0, 5.0)


def frames(encodings):
    return Drive(position_m=np.arange(float(len(encodings))), encodings=encodings.astype(np.float32))


@pytest.fixture(scope="module")
def seasons():
    """[n, d] encodings of one route in three seasons: landmarks, training, live."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(N_IMAGES, DIM))
    return [place + noise * rng.normal(size=place.shape) for noise in (0.3, 0.1, 0.3)]


def with_dissimilarities(drive, model):
    return replace(drive, dissimilarities=EVALUATOR.dissimilarities(drive.encodings, model))


@pytest.fixture(scope="module")
def snapshots(seasons):
    landmarks, training, _ = seasons
    model = EVALUATOR.fit_landmarks(landmarks[:N_LANDMARKS].astype(np.float32))
    first, second = frames(training), frames(landmarks)

    def make(relevance=Relevance.COMPOSED, closed=False):
        plan = MapPlan(relevance, LIST_LENGTH, ACTIONS_M, closed, same_route=True)
        if relevance is Relevance.COMPOSED:
            return compose_map(plan, first, second, second, N_LANDMARKS).map
        return build_from_dissimilarities(plan, first, second, model, with_dissimilarities).map

    return functools.cache(make)


@pytest.fixture(scope="module")
def queries(seasons, snapshots):
    encodings = seasons[2].astype(np.float32)
    dissimilarities = EVALUATOR.dissimilarities(encodings, snapshots(Relevance.RRF).landmark_model)
    return [Query(*view) for view in zip(rank_landmarks(dissimilarities), dissimilarities, encodings, strict=True)]


def walk(localizer, queries, frames, state=None):
    """The state after a view of every frame, moving exactly between them."""
    state = localizer.start() if state is None else state
    last_frame = frames[0]
    for frame in frames:
        state = localizer.step(state, queries[frame], float((frame - last_frame) % N_IMAGES)).state
        last_frame = frame
    return state


def entropy(mass):
    return float(-sum(m * math.log2(m) for m in mass.tolist() if m > 0))


# --- describe, retrieve, predict, update, plan ---------------------------------------------------------------------


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("relevance", [Relevance.COMPOSED, Relevance.STANDARDISED, Relevance.RRF])
def test_a_step_is_describe_retrieve_predict_update_plan(snapshots, queries, closed, relevance):
    map_ = snapshots(relevance, closed=closed)
    ticks = itertools.count()
    localizer = ActiveLocalizer(map_, LocalizerConfig(price_bits_per_m=0.1), lambda: float(next(ticks)))
    state, live, belief = localizer.start(), map_.live_statistics, GridFilter.uniform(map_.route, map_.update_rule)
    position_m = 120.0 if closed else 20.0
    for number, action_m in enumerate((0.0, 5.0, 1.0, 2.0, 10.0, 0.0, 20.0)):
        position_m += action_m
        query = queries[int(position_m) % N_IMAGES]
        step = localizer.step(state, query, action_m if number else 77.0)  # the first move is ignored
        live = live and live.observing(query, min(1.0, action_m) if number else 1.0)
        relevance_of_images = relevances(map_, query, live)
        shared = 0.0
        if number:
            belief = belief.predicted(action_m, math.sqrt(0.0025 + 0.01 * action_m) if action_m else 0.0, number)
            shared = map_.shared_error_after(action_m)
        belief = belief.updated(
            ViewEvidence.of(relevance_of_images, map_.update_rule, map_.log_likelihood_scale, shared), number
        )
        np.testing.assert_allclose(step.state.relevance, relevance_of_images)
        np.testing.assert_allclose(step.state.belief.mass, belief.mass)
        assert step.state.belief.doubt.off_route == pytest.approx(belief.doubt.off_route)
        ahead = information_ahead(map_, 0.1)
        if ahead is None:
            assert (step.plan.action_m, step.plan.values) == (5.0, None)
        else:
            near_shares = near_mode(map_.route, belief.mass, int(belief.mass.argmax()), usual_errors(*map_.actions_m))
            doubt_bits = 2 * np.log2(np.maximum(1 - near_shares, 1e-6))
            expected = belief.mass @ ahead[:, :3] - (doubt_bits[1:] - doubt_bits[0])
            np.testing.assert_allclose(step.plan.values, expected, rtol=1e-4)
        assert localizer.plan(step.state).action_m == step.plan.action_m
        assert step.timings_ms == dict.fromkeys(("retrieve", "predict", "update", "plan"), 1000)
        state = step.state
    assert relevance is Relevance.RRF or int(state.belief.mass.argmax()) == int(position_m) % N_IMAGES
    assert state.n_observations == 7


def test_a_robot_that_was_believed_elsewhere_begins_anew_with_its_statistics(snapshots, queries):
    map_ = snapshots()
    localizer = ActiveLocalizer(map_, LocalizerConfig(update=UpdateRule.LOG_LIKELIHOOD))
    state = walk(localizer, queries, range(20, 30))
    step, has_restarted = localizer.observe_or_restart(state, queries[31], 2.0)
    assert not has_restarted
    np.testing.assert_array_equal(step.state.belief.mass, localizer.step(state, queries[31], 2.0).state.belief.mass)
    step, has_restarted = localizer.observe_or_restart(state, queries[70], 900.0)
    assert has_restarted
    np.testing.assert_array_equal(step.relevance, relevances(map_, queries[70], state.live.observing(queries[70])))
    even = GridFilter.uniform(map_.route, UpdateRule.LOG_LIKELIHOOD)
    evidence = ViewEvidence.of(step.relevance, UpdateRule.LOG_LIKELIHOOD, map_.log_likelihood_scale)
    np.testing.assert_array_equal(step.state.belief.mass, even.updated(evidence, 0).mass)
    assert step.plan is None


def test_views_of_one_place_share_their_errors_and_those_far_apart_do_not(snapshots):
    map_ = snapshots()
    assert map_.shared_error_after(0.0) == 1
    assert 0 < map_.shared_error_after(5.0) < map_.shared_error_after(1.0) < 1
    assert map_.shared_error_after(-2.0) == map_.shared_error_after(2.0)
    assert map_.alike_after(0.0) == 1


def test_while_it_stands_its_statistics_rest(snapshots, queries):
    localizer = ActiveLocalizer(snapshots(), LocalizerConfig())
    state = walk(localizer, queries, [10, 15])
    standing_state = localizer.step(state, queries[15], 0.0).state
    assert standing_state.live.encodings.weight == state.live.encodings.weight
    moving_state = localizer.step(state, queries[20], 5.0).state
    assert moving_state.live.encodings.weight > state.live.encodings.weight + 0.5


@pytest.mark.parametrize("relevance", list(Relevance))
@pytest.mark.parametrize("kind", list(FilterKind))
def test_every_relevance_and_filter_finds_the_way(snapshots, queries, relevance, kind):
    snapshot = snapshots(relevance)
    localizer = ActiveLocalizer(snapshot, LocalizerConfig(kind, n_particles=3000))
    errors, entropy_drops = [], []
    for start in range(0, 90, 15):
        state = walk(localizer, queries, [start])
        entropy_drops.append(entropy(state.belief.mass))
        state = walk(localizer, queries, list(range(start, start + 55, 5)), localizer.start())
        errors.append(abs(int(state.belief.mass.argmax()) - (start + 50)))
        entropy_drops[-1] -= entropy(state.belief.mass)
        assert state.belief.mass.sum() == pytest.approx(1)
    assert np.median(errors) <= 1, errors
    assert np.mean(entropy_drops) > 0, "it is surer after ten moves"


def test_a_chosen_update_and_planner_are_used(snapshots, queries):
    snapshot = snapshots(Relevance.RRF)
    default_step = ActiveLocalizer(snapshot, LocalizerConfig()).step
    localizer = ActiveLocalizer(snapshot, LocalizerConfig(update=UpdateRule.LOG_LIKELIHOOD, planner="constant:2"))
    start = localizer.start()
    step = localizer.step(start, queries[5])
    assert step.plan is not None
    assert (step.plan.planner, step.plan.action_m) == ("constant:2", 2.0)
    assert not np.allclose(step.state.belief.mass, default_step(start, queries[5]).state.belief.mass)
    with pytest.raises(InvalidInputError):
        ActiveLocalizer(snapshot, LocalizerConfig(planner="constant:3"))


# --- priors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_robot_that_was_carried_keeps_what_is_usual(snapshots, queries, kind):
    localizer = ActiveLocalizer(snapshots(), LocalizerConfig(kind))
    state = walk(localizer, queries, [10, 15, 20])
    carried_state = localizer.with_prior(state, 100.0, 2.0)
    assert abs(int(carried_state.belief.mass.argmax()) - 100) <= 2
    assert carried_state.live is state.live
    assert carried_state.n_observations == 3
    next_state = localizer.step(carried_state, queries[105], 5.0).state
    assert abs(int(next_state.belief.mass.argmax()) - 105) <= 4


# --- views that say nothing -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("relevance", list(Relevance))
def test_a_view_that_shows_nothing_moves_no_belief(snapshots, queries, kind, relevance):
    localizer = ActiveLocalizer(snapshots(relevance), LocalizerConfig(kind))
    grey = Query.uninformative(N_LANDMARKS)
    first = localizer.step(localizer.start(), grey)
    np.testing.assert_allclose(first.state.belief.mass, localizer.start().belief.mass)
    state = walk(localizer, queries, [10, 15, 20], localizer.start(10.0, 0.5))
    standing_step = localizer.step(state, grey, 0.0)
    assert entropy(standing_step.state.belief.mass) >= entropy(state.belief.mass) - (
        1e-9 if kind is FilterKind.GRID else 0.1
    )
    assert standing_step.state.belief.mass.argmax() == state.belief.mass.argmax()
    assert standing_step.state.live is state.live
    moving_step = localizer.step(state, grey, 5.0)
    assert abs(int(moving_step.state.belief.mass.argmax()) - (int(state.belief.mass.argmax()) + 5)) <= 1
    assert standing_step.state.n_observations == 4


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_view_is_as_new_as_the_way_from_the_last_that_showed_a_place(snapshots, queries, kind):
    """Whether the robot moved before or after it saw nothing: where it stands again it is not where that view was."""
    localizer, grey = ActiveLocalizer(snapshots(), LocalizerConfig(kind)), Query.uninformative(N_LANDMARKS)
    beliefs = []
    for moves_m in ([5.0, 0.0], [0.0, 5.0]):
        state = walk(localizer, queries, [10, 15])
        for query, action_m in zip((grey, queries[20]), moves_m, strict=True):
            state = localizer.from_arrays(localizer.to_arrays(state))
            state = localizer.observe(state, query, action_m).state
        beliefs.append(state.belief)
    first_log_trust, second_log_trust = (belief.doubt.log_trust for belief in beliefs)
    # Where the last move alone counts they are 2 and more apart
    np.testing.assert_allclose(first_log_trust, second_log_trust, atol=0.2)


def test_noise_tells_nothing_of_a_route_and_an_odd_season_does():
    """A route of 400 numbers that few causes vary; noise shows what no place does, the same wherever the robot is."""
    rng = np.random.default_rng(6)
    causes = rng.normal(size=(20, 400))
    place = np.maximum(rng.normal(size=(N_IMAGES, 20)) @ causes, 0)  # as of a network: many numbers are 0
    map_ = compose_map(MapPlan(Relevance.COMPOSED, LIST_LENGTH, ACTIONS_M), frames(place), None, None, N_LANDMARKS).map
    localizer = ActiveLocalizer(map_, LocalizerConfig())
    noise = np.abs(rng.normal(0, 4 * place.std(), 400))
    season_shift = np.where(rng.random(400) < 0.1, rng.normal(0, 3, 400), 0) * place.std(axis=0)  # of a season
    encodings = np.concatenate([np.tile(noise, (60, 1)) + rng.normal(0, 0.3, (60, 400)), place[:60] + season_shift])
    views = [
        Query(np.arange(1.0, N_LANDMARKS + 1, dtype=np.float32), None, view) for view in encodings.astype(np.float32)
    ]
    state = localizer.start()
    for number, view in enumerate(views):
        step = localizer.step(state, view, 1.0)
        assert step.is_informative == (number >= 60)
        state = step.state
        if number < 60:
            assert entropy(state.belief.mass) > math.log2(N_IMAGES) - 1
    assert abs(int(state.belief.mass.argmax()) - 59) <= 1
    drive = np.concatenate([place, encodings[:3]]).astype(np.float32)
    assert np.flatnonzero(shows_nothing(lambda: [drive])).tolist() == [150, 151, 152]


def test_a_season_that_is_stranger_than_any_known_is_soon_believed():
    rng = np.random.default_rng(7)
    place = rng.normal(size=(N_IMAGES, 400))
    map_ = compose_map(MapPlan(Relevance.COMPOSED, LIST_LENGTH, ACTIONS_M), frames(place), None, None, 60).map
    localizer = ActiveLocalizer(map_, LocalizerConfig())
    shift = np.where(np.arange(400) < 120, 3.0, 0.0)
    is_informative, state = [], localizer.start()
    for view in (place + shift + rng.normal(0, 0.2, place.shape)).astype(np.float32)[:80]:
        step = localizer.step(state, Query(np.arange(1.0, 61, dtype=np.float32), None, view), 1.0)
        is_informative.append(step.is_informative)
        state = step.state
    assert not any(is_informative[:15])
    assert all(is_informative[30:])
    assert abs(int(state.belief.mass.argmax()) - 79) <= 1
