"""One candidate in the contest."""

from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from bench.extractors.candidate import Candidate, Encode, as_sent
from bench.extractors.trials import Recordings, Trial
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.landmark_selection import select_landmarks
from deepsimbad.core.metrics import RetrievalScorer
from deepsimbad.core.relevance import Query, Relevance, brute_force_relevances, relevances
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.evaluators.feature_l2 import FeatureL2

LANDMARKS, LIST_LENGTH = 300, 4


class Entrant:
    """Every recording is encoded once, or once for each landmark traverse the candidate is fitted on.

    Attributes:
        seconds: Of every single encoding.
    """

    def __init__(self, candidate: Candidate, recordings: Recordings) -> None:
        self._candidate, self._recordings = candidate, recordings
        self._extractors: dict[str, Encode] = {}
        self._encodings: dict[tuple[str, str], NDArray[np.float32]] = {}
        self.seconds: list[float] = []

    @property
    def encoding_dim(self) -> int:
        """d, once something was encoded."""
        return int(next(iter(self._encodings.values())).shape[1])

    def anr(self, trial: Trial) -> tuple[float, float, float]:
        """ANR in percent of brute force, rrf and standardised; queries one by one and stateless."""
        evaluator = FeatureL2("none")
        candidates, mapped, live = (
            self._encoded(trial.landmarks, name) for name in (trial.landmarks, trial.mapped, trial.live)
        )
        chosen = select_landmarks(candidates, min(LANDMARKS, len(candidates)))
        model = evaluator.fit_landmarks(candidates[chosen])
        map_side = evaluator.dissimilarities(mapped, model)
        ranks = rank_landmarks(evaluator.dissimilarities(live, model))
        rrf, standardised = (
            build_retrieval_map(relevance, map_side, LIST_LENGTH)
            for relevance in (Relevance.RRF, Relevance.STANDARDISED)
        )
        return (
            _anr(brute_force_relevances(mapped, live), trial),
            _anr([relevances(rrf, Query(view)) for view in ranks], trial),
            _anr([relevances(standardised, Query(view)) for view in ranks], trial),
        )

    def _encoded(self, fitted_on: str, recording: str) -> NDArray[np.float32]:
        key = (fitted_on if self._candidate.learns else "", recording)
        if key not in self._encodings:
            encode, rows = self._extractor(key[0]), []
            for image in self._recordings[recording]:
                sent = as_sent(image, self._candidate.input_size)
                began = perf_counter()
                rows.append(encode(sent))
                self.seconds.append(perf_counter() - began)
            self._encodings[key] = np.stack(rows)
        return self._encodings[key]

    def _extractor(self, fitted_on: str) -> Encode:
        if fitted_on not in self._extractors:
            shown = self._recordings[fitted_on] if fitted_on else []
            self._extractors[fitted_on] = self._candidate.fit(
                [as_sent(image, self._candidate.input_size) for image in shown]
            )
        return self._extractors[fitted_on]


def _anr(answers: "NDArray[np.float32] | list[NDArray[np.float32]]", trial: Trial) -> float:
    scorer = RetrievalScorer()
    for answer, truth in zip(answers, trial.truth, strict=True):
        scorer.add(answer, truth)
    return scorer.result().anr
