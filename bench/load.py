"""Twenty robots and one operator at one service for an hour: errors, latency, leaks.

make load
"""

import sys
import threading
import time
from abc import ABC, abstractmethod
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.link import GoneError, Link, RefusedError
from bench.measurement import Command, machine, markdown, print_page, work_folder
from deepsimbad_client.http.local_server import LocalServer

N_ROBOTS, SESSION_LENGTH = 20, 120
N_IMAGES, N_LANDMARKS, DIM, SPACING_M = 2000, 200, 64, 0.5
DOMAIN = "circuit"
BASE = f"/v1/admin/domains/{DOMAIN}"


def drive_of(seed: int) -> NDArray[np.float32]:
    """[n, d] encodings of one drive around the circuit: places are alike in all, the noise is not."""
    places = np.random.default_rng(0).normal(size=(N_IMAGES, DIM))
    return (places + 0.5 * np.random.default_rng([1, seed]).normal(size=(N_IMAGES, DIM))).astype(np.float32)


def remap_config(episodes: int) -> dict[str, Any]:
    """The body of a remap."""
    drives = {"training_traverse": "training", "landmark_traverse": "landmarks"}
    return {**drives, "n_landmarks": N_LANDMARKS, "training_episodes": episodes}


@dataclass(frozen=True)
class Sample:
    """Resident MB, open file handles and threads of the service's process; jobs run in processes of their own."""

    rss_mb: float
    n_handles: int
    n_threads: int

    @classmethod
    def of(cls, pid: int) -> "Sample":
        """Look at a process now (Linux)."""
        proc = Path(f"/proc/{pid}")
        fields = dict(line.split(":", 1) for line in (proc / "status").read_text(encoding="utf-8").splitlines())
        rss_mb = int(fields["VmRSS"].split()[0]) / 1024
        return cls(rss_mb, len(list((proc / "fd").iterdir())), int(fields["Threads"]))


@dataclass
class Load:
    """What a run under load met with.

    Attributes:
        seconds: How long the robots drove.
        observation_s: Seconds of every observation, all robots together.
        n_requests: Requests answered as they should be.
        errors: Everything else, in words.
        n_remaps: Remaps that succeeded.
        n_rollbacks: Activations of another version.
        samples: Of the service's process, in order.
    """

    seconds: float
    observation_s: list[float] = field(default_factory=list)
    n_requests: int = 0
    errors: list[str] = field(default_factory=list)
    n_remaps: int = 0
    n_rollbacks: int = 0
    samples: list[Sample] = field(default_factory=list)

    def quarter(self, number: int) -> Sample:
        """Medians over a quarter of the run, 0 to 3: the first one still warms up."""
        samples = np.array_split([astuple(sample) for sample in self.samples], 4)[number]
        rss_mb, n_handles, n_threads = np.median(samples, axis=0)
        return Sample(float(rss_mb), int(n_handles), int(n_threads))


class Driver(ABC, threading.Thread):
    """Acts until told to stop; an error is noted and it goes on."""

    def __init__(self, url: str, stop: threading.Event, result: Load, every_s: float) -> None:
        super().__init__(daemon=True)
        self.n_requests = 0
        self._url, self._stopped, self._result, self._every_s = url, stop, result, every_s

    def run(self) -> None:
        """Act again and again."""
        while not self._stopped.is_set():
            with Link(self._url) as link:
                try:
                    while not self._stopped.is_set():
                        self.act(link)
                except (GoneError, RefusedError, AssertionError, RuntimeError) as error:
                    self._result.errors.append(f"{type(self).__name__}: {error}")
                    self.recover()

    @abstractmethod
    def act(self, link: Link) -> None:
        """Do one thing."""

    def recover(self) -> None:
        """Forget what was under way when an error came."""

    def ask(self, link: Link, method: str, path: str, body: Any = b"") -> Any:
        """Send one request, which is counted."""
        answer = link.ask(method, path, body)
        self.n_requests += 1
        return answer


class LoadRobot(Driver):
    """Drives around the circuit: a session of views, then its true positions are fed back, then the next."""

    def __init__(self, url: str, stop: threading.Event, result: Load, every_s: float, number: int) -> None:
        super().__init__(url, stop, result, every_s)
        self._rng = np.random.default_rng([2, number])
        self._encodings = drive_of(100 + number % 3)
        self._place = int(self._rng.integers(N_IMAGES))
        self._session_id = ""
        self._truths_m: list[float] = []

    def act(self, link: Link) -> None:
        """Begin, observe, or end."""
        if not self._session_id:
            self._session_id = self.ask(link, "POST", f"/v1/domains/{DOMAIN}/sessions", {})["session_id"]
            self._truths_m = []
        elif len(self._truths_m) == SESSION_LENGTH:
            self.ask(link, "POST", f"/v1/sessions/{self._session_id}/truths", {"true_positions_m": self._truths_m})
            self.ask(link, "DELETE", f"/v1/sessions/{self._session_id}")
            self._session_id = ""
        else:
            start_s = time.perf_counter()
            self._observe(link)
            spent = time.perf_counter() - start_s
            self._result.observation_s.append(spent)
            self._stopped.wait(max(0.0, self._every_s * self._rng.uniform(0.8, 1.2) - spent))

    def _observe(self, link: Link) -> None:
        n_steps = int(self._rng.integers(1, 7))
        self._place = (self._place + n_steps) % N_IMAGES
        path = f"/v1/sessions/{self._session_id}/observations?action_m={n_steps * SPACING_M}"
        answer = self.ask(link, "POST", path, {"encoding": self._encodings[self._place].tolist()})
        self._truths_m.append(self._place * SPACING_M)
        if answer["n_observations"] != len(self._truths_m):
            raise AssertionError(f"{answer['n_observations']} observations of {len(self._truths_m)}")

    def recover(self) -> None:
        """Begin anew."""
        self._session_id = ""


