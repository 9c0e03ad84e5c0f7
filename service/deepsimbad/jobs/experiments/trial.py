"""A trial of two drives: one is mapped, the other localized on it in order as one session, and held to the truth."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.particles import BeliefFilter
from deepsimbad.core.belief.summary import CONFIDENT_WITHIN_M
from deepsimbad.core.building import MapPlan
from deepsimbad.core.drive import Drive
from deepsimbad.core.landmark_model import fitting_number
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Query
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build import build, measure_drive, views_of
from deepsimbad.jobs.experiments.truth import nearest_images
from deepsimbad.jobs.experiments.vpr import (
    BRUTE_FORCE_U,
    bits_per_map_image,
    moves_between,
    relevances_by_all,
    scores_document,
)
from deepsimbad.jobs.fitting import Fitter, Pictures
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import DEFAULT_LIST_LENGTH, DEFAULT_N_LANDMARKS

RECALL_RANKS = tuple(range(1, 26))  # N of the curve of recall@N
TRIAL_STAGES = {"map": 3.0, "localize": 3.0}
_N_STRETCHES = 20  # that a drive is cut into, to say where it fails


@dataclass(frozen=True)
class Outcome:
    """One query, and what came back."""

    best_image: int  # the map image that this view alone places first
    true_image: int | None  # the nearest of those that are true; None: the map does not hold the place
    rank: float | None  # of the best-placed true image, from 0; None where there is none
    error_m: float | None  # from the best image to the true one
    belief_error_m: float | None  # from the image that the session then believes likeliest to the true one

    @property
    def is_wrong(self) -> bool:
        """Whether it has a true image, and another came first."""
        return self.rank is not None and self.rank >= 1


@dataclass(frozen=True)
class Stretch:
    """A part of the query drive, and how its queries fared."""

    from_m: float
    to_m: float
    n_queries: int
    n_wrong: int
    median_error_m: float  # of the wrong ones


@dataclass(frozen=True)
class TrialReport:
    """The results of a trial."""

    map: Map
    queries: Drive
    outcomes: list[Outcome]  # in the order of the queries
    belief: NDArray[np.float32]  # [m, b] mass after each query in equal parts of the map's route
    scores: dict[str, RetrievalScores]  # of the map's lists, and of the whole vectors that they stand for
    seconds: dict[str, float]  # by stage
    n_forgot: int = 0  # moves that the belief had no room for, after which the session began anew
    warnings: tuple[str, ...] = ()  # of fitting the evaluator

    @cached_property
    def stretches(self) -> list[Stretch]:
        """The stretches in which some query fails, worst first."""
        return _stretches(self.queries, self.outcomes)

    def as_dict(self, config: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document, as `experiment vpr` has it."""
        errors = [outcome.error_m for outcome in self.outcomes if outcome.error_m is not None]
        belief_errors = [outcome.belief_error_m for outcome in self.outcomes if outcome.belief_error_m is not None]
        is_near = [error_m <= CONFIDENT_WITHIN_M for error_m in belief_errors]
        return {
            **scores_document(self.scores, (1, 5)),
            "recall_at": {
                name: {str(n): r for n, r in method_scores.recall_at.items()}
                for name, method_scores in self.scores.items()
            },
            "n_map_images": self.map.n_images,
            "n_landmarks": self.map.n_landmarks,
            "error_m": {"median": _quantile(errors, 0.5), "p90": _quantile(errors, 0.9)},
            "belief_within_5_m": 100 * float(np.mean(is_near)) if is_near else float("nan"),
            "n_forgot": self.n_forgot,
            "fails": [asdict(stretch) for stretch in self.stretches],
            "index_bits_per_map_image": bits_per_map_image(self.map),
            "config": config,
            "seconds": self.seconds,
        }


