"""What the service is and holds at the moment of a scrape, as gauges."""

import platform
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Self

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from deepsimbad.engine.maps import Maps
from deepsimbad.errors import DeepSimbadError
from deepsimbad.jobs.runner import REMAP
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import DomainRecord, JobRecord, JobState, MapRecord

GATE_LOST = "gate_lost"  # sealed, but worse than the active map by more than its gate allowed
REMAP_OUTCOMES = (JobState.SUCCEEDED.value, GATE_LOST, JobState.FAILED.value, JobState.CANCELLED.value)


@dataclass(frozen=True)
class WatchedState:
    """Where it is read.

    Attributes:
        version: Of the release.
        data_dir: The data directory.
        catalog: Domains, maps and jobs.
        maps: Those in memory.
        faults: What keeps the service from being ready.
        queue_length: Of the inference worker.
        n_sessions: That have not ended.
    """

    version: str
    data_dir: Path
    catalog: Catalog
    maps: Maps
    faults: Callable[[], Sequence[str]]
    queue_length: Callable[[], int]
    n_sessions: Callable[[], int]


@dataclass(frozen=True)
class CatalogState:
    """What the catalog says: domains, every job, oldest first, and the active map of each domain that has one."""

    domains: Sequence[DomainRecord]
    jobs: Sequence[JobRecord]
    serving: Mapping[str, MapRecord]

    @classmethod
    def of(cls, catalog: Catalog) -> Self:
        """Read it; raises DeepSimbadError."""
        domains = catalog.domains()
        versions = {domain.name: domain.active_version for domain in domains}
        serving = {name: catalog.map(name, version) for name, version in versions.items() if version is not None}
        return cls(domains, catalog.jobs(), serving)

    def last_remaps(self) -> Mapping[str, JobRecord]:
        """The remap of each domain that ended last.

        They are done one after the other as they came, whatever the clock was set to; one that was cancelled while it
        waited, out of that order, tells of nothing that was done and counts only beside others such.
        """
        ended = [job for job in self.jobs if job.kind == REMAP and job.finished_at is not None]
        return {job.domain: job for job in sorted(ended, key=lambda job: job.n_starts > 0)}


class StateCollector(Collector):
    """Gives what `look` saw; series of deleted domains end by themselves, since nothing is kept from scrape to scrape.

    Args:
        watched: Where it is read.
        wall: Seconds since 1970.
    """

    def __init__(self, watched: WatchedState, wall: Callable[[], float] = time.time) -> None:
        self._watched = watched
        self._wall = wall
        self._seen: CatalogState | None = None

    def look(self) -> CatalogState | None:
        """Read the catalog for the next `collect`; None where it cannot be read."""
        try:
            self._seen = CatalogState.of(self._watched.catalog)
        except DeepSimbadError:  # `deepsimbad_ready` tells; what needs no catalog is shown all the same
            self._seen = None
        return self._seen

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Every family."""
        watched = self._watched
        yield _labelled(
            "deepsimbad_build_info",
            "Always 1; the labels tell the release.",
            ("version", "python"),
            [((watched.version, platform.python_version()), 1)],
        )
        yield _plain("deepsimbad_ready", "1 where /readyz answers 200.", 0 if watched.faults() else 1)
        yield _plain("deepsimbad_inference_queue", "Work waiting for the inference worker.", watched.queue_length())
        yield _plain("deepsimbad_loaded_maps", "Active maps held in memory.", watched.maps.n_loaded)
        yield _plain("deepsimbad_sessions", "Sessions that have not ended.", watched.n_sessions())
        yield from self._disk()
        if self._seen is not None:
            yield from self._of_catalog(self._seen)

    def _disk(self) -> Iterator[GaugeMetricFamily]:
        try:
            usage = shutil.disk_usage(self._watched.data_dir)
        except OSError:
            return
        yield _plain("deepsimbad_data_dir_free_bytes", "Free where the data directory lies.", usage.free)
        yield _plain("deepsimbad_data_dir_size_bytes", "Size of the disk it lies on.", usage.total)

    def _of_catalog(self, state: CatalogState) -> Iterator[GaugeMetricFamily]:
        now = self._wall()
        n_jobs = Counter(job.state for job in state.jobs)
        remaps = state.last_remaps()
        snapshots = [one.snapshot for one in self._watched.maps.loaded()]
        damaged = self._watched.maps.damaged()
        yield _labelled(
            "deepsimbad_jobs",
            "Jobs the catalog knows, by state.",
            ("state",),
            [((value.value,), n_jobs[value]) for value in JobState],
        )
        yield _plain("deepsimbad_domains", "Domains there are.", len(state.domains))
        yield _by_domain(
            "deepsimbad_active_map_version",
            "Version of the map that serves.",
            [(domain, record.version) for domain, record in state.serving.items()],
        )
        yield _by_domain(
            "deepsimbad_map_age_seconds",
            "Time since the map that serves was built.",
            [(domain, max(0.0, now - _seconds(record.created_at))) for domain, record in state.serving.items()],
        )
        yield _by_domain(
            "deepsimbad_map_damaged",
            "1 where the map that serves could not be loaded.",
            [(domain, int(damaged.get(domain) == record.version)) for domain, record in state.serving.items()],
        )
        yield _by_domain(
            "deepsimbad_map_images",
            "Map images of the map in memory.",
            [(one.domain, one.route.n_images) for one in snapshots],
        )
        yield _by_domain(
            "deepsimbad_map_index_bytes",
            "Bytes of its index in the map file.",
            [(one.domain, one.index_bytes) for one in snapshots],
        )
        yield _labelled(
            "deepsimbad_last_remap",
            "1 for the outcome of the remap that ended last, else 0.",
            ("domain", "outcome"),
            [
                ((domain, outcome), int(outcome == _outcome(job)))
                for domain, job in sorted(remaps.items())
                for outcome in REMAP_OUTCOMES
            ],
        )
        yield _by_domain(
            "deepsimbad_last_remap_timestamp_seconds",
            "When it ended, seconds since 1970.",
            [(domain, _seconds(job.finished_at or "")) for domain, job in sorted(remaps.items())],
        )


def _outcome(job: JobRecord) -> str:
    check = ((job.result or {}).get("metrics") or {}).get("check") or {}
    return GATE_LOST if job.state is JobState.SUCCEEDED and check.get("passed") is False else job.state.value


def _seconds(iso: str) -> float:
    return datetime.fromisoformat(iso).timestamp()


def _plain(name: str, meaning: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, meaning, value=value)


def _by_domain(name: str, meaning: str, values: Sequence[tuple[str, float]]) -> GaugeMetricFamily:
    return _labelled(name, meaning, ("domain",), [((domain,), value) for domain, value in values])


def _labelled(
    name: str, meaning: str, labels: Sequence[str], values: Sequence[tuple[Sequence[str], float]]
) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, meaning, labels=labels)
    for of, value in values:
        family.add_metric(of, value)
    return family
