"""Which live images a map is trained on, and what remaps keep of it."""

from functools import partial

import numpy as np
import pytest

from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.training_world import TrainingWorld
from deepsimbad.errors import CancelledError
from deepsimbad.jobs import train_nnql as module
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import REMAP_STAGES, remap
from deepsimbad.jobs.train_nnql import HELD_OUT, SECOND_DRIVE, DescribedDrive, train_nnql
from deepsimbad.store.map_file import read_map

DOMAIN = "route"
ACTIONS_M = (2.0, 1.0, 5.0)
N, R = 90, 20


def drives(noise: float = 0.4, seed: int = 0) -> tuple[DescribedDrive, DescribedDrive]:
    """The map's own drive and a second one of the same places."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(N, R))
    route = Route(np.arange(N, dtype=float))

    def seen() -> DescribedDrive:
        views = (places + noise * rng.normal(size=(N, R))).astype(np.float32)
        return DescribedDrive(route, views, views)

    return seen(), seen()


def trained(relevance=Relevance.RRF, second=None, own=None, config=None, on_progress=lambda _: None):
    own = own or drives()[0]
    built = build_retrieval_map(relevance, own.dissimilarities, 4, own.encodings)
    config = config or NnqlConfig(n_episodes=200)
    return train_nnql(built, own.route, ACTIONS_M, lambda: own, second, config, on_progress)


@pytest.fixture
def worlds(monkeypatch):
    """Every world that training makes, with the route its map lies on."""
    seen = []
    on = TrainingWorld.on

    def recording(route, views, live_route, *rest):
        seen.append((route, views, live_route))
        return on(route, views, live_route, *rest)

    monkeypatch.setattr(module.TrainingWorld, "on", recording)
    return seen


def test_a_second_drive_of_the_route_gives_the_live_images(worlds):
    own, second = drives()
    experience = trained(second=second, own=own)
    assert experience.metrics["live_images"] == SECOND_DRIVE
    assert experience.metrics["n_episodes"] == 200
    ((route, views, _),) = worlds
    assert route.n_images == N
    assert views.dissimilarities is second.dissimilarities
    assert experience.q_values.shape == (N, 3)
    assert experience.q_values.dtype == np.float32
    assert (experience.q_values > 1).mean() > 0.5


def test_else_alternate_frames_are_held_out_of_the_map_they_look_at(worlds):
    own, _ = drives()
    experience = trained(own=own)
    assert experience.metrics["live_images"] == HELD_OUT
    assert len(experience.metrics["curves"]) == len(worlds) == 2
    for route, views, live_route in worlds:
        assert not set(route.position_m) & set(live_route.position_m), "a live image is a map image"
        assert views.built.index.n_images == route.n_images == N // 2
        for image, position_m in enumerate(route.position_m):  # the half's lists are those of its frames
            nearest = np.argsort(own.dissimilarities[int(position_m)], kind="stable")[:4]
            assert views.built.index.lists[:, image].tolist() == nearest.tolist()
    touched = (experience.q_values != np.float32(1e-4)).any(axis=1)
    assert touched[::2].mean() > 0.5
    assert touched[1::2].mean() > 0.5


@pytest.mark.parametrize("relevance", list(Relevance))
def test_maps_for_every_relevance_learn(relevance):
    own, second = drives()
    for live in (None, second):
        experience = trained(relevance, live, own, NnqlConfig(n_episodes=40))
        assert np.isfinite(experience.q_values).all()
        assert (experience.q_values > 1).any()


def test_small_maps_take_fewer_episodes_and_one_image_none():
    own, _ = drives()
    assert trained(own=own.at(np.arange(6)), config=NnqlConfig()).metrics["n_episodes"] == 150
    alone = trained(own=own.at(np.arange(1)))
    assert alone.q_values.tolist() == [[np.float32(1e-4)] * 3]
    assert alone.metrics["curves"] == []
    nothing = trained(second=drives()[1], config=NnqlConfig(n_episodes=0))
    assert (nothing.q_values == np.float32(1e-4)).all()


def test_progress_rises_and_a_cancel_gets_through():
    for second in (None, drives()[1]):
        shares: list[float] = []
        trained(second=second, on_progress=shares.append)
        assert shares == sorted(shares)
        assert shares[-1] == 1.0

        def cancel(share: float) -> None:
            raise CancelledError("asked to stop")

        with pytest.raises(CancelledError):
            trained(second=second, on_progress=cancel)


def test_columns_are_the_moves_in_ascending_order():
    own, second = drives()
    built = build_retrieval_map(Relevance.RRF, own.dissimilarities, 4)
    train_it = partial(train_nnql, built, own.route)
    rest = (lambda: own, second, NnqlConfig(n_episodes=30), lambda _: None)
    assert np.array_equal(train_it((5.0, 1.0, 2.0), *rest).q_values, train_it((1.0, 2.0, 5.0), *rest).q_values)


def remap_config(**changes):
    return RemapConfig(**{"training_traverse": "drive", "landmark_traverse": "other", "n_landmarks": 8} | changes)


def test_a_remap_stores_what_it_learnt(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 12)
    stages: list[str] = []
    progress = Progress(REMAP_STAGES, lambda state: stages.append(state.stage))
    result = remap(catalog, DOMAIN, remap_config(), evaluator, progress)
    assert "train" in stages
    training = result["metrics"]["training"]
    assert training["n_episodes"] == 300
    assert training["live_images"] == HELD_OUT
    assert all(0 <= share <= 1 for curve in training["curves"] for share in curve["reward_share"])
    assert training["hyperparameters"]["learning_rate"] == 0.1
    assert catalog.map(DOMAIN, 1).metrics["training"] == training
    q_values = read_map(catalog.map_path(DOMAIN, 1)).q_values
    assert q_values.shape == (12, 2)
    again = remap(catalog, DOMAIN, remap_config(), evaluator, quiet)
    assert np.array_equal(read_map(catalog.map_path(DOMAIN, again["map_version"])).q_values, q_values)
    other_seed = remap(catalog, DOMAIN, remap_config(seed=1), evaluator, Progress(REMAP_STAGES))
    assert not np.array_equal(read_map(catalog.map_path(DOMAIN, other_seed["map_version"])).q_values, q_values)


def test_a_remap_without_episodes_has_no_experience(catalog, drive, evaluator, quiet):
    drive("other", 30, seed=1)
    drive("drive", 12)
    result = remap(catalog, DOMAIN, remap_config(training_episodes=0), evaluator, quiet)
    assert result["metrics"]["training"] is None
    assert read_map(catalog.map_path(DOMAIN, 1)).q_values is None
