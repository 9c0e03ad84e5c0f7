"""The OpenAPI document: what the framework derives, and what it cannot know."""

from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel

from deepsimbad.api.bodies import DECLARED_BODIES
from deepsimbad.api.problems import MEDIA_TYPE
from deepsimbad.api.schemas import Problem
from deepsimbad.api.session_bodies import DECLARED_SESSION_BODIES

_REFERENCE = "#/components/schemas/{model}"
_DESCRIPTIONS = {
    404: "An unknown name or id",
    409: "The present state forbids it",
    410: "A session that has ended, or whose map is no more",
    413: "More bytes or pixels than a limit allows",
    415: "A missing or unsupported Content-Type; `allowed` lists what is taken",
    422: "A value that can never be accepted; `errors` or the other members say which",
    429: "More than the service takes at once; try again after Retry-After seconds",
    500: "The service failed; the fault is its own",
    503: "The service cannot answer now; try again after Retry-After seconds",
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that may answer with these problems; 500 and 503 are always among them."""
    return {
        status: {
            "description": _DESCRIPTIONS[status],
            "content": {MEDIA_TYPE: {"schema": {"$ref": _REFERENCE.format(model="Problem")}}},
        }
        for status in (*statuses, 500, 503)
    }


def binary(description: str) -> Mapping[str, Any]:
    """The content of an answer that is a float32 npy on request."""
    return {"application/octet-stream": {"schema": {"type": "string", "format": "binary", "description": description}}}


def install_openapi(app: FastAPI) -> None:
    """Complete the document of `app` with the models that routes only refer to."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            made = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            schemas = made.setdefault("components", {}).setdefault("schemas", {})
            models: tuple[type[BaseModel], ...] = (Problem, *DECLARED_BODIES, *DECLARED_SESSION_BODIES)
            for model in models:
                schema = model.model_json_schema(ref_template=_REFERENCE)
                schemas.update(schema.pop("$defs", {}))
                schemas[model.__name__] = schema
            app.openapi_schema = made
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]
