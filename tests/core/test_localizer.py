"""The algorithm on one page against straight-line code; restoring, priors, views that say nothing, the end."""

import itertools
import math
from statistics import NormalDist

import numpy as np
import pytest

from deepsimbad.core.belief import FilterKind
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.off_route import OffRouteModel
from deepsimbad.core.relevance import Query, Relevance, UpdateRule
from deepsimbad.errors import InvalidInputError, PastTheEndError
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.build import build

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


@pytest.fixture(scope="module")
def snapshots(seasons):
    landmarks, training, _ = seasons
    model = EVALUATOR.fit_landmarks(landmarks[:N_LANDMARKS].astype(np.float32))

    def make(relevance=Relevance.CALIBRATED, closed=False):
        drives = (frames(training), frames(landmarks))
        how = (model, relevance, LIST_LENGTH, ACTIONS_M, closed, lambda _: None)
        return build(*drives, True, EVALUATOR, *how).map

    return make


@pytest.fixture(scope="module")
def queries(seasons, snapshots):
    encodings = seasons[2].astype(np.float32)
    dissimilarities = EVALUATOR.dissimilarities(encodings, snapshots().landmark_model)
    return [Query(*each) for each in zip(rank_landmarks(dissimilarities), dissimilarities, encodings, strict=True)]


def walk(localizer, queries, frames, state=None):
    """The state after a view of every frame, moving exactly between them."""
    state = localizer.start() if state is None else state
    before = frames[0]
    for frame in frames:
        state = localizer.step(state, queries[frame], float((frame - before) % N_IMAGES)).state
        before = frame
    return state


def entropy(mass):
    return float(-sum(m * math.log2(m) for m in mass.tolist() if m > 0))


# --- describe, retrieve, predict, update, plan ---------------------------------------------------------------------


def slow_prediction(mass, action_m, std_m, closed):
    """Images are one metre apart."""
    n = len(mass)
    moved = [0.0] * n
    whole, part = int(action_m), action_m - int(action_m)
    for image in range(n):
        for step, share in ((whole, 1 - part), (whole + 1, part)):
            if share and (closed or image + step < n):
                moved[(image + step) % n] += mass[image] * share
    total = sum(moved)
    blurred = [0.0] * n
    for image in range(n):
        reach = range(-int(4 * std_m), int(4 * std_m) + 1)
        weights = {d: math.exp(-0.5 * (d / std_m) ** 2) for d in reach if closed or 0 <= image + d < n}
        for d, weight in weights.items():
            blurred[(image + d) % n] += moved[image] / total * weight / sum(weights.values())
    return blurred


def slow_step(snapshot, mass, moments, query, action_m, closed):
    """(mass, predicted, relevance); `moments` are (weight, mean, square), moved on in place."""
    score = [NormalDist().inv_cdf((rank - 0.5) / N_LANDMARKS) for rank in query.ranks.tolist()]
    n, mean, square = moments
    mean = [(n * m + s) / (n + 1) for m, s in zip(mean, score, strict=True)]
    square = [(n * q + s * s) / (n + 1) for q, s in zip(square, score, strict=True)]
    moments[:] = n + 1, mean, square
    z = [(s - m) / math.sqrt(q - m * m) for s, m, q in zip(score, mean, square, strict=True)]
    assert snapshot.correlation is not None
    assert snapshot.listed_score is not None
    relevance = []
    for image in range(N_IMAGES):
        total = 0.0
        for rank, landmark in enumerate(snapshot.lists[:, image].tolist()):
            expected = snapshot.correlation[landmark] * snapshot.listed_score[rank, landmark]
            total += expected * z[landmark] - expected**2 / 2
        relevance.append(total)
    predicted = mass
    if action_m is not None:
        predicted = slow_prediction(mass, action_m, math.sqrt(0.0025 + 0.01 * action_m), closed)
    weighed = [m * math.exp(0.3 * r) for m, r in zip(predicted, relevance, strict=True)]
    return [w / sum(weighed) for w in weighed], predicted, relevance


