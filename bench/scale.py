"""A fleet of 100,000 domains and 10^9 map images, simulated with measured parameters: docs/results/scale.md.

    python -m bench.scale

Robots drive routes of which few are driven by many (Zipf), post an observation every two seconds and go on to another
route after half an hour. A domain lives with two replicas by rendezvous hashing, a session with one of them; a replica
is one server that answers in order of arrival and keeps maps in a cache of bounded bytes, in memory and on its disk,
the least recently used leaving first. Robots begin one after the other in the first ten minutes, which are not counted.
One replica dies in the middle; its sessions live with the other owners of their domains until it is back, empty.
"""

import heapq
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from bench.measurement import RESULTS, Command, markdown, print_page
from deepsimbad.fleet.placement import owners
from deepsimbad.settings import MEBIBYTE


@dataclass(frozen=True)
class Parameters:
    """What is simulated; what was measured, and where, stands in docs/scale.md."""

    n_domains: int = 100_000
    n_images: int = 10_000  # of a domain
    n_robots: int = 1_000
    n_replicas: int = 8
    hours: float = 0.75
    away_s: float = 10.0  # until a replica that died is back
    every_s: float = 2.0  # a robot's observations
    drive_s: float = 1800.0  # on one route
    zipf: float = 1.0  # how much more often the first routes are driven
    answer_ms: float = 4.0  # of processor time, an observation on board encoded, its map in memory
    load_ms: float = 90.0  # a map from the replica's disk
    fetch_ms: float = 60.0  # a map from the store to the disk: assumed, two round trips of 15 ms and 100 MB a second
    replay_ms: float = 100.0  # a session of 450 observations that moves to another replica
    map_bytes: int = 3 * MEBIBYTE  # of a file
    loaded_bytes: int = 4 * MEBIBYTE  # of a map in memory
    memory_bytes: int = 4096 * MEBIBYTE  # of a replica, for maps
    disk_bytes: int = 64 * 1024 * MEBIBYTE  # of a replica, for files of maps


BEGIN_S = 600.0


class Cache:
    """Domains within a number of bytes, the least recently used leaving first."""

    def __init__(self, n_bytes: int, domain_bytes: int) -> None:
        self._n_domains, self._domains = n_bytes // domain_bytes, OrderedDict[int, None]()

    def has(self, domain: int) -> bool:
        """Whether a domain was in the cache; it is from now on."""
        was_there = domain in self._domains
        self._domains[domain] = None
        self._domains.move_to_end(domain)
        if len(self._domains) > self._n_domains:
            self._domains.popitem(last=False)
        return was_there


@dataclass
class Replica:
    """One server with its caches, and the time until which it is busy."""

    memory: Cache
    disk: Cache
    free_at_s: float = 0.0
    followed_at_s: float = 0.0  # until when it follows journals, which gives way to what is asked meanwhile
    busy_s: float = 0.0
    sessions: set[int] = field(default_factory=set)  # robots whose beliefs it holds

    @classmethod
    def empty(cls, of: Parameters) -> "Replica":
        """A replica as it starts."""
        return cls(Cache(of.memory_bytes, of.loaded_bytes), Cache(of.disk_bytes, of.map_bytes))


@dataclass(frozen=True)
class Outcome:
    """The figures of one run."""

    answer_ms: np.ndarray  # of every observation, waiting counted
    n_loaded: int
    n_fetched: int
    n_moved: int  # times that a session went on with a replica that had to follow its journal
    busy: float  # share of the replicas' time


