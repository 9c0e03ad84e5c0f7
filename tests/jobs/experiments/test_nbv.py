"""The active experiment: in the paper's set-up against a slow reference, on random and on real data; the report."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.errors import CancelledError, InvalidMapConfigError
from deepsimbad.jobs.build import encode_recording
from deepsimbad.jobs.experiments.nbv import Episode, NbvConfig, NbvReport, nbv_stages, run_nbv
from deepsimbad.jobs.progress import Progress
from deepsimbad_client.recordings.sources import open_source

QUICK = NbvConfig(n_landmarks=40, actions_m=(1.0, 2.0, 4.0), n_steps=4, training_episodes=60, episodes=60)
PLANNERS = {"random", "constant_1", "constant_2", "constant_4", "clairvoyant", "nnql", "informed"}


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """One route in three seasons, a metre between frames."""
    folder = tmp_path_factory.mktemp("nbv")
    rng = np.random.default_rng(0)
    places = rng.normal(size=(110, 8))
    for role, noise in (("landmarks", 0.4), ("training", 0.2), ("test", 1.0)):
        np.save(folder / f"{role}.npy", (places + noise * rng.normal(size=places.shape)).astype(np.float32))
    return {role: str(folder / f"{role}.npy") for role in ("landmarks", "training", "test")}


def experiment(sources, evaluator, config, progress=None, spacing_m=1.0):
    triplet = [
        encode_recording(open_source(sources[role], spacing_m=spacing_m), evaluator, 1, lambda _: None).drive
        for role in ("landmarks", "training", "test")
    ]
    return run_nbv(config, evaluator, *triplet, progress or Progress(nbv_stages(config)))


@pytest.fixture(scope="module")
def report(drives, evaluator) -> NbvReport:
    return experiment(drives, evaluator, QUICK)


# --- the slow reference: the paper's relevance, update and motion on frames a metre apart, nothing of the product's --


def slow_paper(rows, config, moves):
    """Rank shares [episodes, steps] where episode e makes moves[e] from the e-th start."""
    candidates, map_rows, live = rows
    distances = np.array([((candidates - row) ** 2).sum(axis=1) for row in candidates])
    np.fill_diagonal(distances, np.inf)
    landmark_rows = sorted(range(len(candidates)), key=lambda c: (-distances[c].min(), c))[: config.n_landmarks]
    landmarks = candidates[landmark_rows]

    def ranks_of(encodings):
        order = [np.argsort(((landmarks - row) ** 2).sum(axis=1), kind="stable") for row in encodings]
        return np.argsort(order, axis=1) + 1

    map_ranks, live_ranks = ranks_of(map_rows), ranks_of(live)
    features = np.where(map_ranks <= config.list_length, 1 / map_ranks, 0.0)
    relevance = (1 / live_ranks) @ features.T  # [frames, images]
    n = len(map_rows)
    last_start = len(live) - 1 - config.n_steps * int(max(config.actions_m))
    starts = np.random.default_rng(config.seed).choice(np.arange(last_start + 1), config.episodes)
    off = np.subtract.outer(np.arange(n), np.arange(n))
    blur = np.where(np.abs(off) <= 4 * 0.7, np.exp(-0.5 * (off / 0.7) ** 2), 0.0)
    blur /= blur.sum(axis=1, keepdims=True)
    shares = np.empty((config.episodes, config.n_steps))
    for episode, start in enumerate(starts):
        frame = int(start)
        weights = np.full(n, 1.0) + relevance[frame]
        belief = weights / weights.sum()
        for step, action in enumerate(moves[episode]):
            frame += int(action)
            shifted = np.zeros(n)
            shifted[int(action) :] = belief[: n - int(action)]
            weights = n * (shifted / shifted.sum()) @ blur + relevance[frame]
            belief = weights / weights.sum()
            tied = np.isclose(belief, belief[frame], rtol=1e-7, atol=0)
            shares[episode, step] = ((belief[~tied] > belief[frame]).sum() + 0.5 * (tied.sum() - 1)) / n
    return shares


def shares_of(episodes):
    """[episodes, steps] rank shares."""
    return np.array([episode.rank_share for episode in episodes])


def test_the_papers_set_up_agrees_with_the_slow_reference(drives, report):
    rows = [np.load(drives[role]).astype(np.float64) for role in ("landmarks", "training", "test")]
    # The random planner's moves depend on the seed alone, not on what is believed.
    moves_of = {
        "random": np.diff([episode.travelled_m for episode in report.paper_episodes["random"]], axis=1, prepend=0)
    }
    assert set(np.unique(moves_of["random"])) == set(QUICK.actions_m)
    moves_of |= {f"constant_{action_m:g}": np.full_like(moves_of["random"], action_m) for action_m in QUICK.actions_m}
    for planner, moves in moves_of.items():
        expected, measured = slow_paper(rows, QUICK, moves), shares_of(report.paper_episodes[planner])
        assert expected.mean() > 0.01, "all were found, so nothing was compared"
        np.testing.assert_allclose(measured, expected, atol=1.01 / 110)
        assert measured.mean() == pytest.approx(expected.mean(), abs=2e-4)


@pytest.mark.slow
@pytest.mark.real_data
def test_real_netvlad_in_order_of_what_they_know(real_data, evaluator):
    folder, roles = real_data / "nordland_netvlad64", ("landmarks", "training", "test")
    sources = {role: str(folder / f"{name}.npy") for role, name in zip(roles, ("nr", "nq", "nq2"), strict=True)}
    report = experiment(sources, evaluator, NbvConfig(episodes=75, training_episodes=500))
    mean, paper = (
        {name: shares_of(episodes).mean() for name, episodes in setup.items()}
        for setup in (report.our_episodes, report.paper_episodes)
    )
    assert mean["clairvoyant"] < mean["informed"] < mean["random"]
    assert all(mean[name] < paper[name] for name in mean)
    rows = [np.load(path).astype(np.float64) for path in sources.values()]
    expected = slow_paper(rows, report.config, np.full((75, 10), 5.0))
    assert 100 * paper["constant_5"] == pytest.approx(100 * expected.mean(), abs=0.01)


# --- what is compared ----------------------------------------------------------------------------------------------


def test_every_planner_has_the_same_starts(drives, report, evaluator):
    """With one move to choose from, all planners are one."""
    config = replace(QUICK, actions_m=(2.0,), episodes=20)
    only = experiment(drives, evaluator, config)
    for setup in (only.our_episodes, only.paper_episodes):
        for name, episodes in setup.items():
            np.testing.assert_array_equal(shares_of(episodes), shares_of(setup["constant_2"]), err_msg=name)
    assert set(report.config.actions_m) == {1, 2, 4}, "the other tests are of several moves"


def test_the_truth_is_the_map_image_nearest_in_metres(drives, evaluator):
    """Part of the mapped drive itself, driven again: frame i of the test is not map image i."""
    config = replace(QUICK, episodes=30, training_episodes=0)
    report = experiment({**drives, "test": drives["training"] + "#31:90:2"}, evaluator, config)
    assert shares_of(report.our_episodes["constant_4"]).mean() < 0.002
    assert shares_of(report.paper_episodes["constant_4"]).mean() < 0.02


def test_a_test_drive_too_short_is_named(drives, evaluator):
    short = {**drives, "test": drives["test"] + "#:16"}
    with pytest.raises(InvalidMapConfigError, match="16 m"):
        experiment(short, evaluator, QUICK)


def test_stages_are_reported_and_the_whole_can_be_cancelled(drives, evaluator):
    states = []
    experiment(drives, evaluator, replace(QUICK, episodes=5), Progress(nbv_stages(QUICK), states.append))
    assert list(dict.fromkeys(state.stage for state in states)) == list(nbv_stages(QUICK))
    stop = Progress(nbv_stages(QUICK), None, lambda: True)
    with pytest.raises(CancelledError):
        experiment(drives, evaluator, QUICK, stop)


# --- the report ----------------------------------------------------------------------------------------------------


def test_the_document_tells_what_was_measured(report):
    document = report.as_dict({"training": "here"})
    for name, episodes in report.our_episodes.items():
        shares = shares_of(episodes)
        assert document["anr"][name] == pytest.approx(100 * shares.mean())
        assert document["anr_paper"][name] == pytest.approx(100 * shares_of(report.paper_episodes[name]).mean())
        low, high = document["interval_95"][name]
        assert low <= document["anr"][name] <= high
        assert document["anr_by_step"][name] == pytest.approx([100 * shares[:, step].mean() for step in range(4)])
        for figure, part in (("views_to_confident", "views"), ("metres_to_confident", "metres")):
            assert document[figure][name] == pytest.approx(
                np.mean([getattr(one_episode, part) for one_episode in episodes])
            )
            low, high = document[figure]["interval_95"][name]
            assert low <= document[figure][name] <= high
        assert document["wrong_when_confident"][name] == 100 * np.mean([episode.is_wrong for episode in episodes])
    assert document["default"] == "informed"
    views = document["views_to_confident"]
    assert document["best_constant"] == min((name for name in views if name.startswith("constant")), key=views.get)
    rivals = {"informed - random", f"informed - {document['best_constant']}"}
    assert set(document["difference_95"]) == set(document["views_difference_95"]) == rivals
    assert document["n_episodes"] == 60
    assert document["config"]["training"] == "here"
    assert document["config"]["actions_m"] == (1.0, 2.0, 4.0)


def episodes(shares, travelled_m=None, views=None):
    """One episode for every row of rank shares [episodes, steps]."""
    travelled_m = np.ones_like(shares) if travelled_m is None else travelled_m
    views = np.ones(len(shares)) if views is None else views
    return [Episode(*fields, metres=0.0, is_wrong=False) for fields in zip(shares, travelled_m, views, strict=True)]


def test_differences_are_those_of_the_same_starts():
    """The default is better by one hundredth everywhere; how hard a start is does not blur that."""
    hard = np.random.default_rng(0).random((200, 3)) / 2
    views = 20 * hard[:, 0]
    by_planner = {
        "informed": episodes(hard, views=views),
        "random": episodes(hard + 0.01, views=views + 3),
        "constant_1": episodes(hard, views=views + 2),
        "constant_9": episodes(hard + 0.02, views=views + 1),
    }
    report = NbvReport(QUICK, by_planner, by_planner, np.arange(200) // 20)
    document = report.as_dict({})
    assert document["difference_95"]["informed - random"] == pytest.approx([-1, -1])
    assert document["difference_95"]["informed - constant_9"] == pytest.approx([-2, -2])
    assert document["views_difference_95"]["informed - random"] == pytest.approx([-3, -3])
    assert report.best_constant == "constant_9", "it takes the fewest views"


def test_starts_of_one_stretch_count_as_one():
    """Equal episodes of one stretch of 20 m do not make an interval narrower than stretches do."""
    shares = np.repeat(np.random.default_rng(0).random((10, 3)), 20, axis=0)
    by_planner = dict.fromkeys(("informed", "random", "constant_1"), episodes(shares))

    def width(block):
        low, high = NbvReport(QUICK, by_planner, by_planner, block).as_dict({})["interval_95"]["random"]
        return high - low

    assert width(np.arange(200) // 20) > 2 * width(np.arange(200))


def test_at_a_distance_the_last_view_before_it_counts():
    shares = np.array([[0.5, 0.4, 0.3], [0.6, 0.2, 0.1], [0.9, 0.9, 0.9]])
    travelled = np.array([[4.0, 9.0, 12.0], [10.0, 20.0, 30.0], [1.0, 2.0, 3.0]])
    by_planner = dict.fromkeys(("informed", "random", "constant_1"), episodes(shares, travelled))
    document = NbvReport(QUICK, by_planner, by_planner, np.arange(3)).as_dict({})
    at = document["anr_at_distance_m"]["random"]
    # 10 m: the second view of the first episode (9 m), the first of the second; the third never went so far
    assert at["10"] == pytest.approx(100 * (0.4 + 0.6) / 2)
    assert at["20"] == pytest.approx(100 * 0.2)
    assert at["50"] is None