@pytest.mark.parametrize("closed", [False, True])
def test_a_step_is_describe_retrieve_predict_update_plan(snapshots, queries, closed):
    snapshot = snapshots(closed=closed)
    ticks = itertools.count()
    localizer = ActiveLocalizer(snapshot, LocalizerConfig(), lambda: float(next(ticks)))
    state = localizer.start()
    statistics = snapshot.landmark_statistics
    assert statistics is not None
    moments = [20.0, statistics.mean.tolist(), statistics.square.tolist()]
    mass, off_route = (1 / N_IMAGES * np.ones(N_IMAGES)).tolist(), 0.02
    position_m = 120.0 if closed else 20.0
    for action_m in (None, 5.0, 1.0, 2.0, 10.0, 0.0, 20.0):
        position_m += action_m or 0.0
        query = queries[int(position_m) % N_IMAGES]
        step = localizer.step(state, query, 77.0 if action_m is None else action_m)  # the first move is ignored
        mass, predicted, relevance = slow_step(snapshot, mass, moments, query, action_m, closed)
        assert step.state.relevance is not None
        np.testing.assert_allclose(step.state.relevance, relevance, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(step.state.belief.mass, mass, rtol=1e-3, atol=1e-9)
        if action_m is not None:
            likelihood = np.exp(0.3 * np.array(relevance))
            agreement = math.log(np.dot(predicted, likelihood) / likelihood.mean())
            model = OffRouteModel.of(snapshot)
            assert model is not None
            log_odds = min(3, max(-3, model.intercept + model.slope * agreement))
            moved = off_route * 0.95 + (1 - off_route) * 0.01
            off_route = moved * math.exp(log_odds) / (moved * math.exp(log_odds) + 1 - moved)
        assert step.state.off_route == pytest.approx(off_route, rel=1e-3)
        assert snapshot.bits_ahead is not None
        doubt = -math.log2(np.square(mass).sum()) / math.log2(len(mass))
        mean_bits = [np.dot(mass, snapshot.bits_ahead[:, i]) for i in range(len(ACTIONS_M))]
        values = [0.12 * a + math.sqrt(doubt) * bits for a, bits in zip(ACTIONS_M, mean_bits, strict=True)]
        assert step.plan is not None
        assert step.plan.values is not None
        np.testing.assert_allclose(step.plan.values, values, rtol=1e-4)
        assert step.plan.action_m == ACTIONS_M[int(np.argmax(values))]
        again = localizer.plan(step.state)
        assert again is not None
        assert again.action_m == step.plan.action_m
        assert step.timings_ms == dict.fromkeys(("retrieve", "predict", "update", "plan"), 1000)
        state = step.state
    assert int(state.belief.mass.argmax()) == int(position_m) % N_IMAGES
    assert state.n_observations == 7


@pytest.mark.parametrize("relevance", list(Relevance))
@pytest.mark.parametrize("kind", list(FilterKind))
def test_every_relevance_and_filter_finds_the_way(snapshots, queries, relevance, kind):
    snapshot = snapshots(relevance)
    localizer = ActiveLocalizer(snapshot, LocalizerConfig(kind, n_particles=3000))
    errors, before = [], []
    for start in range(0, 90, 15):
        state = walk(localizer, queries, [start])
        before.append(entropy(state.belief.mass))
        state = walk(localizer, queries, list(range(start, start + 55, 5)), localizer.start())
        errors.append(abs(int(state.belief.mass.argmax()) - (start + 50)))
        before[-1] -= entropy(state.belief.mass)
        assert state.belief.mass.sum() == pytest.approx(1)
    assert np.median(errors) <= 1, errors
    assert np.mean(before) > 0, "it is surer after ten moves"


def test_a_chosen_update_and_planner_are_used(snapshots, queries):
    snapshot = snapshots(Relevance.RRF)
    usual = ActiveLocalizer(snapshot, LocalizerConfig()).step
    chosen = ActiveLocalizer(snapshot, LocalizerConfig(update=UpdateRule.LOG_LIKELIHOOD, planner="constant:2"))
    start = chosen.start()
    step = chosen.step(start, queries[5])
    assert step.plan is not None
    assert (step.plan.planner, step.plan.action_m) == ("constant:2", 2.0)
    assert not np.allclose(step.state.belief.mass, usual(start, queries[5]).state.belief.mass)
    with pytest.raises(InvalidInputError):
        ActiveLocalizer(snapshot, LocalizerConfig(planner="constant:3"))


def test_a_map_of_one_season_knows_no_telling_places(snapshots, queries):
    step = ActiveLocalizer(snapshots(Relevance.STANDARDISED), LocalizerConfig())
    after = step.step(step.start(), queries[9])
    assert after.state.off_route is None
    assert after.plan is not None
    assert (after.plan.action_m, after.plan.values) == (5.0, None)


# --- nothing is lost -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("relevance", [Relevance.CALIBRATED, Relevance.SIMBAD])
def test_a_restored_state_goes_on_bit_for_bit(snapshots, queries, kind, relevance):
    localizer = ActiveLocalizer(snapshots(relevance), LocalizerConfig(kind, seed=5, n_particles=200))
    for visited in ([], [10], [10, 15, 17, 27]):
        state = walk(localizer, queries, visited) if visited else localizer.start()
        stored = {
            name: np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)
            for name, array in localizer.to_arrays(state).items()
        }
        restored = localizer.from_arrays(stored)
        same(localizer, state, restored)
        same(localizer, *(walk(localizer, queries, [27, 32], each) for each in (state, restored)))