def simulated(of: Parameters, seed: int = 0) -> Outcome:
    """Simulate one run."""
    rng = np.random.default_rng(seed)
    popularity = np.cumsum(np.arange(1, of.n_domains + 1) ** -of.zipf)
    end_s, dies_s = 3600 * of.hours, 1800 * of.hours
    replicas = [Replica.empty(of) for _ in range(of.n_replicas)]
    owners_of: dict[int, tuple[int, ...]] = {}
    domain, until_s = np.zeros(of.n_robots, np.int64), np.zeros(of.n_robots)
    due = [(float(rng.uniform(0, BEGIN_S)), robot) for robot in range(of.n_robots)]
    heapq.heapify(due)
    answer_ms, counts, has_died = [], {"loaded": 0, "fetched": 0, "moved": 0}, False
    while due[0][0] < end_s:
        now_s, robot = due[0]
        if now_s >= dies_s and not has_died:
            replicas[0], has_died = Replica.empty(of), True
        is_new = now_s >= until_s[robot]
        if is_new:
            domain[robot] = np.searchsorted(popularity, rng.uniform(0, popularity[-1]))
            until_s[robot] = now_s + of.drive_s * rng.uniform(0.5, 1.5)
        route = int(domain[robot])
        if route not in owners_of:
            owners_of[route] = owners(f"{route:08x}", of.n_replicas)
        number, other = owners_of[route][robot % 2], owners_of[route][1 - robot % 2]
        is_away = number == 0 and dies_s <= now_s < dies_s + of.away_s
        replica = replicas[other if is_away else number]
        takes_ms = of.answer_ms
        if not replica.memory.has(route):
            takes_ms += of.load_ms
            counts["loaded"] += 1
            if not replica.disk.has(route):
                takes_ms += of.fetch_ms
                counts["fetched"] += 1
        is_moved = not is_new and robot not in replica.sessions
        replica.sessions.add(robot)
        if is_moved:
            replica.followed_at_s = max(now_s, replica.followed_at_s) + of.replay_ms / 1000
            counts["moved"] += 1
        begins_s = max(now_s, replica.free_at_s)
        replica.free_at_s = begins_s + takes_ms / 1000
        replica.busy_s += takes_ms / 1000
        if now_s >= BEGIN_S:
            answer_ms.append(1000 * (max(replica.free_at_s, replica.followed_at_s if is_moved else 0.0) - now_s))
        heapq.heapreplace(due, (now_s + of.every_s * rng.uniform(0.9, 1.1), robot))
    busy = sum(replica.busy_s for replica in replicas) / (of.n_replicas * end_s)
    return Outcome(np.array(answer_ms), counts["loaded"], counts["fetched"], counts["moved"], busy)


def lines() -> Iterator[str]:
    """The page."""
    default = Parameters()
    runs = {
        "as told": default,
        "twice the robots": replace(default, n_robots=2 * default.n_robots),
        "256 MiB of memory for maps": replace(default, memory_bytes=256 * MEBIBYTE),
        "4 replicas": replace(default, n_replicas=4),
        "all routes alike": replace(default, zipf=0.0),
        "the store ten times slower": replace(default, fetch_ms=10 * default.fetch_ms),
    }
    yield from ("# 100,000 domains, 10^9 map images: a simulation", "", "`python -m bench.scale`", "")
    yield from ((__doc__ or "").split("\n\n", 2)[2].strip(), "")
    yield "Parameters (where they were measured: [scale.md](../scale.md)):"
    yield from ("", *(f"- {name.replace('_', ' ')}: {value:,}" for name, value in vars(default).items()), "")
    yield from markdown(
        ("run", "observations", "median", "p99", "p99.9", "worst", "busy", "from disk", "from the store", "moved"),
        (row(name, simulated(of)) for name, of in runs.items()),
    )
    yield from (
        "",
        "Times are milliseconds from a robot's post to its answer at the replica, the network apart. `moved` counts",
    )
    yield "how often a session went on with a replica that had to follow its journal first, there and back."


def row(name: str, outcome: Outcome) -> tuple[str, ...]:
    """The cells of one run."""
    times = (f"{np.percentile(outcome.answer_ms, share):,.1f}" for share in (50, 99, 99.9, 100))
    counts = (f"{count:,}" for count in (outcome.n_loaded, outcome.n_fetched, outcome.n_moved))
    return name, f"{outcome.answer_ms.size:,}", *times, f"{outcome.busy:.0%}", *counts


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(lines(), RESULTS / "scale.md"))
