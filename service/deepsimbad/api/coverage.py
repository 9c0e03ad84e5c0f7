"""A domain's map for people to look at: where on its route it can be trusted, its landmarks, pictures of both."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from anyio.to_thread import run_sync
from fastapi import APIRouter, Response
from fastapi import Path as PathParameter
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import TypedDict

from deepsimbad.api.localizations import FrameName
from deepsimbad.api.problems import problems
from deepsimbad.api.requests import GREATEST_ID, JSON, DomainName, PinnedVersion, RunningServices, StrictRoute
from deepsimbad.core.map import Map
from deepsimbad.core.rehearsal import WITHIN_M, worst_stretches

router = APIRouter(prefix="/v1/domains", tags=["domains"], route_class=StrictRoute)

Metres = list[float | None] | None


class StretchAnswer(TypedDict):
    """A part of the route where views are placed rightly less often than elsewhere."""

    from_m: float
    to_m: float
    chance: Annotated[float, Field(description="Mean over its map images.", ge=0, le=1)]
    first_map_image: int
    last_map_image: int
    first_frame: FrameName
    last_frame: FrameName
    worst_map_image: int
    worst_frame: FrameName


class CoverageAnswer(TypedDict):
    """Every map image, and how surely its place is recognised; columns are in route order."""

    domain: str
    map_version: int
    thumbnail_bytes: Annotated[int, Field(description="Of all small pictures that the domain keeps; 0: it keeps none.")]
    within_m: Annotated[float, Field(description="A view is placed rightly so near to its place.")]
    basis: Annotated[
        Literal["two_seasons", "one_season"] | None,
        Field(description="What it was learnt from; null: an earlier release made the map."),
    ]
    stretches: Annotated[list[StretchAnswer], Field(description="Where it is well below the mean, worst first.")]
    route_position_m: list[float]
    x_m: Annotated[Metres, Field(description="null where the map knows none.")]
    y_m: Metres
    chance: Annotated[
        list[float | None] | None, Field(description="That one view alone is placed rightly; null where unknown.")
    ]


@router.get("/{domain}/coverage", response_model=CoverageAnswer, responses=problems(404, 409, 410, 422))
async def get_coverage(domain: DomainName, services: RunningServices, map_version: PinnedVersion = None) -> Response:
    """For every map image the chance that a single view there is placed rightly; worst stretches first."""
    snapshot = await services.snapshot(domain, map_version)
    record = await run_sync(services.catalog.map, domain, snapshot.version)
    n_bytes = await run_sync(services.pictures.n_bytes, domain)
    _, body = await services.render_json(snapshot.n_images, render_coverage, snapshot, record.metrics, n_bytes)
    return Response(body, media_type=JSON)


def render_coverage(snapshot: Map, metrics: Mapping[str, Any], thumbnail_bytes: int) -> CoverageAnswer:
    """A map's coverage, with what was measured when it was made; takes some milliseconds for a long route."""
    at_m, frames, chance = snapshot.position_m, snapshot.frames, snapshot.coverage
    stretches: list[StretchAnswer] = []
    for stretch in () if chance is None else worst_stretches(at_m, chance):
        first, last, worst = stretch.first, stretch.last, stretch.worst
        stretches.append(
            {
                "from_m": float(at_m[first]),
                "to_m": float(at_m[last]),
                "chance": stretch.chance,
                "first_map_image": first,
                "last_map_image": last,
                "first_frame": frames[first],
                "last_frame": frames[last],
                "worst_map_image": worst,
                "worst_frame": frames[worst],
            }
        )
    basis: Literal["two_seasons", "one_season"] | None = None
    if chance is not None:
        season = metrics.get("second_season") or {}
        basis = "two_seasons" if season.get("accepted") else "one_season"
    return {
        "domain": snapshot.domain,
        "map_version": snapshot.version,
        "thumbnail_bytes": thumbnail_bytes,
        "within_m": WITHIN_M,
        "basis": basis,
        "stretches": stretches,
        "route_position_m": at_m.round(3).tolist(),
        "x_m": _finite_column(snapshot.x_m, 3),
        "y_m": _finite_column(snapshot.y_m, 3),
        "chance": _finite_column(chance, 4),
    }


