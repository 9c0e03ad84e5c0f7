"""Where a single view places the robot: stateless, from a uniform prior."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from io import BytesIO
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray

from deepsimbad.api.bodies import (
    BINARY,
    GREATEST_ID,
    IMAGE_SCHEMA,
    JSON,
    OBSERVATION_SCHEMA,
    ObservationBody,
    declare,
    media_type_of,
    parse_json,
    read_bytes,
)
from deepsimbad.api.dependencies import DomainName, Running, Services
from deepsimbad.api.long_work import written
from deepsimbad.api.openapi import binary, problems
from deepsimbad.api.rendering import render_localization
from deepsimbad.api.schemas import LocalizationAnswer
from deepsimbad.engine.localizer import Localization, localize, retrieve, shortlist_length
from deepsimbad.engine.observation import View
from deepsimbad.engine.stopwatch import Stopwatch
from deepsimbad.evaluators.image import MEDIA_TYPES

router = APIRouter(prefix="/v1/domains", tags=["localization"])

OBSERVATION_TYPES = (*MEDIA_TYPES, JSON)


@router.post(
    "/{domain}/localizations",
    response_model=LocalizationAnswer,
    responses={
        200: {"content": dict(binary("float32 npy [n]: the relevance of every map image, in route order"))},
        **problems(404, 409, 413, 415, 422),
    },
    openapi_extra=declare({**dict.fromkeys(MEDIA_TYPES, IMAGE_SCHEMA), JSON: OBSERVATION_SCHEMA}),
)
async def post_localization(
    domain: DomainName,
    request: Request,
    running: Running,
    shortlist: Annotated[
        int | None,
        Query(
            ge=1,
            le=GREATEST_ID,
            description="Length of `retrieval` and `top`, up to the number of map images; absent: 10 or all.",
        ),
    ] = None,
) -> Response:
    """Localize one view.

    The body is the image itself, or what a robot that encodes on board made of it. An image's real format is read
    from its bytes, whichever of the image types the header names. With `Accept: application/octet-stream` the answer
    is the relevance of every map image.
    """
    watch = Stopwatch()
    active = await running.active(domain)
    media_type = media_type_of(request, OBSERVATION_TYPES)
    shortlist_length(active.snapshot, shortlist)  # a bad query should not cost an upload
    body = await read_bytes(request)
    watch.lap("receive")
    evaluator = running.evaluators.evaluator(active.record.evaluator)
    if prefers_binary(request):
        async with view_in(body, running, media_type) as view:
            retrieval = await running.infer(lambda: retrieve(active.snapshot, evaluator, view))
        return npy_response(retrieval.relevance)

    def look() -> Localization:
        watch.lap("wait")
        found = localize(active.snapshot, evaluator, view, shortlist)
        watch.take(found.timings_ms)
        return found

    async with view_in(body, running, media_type) as view:
        watch.lap("decode")
        localization = await running.infer(look)
    answer, text = await written(localization.belief.top.size, lambda: render_localization(localization, watch))
    running.metrics.localized(domain, answer.timings_ms, answer.belief.entropy_bits)
    return Response(text, media_type=JSON)


@asynccontextmanager
async def view_in(body: bytes, running: Services, media_type: str) -> AsyncIterator[View]:
    """The observation in a body that has been read; an image, as `Services.decoded` gives it."""
    if media_type == JSON:
        yield (await parse_json(body, ObservationBody)).view()
        return
    async with running.decoded(body) as image:
        yield image


def prefers_binary(request: Request) -> bool:
    """Whether `Accept` asks for the npy rather than for JSON."""
    wanted = {}
    for part in request.headers.get("accept", "").split(","):
        media_type, *parameters = (piece.strip().lower() for piece in part.split(";"))
        quality = next((piece[2:] for piece in parameters if piece.startswith("q=")), "1")
        try:
            wanted[media_type] = float(quality)
        except ValueError:
            wanted[media_type] = 0.0
    return wanted.get(BINARY, 0.0) > wanted.get(JSON, 0.0)


def npy_response(values: NDArray[np.float32]) -> Response:
    """An array as a float32 npy file."""
    packed = BytesIO()
    np.save(packed, values.astype(np.float32, copy=False), allow_pickle=False)
    return Response(packed.getvalue(), media_type=BINARY)
