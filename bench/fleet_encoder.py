"""`python -m bench.fleet_encoder`: a fleet with one encoder beside one whose replicas have networks of their own.

Both run at once and are asked in turn: docs/results/fleet-encoder.md.
"""

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from bench.link import Link
from bench.measurement import (
    RESULTS,
    Command,
    Timing,
    duration,
    interleaved,
    machine,
    markdown,
    print_page,
    work_folder,
)
from deepsimbad.settings import MEBIBYTE
from deepsimbad_client.http.local_server import LocalServer

N_IMAGES, N_REPLICAS, N_ROBOTS, N_EACH = 40, 2, 8, 12
URL, JPEG = "/v1/domains/seen/localizations", {"Content-Type": "image/jpeg"}


def picture(number: int) -> bytes:
    """A JPEG of 640 x 480 pixels."""
    coarse = np.random.default_rng(number).integers(0, 255, (12, 16, 3), np.uint8)
    _, body = cv2.imencode(".jpg", cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC))
    return np.asarray(body).tobytes()


def make_domain(data_dir: Path) -> None:
    """A route of pictures, by the default network."""
    with LocalServer(data_dir) as server, Link(server.url) as link:
        link.ask("PUT", "/v1/admin/domains/seen", {"evaluator": {"kind": "feature_l2"}})
        link.ask("POST", "/v1/admin/domains/seen/traverses", {"name": "drive"})
        for number in range(N_IMAGES):
            path = f"/v1/admin/domains/seen/traverses/drive/frames/{number}?position_m={number}"
            link.ask("PUT", path, picture(number), JPEG)
        drives = {"training_traverse": "drive", "landmark_traverse": "drive"}
        link.remap("seen", {**drives, "n_landmarks": 20, "training_episodes": 0})


def fleet_of(folder: Path, n_encoders: int, store: str) -> LocalServer:
    """A fleet that is not started yet, and shares maps with the other one."""
    data_dir = folder / f"encoders-{n_encoders}"
    server = LocalServer(data_dir, folder / f"{data_dir.name}.log", {"DEEPSIMBAD_LOG_LEVEL": "WARNING"})
    server.command[server.command.index("serve") :] = [
        *("ray", "serve", "--replicas", str(N_REPLICAS), "--encoders", str(n_encoders)),
        *("--data-dir", str(data_dir), "--map-store", store),
    ]
    return server


def memory(parent: int, title: str) -> list[int]:
    """Bytes of a fleet's processes of a deployment, by its beginning; what processes share is counted in parts."""
    sizes = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            is_of = f"ray::ServeReplica:deepsimbad:{title}".encode() in (process / "cmdline").read_bytes()
            if is_of and parent in ancestors(int(process.name)):
                lines = (process / "smaps_rollup").read_text().splitlines()
                sizes.append(next(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:")))
        except OSError:
            continue
    return sizes


def ancestors(pid: int) -> Iterator[int]:
    """A process and the processes above it, up to 1."""
    while pid > 1:
        yield pid
        pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def at_once(url: str) -> Callable[[], None]:
    """A run of several robots that send one picture after the other."""

    def drive(number: int) -> None:
        with Link(url) as link:
            for view in range(N_EACH):
                link.ask("POST", URL, picture(number + view), JPEG)

    def run() -> None:
        robots = [threading.Thread(target=drive, args=[number]) for number in range(N_ROBOTS)]
        for robot in robots:
            robot.start()
        for robot in robots:
            robot.join()

    return run


def report(n_repeats: int) -> Iterator[str]:
    """Markdown lines."""
    with work_folder() as folder:
        store = f"file://{folder}/store"
        make_domain(folder / "encoders-1")
        shutil.copytree(folder / "encoders-1", folder / "encoders-0")
        plain, without_encoder, with_encoder = (
            LocalServer(folder / "plain"),
            fleet_of(folder, 0, store + "-0"),
            fleet_of(folder, 1, store + "-1"),
        )
        shutil.copytree(folder / "encoders-1", folder / "plain")
        with plain, without_encoder, with_encoder:
            body = picture(7)
            links = [Link(server.url) for server in (plain, without_encoder, with_encoder)]
            answers = [link.ask("POST", URL, body, JPEG) for link in links]
            for answer in answers:
                del answer["timings_ms"]
            is_same = all(answer == answers[0] for answer in answers)
            alone = interleaved([lambda link=link: link.ask("POST", URL, body, JPEG) for link in links], n_repeats, 20)
            together = interleaved([at_once(server.url) for server in (plain, without_encoder, with_encoder)], 3)
            sizes = [
                [memory(server.pid, title) for title in ("domains-", "admin", "encoder")]
                for server in (without_encoder, with_encoder)
            ]
    yield "# One encoder for a fleet"
    yield ""
    yield (
        f"Made by `python -m bench.fleet_encoder`: a plain service and two fleets of {N_REPLICAS} replicas, one whose "
        "processes have networks of their own and one with an encoder, all up at once and asked in turn for the place "
        "of a JPEG of 640 x 480 pixels by the default network. Memory is the proportional set size: what processes "
        f"share is counted once. The three answers are {'equal' if is_same else '**not** equal'}."
    )
    yield ""
    yield machine()
    yield f"Load average at the end: {', '.join(f'{load:.1f}' for load in os.getloadavg())}."
    yield ""

    def mean_size(sizes: list[int]) -> str:
        return f"{np.mean(sizes) / MEBIBYTE:.0f} MiB" if sizes else "-"

    def a_second(timing: Timing) -> str:
        return f"{N_ROBOTS * N_EACH / timing.median_s:.1f}"

    rows = [
        ("one robot alone, median", *(duration(timing.median_s) for timing in alone)),
        ("one robot alone, p95", *(duration(float(np.quantile(timing.seconds, 0.95))) for timing in alone)),
        (f"{N_ROBOTS} robots at once, images a second", *map(a_second, together)),
        ("memory of a replica", "-", *(mean_size(fleet_sizes[0]) for fleet_sizes in sizes)),
        ("memory of the one that administers", "-", *(mean_size(fleet_sizes[1]) for fleet_sizes in sizes)),
        ("memory of the encoder", "-", *(mean_size(fleet_sizes[2]) for fleet_sizes in sizes)),
        ("memory of all of these", "-", *(f"{sum(map(sum, fleet_sizes)) / MEBIBYTE:.0f} MiB" for fleet_sizes in sizes)),
    ]
    yield from markdown(("", "plain service", "fleet, networks of their own", "fleet, one encoder"), rows)


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("--repeats", type=int, default=200, help="images of the robot that is alone")
    command.run(lambda arguments: print_page(report(arguments.repeats), RESULTS / "fleet-encoder.md"))
