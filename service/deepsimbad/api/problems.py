"""Errors as RFC 9457 problem details: the one table from the error tree to HTTP statuses; the OpenAPI document.

The framework derives the document, and `install_openapi` adds what it cannot know: these problems, bodies that
handlers read themselves, keys, links and examples.
"""

import json
import logging
import re
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from importlib import resources
from typing import Annotated, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import Scope

from deepsimbad import errors
from deepsimbad.api.keys import needed_scope
from deepsimbad.errors import DeepSimbadError, InvalidInputError, OverloadedError

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 5

# Looked up along an error's bases, nearest first, so a branch may hold an exception to its parent's rule.
STATUS_OF_BRANCH: Mapping[type[BaseException], HTTPStatus] = {
    errors.SettingsError: HTTPStatus.INTERNAL_SERVER_ERROR,
    errors.InvalidInputError: HTTPStatus.UNPROCESSABLE_ENTITY,
    errors.AccessError: HTTPStatus.UNAUTHORIZED,
    errors.ForbiddenError: HTTPStatus.FORBIDDEN,
    errors.NotFoundError: HTTPStatus.NOT_FOUND,
    errors.NotAcceptableError: HTTPStatus.NOT_ACCEPTABLE,
    errors.UnreadableRequestError: HTTPStatus.BAD_REQUEST,
    errors.ConflictError: HTTPStatus.CONFLICT,
    errors.CancelledError: HTTPStatus.CONFLICT,
    errors.GoneError: HTTPStatus.GONE,
    errors.BusyError: HTTPStatus.TOO_MANY_REQUESTS,
    errors.TooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    errors.UnsupportedMediaTypeError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    errors.UnavailableError: HTTPStatus.SERVICE_UNAVAILABLE,
}

# The titles of answers that no error of ours stands behind.
_TITLE_OF_CODE = {
    "invalid_request": "A value of the request cannot be accepted",
    "not_found": "Nothing answers to this path",
    "method_not_allowed": "The path does not answer to this method",
    "range_not_satisfiable": "The range begins behind the end",
    "internal_error": "The service failed; the fault is its own",
}
_CODE_OF_STATUS = {404: "not_found", 405: "method_not_allowed", 416: "range_not_satisfiable"}


class InvalidRequestError(InvalidInputError, code="invalid_request"):
    """A value of the request cannot be accepted."""


def status_of(error: DeepSimbadError) -> int:
    """The HTTP status of an error of the tree."""
    bases = type(error).__mro__
    return int(next((STATUS_OF_BRANCH[base] for base in bases if base in STATUS_OF_BRANCH), 500))


