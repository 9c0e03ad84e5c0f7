"""What the service is and holds at the moment of a scrape, as gauges."""

import platform
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from deepsimbad.engine.maps import Maps
from deepsimbad.errors import DeepSimbadError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.census import GATE_LOST, Census
from deepsimbad.store.records import JobState

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


class StateCollector(Collector):
    """Gives what `look` saw; series of deleted domains end by themselves, since nothing is kept from scrape to scrape.

    Args:
        watched: Where it is read.
        wall: Seconds since 1970.
    """

    def __init__(self, watched: WatchedState, wall: Callable[[], float] = time.time) -> None:
        self._watched = watched
        self._wall = wall
        self._census: Census | None = None

    def look(self) -> Census | None:
        """Read the catalog for the next `collect`; None where it cannot be read."""
        try:
            self._census = self._watched.catalog.census()
        except DeepSimbadError:  # `deepsimbad_ready` tells; what needs no catalog is shown all the same
            self._census = None
        return self._census

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
        if self._census is not None:
            yield from self._of_catalog(self._census)

    def _disk(self) -> Iterator[GaugeMetricFamily]:
        try:
            usage = shutil.disk_usage(self._watched.data_dir)
        except OSError:
            return
        yield _plain("deepsimbad_data_dir_free_bytes", "Free where the data directory lies.", usage.free)
        yield _plain("deepsimbad_data_dir_size_bytes", "Size of the disk it lies on.", usage.total)

    def _of_catalog(self, census: Census) -> Iterator[GaugeMetricFamily]:
        now = self._wall()
        serving = census.serving
        snapshots = [one.snapshot for one in self._watched.maps.loaded()]
        damaged = self._watched.maps.damaged()
        yield _labelled(
            "deepsimbad_jobs",
            "Jobs the catalog knows, by state.",
            ("state",),
            [((state.value,), n) for state, n in census.jobs.items()],
        )
        yield _plain("deepsimbad_domains", "Domains there are.", len(census.domains))
        yield _by_domain(
            "deepsimbad_active_map_version",
            "Version of the map that serves.",
            [(one.domain, one.version) for one in serving],
        )
        yield _by_domain(
            "deepsimbad_map_age_seconds",
            "Time since the map that serves was built.",
            [(one.domain, max(0.0, now - one.created_at)) for one in serving],
        )
        yield _by_domain(
            "deepsimbad_map_damaged",
            "1 where the map that serves could not be loaded.",
            [(one.domain, int(damaged.get(one.domain) == one.version)) for one in serving],
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
                ((one.domain, outcome), int(outcome == one.outcome))
                for one in census.remaps
                for outcome in REMAP_OUTCOMES
            ],
        )
        yield _by_domain(
            "deepsimbad_last_remap_timestamp_seconds",
            "When it ended, seconds since 1970.",
            [(one.domain, one.finished_at) for one in census.remaps],
        )


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