def _finite_column(values: NDArray[np.floating] | None, digits: int) -> Metres:
    if values is None or not np.isfinite(values).any():
        return None
    cells = values.astype(np.float64).round(digits).astype(object)
    cells[~np.isfinite(values)] = None
    column: list[float | None] = cells.tolist()
    return column


class LandmarksAnswer(TypedDict):
    """Every landmark of a map; columns are in the order of their numbers, from 0."""

    domain: str
    map_version: int
    thumbnail_bytes: Annotated[int, Field(description="As in the domain's coverage.")]
    n_map_images: Annotated[list[int], Field(description="That list it.")]
    map_image: Annotated[list[int | None], Field(description="That is the frame it began as; null where none is.")]
    frame: Annotated[list[FrameName], Field(description="That it began as, before sums of landmarks moved it.")]
    drive: Annotated[list[str | None], Field(description="That it is of; null where an earlier release made it.")]


@router.get("/{domain}/landmarks", response_model=LandmarksAnswer, responses=problems(404, 409, 410, 422))
async def get_landmarks(domain: DomainName, services: RunningServices, map_version: PinnedVersion = None) -> Response:
    """A map's landmarks: the frames they began as, and how many map images list each."""
    snapshot = await services.snapshot(domain, map_version)
    n_bytes = await run_sync(services.pictures.n_bytes, domain)
    _, body = await services.render_json(snapshot.n_landmarks, render_landmarks, snapshot, n_bytes)
    return Response(body, media_type=JSON)


def render_landmarks(snapshot: Map, thumbnail_bytes: int) -> LandmarksAnswer:
    """A map's landmarks."""
    frame_digests, landmark_digests = snapshot.frame_digest, snapshot.landmark_digest
    image_of = (
        {} if frame_digests is None else dict(zip(frame_digests.tolist(), range(frame_digests.size), strict=True))
    )
    return {
        "domain": snapshot.domain,
        "map_version": snapshot.version,
        "thumbnail_bytes": thumbnail_bytes,
        "n_map_images": np.bincount(snapshot.lists.reshape(-1), minlength=snapshot.n_landmarks).tolist(),
        "map_image": _landmark_column(
            snapshot,
            None if landmark_digests is None else [image_of.get(digest) for digest in landmark_digests.tolist()],
        ),
        "frame": _landmark_column(snapshot, snapshot.landmark_frame),
        "drive": _landmark_column(snapshot, snapshot.landmark_drive),
    }


def _landmark_column(snapshot: Map, values: Iterable[Any] | None) -> list[Any]:
    """One value for every landmark; None where it is unknown."""
    return [None] * snapshot.n_landmarks if values is None else [None if value == "" else value for value in values]


_PICTURE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}},
    **problems(404, 409, 410, 422),
}


@router.get("/{domain}/landmarks/{index}/thumbnail", response_class=Response, responses=_PICTURE)
async def get_landmark_thumbnail(
    domain: DomainName,
    index: Annotated[int, PathParameter(ge=0, le=GREATEST_ID, description="The landmark's number, from 0.")],
    services: RunningServices,
    map_version: PinnedVersion = None,
) -> Response:
    """A small picture of the frame that a landmark began as, where the domain keeps them (`thumbnails`)."""
    snapshot = await services.snapshot(domain, map_version)
    content = await run_sync(services.pictures.of_frame, snapshot, snapshot.landmark_digest, index)
    return Response(content, media_type="image/jpeg")


@router.get("/{domain}/map-images/{index}/thumbnail", response_class=Response, responses=_PICTURE)
async def get_thumbnail(
    domain: DomainName,
    index: Annotated[int, PathParameter(ge=0, le=GREATEST_ID, description="In route order, from 0.")],
    services: RunningServices,
    map_version: PinnedVersion = None,
) -> Response:
    """A small picture of a map image, where the domain keeps them (`thumbnails`)."""
    snapshot = await services.snapshot(domain, map_version)
    content = await run_sync(services.pictures.of_frame, snapshot, snapshot.frame_digest, index)
    return Response(content, media_type="image/jpeg")
