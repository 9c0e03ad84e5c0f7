"""The page that shows the OpenAPI document, and all it needs: a robot's network reaches no other host."""

from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter
from fastapi import Path as PathParameter
from starlette.responses import FileResponse, Response

router = APIRouter(include_in_schema=False)

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Deep SIMBAD</title>
<link rel="stylesheet" href="docs/swagger-ui.css">
<link rel="icon" href="data:,">
</head>
<body>
<div id="page"></div>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
</body>
</html>
"""
# The validator is another host's; a key that was typed in is forgotten with the page.
_START = """SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#page",
  deepLinking: true,
  persistAuthorization: false,
  validatorUrl: null,
});
"""
# Styles stand in the page's elements, so they cannot be forbidden there; scripts come from here alone.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_KEPT = {"Cache-Control": "public, max-age=3600"}


@router.get("/docs")
async def page() -> Response:
    """Every call, to read and to try."""
    return Response(_PAGE, media_type="text/html", headers={"Content-Security-Policy": _POLICY})


@router.get("/docs/start.js")
async def start() -> Response:
    """What draws the page."""
    return Response(_START, media_type="text/javascript", headers=_KEPT)


@router.get("/docs/{asset}")
async def asset(
    name: Annotated[Literal["swagger-ui-bundle.js", "swagger-ui.css"], PathParameter(alias="asset")],
) -> Response:
    """Swagger UI, from the package that brings it."""
    folder = Path(str(resources.files("fastapi_offline") / "static"))
    return FileResponse(folder / name, headers=_KEPT)
