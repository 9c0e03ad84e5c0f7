"""A session followed while its robot drives, or gone through again afterwards."""

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent

from deepsimbad.api.jobs import room_for_a_stream
from deepsimbad.api.problems import problems
from deepsimbad.api.requests import GREATEST_ID, RunningServices, SessionId, StrictRoute, key_id_of, robot_of
from deepsimbad.api.sessions import render_observation, render_session
from deepsimbad.engine.worker import Stopwatch
from deepsimbad.store.sessions import SessionRecord

router = APIRouter(prefix="/v1/sessions", tags=["sessions"], route_class=StrictRoute)


def _session(session_id: SessionId, request: Request, services: RunningServices) -> SessionRecord:
    """The session of the path, so that an unknown one is refused before a stream begins."""
    return services.session_events.find(session_id, robot_of(request))


def _followable_session(
    session: Annotated[SessionRecord, Depends(_session)], services: RunningServices
) -> SessionRecord:
    """The session of the path, so that one whose map is no more is refused before a stream begins."""
    services.sessions.engine_of(session)
    return session


@router.get(
    "/{session_id}/events",
    response_class=EventSourceResponse,
    dependencies=[Depends(room_for_a_stream)],
    responses={
        200: {
            "description": "`observation` events: what each observation was answered; its timings, remarks on its "
            "picture and how long its lists were asked to be are apart. `prior` events with the session as somebody's "
            "word left it; `done` when the session has ended. Ids count from 1."
        },
        **problems(404, 410, 422),
    },
)
async def get_session_events(
    session: Annotated[SessionRecord, Depends(_followable_session)],
    request: Request,
    services: RunningServices,
    after_sequence: Annotated[
        int | None,
        Query(
            alias="after",
            ge=0,
            le=GREATEST_ID,
            description="Begin behind the event of this id; 0: from the first; absent: now.",
        ),
    ] = None,
    last_event_id: Annotated[
        str | None, Header(pattern=r"^\d{1,9}$", description="The same, as a browser says that was cut off.")
    ] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Follow a session: an event for every observation, whoever sends them; the last one that there was comes at once.

    What has passed can be had again, of a session that has ended too, as long as it is known. The stream may end
    earlier, when the service shuts down or the key is revoked: ask again, behind the last event that came.
    """
    last_sequence = int(last_event_id) if last_event_id is not None else after_sequence
    key_id = key_id_of(request)
    async for event in services.session_events.follow(session, last_sequence):
        if services.stopping.is_set() or not services.keys.still_opens(key_id):
            return
        if event is None:
            continue
        number = str(event.sequence)
        if event.is_observation:
            yield ServerSentEvent(data=render_observation(event.view, Stopwatch()), event="observation", id=number)
        else:
            yield ServerSentEvent(data=render_session(event.view), event="prior", id=number)
    yield ServerSentEvent(data={"session_id": session.session_id}, event="done")


@router.get(
    "/{session_id}/view",
    response_class=Response,
    responses={
        200: {"content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}},
        204: {"description": "It is not held: nothing was seen yet, or long ago, or no image was sent."},
        **problems(404, 410, 422),
    },
)
def get_view(session: Annotated[SessionRecord, Depends(_session)], services: RunningServices) -> Response:
    """What the robot saw last, as a small picture; held in memory alone, for people who look on."""
    content = services.pictures.view(session.session_id)
    return Response(status_code=204) if content is None else Response(content, media_type="image/jpeg")
