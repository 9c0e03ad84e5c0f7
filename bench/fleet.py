"""`python -m bench.fleet`: robots ask a fleet whose replicas are killed, and a plain service: docs/results/fleet.md.

Both have the same maps and the same robots, which see the same: every answer of the fleet has one to be equal to.
"""

import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import threading
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Any

import numpy as np

from bench.link import GoneError, Link, RefusedError
from bench.measurement import RESULTS, Command, duration, machine, markdown, print_page, work_folder
from deepsimbad.jobs.versions import import_map
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import export_map
from deepsimbad_client.http.local_server import LocalServer

N_LOOKS, N_LANDMARKS, DIM = 4, 50, 64
SESSION_LENGTH = 40
N_SWITCHES = 6  # the last one is to the version that served


@dataclass
class Run:
    """What the robots of one service met with.

    Attributes:
        seconds: From every observation to its acknowledgement, repeats counted.
        digests: By robot, session and view, the digest of the answer.
        refusals: Documented ones, by code.
        faults: Everything else that should not be.
        alone_s: Seconds of every answer to one robot before the others start.
        n_kills: Replicas killed.
    """

    seconds: list[float] = field(default_factory=list)
    digests: dict[tuple[int, int, int], str] = field(default_factory=dict)
    refusals: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    alone_s: list[float] = field(default_factory=list)
    n_kills: int = 0


def drive(url: str, run: Run, number: int, n_domains: int, every_s: float, stopped: threading.Event) -> None:
    """A robot that observes once in a while, and repeats what was refused."""
    draws = random.Random(number)
    with Link(url) as link:

        def ask(method: str, path: str, body: Any, key: str) -> dict[str, Any]:
            while True:
                try:
                    answer: dict[str, Any] = link.ask(method, path, body, {"Idempotency-Key": key})
                    return answer
                except RefusedError as error:
                    if error.status != HTTPStatus.SERVICE_UNAVAILABLE or not error.code:
                        run.faults.append(str(error))
                    run.refusals[error.code] += 1
                except GoneError as error:
                    run.faults.append(str(error))
                time.sleep(0.2)

        for n_session in range(10**6):
            domain = f"route-{draws.randrange(n_domains)}"
            session = ask("POST", f"/v1/domains/{domain}/sessions", {"seed": number}, f"{number}-{n_session}")
            for view in range(SESSION_LENGTH):
                if stopped.is_set():
                    return
                ranks = np.random.default_rng([number, n_session, view]).permutation(N_LANDMARKS).tolist()
                start_s = time.perf_counter()
                path = f"/v1/sessions/{session['session_id']}/observations?action_m=1"
                answer = ask("POST", path, {"ranked_landmarks": ranks}, f"{view}")
                run.seconds.append(time.perf_counter() - start_s)
                if answer["n_observations"] != view + 1:
                    run.faults.append(f"view {view + 1} was counted as {answer['n_observations']}")
                run.digests[number, n_session, view] = digest(answer)
                time.sleep(max(0.0, every_s - (time.perf_counter() - start_s)))


def digest(answer: dict[str, Any]) -> str:
    """A digest of the parts of an answer that depend on neither the moment nor the asker."""
    content = {name: answer[name] for name in ("domain", "map_version", "belief", "next_best_view", "retrieval")}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def fleet_of(data_dir: Path, store: Path, environment: dict[str, str], *options: str) -> LocalServer:
    """A fleet that is not started yet, whose replicas share their maps in a folder."""
    server = LocalServer(data_dir, data_dir.with_suffix(".log"), environment)
    arguments = ("--data-dir", str(data_dir), "--map-store", f"file://{store}")
    server.command[server.command.index("serve") :] = ["ray", "serve", *options, *arguments]
    return server


def processes_of(title: str) -> list[int]:
    """The processes of this machine that serve a deployment whose name begins like this."""
    command, pids = f"ray::ServeReplica:deepsimbad:{title}".encode(), []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if command in (process / "cmdline").read_bytes():
                pids.append(int(process.name))
    return pids


def measured(url: str, arguments: Namespace, kill_every_s: float | None) -> Run:
    """Let the robots drive; a replica is killed every `kill_every_s` seconds; None: none is."""
    run, stopped, draws = Run(), threading.Event(), random.Random(1)
    with Link(url) as link:
        session = link.ask("POST", "/v1/domains/route-0/sessions", {})
        path = f"/v1/sessions/{session['session_id']}/observations?action_m=0"
        for _ in range(200):
            start_s = time.perf_counter()
            link.ask("POST", path, {"ranked_landmarks": list(range(N_LANDMARKS))})
            run.alone_s.append(time.perf_counter() - start_s)
    with ThreadPoolExecutor(arguments.robots) as pool:
        robots = [
            pool.submit(drive, url, run, number, arguments.domains, arguments.every_s, stopped)
            for number in range(arguments.robots)
        ]
        end_s = time.monotonic() + arguments.seconds
        while (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(left_s, kill_every_s or left_s))
            is_early = kill_every_s is not None and end_s - time.monotonic() > kill_every_s / 2
            if is_early and (pids := processes_of("domains-")):
                os.kill(draws.choice(pids), signal.SIGKILL)
                run.n_kills += 1
        stopped.set()
    for robot in robots:
        robot.result()
    return run


