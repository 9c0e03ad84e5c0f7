"""What Prometheus scrapes: one registry per application, so that two in one process do not mix.

Every metric is explained in `docs/operations.md`, and a test compares.
"""

import threading
from collections.abc import Iterable, Mapping
from functools import cache

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from deepsimbad.api.state_metrics import StateCollector

# A gauge beside every counter that says when it began: nobody asks.
disable_created_metrics()  # type: ignore[no-untyped-call]

_LATENCY_BUCKETS_S = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.125, 0.25, 0.5, 1, 2, 4, 8, 30)
_PERCENT_BUCKETS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 40, 50, 75, 100)
_JOB_BUCKETS_S = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600, 7200)
_BATCH_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128, 256)


class Metrics:
    """The service's counters, all named `deepsimbad_...`.

    Attributes:
        content_type: Of `render()`.
    """

    content_type = CONTENT_TYPE_LATEST

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "deepsimbad_requests",
            "Requests answered.",
            ["method", "route", "status"],
            registry=self._registry,
        )
        self._request_seconds = Histogram(
            "deepsimbad_request_seconds",
            "Time from a request's head to the end of its answer.",
            ["route"],
            buckets=_LATENCY_BUCKETS_S,
            registry=self._registry,
        )
        stage_seconds = Histogram(
            "deepsimbad_localization_stage_seconds",
            "Time of the stages of one answer to a view, and their total.",
            ["stage"],
            buckets=_LATENCY_BUCKETS_S,
            registry=self._registry,
        )
        self._seconds_of_stage = cache(stage_seconds.labels)  # a view has a dozen: looked up, they cost twice as much
        self._entropy_bits = Histogram(
            "deepsimbad_belief_entropy_bits",
            "Entropy of the belief after one view: high when the map no longer tells places apart.",
            ["domain"],
            buckets=tuple(range(0, 25, 2)),
            registry=self._registry,
        )
        self._live_anr_percent = Histogram(
            "deepsimbad_live_anr_percent",
            "Normalised rank of the true map image in a session's belief, in percent, once the truth was told: 0 is "
            "perfect, 50 chance.",
            ["domain"],
            buckets=_PERCENT_BUCKETS,
            registry=self._registry,
        )
        self._observations = Counter(
            "deepsimbad_observations",
            "Observations of sessions: accepted, repeated (counted before), or the code of what was wrong.",
            ["outcome"],
            registry=self._registry,
        )
        self._commit_writes = Histogram(
            "deepsimbad_session_commit_writes",
            "Writes that shared one transaction of the sessions' file.",
            buckets=_BATCH_BUCKETS,
            registry=self._registry,
        )
        self._refused = Counter(
            "deepsimbad_refused_requests",
            "Requests and connections turned away for what they are or how many, by reason.",
            ["reason"],
            registry=self._registry,
        )
        self._job_seconds = Histogram(
            "deepsimbad_job_seconds",
            "Time from a job's start to its end.",
            ["kind", "state"],
            buckets=_JOB_BUCKETS_S,
            registry=self._registry,
        )
        self._in_flight = Gauge(
            "deepsimbad_requests_in_flight", "Requests being answered now.", registry=self._registry
        )
        ProcessCollector(registry=self._registry)
        self._state: StateCollector | None = None
        self._domains: set[str] = set()  # that have series here
        self._scrape = threading.Lock()

    def watch(self, state: StateCollector) -> None:
        """Show this state too, from now on."""
        self._state = state
        self._registry.register(state)

    def request_began(self) -> None:
        """Count a request as being answered."""
        self._in_flight.inc()

    def request_ended(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request as answered."""
        self._in_flight.dec()
        self._requests.labels(method, route, str(status)).inc()
        self._request_seconds.labels(route).observe(seconds)

    def localized(self, domain: str, timings_ms: Mapping[str, float], entropy_bits: float) -> None:
        """Record one localization."""
        for stage, milliseconds in timings_ms.items():
            self._seconds_of_stage(stage).observe(milliseconds / 1000)
        self._domains.add(domain)
        self._entropy_bits.labels(domain).observe(entropy_bits)

    def fed_back(self, domain: str, rank_shares: Iterable[float]) -> None:
        """Record where beliefs had placed the truth: shares of the map, 0..1, one for every observation."""
        self._domains.add(domain)
        ranks = self._live_anr_percent.labels(domain)
        for share in rank_shares:
            ranks.observe(100 * share)

    def observed(self, outcome: str) -> None:
        """Count an observation of a session: "accepted", "repeated" or an error's code."""
        self._observations.labels(outcome).inc()

    def committed(self, n_writes: int) -> None:
        """Record one transaction of the sessions' file."""
        self._commit_writes.observe(n_writes)

    def refused(self, reason: str) -> None:
        """Count what was turned away: an error's code, or another word of ours."""
        self._refused.labels(reason).inc()

    def job_ended(self, kind: str, state: str, seconds: float) -> None:
        """Record how long a job ran until it ended so."""
        self._job_seconds.labels(kind, state).observe(seconds)

    def forget_domain(self, domain: str) -> None:
        """Drop what is kept by a domain's name, so that deleted domains do not pile up."""
        self._domains.discard(domain)
        for histogram in (self._entropy_bits, self._live_anr_percent):
            histogram.remove_by_labels({"domain": domain})

    def render(self) -> bytes:
        """The text exposition; reads files."""
        with self._scrape:
            state = None if self._state is None else self._state.look()
            if state is not None:  # a view that was on its way brought a deleted domain back
                for domain in self._domains.difference(record.name for record in state.domains):
                    self.forget_domain(domain)
            return generate_latest(self._registry)
