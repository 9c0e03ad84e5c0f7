"""A catalog, maps made without a job, and a service over them that can be restarted."""

from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.core.building import MapPlan, build_map, compose_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.engine.localizer import RankedLandmarks, ReadyEncoding, View
from deepsimbad.engine.maps import Maps
from deepsimbad.engine.session import Observation, SessionConfig, SessionView
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.worker import EvaluatorPool, InferenceWorker, Stopwatch
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.map_file import seal, write_map
from deepsimbad.store.sessions import IdempotencyKey, SessionStore

N_IMAGES, N_LANDMARKS, DIM, LIST_LENGTH = 30, 9, 6, 3
EVALUATOR = {"kind": "feature_l2", "extractor": "none"}
TTL_S, KEEP_ENDED_S = 100.0, 50_000.0


class Clock:
    def __init__(self) -> None:
        self.now_s = 1_000_000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


def map_contents(
    domain: str = "d", version: int = 1, relevance: Relevance = Relevance.STANDARDISED, closed: bool = False
) -> Map:
    rng = np.random.default_rng(version)
    encodings = rng.normal(size=(N_IMAGES, DIM)).astype(np.float32)
    evaluator = FeatureL2("none")
    model = evaluator.fit_landmarks(rng.normal(size=(N_LANDMARKS, DIM)).astype(np.float32))
    dissimilarities = evaluator.dissimilarities(encodings, model)
    drive = Drive(position_m=np.arange(N_IMAGES) * 1.5, encodings=encodings, dissimilarities=dissimilarities)
    if relevance is Relevance.COMPOSED:
        plan = MapPlan(relevance, LIST_LENGTH, (1.0, 2.0), closed)
        map_ = compose_map(plan, drive, None, None, N_LANDMARKS).map
    else:
        map_ = replace(
            build_map(relevance, drive, LIST_LENGTH, closed), actions_m=np.array([1.0, 2.0]), landmark_model=model
        )
    return replace(
        map_, domain=domain, version=version, created_at="2026-01-01T00:00:00Z", evaluator=EVALUATOR, index_bytes=1200
    )


def add_map(catalog: Catalog, domain: str = "d", contents: Map | None = None, activate: bool = True) -> int:
    """Build and seal the next version."""
    version = catalog.begin_map(domain, {})
    building = catalog.building_path(domain, version)
    write_map(building, map_contents(domain, version) if contents is None else contents)
    digest, n_bytes = seal(building, catalog.map_path(domain, version))
    catalog.seal_map(domain, version, digest, n_bytes, {})
    if activate:
        catalog.activate(domain, version, ANY)
    return version


def add_domain(catalog: Catalog, name: str, closed: bool = False) -> None:
    catalog.create_domain(name, EVALUATOR, closed, (1.0, 2.0))


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(tmp_path) as empty_catalog:
        yield empty_catalog


@pytest.fixture
def mapped_catalog(catalog: Catalog) -> Catalog:
    """A catalog with one domain, `d`, that has its first map."""
    add_domain(catalog, "d")
    add_map(catalog)
    return catalog


class Service:
    """One run of a service over a data directory."""

    def __init__(self, catalog: Catalog, clock: Clock, **options: Any) -> None:
        self.catalog = catalog
        self.commits: list[int] = []
        self.store = SessionStore.open(catalog.data_dir, self.commits.append)
        self.worker = InferenceWorker()
        self.maps = Maps(catalog)
        limits = {"ttl_s": TTL_S, "max_sessions": 20, "max_sessions_per_key": 10, "snapshot_every": 4}
        options = {**limits, "keep_ended_s": KEEP_ENDED_S, "clock": clock, **options}
        self.sessions = Sessions(self.store, self.maps, EvaluatorPool(), self.worker, **options)

    async def begin(self, **config: Any) -> str:
        return (await self.sessions.begin(self.maps.active("d"), SessionConfig(**config))).session_id

    async def observe(self, session_id: str, seed: int, watch: Stopwatch | None = None, **options: Any) -> SessionView:
        """An observation of ranks, the same for the same seed."""
        return await self.sessions.observe(session_id, ranked_observation(seed, **options), watch)


@contextmanager
def open_service(catalog: Catalog, clock: Clock | None = None, **options: Any) -> Iterator[Service]:
    service = Service(catalog, clock or Clock(), **options)
    try:
        yield service
    finally:
        service.sessions.close()
        service.worker.close()
        service.store.close()


@pytest.fixture
def service(mapped_catalog: Catalog, clock: Clock) -> Iterator[Service]:
    """A service over the catalog with one map."""
    with open_service(mapped_catalog, clock) as service:
        yield service


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


def view_decoder(view: View) -> Callable[[Evaluator, Map], Awaitable[tuple[View, Sequence[str]]]]:
    async def decode(_evaluator: Evaluator, _map: Map) -> tuple[View, Sequence[str]]:
        return view, ()

    return decode


def ranked_observation(seed: int, action_m: float = 1.5, key: str | None = None, digest: bytes = b"d") -> Observation:
    ids = np.random.default_rng(seed).permutation(N_LANDMARKS)[: 1 + seed % N_LANDMARKS]
    idempotency = None if key is None else IdempotencyKey(key, digest)
    return Observation(view_decoder(RankedLandmarks(tuple(ids.tolist()))), action_m, idempotency=idempotency)


def encoding_observation(seed: int, action_m: float = 1.5) -> Observation:
    return Observation(view_decoder(ReadyEncoding(np.random.default_rng(seed).normal(size=DIM))), action_m)
