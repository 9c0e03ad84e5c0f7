"""Frames of a traverse: one by one, or many whose encodings are known."""

import dataclasses
import tempfile
from io import BytesIO
from typing import IO, Annotated, Any

import numpy as np
from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, FailFast, Field, StrictFloat

from deepsimbad.api.localizations import IMAGE_SCHEMA, list_schema
from deepsimbad.api.problems import binary, declare, invalid_body, problems
from deepsimbad.api.requests import (
    BINARY,
    GREATEST_EXACT_INTEGER,
    JSON,
    Answer,
    DomainName,
    JsonBody,
    RunningServices,
    Services,
    StrictRoute,
    media_type_of,
    parse_json,
    read_bytes,
)
from deepsimbad.api.scenes import MOST_PARTS, SCENE_BODIES, SCENE_MEMBERS, SCENE_SCHEMA, scene_in
from deepsimbad.api.traverses import TraverseName
from deepsimbad.core.drive import FRAME_NAME, Drive
from deepsimbad.core.frames import MAX_POSITION_M, Camera, content_digest
from deepsimbad.engine.distant import encoded
from deepsimbad.engine.localizer import ready_encodings
from deepsimbad.engine.traverses import read_batch
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import EmptyBodyError, GreyLevelsDifferError, InvalidInputError
from deepsimbad.evaluators.base import Fitting
from deepsimbad.evaluators.grey_levels import GreyLevels
from deepsimbad.evaluators.image_files import MEDIA_TYPES
from deepsimbad.evaluators.scenes import check_whole
from deepsimbad.store.durable import storage_faults

router = APIRouter(
    prefix="/v1/admin/domains/{domain}/traverses/{name}/frames", tags=["admin: traverses"], route_class=StrictRoute
)

FRAME_TYPES = (*MEDIA_TYPES, JSON, *SCENE_BODIES)
_SPOOL_CHUNK_BYTES = 1 << 20

# Bodies and answers


class FrameBody(JsonBody):
    """A frame that was encoded elsewhere, or is told."""

    most_parts = MOST_PARTS

    encoding: Annotated[tuple[StrictFloat, ...], FailFast()] = ()
    objects: Any = None
    text: Any = None


_ENCODING_SCHEMA = list_schema(
    "encoding", {"type": "number"}, "A ready encoding, as long as the others of the traverse."
)
_FRAME_SCHEMA = {"oneOf": [_ENCODING_SCHEMA, SCENE_SCHEMA]}


def _metres(description: str) -> Any:
    return Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M, allow_inf_nan=False, description=description)


Replace = Annotated[
    bool,
    Query(description="false: a frame that is there already and differs is a 409 `frames_differ`, an equal one stays."),
]


class FrameQuery(BaseModel):
    """The place of a frame, and how it is stored."""

    position_m: Annotated[float, _metres("Metres along the route.")]
    timestamp_us: Annotated[
        int | None, Field(ge=0, le=GREATEST_EXACT_INTEGER, description="Microseconds since 1970.")
    ] = None
    x_m: Annotated[float | None, _metres("East, in metres.")] = None
    y_m: Annotated[float | None, _metres("North, in metres.")] = None
    frame_name: Annotated[
        str | None,
        Field(alias="name", pattern=f"^{FRAME_NAME}$", description="As answers show it; the file's, in a recording."),
    ] = None
    camera: Annotated[str | None, Field(pattern=f"^{FRAME_NAME}$", description="What took the picture, as `Cam5`.")] = (
        None
    )
    replace: Replace = True

    def columns(self, index: int) -> dict[str, Any]:
        """What is known of the frame, as the arrays [1] of a drive."""
        place = self.model_dump(exclude={"camera", "replace"}, exclude_none=True)
        return {key: np.array([value]) for key, value in {"index": index, **place}.items()}


class FrameAnswer(Answer):
    """A frame has been stored."""

    index: int
    n_frames: Annotated[int, Field(description="Of the traverse, now.")]


class BatchAnswer(Answer):
    """A batch of frames has been stored, all or none."""

    n_new: int
    n_replaced: int
    n_frames: Annotated[int, Field(description="Of the traverse, now.")]


# Handlers


