"""What the triplets of the paper come to together: means, intervals over stretches and over drives, claims judged."""

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
class Pooled:
    """One figure of every method over the test frames of all triplets, by stretches of 20 m."""

    n: NDArray[np.int64]  # [stretches] frames or starts there
    sums: dict[str, NDArray[np.float64]]  # by method, [stretches]
    drive: NDArray[np.int64]  # [stretches] the test drive

    @classmethod
    def of(cls, blocks: Mapping[str, Document]) -> Self:
        """Of triplets' `blocks`, by the triplet's name."""
        seasons = list(SEASONS)
        drive = [np.full(len(each["n"]), seasons.index(triplet[-2:])) for triplet, each in blocks.items()]
        first = next(iter(blocks.values()))
        sums = {name: np.concatenate([each["sums"][name] for each in blocks.values()]) for name in first["sums"]}
        return cls(np.concatenate([each["n"] for each in blocks.values()]), sums, np.concatenate(drive))

    def mean(self, name: str) -> float:
        """Of all frames."""
        return float(self.sums[name].sum() / self.n.sum())

    def figures(self, seed: int) -> dict[str, Document]:
        """Every method's mean, with its intervals."""
        return {name: {"mean": self.mean(name), **self._intervals(sums, seed)} for name, sums in self.sums.items()}

    def difference(self, name: str, rival: str, seed: int) -> Document:
        """A method's less its rival's, frame by frame."""
        return {"mean": self.mean(name) - self.mean(rival), **self._intervals(self.sums[name] - self.sums[rival], seed)}

    def _intervals(self, sums: NDArray[np.float64], seed: int) -> dict[str, list[float]]:
        """95 %, by stretches, and by test drives: of what other stretches and what other days would have shown."""
        values = np.repeat(sums / self.n, self.n)
        stretches, drives = np.arange(self.n.size), self.drive
        return {
            name: list(mean_interval(values, seed, np.repeat(group, self.n)))
            for name, group in (("stretches", stretches), ("drives", drives))
        }


def paper_document(config: PaperConfig, results: Mapping[str, Document]) -> Document:
    """Everything that the report shows of what was measured, JSON-ready; percent."""
    lengths = [h for h in config.list_lengths if all(str(h) in each for each in results.values())]
    at = {h: {triplet: each[str(h)] for triplet, each in results.items()} for h in lengths}
    h = min(lengths, key=lambda length: abs(length - config.list_length))
    active = {triplet: each["active"] for triplet, each in results.items()}
    single = {length: Pooled.of({t: each["blocks"] for t, each in at[length].items()}) for length in lengths}
    moves = {
        setup: Pooled.of({triplet: each["blocks"][setup] for triplet, each in active.items()})
        for setup in (*SETUPS, "views")
    }
    first, first_moves = next(iter(at[h].values())), next(iter(active.values()))
    return {
        "anr": {str(length): each.figures(config.seed) for length, each in single.items()},
        "recall": _mean_of([each["recall"] for each in at[h].values()]),
        "anr_at": _mean_of([each["anr_at"] for each in at[h].values()]),
        "active": {setup: each.figures(config.seed) for setup, each in moves.items()},
        "wrong_when_confident": _mean_of([_numbers(each["wrong_when"]) for each in active.values()]),
        "metres_to_confident": _mean_of([_numbers(each["metres_to"]) for each in active.values()]),
        "mean_move_m": _mean_of([each["mean_move_m"] for each in active.values()]),
        "index_bits_per_map_image": _mean_of([each["index_bits"] for each in at[h].values()]),
        "took_ms": _mean_of([each["took_ms"] for each in active.values()]),
        "evaluations": first_moves["evaluations"],
        "evaluations_s": first_moves["evaluations_s"],
        "evaluations_of_the_paper": config.training_episodes * 10 * config.n_landmarks,
        "list_length": h,
        "n_queries": sum(each["n_queries"] for each in at[h].values()),
        "n_left_out": sum(each["n_left_out"] for each in at[h].values()),
        "n_episodes": sum(each["n_episodes"] for each in active.values()),
        "second_season": {triplet: each["second_season"] for triplet, each in at[h].items()},
        "claims": [*_claims_of_views(single[h], at[h], config.seed), *_claims_of_moves(moves, active, config.seed)],
        "by_triplet": {
            triplet: {
                "anr": {str(length): at[length][triplet]["anr"] for length in lengths},
                "recall": at[h][triplet]["recall"],
                "active": {"ours": each["anr"], "paper": each["anr_paper"]},
                "views_to_confident": _numbers(each["views_to"]),
            }
            for triplet, each in active.items()
        },
        "methods": [*first["anr"]],
    }


def _numbers(figures: Mapping[str, Any]) -> dict[str, float]:
    """Without the intervals that lie beside them."""
    return {name: value for name, value in figures.items() if isinstance(value, float)}