def run_trial(
    evaluator: Evaluator,
    landmarks: Drive | None,
    database: Drive,
    queries: Drive,
    true_images: Sequence[NDArray[np.int64]],
    same_route: bool | None,
    progress: Progress,
    pictures: Pictures | None = None,
) -> TrialReport:
    """Map the database as a remap does by default, and localize every query in order, as one session.

    Args:
        landmarks: Another drive to choose landmarks from and learn from; None: the database's own frames.
        true_images: For every query the map images that count as true.
        same_route: Whether positions of the landmark drive and the database are comparable; None: where both know x, y.
        pictures: Images of the drive that landmarks are chosen from, for evaluators that are fitted to them.
    """
    progress.stage("map")
    plan = MapPlan(DEFAULT_RELEVANCE, DEFAULT_LIST_LENGTH, (CONFIDENT_WITHIN_M,), same_route=same_route)
    n_landmarks = fitting_number(None, (landmarks or database).n_frames, DEFAULT_N_LANDMARKS)
    fitter = Fitter(evaluator, pictures)
    map_build = build(plan, database, landmarks, landmarks, n_landmarks, evaluator, progress.update, fitter=fitter)
    progress.stage("localize")
    views = views_of(measure_drive(queries, map_build.map.landmark_model, evaluator))
    scorer, all_scorer, outcomes = RetrievalScorer(RECALL_RANKS), RetrievalScorer(RECALL_RANKS), []
    nearest_map_images, beliefs, n_forgot = nearest_images(queries, database), [], 0
    all_relevances = relevances_by_all(map_build, views, moves_between(queries), stateless=False)
    answers = zip(true_images, all_relevances, _in_order(map_build.map, views, queries), strict=True)
    for row, (truth, frame_relevances, (relevance, belief, has_forgotten)) in enumerate(answers):
        all_scorer.add(frame_relevances, truth)
        rank, mass = scorer.add(relevance, truth), belief.mass
        outcomes.append(_outcome(map_build.map, relevance, mass, truth, rank, int(nearest_map_images[row])))
        beliefs.append(belief.route.histogram_of(mass))
        n_forgot += has_forgotten
        progress.update((row + 1) / len(true_images))
    scores = {DEFAULT_RELEVANCE.value: scorer.result(), BRUTE_FORCE_U: all_scorer.result()}
    return TrialReport(
        map_build.map,
        queries,
        outcomes,
        np.array(beliefs, np.float32),
        scores,
        progress.seconds(TRIAL_STAGES),
        n_forgot,
        map_build.warnings,
    )


def _in_order(map_: Map, views: Query, queries: Drive) -> Iterator[tuple[NDArray[np.float32], BeliefFilter, bool]]:
    """One robot on the query drive, which knows how far it moves.

    Yields the relevance of every map image to each view, [n], the belief after it, and whether it began anew.
    """
    localizer = ActiveLocalizer(map_, LocalizerConfig())
    state = localizer.start()
    for row, move_m in enumerate(np.diff(queries.position_m, prepend=queries.position_m[0]).tolist()):
        step, has_forgotten = localizer.observe_or_restart(state, views.at(row), move_m)
        state = step.state
        yield step.relevance, state.belief, has_forgotten


def _outcome(
    map_: Map,
    relevance: NDArray[np.float32],
    mass: NDArray[np.float32],
    truth: NDArray[np.int64],
    rank: float | None,
    nearest_image: int,
) -> Outcome:
    best_image = int(relevance.argmax())
    if rank is None:
        return Outcome(best_image, None, None, None, None)
    true_image = (
        nearest_image if nearest_image in truth else int(truth[truth.size // 2])
    )  # a file of ground truth may know it better
    route = map_.route
    x_m, y_m = (None if axis is None else float(axis[true_image]) for axis in (route.x_m, route.y_m))
    apart_m = route.apart_m(np.array([best_image, mass.argmax()]), float(route.position_m[true_image]), x_m, y_m)
    return Outcome(best_image, true_image, rank, *apart_m.tolist())


def _stretches(queries: Drive, outcomes: Sequence[Outcome]) -> list[Stretch]:
    edges_m = np.linspace(queries.position_m[0], queries.position_m[-1], min(_N_STRETCHES, len(outcomes)) + 1)
    stretch_of = np.clip(np.searchsorted(edges_m, queries.position_m, side="right") - 1, 0, max(edges_m.size - 2, 0))
    stretches = []
    for number in range(edges_m.size - 1):
        stretch_outcomes = [outcome for outcome, part in zip(outcomes, stretch_of, strict=True) if part == number]
        scored_outcomes = [outcome for outcome in stretch_outcomes if outcome.rank is not None]
        errors = [outcome.error_m for outcome in scored_outcomes if outcome.is_wrong and outcome.error_m is not None]
        if errors:
            ends_m = float(edges_m[number]), float(edges_m[number + 1])
            stretches.append(Stretch(*ends_m, len(scored_outcomes), len(errors), float(np.median(errors))))
    return sorted(stretches, key=lambda stretch: (-stretch.n_wrong / stretch.n_queries, -stretch.median_error_m))


def _quantile(values: Sequence[float], q: float) -> float:
    return float(np.quantile(values, q)) if values else float("nan")
