"""`python -m bench.fleet_encoder`: a fleet with one encoder beside one whose replicas have networks of their own.

Both run at once and are asked in turn: docs/results/fleet-encoder.md.
"""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np

from bench.fleet import fleet_of, processes_of
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
from bench.robots import grainy_jpegs
from deepsimbad.settings import MEBIBYTE
from deepsimbad_client.http.local_server import LocalServer

N_REPLICAS, N_ROBOTS, N_EACH = 2, 8, 12
URL, JPEG = "/v1/domains/seen/localizations", {"Content-Type": "image/jpeg"}


def make_domain(data_dir: Path, pictures: Sequence[bytes]) -> None:
    """A route of pictures, by the default network."""
    with LocalServer(data_dir) as server, Link(server.url) as link:
        link.ask("PUT", "/v1/admin/domains/seen", {"evaluator": {"kind": "feature_l2"}})
        link.ask("POST", "/v1/admin/domains/seen/traverses", {"name": "drive"})
        for number, body in enumerate(pictures):
            path = f"/v1/admin/domains/seen/traverses/drive/frames/{number}?position_m={number}"
            link.ask("PUT", path, body, JPEG)
        drives = {"training_traverse": "drive", "landmark_traverse": "drive"}
        link.remap("seen", {**drives, "n_landmarks": 20, "training_episodes": 0})


def memory(parent: int, title: str) -> list[int]:
    """Bytes of a fleet's processes of a deployment, by its beginning; what processes share is counted in parts."""
    sizes = []
    for pid in processes_of(title):
        with suppress(OSError):
            if parent in ancestors(pid):
                rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
                sizes.append(1024 * int(rollup.partition("\nPss:")[2].split()[0]))
    return sizes


def ancestors(pid: int) -> Iterator[int]:
    """A process and the processes above it, up to 1."""
    while pid > 1:
        yield pid
        pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def at_once(url: str, pictures: Sequence[bytes]) -> Callable[[], None]:
    """A run of several robots that send one picture after the other."""

    def drive(number: int) -> None:
        with Link(url) as link:
            for view in range(N_EACH):
                link.ask("POST", URL, pictures[number + view], JPEG)

    def run() -> None:
        with ThreadPoolExecutor(N_ROBOTS) as pool:
            list(pool.map(drive, range(N_ROBOTS)))

    return run


def report(n_repeats: int) -> Iterator[str]:
    """Markdown lines."""
    pictures = grainy_jpegs(40)
    with work_folder() as folder:
        make_domain(folder / "encoders-1", pictures)
        shutil.copytree(folder / "encoders-1", folder / "encoders-0")
        shutil.copytree(folder / "encoders-1", folder / "plain")
        plain = LocalServer(folder / "plain")
        quiet, options = {"DEEPSIMBAD_LOG_LEVEL": "WARNING"}, ("--replicas", str(N_REPLICAS), "--encoders")
        without_encoder, with_encoder = (
            fleet_of(folder / f"encoders-{n}", folder / f"store-{n}", quiet, *options, str(n)) for n in range(2)
        )
        servers = (plain, without_encoder, with_encoder)
        with plain, without_encoder, with_encoder:
            body = pictures[7]
            links = [Link(server.url) for server in servers]
            answers = [link.ask("POST", URL, body, JPEG) for link in links]
            for answer in answers:
                del answer["timings_ms"]
            is_same = all(answer == answers[0] for answer in answers)
            alone = interleaved([lambda link=link: link.ask("POST", URL, body, JPEG) for link in links], n_repeats, 20)
            together = interleaved([at_once(server.url, pictures) for server in servers], 3)
            sizes = [
                [memory(server.pid, title) for title in ("domains-", "admin", "encoder")] for server in servers[1:]
            ]
    yield from ("# One encoder for a fleet", "")
    yield (
        f"Made by `python -m bench.fleet_encoder`: a plain service and two fleets of {N_REPLICAS} replicas, one whose "
        "processes have networks of their own and one with an encoder, all up at once and asked in turn for the place "
        "of a JPEG of 640 x 480 pixels by the default network. Memory is the proportional set size: what processes "
        f"share is counted once. The three answers are {'equal' if is_same else '**not** equal'}."
    )
    yield from ("", machine())
    yield from (f"Load average at the end: {', '.join(f'{load:.1f}' for load in os.getloadavg())}.", "")

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
