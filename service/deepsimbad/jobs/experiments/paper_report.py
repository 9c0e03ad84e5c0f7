"""What the paper's triplets show together: means, intervals over stretches and over drives, and claims judged."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.metrics import mean_interval
from deepsimbad.core.planners import CONSTANT, DEFAULT_PLANNER, NNQL, RANDOM
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.jobs.experiments.paper import SEASONS, SETUPS, Document, PaperConfig
from deepsimbad.jobs.experiments.vpr import BRUTE_FORCE_U

HOLDS, OTHERWISE, UNDECIDED = "holds", "does not hold", "cannot be told apart"
_CHANCE, _NEAR_CHANCE = 50.0, 45.0  # ANR, percent


@dataclass(frozen=True)
class PooledFigures:
    """One figure of every method over the test frames of all triplets, by stretches of 20 m."""

    n: NDArray[np.int64]  # [stretches] frames or starts there
    sums: dict[str, NDArray[np.float64]]  # by method, [stretches]
    drive: NDArray[np.int64]  # [stretches] the test drive

    @classmethod
    def of(cls, blocks: Mapping[str, Document]) -> Self:
        """Pool the `blocks` of triplets, which are given by the triplet's name."""
        seasons = list(SEASONS)
        drive = [np.full(len(document["n"]), seasons.index(triplet[-2:])) for triplet, document in blocks.items()]
        first_document = next(iter(blocks.values()))
        sums = {
            name: np.concatenate([document["sums"][name] for document in blocks.values()])
            for name in first_document["sums"]
        }
        return cls(np.concatenate([document["n"] for document in blocks.values()]), sums, np.concatenate(drive))

    def mean(self, name: str) -> float:
        """A method's mean over all frames."""
        return float(self.sums[name].sum() / self.n.sum())

    def figures(self, seed: int) -> dict[str, Document]:
        """Every method's mean, with its intervals."""
        return {name: {"mean": self.mean(name), **self._intervals(sums, seed)} for name, sums in self.sums.items()}

    def difference(self, name: str, rival: str, seed: int) -> Document:
        """A method's figure less its rival's, frame by frame, with its intervals."""
        return {"mean": self.mean(name) - self.mean(rival), **self._intervals(self.sums[name] - self.sums[rival], seed)}

    def _intervals(self, sums: NDArray[np.float64], seed: int) -> dict[str, list[float]]:
        """95 % intervals by stretches and by test drives: what other stretches and other days would have shown."""
        values = np.repeat(sums / self.n, self.n)
        stretches, drives = np.arange(self.n.size), self.drive
        return {
            name: list(mean_interval(values, seed, np.repeat(group, self.n)))
            for name, group in (("stretches", stretches), ("drives", drives))
        }


def paper_document(config: PaperConfig, results: Mapping[str, Document]) -> Document:
    """Everything that the report shows of what was measured, JSON-ready; percent."""
    lengths = [h for h in config.list_lengths if all(str(h) in document for document in results.values())]
    by_length = {h: {triplet: document[str(h)] for triplet, document in results.items()} for h in lengths}
    h = min(lengths, key=lambda length: abs(length - config.list_length))
    active_documents = {triplet: document["active"] for triplet, document in results.items()}
    views = {
        length: PooledFigures.of({t: document["blocks"] for t, document in by_length[length].items()})
        for length in lengths
    }
    moves = {
        setup: PooledFigures.of({triplet: document["blocks"][setup] for triplet, document in active_documents.items()})
        for setup in (*SETUPS, "views")
    }
    first_document, first_moves = next(iter(by_length[h].values())), next(iter(active_documents.values()))
    return {
        "anr": {str(length): figures.figures(config.seed) for length, figures in views.items()},
        "recall": _mean_of([document["recall"] for document in by_length[h].values()]),
        "anr_at": _mean_of([document["anr_at"] for document in by_length[h].values()]),
        "active": {setup: figures.figures(config.seed) for setup, figures in moves.items()},
        "wrong_when_confident": _mean_of([_numbers(document["wrong_when"]) for document in active_documents.values()]),
        "metres_to_confident": _mean_of([_numbers(document["metres_to"]) for document in active_documents.values()]),
        "mean_move_m": _mean_of([document["mean_move_m"] for document in active_documents.values()]),
        "index_bits_per_map_image": _mean_of([document["index_bits"] for document in by_length[h].values()]),
        "took_ms": _mean_of([document["took_ms"] for document in active_documents.values()]),
        "evaluations": first_moves["evaluations"],
        "evaluations_s": first_moves["evaluations_s"],
        "evaluations_of_the_paper": config.training_episodes * 10 * config.n_landmarks,
        "list_length": h,
        "n_queries": sum(document["n_queries"] for document in by_length[h].values()),
        "n_left_out": sum(document["n_left_out"] for document in by_length[h].values()),
        "n_episodes": sum(document["n_episodes"] for document in active_documents.values()),
        "second_season": {triplet: document["second_season"] for triplet, document in by_length[h].items()},
        "claims": [
            *_claims_of_views(views[h], by_length[h], config.seed),
            *_claims_of_moves(moves, active_documents, config.seed),
        ],
        "by_triplet": {
            triplet: {
                "anr": {str(length): by_length[length][triplet]["anr"] for length in lengths},
                "recall": by_length[h][triplet]["recall"],
                "active": {"ours": document["anr"], "paper": document["anr_paper"]},
                "views_to_confident": _numbers(document["views_to"]),
            }
            for triplet, document in active_documents.items()
        },
        "methods": [*first_document["anr"]],
    }


