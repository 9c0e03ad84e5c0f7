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
ACTIONS_M = tuple(float(metres) for metres in range(1, 11))  # over which views err alike is learnt so far
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
        return {
            **told(self.scores, RANKS),
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


def told(scores: Mapping[str, RetrievalScores], ranks: Sequence[int]) -> dict[str, Any]:
    """Scores by relevance as results tell them, JSON-ready."""
    first = next(iter(scores.values()))
    return {
        "anr": {name: score.anr for name, score in scores.items()},
        **{f"recall_at_{k}": {name: score.recall_at[k] for name, score in scores.items()} for k in ranks},
        "default": DEFAULT_RELEVANCE.value,
        "n_queries": first.n_queries,
        "n_left_out": first.n_left_out,
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
    built = build_maps(
        config, Fitter(evaluator, pictures, config.seed), evaluator, landmarks, training, progress.update
    )
    views = ViewsOf(test.drive, evaluator)
    scores = score_maps(config, built, views, [true_images], progress)[0]
    passive: PassiveScores | None = None
    if _is_driven(config):
        progress.stage("drive")
        map_ = built[Relevance.COMPOSED].map
        described, moved_m = views.by(map_.landmark_model), moves_between(test.drive)
        by_all = relevances_by_all(built[Relevance.COMPOSED], described, moved_m, stateless=False)
        passive = drive_in_order(map_, described, test.drive.position_m, by_all, true_images, progress.update)
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
        bytes_per_encoding=bytes_per_encoding(test.drive),
        encode_ms=test.encode_ms,
        passive=passive,
        fitting=sized.fitting,
        warnings=sized.warnings,
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
    built: dict[Relevance, Built] = {}
    model: LandmarkModel | None = None
    for number, name in enumerate(config.relevances):
        plan = MapPlan(
            name, config.list_length, ACTIONS_M, same_route=config.same_route, bars_own_place=config.bar_own_place
        )
        chosen = landmarks if name is Relevance.COMPOSED or model is None else model
        share = number / len(config.relevances)
        built[name] = build(
            *(plan, training, landmarks, chosen, config.n_landmarks, evaluator),
            lambda done, share=share: on_progress(share + done / len(config.relevances)),  # type: ignore[misc]
            fitter=fitter,
        )
        if name is not Relevance.COMPOSED:
            model = built[name].map.landmark_model
    return built


def listed_anew(built: Built, list_length: int) -> Map:
    """The map with lists of another length, and landmarks moved for them: single views are compared by no more."""
    map_ = built.map
    if map_.relevance is Relevance.COMPOSED and built.places is not None and built.initial_landmarks is not None:
        prototypes = learnt_landmarks(built.places, built.initial_landmarks, list_length)
        lists = compose(built.places, prototypes, list_length)
        return replace(map_, lists=lists, landmark_model={**map_.landmark_model, "prototypes": prototypes})
    listed = build_map(map_.relevance, built.map_drive, list_length)
    return replace(listed, landmark_model=map_.landmark_model, actions_m=map_.actions_m)


class ViewsOf:
    """A test drive's frames as live views, measured once by the landmarks of every model.

    Attributes:
        drive: The drive.
    """

    def __init__(self, drive: Drive, evaluator: Evaluator) -> None:
        self.drive, self._evaluator = drive, evaluator
        self._known: list[tuple[LandmarkModel, Query]] = []

    def by(self, model: LandmarkModel) -> Query:
        """A batch. Models are the same where their arrays are."""
        for known, views in self._known:
            if known.keys() == model.keys() and all(known[name] is model[name] for name in known):
                return views
        views = views_of(measure_drive(self.drive, model, self._evaluator))
        self._known.append((model, views))
        return views


def score_maps(
    config: VprConfig,
    built: Mapping[Relevance, Built],
    test: ViewsOf,
    truths: Sequence[Sequence[NDArray[np.int64]]],
    progress: Progress,
    *,
    bound: bool = True,
) -> list[dict[str, RetrievalScores]]:
    """Scores by relevance, and of what rivals `composed`, for each of several truths.

    Args:
        truths: For every test frame the map images that count as true; as often as somebody sees that otherwise.
        bound: Whether `brute_force_u` is scored too, beside `composed`.
    """
    scores: list[dict[str, RetrievalScores]] = [{} for _ in truths]

    def keep(name: str, rows: Iterable[NDArray[np.floating]]) -> None:
        for each, score in zip(scores, _scores(rows, truths), strict=True):
            each[name] = score

    for name in config.relevances:
        progress.stage(f"query by {name.value}")
        map_ = built[name].map
        views, moved_m = test.by(map_.landmark_model), moves_between(test.drive)
        live = None if config.stateless else map_.live_statistics
        keep(name.value, _relevances_in_order(map_, views, live, moved_m, progress.update))
        if name is Relevance.COMPOSED and bound:
            keep(BRUTE_FORCE_U, relevances_by_all(built[name], views, moved_m, config.stateless))
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
    """Of a frame in a traverse's file."""
    return drive.encoding_dim * (2 if is_halvable(drive.encodings) else 4)


def bits_per_map_image(map_: Map) -> float:
    """Write the map to a file, as a remap would, and count the pages of its posting tables."""
    with tempfile.TemporaryDirectory() as folder:
        building, sealed = Path(folder) / "1.building", Path(folder) / "1.sqlite"
        write_map(building, map_)
        seal(building, sealed)
        return 8 * index_bytes(sealed) / map_.n_images


def moves_between(drive: Drive) -> list[float | None]:
    """Metres from the view before to each; None to the first."""
    return [None, *np.diff(drive.position_m).tolist()]


def _relevances_in_order(
    map_: Map,
    views: Query,
    live: LiveStatistics | None,
    moved_m: Sequence[float | None],
    on_progress: Callable[[float], None],
) -> Iterator[NDArray[np.float32]]:
    """[n] of every view, one after the other."""
    # Without a session's statistics every view is compared by itself; many at once are one matrix product.
    size = _QUERIES_A_BLOCK if map_.relevance is Relevance.BRUTE_FORCE else 1
    for first in range(0, len(moved_m), size):
        asked = views.at(slice(first, first + size) if size > 1 else first)
        if live is not None:
            live, _ = map_.after_view(live, asked, moved_m[first])
        yield from np.atleast_2d(relevances(map_, asked, live))
        on_progress(min(1.0, (first + size) / len(moved_m)))


def relevances_by_all(
    built: Built, views: Query, moved_m: Sequence[float | None], stateless: bool
) -> Iterator[NDArray[np.float32]]:
    """[n] of every view by what the lists stand for: the same unit vectors, and nothing left out."""
    map_, places = built.map, built.places
    live, projection = map_.live_statistics, map_.landmark_model.get("projection")
    for number, move_m in enumerate(moved_m):
        view = views.at(number)
        if not stateless:
            live, _ = map_.after_view(live, view, move_m)
        if places is None or view.encoding is None or live is None or live.encodings is None:
            raise InvalidMapConfigError("only a composed map has unit vectors")
        yield np.asarray(places @ unit_encodings(view.encoding, live.encodings, projection).T, np.float32)