def same(localizer, one, other):
    expected, again = localizer.to_arrays(one), localizer.to_arrays(other)
    assert again.keys() == expected.keys()
    for name, array in expected.items():
        assert array.tobytes() == again[name].tobytes(), name


# --- priors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_start_around_a_position(snapshots, kind):
    mass = ActiveLocalizer(snapshots(), LocalizerConfig(kind)).start(70.0, 4.0).belief.mass
    x = np.arange(N_IMAGES)
    assert mass @ x == pytest.approx(70, abs=0.5)
    assert np.sqrt(mass @ (x - mass @ x) ** 2) == pytest.approx(4, abs=0.4)


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_robot_that_was_carried_keeps_what_is_usual(snapshots, queries, kind):
    localizer = ActiveLocalizer(snapshots(), LocalizerConfig(kind))
    state = walk(localizer, queries, [10, 15, 20])
    carried = localizer.with_prior(state, 100.0, 2.0)
    assert abs(int(carried.belief.mass.argmax()) - 100) <= 2
    assert carried.live is state.live
    assert carried.n_observations == 3
    after = localizer.step(carried, queries[105], 5.0).state
    assert abs(int(after.belief.mass.argmax()) - 105) <= 4


# --- views that say nothing, and the end ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("relevance", list(Relevance))
def test_a_view_that_shows_nothing_moves_no_belief(snapshots, queries, kind, relevance):
    localizer = ActiveLocalizer(snapshots(relevance), LocalizerConfig(kind))
    grey = Query.uninformative(N_LANDMARKS)
    first = localizer.step(localizer.start(), grey)
    np.testing.assert_allclose(first.state.belief.mass, localizer.start().belief.mass)
    state = walk(localizer, queries, [10, 15, 20], localizer.start(10.0, 0.5))
    stood = localizer.step(state, grey, 0.0)
    assert entropy(stood.state.belief.mass) >= entropy(state.belief.mass) - (1e-9 if kind is FilterKind.GRID else 0.1)
    assert stood.state.belief.mass.argmax() == state.belief.mass.argmax()
    assert stood.state.live is state.live
    moved = localizer.step(state, grey, 5.0)
    assert abs(int(moved.state.belief.mass.argmax()) - (int(state.belief.mass.argmax()) + 5)) <= 1
    assert stood.state.n_observations == 4


def test_nothing_seen_says_nothing_of_the_route(snapshots, queries):
    localizer = ActiveLocalizer(snapshots(), LocalizerConfig())
    state = walk(localizer, queries, [10, 15, 20])
    assert state.off_route is not None
    grey = localizer.step(state, Query.uninformative(N_LANDMARKS), 5.0).state.off_route
    assert grey == pytest.approx(state.off_route * 0.95 + (1 - state.off_route) * 0.01)


@pytest.mark.parametrize("kind", list(FilterKind))
def test_past_the_end_of_an_open_route(snapshots, queries, kind):
    localizer = ActiveLocalizer(snapshots(), LocalizerConfig(kind))
    state = localizer.step(localizer.start(145.0, 0.5), queries[145]).state
    with pytest.raises(PastTheEndError):
        localizer.step(state, queries[149], 20.0)
    around = ActiveLocalizer(snapshots(closed=True), LocalizerConfig(kind))
    state = around.step(around.start(145.0, 0.5), queries[145]).state
    assert abs(int(around.step(state, queries[15], 20.0).state.belief.mass.argmax()) - 15) <= 1


@pytest.mark.parametrize("relevance", [Relevance.SIMBAD, Relevance.BRUTE_FORCE])
def test_ranks_alone_cannot_answer_maps_that_compare_more(snapshots, queries, relevance):
    localizer = ActiveLocalizer(snapshots(relevance), LocalizerConfig())
    with pytest.raises(InvalidInputError):
        localizer.step(localizer.start(), Query(queries[3].ranks))
