"""The console: pages for people, which ask this service alone, by the calls that everybody has."""

from importlib import resources
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Response
from fastapi import Path as PathParameter
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, RedirectResponse

from deepsimbad.api.requests import StrictRoute

router = APIRouter(include_in_schema=False, route_class=StrictRoute)

_FILES = Path(str(resources.files("deepsimbad") / "console"))
# What is fetched, drawn and run comes from here alone; a robot's network reaches no other host.
_POLICY = (
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
    return _file("index.html", _POLICY)


@router.get("/console/")
async def console_with_slash() -> Response:
    """What was meant."""
    return RedirectResponse("../console", 308)


@router.get("/console/report.html")
async def report() -> Response:
    """Where a report is opened."""
    return _file("report.html", _REPORT_POLICY)


@router.get("/console/{name}")
async def asset(name: Annotated[str, PathParameter(pattern=r"^[a-z][A-Za-z0-9.]*\.(js|css|svg|txt)$")]) -> Response:
    """What the page is made of."""
    if not (_FILES / name).is_file():
        raise HTTPException(404)
    return _file(name)