def problem_response(
    scope: Scope,
    status: int,
    code: str,
    detail: str,
    *,
    title: str | None = None,
    hints: Mapping[str, Any] | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Render one problem, with hints as further members; its code and the limit met are noted for the log."""
    document = {
        **(hints or {}),
        "type": f"urn:deepsimbad:problem:{code}",
        "title": title or _TITLE_OF_CODE.get(code) or HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "instance": _instance(scope),
        "code": code,
        "request_id": scope.get("state", {}).get("request_id"),
    }
    state = scope.setdefault("state", {})  # for the log
    state["code"] = code
    if isinstance(document.get("limit"), str):
        state["limit"] = document["limit"]
    sent_headers = dict(headers or {})
    if status == HTTPStatus.UNAUTHORIZED:
        sent_headers.setdefault("WWW-Authenticate", "Bearer")
    if status in {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS}:
        sent_headers.setdefault("Retry-After", str(RETRY_AFTER_S))
    # json escapes everything outside ASCII, so text that cannot be encoded (lone surrogates) still travels.
    content = json.dumps(document, default=lambda scalar: scalar.item()).encode("ascii")  # numpy's
    return Response(content, status, headers=sent_headers, media_type=MEDIA_TYPE)


def error_response(scope: Scope, error: DeepSimbadError) -> Response:
    """Render an error of the tree."""
    status = status_of(error)
    if status >= HTTPStatus.INTERNAL_SERVER_ERROR and not isinstance(error, OverloadedError):
        # What stands behind a 503 helps; where nothing does its sentence says all, and a probe repeats it all night.
        is_complete = status == HTTPStatus.SERVICE_UNAVAILABLE and error.__cause__ is None
        log_fields = {"request_id": scope.get("state", {}).get("request_id"), "code": error.code, "why": error.message}
        log.warning("not answered", exc_info=None if is_complete else error, extra=log_fields)
    summary = (type(error).__doc__ or "").strip().partition("\n")[0].rstrip(".")
    retry_after_s = error.hints.get("retry_after_s")
    headers = None if retry_after_s is None else {"Retry-After": str(retry_after_s)}
    return problem_response(scope, status, error.code, error.message, title=summary, hints=error.hints, headers=headers)


def unexpected_response(scope: Scope) -> Response:
    """Render a fault of ours: no cause, no stack, only the request id by which the log can be searched."""
    detail = "The service failed in a way it did not foresee; quote the request id to its operator."
    return problem_response(scope, HTTPStatus.INTERNAL_SERVER_ERROR, "internal_error", detail)


def invalid_request(findings: Sequence[Any], *prefix: str) -> InvalidRequestError:
    """The tree's error for up to 20 findings of pydantic; `prefix` begins the location of each, as "body"."""
    errors = [  # pydantic puts its own words before those of our validators
        {
            "loc": [*prefix, *finding["loc"]],
            "msg": finding["msg"].removeprefix("Value error, "),
            "type": finding["type"],
        }
        for finding in findings[:20]
    ]
    place = ".".join(str(part) for part in errors[0]["loc"])
    return InvalidRequestError(f"{place}: {errors[0]['msg']}", errors=errors)


def invalid_body(complaint: str, kind: str = "value_error") -> InvalidRequestError:
    """The tree's error for a body that no pydantic model refused."""
    return InvalidRequestError(f"body: {complaint}", errors=[{"loc": ["body"], "msg": complaint, "type": kind}])


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error that leaves a route of `app` as a problem."""

    async def from_tree(request: Request, error: Any) -> Response:
        return error_response(request.scope, error)

    async def from_validation(request: Request, error: Any) -> Response:
        # The stock answer echoes the input, so that NaN in it becomes a 500.
        return error_response(request.scope, invalid_request(error.errors()))

    async def from_http(request: Request, error: Any) -> Response:
        code = _CODE_OF_STATUS.get(error.status_code, f"http_{error.status_code}")
        detail = f"{request.method} {_instance(request.scope)}: {error.detail}"
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # the framework names those of one route
            path = request.scope["path"]
            routes = [route for route in app.routes if isinstance(route, Route) and route.path_regex.match(path)]
            methods = {method for route in routes for method in route.methods or ()}
            headers["Allow"] = ", ".join(sorted(methods)) or headers.get("Allow", "")
        return problem_response(request.scope, error.status_code, code, detail, headers=headers)

    app.add_exception_handler(DeepSimbadError, from_tree)
    app.add_exception_handler(RequestValidationError, from_validation)
    app.add_exception_handler(HTTPException, from_http)


def _instance(scope: Scope) -> str:
    """The path as it was sent, percent-encoding kept, so that it is ASCII."""
    raw: bytes = scope.get("raw_path") or b""
    return raw.partition(b"?")[0].decode("ascii", "backslashreplace") or "/"


# The document

_REFERENCE = "#/components/schemas/{model}"
_DESCRIPTIONS = {
    401: "No key, or one that is unknown, revoked or expired; a service without keys asks for none",
    403: "A key without the scope that the call needs; where no key exists, a foreign `Host` or `Origin`",
    404: "An unknown name or id",
    406: "No answer of the kind that `Accept` asks for; `reason` says why",
    409: "The present state forbids it",
    410: "A session that has ended, or a map that is no more",
    413: "More bytes or pixels than a limit allows",
    415: "A missing or unsupported Content-Type; `allowed` lists what is taken",
    416: "A range outside the file",
    422: "A value that can never be accepted; `errors` or the other members say which",
    429: "More than the service takes at once, or from one key; try again after Retry-After seconds",
    500: "The service failed; the fault is its own",
    503: "The service cannot answer now; try again after Retry-After seconds",
}
_RETRY_AFTER = {"Retry-After": {"description": "Seconds to wait.", "schema": {"type": "integer", "minimum": 1}}}
_CHALLENGE = {"WWW-Authenticate": {"description": "How to authenticate.", "schema": {"const": "Bearer"}}}
_HEADERS = {401: _CHALLENGE, 429: _RETRY_AFTER, 503: _RETRY_AFTER}
_DOMAIN = {"domain": "$request.path.domain"}
# A call, the status of its answer, and the path parameters that this answer gives to other calls.
_LINKS = (
    ("PUT /v1/admin/domains/{domain}", "201", _DOMAIN),
    ("POST /v1/admin/domains/{domain}/traverses", "201", _DOMAIN | {"name": "$response.body#/name"}),
    ("POST /v1/admin/domains/{domain}/remaps", "202", {"job_id": "$response.body#/job_id"}),
    ("POST /v1/admin/domains/{domain}/experience", "202", {"job_id": "$response.body#/job_id"}),
    ("POST /v1/domains/{domain}/sessions", "201", {"session_id": "$response.body#/session_id"}),
)
_SECURITY_SCHEMES = {
    "bearer": {
        "type": "http",
        "scheme": "bearer",
        "description": "A key of `deepsimbad keys create`. A service on which no key was ever created asks for none.",
    },
    "api_key": {
        "type": "apiKey",
        "in": "header",
        "name": "X-API-Key",
        "description": "The same key, where a proxy needs `Authorization` for itself.",
    },
}
# What a first request may look like.
BODY_EXAMPLES: Mapping[str, Any] = {
    "DomainBody": {"evaluator": {"kind": "feature_l2"}, "closed": False},
    "TraverseBody": {"name": "2012-08-20"},
    "RemapBody": {"training_traverse": "2012-08-20", "landmark_traverse": "2012-05-11", "gate_margin": 2.0},
    "ActiveMapBody": {"version": 1, "expected": 2},
    "SessionBody": {"start_position_m": 4.5, "start_std_m": 10.0},
    "PriorBody": {"position_m": 8.0, "std_m": 3.0},
    "TruthsBody": {"true_positions_m": [4.5, 7.5, None]},
    "ExperienceBody": {"session_id": "5f0c2f7e8a7b4a0c9d3e1b2a4c6d8e0f", "true_positions_m": [4.5, 7.5, None]},
}
ENCODED_ON_BOARD = {"ranked_landmarks": [7, 2, 9, 0]}
_PARAMETER_EXAMPLES: Mapping[str, Any] = {
    "domain": "campus",
    "name": "2012-08-20",
    "version": 1,
    "map_version": 1,
    "index": 0,
    "position_m": 12.5,
    "session_id": "5f0c2f7e8a7b4a0c9d3e1b2a4c6d8e0f",
    "job_id": "8a7b4a0c9d3e1b2a4c6d8e0f5f0c2f7e",
    "timestamp_us": 1_345_480_000_000_000,
    "x_m": 101.5,
    "y_m": -42.25,
    "action_m": 3.0,
    "action_std_m": 0.3,
    "shortlist": 10,
    "limit": 100,
    "Idempotency-Key": "robot-7/421",
    "If-Match": "*",
}
_declared_bodies: dict[str, type[BaseModel]] = {}


class Problem(BaseModel):
    """An error, as RFC 9457 problem details. Further members hold what helps: limits, allowed values."""

    model_config = ConfigDict(extra="allow")

    type: Annotated[str, Field(description="`urn:deepsimbad:problem:` and the code.")]
    title: Annotated[str, Field(description="One sentence on this kind of problem.")]
    status: Annotated[int, Field(description="The HTTP status.", ge=400, le=599)]
    detail: Annotated[str, Field(description="One sentence on this occurrence.")]
    instance: Annotated[str, Field(description="The path that was asked.")]
    code: Annotated[str, Field(description="A stable word that scripts may test.", pattern="^[a-z0-9_]+$")]
    request_id: Annotated[str | None, Field(description="By which the server's log can be searched.")]


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that may answer with these problems; 500 and 503 are always among them."""
    return {status: _problem(status) for status in (*statuses, 500, 503)}


def binary(description: str) -> dict[str, Any]:
    """The content of an answer of bytes."""
    return {"application/octet-stream": {"schema": {"type": "string", "format": "binary", "description": description}}}


def location(status: int, description: str) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route whose answer has a `Location` header, which `description` describes."""
    return {status: {"headers": {"Location": {"description": description, "schema": {"type": "string"}}}}}


def declare_json(model: type[BaseModel]) -> dict[str, Any]:
    """The OpenAPI request body of a route that reads this model, as `openapi_extra`."""
    _declared_bodies[model.__name__] = model
    return declare({"application/json": {"$ref": _REFERENCE.format(model=model.__name__)}})


def declare(content: dict[str, Any]) -> dict[str, Any]:
    """The OpenAPI request body with these media types and schemas, as `openapi_extra`."""
    content_schemas = {media_type: {"schema": schema} for media_type, schema in content.items()}
    return {"requestBody": {"required": True, "content": content_schemas}}


def install_openapi(app: FastAPI, root_path: str) -> None:
    """Complete the document of `app` with the models that routes only refer to, and with what comes before routes."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = get_openapi(
                title=app.title,
                version=app.version,
                description=app.description,
                routes=app.routes,
                servers=[{"url": root_path}] if root_path else None,
            )
            _complete(app.openapi_schema)
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]
    answers: list[Response] = []

    async def answer() -> Response:
        if not answers:  # written once: anybody may ask, without a key
            answers.append(JSONResponse(document()))
        return answers[0]

    app.add_api_route("/openapi.json", answer, include_in_schema=False)


