"""What handlers are given: the running service, parameters with their limits, bodies read and checked, pages of lists.

Handlers read their bodies through this file and not through the framework, whose own reading knows no 415, answers
deeply nested JSON with 400, and takes NaN.
"""

import hashlib
import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, cast
from urllib.parse import parse_qsl

import numpy as np
from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi import Depends, Header, Path, Query, Request, params
from fastapi.dependencies.utils import get_flat_params
from fastapi.routing import APIRoute
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from pydantic_core import ErrorDetails, to_json
from starlette.types import Receive, Scope, Send

from deepsimbad.api.keys import KeyRing
from deepsimbad.api.metrics import Metrics
from deepsimbad.api.problems import InvalidRequestError, invalid_body, invalid_request
from deepsimbad.core.map import Map
from deepsimbad.engine.atlas import Atlas, Owners
from deepsimbad.engine.decoders import Decoders
from deepsimbad.engine.distant import encoded
from deepsimbad.engine.events import SessionEvents
from deepsimbad.engine.localizer import View
from deepsimbad.engine.maps import MappedDomain, Maps, Retention
from deepsimbad.engine.pictures import Pictures
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.traverses import OpenTraverses, SpoolRoom
from deepsimbad.engine.truths import Truths
from deepsimbad.engine.worker import EvaluatorPool, InferenceWorker
from deepsimbad.errors import (
    EmptyBodyError,
    OverloadedError,
    UnknownParameterError,
    UnsupportedMediaTypeError,
    nearest_of,
)
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.scenes import Scene
from deepsimbad.jobs.runner import JobRunner
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, KeyScope, ListPage
from deepsimbad.store.sessions import SessionStore

T = TypeVar("T")

JSON = "application/json"
BINARY = "application/octet-stream"
# As programs spell types that have another name; what an image is its first bytes say anyway.
_MEDIA_TYPE_ALIASES = {
    **dict.fromkeys(("image/jpg", "image/pjpeg", "image/x-jpeg"), "image/jpeg"),
    **dict.fromkeys(("image/tif", "image/x-tif", "image/x-tiff"), "image/tiff"),
    "image/x-png": "image/png",
}
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # some editors and PowerShell begin UTF-8 with it
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
GREATEST_EXACT_INTEGER = 2**53 - 1
GREATEST_ID = 2**31 - 1
MAX_NUMBERS = 2**17  # in one body; about 20 ms to parse
LONG_LIST = 1000  # entries; a list of so many takes some milliseconds
_LONG_BYTES = 1 << 16
_LONGEST_NAME, _MOST_NAMES = 100, 20  # that an answer repeats of what a sender chose
_MAX_PARTS = 1000  # members, texts, lists: far more than any body here has

# The running service


class Slots:
    """Room for `capacity` of something at once, which `phrase` names in a sentence; `setting` allows more."""

    def __init__(self, capacity: int, phrase: str, setting: str) -> None:
        self.capacity = capacity
        self.n_taken = 0
        self._phrase = phrase
        self._setting = setting

    def check(self, n: int = 1) -> None:
        """Raise OverloadedError where there is no room for `n` more."""
        if self.n_taken + n > self.capacity:
            raise OverloadedError(
                f"{self.n_taken} {self._phrase} and no more are taken: try again in a moment",
                retry_after_s=1,
                limit=self._setting,
            )

    def take(self, n: int = 1) -> None:
        """Take room for `n`; raises OverloadedError where there is none."""
        if self.n_taken + n > self.capacity:
            self.check(n)
        self.n_taken += n

    def give_back(self, n: int = 1) -> None:
        """Give back the room for `n`."""
        self.n_taken -= n

    @contextmanager
    def slot(self) -> Iterator[None]:
        """Room for one inside the block; raises OverloadedError."""
        self.take()
        try:
            yield
        finally:
            self.give_back()


