"""How many landmarks, chosen how: accuracy over r, time over length of route; and what else was tried for lists.

    python -m bench.landmarks

What is tried is chosen by the rehearsal alone, in which the landmark drive is driven through lists of the training
drive without a place's own landmark; the test drive is then judged once.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from bench.measurement import RESULTS, Command, duration, figures, machine, markdown, print_page, scored, timed
from bench.quantised import LIST_LENGTH, TOLERANCE, composed_places, k_means, session_scores
from bench.recordings import encoded, netvlad_drives, real_recordings
from deepsimbad.core import composed
from deepsimbad.core.building import Built, MapPlan, compose_map
from deepsimbad.core.composed import Moments, compose, described, learnt_landmarks, unit
from deepsimbad.core.drive import Drive
from deepsimbad.core.landmark_model import farthest_first, select_landmarks
from deepsimbad.core.metrics import RetrievalScores
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import true_images_of

_NUMBERS = (37, 75, 150, 300)  # r: a sixteenth of the NetVLAD places, an eighth, a quarter, a half
_LENGTHS = (1_000, 5_000, 26_208)  # map images
_N_LANDMARKS = 500
Rule = Callable[[NDArray[np.float32], int], NDArray[np.int64]]
Lists = Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_] | None], NDArray[np.uint16]]


def medoids(u: NDArray[np.float32], n_landmarks: int) -> NDArray[np.int64]:
    """[r] the rows nearest to the centres of k-means of unit vectors, none twice."""
    centres, is_taken = unit(k_means(u, n_landmarks)), np.zeros(len(u), bool)
    rows = []
    for products in centres @ u.T:
        products[is_taken] = -2.0
        rows.append(int(products.argmax()))
        is_taken[rows[-1]] = True
    return np.array(rows, np.int64)


RULES: dict[str, Rule] = {
    "farthest first (default)": farthest_first,
    "medoids of k-means": medoids,
    "the paper's (II-B)": select_landmarks,
}
AS_CHOSEN = "farthest first, not moved"


@dataclass(frozen=True)
class Case:
    """A map to make and a drive to judge it by."""

    training: Drive
    test: Drive
    second: Drive | None = None  # of the same route, and the landmark drive; None: the training drive gives them

    def build(self, r: int) -> Built:
        """The map with `r` landmarks chosen by the default rule."""
        plan = MapPlan(Relevance.COMPOSED, LIST_LENGTH, (1.0,), same_route=self.second is not None)
        return compose_map(plan, self.training, self.second, self.second, r)

    def landmarks(self, built_map: Built, rule: Rule, r: int) -> NDArray[np.float32]:
        """[r, k] landmarks chosen by a rule, as unit vectors of the map."""
        candidates = self.second or self.training
        projection = built_map.map.landmark_model.get("projection")
        u = described(candidates.encodings, Moments.of(candidates.encodings), projection)
        return u[rule(u, r)]

    def scores(self, built_map: Built, landmarks: NDArray[np.float32]) -> RetrievalScores:
        """Scores of the test drive on lists of these landmarks [r, k]."""
        restored = composed_places(compose(built_map.places, landmarks, LIST_LENGTH), landmarks)
        return session_scores(built_map, restored, self.test)


def cases() -> dict[str, list[Case]]:
    """Cases of real recordings, by the name of their set."""
    drives, folder = netvlad_drives(), real_recordings()
    query, reference = (encoded(folder / "corridor" / name) for name in ("query", "ref"))
    summer, winter = (encoded(folder / "nordland" / f"{season}#0:600") for season in ("summer", "winter"))
    return {
        "NetVLAD, two seasons": [Case(m, t, second) for second, m, t in itertools.permutations(drives)],
        "NetVLAD, one season": [Case(m, t) for m, t in itertools.permutations(drives, 2)],
        "Nordland images, one season": [Case(summer, winter), Case(winter, summer)],
        "corridor, one season": [Case(reference, query), Case(query, reference)],
    }


def accuracy(all_cases: dict[str, list[Case]]) -> Iterator[str]:
    """ANR and R@1 by set, rule and r; r is cut to the number of frames."""
    rows = []
    for name, set_cases in all_cases.items():
        scores: dict[str, list[list[RetrievalScores]]] = {rule: [] for rule in (*RULES, AS_CHOSEN)}
        for r in _NUMBERS:
            for per_rule in scores.values():
                per_rule.append([])
            for case in set_cases:
                n_landmarks = min(r, case.training.n_frames)
                built_map = case.build(n_landmarks)
                for rule, per_rule in scores.items():
                    landmarks = case.landmarks(built_map, RULES.get(rule, farthest_first), n_landmarks)
                    if rule != AS_CHOSEN:
                        landmarks = learnt_landmarks(built_map.places, landmarks, LIST_LENGTH)
                    per_rule[-1].append(case.scores(built_map, landmarks))
        for rule, by_r in scores.items():
            cells = (figures(scores_of_r) for scores_of_r in by_r)
            rows.append([name, rule, *(f"{anr} / {recall}" for anr, recall, _ in cells)])
    return markdown(("set", "landmarks by", *(f"r = {r}" for r in _NUMBERS)), rows)


def times() -> Iterator[str]:
    """Seconds to choose 500 landmarks, move them and compose lists, on made-up drives whose neighbours are alike."""
    rows = []
    for n in _LENGTHS:
        steps = np.random.default_rng(0).normal(size=(n, composed.MOST_DIMENSIONS)).astype(np.float32)
        u = unit(steps + np.roll(steps, 1, axis=0) + np.roll(steps, 2, axis=0))
        choosing = [timed(lambda rule=rule, u=u: rule(u, _N_LANDMARKS), 1, 0) for rule in RULES.values()]
        landmarks = u[farthest_first(u, _N_LANDMARKS)]
        moving = timed(lambda u=u, landmarks=landmarks: learnt_landmarks(u, landmarks, LIST_LENGTH), 1, 0)
        composing = timed(lambda u=u, landmarks=landmarks: compose(u, landmarks, LIST_LENGTH), 1, 0)
        rows.append([f"{n:,}", *(duration(timing.median_s) for timing in (*choosing, moving, composing))])
    return markdown(("map images", *RULES, "moved", "all lists"), rows)


def by_beam(
    places: NDArray[np.float32], landmarks: NDArray[np.float32], barred: NDArray[np.bool_] | None
) -> NDArray[np.uint16]:
    """[h, n] lists by the default."""
    return compose(places, landmarks, LIST_LENGTH, barred)


def greedy(
    places: NDArray[np.float32], landmarks: NDArray[np.float32], barred: NDArray[np.bool_] | None
) -> NDArray[np.uint16]:
    """[h, n] lists by a beam of one: one after the other, the landmark that brings the sum nearest."""
    products, gram, rows = places @ landmarks.T, landmarks @ landmarks.T, np.arange(len(places))
    excluded = np.zeros(products.shape, bool) if barred is None else barred.copy()
    products_so_far, squares, cross, lists = np.zeros(len(places)), np.zeros(len(places)), np.zeros(products.shape), []
    for weight in composed.list_weights(LIST_LENGTH):
        cosine = (products_so_far[:, np.newaxis] + weight * products) / np.sqrt(
            np.maximum(squares[:, np.newaxis] + weight * (2 * cross + weight), 1e-9)
        )
        cosine[excluded] = -np.inf
        lists.append(ids := cosine.argmax(axis=1))
        products_so_far += weight * products[rows, ids]
        squares += weight * (2 * cross[rows, ids] + weight)
        cross += weight * gram[ids]
        excluded[rows, ids] = True
    return np.array(lists, np.uint16)


def smoothed(
    places: NDArray[np.float32], landmarks: NDArray[np.float32], barred: NDArray[np.bool_] | None
) -> NDArray[np.uint16]:
    """[h, n] lists of places to which a quarter of their neighbours along the route is added."""
    padded = np.concatenate([places[:1], places, places[-1:]])
    return by_beam(unit(places + 0.25 * (padded[:-2] + padded[2:])), landmarks, barred)


WEIGHTS = [tuple(share**place for place in range(LIST_LENGTH)) for share in (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)]


def tried(set_cases: Sequence[Case], r: int) -> Iterator[str]:
    """Other ways to make lists, by rehearsal and on the test drives."""
    ways: dict[str, tuple[tuple[float, ...], Lists]] = {
        "beam of 8 (default)": (composed.WEIGHTS, by_beam),
        "greedy, beam of 1": (composed.WEIGHTS, greedy),
        "smoothed along the route": (composed.WEIGHTS, smoothed),
        **{f"weights {', '.join(f'{weight:.2f}' for weight in weights)}": (weights, by_beam) for weights in WEIGHTS},
    }
    rehearsals: dict[str, list[RetrievalScores]] = {name: [] for name in ways}
    tests: dict[str, list[RetrievalScores]] = {name: [] for name in ways}
    for case in set_cases:
        built_map = case.build(r)
        landmarks = case.landmarks(built_map, farthest_first, r)
        for name, (weights, lists) in ways.items():
            frozen = np.array(weights, np.float32)
            with patch.object(composed, "list_weights", lambda _, frozen=frozen: frozen):
                rehearsals[name].append(rehearsed(case, built_map, landmarks, lists))
                restored = composed_places(lists(built_map.places, landmarks, None), landmarks)
            tests[name].append(session_scores(built_map, restored, case.test))
    rows = [[name, *figures(rehearsals[name]), *figures(tests[name])] for name in ways]
    titles = (f"{judge}: {figure}" for judge in ("rehearsal", "test") for figure in ("ANR %", "R@1 %", "worst"))
    return markdown(("lists by", *titles), rows)


def rehearsed(case: Case, built_map: Built, landmarks: NDArray[np.float32], lists: Lists) -> RetrievalScores:
    """Scores of the landmark drive on lists of the training drive alone, a place's own landmarks barred."""
    projection = built_map.map.landmark_model.get("projection")
    views, places = (
        described(drive.encodings, Moments.of(drive.encodings), projection) for drive in (case.second, case.training)
    )
    from_m = case.second.position_m[(landmarks @ views.T).argmax(axis=1)]
    barred = np.abs(case.training.position_m[:, np.newaxis] - from_m) <= TOLERANCE
    restored = composed_places(lists(places, landmarks, barred), landmarks)
    return scored(views @ restored.T, true_images_of(case.second.route(), case.training.route(), TOLERANCE))


