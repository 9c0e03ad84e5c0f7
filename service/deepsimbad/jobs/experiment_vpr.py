"""The paper's single-view experiment (III, Fig. 6): every relevance on one landmark-training-test triplet."""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.landmark_selection import select_landmarks
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import (
    DEFAULT_RELEVANCE,
    Query,
    Relevance,
    RetrievalMap,
    brute_force_relevances,
    relevances,
)
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.same_route import SameRoute, second_season
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.build_map import Described, map_contents
from deepsimbad.jobs.encoded_traverse import EncodedTraverse
from deepsimbad.jobs.progress import Progress
from deepsimbad.store.arrays import is_halvable
from deepsimbad.store.map_file import index_bytes, write_map
from deepsimbad.store.records import DomainRecord
from deepsimbad.store.sealing import seal

_QUERIES_A_BLOCK = 64  # of brute force: large enough for a matrix product, small enough for memory


@dataclass(frozen=True)
class VprConfig:
    """What is compared, and how it is scored.

    Attributes:
        n_landmarks: r.
        list_length: h.
        tolerance_m: How far from the query a map image may be and still be true.
        relevances: Which to compare, in the order of the report.
        seed: Kept with the result; nothing here is random.
        same_route: Whether positions of landmark and training traverse are comparable; None: where both know x, y.
    """

    n_landmarks: int = 300
    list_length: int = 4
    tolerance_m: float = 2.0
    relevances: tuple[Relevance, ...] = tuple(Relevance)
    seed: int = 0
    same_route: bool | None = True


@dataclass(frozen=True)
class VprReport:
    """Scores by relevance, and what they cost.

    Attributes:
        scores: By relevance.
        index_bits_per_map_image: Size on disk of the posting tables, of the map for the relevance that ships (or
            of the first asked for).
        seconds: Seconds by stage.
        same_route: Whether the landmark traverse drove the mapped route.
        encoding_dim: d.
        bytes_per_encoding: Of one frame in a traverse's file, places apart.
        encode_ms: Median from reading an image to its encoding; None where encodings came ready.
    """

    config: VprConfig
    scores: dict[Relevance, RetrievalScores]
    index_bits_per_map_image: float
    seconds: dict[str, float]
    same_route: SameRoute
    encoding_dim: int
    bytes_per_encoding: int
    encode_ms: float | None

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7."""
        first = next(iter(self.scores.values()))
        return {
            "anr": {name.value: score.anr for name, score in self.scores.items()},
            "recall_at_1": {name.value: score.recall_at[1] for name, score in self.scores.items()},
            "recall_at_5": {name.value: score.recall_at[5] for name, score in self.scores.items()},
            "default": DEFAULT_RELEVANCE.value,
            "n_queries": first.n_queries,
            "n_left_out": first.n_left_out,
            "index_bits_per_map_image": self.index_bits_per_map_image,
            "second_season": self.same_route.as_dict(),
            "encoding_dim": self.encoding_dim,
            "bytes_per_encoding": self.bytes_per_encoding,
            "encode_ms": self.encode_ms,
            "config": {**asdict(self.config), **sources},
            "seconds": self.seconds,
        }


def vpr_stages(config: VprConfig) -> dict[str, float]:
    """The stages `run_vpr` reports, with their weights."""
    return {"select landmarks": 2.0, "describe": 1.0} | {
        f"query by {name.value}": 3.0 if name is Relevance.BRUTE_FORCE else 1.0 for name in config.relevances
    }


def run_vpr(
    config: VprConfig,
    evaluator: Evaluator,
    landmarks: EncodedTraverse,
    training: EncodedTraverse,
    test: EncodedTraverse,
    true_images: Sequence[NDArray[np.int64]],
    progress: Progress,
) -> VprReport:
    """Select landmarks, map the training traverse, query every test frame in order as one passive session.

    Args:
        config: What is compared.
        evaluator: Measures dissimilarities of encodings.
        landmarks: The landmark traverse; where it drove the mapped route, `calibrated` learns from it.
        training: The mapped traverse.
        test: The queries, in the order they were driven.
        true_images: For every test frame the map images that count as true.
        progress: Reports; stages of `vpr_stages`.
    """
    seconds: dict[str, float] = {}
    started = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal started
        now = time.perf_counter()
        seconds[stage.replace(" ", "_")] = now - started
        started = now

    progress.stage("select landmarks")
    chosen = select_landmarks(landmarks.encodings, config.n_landmarks, progress.update)
    model = evaluator.fit_landmarks(landmarks.encodings[chosen])
    lap("select landmarks")

    progress.stage("describe")
    map_dissimilarities = evaluator.dissimilarities(training.encodings, model)
    progress.update(0.3)
    test_dissimilarities = evaluator.dissimilarities(test.encodings, model)
    progress.update(0.6)
    second, same_route = second_season(
        map_dissimilarities,
        lambda: evaluator.dissimilarities(landmarks.encodings, model),
        training.route,
        landmarks.route,
        config.same_route,
    )
    queries = [
        Query(ranks, dissimilarities, encoding)
        for ranks, dissimilarities, encoding in zip(
            rank_landmarks(test_dissimilarities), test_dissimilarities, test.encodings, strict=True
        )
    ]
    lap("describe")

    scores: dict[Relevance, RetrievalScores] = {}
    maps: dict[Relevance, RetrievalMap] = {}
    for name in config.relevances:
        progress.stage(f"query by {name.value}")
        maps[name] = build_retrieval_map(name, map_dissimilarities, config.list_length, training.encodings, second)
        scores[name] = _score(maps[name], queries, true_images, progress.update)
        lap(f"query by {name.value}")
    sized = maps.get(DEFAULT_RELEVANCE, maps[config.relevances[0]])
    return VprReport(
        config,
        scores,
        _bits_per_map_image(sized, model, training.route),
        seconds,
        same_route,
        encoding_dim=int(test.encodings.shape[1]),
        bytes_per_encoding=test.encodings.shape[1] * (2 if is_halvable(test.encodings) else 4),
        encode_ms=test.encode_ms,
    )


def _bits_per_map_image(built: RetrievalMap, model: LandmarkModel, route: Route) -> float:
    """Write the map to a file, as a remap would, and count the pages of its posting tables."""
    domain = DomainRecord("experiment", {}, closed=False, actions_m=(), active_version=None, created_at="")
    with tempfile.TemporaryDirectory() as folder:
        building, sealed = Path(folder) / "1.building", Path(folder) / "1.sqlite"
        write_map(building, map_contents(domain, 1, {}, model, Described(built), route))
        seal(building, sealed)
        return 8 * index_bytes(sealed) / route.n_images


def _score(
    built: RetrievalMap,
    queries: Sequence[Query],
    true_images: Sequence[NDArray[np.int64]],
    on_progress: Callable[[float], None],
) -> RetrievalScores:
    scorer = RetrievalScorer()
    live = built.statistics
    block = np.empty((0, 0), np.float32)
    for place, (query, truth) in enumerate(zip(queries, true_images, strict=True)):
        if built.relevance is Relevance.BRUTE_FORCE and built.encodings is not None:
            row = place % _QUERIES_A_BLOCK
            if row == 0:
                ahead = queries[place : place + _QUERIES_A_BLOCK]
                stacked = np.array([each.encoding for each in ahead], np.float32)
                block = brute_force_relevances(built.encodings, stacked)
            relevance = block[row]
        else:
            live = live.observing(query.ranks) if live else None
            relevance = relevances(built, query, live)
        scorer.add(relevance, truth)
        on_progress((place + 1) / len(queries))
    return scorer.result()
