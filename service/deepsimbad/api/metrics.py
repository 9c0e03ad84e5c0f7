"""What Prometheus scrapes: one registry per application, so that two in one process do not mix.

Every metric is explained in `docs/operations.md`, and a test compares.
"""

import platform
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from deepsimbad import release
from deepsimbad.api.keys import KeyRing
from deepsimbad.engine.maps import Maps
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.worker import InferenceWorker
from deepsimbad.errors import DeepSimbadError
from deepsimbad.jobs.runner import REMAP
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, JobState, MapRecord

# Else a gauge beside every counter would say when the counter began, which nobody asks.
disable_created_metrics()  # type: ignore[no-untyped-call]

GATE_LOST = "gate_lost"  # sealed, but worse than the active map by more than its gate allowed
REMAP_OUTCOMES = (JobState.SUCCEEDED.value, GATE_LOST, JobState.FAILED.value, JobState.CANCELLED.value)
_LATENCY_BUCKETS_S = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.125, 0.25, 0.5, 1, 2, 4, 8, 30)
_PERCENT_BUCKETS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 40, 50, 75, 100)
_JOB_BUCKETS_S = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600, 7200)
_BATCH_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128, 256)


class Metrics:
    """The service's counters, all named `deepsimbad_...`.

    Attributes:
        begin_request: Call it as a request's answer begins.
        record_commit: Call it with the number of writes in one transaction of the sessions' file.
        map_store_failing: Call it with whether the map store cannot be followed now.
    """

    def __init__(self) -> None:
        self._registry = CollectorRegistry()

        def counter(name: str, meaning: str, *labels: str) -> Counter:
            return Counter(f"deepsimbad_{name}", meaning, labels, registry=self._registry)

        def histogram(name: str, meaning: str, buckets: Sequence[float], *labels: str) -> Histogram:
            return Histogram(f"deepsimbad_{name}", meaning, labels, buckets=buckets, registry=self._registry)

        # A cache of ours makes looking a series up half as costly.
        self._requests = cache(counter("requests", "Requests answered.", "method", "route", "status").labels)
        meaning = "Time from a request's head to the end of its answer."
        self._request_seconds = cache(histogram("request_seconds", meaning, _LATENCY_BUCKETS_S, "route").labels)
        meaning = "Time of the stages of one answer to a view, and their total."
        self._stage_seconds = cache(
            histogram("localization_stage_seconds", meaning, _LATENCY_BUCKETS_S, "stage").labels
        )
        meaning = "Entropy of the belief after one view: high when the map no longer tells places apart."
        self._entropy_bits = histogram("belief_entropy_bits", meaning, range(0, 25, 2), "domain")
        meaning = "Normalised rank of the true map image in a session's belief, in percent, once the truth was told: "
        meaning += "0 is perfect, 50 chance."
        self._live_anr_percent = histogram("live_anr_percent", meaning, _PERCENT_BUCKETS, "domain")
        meaning = "Observations of sessions: accepted, repeated (counted before), or the code of what was wrong."
        self._observations = counter("observations", meaning, "outcome")
        meaning = "Writes that shared one transaction of the sessions' file."
        self.record_commit = histogram("session_commit_writes", meaning, _BATCH_BUCKETS).observe
        meaning = "Requests turned away for what they are or how many, by reason."
        self._refused = counter("refused_requests", meaning, "reason")
        meaning = "Time from a job's start to its end."
        self._job_seconds = histogram("job_seconds", meaning, _JOB_BUCKETS_S, "kind", "state")
        self._in_flight = Gauge(
            "deepsimbad_requests_in_flight", "Requests being answered now.", registry=self._registry
        )
        self.begin_request = self._in_flight.inc
        meaning = "1 where the map store could not be followed the last time."
        self.map_store_failing = Gauge("deepsimbad_map_store_failing", meaning, registry=self._registry).set
        ProcessCollector(registry=self._registry)
        self._state: StateCollector | None = None
        self._domains: set[str] = set()  # that have series here
        self._scrape = threading.Lock()

    def watch(self, state: "StateCollector") -> None:
        """Expose this state too, from now on."""
        self._state = state
        self._registry.register(state)

    def end_request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request as answered."""
        self._in_flight.dec()
        self._requests(method, route, str(status)).inc()
        self._request_seconds(route).observe(seconds)

    def record_localization(
        self, domain: str, timings_ms: Mapping[str, float], entropy_bits: float, outcome: str | None = None
    ) -> None:
        """Record one answer to a view; for a session's view with its outcome, as `count_observation` takes it."""
        if outcome is not None:
            self._observations.labels(outcome).inc()
        for stage, milliseconds in timings_ms.items():
            self._stage_seconds(stage).observe(milliseconds / 1000)
        self._domains.add(domain)
        self._entropy_bits.labels(domain).observe(entropy_bits)

    def record_truths(self, domain: str, rank_shares: Iterable[float]) -> None:
        """Record the ranks of the truth in beliefs, as shares of the map, 0..1, one for every observation."""
        self._domains.add(domain)
        ranks = self._live_anr_percent.labels(domain)
        for share in rank_shares:
            ranks.observe(100 * share)

    def count_observation(self, outcome: str) -> None:
        """Count an observation of a session: "accepted", "repeated" or an error's code."""
        self._observations.labels(outcome).inc()

    def count_refusal(self, reason: str) -> None:
        """Count a request turned away; `reason` is the error's code, or the setting whose limit was met."""
        self._refused.labels(reason).inc()

    def record_job(self, kind: str, state: str, seconds: float) -> None:
        """Record how long a job ran until it ended in this state."""
        self._job_seconds.labels(kind, state).observe(seconds)

    def forget_domain(self, domain: str) -> None:
        """Drop the series of a domain, so that those of deleted domains do not pile up."""
        self._domains.discard(domain)
        for histogram in (self._entropy_bits, self._live_anr_percent):
            histogram.remove_by_labels({"domain": domain})

    def render(self) -> bytes:
        """The text exposition; reads files."""
        with self._scrape:
            domain_names = None if self._state is None else self._state.look()
            if domain_names is not None:  # a view that was on its way brought a deleted domain back
                for domain in self._domains - domain_names:
                    self.forget_domain(domain)
            return generate_latest(self._registry)


