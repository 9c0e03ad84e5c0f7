"""Where a single view places the robot: stateless, from a uniform prior."""

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
    RANKS,
    RANKS_SCHEMA,
    ObservationBody,
    declare,
    media_type_of,
    parse_json,
    read_bytes,
)
from deepsimbad.api.dependencies import DomainName, Running, Services
from deepsimbad.api.entity_tags import LandmarkModelTag, insisted_on
from deepsimbad.api.long_work import written
from deepsimbad.api.openapi import binary, problems
from deepsimbad.api.rendering import render_localization
from deepsimbad.api.schemas import LocalizationAnswer
from deepsimbad.engine.localizer import Localization, Retrieval, localize, retrieve, shortlist_length
from deepsimbad.engine.views import NothingSeen, PackedRanks, Stopwatch, View
from deepsimbad.engine.worker import Priority
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.image import MEDIA_TYPES

router = APIRouter(prefix="/v1/domains", tags=["localization"])

OBSERVATION_TYPES = (*MEDIA_TYPES, JSON, RANKS)
OBSERVATION_BODY = declare({**dict.fromkeys(MEDIA_TYPES, IMAGE_SCHEMA), JSON: OBSERVATION_SCHEMA, RANKS: RANKS_SCHEMA})


@router.post(
    "/{domain}/localizations",
    response_model=LocalizationAnswer,
    responses={
        200: {"content": dict(binary("float32 npy [n]: the relevance of every map image, in route order"))},
        **problems(404, 409, 413, 415, 422),
    },
    openapi_extra=OBSERVATION_BODY,
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
    if_match: LandmarkModelTag = None,
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
    landmark_models = insisted_on(if_match)
    body = await read_bytes(request)
    watch.lap("receive")
    evaluator = running.evaluators.evaluator(active.record.evaluator)
    view = await view_in(body, running, media_type, evaluator)
    if prefers_binary(request):

        def compare(seen: View) -> Retrieval:
            active.snapshot.check_landmark_model(landmark_models)
            return retrieve(active.snapshot, evaluator, seen)

        return npy_response((await running.look(evaluator, view, compare)).relevance)
    watch.lap("decode")

    def look(seen: View) -> Localization:
        watch.lap("wait", seen)
        active.snapshot.check_landmark_model(landmark_models)
        found = localize(active.snapshot, evaluator, seen, shortlist)
        watch.take(found.timings_ms)
        return found

    localization = await running.look(evaluator, view, look)
    answer, text = await written(localization.belief.top.size, lambda: render_localization(localization, watch))
    running.metrics.localized(domain, answer.timings_ms, answer.belief.entropy_bits)
    return Response(text, media_type=JSON)


async def view_in(body: bytes, running: Services, media_type: str, evaluator: Evaluator) -> View:
    """The observation in a body that has been read; an image at its evaluator's size."""
    if media_type == JSON:
        return (await parse_json(body, ObservationBody)).view()
    if media_type == RANKS:
        return PackedRanks(body)
    decoded = await running.decoders.decoded(body, evaluator, Priority.LIVE)
    return NothingSeen() if decoded.is_blank else decoded.image


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
