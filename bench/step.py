"""One step of the active localizer after encoding, and its planners alone."""

from collections.abc import Iterator
from statistics import median
from time import perf_counter

import numpy as np

from bench.timing import Timing, duration
from bench.worlds import LIST_LENGTH, N_LANDMARKS, NCLT_IMAGES, dense_lists, standardised_map
from deepsimbad.core.belief import FilterKind
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.planners import NNQL, TELLING
from deepsimbad.core.relevance import Query

_STEPS = 300
_ACTIONS_M = tuple(float(metres) for metres in range(1, 11))


def step_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## One step of the active localizer: {NCLT_IMAGES:,} map images, r = {N_LANDMARKS}, h = {LIST_LENGTH}"
    yield ""
    yield "| filter | planner | step, encoding apart | planner alone |"
    yield "|---|---|---|---|"
    snapshot = _snapshot()
    rng = np.random.default_rng(0)
    views = [Query(rng.permutation(N_LANDMARKS).astype(np.float32) + 1) for _ in range(32)]
    for kind in FilterKind:
        for planner in (NNQL, TELLING):
            localizer = ActiveLocalizer(snapshot, LocalizerConfig(filter=kind, planner=planner), perf_counter)
            yield _row(kind, planner, localizer, views)
    yield ""
    yield f"{_STEPS} steps of 1 m with a random view each, so that the belief stays wide; 1,000 particles."


def _row(kind: FilterKind, planner: str, localizer: ActiveLocalizer, views: list[Query]) -> str:
    state = localizer.start()
    seconds, planning_ms = [], []
    for number in range(_STEPS + 10):
        began = perf_counter()
        step = localizer.step(state, views[number % len(views)], 1.0)
        if number >= 10:
            seconds.append(perf_counter() - began)
            planning_ms.append(step.timings_ms["plan"])
        state = step.state
    return f"| {kind.value} | `{planner}` | {Timing(tuple(seconds))} | {duration(median(planning_ms) / 1000)} |"


def _snapshot() -> Map:
    """A map whose lists drift, with an experience database and telling places of random values."""
    rng = np.random.default_rng(1)
    return standardised_map(
        dense_lists(NCLT_IMAGES).lists,
        actions_m=np.array(_ACTIONS_M),
        telling_bits=rng.random(NCLT_IMAGES).astype(np.float32),
        q_values=rng.random((NCLT_IMAGES, len(_ACTIONS_M))).astype(np.float32),
    )
