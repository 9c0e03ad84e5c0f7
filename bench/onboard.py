"""What an observation of a few bytes costs: ANR against that of sending all ranks.

    python -m bench.onboard

A robot that encodes on board sends its unit encoding in a few bits a number, or m landmark ids. Landmarks that it does
not send are judged by what is usual for them and by how they go together (`deepsimbad.core.descriptor`).
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.measurement import machine, markdown, real_recordings, write_page
from bench.nordland import LANDMARK_FRAMES, MAP_FRAMES, kept_frames
from deepsimbad.core.building import MapPlan
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer
from deepsimbad.core.on_board import pack_ranked_landmarks, pack_unit_encoding, ranked_landmarks_within
from deepsimbad.core.relevance import Relevance
from deepsimbad.engine.localizer import PackedRanks, PackedUnitEncoding, describe
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.evaluators.space import unit_vectors
from deepsimbad.jobs.build import build, measure_drive, views_of

N_LANDMARKS, N_SENT = (128, 256, 300, 500), (8, 16, 32, 48, 64)  # and as many as the budget holds
N_BITS = (3, 4, 5, 8)  # a number of a unit encoding
LIST_LENGTH, TOLERANCE, BUDGET_BYTES = 4, 2, 64
_DRIVES = ("nr", "nq", "nq2")
_IMAGES_A_BLOCK = 16
_EVALUATOR = FeatureL2("none")

Packed: TypeAlias = PackedRanks | PackedUnitEncoding


@dataclass(frozen=True)
class Drives:
    """A landmark, a training and a test drive, encoded.

    Attributes:
        landmarks, training, test: [n, d] float32 each.
        position: [n] of the training and of the test frames, one a place.
        is_of_two_seasons: Whether the landmark drive shares the places of the training drive, row by row.
    """

    landmarks: NDArray[np.float32]
    training: NDArray[np.float32]
    test: NDArray[np.float32]
    position: NDArray[np.int64]
    is_of_two_seasons: bool

    def map(self, relevance: Relevance, n_landmarks: int) -> Map:
        """The map of the training drive."""
        landmarks, training = (
            Drive(position_m=np.arange(float(len(rows))), encodings=rows) for rows in (self.landmarks, self.training)
        )
        second = landmarks if self.is_of_two_seasons else None
        plan = MapPlan(relevance, LIST_LENGTH, (1.0,), same_route=True)
        return build(plan, training, second, landmarks, n_landmarks, _EVALUATOR).map


def ranked(drives: Drives, map_: Map, m: int) -> list[PackedRanks]:
    """Bodies that a robot sends of the test frames, each its m nearest landmarks."""
    test = Drive(position_m=np.arange(float(len(drives.test))), encodings=drives.test)
    ranks = views_of(measure_drive(test, map_.landmark_model, _EVALUATOR)).ranks
    return [PackedRanks(pack_ranked_landmarks(np.argsort(row)[:m].tolist(), map_.n_landmarks)) for row in ranks]


def encoded(drives: Drives, map_: Map, n_bits: int) -> list[PackedUnitEncoding]:
    """Bodies that a robot sends of the test frames, each its unit encoding at some bits a number."""
    return [PackedUnitEncoding(pack_unit_encoding(u, n_bits)) for u in unit_vectors(drives.test, map_.landmark_model)]


def anr(drives: Drives, map_: Map, views: Iterable[Packed], statistics: str) -> float:
    """ANR in percent over the test drive.

    Args:
        drives: Where the test frames were taken.
        built: The map.
        views: What was sent of every test frame.
        how: `session`: with the live statistics of a drive in order; `alone`: every view by the map's.
    """
    scorer, live = RetrievalScorer(), map_.live_statistics
    for frame, view in enumerate(views):
        query = describe(map_, _EVALUATOR, view)
        live = live.observing(query) if live is not None and statistics == "session" else live
        truths = np.flatnonzero(np.abs(drives.position - drives.position[frame]) <= TOLERANCE)
        scorer.add(relevances(map_, query, live), truths)
    return scorer.result().anr


def netvlad(folder: Path) -> list[Drives]:
    """The six landmark-training-test permutations of three drives."""
    encodings = {name: np.load(folder / f"{name}.npy").astype(np.float32) for name in _DRIVES}
    return [
        Drives(encodings[landmarks], encodings[training], encodings[test], np.arange(len(encodings[test])), True)
        for landmarks, training, test in itertools.permutations(_DRIVES)
    ]


def nordland(folder: Path) -> list[Drives]:
    """Landmarks from summer frames 1000..1999, the map from summer 0..999, live images from winter 0..999."""
    summer, winter = folder / "summer", folder / "winter"
    map_frames, landmark_frames = kept_frames((summer, winter), MAP_FRAMES), kept_frames((summer,), LANDMARK_FRAMES)
    evaluator = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "efficientnet_lite0"}))
    landmarks, training, test = (
        _encoded(evaluator, season, numbers)
        for season, numbers in ((summer, landmark_frames), (summer, map_frames), (winter, map_frames))
    )
    return [Drives(landmarks, training, test, np.array(map_frames), False)]


def _encoded(evaluator: Evaluator, season: Path, numbers: Sequence[int]) -> NDArray[np.float32]:
    images = [np.asarray(cv2.imread(str(season / f"{number:05}.png")), np.uint8) for number in numbers]
    blocks = (images[first : first + _IMAGES_A_BLOCK] for first in range(0, len(images), _IMAGES_A_BLOCK))
    return np.concatenate([evaluator.encode(block) for block in blocks])


def table(triplets: Sequence[Drives]) -> Iterator[str]:
    """A Markdown line for every r and body, each figure the mean over the triplets."""
    head = ("r", "sent", "bytes", "**composed**", "composed, views alone", "rrf")
    return markdown(head, (row for n_landmarks in N_LANDMARKS for row in _rows(triplets, n_landmarks)))


def _rows(triplets: Sequence[Drives], n_landmarks: int) -> Iterator[list[str]]:
    composed = [(drives, drives.map(Relevance.COMPOSED, n_landmarks)) for drives in triplets]
    rrf = [(drives, drives.map(Relevance.RRF, n_landmarks)) for drives in triplets]
    columns = [(composed, "session"), (composed, "alone"), (rrf, "session")]
    all_ranks: list[float] = []
    for m in (n_landmarks, *N_SENT, ranked_landmarks_within(BUDGET_BYTES, n_landmarks)):
        n_bytes, means = _measured(columns, partial(ranked, m=m))
        costs = [f"{mean:.2f}{_cost(mean, best)}" for mean, best in zip_longest(means, all_ranks)]
        all_ranks = all_ranks or means
        yield [str(n_landmarks), "all ranks" if m == n_landmarks else f"{m} ranks", n_bytes, *costs]
    for n_bits in N_BITS:
        n_bytes, means = _measured(columns[:2], partial(encoded, n_bits=n_bits))
        costs = [f"{mean:.2f}{_cost(mean, best)}" for mean, best in zip(means, all_ranks, strict=False)]
        yield [str(n_landmarks), f"u, {n_bits} bits a number", n_bytes, *costs, ""]


def _measured(
    columns: Sequence[tuple[Sequence[tuple[Drives, Map]], str]], pack: Callable[[Drives, Map], Sequence[Packed]]
) -> tuple[str, list[float]]:
    """The bytes of a body, bold where the budget holds it, and the ANR of every column."""
    n_bytes = len(pack(*columns[0][0][0])[0].body)
    means = [
        float(np.mean([anr(drives, map_, pack(drives, map_), statistics) for drives, map_ in maps]))
        for maps, statistics in columns
    ]
    return f"**{n_bytes}**" if n_bytes <= BUDGET_BYTES else str(n_bytes), means


def _cost(mean: float, best: float | None) -> str:
    """How much worse a mean is than that of all ranks, in percent; empty where there is none to compare with."""
    return "" if best is None else f" ({100 * (mean / best - 1):+.0f} %)"


def report(recordings: Path) -> Iterator[str]:
    """The lines of the page."""
    yield from ("# Encoding on board: what an observation of a few bytes costs", "")
    yield (
        "A robot that encodes on board sends its unit encoding u as `application/vnd.deepsimbad.unit-encoding`, a few "
        "bits a number, or its m nearest landmarks as `application/vnd.deepsimbad.ranks`, two bytes and ceil(log2 r) "
        "bits a landmark. ANR in percent (0 is perfect, 50 chance) and, in brackets, how much worse that is than "
        f"sending all ranks; bodies of at most {BUDGET_BYTES} bytes are in bold. h = {LIST_LENGTH}, tolerance "
        f"{TOLERANCE} frames; one session over the test drive in order, but for `views alone` (each by the map's "
        "statistics, as single localizations are answered)."
    )
    yield ""
    yield (
        "`composed` is the default. Of u the products with all landmarks follow, and a session moves and scales them "
        "by what is usual in it. Of a landmark that was not sent the score is the expected one, given the landmarks "
        "that were, how landmarks went together over the map's drive, and that it is farther than the last that was "
        "sent; its evidence counts by how much of it is known. `rrf`, which compares ranks, has no statistics and "
        "takes the mean of the ranks left."
    )
    yield from ("", "Made by `python -m bench.onboard`.", "", machine(), "", "## NetVLAD encodings of Nordland", "")
    yield "Mean over the six landmark-training-test permutations of three drives, 600 places, 64 numbers each."
    yield ""
    yield from table(netvlad(recordings / "nordland_netvlad64"))
    yield ""
    yield from ("## Images of Nordland, winter on a summer map", "")
    yield (
        "Extractor efficientnet_lite0; landmarks come from another part of the route (summer 1000..1999), so no second "
        "season is known. Frames that show nothing are left out, as in [nordland-http.md](nordland-http.md)."
    )
    yield ""
    yield from table(nordland(recordings / "nordland"))


if __name__ == "__main__":
    write_page("onboard.md", report(real_recordings()))