def _complete(document: dict[str, Any]) -> None:
    components = document["components"]
    schemas = components["schemas"]
    models: tuple[type[BaseModel], ...] = (Problem, *_declared_bodies.values())
    for model in models:
        schema = model.model_json_schema(ref_template=_REFERENCE)
        schemas.update(schema.pop("$defs", {}))
        schemas[model.__name__] = schema
    components["securitySchemes"] = _SECURITY_SCHEMES
    _write_pairs_plainly(schemas)
    operations = {
        f"{method.upper()} {path}": operation
        for path, by_method in document["paths"].items()
        for method, operation in by_method.items()
    }
    for name, operation in operations.items():
        if description := operation.get("description"):  # in place of a function's name: the first sentence, or clause
            operation["summary"] = re.split(r"[.;:](?:\s|$)", " ".join(description.split()), maxsplit=1)[0] + "."
        required_scope = needed_scope(name.partition(" ")[2])
        if required_scope is not None:
            operation["security"] = [{scheme: [required_scope.value]} for scheme in _SECURITY_SCHEMES]
            for refusal in (401, 403, 429):
                operation["responses"].setdefault(str(refusal), _problem(refusal))
        operation["responses"] = dict(sorted(operation["responses"].items()))
    _link(operations)
    answers = json.loads(resources.files("deepsimbad.api").joinpath("examples.json").read_text(encoding="utf-8"))
    for name, example in {**BODY_EXAMPLES, **answers}.items():
        schemas[name]["examples"] = [example]
    for operation in operations.values():
        for parameter in operation.get("parameters", ()):
            if parameter["name"] in _PARAMETER_EXAMPLES:
                parameter["example"] = _PARAMETER_EXAMPLES[parameter["name"]]
        for content in operation.get("requestBody", {}).get("content", {}).values():
            if "oneOf" in content["schema"]:  # what a robot that encodes on board may send
                content["example"] = ENCODED_ON_BOARD


