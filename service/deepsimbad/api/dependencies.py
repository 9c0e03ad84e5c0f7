"""What routes are given: the parts of the running service, and parameters with their limits."""

import asyncio
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, TypeVar, cast

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi import Depends, Path, Request

from deepsimbad.api.auth import KeyRing
from deepsimbad.api.bodies import GREATEST_ID, NAME_PATTERN
from deepsimbad.api.decoders import Decoders
from deepsimbad.api.metrics import Metrics
from deepsimbad.api.readiness import ReadinessCheck
from deepsimbad.engine.encoders import EvaluatorPool
from deepsimbad.engine.maps import MappedDomain, Maps, Retention
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.traverses import OpenTraverses
from deepsimbad.engine.truths import Truths
from deepsimbad.engine.views import View
from deepsimbad.engine.worker import InferenceWorker, Priority
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.runner import JobRunner
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.sessions import SessionStore

T = TypeVar("T")

BATCHES = 1  # batches read into memory at once
HEALTH = 2  # threads that nothing but questions about health may take


@dataclass(frozen=True)
class Services:
    """The running service.

    Attributes:
        settings: As it was started.
        metrics: Counters.
        catalog: What is true of the data directory.
        maps: Map versions in memory.
        evaluators: Evaluators in memory.
        open_traverses: Files kept open while frames arrive.
        sessions: Live beliefs.
        session_store: Their file.
        retention: Which old maps keep their files.
        truths: What their beliefs were worth.
        worker: Where encoding and scoring run.
        decoders: Where images are decoded.
        runner: Where jobs run.
        keys: Who may ask.
        readiness: Whether all of it works.
        stopping: Set when shutdown begins; streams end on it.
        batches: Bounds the batches being read.
        health: Threads of their own for questions about health, which should not wait behind what they ask about.
    """

    settings: Settings
    metrics: Metrics
    catalog: Catalog
    maps: Maps
    evaluators: EvaluatorPool
    open_traverses: OpenTraverses
    sessions: Sessions
    session_store: SessionStore
    retention: Retention
    truths: Truths
    worker: InferenceWorker
    decoders: Decoders
    runner: JobRunner
    keys: KeyRing
    readiness: ReadinessCheck
    stopping: threading.Event = field(default_factory=threading.Event)
    batches: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(BATCHES))
    health: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(HEALTH))

    async def active(self, domain: str) -> MappedDomain:
        """A domain and its active map; files are read in a thread."""
        known = self.maps.peek(domain)
        return known if known is not None else await run_sync(self.maps.active, domain)

    async def infer(self, run: Callable[[], T], priority: Priority = Priority.LIVE) -> T:
        """Run on the inference worker."""
        return await asyncio.wrap_future(self.worker.submit(run, priority))

    async def look(
        self, evaluator: Evaluator, view: View, run: Callable[[View], T], priority: Priority = Priority.LIVE
    ) -> T:
        """Run a function of a view on the inference worker, which encodes an image before."""
        return await asyncio.wrap_future(self.worker.look(evaluator, view, run, priority))


async def services_of(request: Request) -> Services:
    """The running service, for routes. A coroutine, because a plain function would be sent to a thread."""
    return cast("Services", request.app.state.services)


Running = Annotated[Services, Depends(services_of)]
DomainName = Annotated[str, Path(alias="domain", pattern=NAME_PATTERN, description="A domain's name.")]
TraverseName = Annotated[str, Path(alias="name", pattern=NAME_PATTERN, description="A traverse's name.")]
SessionId = Annotated[str, Path(pattern=NAME_PATTERN, description="A session's id.")]
MapVersion = Annotated[int, Path(ge=1, le=GREATEST_ID, description="A map version's number.")]
JobId = Annotated[str, Path(pattern=NAME_PATTERN, description="A job's id.")]