def switched_s(url: str) -> list[float]:
    """Seconds from the request of every rollback, and of its reversal, until no answer is of the other version."""
    seconds = []
    with Link(url) as link:
        for n_switch in range(N_SWITCHES):
            version = 1 + n_switch % 2
            start_s = time.perf_counter()
            link.ask("PUT", "/v1/admin/domains/route-0/active-map", {"version": version, "expected": 3 - version})
            n_right, last = 0, start_s
            while n_right < 20:  # of two owners in turn
                answer = link.ask("POST", "/v1/domains/route-0/localizations", {"ranked_landmarks": [0, 1, 2]})
                is_right = answer["map_version"] == version
                n_right = n_right + 1 if is_right else 0
                last = last if is_right and n_right > 1 else time.perf_counter()
            seconds.append(last - start_s)
    return seconds


def make_domains(data_dir: Path, n_domains: int, n_images: int) -> None:
    """Routes of a few looks; `route-0` has two versions, of which the second serves."""
    looks_dir, files = data_dir.with_name("made"), []
    with LocalServer(looks_dir) as server, Link(server.url) as link:
        for number in range(min(n_domains, N_LOOKS)):
            look, n_frames = f"look-{number}", n_images + 10 * number
            link.ask("PUT", f"/v1/admin/domains/{look}", {"evaluator": {"kind": "feature_l2", "extractor": "none"}})
            encodings = np.random.default_rng(number).normal(size=(n_frames, DIM)).astype(np.float32).cumsum(axis=0)
            link.upload(look, "drive", np.arange(n_frames, dtype=np.float64), encodings)
            drives = {"training_traverse": "drive", "landmark_traverse": "drive"}
            link.remap(look, {**drives, "n_landmarks": N_LANDMARKS, "training_episodes": 0})
            files.append(data_dir.with_name(f"{look}.sqlite"))
    with Catalog.open(looks_dir) as catalog:
        for file in files:
            export_map(catalog, file.stem, None, file)
    with Catalog.open(data_dir) as catalog:
        for number in range(n_domains):
            import_map(catalog, files[number % len(files)], f"route-{number}")
        import_map(catalog, files[1 % len(files)], "route-0")


def report(arguments: Namespace) -> Iterator[str]:
    """Markdown lines."""
    settings = {"DEEPSIMBAD_MAX_SESSIONS": "100000", "DEEPSIMBAD_LOG_LEVEL": "WARNING"}
    with work_folder() as folder:
        make_domains(folder / "plain", arguments.domains, arguments.images)
        shutil.copytree(folder / "plain", folder / "fleet")
        with LocalServer(folder / "plain", folder / "plain.log", settings) as server:
            plain = measured(server.url, arguments, None)
        options = ("--replicas", str(arguments.replicas))
        with fleet_of(folder / "fleet", folder / "store", settings, *options) as server:
            start_s = time.perf_counter()
            switches = switched_s(server.url)
            calm_s = time.perf_counter() - start_s
            fleet = measured(server.url, arguments, arguments.kill_every_s)
    views = plain.digests.keys() & fleet.digests.keys()
    n_wrong = sum(plain.digests[view] != fleet.digests[view] for view in views)
    yield from ("# A fleet whose replicas die", "")
    yield (
        f"Made by `python -m bench.fleet`: {arguments.robots} robots observe every {arguments.every_s:g} s for "
        f"{arguments.seconds:g} s on {arguments.domains} domains of {arguments.images} map images and more, first of a "
        f"plain service, then of a fleet of {arguments.replicas} replicas on the same machine. Of these one is killed "
        f"at random (kill -9) every {arguments.kill_every_s:g} s. Maps and sessions are shared in a folder. The robots "
        "see the same both times, so every answer is compared."
    )
    yield from ("", machine())
    yield from (f"Load average at the end: {', '.join(f'{load:.1f}' for load in os.getloadavg())}.", "")
    rows: list[tuple[str, Any, Any]] = [
        ("kills", "-", fleet.n_kills),
        ("observations acknowledged", len(plain.seconds), len(fleet.seconds)),
        ("answers compared, of them unlike", "-", f"{len(views)}, {n_wrong}"),
        ("acknowledged and lost, or answered otherwise than documented", len(plain.faults), len(fleet.faults)),
        ("503 with Retry-After", plain.refusals.total(), f"{fleet.refusals.total()} {dict(fleet.refusals)}"),
    ]
    for name, share in (("median", 0.5), ("p99", 0.99), ("longest", 1.0)):
        spent = (duration(quantile(run.seconds, share)) for run in (plain, fleet))
        rows.append((f"observation, {name}, repeats counted", *spent))
    alone = [quantile(run.alone_s, 0.5) for run in (plain, fleet)]
    rows.append(("observation of one robot alone, median", *map(duration, alone)))
    yield from markdown(("", "plain", "fleet"), rows)
    yield ""
    yield f"What Ray costs an answer, one robot alone: {alone[1] / alone[0]:.2f} times the plain service's."
    yield (
        f"Another version is answered by every replica at most {duration(max(switches))} after it was asked for, "
        f"rollbacks too ({len(switches)} switches in {duration(calm_s)})."
    )
    if fleet.faults or n_wrong:
        print("\n".join(fleet.faults[:20]), file=sys.stderr)


def quantile(seconds: list[float], share: float) -> float:
    """The quantile of seconds at a share, NaN of none."""
    return float(np.quantile(seconds, share)) if seconds else float("nan")


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("--domains", type=int, default=200)
    command.add_argument("--images", type=int, default=200)
    command.add_argument("--robots", type=int, default=50)
    command.add_argument("--replicas", type=int, default=4)
    command.add_argument("--seconds", type=float, default=180.0)
    command.add_argument("--kill-every-s", type=float, default=20.0)
    command.add_argument("--every-s", type=float, default=2.0, help="between two observations of a robot")
    command.run(lambda arguments: print_page(report(arguments), RESULTS / "fleet.md"))
