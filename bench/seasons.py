"""What further seasons of a route are worth to one map: appended one by one, against all known from the start.

    python -m bench.seasons SOURCE SOURCE SOURCE [SOURCE...]
    python -m bench.seasons --camera FIRST SECOND SOURCE SOURCE [SOURCE...]

SOURCEs are drives of one route in as many seasons. Each is driven in one session on maps of every other, to which the
rest are appended in the order given. With --camera maps of one season learn what a season changes from FIRST and
SECOND, two drives of another route.
"""

import itertools
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace

from bench.measurement import ACTIONS_M, Command, figures, machine, markdown, print_page, scored
from bench.recordings import encoded
from deepsimbad.core.building import MapPlan, SeenTwice, compose_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScores
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import same_places, true_images_of
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.append import KnownDrives, fuse
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.jobs.experiments.vpr import moves_between, relevances_in_order

PLAN = MapPlan(Relevance.COMPOSED, 4, ACTIONS_M, same_route=True)
MOST_LANDMARKS = 300
TOLERANCE_M = 2.0
ONE, BY_CAMERA, FROM_THE_START = "one season", "one, and the camera's", "two from the start"
APPENDED = ("one, and one appended", "one, and two appended", "one, and three appended")
KINDS = (ONE, APPENDED[0], FROM_THE_START, *APPENDED[1:], BY_CAMERA)


def lines(sources: Sequence[str], camera: Sequence[str]) -> Iterator[str]:
    """The table."""
    yield from (machine(), "", f"`python -m bench.seasons {' '.join(sys.argv[1:])}`", "")
    scores: dict[str, list[tuple[RetrievalScores, RetrievalScores]]] = {kind: [] for kind in KINDS}
    for test, maps_by_kind in worlds([encoded(source) for source in sources], [encoded(source) for source in camera]):
        for kind, map_ in maps_by_kind:
            scores[kind].append((scores_of(map_, test, stateless=False), scores_of(map_, test, stateless=True)))
    yield from markdown(
        ("map of", "orders", "one session: ANR / R@1 / worst ANR", "every view on its own"),
        (
            (kind, len(rows), *(" / ".join(figures(column)) for column in zip(*rows, strict=True)))
            for kind, rows in scores.items()
            if rows
        ),
    )


def worlds(drives: Sequence[Drive], camera: Sequence[Drive]) -> Iterator[tuple[Drive, Iterator[tuple[str, Map]]]]:
    """Every test drive, and the maps that it is driven on."""
    seen_twice = [SeenTwice(camera[0], camera[1], same_places(camera[1].route(), camera[0].route()))] if camera else []
    for training, test in itertools.permutations(drives, 2):
        if seen_twice:
            yield test, by_camera(training, seen_twice)
        else:
            yield test, maps(training, [drive for drive in drives if drive not in (training, test)])


def by_camera(training: Drive, camera: Sequence[SeenTwice]) -> Iterator[tuple[str, Map]]:
    """Maps of one drive without and with what its camera's seasons taught elsewhere."""
    n_landmarks = min(MOST_LANDMARKS, training.n_frames)
    yield ONE, compose_map(PLAN, training, None, None, n_landmarks).map
    yield BY_CAMERA, compose_map(PLAN, training, None, None, n_landmarks, camera=camera).map


def maps(training: Drive, seasons: Sequence[Drive]) -> Iterator[tuple[str, Map]]:
    """Maps of one drive that know more and more of the seasons."""
    n_landmarks = min(MOST_LANDMARKS, training.n_frames)
    map_ = compose_map(PLAN, training, None, None, n_landmarks).map
    map_ = replace(map_, frame_digest=training.digests())
    yield ONE, map_
    drives = [(training, True)]
    for kind, season in zip(APPENDED, seasons, strict=False):
        known_drives = KnownDrives.of(map_, drives, training)
        fused = None if known_drives is None else fuse(map_, known_drives, season, same_route=True)[0]
        if fused is None:
            raise SystemExit("these are no drives of one route")
        map_ = fused.map
        drives.append((season, True))
        yield kind, map_
    if seasons:
        yield FROM_THE_START, compose_map(PLAN, training, seasons[0], seasons[0], n_landmarks).map


def scores_of(map_: Map, test: Drive, *, stateless: bool) -> RetrievalScores:
    """Scores of one session over the drive, or of every view by itself."""
    views = views_of(measure_drive(test, map_.landmark_model, FeatureL2("none")))
    live = None if stateless else map_.live_statistics
    rows = relevances_in_order(map_, views, live, moves_between(test))
    return scored(rows, true_images_of(test.route(), map_.route, TOLERANCE_M))


def measure(arguments: Namespace) -> None:
    """Print the table."""
    if len(arguments.sources) < 2:
        command.error("one drive is mapped and another driven: give two SOURCEs or more")
    print_page(lines(arguments.sources, arguments.camera))


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("sources", nargs="+", metavar="SOURCE")
    command.add_argument("--camera", nargs=2, default=(), metavar=("FIRST", "SECOND"))
    command.run(measure)
