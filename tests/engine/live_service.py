"""What the tests of sessions stand on: a data directory with one mapped domain, and a service that can be restarted."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from deepsimbad.engine.encoders import EvaluatorPool
from deepsimbad.engine.maps import Maps
from deepsimbad.engine.session import Observation
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.views import RankedLandmarks, ReadyEncoding, View
from deepsimbad.engine.worker import InferenceWorker
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.journal import IdempotencyKey
from deepsimbad.store.sessions import SessionStore

from .conftest import DIM, N_LANDMARKS

T = TypeVar("T")
TTL_S, KEEP_ENDED_S = 100.0, 50_000.0


class Clock:
    def __init__(self) -> None:
        self.now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


class Live:
    """One run of a service over a data directory."""

    def __init__(self, catalog: Catalog, clock: Clock, **options: Any) -> None:
        self.catalog = catalog
        self.commits: list[int] = []
        self.store = SessionStore.open(catalog.data_dir, self.commits.append)
        self.worker = InferenceWorker()
        self.maps = Maps(catalog)
        self.sessions = Sessions(
            self.store,
            self.maps,
            EvaluatorPool(),
            self.worker,
            **{
                "ttl_s": TTL_S,
                "max_sessions": 20,
                "max_sessions_per_key": 10,
                "snapshot_every": 4,
                "keep_ended_s": KEEP_ENDED_S,
                "clock": clock,
                **options,
            },
        )

    def close(self) -> None:
        self.sessions.close()
        self.worker.close()
        self.store.close()


@contextmanager
def running(catalog: Catalog, clock: Clock | None = None, **options: Any) -> Iterator[Live]:
    live = Live(catalog, clock or Clock(), **options)
    try:
        yield live
    finally:
        live.close()


def run(
    catalog: Catalog, body: Callable[[Live], Coroutine[Any, Any, T]], clock: Clock | None = None, **options: Any
) -> T:
    """Run a coroutine against a service that is started for it, and stopped after it."""
    with running(catalog, clock, **options) as live:
        return asyncio.run(body(live))


def viewed(view: View) -> Callable[[Evaluator], Awaitable[View]]:
    async def give(_evaluator: Evaluator) -> View:
        return view

    return give


def ranked(seed: int, action_m: float = 1.5, key: str | None = None, digest: bytes = b"d", **more: Any) -> Observation:
    ids = np.random.default_rng(seed).permutation(N_LANDMARKS)[: 1 + seed % N_LANDMARKS]
    named = None if key is None else IdempotencyKey(key, digest)
    return Observation(viewed(RankedLandmarks(tuple(ids.tolist()))), action_m, idempotency=named, **more)


def encoded(seed: int, action_m: float = 1.5) -> Observation:
    values = np.random.default_rng(seed).normal(size=DIM)
    return Observation(viewed(ReadyEncoding(values)), action_m)
