"""Request bodies: read, checked and declared here alone.

Routes read their bodies through this file and not through the framework, whose own reading knows no 415, answers
deeply nested JSON with 400, and takes NaN.
"""

from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, FailFast, Field, StrictFloat, StrictInt, ValidationError, model_validator
from starlette.requests import Request

from deepsimbad.api.long_work import off_the_loop
from deepsimbad.api.problems import InvalidRequestError, invalid_request
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.engine.views import Dissimilarities, RankedLandmarks, ReadyEncoding
from deepsimbad.errors import EmptyBodyError, UnsupportedMediaTypeError
from deepsimbad.evaluators.registry import EXTRACTOR_PATTERN, EvaluatorKind
from deepsimbad.jobs.map_config import DEFAULT_LIST_LENGTH, DEFAULT_TRAINING_EPISODES, RemapConfig

JSON = "application/json"
BINARY = "application/octet-stream"
RANKS = "application/vnd.deepsimbad.ranks"
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
MAX_LANDMARKS = 0xFFFF
GREATEST_EXACT_INTEGER = 2**53 - 1
GREATEST_ID = 2**31 - 1
MAX_NUMBERS = 2**17  # in one body; about 20 ms to parse
_LONG_BYTES = 1 << 16
_MAX_PARTS = 1000  # members, texts, lists: far more than any body here has

Body = TypeVar("Body", bound="JsonBody")
Name = Annotated[
    str, Field(pattern=NAME_PATTERN, description="Letters, digits, `.`, `_`, `-`; at most 64, a letter or digit first.")
]


class JsonBody(BaseModel):
    """Root of the JSON bodies: unknown members are errors, so a typing mistake is never silent."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ObservationBody(JsonBody):
    """What a robot made of a view on board: exactly one of the three.

    NaN and infinity pass here, and are refused by what knows the right code for them.
    """

    ranked_landmarks: Annotated[list[StrictInt], FailFast()] = []
    dissimilarities: Annotated[list[StrictFloat], FailFast()] = []
    encoding: Annotated[list[StrictFloat], FailFast()] = []

    @model_validator(mode="after")
    def _one(self) -> Self:
        if len(self.model_fields_set) != 1:
            raise ValueError("give exactly one of ranked_landmarks, dissimilarities, encoding")
        return self

    def view(self) -> RankedLandmarks | Dissimilarities | ReadyEncoding:
        """The engine's form."""
        if "ranked_landmarks" in self.model_fields_set:
            return RankedLandmarks(tuple(self.ranked_landmarks))
        if "dissimilarities" in self.model_fields_set:
            return Dissimilarities(np.array(self.dissimilarities, np.float64))
        return ReadyEncoding(np.array(self.encoding, np.float64))


class EncodingBody(JsonBody):
    """A frame that was encoded elsewhere."""

    encoding: Annotated[list[StrictFloat], FailFast()]

    def view(self) -> ReadyEncoding:
        """The engine's form."""
        return ReadyEncoding(np.array(self.encoding, np.float64))


_EVALUATOR_SCHEMA = {
    "type": "object",
    "required": ["kind"],
    "properties": {
        "kind": {"enum": [kind.value for kind in EvaluatorKind]},
        "extractor": {"type": "string", "pattern": EXTRACTOR_PATTERN},
    },
    "additionalProperties": False,
}


class DomainBody(JsonBody):
    """A domain to be made."""

    evaluator: Annotated[
        dict[str, Any], Field(description="Its `kind`, and options.", json_schema_extra=_EVALUATOR_SCHEMA)
    ]
    closed: Annotated[bool, Field(strict=True, description="Whether the end of the route joins its start.")] = False
    actions_m: Annotated[
        list[Annotated[float, Field(strict=True, gt=0, le=1000, allow_inf_nan=False)]],
        Field(min_length=1, max_length=64, description="Moves in metres, ascending."),
    ] = [float(action) for action in range(1, 11)]

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if any(longer <= shorter for shorter, longer in zip(self.actions_m, self.actions_m[1:], strict=False)):
            raise ValueError("actions_m must ascend")
        return self


