"""Which live images a map is trained on, and what remaps keep of it."""

from dataclasses import replace
from functools import partial
from itertools import repeat

import numpy as np
import pytest

from deepsimbad.core.building import MapPlan, build_map, compose_map
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.experience.nnql import KnownWalk, NnqlConfig
from deepsimbad.core.experience.training import TrainingWorld
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.errors import CancelledError
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.space import OwnDissimilarities
from deepsimbad.jobs.build import HELD_OUT, SECOND_DRIVE, build, train_nnql
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import REMAP_STAGES
from deepsimbad.jobs.versions import LEARN_STAGES, learn_online

from .conftest import DOMAIN

N, R = 90, 20


def drives(noise: float = 0.4, seed: int = 0) -> tuple[Drive, Drive]:
    """The map's own drive and a second one of the same places."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(N, R))

    def season() -> Drive:
        views = (places + noise * rng.normal(size=(N, R))).astype(np.float32)
        return Drive(position_m=np.arange(N, dtype=float), encodings=views, dissimilarities=views)

    return season(), season()


def train_map(relevance=Relevance.RRF, second=None, map_drive=None, config=None, on_progress=lambda _: None):
    map_drive, actions_m, config = map_drive or drives()[0], (1.0, 2.0, 5.0), config or NnqlConfig(n_episodes=200)
    if relevance is Relevance.COMPOSED:
        map_build = compose_map(MapPlan(relevance, 4, actions_m, same_route=True), map_drive, second, second, R)
        return train_nnql(map_build.rehearsal, map_build.map_drive, map_build.second, config, on_progress)
    map_ = replace(build_map(relevance, map_drive, 4), actions_m=np.array(actions_m))
    return train_nnql(map_, map_drive, second, config, on_progress)


@pytest.fixture
def worlds(monkeypatch):
    """Every world that training makes: its map, views and the route they lie on."""
    arguments = []
    on = TrainingWorld.on

    def recording(map_, views, live_route, *rest):
        arguments.append((map_, views, live_route))
        return on(map_, views, live_route, *rest)

    monkeypatch.setattr(TrainingWorld, "on", recording)
    return arguments


def test_a_second_drive_of_the_route_gives_the_live_images(worlds):
    map_drive, second = drives()
    q_values, metrics = train_map(second=second, map_drive=map_drive)
    assert (metrics["live_images"], metrics["n_episodes"]) == (SECOND_DRIVE, 200)
    ((map_, views, _),) = worlds
    assert map_.n_images == N
    assert views.dissimilarities is second.dissimilarities
    assert (q_values.shape, q_values.dtype) == ((N, 3), np.float32)
    assert (q_values > 1).mean() > 0.5


def test_an_evaluator_of_dissimilarities_of_its_own_is_rehearsed_with_the_landmarks_of_the_rehearsal():
    class Cubes(OwnDissimilarities, FeatureL2):
        def own_dissimilarities(self, encodings, model):  # its landmarks are the axes
            return np.abs(encodings) ** 3

    map_drive, second = drives()
    map_build = build(
        MapPlan(Relevance.COMPOSED, 4, (1.0,), same_route=True), map_drive, second, None, R, Cubes("none")
    )
    model = map_build.rehearsal.landmark_model
    np.testing.assert_array_equal(model["prototypes"], map_build.initial_landmarks)


def test_else_alternate_frames_are_held_out_of_the_map_they_look_at(worlds):
    map_drive, _ = drives()
    q_values, metrics = train_map(map_drive=map_drive)
    assert metrics["live_images"] == HELD_OUT
    assert len(metrics["curves"]) == len(worlds) == 2
    for map_, _, live_route in worlds:
        assert not set(map_.position_m) & set(live_route.position_m), "a live image is a map image"
        assert map_.n_images == N // 2
        for image, position_m in enumerate(map_.position_m):  # the half's lists are those of its frames
            nearest = np.argsort(map_drive.dissimilarities[int(position_m)], kind="stable")[:4]
            assert map_.lists[:, image].tolist() == nearest.tolist()
    touched = (q_values != np.float32(1e-4)).any(axis=1)
    assert touched[::2].mean() > 0.5
    assert touched[1::2].mean() > 0.5


@pytest.mark.parametrize("relevance", list(Relevance))
def test_maps_for_every_relevance_learn(relevance):
    map_drive, second = drives()
    for live in (None, second):
        q_values, _ = train_map(relevance, live, map_drive, NnqlConfig(n_episodes=40))
        assert np.isfinite(q_values).all()
        assert (q_values > 1).any()


def test_small_maps_take_fewer_episodes_and_one_image_none():
    map_drive, _ = drives()
    assert train_map(map_drive=map_drive.at(np.arange(6)), config=NnqlConfig())[1]["n_episodes"] == 150
    q_values, metrics = train_map(map_drive=map_drive.at(np.arange(1)))
    assert q_values.tolist() == [[np.float32(1e-4)] * 3]
    assert metrics["curves"] == []
    untrained, _ = train_map(second=drives()[1], config=NnqlConfig(n_episodes=0))
    assert (untrained == np.float32(1e-4)).all()


def test_progress_rises_and_a_cancel_gets_through():
    for second in (None, drives()[1]):
        shares: list[float] = []
        train_map(second=second, on_progress=shares.append)
        assert shares == sorted(shares)
        assert shares[-1] == 1.0

        def cancel(share: float) -> None:
            raise CancelledError("asked to stop")

        with pytest.raises(CancelledError):
            train_map(second=second, on_progress=cancel)


def test_a_remap_stores_what_it_learnt(catalog, two_drives, run, contents):
    config = {"landmark_traverse": "other", "n_landmarks": 8}
    stages: list[str] = []
    progress = Progress(REMAP_STAGES, lambda state: stages.append(state.stage))
    training = run("drive", progress=progress, **config)["metrics"]["training"]
    assert "train" in stages
    assert (training["n_episodes"], training["live_images"]) == (300, HELD_OUT)
    assert all(0 <= share <= 1 for curve in training["curves"] for share in curve["reward_share"])
    assert training["hyperparameters"]["learning_rate"] == 0.1
    assert catalog.map(DOMAIN, 1).metrics["training"] == training
    for seed in (0, 1):
        run("drive", seed=seed, **config)
    q_values = [contents(version).q_values for version in (1, 2, 3)]
    assert q_values[0].shape == (12, 2)
    assert [np.array_equal(values, q_values[0]) for values in q_values] == [True, True, False]


def test_a_cancel_of_learning_from_a_session_leaves_nothing(catalog, two_drives, run, contents, evaluator):
    """One along a mapped route, that saw just what the map saw."""
    run("drive", landmark_traverse="other", n_landmarks=8, training_episodes=0)
    frames = np.arange(1, 11, 2)
    ranks = rank_landmarks(evaluator.dissimilarities(two_drives[1][frames], contents(1).landmark_model))
    walk = KnownWalk([Query(row) for row in ranks], np.full(frames.size, 2.0), frames.astype(float))
    for answers in (repeat(True), iter([False, False, False, True])):
        with pytest.raises(CancelledError):
            learn_online(catalog, DOMAIN, [walk], Progress(LEARN_STAGES, is_cancelled=partial(next, answers)))
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]
    assert catalog.domain(DOMAIN).active_version == 1