@router.put(
    "/{index}",
    status_code=201,
    responses={
        200: {"model": FrameAnswer, "description": "It replaced the frame of that index"},
        **problems(404, 409, 413, 415, 422),
    },
    openapi_extra=declare({**dict.fromkeys(MEDIA_TYPES, IMAGE_SCHEMA), JSON: _FRAME_SCHEMA, **SCENE_BODIES}),
)
async def put_frame(
    domain: DomainName,
    name: TraverseName,
    index: Annotated[int, Path(ge=0, le=GREATEST_EXACT_INTEGER, description="Place in the recording, from 0.")],
    query: Annotated[FrameQuery, Query()],
    request: Request,
    response: Response,
    services: RunningServices,
) -> FrameAnswer:
    """Store one frame, in any order; the same index again replaces it.

    The body is the image, its encoding where that is known, or what is told of it. An image is encoded at once and
    not kept; where the domain's evaluator is fitted to images it waits in the traverse's spool until a map is made of
    that. Positions that go backwards are accepted here and refused by the remap.
    """
    record = await run_sync(services.catalog.domain, domain)
    evaluator = services.evaluators.evaluator(record.evaluator)
    levels = await run_sync(_levels_of, services, domain, name)  # an unknown traverse should not cost an upload
    media_type = media_type_of(request, FRAME_TYPES)
    if media_type == JSON and query.camera is not None:
        raise InvalidInputError("camera is what took a picture, and the body is an encoding: leave it out")
    body = await read_bytes(request)
    frame = await parse_json(body, FrameBody, services) if media_type == JSON else FrameBody()
    members = frame.model_fields_set

    def store(pictures: dict[int, bytes], **facts: Any) -> FrameAnswer:
        with services.open_traverses.lend(domain, name) as traverse:
            n_new, _ = traverse.put_frames(Drive(**query.columns(index), **facts), query.replace, pictures)
            response.status_code = 201 if n_new == 1 else 200
            return FrameAnswer(index=index, n_frames=traverse.n_frames)

    async def store_scene(levels: GreyLevels | None) -> FrameAnswer:
        document = frame.model_dump(include=set(SCENE_MEMBERS))
        scene, picture = await scene_in(body, media_type, document, services, evaluator, Priority.BATCH, levels)
        check_whole(evaluator, scene)
        encoded_image = await encoded(services.worker, evaluator, scene, Priority.BATCH)
        encodings, pictures = encoded_image.values[np.newaxis], dict[int, bytes]()
        facts: dict[str, Any] = {"weights_sha256": encoded_image.weights_sha256}
        if picture is not None:
            if evaluator.fitting is Fitting.IMAGES:
                pictures[index] = picture.body
            if record.options.get("thumbnails"):
                digest = content_digest(np.ascontiguousarray(encodings, "<f4").tobytes())
                await run_sync(services.pictures.keep, domain, [(digest, picture.body)])
            facts["camera"] = None if picture.size is None else Camera(*picture.size, query.camera)
            facts["grey_levels"] = None if picture.is_blank else picture.levels
        return await run_sync(
            lambda: store(
                pictures,
                encodings=encodings,
                content_digest=np.array([content_digest(body)], np.uint64),
                shows_nothing=np.array([scene.is_blank]),
                **facts,
            )
        )

    if members == {"encoding"}:
        return await run_sync(lambda: store({}, encodings=ready_encodings(np.array([frame.encoding], np.float64))))
    if media_type == JSON and not (members and members <= SCENE_MEMBERS):
        raise invalid_body("give encoding; or objects, text, or both")
    if evaluator.fitting is Fitting.IMAGES:
        await run_sync(services.spools.make_room, domain, len(body))
    try:
        return await store_scene(levels)
    except GreyLevelsDifferError:  # another frame came meanwhile, and its levels stay
        return await store_scene(await run_sync(_levels_of, services, domain, name))


@router.get(
    "",
    response_class=Response,
    responses={
        200: {
            "content": binary(
                "npz, in index order, of `index` [n], `position_m`, `timestamp_us` (-1: unknown), `x_m` and `y_m` "
                "(NaN: unknown), and `content_digest`: blake2b of eight bytes, as uint64, of the posted picture, or of "
                "the encoding as float32; 0: unknown"
            )
        },
        **problems(404, 422),
    },
)
async def get_frames(domain: DomainName, name: TraverseName, services: RunningServices) -> Response:
    """The places, times and digests of all frames of a traverse, by which a drive is compared before it is sent."""
    await run_sync(services.catalog.domain, domain)

    def pack() -> bytes:
        with services.open_traverses.lend(domain, name) as traverse:
            content = BytesIO()
            np.savez(content, **traverse.identities())  # type: ignore[arg-type]
            return content.getvalue()

    return Response(await run_sync(pack, limiter=services.batches), media_type=BINARY)


@router.post(
    "",
    responses=problems(404, 409, 413, 415, 422),
    openapi_extra=declare(
        {
            BINARY: {
                "type": "string",
                "format": "binary",
                "description": "npz (numpy.savez) of `encodings` [n, d] float, `index` [n] integer, `position_m` [n], "
                "and where known `timestamp_us` [n] integer (-1: unknown), `x_m` and `y_m` [n] (NaN: unknown), "
                "`name` [n] text (empty: unknown).",
            }
        }
    ),
)
async def post_frames(
    domain: DomainName, name: TraverseName, request: Request, services: RunningServices, replace: Replace = True
) -> BatchAnswer:
    """Store a batch of frames whose encodings are known, all or none; the same indices again replace them."""
    await run_sync(services.catalog.domain, domain)
    await run_sync(_levels_of, services, domain, name)  # an unknown traverse should not cost an upload
    media_type_of(request, (BINARY,))
    max_bytes = services.settings.max_batch_bytes

    def store(spool: IO[bytes]) -> BatchAnswer:
        frames = read_batch(spool, max_bytes)
        encodings = ready_encodings(frames.encodings)
        with services.open_traverses.lend(domain, name) as traverse:
            n_new, n_replaced = traverse.put_frames(dataclasses.replace(frames, encodings=encodings), replace)
            return BatchAnswer(n_new=n_new, n_replaced=n_replaced, n_frames=traverse.n_frames)

    data_dir = services.settings.data_dir  # the system's folder for such files is often memory
    with services.uploads.slot(), storage_faults(data_dir), tempfile.TemporaryFile(dir=data_dir) as spool:
        chunk = bytearray()
        async for piece in request.stream():
            chunk += piece
            if len(chunk) >= _SPOOL_CHUNK_BYTES:
                await run_sync(spool.write, chunk)
                chunk.clear()
        await run_sync(spool.write, chunk)
        if spool.tell() == 0:
            raise EmptyBodyError("the body is empty: send an npz file (numpy.savez)")
        return await run_sync(store, spool, limiter=services.batches)


def _levels_of(services: Services, domain: str, name: str) -> GreyLevels | None:
    with services.open_traverses.lend(domain, name) as traverse:
        return traverse.grey_levels
