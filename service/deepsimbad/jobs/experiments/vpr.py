"""The paper's single-view experiment on one landmark-training-test triplet (III, Fig. 6): every relevance.

One session over the test drive in order; and what the belief makes of it, beside sums of the same relevances.
"""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import Built, MapPlan, build_map
from deepsimbad.core.composed import compose, learnt_landmarks, unit_encodings
from deepsimbad.core.drive import Drive, SameRoute
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, LiveStatistics, Query, Relevance
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.build import EncodedRecording, build, measure_drive, views_of
from deepsimbad.jobs.experiments.passive import PassiveScores, drive_in_order
from deepsimbad.jobs.fitting import Fitter, Pictures
from deepsimbad.jobs.progress import Progress
from deepsimbad.store.arrays import is_halvable
from deepsimbad.store.map_file import index_bytes, seal, write_map

_QUERIES_A_BLOCK = 64  # of brute force: large enough for a matrix product, small enough for memory
ACTIONS_M = tuple(float(metres) for metres in range(1, 11))  # how far views err alike is learnt up to the longest
RANKS = (1, 5, 10)  # of recall
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
    scores: dict[str, RetrievalScores]  # by relevance, and by rival
    # Size on disk of the posting tables, of the map for the relevance that ships (or the first asked for)
    index_bits_per_map_image: float
    seconds: dict[str, float]  # by stage
    same_route: SameRoute | None  # whether the landmark traverse drove the mapped route; None: there is none
    encoding_dim: int  # d
    bytes_per_encoding: int  # that one frame's encoding takes in a traverse's file
    encode_ms: float | None  # median from reading an image to its encoding; None where encodings came ready
    fitting: Mapping[str, Any] | None = None  # how the evaluator was fitted; None: it was not
    warnings: tuple[str, ...] = ()  # of fitting
    passive: PassiveScores | None = None  # of the drive in order; None without `composed`, or without a session

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7."""
        return {
            **scores_document(self.scores, RANKS),
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


def scores_document(scores: Mapping[str, RetrievalScores], ranks: Sequence[int]) -> dict[str, Any]:
    """The part of a result that holds scores by relevance, JSON-ready; recall at each of the `ranks`."""
    first_scores = next(iter(scores.values()))
    return {
        "anr": {name: score.anr for name, score in scores.items()},
        **{f"recall_at_{k}": {name: score.recall_at[k] for name, score in scores.items()} for k in ranks},
        "default": DEFAULT_RELEVANCE.value,
        "n_queries": first_scores.n_queries,
        "n_left_out": first_scores.n_left_out,
    }


def vpr_stages(config: VprConfig) -> dict[str, float]:
    """The stages `run_vpr` reports, with their weights."""
    return (
        {"describe": 3.0}
        | {f"query by {name.value}": 1.0 if name.traits.is_listed else 3.0 for name in config.relevances}
        | ({"drive": 10.0} if _is_driven(config) else {})
    )


def _is_driven(config: VprConfig) -> bool:
    """Whether the test drive is driven in order too, which takes `composed` and a session."""
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
        pictures: Images of the landmark traverse, for evaluators that are fitted to them.
    """
    progress.stage("describe")
    map_builds = build_maps(
        config, Fitter(evaluator, pictures, config.seed), evaluator, landmarks, training, progress.update
    )
    test_views = DriveViews(test.drive, evaluator)
    scores = score_maps(config, map_builds, test_views, [true_images], progress)[0]
    passive: PassiveScores | None = None
    if _is_driven(config):
        progress.stage("drive")
        map_ = map_builds[Relevance.COMPOSED].map
        views, moved_m = test_views.by(map_.landmark_model), moves_between(test.drive)
        all_relevances = relevances_by_all(map_builds[Relevance.COMPOSED], views, moved_m, stateless=False)
        passive = drive_in_order(map_, views, test.drive.position_m, all_relevances, true_images, progress.update)
    seconds = progress.seconds(vpr_stages(config))
    main_build = map_builds.get(DEFAULT_RELEVANCE, map_builds[config.relevances[0]])
    return VprReport(
        config,
        scores,
        bits_per_map_image(main_build.map),
        seconds,
        main_build.same_route,
        encoding_dim=test.drive.encoding_dim,
        bytes_per_encoding=bytes_per_encoding(test.drive),
        encode_ms=test.encode_ms,
        passive=passive,
        fitting=main_build.fitting,
        warnings=main_build.warnings,
    )


def build_maps(
    config: VprConfig,
    fitter: Fitter,
    evaluator: Evaluator,
    landmarks: Drive | None,
    training: Drive,
    on_progress: Callable[[float], None] = lambda _: None,
) -> dict[Relevance, Built]:
    """A map of the training traverse for every relevance; all but `composed` share their landmarks."""
    map_builds: dict[Relevance, Built] = {}
    model: LandmarkModel | None = None
    for number, name in enumerate(config.relevances):
        plan = MapPlan(
            name, config.list_length, ACTIONS_M, same_route=config.same_route, bars_own_place=config.bar_own_place
        )
        landmark_source = landmarks if name.traits.compares_unit_vectors or model is None else model
        share = number / len(config.relevances)
        map_builds[name] = build(
            plan,
            training,
            landmarks,
            landmark_source,
            config.n_landmarks,
            evaluator,
            lambda build_share, share=share: on_progress(share + build_share / len(config.relevances)),  # type: ignore[misc]
            fitter=fitter,
        )
        if not name.traits.compares_unit_vectors:
            model = map_builds[name].map.landmark_model
    return map_builds