@dataclass(frozen=True)
class Services:
    """The running service.

    Attributes:
        faults: What keeps the service from being ready, a sentence each; may wait for the disk.
        stopping: Set when shutdown begins; streams end on it.
        newest_jobs: As `Catalog.newest_jobs`, over all catalogs that this service answers for.
        owners: Who has the domains where one view is asked of many; None: `atlas` does.
        spools: How many bytes of pictures wait to be fitted, and how many may.
        batches: The thread that reads batches into memory.
        long_work: The thread that reads long bodies and writes long answers: two would end no sooner.
        health: Threads for questions about health, which should not wait behind what they ask about.
    """

    settings: Settings
    metrics: Metrics
    catalog: Catalog
    maps: Maps
    atlas: Atlas
    evaluators: EvaluatorPool
    open_traverses: OpenTraverses
    spools: SpoolRoom
    sessions: Sessions
    session_store: SessionStore
    retention: Retention
    truths: Truths
    session_events: SessionEvents
    pictures: Pictures
    worker: InferenceWorker
    decoders: Decoders
    runner: JobRunner
    keys: KeyRing
    faults: Callable[[], tuple[str, ...]]
    uploads: Slots
    event_streams: Slots
    newest_jobs: Callable[[str | None, int | None, int], ListPage[JobRecord, int]]
    owners: Owners | None = None
    stopping: threading.Event = field(default_factory=threading.Event)
    batches: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    long_work: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    health: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))

    async def active(self, domain: str) -> MappedDomain:
        """A domain and its active map; files are read in a thread."""
        mapped_domain = self.maps.peek(domain)
        return mapped_domain if mapped_domain is not None else await run_sync(self.maps.active, domain)

    async def snapshot(self, domain: str, version: int | None) -> Map:
        """A version of a domain's map, the active one where it is None; files are read in a thread."""
        if version is None:
            return (await self.active(domain)).snapshot
        return await run_sync(self.maps.snapshot, domain, version)

    async def encoded(self, evaluator: Evaluator, view: View) -> View:
        """An `EncodedImage` in the place of an image or a scene; other views as they are."""
        if isinstance(view, np.ndarray | Scene):
            return await encoded(self.worker, evaluator, view)
        return view

    async def render_json(self, n_listed: int, render: Callable[..., T], *arguments: Any) -> tuple[T, bytes]:
        """The answer that `render` makes of the arguments, and its JSON, which is not checked again.

        An answer whose longest list, of `n_listed` entries, is long is written beside the event loop.
        """
        if n_listed > LONG_LIST:
            answer = await run_sync(render, *arguments, limiter=self.long_work)
            return answer, await run_sync(to_json, answer, limiter=self.long_work)
        answer = render(*arguments)
        return answer, to_json(answer)


async def services_of(request: Request) -> Services:
    """The running service, for routes. A coroutine, because a plain function would be sent to a thread."""
    return cast("Services", request.app.state.services)


def prefers(request: Request, media_type: str) -> bool:
    """Whether `Accept` asks for one type of answer rather than for JSON."""
    quality_of = {}
    for part in request.headers.get("accept", "").split(","):
        name, *parameters = (piece.strip().lower() for piece in part.split(";"))
        quality = next((piece[2:] for piece in parameters if piece.startswith("q=")), "1")
        try:
            quality_of[name] = float(quality)
        except ValueError:
            quality_of[name] = 0.0
    return quality_of.get(media_type, 0.0) > quality_of.get(JSON, 0.0)


# Parameters


class StrictRoute(APIRoute):
    """A route that refuses query parameters which it does not take; raises UnknownParameterError."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        fields, other_kinds = get_flat_params(self.dependant), params.Path | params.Header  # a query may be a model
        self.queries = tuple(field.alias for field in fields if not isinstance(field.field_info, other_kinds))

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as the framework does, once the query is known to hold no unknown parameter."""
        unknown_queries = Request(scope).query_params.keys() - self.queries
        if unknown_queries and scope["method"] in (self.methods or ()):
            unknown_names = sorted(name[:_LONGEST_NAME] for name in unknown_queries)
            hint = nearest_of(unknown_names[0], self.queries) if self.queries else ": this call takes none"
            raise UnknownParameterError(
                f"there is no query parameter {unknown_names[0]}{hint}",
                unknown=unknown_names[:_MOST_NAMES],
                allowed=list(self.queries),
            )
        await super().handle(scope, receive, send)


class QuickRoute(StrictRoute):
    """A route whose parameters are read by one validator; what that does not take the framework refuses, by name.

    For routes without dependencies that return a response of their own. The framework reads one parameter at a time,
    which is a fifth of what the event loop does for an observation.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        dependant = self.dependant
        fields = [*dependant.path_params, *dependant.query_params, *dependant.header_params]
        definitions: dict[str, Any] = {field.name: (field.field_info.annotation, field.field_info) for field in fields}
        self._kind = None if dependant.dependencies else create_model("Parameters", **definitions)
        self._headers = [(field.alias, field.alias.lower().encode()) for field in dependant.header_params]

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with the parameters that the validator took, else as the framework does."""
        texts = dict[str, Any](parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True))
        parameters: dict[str, Any] | None = None
        if self._kind is not None and scope["method"] in (self.methods or ()) and not texts.keys() - self.queries:
            texts |= scope["path_params"]
            headers = dict(reversed(scope["headers"]))  # the first of several counts
            for alias, name in self._headers:
                if name in headers:
                    texts[alias] = headers[name].decode("latin-1")
            with suppress(ValidationError):
                parameters = vars(self._kind.model_validate(texts))
        if parameters is None:
            await super().handle(scope, receive, send)
        else:
            response = await self.endpoint(request=Request(scope, receive, send), **parameters)
            await response(scope, receive, send)


