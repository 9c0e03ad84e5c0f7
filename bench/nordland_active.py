"""Active episodes on Nordland images through real HTTP: the default planner against blind moves.

    python -m bench.nordland_active

Map, landmarks and live drive as in `bench.nordland`; ten moves an episode, the same random starts for every planner.
"""

import io
from collections.abc import Iterator

from rich.console import Console

from bench.measurement import RESULTS, Command, machine, print_page, work_folder
from bench.nordland import DOMAIN, REMAP, drive_folders, make_domain
from bench.recordings import real_recordings
from deepsimbad_client import Client
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.active import active_replay
from deepsimbad_client.replay.report import active_tables, summarise_active

PLANNERS = ("default", "random", "constant:10", "constant:8", "constant:5", "nnql")
EPISODES = 150


def lines() -> Iterator[str]:
    """Measure; the lines of the page."""
    nordland = real_recordings() / "nordland"
    with work_folder() as work:
        drives, *_ = drive_folders(nordland, work)
        with LocalServer(work / "data") as server, Client(server.url) as client:
            make_domain(client, drives)
            remap(client, DOMAIN, "map", **REMAP)
            live = open_source(str(drives["live"]))
            walked = active_replay(client, live, DOMAIN, work / "walks", planners=PLANNERS, episodes=EPISODES)
            summary = summarise_active(walked)
    console = Console(width=150, record=True, file=io.StringIO())
    for table in active_tables(summary):
        console.print(table)
    yield from (
        "# Active episodes on Nordland images, through HTTP",
        "",
        f"Made by `python -m bench.nordland_active`: {EPISODES} episodes of ten moves, the same starts for all.",
        "",
        machine(),
        "",
        "Landmarks summer 1000..1999, map summer 0..999, robot winter 0..999; the landmark drive never saw the mapped",
        "stretch, so the default planner knows of its places what the map alone expects of them. Where a second season",
        "of the route is known, see composed.md.",
        "",
        "```",
        console.export_text().rstrip(),
        "```",
    )


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(lines(), RESULTS / "nordland-active.md"))
