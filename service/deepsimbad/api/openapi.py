"""The OpenAPI document: what the framework derives, and what it cannot know."""

import re
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from deepsimbad.api.keys import needed_scope
from deepsimbad.api.problems import MEDIA_TYPE

_REFERENCE = "#/components/schemas/{model}"
_DESCRIPTIONS = {
    401: "No key, or one that is unknown, revoked or expired; a service without keys asks for none",
    403: "A key without the scope that the call needs",
    404: "An unknown name or id",
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
# What an answer gives to the calls whose path needs just these: call, status, parameters.
_LINKS = (
    ("PUT /v1/admin/domains/{domain}", "201", {"domain": "$request.path.domain"}),
    (
        "POST /v1/admin/domains/{domain}/traverses",
        "201",
        {"domain": "$request.path.domain", "name": "$response.body#/name"},
    ),
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
    "session_id": "5f0c2f7e8a7b4a0c9d3e1b2a4c6d8e0f",
    "job_id": "8a7b4a0c9d3e1b2a4c6d8e0f5f0c2f7e",
    "version": 1,
    "index": 0,
    "position_m": 12.5,
    "timestamp_us": 1_345_480_000_000_000,
    "x_m": 101.5,
    "y_m": -42.25,
    "action_m": 3.0,
    "action_std_m": 0.3,
    "shortlist": 10,
    "limit": 100,
    "Idempotency-Key": "robot-7/421",
    "If-Match": "*",
    "map_version": 1,
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
    """The `responses` of a route that may answer with these problems; 500 and 503 are always among them.

    What comes before any route (keys, rates) is added to the document by `install_openapi`.
    """
    return {status: _problem(status) for status in (*statuses, 500, 503)}


def binary(description: str) -> dict[str, Any]:
    """The content of an answer of bytes."""
    return {"application/octet-stream": {"schema": {"type": "string", "format": "binary", "description": description}}}


def location(status: int, what: str) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route whose answer says where what was made is."""
    return {status: {"headers": {"Location": {"description": what, "schema": {"type": "string"}}}}}


def declare_json(model: type[BaseModel]) -> dict[str, Any]:
    """The OpenAPI request body of a route that reads this model, as `openapi_extra`."""
    _declared_bodies[model.__name__] = model
    return declare({"application/json": {"$ref": _REFERENCE.format(model=model.__name__)}})


def declare(content: dict[str, Any]) -> dict[str, Any]:
    """The OpenAPI request body with these media types and schemas, as `openapi_extra`."""
    described = {media_type: {"schema": schema} for media_type, schema in content.items()}
    return {"requestBody": {"required": True, "content": described}}


def install_openapi(app: FastAPI) -> None:
    """Complete the document of `app` with the models that routes only refer to, and with what comes before routes."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = get_openapi(
                title=app.title, version=app.version, description=app.description, routes=app.routes
            )
            _complete(app.openapi_schema)
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]
    body = b""

    async def answer(_: Request) -> Response:
        nonlocal body
        body = body or bytes(JSONResponse(document()).body)  # written once: anybody may ask, without a key
        return Response(body, media_type="application/json")

    app.add_route("/openapi.json", answer, include_in_schema=False)


def _complete(document: dict[str, Any]) -> None:
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
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
        needed = needed_scope(name.partition(" ")[2])
        if needed is not None:
            operation["security"] = [{scheme: [needed.value]} for scheme in _SECURITY_SCHEMES]
            for refusal in (401, 403, 429):
                operation["responses"].setdefault(str(refusal), _problem(refusal))
        operation["responses"] = dict(sorted(operation["responses"].items()))
    _link(operations)
    for name, example in BODY_EXAMPLES.items():
        schemas[name]["examples"] = [example]
    for operation in operations.values():
        for parameter in operation.get("parameters", ()):
            if parameter["name"] in _PARAMETER_EXAMPLES:
                parameter["example"] = _PARAMETER_EXAMPLES[parameter["name"]]
        for content in operation.get("requestBody", {}).get("content", {}).values():
            if "oneOf" in content["schema"]:  # what a robot that encodes on board may send
                content["example"] = ENCODED_ON_BOARD


def _link(operations: Mapping[str, dict[str, Any]]) -> None:
    """Say of the answers that make something which calls take it."""
    for source, status, parameters in _LINKS:
        links = operations[source]["responses"][status].setdefault("links", {})
        for target, operation in operations.items():
            if target != source and set(re.findall(r"\{(\w+)\}", target)) == set(parameters):
                name = operation["operationId"]
                links[name] = {"operationId": name, "parameters": dict(parameters)}


def _problem(status: int) -> dict[str, Any]:
    declared: dict[str, Any] = {
        "description": _DESCRIPTIONS[status],
        "content": {MEDIA_TYPE: {"schema": {"$ref": _REFERENCE.format(model="Problem")}}},
    }
    return declared | ({"headers": _HEADERS[status]} if status in _HEADERS else {})


def _write_pairs_plainly(schema: Any) -> None:
    """Write arrays of so many items of one kind with `items`: many readers of such documents know no `prefixItems`."""
    if isinstance(schema, dict):
        kinds = schema.get("prefixItems")
        if isinstance(kinds, list) and all(kind == kinds[0] for kind in kinds):
            schema["items"] = schema.pop("prefixItems")[0]
        for part in schema.values():
            _write_pairs_plainly(part)
    elif isinstance(schema, list):
        for part in schema:
            _write_pairs_plainly(part)