def _mean_of(documents: Sequence[Any]) -> Any:
    """Number by number."""
    if isinstance(documents[0], Mapping):
        return {key: _mean_of([each[key] for each in documents]) for key in documents[0]}
    return float(np.mean([np.nan if each is None else each for each in documents]))


def _judged(
    claim: str, pooled: Pooled, name: str, rival: str, agree: Sequence[bool], seed: int, said_by: str = "paper"
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
        "n_agree": int(sum(agree)),
        "n_triplets": len(agree),
        "verdict": verdict,
        "why": "",
    }


def _claims_of_views(pooled: Pooled, at: Mapping[str, Document], seed: int) -> list[Document]:
    """What Fig. 6 says at the list length that everything is measured at, and what we say."""

    def judged(claim: str, name: str, rival: str, said_by: str = "paper") -> Document:
        agree = [each["anr"][name] < each["anr"][rival] for each in at.values()]
        return _judged(claim, pooled, name, rival, agree, seed, said_by)

    brute, rrf, ours = Relevance.BRUTE_FORCE.value, Relevance.RRF.value, DEFAULT_RELEVANCE.value
    claims = [judged("Brute force beats RRF", brute, rrf)]
    claims += [judged(f"RRF beats {shown_name(each)}", rrf, each) for each in _FELL_BEHIND]
    for name in _FELL_BEHIND:
        figure = pooled.figures(seed)[name]
        low, high = figure["stretches"]
        claims.append(
            {
                "claim": f"{shown_name(name)[0].upper()}{shown_name(name)[1:]} is as bad as chance",
                "said_by": "paper",
                "values": {name: figure["mean"], "chance": _CHANCE},
                "difference": {"mean": figure["mean"] - _CHANCE, "stretches": [low - _CHANCE, high - _CHANCE]},
                "n_agree": sum(each["anr"][name] >= _NEAR_CHANCE for each in at.values()),
                "n_triplets": len(at),
                "verdict": HOLDS if low >= _NEAR_CHANCE else OTHERWISE if high < _NEAR_CHANCE else UNDECIDED,
                "why": "",
            }
        )
    claims += [judged(f"Composed beats {shown_name(each)}", ours, each, "us") for each in (rrf, brute)]
    if claims[0]["verdict"] != HOLDS and pooled.mean(BRUTE_FORCE_U) < pooled.mean(brute):
        claims[0]["why"] = (
            f"Brute force errs by what a season shifts and scales: with every number standardised by its own drive the "
            f"same whole vectors score {pooled.mean(BRUTE_FORCE_U):.2f} % in place of {pooled.mean(brute):.2f} %."
        )
    return claims


def _claims_of_moves(moves: Mapping[str, Pooled], active: Mapping[str, Document], seed: int) -> list[Document]:
    """What Fig. 7 says, and what we say of views until the robot is sure."""

    def judged(claim: str, setup: str, name: str, rival: str, said_by: str = "paper") -> Document:
        at: Callable[[Document], Mapping[str, float]] = {
            "paper": lambda each: each["anr_paper"],
            "ours": lambda each: each["anr"],
            "views": lambda each: each["views_to"],
        }[setup]
        agree = [at(each)[name] < at(each)[rival] for each in active.values()]
        return _judged(claim, moves[setup], name, rival, agree, seed, said_by)

    pooled, views = moves["paper"], moves["views"]
    best, soonest = (
        min((name for name in each.sums if name.startswith(CONSTANT)), key=each.mean) for each in (pooled, views)
    )
    move_m = float(np.mean([each["mean_move_m"]["paper"][NNQL] for each in active.values()]))
    claims = [
        judged("NNQL beats random moves", "paper", NNQL, RANDOM),
        judged(f"NNQL beats the best constant move, {shown_name(best)}", "paper", NNQL, best),
        judged("Informed needs fewer views than random moves", "views", DEFAULT_PLANNER, RANDOM, "us"),
        judged(
            f"Informed needs fewer views than the best constant move, {shown_name(soonest)}",
            *("views", DEFAULT_PLANNER, soonest, "us"),
        ),
    ]
    ends = [f"{CONSTANT}_1", f"{CONSTANT}_10"]
    for claim in [claim for claim in claims[:2] if claim["verdict"] != HOLDS][:1]:
        claim["why"] = (
            f"Constant moves score from {pooled.mean(ends[0]):.2f} % (1 m) to {pooled.mean(ends[1]):.2f} % (10 m), "
            f"the best of them {pooled.mean(best):.2f} %; NNQL moved {move_m:.1f} m on average and scored "
            f"{pooled.mean(NNQL):.2f} %."
        )
    return claims


_FELL_BEHIND = (Relevance.BAG_OF_LANDMARKS.value, Relevance.SIMBAD.value)


def shown_name(name: str) -> str:
    """A method's or a planner's name as a sentence has it."""
    if name.startswith(f"{CONSTANT}_"):
        return f"{name.removeprefix(f'{CONSTANT}_')} m"
    return {"rrf": "RRF", "simbad": "SIMBAD", NNQL: "NNQL"}.get(name, name.replace("_", " "))
