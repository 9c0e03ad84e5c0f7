"""Pages for people, which ask this service alone: where to go from here, every call to try, and the console."""

from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, JSONResponse, RedirectResponse

from deepsimbad import release
from deepsimbad.api.requests import StrictRoute

router = APIRouter(include_in_schema=False, route_class=StrictRoute)

_CACHE_AN_HOUR = {"Cache-Control": "public, max-age=3600"}


# The root page

_LINKS = {
    "console": "console",
    "documentation": "docs",
    "openapi": "openapi.json",
    "domains": "v1/domains",
    "ready": "readyz",
}
_ROOT = (
    '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta name="color-scheme" content="light dark">'
    "<title>Deep SIMBAD</title><h1>Deep SIMBAD</h1><ul>"
    + "".join(f'<li><a href="{path}">{name}</a></li>' for name, path in _LINKS.items())
    + "</ul></html>"
)


@router.get("/")
async def root(request: Request) -> Response:
    """Links to the parts of the service, as a page for a browser, else as JSON."""
    if "text/html" in request.headers.get("accept", ""):
        return Response(_ROOT, media_type="text/html")
    return JSONResponse({"name": "Deep SIMBAD", "version": release(), **_LINKS})


# Every call

# The page that shows the OpenAPI document, and all it needs: a robot's network reaches no other host.
_CALLS = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Deep SIMBAD</title>
<link rel="stylesheet" href="docs/swagger-ui.css"><link rel="icon" href="data:,">
</head>
<body><div id="page"></div><script src="docs/swagger-ui-bundle.js"></script><script src="docs/start.js"></script></body>
</html>
"""
# The validator is another host's; a key that was typed in is forgotten with the page.
_CALLS_START = """SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#page",
  deepLinking: true,
  persistAuthorization: false,
  validatorUrl: null,
});
"""
# Styles stand in the page's elements, so they cannot be forbidden there; scripts come from here alone.
_CALLS_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


@router.get("/docs")
async def calls() -> Response:
    """Every call, to read and to try."""
    return Response(_CALLS, media_type="text/html", headers={"Content-Security-Policy": _CALLS_POLICY})


@router.get("/docs/start.js")
async def calls_start() -> Response:
    """The script that draws the page."""
    return Response(_CALLS_START, media_type="text/javascript", headers=_CACHE_AN_HOUR)


@router.get("/docs/{asset}")
async def calls_asset(
    name: Annotated[Literal["swagger-ui-bundle.js", "swagger-ui.css"], PathParameter(alias="asset")],
) -> Response:
    """Swagger UI, from the package that brings it."""
    return FileResponse(Path(str(resources.files("fastapi_offline") / "static")) / name, headers=_CACHE_AN_HOUR)


# The console

_FILES = Path(str(resources.files("deepsimbad") / "console"))
# What is fetched, drawn and run comes from here alone; a robot's network reaches no other host.
_CONSOLE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "frame-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# A report brings styles and scripts of its own, whoever made it: it is shown where it reaches neither this page, nor
# the key, nor any host.
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


def _file(name: str, policy: str | None = None) -> Response:
    headers = {"Cache-Control": "no-cache"}  # asked for again, by its tag, so that a new release shows at once
    if policy is not None:
        headers |= {"Content-Security-Policy": policy, "X-Frame-Options": "SAMEORIGIN"}
    return FileResponse(_FILES / name, headers=headers)


@router.get("/console")
async def console() -> Response:
    """The one page; where in it somebody is stands behind the address' #."""
    return _file("index.html", _CONSOLE_POLICY)


@router.get("/console/")
async def console_with_slash() -> Response:
    """Redirect to the console's address without the slash."""
    return RedirectResponse("../console", 308)


@router.get("/console/report.html")
async def report() -> Response:
    """The page in which a report is opened."""
    return _file("report.html", _REPORT_POLICY)


@router.get("/console/{name}")
async def console_asset(
    name: Annotated[str, PathParameter(pattern=r"^[a-z][A-Za-z0-9.]*\.(js|css|svg|txt)$")],
) -> Response:
    """A file of the console by its name."""
    if not (_FILES / name).is_file():
        raise HTTPException(404)
    return _file(name)