def relisted_map(map_build: Built, list_length: int) -> Map:
    """The map with lists of another length and landmarks moved for them, which is all that single views need."""
    map_ = map_build.map
    if map_build.places is not None and map_build.initial_landmarks is not None:
        prototypes = learnt_landmarks(map_build.places, map_build.initial_landmarks, list_length)
        lists = compose(map_build.places, prototypes, list_length)
        return replace(map_, lists=lists, landmark_model={**map_.landmark_model, "prototypes": prototypes})
    new_map = build_map(map_.relevance, map_build.map_drive, list_length)
    return replace(new_map, landmark_model=map_.landmark_model, actions_m=map_.actions_m)


class DriveViews:
    """A test drive's frames as live views, measured once by the landmarks of every model.

    Attributes:
        drive: The drive.
    """

    def __init__(self, drive: Drive, evaluator: Evaluator) -> None:
        self.drive, self._evaluator = drive, evaluator
        self._batches: list[tuple[LandmarkModel, Query]] = []

    def by(self, model: LandmarkModel) -> Query:
        """The views measured by a model's landmarks, a batch; models are the same where their arrays are."""
        for batch_model, views in self._batches:
            if batch_model.keys() == model.keys() and all(batch_model[name] is model[name] for name in batch_model):
                return views
        views = views_of(measure_drive(self.drive, model, self._evaluator))
        self._batches.append((model, views))
        return views


def score_maps(
    config: VprConfig,
    map_builds: Mapping[Relevance, Built],
    test: DriveViews,
    truths: Sequence[Sequence[NDArray[np.int64]]],
    progress: Progress,
    *,
    bound: bool = True,
) -> list[dict[str, RetrievalScores]]:
    """Scores by relevance, and by rival of `composed`, for each of several truths.

    Args:
        truths: Every one holds for every test frame the map images that count as true.
        bound: Whether `brute_force_u` is scored too, beside `composed`.
    """
    scores: list[dict[str, RetrievalScores]] = [{} for _ in truths]

    def keep(name: str, rows: Iterable[NDArray[np.floating]]) -> None:
        for truth_scores, score in zip(scores, _scores(rows, truths), strict=True):
            truth_scores[name] = score

    for name in config.relevances:
        progress.stage(f"query by {name.value}")
        map_ = map_builds[name].map
        views, moved_m = test.by(map_.landmark_model), moves_between(test.drive)
        live = None if config.stateless else map_.live_statistics
        keep(name.value, relevances_in_order(map_, views, live, moved_m, progress.update))
        if name.traits.compares_unit_vectors and bound:
            keep(BRUTE_FORCE_U, relevances_by_all(map_builds[name], views, moved_m, config.stateless))
    return scores


def _scores(
    rows: Iterable[NDArray[np.floating]], truths: Sequence[Sequence[NDArray[np.int64]]]
) -> list[RetrievalScores]:
    scorers = [RetrievalScorer(RANKS) for _ in truths]
    for number, row in enumerate(rows):
        for scorer, truth in zip(scorers, truths, strict=True):
            scorer.add(row, truth[number])
    return [scorer.result() for scorer in scorers]


def bytes_per_encoding(drive: Drive) -> int:
    """The bytes that one frame's encoding takes in a traverse's file."""
    return drive.encoding_dim * (2 if is_halvable(drive.encodings) else 4)


def bits_per_map_image(map_: Map) -> float:
    """Write the map to a file, as a remap would, and count the pages of its posting tables."""
    with tempfile.TemporaryDirectory() as folder:
        building, sealed_path = Path(folder) / "1.building", Path(folder) / "1.sqlite"
        write_map(building, map_)
        seal(building, sealed_path)
        return 8 * index_bytes(sealed_path) / map_.n_images


def moves_between(drive: Drive) -> list[float | None]:
    """Metres moved to every view from the one before; None for the first."""
    return [None, *np.diff(drive.position_m).tolist()]


def relevances_in_order(
    map_: Map,
    views: Query,
    live: LiveStatistics | None,
    moved_m: Sequence[float | None],
    on_progress: Callable[[float], None] = lambda _: None,
) -> Iterator[NDArray[np.float32]]:
    """Yield the relevances [n] to every view in order.

    Args:
        views: A batch.
        live: The statistics that a session starts from; None: every view by itself.
        moved_m: Metres moved to every view from the one before; None of the first.
    """
    # Without a session's statistics every view is compared by itself; many at once are one matrix product.
    size = 1 if map_.relevance.traits.is_listed else _QUERIES_A_BLOCK
    for first in range(0, len(moved_m), size):
        query = views.at(slice(first, first + size) if size > 1 else first)
        if live is not None:
            live, _ = map_.after_view(live, query, moved_m[first])
        yield from np.atleast_2d(relevances(map_, query, live))
        on_progress(min(1.0, (first + size) / len(moved_m)))


def relevances_by_all(
    map_build: Built, views: Query, moved_m: Sequence[float | None], stateless: bool
) -> Iterator[NDArray[np.float32]]:
    """Yield the relevances [n] to every view of the whole unit vectors that the lists stand for."""
    map_, places = map_build.map, map_build.places
    live, projection = map_.live_statistics, map_.landmark_model.get("projection")
    for number, move_m in enumerate(moved_m):
        view = views.at(number)
        if not stateless:
            live, _ = map_.after_view(live, view, move_m)
        if places is None or view.encoding is None or live is None or live.encodings is None:
            raise InvalidMapConfigError("only a composed map has unit vectors")
        yield np.asarray(places @ unit_encodings(view.encoding, live.encodings, projection).T, np.float32)
