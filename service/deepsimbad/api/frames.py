"""Frames of a traverse: one by one, or many whose encodings are known."""

import dataclasses
import math
import struct
import tempfile
import zipfile
from io import BytesIO
from typing import IO, Annotated, Any, cast

import numpy as np
from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Query, Request, Response
from numpy.typing import NDArray
from pydantic import FailFast, Field, StrictFloat

from deepsimbad.api.localizations import IMAGE_SCHEMA, only
from deepsimbad.api.problems import binary, declare, problems
from deepsimbad.api.requests import (
    BINARY,
    GREATEST_EXACT_INTEGER,
    JSON,
    Answer,
    DomainName,
    JsonBody,
    Running,
    Services,
    media_type_of,
    parse_json,
    read_bytes,
)
from deepsimbad.api.traverses import TraverseName
from deepsimbad.core.camera import Camera
from deepsimbad.core.drive import FRAME_NAME, MAX_NAME_LENGTH, MAX_POSITION_M, Drive
from deepsimbad.core.frames import UNKNOWN_CONTENT, UNKNOWN_TIMESTAMP, content_digest
from deepsimbad.engine.localizer import ready_encodings
from deepsimbad.engine.worker import EncodedImage, Priority
from deepsimbad.errors import DeepSimbadError, EmptyBodyError, InvalidInputError, TooLargeError
from deepsimbad.evaluators.grey_levels import GreyLevels
from deepsimbad.evaluators.image import picture_size
from deepsimbad.evaluators.image_files import MEDIA_TYPES
from deepsimbad.store.durable import storage_faults

router = APIRouter(prefix="/v1/admin/domains/{domain}/traverses/{name}/frames", tags=["admin: traverses"])

FRAME_TYPES = (*MEDIA_TYPES, JSON)
_SPOOL_CHUNK_BYTES = 1 << 20

# Bodies and answers


class EncodingBody(JsonBody):
    """A frame that was encoded elsewhere."""

    encoding: Annotated[list[StrictFloat], FailFast()]


_ENCODING_SCHEMA = only("encoding", {"type": "number"}, "A ready encoding, as long as the others of the traverse.")


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

Replace = Annotated[
    bool,
    Query(description="false: a frame that is there already and differs is a 409 `frames_differ`, an equal one stays."),
]


def _metres(description: str) -> Any:
    return Query(ge=-MAX_POSITION_M, le=MAX_POSITION_M, allow_inf_nan=False, description=description)


