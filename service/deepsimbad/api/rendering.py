"""From the engine's arrays to the answers' models."""

import math

import numpy as np
from numpy.typing import NDArray

from deepsimbad.api.schemas import (
    ActionAnswer,
    BeliefAnswer,
    HistogramAnswer,
    JobAnswer,
    JobError,
    JobResult,
    LocalizationAnswer,
    MapAnswer,
    NextBestViewAnswer,
    PlaceAnswer,
    RetrievedAnswer,
)
from deepsimbad.core.belief_summary import BeliefSummary
from deepsimbad.core.planners import Plan
from deepsimbad.core.route import Route
from deepsimbad.engine.localizer import Localization
from deepsimbad.engine.views import Stopwatch
from deepsimbad.store.records import JobRecord, MapRecord


def render_localization(localization: Localization, watch: Stopwatch) -> LocalizationAnswer:
    """The answer to one view.

    Args:
        localization: What the engine found.
        watch: Runs since the request arrived.
    """
    route = localization.snapshot.route
    retrieval = render_shortlist(route, localization.shortlist, localization.retrieval.relevance)
    belief = render_belief(route, localization.belief)
    return LocalizationAnswer.model_construct(
        map_version=localization.snapshot.version,
        timings_ms=watch.timings_ms(),
        belief=belief,
        retrieval=retrieval,
        next_best_view=render_plan(localization.plan, localization.snapshot.actions_m),
    )


def render_shortlist(route: Route, ids: NDArray[np.int64], relevance: NDArray[np.float32]) -> list[RetrievedAnswer]:
    """Map images with their places and relevances."""
    return [
        RetrievedAnswer.model_construct(map_image=image, route_position_m=position_m, relevance=worth)
        for image, position_m, worth in zip(
            ids.tolist(), route.position_m[ids].tolist(), relevance[ids].tolist(), strict=True
        )
    ]


def render_plan(plan: Plan | None, actions_m: NDArray[np.float64]) -> NextBestViewAnswer | None:
    """A recommended move; None where there is none."""
    if plan is None:
        return None
    values = [None] * actions_m.size if plan.values is None else plan.values.tolist()
    return NextBestViewAnswer.model_construct(
        planner=plan.planner,
        action_m=plan.action_m,
        actions=[
            ActionAnswer.model_construct(action_m=action_m, q_value=value)
            for action_m, value in zip(actions_m.tolist(), values, strict=True)
        ],
    )


def render_belief(route: Route, belief: BeliefSummary) -> BeliefAnswer:
    """A belief, with the coordinates of its likeliest places.

    The values come from the engine alone, so the models are filled without being checked a second time.
    """
    top = [
        PlaceAnswer.model_construct(map_image=image, route_position_m=position_m, x_m=x_m, y_m=y_m, mass=mass)
        for image, position_m, x_m, y_m, mass in zip(
            belief.top.tolist(),
            route.position_m[belief.top].tolist(),
            _known(route.x_m, belief.top),
            _known(route.y_m, belief.top),
            belief.top_mass.tolist(),
            strict=True,
        )
    ]
    histogram = HistogramAnswer.model_construct(
        edges_m=belief.histogram_edges_m.tolist(), mass=belief.histogram_mass.tolist()
    )
    return BeliefAnswer.model_construct(
        mean_m=belief.mean_m,
        mode_m=belief.mode_m,
        std_m=belief.std_m,
        credible_95_m=belief.credible_95_m,
        entropy_bits=belief.entropy_bits,
        off_route=belief.off_route,
        histogram=histogram,
        top=top,
    )


def _known(values: NDArray[np.float64] | None, ids: NDArray[np.int64]) -> list[float | None]:
    """Values at these ids, None where unknown."""
    if values is None:
        return [None] * ids.size
    return [value if math.isfinite(value) else None for value in values[ids].tolist()]


def render_job(record: JobRecord) -> JobAnswer:
    """A job."""
    error = record.error
    return JobAnswer(
        job_id=record.job_id,
        domain=record.domain,
        kind=record.kind,
        state=record.state.value,
        stage=record.stage,
        progress=record.progress,
        eta_s=record.eta_s,
        result=None if record.result is None else JobResult(**record.result),
        error=None if error is None else JobError(code=error["code"], detail=error["message"]),
        config=record.config,
        created_at=record.created_at,
        started_at=record.started_at,
        finished_at=record.finished_at,
    )


def render_map(record: MapRecord) -> MapAnswer:
    """A map version."""
    return MapAnswer(
        version=record.version,
        state=record.state.value,
        created_at=record.created_at,
        activated_at=record.activated_at,
        retired_at=record.retired_at,
        removed_at=record.removed_at,
        sha256=record.sha256,
        file_bytes=record.file_bytes,
        config=record.config,
        metrics=record.metrics,
    )
