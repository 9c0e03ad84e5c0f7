"""Frames of a traverse: one by one, or many whose encodings are known."""

import tempfile
from dataclasses import replace
from typing import IO, Annotated, cast

import numpy as np
from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Query, Request, Response
from numpy.typing import NDArray

from deepsimbad.api.bodies import (
    BINARY,
    ENCODING_SCHEMA,
    GREATEST_EXACT_INTEGER,
    IMAGE_SCHEMA,
    JSON,
    EncodingBody,
    declare,
    media_type_of,
    parse_json,
    read_bytes,
)
from deepsimbad.api.dependencies import DomainName, Running, Services, TraverseName
from deepsimbad.api.frame_batch import read_batch
from deepsimbad.api.openapi import problems
from deepsimbad.api.schemas import BatchAnswer, FrameAnswer
from deepsimbad.engine.encoders import ready_encodings
from deepsimbad.engine.views import EncodedImage, View
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import EmptyBodyError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.image import MEDIA_TYPES
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.frames import MAX_POSITION_M

router = APIRouter(prefix="/v1/admin/domains/{domain}/traverses/{name}/frames", tags=["admin: traverses"])

FRAME_TYPES = (*MEDIA_TYPES, JSON)
_SPOOL_CHUNK_BYTES = 1 << 20


@router.put(
    "/{index}",
    status_code=201,
    responses={
        200: {"model": FrameAnswer, "description": "It replaced the frame of that index"},
        **problems(404, 413, 415, 422),
    },
    openapi_extra=declare({**dict.fromkeys(MEDIA_TYPES, IMAGE_SCHEMA), JSON: ENCODING_SCHEMA}),
)
async def put_frame(
    domain: DomainName,
    name: TraverseName,
    index: Annotated[int, Path(ge=0, le=GREATEST_EXACT_INTEGER, description="Place in the recording, from 0.")],
    position_m: Annotated[
        float, Query(ge=-MAX_POSITION_M, le=MAX_POSITION_M, allow_inf_nan=False, description="Metres along the route.")
    ],
    request: Request,
    response: Response,
    running: Running,
    timestamp_us: Annotated[
        int | None, Query(ge=0, le=GREATEST_EXACT_INTEGER, description="Microseconds since 1970.")
    ] = None,
    x_m: Annotated[
        float | None,
        Query(ge=-MAX_POSITION_M, le=MAX_POSITION_M, allow_inf_nan=False, description="East, in metres."),
    ] = None,
    y_m: Annotated[
        float | None,
        Query(ge=-MAX_POSITION_M, le=MAX_POSITION_M, allow_inf_nan=False, description="North, in metres."),
    ] = None,
) -> FrameAnswer:
    """Store one frame, in any order; the same index again replaces it.

    The body is the image, or its encoding where that is known. An image is encoded at once and not kept. Positions
    that go backwards are accepted here and refused by the remap.
    """
    evaluator_config = (await run_sync(running.catalog.domain, domain)).evaluator
    await run_sync(_check_traverse, running, domain, name)
    media_type = media_type_of(request, FRAME_TYPES)
    body = await read_bytes(request)
    evaluator = running.evaluators.evaluator(evaluator_config)
    encoding, weights_sha256 = await _encoded(body, running, media_type, evaluator)

    def store() -> tuple[bool, int]:
        with running.open_traverses.lend(domain, name) as traverse:
            created = traverse.put_frame(index, encoding, position_m, timestamp_us, x_m, y_m, weights_sha256)
            return created, traverse.n_frames

    created, n_frames = await run_sync(store)
    response.status_code = 201 if created else 200
    return FrameAnswer(index=index, n_frames=n_frames)


async def _encoded(
    body: bytes, running: Services, media_type: str, evaluator: Evaluator
) -> tuple[NDArray[np.float32], str | None]:
    """The encoding of the frame in a body, and by which weights it was made."""
    if media_type == JSON:
        ready = (await parse_json(body, EncodingBody)).view()
        return (await run_sync(ready_encodings, ready.values[np.newaxis]))[0], None
    decoded = await running.decoders.decoded(body, evaluator, Priority.BATCH)
    seen = await running.look(evaluator, decoded.image, _as_encoded, Priority.BATCH)
    return seen.values, seen.weights_sha256


def _as_encoded(seen: View) -> EncodedImage:
    """What the inference worker makes of an image."""
    return cast("EncodedImage", seen)


@router.post(
    "",
    responses=problems(404, 413, 415, 422),
    openapi_extra=declare(
        {
            BINARY: {
                "type": "string",
                "format": "binary",
                "description": "npz (numpy.savez) of `encodings` [n, d] float, `index` [n] integer, `position_m` [n], "
                "and where known `timestamp_us` [n] integer (-1: unknown), `x_m` and `y_m` [n] (NaN: unknown). Metres, "
                "at most 1e9 either way.",
            }
        }
    ),
)
async def post_frames(domain: DomainName, name: TraverseName, request: Request, running: Running) -> BatchAnswer:
    """Store a batch of frames whose encodings are known, all or none; the same indices again replace them."""
    await run_sync(running.catalog.domain, domain)
    await run_sync(_check_traverse, running, domain, name)
    media_type_of(request, (BINARY,))
    max_bytes = running.settings.max_batch_bytes

    def store(spool: IO[bytes]) -> BatchAnswer:
        frames = read_batch(spool, max_bytes)
        encodings = ready_encodings(frames.encodings)
        with running.open_traverses.lend(domain, name) as traverse:
            n_new, n_replaced = traverse.put_frames(replace(frames, encodings=encodings))
            return BatchAnswer(n_new=n_new, n_replaced=n_replaced, n_frames=traverse.n_frames)

    # Beside the data, because the system's folder for such files is often memory.
    with storage_faults(running.settings.data_dir), tempfile.TemporaryFile(dir=running.settings.data_dir) as spool:
        await _spool_body(request, spool)
        return await run_sync(store, spool, limiter=running.batches)


async def _spool_body(request: Request, spool: IO[bytes]) -> None:
    """Write a body to disk as it streams in, a chunk in memory."""
    chunk = bytearray()
    n_bytes = 0
    async for piece in request.stream():
        chunk += piece
        n_bytes += len(piece)
        if len(chunk) >= _SPOOL_CHUNK_BYTES:
            await run_sync(spool.write, bytes(chunk))
            chunk.clear()
    if n_bytes == 0:
        raise EmptyBodyError("the body is empty: send an npz file (numpy.savez)")
    await run_sync(spool.write, bytes(chunk))


def _check_traverse(running: Services, domain: str, name: str) -> None:
    """An unknown traverse should not cost an upload."""
    with running.open_traverses.lend(domain, name):
        pass