@router.put(
    "/{index}",
    status_code=201,
    responses={
        200: {"model": FrameAnswer, "description": "It replaced the frame of that index"},
        **problems(404, 409, 413, 415, 422),
    },
    openapi_extra=declare({**dict.fromkeys(MEDIA_TYPES, IMAGE_SCHEMA), JSON: _ENCODING_SCHEMA}),
)
async def put_frame(
    domain: DomainName,
    name: TraverseName,
    index: Annotated[int, Path(ge=0, le=GREATEST_EXACT_INTEGER, description="Place in the recording, from 0.")],
    position_m: Annotated[float, _metres("Metres along the route.")],
    request: Request,
    response: Response,
    running: Running,
    timestamp_us: Annotated[
        int | None, Query(ge=0, le=GREATEST_EXACT_INTEGER, description="Microseconds since 1970.")
    ] = None,
    x_m: Annotated[float | None, _metres("East, in metres.")] = None,
    y_m: Annotated[float | None, _metres("North, in metres.")] = None,
    frame_name: Annotated[
        str | None,
        Query(alias="name", pattern=f"^{FRAME_NAME}$", description="As answers show it; the file's, in a recording."),
    ] = None,
    camera: Annotated[
        str | None, Query(pattern=f"^{FRAME_NAME}$", description="What took the picture, as `Cam5`.")
    ] = None,
    replace: Replace = True,
) -> FrameAnswer:
    """Store one frame, in any order; the same index again replaces it.

    The body is the image, or its encoding where that is known. An image is encoded at once and not kept. Positions
    that go backwards are accepted here and refused by the remap.
    """
    evaluator_config = (await run_sync(running.catalog.domain, domain)).evaluator
    levels = await run_sync(_levels_of, running, domain, name)  # an unknown traverse should not cost an upload
    media_type = media_type_of(request, FRAME_TYPES)
    body = await read_bytes(request)
    evaluator = running.evaluators.evaluator(evaluator_config)
    weights_sha256, digest, shows_nothing, taken_by = None, UNKNOWN_CONTENT, False, None
    if media_type == JSON:
        values = np.array((await parse_json(body, EncodingBody, running)).encoding, np.float64)
        encoding = (await run_sync(ready_encodings, values[np.newaxis]))[0]
    else:
        seen = await running.decoders.decoded(body, evaluator, Priority.BATCH, levels)
        shows_nothing = seen.is_blank
        if levels is None and seen.levels is not None and not shows_nothing:
            levels = await run_sync(_keep_levels, running, domain, name, seen.levels)
            if levels != seen.levels:  # another frame was quicker
                seen = await running.decoders.decoded(body, evaluator, Priority.BATCH, levels)
        encoded = cast("EncodedImage", await running.look(evaluator, seen.image, lambda view: view, Priority.BATCH))
        encoding, weights_sha256, digest = encoded.values, encoded.weights_sha256, content_digest(body)
        size = picture_size(body)
        taken_by = None if size is None else Camera(*size, camera)

    def store() -> tuple[bool, int]:
        with running.open_traverses.lend(domain, name) as traverse:
            created = traverse.put_frame(
                *(index, encoding, position_m, timestamp_us, x_m, y_m, weights_sha256, frame_name, digest, replace),
                shows_nothing=shows_nothing,
                camera=taken_by,
            )
            return created, traverse.n_frames

    created, n_frames = await run_sync(store)
    response.status_code = 201 if created else 200
    return FrameAnswer(index=index, n_frames=n_frames)


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
async def get_frames(domain: DomainName, name: TraverseName, running: Running) -> Response:
    """What is there: the places, times and digests of all frames, by which a drive is compared before it is sent."""
    await run_sync(running.catalog.domain, domain)

    def packed() -> bytes:
        with running.open_traverses.lend(domain, name) as traverse:
            content = BytesIO()
            np.savez(content, **traverse.known())  # type: ignore[arg-type]
            return content.getvalue()

    return Response(await run_sync(packed, limiter=running.batches), media_type=BINARY)


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
    domain: DomainName, name: TraverseName, request: Request, running: Running, replace: Replace = True
) -> BatchAnswer:
    """Store a batch of frames whose encodings are known, all or none; the same indices again replace them."""
    await run_sync(running.catalog.domain, domain)
    await run_sync(_levels_of, running, domain, name)  # as above
    media_type_of(request, (BINARY,))
    max_bytes = running.settings.max_batch_bytes

    def store(spool: IO[bytes]) -> BatchAnswer:
        frames = read_batch(spool, max_bytes)
        encodings = ready_encodings(frames.encodings)
        with running.open_traverses.lend(domain, name) as traverse:
            n_new, n_replaced = traverse.put_frames(dataclasses.replace(frames, encodings=encodings), replace)
            return BatchAnswer(n_new=n_new, n_replaced=n_replaced, n_frames=traverse.n_frames)

    data_dir = running.settings.data_dir  # the system's folder for such files is often memory
    with running.uploads.taken(), storage_faults(data_dir), tempfile.TemporaryFile(dir=data_dir) as spool:
        chunk = bytearray()
        async for piece in request.stream():
            chunk += piece
            if len(chunk) >= _SPOOL_CHUNK_BYTES:
                await run_sync(spool.write, bytes(chunk))
                chunk.clear()
        await run_sync(spool.write, bytes(chunk))
        if spool.tell() == 0:
            raise EmptyBodyError("the body is empty: send an npz file (numpy.savez)")
        return await run_sync(store, spool, limiter=running.batches)


def _levels_of(running: Services, domain: str, name: str) -> GreyLevels | None:
    with running.open_traverses.lend(domain, name) as traverse:
        return traverse.grey_levels


def _keep_levels(running: Services, domain: str, name: str, levels: GreyLevels) -> GreyLevels:
    with running.open_traverses.lend(domain, name) as traverse:
        return traverse.keep_levels(levels)


# A batch is read with distrust: what it declares is judged before anything is unpacked.

MEMBERS = {"encodings": 2, "index": 1, "position_m": 1, "timestamp_us": 1, "x_m": 1, "y_m": 1, "name": 1}
"""Arrays that a batch may hold, and how many dimensions each has."""
REQUIRED = ("encodings", "index", "position_m")
_KINDS = {"encodings": "f", "position_m": "fiu", "x_m": "fiu", "y_m": "fiu", "name": "U"}  # numpy's; else "iu"
_KIND_WORDS = {"f": "floats", "U": "texts"}
_END_OF_DIRECTORY, _LARGE_DIRECTORY = b"PK\x05\x06", b"PK\x06\x07"
_MAX_HEADER_BYTES = 4096


