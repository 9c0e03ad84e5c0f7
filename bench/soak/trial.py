"""The soak itself: start, let everybody act, kill, check, start again."""

import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bench.link import Link
from bench.soak.actor import Actor, expect, make_domain
from bench.soak.mapper import Mapper
from bench.soak.robot import Robot
from bench.soak.uploader import Uploader
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad_client.http.local_server import LocalServer

N_ROBOTS, SHORT_SESSION = 4, 25
LONGEST_LIFE_S = 4.0
_AIMS = ("", "uploading", "remap:", "activating", "rolling back")  # in turn: at any moment, or in the middle of this
_AIMING_S, _INTO_IT_S = 5.0, {"remap:": 2.0, "uploading": 0.01, "activating": 0.02, "rolling back": 0.02}
ENVIRONMENT = {"DEEPSIMBAD_SNAPSHOT_EVERY": "8", "DEEPSIMBAD_LOG_LEVEL": "ERROR", "DEEPSIMBAD_KEEP_MAPS": "3"}


@dataclass
class Soak:
    """What a soak met with.

    Attributes:
        ready_s: Seconds from each start after a kill to the first `/readyz` that answers 200.
        empty_ready_s: The same of a service on an empty data directory, right before each of them: what the machine
            itself was up to at that moment.
        n_acknowledged: Writes that were answered, by who asked; none was lost, or the soak would have ended.
        doing: What was going on at the moments of the kills; robots observe at all of them.
        n_remaps: Remaps that succeeded, many of them across kills.
        n_interrupted: Remaps that gave up after the service had died three times under them.
    """

    ready_s: list[float] = field(default_factory=list)
    empty_ready_s: list[float] = field(default_factory=list)
    n_acknowledged: Counter[str] = field(default_factory=Counter)
    doing: Counter[str] = field(default_factory=Counter)
    n_remaps: int = 0
    n_interrupted: int = 0


def soak(data_dir: Path, n_kills: int, seed: int, on_kill: Callable[[int], None] = lambda _: None) -> Soak:
    """Kill a service under load; raises LostError where anything acknowledged is lost or any file is damaged.

    Args:
        data_dir: An empty folder.
        n_kills: How often it is killed.
        seed: Of the moments and of the actors; the service's own pace makes every run another one all the same.
        on_kill: Called after each kill with the number of kills so far.
    """
    rng = np.random.default_rng(seed)
    result = Soak()
    server = LocalServer(data_dir, environment=ENVIRONMENT)
    server.start()
    try:
        with Link(server.url) as link:
            make_domain(link)
        kinds = list(FilterKind)
        robots = [Robot(number, kinds[number % len(kinds)]) for number in range(N_ROBOTS)]
        robots += [Robot(N_ROBOTS + number, kinds[number], SHORT_SESSION) for number in range(2)]
        uploader, mapper = Uploader(), Mapper(seed)
        actors: list[Actor] = [*robots, uploader, mapper]
        for kill in range(n_kills):
            _live_and_die(server, actors, _AIMS[kill % len(_AIMS)], rng)
            result.doing.update([uploader.doing, mapper.doing])
            with tempfile.TemporaryDirectory() as folder:
                empty = LocalServer(Path(folder) / "data", environment=ENVIRONMENT)
                result.empty_ready_s.append(_ready(empty))
                empty.kill()
            result.ready_s.append(_ready(server))
            with Link(server.url) as link:
                expect(link.ask("GET", "/readyz")["damaged_maps"] == [], "a map is damaged")
                for actor in actors:
                    actor.check(link)
            on_kill(kill + 1)
        with Link(server.url) as link:
            mapper.finish(link)
            for robot in robots:
                robot.check_bits(link, data_dir)
        uploader.check_bits(data_dir)
        command = [sys.executable, "-m", "deepsimbad", "check", "--json", "--data-dir", str(data_dir)]
        process = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own interpreter
        expect(process.returncode == 0, f"deepsimbad check: {process.stdout} {process.stderr}")
    finally:
        server.kill()
    for actor in actors:
        result.n_acknowledged[type(actor).__name__] += actor.n_acknowledged
    result.n_remaps, result.n_interrupted = mapper.n_remaps, mapper.n_interrupted
    return result


def _ready(server: LocalServer) -> float:
    start_s = time.perf_counter()
    server.start()
    return time.perf_counter() - start_s


def _live_and_die(server: LocalServer, actors: list[Actor], aim: str, rng: np.random.Generator) -> None:
    broken: list[BaseException] = []

    def act(actor: Actor) -> None:
        try:
            actor.until_gone(server.url)
        except BaseException as error:  # raised again by the soak's own thread
            broken.append(error)

    threads = [threading.Thread(target=act, args=(actor,)) for actor in actors]
    for thread in threads:
        thread.start()
    # In the first life everybody is answered once: what was never acknowledged cannot be lost.
    while all(thread.is_alive() for thread in threads) and not all(actor.n_acknowledged for actor in actors):
        time.sleep(0.01)
    time.sleep(float(rng.uniform(0.0, LONGEST_LIFE_S)))
    give_up_at = time.monotonic() + _AIMING_S
    while not any(actor.doing.startswith(aim) for actor in actors) and time.monotonic() < give_up_at:
        time.sleep(0.0005)
    time.sleep(float(rng.uniform(0.0, _INTO_IT_S.get(aim, 0.0))))
    server.kill()
    for thread in threads:
        thread.join()
    if broken:
        raise broken[0]
