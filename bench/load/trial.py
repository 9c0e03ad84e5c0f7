"""One run under load, and what the service's process held meanwhile."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.load.drivers import LoadRobot, Operator, make_domain
from bench.soak.link import Link
from deepsimbad_client.http.local_server import LocalServer

N_ROBOTS = 20


@dataclass(frozen=True)
class Sample:
    """The service's process at one moment.

    Attributes:
        at_s: Since the robots set out.
        rss_mb: Resident memory of the service itself; jobs run in processes of their own.
        n_handles: Open file handles.
        n_threads: Threads.
    """

    at_s: float
    rss_mb: float
    n_handles: int
    n_threads: int

    @classmethod
    def of(cls, pid: int, at_s: float) -> "Sample":
        """Look at a process now (Linux)."""
        proc = Path(f"/proc/{pid}")
        fields = dict(line.split(":", 1) for line in (proc / "status").read_text(encoding="utf-8").splitlines())
        rss_mb = int(fields["VmRSS"].split()[0]) / 1024
        return cls(at_s, rss_mb, len(list((proc / "fd").iterdir())), int(fields["Threads"]))


@dataclass(frozen=True)
class Load:
    """What a run under load met with.

    Attributes:
        seconds: How long the robots drove.
        observation_s: Of every observation, all robots together.
        n_requests: Answered as they should be.
        errors: Everything else, the first few in words.
        n_remaps: Remaps that succeeded.
        n_rollbacks: Activations of another version.
        samples: The process, in order.
    """

    seconds: float
    observation_s: tuple[float, ...]
    n_requests: int
    errors: tuple[str, ...]
    n_remaps: int
    n_rollbacks: int
    samples: tuple[Sample, ...]

    def quarter(self, number: int) -> Sample:
        """Medians over a quarter of the run, 0 to 3: the first one still warms up."""
        part = np.array_split(np.arange(len(self.samples)), 4)[number]
        chosen = [self.samples[place] for place in part]
        return Sample(
            float(np.median([each.at_s for each in chosen])),
            float(np.median([each.rss_mb for each in chosen])),
            int(np.median([each.n_handles for each in chosen])),
            int(np.median([each.n_threads for each in chosen])),
        )


def load(
    data_dir: Path,
    seconds: float,
    observe_every_s: float,
    remap_every_s: float,
    episodes: int = 1000,
    on_sample: Callable[[Sample], None] = lambda _: None,
) -> Load:
    """Let robots drive while their domain is remapped.

    Args:
        data_dir: An empty folder.
        seconds: How long.
        observe_every_s: Of every robot.
        remap_every_s: Of the operator, beside the remaps' own time.
        episodes: Of every remap's training.
        on_sample: Told of the process now and then.
    """
    stop = threading.Event()
    with LocalServer(data_dir, environment={"DEEPSIMBAD_LOG_LEVEL": "WARNING"}) as server:
        with Link(server.url) as link:
            make_domain(link)
        robots = [LoadRobot(server.url, stop, number, observe_every_s) for number in range(N_ROBOTS)]
        operator = Operator(server.url, stop, remap_every_s, episodes)
        for driver in (*robots, operator):
            driver.start()
        began = time.monotonic()
        samples = []
        while (at_s := time.monotonic() - began) < seconds:
            samples.append(Sample.of(server.pid, at_s))
            on_sample(samples[-1])
            time.sleep(min(5.0, seconds / 40))
        stop.set()
        for driver in (*robots, operator):
            driver.join()
    tallies = [driver.tally for driver in (*robots, operator)]
    return Load(
        seconds,
        tuple(spent for tally in tallies for spent in tally.seconds),
        sum(tally.n_requests for tally in tallies),
        tuple(error for tally in tallies for error in tally.errors),
        operator.n_remaps,
        operator.n_rollbacks,
        tuple(samples),
    )