def report() -> Iterator[str]:
    """The lines of the page."""
    all_cases = cases()
    yield from ("# Landmarks: how many, chosen how", "")
    yield (
        "h = 4, one session over the test drive, tolerance 2 m, every order of the drives. Images (the corridor, and "
        "600 places of Nordland) are encoded by the default extractor. One season: landmarks from the map's own drive. "
        "Landmarks are frames by one of three rules, and then moved to where their sums come nearest to the places."
    )
    yield from ("", "Made by `python -m bench.landmarks`.", "", machine())
    yield from ("", "## Accuracy", "", "ANR / R@1, percent.", "")
    yield from accuracy(all_cases)
    yield from ("", "Longer routes: [long-route.md](long-route.md).")
    yield from ("", f"## Time to choose {_N_LANDMARKS}, made-up encodings of {composed.MOST_DIMENSIONS} numbers", "")
    yield from times()
    yield from ("", "## What was tried for lists", "")
    yield (
        "NetVLAD, two seasons, r = 300, landmarks as they were chosen. Rehearsal: the landmark drive against lists of "
        "the training drive alone, by which a way may be chosen; test: what it comes to, looked at once."
    )
    yield ""
    yield from tried(all_cases["NetVLAD, two seasons"], 300)


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(report(), RESULTS / "landmarks.md"))