class TraverseBody(JsonBody):
    """A traverse to be made."""

    name: Name


class RemapBody(JsonBody):
    """What to build the next map of a domain from."""

    training_traverse: Annotated[Name, Field(description="Its frames become the map images.")]
    landmark_traverse: Annotated[
        Name | None,
        Field(description="Landmarks are selected among its frames; null keeps the active map's landmarks."),
    ] = None
    n_landmarks: Annotated[
        Annotated[int, Field(strict=True, ge=1, le=MAX_LANDMARKS)] | None,
        Field(description="r; null: 500, all frames of a shorter drive, or the active map's where they stay."),
    ] = None
    list_length: Annotated[int, Field(strict=True, ge=1, le=MAX_LANDMARKS, description="h, at most r")] = (
        DEFAULT_LIST_LENGTH
    )
    relevance: Relevance = DEFAULT_RELEVANCE
    training_episodes: Annotated[
        int, Field(strict=True, ge=0, le=10_000_000, description="Of what the planner `nnql` knows; 0: nothing.")
    ] = DEFAULT_TRAINING_EPISODES
    seed: Annotated[int, Field(strict=True, ge=0, le=GREATEST_EXACT_INTEGER)] = 0
    activate: Annotated[
        bool, Field(strict=True, description="Switch to the new map when it is sealed, whatever serves by then.")
    ] = True
    check_traverse: Annotated[
        Name | None,
        Field(
            description="Drive that the new map and the active one are compared on; "
            "null: every tenth frame of the training traverse, held out."
        ),
    ] = None
    gate_margin: Annotated[
        Annotated[float, Field(strict=True, ge=0, le=100, allow_inf_nan=False)] | None,
        Field(
            description="Percentage points of ANR by which the new map may be worse than the active one; "
            "one that is worse is sealed but not activated. null: no gate."
        ),
    ] = None
    append: Annotated[
        bool,
        Field(
            strict=True,
            description="Add the training traverse to a copy of the active map, whose images and landmarks stay; "
            "landmark_traverse must be null.",
        ),
    ] = False
    same_route: Annotated[
        Annotated[bool, Field(strict=True)] | None,
        Field(
            description="Whether the training traverse and the one that the map would learn a second season from (the "
            "landmark traverse, else what the active map was made of) count positions along one route; null: only "
            "where both know x, y. Where their views disagree nothing is learnt, and metrics.second_season says why."
        ),
    ] = None

    def config(self) -> RemapConfig:
        """The job's form; raises InvalidMapConfigError."""
        return RemapConfig(**{name: getattr(self, name) for name in type(self).model_fields})


class ActiveMapBody(JsonBody):
    """Which version to activate, and which one must be active for that."""

    version: Annotated[int, Field(strict=True, ge=1, le=GREATEST_ID)]
    expected: Annotated[
        Annotated[int, Field(strict=True, ge=1, le=GREATEST_ID)] | None,
        Field(
            description="The version thought active; null: none. Another one being active is a 409. "
            "Absent: switch whichever is active."
        ),
    ] = None


def media_type_of(request: Request, allowed: tuple[str, ...]) -> str:
    """The body's media type, without parameters.

    Raises:
        UnsupportedMediaTypeError: There is none, or it is not one of those allowed.
    """
    header = request.headers.get("content-type")
    if header is None:
        raise UnsupportedMediaTypeError(
            f"the request has no Content-Type; send one of {', '.join(allowed)}", allowed=list(allowed)
        )
    media_type = header.partition(";")[0].strip().lower()
    if media_type not in allowed:
        raise UnsupportedMediaTypeError(
            f"Content-Type {media_type[:100]!r} is not taken here; send one of {', '.join(allowed)}",
            allowed=list(allowed),
        )
    return media_type


async def read_bytes(request: Request) -> bytes:
    """The whole body.

    Raises:
        EmptyBodyError: There is none.
    """
    body = await request.body()
    if not body:
        raise EmptyBodyError("the body is empty: send the content that Content-Type names")
    return body