class Operator(Driver):
    """Remaps, rolls back and forward, adds a drive and removes one, looks at the metrics."""

    def __init__(self, url: str, stop: threading.Event, result: Load, every_s: float, episodes: int) -> None:
        super().__init__(url, stop, result, every_s)
        self._episodes = episodes

    def act(self, link: Link) -> None:
        """Do one round."""
        earlier_version = self.ask(link, "GET", f"/v1/domains/{DOMAIN}")["map_version"]
        job = link.remap(DOMAIN, remap_config(self._episodes))
        self._result.n_remaps += 1
        new_version = job["result"]["map_version"]
        for version, expected in ((earlier_version, new_version), (new_version, earlier_version)):
            self._stopped.wait(self._every_s / 4)
            self.ask(link, "PUT", f"{BASE}/active-map", {"version": version, "expected": expected})
            self._result.n_rollbacks += 1
        name = f"extra-{self._result.n_remaps}"
        link.upload(DOMAIN, name, np.arange(200) * SPACING_M, drive_of(self._result.n_remaps)[:200])
        self.ask(link, "DELETE", f"{BASE}/traverses/{name}")
        link.ask("GET", "/metrics")
        self._stopped.wait(self._every_s / 2)


def load(
    data_dir: Path,
    seconds: float,
    observe_every_s: float,
    remap_every_s: float,
    episodes: int = 1000,
    on_sample: Callable[[Load], None] = lambda _: None,
) -> Load:
    """Let robots drive while their domain is remapped.

    Args:
        data_dir: An empty folder.
        seconds: How long.
        observe_every_s: Seconds between two observations of a robot.
        remap_every_s: Seconds between two remaps, beside their own time.
        episodes: Of every remap's training.
        on_sample: Called with the run now and then.
    """
    stop, result = threading.Event(), Load(seconds)
    with LocalServer(data_dir, environment={"DEEPSIMBAD_LOG_LEVEL": "WARNING"}) as server:
        with Link(server.url) as link:
            link.ask("PUT", BASE, {"evaluator": {"kind": "feature_l2", "extractor": "none"}, "closed": True})
            for seed, name in enumerate(("landmarks", "training")):
                link.upload(DOMAIN, name, np.arange(N_IMAGES) * SPACING_M, drive_of(seed))
            link.remap(DOMAIN, remap_config(500))
        drivers: Sequence[Driver] = [
            *(LoadRobot(server.url, stop, result, observe_every_s, number) for number in range(N_ROBOTS)),
            Operator(server.url, stop, result, remap_every_s, episodes),
        ]
        for driver in drivers:
            driver.start()
        ends_at = time.monotonic() + seconds
        while time.monotonic() < ends_at:
            result.samples.append(Sample.of(server.pid))
            on_sample(result)
            time.sleep(min(5.0, seconds / 40))
        stop.set()
        for driver in drivers:
            driver.join()
    result.n_requests = sum(driver.n_requests for driver in drivers)
    return result


def report(result: Load, observe_every_s: float) -> Iterator[str]:
    """Markdown lines."""
    spent_ms = 1000 * np.array(result.observation_s)
    yield "# An hour under load" if result.seconds >= 3600 else f"# {result.seconds / 60:.1f} minutes under load"
    yield ""
    yield f"Made by `make load`: {N_ROBOTS} robots with an observation every {observe_every_s:g} s each, sessions of"
    yield f"{SESSION_LENGTH} views whose true positions are fed back, on a domain of {N_IMAGES:,} map images that is"
    yield from ("remapped, rolled back and forward all the while, with traverses coming and going.", "")
    yield from (f"{machine()}; robots, remaps and service share it.", "")
    spread = (
        f"median {np.median(spent_ms):.1f} ms, 99 % within {np.quantile(spent_ms, 0.99):.1f} ms, "
        f"longest {spent_ms.max():.0f} ms"
    )
    rows = {
        "minutes": f"{result.seconds / 60:.1f}",
        "requests answered as they should be": f"{result.n_requests:,}",
        "errors": len(result.errors),
        "remaps, activations of another version": f"{result.n_remaps}, {result.n_rollbacks}",
        "an observation, durable": spread,
    }
    yield from markdown(("", ""), rows.items())
    yield from ("", "The service's process, medians over the quarters of the run:", "")
    quarters = [(number + 1, result.quarter(number)) for number in range(4)]
    memory = [(number, f"{part.rss_mb:.0f}", part.n_handles, part.n_threads) for number, part in quarters]
    yield from markdown(("quarter", "resident memory, MB", "file handles", "threads"), memory)
    for error in result.errors:
        yield f"\n    {error}"


def measure(arguments: Namespace) -> None:
    """Run once and print the report; ends with 1 where there were errors."""

    def tell(result: Load) -> None:
        progress = f"\r{len(result.observation_s)} observations, {result.samples[-1].rss_mb:.0f} MB "
        print(progress, end="", file=sys.stderr, flush=True)

    with work_folder() as folder:
        paces = (60 * arguments.minutes, arguments.observe_every, arguments.remap_every)
        result = load(folder / "data", *paces, on_sample=tell)
    print(file=sys.stderr)
    print_page(report(result, arguments.observe_every), arguments.out)
    sys.exit(1 if result.errors else 0)


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("--minutes", type=float, default=60.0)
    command.add_argument("--observe-every", type=float, default=1.0, metavar="SECONDS")
    command.add_argument("--remap-every", type=float, default=60.0, metavar="SECONDS")
    command.add_argument("--out", type=Path, help="write the report here as well")
    command.run(measure)