RunningServices = Annotated[Services, Depends(services_of)]
Name = Annotated[
    str, Field(pattern=NAME_PATTERN, description="Letters, digits, `.`, `_`, `-`; at most 64, a letter or digit first.")
]
DomainName = Annotated[str, Path(alias="domain", pattern=NAME_PATTERN, description="A domain's name.")]
SessionId = Annotated[str, Path(pattern=NAME_PATTERN, description="A session's id.")]
PinnedVersion = Annotated[
    int | None, Query(ge=1, le=GREATEST_ID, description="One a session is pinned to; absent: the active one.")
]
OfDomain = Annotated[str | None, Query(pattern=NAME_PATTERN, description="Only this domain's; absent: all.")]

Next = Annotated[str | None, Field(description="Ask for the list `after` this for its next page; null: it ends here.")]


class Page(NamedTuple):
    """Which page of a list is asked for: at most `limit` entries behind the one of this key; None: the first."""

    list_name: str
    limit: int
    key: str | None

    @property
    def number(self) -> int | None:
        """The key as a number, for a list whose keys are numbers."""
        return None if self.key is None else int(self.key)

    def next(self, last_key: int | str | None) -> Next:
        """The cursor of the page behind a key: the list's name and the key; None where there is none."""
        return None if last_key is None else f"{self.list_name}-{last_key}"


def page_of(list_name: str, key_pattern: str = "[0-9]{1,18}$", default_limit: int = 100) -> Any:
    """The query parameters `limit` and `after` of a list, as a `Page`."""
    cursor_pattern = f"^{list_name}-{key_pattern}"

    async def page(
        limit: Annotated[int, Query(ge=1, le=1000, description="Most entries of the answer.")] = default_limit,
        cursor: Annotated[
            str | None,
            Query(
                alias="after", pattern=cursor_pattern, description="`next` of the page before; absent: the first page."
            ),
        ] = None,
    ) -> Page:
        return Page(list_name, limit, None if cursor is None else cursor.removeprefix(f"{list_name}-"))

    return Depends(page)


# Entity tags: which content a request has, or insists on (RFC 9110, 13.1)

_TAG = r'(?:W/)?"[\x21\x23-\x7e]*"'
_STRONG = re.compile(r'(W/)?"([\x21\x23-\x7e]*)"')
REVALIDATE = {"Cache-Control": "private, no-cache"}
"""Headers of tagged content: a client may keep it but must ask again, for a domain made anew counts versions anew."""
LandmarkModelTag = Annotated[
    str | None,
    Header(
        alias="If-Match",
        pattern=rf"^(?:\*|{_TAG}(?:[ \t]*,[ \t]*{_TAG})*)$",
        description="The quoted digest of the landmark model that the view was ranked by, as `landmark-model` names "
        "it: a map with another one does not answer: 409 `landmark_model_differs`.",
    ),
]


def has_tag(header: str | None, etag: str) -> bool:
    """Whether an If-None-Match names a content by its tag; weak tags count too."""
    return header is not None and any(tag.strip().removeprefix("W/") in {etag, "*"} for tag in header.split(","))


def required_tags(header: str) -> frozenset[str] | None:
    """The tags, one of which an If-Match requires; None: any content will do. Weak tags match nothing."""
    if header.strip() == "*":
        return None
    return frozenset(tag for weak, tag in _STRONG.findall(header) if not weak)


# Requests that make something, and make it once however often they are sent

KeyWord = Annotated[str, Field(pattern=r"^[\x21-\x7e]{1,255}$")]


def idempotency_header(consequence: str) -> Any:
    """The header `Idempotency-Key`, described."""
    return Header(alias="Idempotency-Key", description=f"The same key with the same {consequence}")


KeyOfCreation = Annotated[
    KeyWord | None,
    idempotency_header("body again makes nothing more: the first one is answered, as it stands. Choose a UUID."),
]


def robot_of(request: Request) -> str | None:
    """The key whose sessions alone the asker may know of; None: of all, with an admin's key or while none is asked."""
    state = request.scope["state"]
    return None if state.get("key_scope") == KeyScope.ADMIN else cast("str | None", state.get("key_id"))