class InvalidBatchError(InvalidInputError, code="invalid_batch"):
    """A batch of frames that is not an npz file of the arrays asked for."""

    code = "invalid_batch"


def read_batch(file: IO[bytes], max_bytes: int) -> Drive:
    """Read the arrays of an npz file, whose values are not yet judged; `encodings` may still be of another float type.

    Raises:
        InvalidBatchError: Not such a file; pickled objects are never read.
        TooLargeError: The arrays are larger than `max_bytes`, unpacked.
    """
    try:
        _check_directory(file)
        with zipfile.ZipFile(file) as archive:
            arrays = _arrays(archive, max_bytes)
    except DeepSimbadError:
        raise
    except Exception as error:  # zipfile and numpy raise some ten kinds over a file that was meddled with
        raise InvalidBatchError("the batch is not a whole npz file as numpy.savez writes it") from error
    n_frames = len(arrays["encodings"])
    unknown = np.full(n_frames, np.nan)
    return Drive(
        index=arrays["index"],
        position_m=arrays["position_m"],
        timestamp_us=arrays.get("timestamp_us", np.full(n_frames, UNKNOWN_TIMESTAMP)),
        x_m=arrays.get("x_m", unknown),
        y_m=arrays.get("y_m", unknown),
        frame_name=arrays.get("name", np.full(n_frames, "")),
        encodings=arrays["encodings"],
    )


def _check_directory(file: IO[bytes]) -> None:
    """Refuse a table of contents that could be long: zipfile would read all of it into memory."""
    size = file.seek(0, 2)
    file.seek(max(0, size - (1 << 16) - 22))
    tail = file.read()
    end = tail.rfind(_END_OF_DIRECTORY)
    if end < 0 or len(tail) - end < 22:
        raise InvalidBatchError("the batch is not a whole npz file (numpy.savez)")
    n_members, directory_bytes = struct.unpack_from("<HL", tail, end + 10)
    is_large = tail[max(0, end - 20) : end].startswith(_LARGE_DIRECTORY)
    if n_members > len(MEMBERS) or directory_bytes > 1 << 14 or is_large:
        raise InvalidBatchError(f"the batch holds more than the arrays {', '.join(MEMBERS)}", allowed=list(MEMBERS))


def _arrays(archive: zipfile.ZipFile, max_bytes: int) -> dict[str, NDArray[Any]]:
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    if not set(members) <= set(MEMBERS) or len(members) != len(archive.infolist()):
        what = f"the batch holds arrays that are not known or stand twice; known are {', '.join(MEMBERS)}"
        raise InvalidBatchError(what, allowed=list(MEMBERS))
    if missing := [name for name in REQUIRED if name not in members]:
        raise InvalidBatchError(f"the batch lacks {', '.join(missing)}", missing=missing)
    n_bytes = sum(member.file_size for member in members.values())
    if n_bytes > max_bytes:
        what = f"the batch unpacks to {n_bytes} bytes; at most {max_bytes} are taken, send fewer frames at once"
        raise TooLargeError(what, max_bytes=max_bytes)
    arrays = {}
    for name, member in members.items():
        with archive.open(member) as stream:
            _check_header(name, stream, member.file_size)
        with archive.open(member) as stream:  # from its beginning; a piece at a time, into the array's own memory
            arrays[name] = np.lib.format.read_array(stream, allow_pickle=False, max_header_size=_MAX_HEADER_BYTES)
            if stream.read(1):  # reading to the end is also what checks the member's checksum
                raise InvalidBatchError(f"{name} is longer than its header says")
    return arrays


def _check_header(name: str, stream: IO[bytes], n_bytes: int) -> None:
    """Refuse a shape or type that is not the array's own, before room is made for its numbers."""
    version = np.lib.format.read_magic(stream)
    if version not in {(1, 0), (2, 0)}:
        raise InvalidBatchError(f"{name} has npy version {version}; 1.0 and 2.0 are read")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream, max_header_size=_MAX_HEADER_BYTES)
    kinds = _KINDS.get(name, "iu")
    if dtype.kind not in kinds or dtype.itemsize > (4 * MAX_NAME_LENGTH if dtype.kind == "U" else 8):
        raise InvalidBatchError(f"{name} holds {dtype}; it must hold {_KIND_WORDS.get(kinds[0], 'integers')}")
    if len(shape) != MEMBERS[name]:
        raise InvalidBatchError(f"{name} has shape {list(shape)}; it must have {MEMBERS[name]} dimensions")
    if stream.tell() + math.prod(shape) * dtype.itemsize != n_bytes:
        raise InvalidBatchError(f"{name} does not hold the {math.prod(shape)} numbers its header says")
