"""One view of many domains: is the true one told, with what certainty, and what does it take?

    DEEPSIMBAD_REAL_DATA=... python -m bench.many_domains
    python -m bench.many_domains --domains 100000 [--work DIR]

The first writes docs/results/many-domains.md. The second makes a data directory of so many domains, starts a service
on it and prints what start, memory, cold and warm answers take.
"""

import os
import time
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.load import Sample
from bench.measurement import ACTIONS_M, RESULTS, Command, duration, machine, markdown, print_page, timed, work_folder
from bench.recordings import encoded, netvlad_drives, real_recordings
from bench.worlds import LIST_LENGTH, composed_map, scattered_lists
from deepsimbad.core.atlas import Atlas, posterior
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.composed import unit
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.evaluators.compute import available_cores
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.layout import maps_folder, traverses_folder
from deepsimbad.store.map_file import seal, write_map
from deepsimbad.store.records import current_moment
from deepsimbad_campus.writer import write_campus
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

Encodings = NDArray[np.float32]
PLAN = MapPlan(Relevance.COMPOSED, LIST_LENGTH, ACTIONS_M, same_route=True)
BOUNDS = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)
N_DOMAINS, N_IMAGES, N_DISTINCT = 1000, 10_000, 2000


@dataclass(frozen=True)
class World:
    """Domains, and views of which the true domain is known; None: it is none of them."""

    name: str
    maps: Mapping[str, Map]
    views: Sequence[tuple[Encodings, str | None]]


# Whether it is right


