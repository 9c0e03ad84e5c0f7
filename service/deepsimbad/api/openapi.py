"""The OpenAPI document: what the framework derives, and what it cannot know."""

import re
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from deepsimbad.api.auth import needed_scope
from deepsimbad.api.bodies import DECLARED_BODIES
from deepsimbad.api.examples import write_examples
from deepsimbad.api.problems import MEDIA_TYPE
from deepsimbad.api.schemas import Problem
from deepsimbad.api.session_bodies import DECLARED_SESSION_BODIES
from deepsimbad.store.records import KeyScope

_REFERENCE = "#/components/schemas/{model}"
_DESCRIPTIONS = {
    401: "No key, or one that is unknown, revoked or expired; a service without keys asks for none",
    403: "A key without the scope that the call needs",
    404: "An unknown name or id",
    408: "A body whose bytes stopped coming",
    409: "The present state forbids it",
    410: "A session that has ended, or a map that is no more",
    413: "More bytes or pixels than a limit allows",
    415: "A missing or unsupported Content-Type; `allowed` lists what is taken",
    416: "A range outside the file",
    422: "A value that can never be accepted; `errors` or the other members say which",
    429: "More than the service takes at once, or from one key; try again after Retry-After seconds",
    431: "More bytes of headers than the limit",
    500: "The service failed; the fault is its own",
    503: "The service cannot answer now; try again after Retry-After seconds",
}
_RETRY_AFTER = {"Retry-After": {"description": "Seconds to wait.", "schema": {"type": "integer", "minimum": 1}}}
_CHALLENGE = {"WWW-Authenticate": {"description": "How to authenticate.", "schema": {"const": "Bearer"}}}
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
_HEADERS = {401: _CHALLENGE, 429: _RETRY_AFTER, 503: _RETRY_AFTER}
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


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that may answer with these problems; 500 and 503 are always among them.

    What comes before any route (keys, rates, timeouts) is added to the document by `install_openapi`.
    """
    return {status: _problem(status) for status in (*statuses, 500, 503)}


def _problem(status: int) -> dict[str, Any]:
    declared: dict[str, Any] = {
        "description": _DESCRIPTIONS[status],
        "content": {MEDIA_TYPE: {"schema": {"$ref": _REFERENCE.format(model="Problem")}}},
    }
    return declared | ({"headers": _HEADERS[status]} if status in _HEADERS else {})


def binary(description: str) -> Mapping[str, Any]:
    """The content of an answer that is a float32 npy on request."""
    return {"application/octet-stream": {"schema": {"type": "string", "format": "binary", "description": description}}}


def install_openapi(app: FastAPI) -> None:
    """Complete the document of `app` with the models that routes only refer to, and with what comes before routes."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            made = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            components = made.setdefault("components", {})
            schemas = components.setdefault("schemas", {})
            models: tuple[type[BaseModel], ...] = (Problem, *DECLARED_BODIES, *DECLARED_SESSION_BODIES)
            for model in models:
                schema = model.model_json_schema(ref_template=_REFERENCE)
                schemas.update(schema.pop("$defs", {}))
                schemas[model.__name__] = schema
            components["securitySchemes"] = _SECURITY_SCHEMES
            _write_pairs_plainly(schemas)
            operations = {
                f"{method.upper()} {path}": operation
                for path, by_method in made["paths"].items()
                for method, operation in by_method.items()
            }
            for name, operation in operations.items():
                _declare_what_comes_first(operation, needed_scope(name.partition(" ")[2]))
            _link(operations)
            write_examples(operations, schemas)
            app.openapi_schema = made
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]
    kept = b""

    async def answer(_: Request) -> Response:
        nonlocal kept
        kept = kept or bytes(JSONResponse(document()).body)  # written once: anybody may ask, without a key
        return Response(kept, media_type="application/json")

    app.add_route("/openapi.json", answer, include_in_schema=False)


def _declare_what_comes_first(operation: dict[str, Any], needed: KeyScope | None) -> None:
    """Add keys, and the answers that middleware gives, to one operation."""
    statuses = [431]
    if needed is not None:
        operation["security"] = [{scheme: [needed.value]} for scheme in _SECURITY_SCHEMES]
        statuses += [401, 429] if needed is KeyScope.LOCALIZE else [401, 403, 429]
    if "requestBody" in operation:
        statuses.append(408)
    for status in statuses:
        operation["responses"].setdefault(str(status), _problem(status))
    operation["responses"] = dict(sorted(operation["responses"].items()))


def _link(operations: Mapping[str, dict[str, Any]]) -> None:
    """Say of the answers that make something which calls take it."""
    for source, status, parameters in _LINKS:
        links = operations[source]["responses"][status].setdefault("links", {})
        for target, operation in operations.items():
            if target != source and set(re.findall(r"\{(\w+)\}", target)) == set(parameters):
                name = operation["operationId"]
                links[name] = {"operationId": name, "parameters": dict(parameters)}


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