def _link(operations: Mapping[str, dict[str, Any]]) -> None:
    """Link answers to the calls whose path parameters they give."""
    for source, status, parameters in _LINKS:
        links = operations[source]["responses"][status].setdefault("links", {})
        for target, operation in operations.items():
            if target != source and set(re.findall(r"\{(\w+)\}", target)) == set(parameters):
                name = operation["operationId"]
                links[name] = {"operationId": name, "parameters": dict(parameters)}


def _problem(status: int) -> dict[str, Any]:
    response: dict[str, Any] = {
        "description": _DESCRIPTIONS[status],
        "content": {MEDIA_TYPE: {"schema": {"$ref": _REFERENCE.format(model="Problem")}}},
    }
    return response | ({"headers": _HEADERS[status]} if status in _HEADERS else {})


def _write_pairs_plainly(schema: Any) -> None:
    """Write tuples of one kind of item with `items`, in place: many readers of the document know no `prefixItems`."""
    if isinstance(schema, dict):
        kinds = schema.get("prefixItems")
        if isinstance(kinds, list) and all(kind == kinds[0] for kind in kinds):
            schema["items"] = schema.pop("prefixItems")[0]
        for part in schema.values():
            _write_pairs_plainly(part)
    elif isinstance(schema, list):
        for part in schema:
            _write_pairs_plainly(part)