def composed_map_of(*seasons: Drive) -> Map:
    """A map of one season of a route, or of two."""
    second = seasons[1] if len(seasons) > 1 else None
    return compose_map(PLAN, seasons[0], second, second, min(300, seasons[0].n_frames // 2)).map


def pieces(name: str, maps: Sequence[Drive], live: Drive, length: int, step: int = 3) -> World:
    """Every other stretch of a route is a domain, and those between are none."""
    stretches = range(0, live.n_frames - length + 1, length)
    domains = {
        f"{start}": composed_map_of(*(season.at(np.arange(start, start + length)) for season in maps))
        for start in stretches[::2]
    }
    views = [
        (live.encodings[i], str(start) if str(start) in domains else None)
        for start in stretches
        for i in range(start, start + length, step)
    ]
    return World(name, domains, views)


def worlds(data: Path, work: Path) -> Iterator[World]:
    """Worlds that the constants were not chosen on: seasons have exchanged their parts, the campuses are new."""
    nr, nq, nq2 = netvlad_drives()
    yield pieces("railway by NetVLAD (64 numbers), stretches of 100, one season", (nq2,), nr, 100)
    yield pieces("the same, two seasons", (nq2, nq), nr, 100)
    summer, winter = (encoded(data / "nordland" / season) for season in ("summer", "winter"))
    shows_place = ~np.any([drive.shows_nothing | drive.is_unlike_all for drive in (summer, winter)], axis=0)
    summer, winter = (drive.at(np.flatnonzero(shows_place)) for drive in (summer, winter))
    yield pieces("railway, 64 x 32 pixels, stretches of 200, map winter, live summer", (winter,), summer, 200, 4)
    ref, query = (encoded(data / "corridor" / name) for name in ("ref", "query"))
    campuses = []
    for seed in (2, 3, 4):
        sources = write_campus(work / f"campus-{seed}", ("winter", "summer", "autumn"), 150, seed)
        campuses.append([encoded(source) for source in sources])
    railway = {"railway, short": composed_map_of(winter.at(np.arange(150)))}
    railway["railway, long"] = composed_map_of(winter.at(np.arange(300, 1300)))
    maps = {f"campus {n}": composed_map_of(*drives[:2]) for n, drives in enumerate(campuses[:2])}
    maps |= {"corridor": composed_map_of(query), **railway}
    railway_views = [(view, "railway, short") for view in summer.encodings[:150:5]]
    railway_views += [(view, "railway, long") for view in summer.encodings[300:1300:20]]
    views = [
        (view, f"campus {n}" if n < 2 else None)
        for n, (*_, autumn) in enumerate(campuses)
        for view in autumn.encodings[::3]
    ]
    views += [(view, "corridor") for view in ref.encodings[::3]] + railway_views
    views += [(view, None) for view in summer.encodings[1500::10]]
    yield World(
        "routes of different kinds: two campuses in two seasons, a corridor, a short and a long railway", maps, views
    )
    views = railway_views + [(view, None) for view in (*ref.encodings[::3], *campuses[0][2].encodings[::3])]
    yield World("of these the railways alone, views of none are of the corridor and a campus", railway, views)


def quality_row(world: World, likeliest: list[tuple[float, bool]]) -> Sequence[object]:
    """The cells of a world; the probability of every view's likeliest domain, and whether that is true, are added."""
    atlas, names = Atlas(list(world.maps.values())), list(world.maps)
    right, on_route, off_route = [], [], []
    for view, truth in world.views:
        log_evidences = dict(zip(names, atlas.log_evidences(view).tolist(), strict=True))
        probabilities, elsewhere_probability = posterior(log_evidences)
        if truth is None:
            off_route.append(elsewhere_probability)
            continue
        best = max(probabilities, key=lambda name: probabilities[name])
        right.append(best == truth)
        on_route.append(elsewhere_probability)
        likeliest.append((probabilities[best], best == truth))
    bar = float(np.quantile(on_route, 0.95))
    return (
        *(world.name, len(names), len(right), f"{100 * np.mean(right):.0f} %", f"{100 / len(names):.0f} %"),
        *(f"{np.median(on_route):.3f} / {np.median(off_route):.3f}", len(off_route)),
        f"{100 * np.mean(np.array(off_route) > bar):.0f} %",
    )


def quality_lines(data: Path, work: Path) -> Iterator[str]:
    """Lines of two tables: how often the true domain is the likeliest, and how often at which probability."""
    likeliest: list[tuple[float, bool]] = []
    yield from markdown(
        (
            *("domains", "how many", "views of them", "true one likeliest", "by chance"),
            *("median `elsewhere`: views of them / of none", "views of none", "above 95 % of the views of them"),
        ),
        (quality_row(world, likeliest) for world in worlds(data, work)),
    )
    yield from (
        "",
        "How often the likeliest domain is the true one, of all views of domains, by the probability told:",
        "",
    )
    chance, is_right = np.array([p for p, _ in likeliest]), np.array([ok for _, ok in likeliest])
    table = []
    for low, high in pairwise(BOUNDS):
        in_range = (chance > low) & (chance <= high)
        if in_range.any():
            mean, share = f"{100 * chance[in_range].mean():.0f} %", f"{100 * is_right[in_range].mean():.0f} %"
            table.append((f"{low:g} .. {high:g}", int(in_range.sum()), mean, share))
    yield from markdown(("told", "views", "mean told", "true"), table)


# What it takes in one process


def speed_lines() -> Iterator[str]:
    """Lines on the time of the posterior over many domains, after encoding."""
    rng = np.random.default_rng(0)
    base = composed_map(scattered_lists(N_IMAGES))
    landmarks = base.landmark_model["prototypes"]

    def maps(n: int, d: int | None, is_shared: bool) -> list[Map]:
        """Maps for encodings of 96 numbers, or of d numbers that each map projects by itself."""
        made_maps = []
        for _ in range(n):
            model: dict[str, Any] = {"prototypes": landmarks if is_shared else unit(rng.normal(size=landmarks.shape))}
            usual_encoding = base.usual_encoding
            if d is not None:
                model["projection"] = rng.normal(size=(d, 96)).astype(np.float32)
                usual_encoding = np.stack([np.zeros(d), np.ones(d)]).astype(np.float32)
            lists = np.ascontiguousarray(np.roll(base.lists, int(rng.integers(N_IMAGES)), axis=1))
            made_maps.append(replace(base, lists=lists, landmark_model=model, usual_encoding=usual_encoding))
        return made_maps

    rows, pool = [], ThreadPoolExecutor(available_cores())
    for name, n, d, is_shared in (
        ("landmarks of their own, encodings of 96 numbers", N_DOMAINS, None, False),
        ("one landmark model", N_DOMAINS, None, True),
        ("8,064 numbers, projected by every domain", 100, 8064, False),
    ):
        atlas = Atlas(maps(n, d, is_shared))
        names = [f"{number}" for number in range(n)]

        def ask(atlas: Atlas = atlas, names: Sequence[str] = names, d: int = d or 96) -> None:
            view = rng.normal(size=d).astype(np.float32)
            posterior(dict(zip(names, atlas.log_evidences(view, pool).tolist(), strict=True)))

        timing = timed(ask, 60, 5)
        rows.append((name, n, str(timing), duration(timing.median_s / n)))
    yield from markdown((f"domains of {N_IMAGES:,} map images", "how many", "one view of all", "a domain"), rows)


# A data directory of many domains


def write_domains(data_dir: Path, n: int) -> None:
    """Domains of 200 map images each, straight into catalog and folders: distinct files, later hard links."""
    drive = Drive(
        position_m=np.arange(200.0), encodings=np.random.default_rng(0).normal(size=(200, 64)).astype(np.float32)
    )
    map_ = replace(composed_map_of(drive), evaluator={"kind": "feature_l2", "extractor": "none"})
    moment, digest, n_bytes = current_moment(), "", 0
    domains, versions = [], []
    with Catalog.open(data_dir) as catalog:
        for number in range(n):
            name = f"d{number:06}"
            path = maps_folder(data_dir, name) / "000001.sqlite"
            path.parent.mkdir(parents=True)
            traverses_folder(data_dir, name).mkdir()
            if number < N_DISTINCT or number % 1000 == 0:
                building, lists = path.with_suffix(".building"), np.roll(map_.lists, number, axis=1)
                write_map(building, replace(map_, domain=name, version=1, lists=lists))
                digest, n_bytes = seal(building, path)
                distinct = path
            else:
                os.link(distinct, path)
            domains.append((name, '{"extractor":"none","kind":"feature_l2"}', 0, "[1.0,2.0]", moment, 2))
            versions.append((name, 1, "active", moment, digest, n_bytes, '{"relevance":"composed"}', "{}", moment))
        with catalog._writing() as db:
            into = "domain (name, evaluator, closed, actions_m, created_at, next_version)"
            db.conn.executemany(f"INSERT INTO {into} VALUES (?, ?, ?, ?, ?, ?)", domains)  # noqa: S608
            into = "map (domain, version, state, created_at, sha256, file_bytes, config, metrics, activated_at)"
            db.conn.executemany(f"INSERT INTO {into} VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", versions)  # noqa: S608


def directory_lines(n: int, work: Path) -> Iterator[str]:
    """Lines on start, memory, cold and warm answers of a service of n domains, beside one of a single domain."""
    figures: dict[str, dict[int, str]] = {}
    memory_mib = {}
    view = np.random.default_rng(1).normal(size=64).tolist()
    for n_made in (1, n):
        folder = work / f"domains-{n_made}"
        if not folder.exists():
            write_domains(folder, n_made)
        for _ in range(2):  # the first start of an installation compiles
            start_s = time.perf_counter()
            with LocalServer(folder) as server, Client(server.url) as client:
                ready_s = time.perf_counter() - start_s
                memory_mib[n_made] = Sample.of(server.pid).rss_mb

                def ask(name: str, client: Client = client) -> None:
                    client.localize(name, encoding=view)

                warm = timed(lambda: ask("d000000"), 300, 20)
                numbers = np.random.default_rng(2).permutation(np.arange(min(n_made, 1000), min(n_made, N_DISTINCT)))
                cold_s = [timed(lambda: ask(f"d{number:06}"), 1, 0).median_s for number in numbers[:400]]  # noqa: B023
                domains = [f"d{number:06}" for number in numbers[:400]]

                def ask_all(domains: Sequence[str] = domains, client: Client = client) -> None:
                    client.localize_anywhere(encoding=view, domains=domains)

                together = timed(ask_all, 20, 2) if domains else None
        figures.setdefault("ready after", {})[n_made] = duration(ready_s)
        figures.setdefault("memory when ready", {})[n_made] = f"{memory_mib[n_made]:.0f} MiB"
        figures.setdefault("warm answer", {})[n_made] = str(warm)
        if cold_s:
            figures["cold answer, median / p99"] = {
                n_made: f"{duration(float(np.median(cold_s)))} / {duration(float(np.quantile(cold_s, 0.99)))}"
            }
            figures["one view of 400 of them"] = {n_made: str(together)}
    yield from (machine(), "", f"Load when it ended: {os.getloadavg()[0]:.1f}. Files lie in the system's cache.", "")
    rows = ((figure, *(values.get(count, "") for count in (1, n))) for figure, values in figures.items())
    yield from markdown(("", "one domain", f"{n:,} domains"), rows)
    yield from ("", f"Memory of a further domain: {(memory_mib[n] - memory_mib[1]) * 2**20 / n / 1000:.2f} kB.")


def page(data: Path, work: Path) -> Iterator[str]:
    """docs/results/many-domains.md."""
    yield from (
        "# One view of many domains",
        "",
        "Made by `DEEPSIMBAD_REAL_DATA=... python -m bench.many_domains`.",
        "",
    )
    yield from (machine(), "", "## Is the true domain told", "")
    yield from (
        "Single views, all domains as probable before. The constants of `core/atlas.py` were chosen on other",
        "directions of the same recordings (summer mapped, winter live) and on other campuses: these maps are new,",
        "most cameras are not.",
        "",
    )
    yield from quality_lines(data, work)
    yield from (
        "",
        "## What it takes",
        "",
        "After encoding, in one process, in as many threads as there are cores.",
        "",
    )
    yield from speed_lines()


def measure(arguments: Namespace) -> None:
    """Print what was asked for."""
    with work_folder(arguments.work) as work:
        if arguments.speed:
            print_page(speed_lines())
        elif arguments.domains is not None:
            print_page(directory_lines(arguments.domains, work))
        else:
            print_page(page(real_recordings(), work), RESULTS / "many-domains.md")


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("--domains", type=int)
    command.add_argument("--work", type=Path)
    command.add_argument("--speed", action="store_true", help="print the speed alone")
    command.run(measure)
