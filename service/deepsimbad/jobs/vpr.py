"""The paper's single-view experiment on one landmark-training-test triplet (III, Fig. 6): every relevance.

One session over the test drive in order; and what the belief makes of it, beside sums of the same relevances.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import Built, MapPlan
from deepsimbad.core.composed import unit_encodings
from deepsimbad.core.drive import Drive, SameRoute
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, LiveStatistics, Query, Relevance, worth_of_move
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.build import EncodedRecording, build, measured, views_of
from deepsimbad.jobs.fitting import Fitter, Pictures
from deepsimbad.jobs.passive import PassiveScores, drive_in_order
from deepsimbad.jobs.progress import Progress
from deepsimbad.store.arrays import is_halvable
from deepsimbad.store.map_file import index_bytes, seal, write_map

_QUERIES_A_BLOCK = 64  # of brute force: large enough for a matrix product, small enough for memory
_ACTIONS_M = tuple(float(metres) for metres in range(1, 11))  # over which views err alike is learnt so far
BRUTE_FORCE_U = "brute_force_u"  # all of the unit vectors that composed lists stand for: the most they could tell


@dataclass(frozen=True)
class VprConfig:
    """What is compared, and how it is scored."""

    n_landmarks: int = 300
    list_length: int = 4
    tolerance_m: float = 2.0  # how far from the query a map image may be and still be true
    relevances: tuple[Relevance, ...] = tuple(Relevance)  # which to compare, in the order of the report
    seed: int = 0  # of fitting an evaluator; kept with the result
    stateless: bool = False  # every view by itself, by the map's statistics, in place of one session in order
    # Whether positions of landmark and training traverse are comparable; None: where both know x, y
    same_route: bool | None = True
    bar_own_place: bool = False  # no list of `composed` may hold a landmark seen from the image's own place


@dataclass(frozen=True)
class VprReport:
    """Scores by relevance, and what they cost."""

    config: VprConfig
    scores: dict[str, RetrievalScores]  # by relevance; and of what rivals it
    # Size on disk of the posting tables, of the map for the relevance that ships (or of the first asked for)
    index_bits_per_map_image: float
    seconds: dict[str, float]  # by stage
    same_route: SameRoute | None  # whether the landmark traverse drove the mapped route; None: there is none
    encoding_dim: int  # d
    bytes_per_encoding: int  # of one frame in a traverse's file, places apart
    encode_ms: float | None  # median from reading an image to its encoding; None where encodings came ready
    fitting: Mapping[str, Any] | None = None  # how the evaluator was fitted; None: it was not
    warnings: tuple[str, ...] = ()  # of fitting
    passive: PassiveScores | None = None  # the drive in order; None where `composed` is not asked for, or no session

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7."""
        first = next(iter(self.scores.values()))
        return {
            "anr": {name: score.anr for name, score in self.scores.items()},
            "recall_at_1": {name: score.recall_at[1] for name, score in self.scores.items()},
            "recall_at_5": {name: score.recall_at[5] for name, score in self.scores.items()},
            "default": DEFAULT_RELEVANCE.value,
            "n_queries": first.n_queries,
            "n_left_out": first.n_left_out,
            "index_bits_per_map_image": self.index_bits_per_map_image,
            "passive": None if self.passive is None else self.passive.as_dict(),
            "second_season": None if self.same_route is None else self.same_route.as_dict(),
            "encoding_dim": self.encoding_dim,
            "bytes_per_encoding": self.bytes_per_encoding,
            "encode_ms": self.encode_ms,
            "config": {**asdict(self.config), **sources},
            "seconds": self.seconds,
            **({} if self.fitting is None else {"fitting": dict(self.fitting)}),
        }


def vpr_stages(config: VprConfig) -> dict[str, float]:
    """The stages `run_vpr` reports, with their weights."""
    return (
        {"describe": 3.0}
        | {f"query by {name.value}": 3.0 if name is Relevance.BRUTE_FORCE else 1.0 for name in config.relevances}
        | ({"drive": 10.0} if _is_driven(config) else {})
    )


def _is_driven(config: VprConfig) -> bool:
    """Whether views are one session of the relevance that has beliefs of its own."""
    return Relevance.COMPOSED in config.relevances and not config.stateless