def _numbers(figures: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of a document, without the intervals that lie beside them."""
    return {name: value for name, value in figures.items() if isinstance(value, float)}


def _mean_of(documents: Sequence[Any]) -> Any:
    """The mean of documents of one form, number by number."""
    if isinstance(documents[0], Mapping):
        return {key: _mean_of([document[key] for document in documents]) for key in documents[0]}
    return float(np.mean([np.nan if document is None else document for document in documents]))


def _judge(
    claim: str, pooled: PooledFigures, name: str, rival: str, is_less: Sequence[bool], seed: int, said_by: str = "paper"
) -> Document:
    """A claim that one method's figure is less than another's; whether it is so in every triplet."""
    difference = pooled.difference(name, rival, seed)
    ends = [difference["stretches"], difference["drives"]]
    verdict = HOLDS if all(high < 0 for _, high in ends) else UNDECIDED
    verdict = OTHERWISE if all(low > 0 for low, _ in ends) else verdict
    return {
        "claim": claim,
        "said_by": said_by,
        "values": {name: pooled.mean(name), rival: pooled.mean(rival)},
        "difference": difference,
        "n_agree": int(sum(is_less)),
        "n_triplets": len(is_less),
        "verdict": verdict,
        "why": "",
    }


def _claims_of_views(pooled: PooledFigures, documents: Mapping[str, Document], seed: int) -> list[Document]:
    """The claims of Fig. 6, at the list length that everything is measured at, and ours."""

    def judge(claim: str, name: str, rival: str, said_by: str = "paper") -> Document:
        is_less = [document["anr"][name] < document["anr"][rival] for document in documents.values()]
        return _judge(claim, pooled, name, rival, is_less, seed, said_by)

    brute, rrf, our_relevance = Relevance.BRUTE_FORCE.value, Relevance.RRF.value, DEFAULT_RELEVANCE.value
    claims = [judge("Brute force beats RRF", brute, rrf)]
    claims += [judge(f"RRF beats {display_name(rival)}", rrf, rival) for rival in _FELL_BEHIND]
    for name in _FELL_BEHIND:
        figure = pooled.figures(seed)[name]
        low, high = figure["stretches"]
        claims.append(
            {
                "claim": f"{display_name(name)[0].upper()}{display_name(name)[1:]} is as bad as chance",
                "said_by": "paper",
                "values": {name: figure["mean"], "chance": _CHANCE},
                "difference": {"mean": figure["mean"] - _CHANCE, "stretches": [low - _CHANCE, high - _CHANCE]},
                "n_agree": sum(document["anr"][name] >= _NEAR_CHANCE for document in documents.values()),
                "n_triplets": len(documents),
                "verdict": HOLDS if low >= _NEAR_CHANCE else OTHERWISE if high < _NEAR_CHANCE else UNDECIDED,
                "why": "",
            }
        )
    claims += [judge(f"Composed beats {display_name(rival)}", our_relevance, rival, "us") for rival in (rrf, brute)]
    if claims[0]["verdict"] != HOLDS and pooled.mean(BRUTE_FORCE_U) < pooled.mean(brute):
        claims[0]["why"] = (
            f"Brute force errs by what a season shifts and scales: with every number standardised by its own drive the "
            f"same whole vectors score {pooled.mean(BRUTE_FORCE_U):.2f} % in place of {pooled.mean(brute):.2f} %."
        )
    return claims


def _claims_of_moves(
    moves: Mapping[str, PooledFigures], documents: Mapping[str, Document], seed: int
) -> list[Document]:
    """The claims of Fig. 7, and ours of views until the robot is sure."""

    def judge(claim: str, setup: str, name: str, rival: str, said_by: str = "paper") -> Document:
        figures_of: Callable[[Document], Mapping[str, float]] = {
            "paper": lambda document: document["anr_paper"],
            "ours": lambda document: document["anr"],
            "views": lambda document: document["views_to"],
        }[setup]
        is_less = [figures_of(document)[name] < figures_of(document)[rival] for document in documents.values()]
        return _judge(claim, moves[setup], name, rival, is_less, seed, said_by)

    paper_figures, view_figures = moves["paper"], moves["views"]
    best_move, soonest_move = (
        min((name for name in figures.sums if name.startswith(CONSTANT)), key=figures.mean)
        for figures in (paper_figures, view_figures)
    )
    move_m = float(np.mean([document["mean_move_m"]["paper"][NNQL] for document in documents.values()]))
    claims = [
        judge("NNQL beats random moves", "paper", NNQL, RANDOM),
        judge(f"NNQL beats the best constant move, {display_name(best_move)}", "paper", NNQL, best_move),
        judge("Informed needs fewer views than random moves", "views", DEFAULT_PLANNER, RANDOM, "us"),
        judge(
            f"Informed needs fewer views than the best constant move, {display_name(soonest_move)}",
            "views",
            DEFAULT_PLANNER,
            soonest_move,
            "us",
        ),
    ]
    ends = [f"{CONSTANT}_1", f"{CONSTANT}_10"]
    for claim in [claim for claim in claims[:2] if claim["verdict"] != HOLDS][:1]:
        claim["why"] = (
            f"Constant moves score from {paper_figures.mean(ends[0]):.2f} % (1 m) to "
            f"{paper_figures.mean(ends[1]):.2f} % (10 m), the best of them {paper_figures.mean(best_move):.2f} %; NNQL "
            f"moved {move_m:.1f} m on average and scored {paper_figures.mean(NNQL):.2f} %."
        )
    return claims


_FELL_BEHIND = (Relevance.BAG_OF_LANDMARKS.value, Relevance.SIMBAD.value)


def display_name(name: str) -> str:
    """A method's or a planner's name as a sentence has it."""
    if name.startswith(f"{CONSTANT}_"):
        return f"{name.removeprefix(f'{CONSTANT}_')} m"
    return {"rrf": "RRF", "simbad": "SIMBAD", NNQL: "NNQL"}.get(name, name.replace("_", " "))
