"""What Prometheus scrapes: one registry per application, so that two in one process do not mix."""

from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

_LATENCY_BUCKETS_S = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.125, 0.25, 0.5, 1, 2, 4, 8, 30)
_PERCENT_BUCKETS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 40, 50, 75, 100)
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
        self._stage_seconds = Histogram(
            "deepsimbad_localization_stage_seconds",
            "Time of the stages of one localization.",
            ["stage"],
            buckets=_LATENCY_BUCKETS_S,
            registry=self._registry,
        )
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
        self._in_flight = Gauge(
            "deepsimbad_requests_in_flight", "Requests being answered now.", registry=self._registry
        )
        self._queue = Gauge(
            "deepsimbad_inference_queue", "Work waiting for the inference worker.", registry=self._registry
        )
        self._active_maps = Gauge("deepsimbad_loaded_maps", "Active maps held in memory.", registry=self._registry)
        self._sessions = Gauge("deepsimbad_sessions", "Sessions that have not ended.", registry=self._registry)

    def watch(
        self, queue_length: Callable[[], int], n_active_maps: Callable[[], int], n_sessions: Callable[[], int]
    ) -> None:
        """Read these whenever the metrics are scraped."""
        self._queue.set_function(lambda: float(queue_length()))
        self._active_maps.set_function(lambda: float(n_active_maps()))
        self._sessions.set_function(lambda: float(n_sessions()))

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
            self._stage_seconds.labels(stage).observe(milliseconds / 1000)
        self._entropy_bits.labels(domain).observe(entropy_bits)

    def fed_back(self, domain: str, rank_shares: Iterable[float]) -> None:
        """Record where beliefs had placed the truth: shares of the map, 0..1, one for every observation."""
        ranks = self._live_anr_percent.labels(domain)
        for share in rank_shares:
            ranks.observe(100 * share)

    def observed(self, outcome: str) -> None:
        """Count an observation of a session: "accepted", "repeated" or an error's code."""
        self._observations.labels(outcome).inc()

    def committed(self, n_writes: int) -> None:
        """Record one transaction of the sessions' file."""
        self._commit_writes.observe(n_writes)

    def forget_domain(self, domain: str) -> None:
        """Drop what is kept by a domain's name, so that deleted domains do not pile up."""
        for histogram in (self._entropy_bits, self._live_anr_percent):
            histogram.remove_by_labels({"domain": domain})

    def render(self) -> bytes:
        """The text exposition."""
        return generate_latest(self._registry)
