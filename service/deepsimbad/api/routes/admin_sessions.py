"""Which sessions live."""

from typing import Annotated

from anyio.to_thread import run_sync
from fastapi import APIRouter, Query

from deepsimbad.api.bodies import NAME_PATTERN
from deepsimbad.api.dependencies import Running
from deepsimbad.api.openapi import problems
from deepsimbad.api.paging import USUALLY_AT_ONCE, AfterSession, Limit, cursor_of, number_of
from deepsimbad.api.session_rendering import render_listed
from deepsimbad.api.session_schemas import SessionList

router = APIRouter(prefix="/v1/admin/sessions", tags=["admin: sessions"])


@router.get("", responses=problems(404, 422))
async def list_sessions(
    running: Running,
    domain: Annotated[str | None, Query(pattern=NAME_PATTERN, description="Only this domain's; absent: all.")] = None,
    limit: Limit = USUALLY_AT_ONCE,
    after: AfterSession = None,
) -> SessionList:
    """Living sessions, newest first; whoever may list them may also ask and end them by their ids."""
    if domain is not None:
        await run_sync(running.catalog.domain, domain)
    page = await running.sessions.newest(domain, number_of(after), limit)
    return SessionList(
        sessions=[render_listed(listed) for listed in page.records], next=cursor_of("sessions", page.last_key)
    )