async def read_json(request: Request, kind: type[Body]) -> Body:
    """A JSON body.

    Raises:
        UnsupportedMediaTypeError: Its Content-Type is not JSON.
        InvalidInputError: It is empty, not JSON, or not such a body.
    """
    media_type_of(request, (JSON,))
    return await parse_json(await read_bytes(request), kind)


async def parse_json(body: bytes, kind: type[Body]) -> Body:
    """Check the bytes of a JSON body, those of a long one in a thread; raises InvalidRequestError."""
    if len(body) > _LONG_BYTES:
        return await off_the_loop(lambda: _parsed(body, kind))
    return _parsed(body, kind)


def _parsed(body: bytes, kind: type[Body]) -> Body:
    # All but numbers costs the parser a hundred times its bytes, and an error of its own where it is wrong: megabytes
    # of it would take seconds and gigabytes.
    if len(body) > _MAX_PARTS and any(body.count(mark) > _MAX_PARTS for mark in (b":", b'"', b"{", b"[")):
        what = f"more than {_MAX_PARTS} members, texts or lists, which no body here has"
        raise InvalidRequestError(f"body: {what}", errors=[{"loc": ["body"], "msg": what, "type": "too_many_parts"}])
    # The parser lets no other thread run until it has read all: millions of numbers would hold the event loop up.
    if body.count(b",") >= MAX_NUMBERS:
        what = f"more than {MAX_NUMBERS} numbers"
        raise InvalidRequestError(f"body: {what}", errors=[{"loc": ["body"], "msg": what, "type": "too_many_numbers"}])
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        raise invalid_request(error, "body") from error
    except (RecursionError, OverflowError, ValueError) as error:
        raise InvalidRequestError("body: not JSON that can be read") from error


def declare_json(kind: type[JsonBody]) -> dict[str, Any]:
    """The OpenAPI request body of a JSON route, as `openapi_extra`."""
    return declare({JSON: {"$ref": f"#/components/schemas/{kind.__name__}"}})


def declare(content: dict[str, Any]) -> dict[str, Any]:
    """The OpenAPI request body with these media types and schemas, as `openapi_extra`."""
    return {
        "requestBody": {
            "required": True,
            "content": {media_type: {"schema": schema} for media_type, schema in content.items()},
        }
    }


def _only(name: str, items: dict[str, Any], description: str) -> dict[str, Any]:
    values = {
        "type": "array",
        "items": items,
        "minItems": 1,
        "maxItems": MAX_NUMBERS,
        "description": description,
    }
    return {"type": "object", "required": [name], "properties": {name: values}, "additionalProperties": False}


OBSERVATION_SCHEMA = {
    "oneOf": [
        _only(
            "ranked_landmarks",
            {"type": "integer", "minimum": 0, "maximum": MAX_LANDMARKS - 1},
            "Distinct landmark ids from 0, nearest first, 1..r of them; of the rest no more is known than that they "
            "are farther, and that landmarks go together as they did along the map's own drive.",
        ),
        _only("dissimilarities", {"type": "number"}, "r finite numbers in landmark order, smaller is nearer."),
        _only("encoding", {"type": "number"}, "A ready encoding, as long as those the map was made of."),
    ]
}
ENCODING_SCHEMA = _only("encoding", {"type": "number"}, "A ready encoding, as long as the others of the traverse.")
IMAGE_SCHEMA: dict[str, Any] = {"type": "string", "format": "binary"}
RANKS_SCHEMA: dict[str, Any] = {
    "type": "string",
    "format": "binary",
    "description": "The same in fewest bytes: their number m in two, big-endian, then m landmark ids, nearest first, "
    "of ceil(log2 r) bits each, most significant bit first; zero bits fill the last byte.",
}
DECLARED_BODIES: tuple[type[JsonBody], ...] = (DomainBody, TraverseBody, RemapBody, ActiveMapBody)