def key_id_of(request: Request) -> str | None:
    """The id of the API key that a request came with; None where none is asked."""
    return cast("str | None", request.scope["state"].get("key_id"))


def id_under_key(request: Request, kind: str, domain: str, key: str | None) -> str | None:
    """The id of what a request makes; None where it has no idempotency key."""
    return None if key is None else derived_id(kind, key_id_of(request), domain, key)


def derived_id(kind: str, key_id: str | None, domain: str, key: str) -> str:
    """The id that follows from an API key and an idempotency key."""
    return hashlib.sha256(f"{kind}\n{key_id or ''}\n{domain}\n{key}".encode("utf-8", "surrogatepass")).hexdigest()[:32]


# Bodies


class JsonBody(BaseModel):
    """Root of the JSON bodies: unknown members are errors, so a typing mistake is never silent."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    most_parts: ClassVar[int] = _MAX_PARTS


class Answer(BaseModel):
    """Root of the answers. Every field is always present; what is not known is null."""

    model_config = ConfigDict(frozen=True, from_attributes=True)


Body = TypeVar("Body", bound=JsonBody)


def _with_nearest(finding: ErrorDetails, kind: type[Body]) -> ErrorDetails:
    """A finding of pydantic, in better words: of NaN, and with what is nearest to an unknown member or choice."""
    if isinstance(finding["input"], float) and math.isnan(finding["input"]):  # no number is less or greater
        return {**finding, "msg": "Input should be a finite number", "type": "finite_number"}
    if finding["type"] == "extra_forbidden" and len(finding["loc"]) == 1:
        return {**finding, "msg": f"there is no such member{nearest_of(str(finding['loc'][0]), kind.model_fields)}"}
    choices = re.findall(r"'([^']*)'", str(finding.get("ctx", {}).get("expected", "")))
    if choices and isinstance(finding["input"], str):
        return {**finding, "msg": f"it is none of these{nearest_of(finding['input'], choices)}"}
    return finding


def media_type_of(request: Request, allowed: tuple[str, ...]) -> str:
    """The body's media type, without parameters; raises UnsupportedMediaTypeError for none, or one not allowed."""
    header = request.headers.get("content-type")
    media_type = (header or "").partition(";")[0].strip().lower()
    media_type = _MEDIA_TYPE_ALIASES.get(media_type, media_type)
    if media_type not in allowed:
        complaint = f"Content-Type {media_type[:100]!r} is not taken" if header else "the request has no Content-Type"
        raise UnsupportedMediaTypeError(f"{complaint}; send one of {', '.join(allowed)}", allowed=list(allowed))
    return media_type


async def read_bytes(request: Request) -> bytes:
    """The whole body; raises EmptyBodyError."""
    body = await request.body()
    if not body:
        raise EmptyBodyError("the body is empty: send the content that Content-Type names")
    return body


async def read_json(request: Request, kind: type[Body]) -> Body:
    """A JSON body; raises UnsupportedMediaTypeError and InvalidInputError."""
    media_type_of(request, (JSON,))
    return await parse_json(await read_bytes(request), kind, request.app.state.services)


async def parse_json(body: bytes, kind: type[Body], services: Services) -> Body:
    """Check the bytes of a JSON body, those of a long one in a thread; raises InvalidRequestError."""
    # All but numbers costs the parser a hundred times its bytes, and an error of its own where it is wrong: megabytes
    # of it would take seconds and gigabytes.
    if len(body) > kind.most_parts and any(body.count(mark) > kind.most_parts for mark in (b":", b'"', b"{", b"[")):
        raise invalid_body(
            f"more than {kind.most_parts} members, texts or lists, which no body here has", "too_many_parts"
        )
    # The parser lets no other thread run until it has read all: millions of numbers would hold the event loop up.
    if body.count(b",") >= MAX_NUMBERS:
        raise invalid_body(f"more than {MAX_NUMBERS} numbers", "too_many_numbers")
    document = body.removeprefix(_BYTE_ORDER_MARK)
    try:
        if len(body) > _LONG_BYTES:
            return await run_sync(kind.model_validate_json, document, limiter=services.long_work)
        return kind.model_validate_json(document)
    except ValidationError as error:
        raise invalid_request(
            [_with_nearest(finding, kind) for finding in error.errors(include_url=False)], "body"
        ) from error
    except (RecursionError, OverflowError, ValueError) as error:
        raise InvalidRequestError("body: not JSON that can be read") from error
