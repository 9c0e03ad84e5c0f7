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
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from bench.measurement import RESULTS, Command, machine, markdown, print_page, scored
from bench.nordland import LANDMARK_FRAMES, MAP_FRAMES, kept_frames
from bench.recordings import encoded, netvlad_drives, real_recordings
from deepsimbad.core.building import MapPlan
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.on_board import pack_ranked_landmarks, pack_unit_encoding, ranked_landmarks_within
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.engine.localizer import PackedRanks, PackedUnitEncoding, describe
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.space import unit_vectors
from deepsimbad.jobs.build import build, measure_drive, views_of
from deepsimbad.jobs.experiments.vpr import moves_between

N_LANDMARKS, N_SENT = (128, 256, 300, 500), (8, 16, 32, 48, 64)  # and as many as the budget holds
N_BITS = (3, 4, 5, 8)  # a number of a unit encoding
LIST_LENGTH, TOLERANCE, BUDGET_BYTES = 4, 2, 64
_EVALUATOR = FeatureL2("none")

Packed: TypeAlias = PackedRanks | PackedUnitEncoding


@dataclass(frozen=True)
class Drives:
    """A landmark, a training and a test drive, and whether the first drove the route of the others."""

    landmarks: Drive
    training: Drive
    test: Drive
    is_of_two_seasons: bool

    def map(self, relevance: Relevance, n_landmarks: int) -> Map:
        """The map of the training drive."""
        second = self.landmarks if self.is_of_two_seasons else None
        plan = MapPlan(relevance, LIST_LENGTH, (1.0,), same_route=True)
        return build(plan, self.training, second, self.landmarks, n_landmarks, _EVALUATOR).map


def ranks_of(test: Drive, map_: Map, m: int) -> list[PackedRanks]:
    """Bodies that a robot sends of the test frames, each its m nearest landmarks."""
    ranks = views_of(measure_drive(test, map_.landmark_model, _EVALUATOR)).ranks
    return [PackedRanks(pack_ranked_landmarks(np.argsort(row)[:m].tolist(), map_.n_landmarks)) for row in ranks]


def units_of(test: Drive, map_: Map, n_bits: int) -> list[PackedUnitEncoding]:
    """Bodies that a robot sends of the test frames, each its unit encoding at some bits a number."""
    units = unit_vectors(test.encodings, map_.landmark_model)
    return [PackedUnitEncoding(pack_unit_encoding(u, n_bits)) for u in units]


def anr(test: Drive, map_: Map, views: Iterable[Packed], *, in_session: bool) -> float:
    """ANR in percent over the test drive, of what was sent of every frame in one session, or of each view alone."""

    def rows() -> Iterator[NDArray[np.float32]]:
        live = map_.live_statistics if in_session else None
        for view, moved_m in zip(views, moves_between(test), strict=True):
            query = describe(map_, _EVALUATOR, view)
            live, _ = map_.after_view(live, query, moved_m)
            yield relevances(map_, query, live)

    return scored(rows(), true_images_of(test.route(), map_.route, TOLERANCE)).anr


def nordland() -> Drives:
    """Landmarks from summer frames 1000..1999, the map from summer 0..999, live images from winter 0..999."""
    folders = [real_recordings() / "nordland" / season for season in ("summer", "winter")]
    summer, winter = (encoded(f"{folder}#0:2000") for folder in folders)
    map_frames = np.array(kept_frames(tuple(folders), MAP_FRAMES))
    landmark_frames = np.array(kept_frames((folders[0],), LANDMARK_FRAMES))
    return Drives(summer.at(landmark_frames), summer.at(map_frames), winter.at(map_frames), is_of_two_seasons=False)


def table(triplets: Sequence[Drives]) -> Iterator[str]:
    """A Markdown line for every r and body, each figure the mean over the triplets."""
    head = ("r", "sent", "bytes", "**composed**", "composed, views alone", "rrf")
    return markdown(head, (row for n_landmarks in N_LANDMARKS for row in _rows(triplets, n_landmarks)))


def _rows(triplets: Sequence[Drives], n_landmarks: int) -> Iterator[list[str]]:
    composed, rrf = (
        [(drives.test, drives.map(relevance, n_landmarks)) for drives in triplets]
        for relevance in (Relevance.COMPOSED, Relevance.RRF)
    )
    columns = [(composed, True), (composed, False), (rrf, True)]
    all_ranks: list[float] = []
    for m in (n_landmarks, *N_SENT, ranked_landmarks_within(BUDGET_BYTES, n_landmarks)):
        n_bytes, means = _measured(columns, partial(ranks_of, m=m))
        costs = [f"{mean:.2f}{_cost(mean, best)}" for mean, best in zip_longest(means, all_ranks)]
        all_ranks = all_ranks or means
        yield [str(n_landmarks), "all ranks" if m == n_landmarks else f"{m} ranks", n_bytes, *costs]
    for n_bits in N_BITS:
        n_bytes, means = _measured(columns[:2], partial(units_of, n_bits=n_bits))
        costs = [f"{mean:.2f}{_cost(mean, best)}" for mean, best in zip(means, all_ranks, strict=False)]
        yield [str(n_landmarks), f"u, {n_bits} bits a number", n_bytes, *costs, ""]


def _measured(
    columns: Sequence[tuple[Sequence[tuple[Drive, Map]], bool]], pack: Callable[[Drive, Map], Sequence[Packed]]
) -> tuple[str, list[float]]:
    """The bytes of a body, bold where the budget holds it, and the ANR of every column."""
    n_bytes = len(pack(*columns[0][0][0])[0].body)
    means = [
        float(np.mean([anr(test, map_, pack(test, map_), in_session=in_session) for test, map_ in maps]))
        for maps, in_session in columns
    ]
    return f"**{n_bytes}**" if n_bytes <= BUDGET_BYTES else str(n_bytes), means


def _cost(mean: float, best: float | None) -> str:
    """How much worse a mean is than that of all ranks, in percent; empty where there is none to compare with."""
    return "" if best is None else f" ({100 * (mean / best - 1):+.0f} %)"


def report() -> Iterator[str]:
    """The lines of the page."""
    drives = netvlad_drives()
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
    yield from table([Drives(*order, is_of_two_seasons=True) for order in itertools.permutations(drives)])
    yield ""
    yield from ("## Images of Nordland, winter on a summer map", "")
    yield (
        "Extractor efficientnet_lite0; landmarks come from another part of the route (summer 1000..1999), so no second "
        "season is known. Frames that show nothing are left out, as in [nordland-http.md](nordland-http.md)."
    )
    yield ""
    yield from table([nordland()])


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(report(), RESULTS / "onboard.md"))