@dataclass(eq=False)
class StateCollector(Collector):
    """Collects what `look` read, and nothing of the scrape before, so that series of deleted domains end.

    `_faults` returns what keeps the service from being ready.
    """

    _catalog: Catalog
    _maps: Maps
    _faults: Callable[[], Sequence[str]]
    _worker: InferenceWorker
    _sessions: Sessions
    _keys: KeyRing
    _n_domains: int | None = None
    _n_jobs: Mapping[JobState, int] = field(default_factory=dict)
    _last_remaps: Sequence[JobRecord] = ()
    _serving: Mapping[str, MapRecord] = field(default_factory=dict)

    def look(self) -> set[str] | None:
        """Read the catalog for the next `collect`; the names of its domains, None where it cannot be read."""
        try:
            domains = self._catalog.domain_names()
            self._n_jobs, self._last_remaps = self._catalog.n_jobs(), self._catalog.last_jobs(REMAP)
            # Nobody could read the series of a hundred thousand domains: those whose maps are in memory have them.
            damaged_versions = self._maps.damaged()  # asked first: one that is back is in memory then
            series_domains = {
                mapped_domain.record.name for mapped_domain in self._maps.loaded()
            } | damaged_versions.keys()
            self._serving = self._catalog.serving_maps(series_domains & domains)
        except DeepSimbadError:  # `deepsimbad_ready` tells; what needs no catalog is shown all the same
            self._n_domains = None
            return None
        self._n_domains = len(domains)
        return domains

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """All families of gauges."""
        build = {(release(), platform.python_version()): 1}
        yield _gauge("build_info", "Always 1; the labels tell the release.", build, "version", "python")
        yield _gauge("ready", "1 where /readyz answers 200.", {(): not self._faults()})
        yield _gauge("inference_queue", "Work waiting for the inference worker.", {(): self._worker.n_waiting})
        yield _gauge("loaded_maps", "Active maps held in memory.", {(): self._maps.n_loaded})
        yield _gauge("sessions", "Sessions that have not ended.", {(): self._sessions.n_living})
        next_expiry = self._keys.next_expiry
        expires_at = {(): _seconds(next_expiry)} if next_expiry else {}
        meaning = "When the next key expires, seconds since 1970; absent where none does."
        yield _gauge("key_expiry_timestamp_seconds", meaning, expires_at)
        with suppress(OSError):
            usage = shutil.disk_usage(self._catalog.data_dir)
            yield _gauge("data_dir_free_bytes", "Free where the data directory lies.", {(): usage.free})
            yield _gauge("data_dir_size_bytes", "Size of the disk it lies on.", {(): usage.total})
        yield _gauge("loaded_map_bytes", "Bytes of their arrays.", {(): self._maps.n_bytes})
        if self._n_domains is not None:
            yield _gauge("domains", "Domains there are.", {(): self._n_domains})
            yield from self._of_maps()
            yield from self._of_jobs()

    def _of_maps(self) -> Iterator[GaugeMetricFamily]:
        serving_maps, damaged_versions = self._serving.items(), self._maps.damaged()
        versions = {(domain,): record.version for domain, record in serving_maps}
        yield _gauge("active_map_version", "Version of the map that serves.", versions, "domain")
        ages_s = {(domain,): max(0.0, time.time() - _seconds(record.created_at)) for domain, record in serving_maps}
        yield _gauge("map_age_seconds", "Time since the map that serves was built.", ages_s, "domain")
        is_damaged = {(domain,): damaged_versions.get(domain) == record.version for domain, record in serving_maps}
        yield _gauge("map_damaged", "1 where the map that serves could not be loaded.", is_damaged, "domain")
        snapshots = {(mapped_domain.snapshot.domain,): mapped_domain.snapshot for mapped_domain in self._maps.loaded()}
        n_images = {domain: snapshot.route.n_images for domain, snapshot in snapshots.items()}
        yield _gauge("map_images", "Map images of the map in memory.", n_images, "domain")
        n_bytes = {domain: snapshot.index_bytes for domain, snapshot in snapshots.items()}
        yield _gauge("map_index_bytes", "Bytes of its index in the map file.", n_bytes, "domain")

    def _of_jobs(self) -> Iterator[GaugeMetricFamily]:
        by_state = {(state.value,): self._n_jobs.get(state, 0) for state in JobState}
        yield _gauge("jobs", "Jobs the catalog knows, by state.", by_state, "state")
        outcomes = {
            (job.domain, outcome): outcome == _outcome(job) for job in self._last_remaps for outcome in REMAP_OUTCOMES
        }
        meaning = "1 for the outcome of the remap that ended last, else 0."
        yield _gauge("last_remap", meaning, outcomes, "domain", "outcome")
        ended_at = {(job.domain,): _seconds(job.finished_at or "") for job in self._last_remaps}
        yield _gauge("last_remap_timestamp_seconds", "When it ended, seconds since 1970.", ended_at, "domain")


def _outcome(job: JobRecord) -> str:
    check = ((job.result or {}).get("metrics") or {}).get("check") or {}
    return GATE_LOST if job.state is JobState.SUCCEEDED and check.get("passed") is False else job.state.value


def _seconds(iso: str) -> float:
    return datetime.fromisoformat(iso).timestamp()


def _gauge(name: str, meaning: str, values: Mapping[Any, float], *labels: str) -> GaugeMetricFamily:
    """A family of gauges, of values by the values of their labels."""
    family = GaugeMetricFamily(f"deepsimbad_{name}", meaning, labels=labels)
    for label_values, value in values.items():
        family.add_metric(label_values, int(value) if isinstance(value, bool) else value)
    return family
