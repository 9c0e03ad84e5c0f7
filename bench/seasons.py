"""What further seasons of a route are worth to one map: appended one by one, against all known from the start.

    python -m bench.seasons SOURCE SOURCE SOURCE [SOURCE...]
    python -m bench.seasons --camera FIRST SECOND SOURCE SOURCE [SOURCE...]

SOURCEs are drives of one route in as many seasons. Each is driven in one session on maps of every other, to which the
rest are appended in the order given. With --camera maps of one season learn what a season changes from FIRST and
SECOND, two drives of another route.
"""

import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bench.measurement import ACTIONS_M, machine, markdown
from deepsimbad.core.building import MapPlan, SeenTwice, compose_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.core.route import same_places, true_images_of
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.append import KnownDrives, fuse
from deepsimbad.jobs.build import encode_recording
from deepsimbad_client.recordings.sources import open_source

PLAN = MapPlan(Relevance.COMPOSED, 4, ACTIONS_M, same_route=True)
MOST_LANDMARKS = 300
MAX_PIXELS = 50_000_000
TOLERANCE_M = 2.0
ONE, BY_CAMERA, FROM_THE_START = "one season", "one, and the camera's", "two from the start"
APPENDED = ("one, and one appended", "one, and two appended", "one, and three appended")
KINDS = (ONE, APPENDED[0], FROM_THE_START, *APPENDED[1:], BY_CAMERA)


def lines(sources: Sequence[str]) -> Iterator[str]:
    """The table."""
    yield from (machine(), "", f"`python -m bench.seasons {' '.join(sources)}`", "")
    scores: dict[str, list[tuple[RetrievalScores, RetrievalScores]]] = {kind: [] for kind in KINDS}
    for test, maps_by_kind in worlds(sources):
        for kind, map_ in maps_by_kind:
            scores[kind].append((scores_of(map_, test, stateless=False), scores_of(map_, test, stateless=True)))
    yield from markdown(
        ("map of", "orders", "one session: ANR / R@1 / worst ANR", "every view on its own"),
        ((kind, len(rows), *map(figures, zip(*rows, strict=True))) for kind, rows in scores.items() if rows),
    )


def worlds(sources: Sequence[str]) -> Iterator[tuple[Drive, Iterator[tuple[str, Map]]]]:
    """Every test drive, and the maps that it is driven on."""
    if sources[0] != "--camera":
        drives = encoded(sources)
        for training, test in itertools.permutations(drives, 2):
            yield test, maps(training, [drive for drive in drives if drive not in (training, test)])
        return
    first, second, *drives = encoded(sources[1:])
    camera = (SeenTwice(first, second, same_places(second.route(), first.route())),)
    for training, test in itertools.permutations(drives, 2):
        yield test, by_camera(training, camera)


def by_camera(training: Drive, camera: Sequence[SeenTwice]) -> Iterator[tuple[str, Map]]:
    """Maps of one drive without and with what its camera's seasons taught elsewhere."""
    n_landmarks = min(MOST_LANDMARKS, training.n_frames)
    yield ONE, compose_map(PLAN, training, None, None, n_landmarks).map
    yield BY_CAMERA, compose_map(PLAN, training, None, None, n_landmarks, camera=camera).map


def encoded(sources: Sequence[str]) -> list[Drive]:
    """Every drive; images by the default extractor."""
    drives = []
    for source in sources:
        recording = open_source(source)
        config = {"kind": "feature_l2", **({} if recording.encodings is None else {"extractor": "none"})}
        evaluator = make_evaluator(evaluator_config(config))
        drives.append(encode_recording(recording, evaluator, MAX_PIXELS, lambda _: None).drive)
    return drives


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
    scorer, live = RetrievalScorer(), map_.live_statistics
    truths = true_images_of(test.route(), map_.route, TOLERANCE_M)
    for encoding, truth in zip(test.encodings, truths, strict=True):
        view = Query(np.arange(1.0, map_.n_landmarks + 1, dtype=np.float32), encoding=encoding)
        live = live if stateless or live is None else live.observing(view)
        scorer.add(relevances(map_, view, live), truth)
    return scorer.result()


def figures(scores: Sequence[RetrievalScores]) -> str:
    """Mean ANR, mean R@1 and the worst ANR, in percent."""
    anr = [score.anr for score in scores]
    return f"{np.mean(anr):.2f} / {np.mean([score.recall_at[1] for score in scores]):.1f} / {max(anr):.2f}"


if __name__ == "__main__":
    for line in lines(sys.argv[1:]):
        print(line, flush=True)