def run_vpr(
    config: VprConfig,
    evaluator: Evaluator,
    landmarks: Drive | None,
    training: Drive,
    test: EncodedRecording,
    true_images: Sequence[NDArray[np.int64]],
    progress: Progress,
    pictures: Pictures | None = None,
) -> VprReport:
    """Choose landmarks, map the training traverse, query every test frame in order as one passive session.

    Args:
        landmarks: The landmark traverse; where it drove the mapped route, maps learn from it. None: the training one.
        true_images: For every test frame the map images that count as true.
        pictures: Of the landmark traverse, for evaluators that are fitted to images.
    """
    progress.stage("describe")
    fitter = Fitter(evaluator, pictures, config.seed)
    scores: dict[str, RetrievalScores] = {}
    built: dict[Relevance, Built] = {}
    model: LandmarkModel | None = None
    for number, name in enumerate(config.relevances):
        plan = MapPlan(
            name,
            config.list_length,
            _ACTIONS_M,
            same_route=config.same_route,
            bars_own_place=config.bar_own_place,
        )
        chosen = landmarks if name is Relevance.COMPOSED or model is None else model
        share = number / len(config.relevances)
        built[name] = build(
            *(plan, training, landmarks, chosen, config.n_landmarks, evaluator),
            lambda done, share=share: progress.update(share + done / len(config.relevances)),  # type: ignore[misc]
            fitter=fitter,
        )
        if name is not Relevance.COMPOSED:
            model = built[name].map.landmark_model
    for name in config.relevances:
        progress.stage(f"query by {name.value}")
        seen = measured(test.drive, built[name].map.landmark_model, evaluator)
        views = views_of(seen)
        live = None if config.stateless else built[name].map.live_statistics
        worth = _worth_of_views(test.drive)
        scores[name.value] = _score(built[name].map, views, true_images, live, worth, progress.update)
        if name is Relevance.COMPOSED:
            scores[BRUTE_FORCE_U] = score_by_all(built[name], seen, true_images, config.stateless)
    passive: PassiveScores | None = None
    if _is_driven(config):
        progress.stage("drive")
        map_ = built[Relevance.COMPOSED].map
        seen = measured(test.drive, map_.landmark_model, evaluator)
        by_all = relevances_by_all(built[Relevance.COMPOSED], seen, stateless=False)
        passive = drive_in_order(map_, views_of(seen), test.drive.position_m, by_all, true_images, progress.update)
    stages = {stage.replace(" ", "_") for stage in vpr_stages(config)}
    seconds = {stage: took for stage, took in progress.seconds().items() if stage in stages}
    sized = built.get(DEFAULT_RELEVANCE, built[config.relevances[0]])
    return VprReport(
        config,
        scores,
        bits_per_map_image(sized.map),
        seconds,
        sized.same_route,
        encoding_dim=test.drive.encoding_dim,
        bytes_per_encoding=test.drive.encoding_dim * (2 if is_halvable(test.drive.encodings) else 4),
        encode_ms=test.encode_ms,
        passive=passive,
        fitting=sized.fitting,
        warnings=sized.warnings,
    )


def bits_per_map_image(map_: Map) -> float:
    """Write the map to a file, as a remap would, and count the pages of its posting tables."""
    with tempfile.TemporaryDirectory() as folder:
        building, sealed = Path(folder) / "1.building", Path(folder) / "1.sqlite"
        write_map(building, map_)
        seal(building, sealed)
        return 8 * index_bytes(sealed) / map_.n_images


def _worth_of_views(drive: Drive) -> list[float]:
    """What each view of a drive counts for among what is usual: as much as a session's view after that move."""
    return [1.0, *(worth_of_move(move_m) for move_m in np.diff(drive.position_m).tolist())]


def _score(
    map_: Map,
    views: Query,
    true_images: Sequence[NDArray[np.int64]],
    live: LiveStatistics | None,
    worth: Sequence[float],
    on_progress: Callable[[float], None],
) -> RetrievalScores:
    scorer = RetrievalScorer()
    # Without a session's statistics every view is compared by itself; many at once are one matrix product.
    size = _QUERIES_A_BLOCK if map_.relevance is Relevance.BRUTE_FORCE else 1
    for first in range(0, len(true_images), size):
        asked = views.at(slice(first, first + size))
        if size == 1:
            asked = views.at(first)
        live = live.observing(asked, worth[first]) if live else None
        rows = np.atleast_2d(relevances(map_, asked, live))
        for row, truth in zip(rows, true_images[first : first + size], strict=True):
            scorer.add(row, truth)
        on_progress(min(1.0, (first + size) / len(true_images)))
    return scorer.result()


def score_by_all(
    built: Built, test: Drive, true_images: Sequence[NDArray[np.int64]], stateless: bool
) -> RetrievalScores:
    """What unit vectors of places, `built.places`, score: those that lists stand for, or what else restores them."""
    scorer = RetrievalScorer()
    for relevance, truth in zip(relevances_by_all(built, test, stateless), true_images, strict=True):
        scorer.add(relevance, truth)
    return scorer.result()


def relevances_by_all(built: Built, test: Drive, stateless: bool) -> Iterator[NDArray[np.float32]]:
    """[n] of every frame by what the lists stand for: the same unit vectors, and nothing left out."""
    usual = built.map.live_statistics
    if built.places is None or usual is None or usual.encodings is None:
        raise InvalidMapConfigError("only a composed map has unit vectors")
    encodings, projection = usual.encodings, built.map.landmark_model.get("projection")
    for encoding, worth in zip(test.encodings, _worth_of_views(test), strict=True):
        encodings = encodings if stateless else encodings.observing(encoding, worth)
        yield built.places @ unit_encodings(encoding, encodings, projection)
