"""Twenty robots and one operator, each at its own pace."""

import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.soak.link import GoneError, Link, RefusedError
from bench.soak.world import NPZ, packed

DOMAIN = "circuit"
BASE = f"/v1/admin/domains/{DOMAIN}"
N_IMAGES, N_LANDMARKS, DIM, SPACING_M = 2000, 200, 64, 0.5
SESSION_LENGTH = 120
_FINAL = {"succeeded", "failed", "cancelled"}
_MOST_ERRORS_KEPT = 20


def places() -> NDArray[np.float64]:
    """[n, d] what every place looks like in no season at all."""
    return np.random.default_rng(0).normal(size=(N_IMAGES, DIM))


def drive(seed: int, noise: float = 0.5) -> NDArray[np.float32]:
    """[n, d] encodings of one drive around the circuit."""
    return (places() + noise * np.random.default_rng([1, seed]).normal(size=(N_IMAGES, DIM))).astype(np.float32)


def make_domain(link: Link) -> None:
    """The domain, two drives of it and its first map."""
    link.ask("PUT", BASE, {"evaluator": {"kind": "feature_l2", "extractor": "none"}, "closed": True})
    n = np.arange(N_IMAGES)
    for seed, name in enumerate(("landmarks", "training")):
        link.ask("POST", f"{BASE}/traverses", {"name": name})
        batch = packed(encodings=drive(seed), index=n, position_m=n * SPACING_M)
        link.ask("POST", f"{BASE}/traverses/{name}/frames", batch, NPZ)
    job = wait_for(link, ask_for_remap(link, episodes=500))
    if job["state"] != "succeeded":
        raise RuntimeError(f"the first map failed: {job}")


def ask_for_remap(link: Link, episodes: int) -> str:
    """Id of the job of a remap."""
    config = {
        "training_traverse": "training",
        "landmark_traverse": "landmarks",
        "n_landmarks": N_LANDMARKS,
        "training_episodes": episodes,
    }
    return str(link.ask("POST", f"{BASE}/remaps", config)["job_id"])


def wait_for(link: Link, job_id: str, every_s: float = 0.2) -> dict[str, Any]:
    """The job, ended."""
    while True:
        job: dict[str, Any] = link.ask("GET", f"/v1/admin/jobs/{job_id}")
        if job["state"] in _FINAL:
            return job
        time.sleep(every_s)


@dataclass
class Tally:
    """What one driver met with.

    Attributes:
        seconds: Of every observation.
        n_requests: All requests that were answered as they should be.
        errors: The first few that were not.
    """

    seconds: list[float] = field(default_factory=list)
    n_requests: int = 0
    errors: list[str] = field(default_factory=list)


class Driver(ABC, threading.Thread):
    """Acts until told to stop; an error is noted and it goes on.

    Args:
        url: Of the service.
        stop: Set when it is over.
    """

    def __init__(self, url: str, stop: threading.Event) -> None:
        super().__init__(daemon=True)
        self._url, self._stopped = url, stop
        self.tally = Tally()

    def run(self) -> None:
        """Act again and again."""
        while not self._stopped.is_set():
            with Link(self._url) as link:
                try:
                    while not self._stopped.is_set():
                        self.act(link)
                except (GoneError, RefusedError, AssertionError) as error:
                    if len(self.tally.errors) < _MOST_ERRORS_KEPT:
                        self.tally.errors.append(f"{type(self).__name__}: {error}")
                    self.recover()

    @abstractmethod
    def act(self, link: Link) -> None:
        """Do one thing."""

    def recover(self) -> None:
        """Forget what was under way when an error came."""

    def ask(self, link: Link, method: str, path: str, body: Any = b"") -> Any:
        """One counted request."""
        answer = link.ask(method, path, body)
        self.tally.n_requests += 1
        return answer


class LoadRobot(Driver):
    """Drives around the circuit: a session of views, then its true positions are fed back, then the next.

    Args:
        url: Of the service.
        stop: Set when it is over.
        number: Of the robot.
        every_s: From one observation to the next, if the service is quick enough.
    """

    def __init__(self, url: str, stop: threading.Event, number: int, every_s: float) -> None:
        super().__init__(url, stop)
        self._every_s = every_s
        self._rng = np.random.default_rng([2, number])
        self._encodings = drive(100 + number % 3)
        self._place = int(self._rng.integers(N_IMAGES))
        self._session_id = ""
        self._truths: list[float] = []

    def act(self, link: Link) -> None:
        """Begin, observe, or end."""
        if not self._session_id:
            self._session_id = self.ask(link, "POST", f"/v1/domains/{DOMAIN}/sessions", {})["session_id"]
            self._truths = []
        elif len(self._truths) == SESSION_LENGTH:
            self.ask(link, "POST", f"/v1/sessions/{self._session_id}/truths", {"true_positions_m": self._truths})
            self.ask(link, "DELETE", f"/v1/sessions/{self._session_id}")
            self._session_id = ""
        else:
            began = time.perf_counter()
            self._observe(link)
            spent = time.perf_counter() - began
            self.tally.seconds.append(spent)
            self._stopped.wait(max(0.0, self._every_s * self._rng.uniform(0.8, 1.2) - spent))

    def _observe(self, link: Link) -> None:
        n_steps = int(self._rng.integers(1, 7))
        self._place = (self._place + n_steps) % N_IMAGES
        path = f"/v1/sessions/{self._session_id}/observations?action_m={n_steps * SPACING_M}"
        answer = self.ask(link, "POST", path, {"encoding": self._encodings[self._place].tolist()})
        self._truths.append(self._place * SPACING_M)
        if answer["n_observations"] != len(self._truths):
            raise AssertionError(f"{answer['n_observations']} observations of {len(self._truths)}")

    def recover(self) -> None:
        """Begin anew."""
        self._session_id = ""


class Operator(Driver):
    """Remaps, rolls back and forward, adds a drive and removes one, looks at the metrics.

    Args:
        url: Of the service.
        stop: Set when it is over.
        every_s: From the end of one round to the next.
        episodes: Of a remap's training.
    """

    def __init__(self, url: str, stop: threading.Event, every_s: float, episodes: int) -> None:
        super().__init__(url, stop)
        self._every_s, self._episodes = every_s, episodes
        self.n_remaps = self.n_rollbacks = 0

    def act(self, link: Link) -> None:
        """One round."""
        before = self.ask(link, "GET", f"/v1/domains/{DOMAIN}")["map_version"]
        job = wait_for(link, ask_for_remap(link, self._episodes))
        if job["state"] != "succeeded":
            raise AssertionError(f"a remap ended as {job}")
        self.n_remaps += 1
        made = job["result"]["map_version"]
        for version, expected in ((before, made), (made, before)):
            self._stopped.wait(self._every_s / 4)
            self.ask(link, "PUT", f"{BASE}/active-map", {"version": version, "expected": expected})
            self.n_rollbacks += 1
        self._add_and_remove_a_drive(link)
        link.ask("GET", "/metrics")
        self._stopped.wait(self._every_s / 2)

    def _add_and_remove_a_drive(self, link: Link) -> None:
        name, n = f"extra-{self.n_remaps}", np.arange(200)
        self.ask(link, "POST", f"{BASE}/traverses", {"name": name})
        batch = packed(encodings=drive(self.n_remaps)[:200], index=n, position_m=n * SPACING_M)
        link.ask("POST", f"{BASE}/traverses/{name}/frames", batch, NPZ)
        self.ask(link, "DELETE", f"{BASE}/traverses/{name}")
