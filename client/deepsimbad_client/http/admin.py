"""An administrator's calls for domains, traverses, jobs, maps and sessions, on the blocking and the async client."""

import time
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping, Sequence
from contextlib import aclosing, suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from pydantic import ValidationError

from deepsimbad_client.errors import (
    ApiError,
    JobCancelledError,
    JobFailedError,
    NoEarlierMapError,
    NotSavedError,
    TransportError,
)
from deepsimbad_client.http import (
    BINARY,
    RETRIED_STATUSES,
    Call,
    Image,
    Numbers,
    Repeat,
    idempotency_header,
    in_path,
    known_positions,
    named_arrays,
    observation,
    require_numpy,
    session_path,
    text_of,
)
from deepsimbad_client.http.download import MapFile, OnBytes, download
from deepsimbad_client.http.models import Domain, FramesStored, FrameStored, Job, ListedSession, MapVersion, Traverse
from deepsimbad_client.http.wire import Awaiting, Blocking, Face, shared, shared_stream

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from deepsimbad_client.http.client import Client

PATIENCE_S = 600.0
POLL_S = 1.0
LONGEST_POLL_S = 15.0
_JOBS = "/v1/admin/jobs"


class RemapOptions(TypedDict, total=False):
    """The options of a remap; one that is absent or None is left to the service's default."""

    landmark_traverse: str | None  # where landmarks are chosen; absent: the active map's, or the new map's own drive
    n_landmarks: int | None  # r
    list_length: int | None  # h, how many of them a map image keeps
    relevance: str | None  # how a map image is compared with a query
    training_episodes: int | None  # length of the planner's training
    seed: int | None  # of whatever is random
    activate: bool | None  # whether the new map serves at once
    check_traverse: str | None  # the drive that the new map and the active one are compared on
    gate_margin: float | None  # percentage points of ANR by which the new map may be worse and still be activated
    append: bool | None  # whether the traverse is added to a copy of the active map
    camera_of: str | None  # another domain of the camera, that what a season changes is learnt from
    same_route: bool | None  # whether both drives count their positions along one route; absent: where both know x, y


class AdminCalls(Face):
    """The calls that need a key of scope `admin`."""

    @shared
    async def put_domain(
        self,
        name: str,
        evaluator: Mapping[str, Any],
        *,
        closed: bool = False,
        actions_m: Sequence[float] | None = None,
        thumbnails: bool | None = None,
        anchor: Mapping[str, float] | None = None,
    ) -> Domain:
        """Make a domain; the same again changes nothing, another configuration raises ConflictError.

        `evaluator` is `{"kind": ..., ...}`, how observations are compared with landmarks; `closed` says that the
        route's end is its start; `actions_m` are the moves a robot may be told to make, absent: the service's default.
        Whether pictures are kept (`thumbnails`) and where x = y = 0 lies (`anchor`: `{"lat_deg": ..., "lon_deg": ...}`)
        may be changed later; None leaves it as it is.
        """
        document = {
            "evaluator": dict(evaluator),
            "closed": closed,
            "actions_m": None if actions_m is None else [float(action) for action in actions_m],
            "thumbnails": thumbnails,
            "anchor": None if anchor is None else dict(anchor),
        }
        return await self._wire.model(Domain, Call.with_json("PUT", _domain(name), document))

    @shared
    async def delete_domain(self, name: str) -> None:
        """Remove a domain with all its maps and traverses."""
        await self._wire.send(Call.delete(_domain(name)))

    @shared
    async def create_traverse(self, domain: str, name: str, *, grey_levels: tuple[int, int] | None = None) -> Traverse:
        """Make an empty traverse; one of that name that is there stays as it is.

        `grey_levels` are the levels shown as black and as white in pictures of more than 8 bits; absent: by the first
        picture. A traverse that has some keeps them.
        """
        in_path("traverse", name)
        call = Call.with_json("POST", f"{_domain(domain)}/traverses", {"name": name, "grey_levels": grey_levels})
        return await self._wire.model(Traverse, call)

    @shared
    async def traverses(self, domain: str) -> tuple[Traverse, ...]:
        """Every traverse of a domain, by name."""
        return await self._wire.model_list(Traverse, "traverses", f"{_domain(domain)}/traverses")

    @shared
    async def traverse(self, domain: str, name: str) -> Traverse:
        """One traverse: how many frames have arrived and which are missing."""
        return await self._wire.model(Traverse, Call("GET", _traverse(domain, name)))

    @shared
    async def delete_traverse(self, domain: str, name: str) -> None:
        """Remove a traverse and its frames."""
        await self._wire.send(Call.delete(_traverse(domain, name)))

    @shared
    async def put_frame(
        self,
        domain: str,
        traverse: str,
        index: int,
        image: Image | None = None,
        *,
        position_m: float,
        timestamp_us: int | None = None,
        x_m: float | None = None,
        y_m: float | None = None,
        name: str | None = None,
        camera: str | None = None,
        replace: bool = True,
        content_type: str | None = None,
        encoding: Numbers | None = None,
        objects: Iterable[Mapping[str, Any]] | None = None,
        text: str | None = None,
    ) -> FrameStored:
        """Send one frame, as `Client.localize` takes it or a ready encoding; the same index again replaces it.

        `index` is its place in the recording, from 0; `position_m` its distance along the route. Answers show
        the `name`, as of its file; `camera` names what took it. Without `replace` an equal frame stays, and another one
        raises FramesDifferError.
        """
        view = observation(image, content_type=content_type, encoding=encoding, objects=objects, text=text)
        place: dict[str, float | str | None] = {"position_m": position_m, "timestamp_us": timestamp_us}
        place |= {"x_m": x_m, "y_m": y_m, "name": None if name is None else text_of(name)}
        place |= {"camera": None if camera is None else text_of(camera), **_replace_param(replace)}
        call = Call("PUT", f"{_traverse(domain, traverse)}/frames/{int(index)}", place, view.headers, view.body)
        return await self._wire.model(FrameStored, call)

    @shared
    async def put_frames(
        self,
        domain: str,
        traverse: str,
        *,
        encodings: "ArrayLike",
        index: "ArrayLike",
        position_m: "ArrayLike",
        timestamp_us: "ArrayLike | None" = None,
        x_m: "ArrayLike | None" = None,
        y_m: "ArrayLike | None" = None,
        name: Sequence[str] | None = None,
        replace: bool = True,
    ) -> FramesStored:
        """Send a batch of frames whose encodings [n, d] are known (needs numpy); the same indices again replace them.

        Everything else is [n]; unknown times are -1, unknown places NaN, unknown names "". `x_m` and `y_m` are sent
        together or not. `replace` is that of `put_frame`.
        """
        np = require_numpy()
        is_whole = np.array_equal(index, np.asarray(index).astype(np.int64))  # else the service refuses it
        columns: dict[str, tuple[Any, Any]] = {"encodings": (encodings, np.float32)}
        columns |= {"index": (index, np.int64 if is_whole else None)}
        columns |= {"position_m": (position_m, np.float64), "timestamp_us": (timestamp_us, np.int64)}
        if x_m is not None and y_m is not None:
            columns |= {"x_m": (x_m, np.float64), "y_m": (y_m, np.float64)}
        if name is not None:
            columns["name"] = ([text_of(text) for text in name], np.str_)
        body = BytesIO()
        np.savez(body, **{name: np.asarray(*column) for name, column in columns.items() if column[0] is not None})
        headers = {"Content-Type": "application/octet-stream"}
        call = Call("POST", f"{_traverse(domain, traverse)}/frames", _replace_param(replace), headers, body.getvalue())
        return await self._wire.model(FramesStored, call)

    @shared
    async def frames(self, domain: str, traverse: str) -> "dict[str, NDArray[Any]]":
        """The stored frames without encodings: `index`, and the arrays [n] that `deepsimbad.core.frames` names."""
        call = Call("GET", f"{_traverse(domain, traverse)}/frames", headers=BINARY)
        return named_arrays(await self._wire.send(call))

    @shared
    async def remap(
        self,
        /,
        domain: str,
        *,
        training_traverse: str,
        idempotency_key: str | None = None,
        **options: Unpack[RemapOptions],
    ) -> Job:
        """Submit a remap of `training_traverse` and return its job at once; `remap` of this module also follows it.

        A lost answer is asked for again and makes no second job. The `idempotency_key` names this request, so that it
        can be repeated after a `TransportError`; absent: a new one.
        """
        document = {"training_traverse": training_traverse, **options}
        call = Call.with_json(
            "POST", f"{_domain(domain)}/remaps", document, headers=idempotency_header(idempotency_key)
        )
        return await self._wire.model(Job, call)

    @shared
    async def feed_experience(
        self, domain: str, session_id: str, true_positions_m: Numbers, *, idempotency_key: str | None = None
    ) -> Job:
        """Teach the next map: where a session's robot truly was at each of its observations, known only afterwards.

        The job makes the next map version; the session may have ended a while ago. A position along the map's route for
        each observation, in order, is None or NaN where unknown; the key is as that of `remap`.
        """
        document = {"session_id": session_id, "true_positions_m": known_positions(true_positions_m)}
        call = Call.with_json(
            "POST", f"{_domain(domain)}/experience", document, headers=idempotency_header(idempotency_key)
        )
        return await self._wire.model(Job, call)

    @shared
    async def jobs(self, domain: str | None = None) -> tuple[Job, ...]:
        """Jobs, newest first, of one domain or all."""
        return await self._wire.model_list(Job, "jobs", _JOBS, domain=domain)

    @shared
    async def job(self, job_id: str) -> Job:
        """One job."""
        return await self._wire.model(Job, Call("GET", _job(job_id)))

    @shared_stream
    async def job_events(self, job_id: str) -> AsyncGenerator[Job, None]:
        """Yield the job each time it has changed, until it has ended, over one connection that is not renewed.

        Raises TransportError (the connection failed or broke off).
        """
        call = Call("GET", f"{_job(job_id)}/events", headers={"Accept": "text/event-stream"}, repeat=Repeat.NEVER)
        async with aclosing(self._wire.events(call)) as events:
            async for event in events:
                with suppress(ValidationError):  # of an event that holds no job
                    yield Job.model_validate_json(event.data)
                if event.event == "done":
                    return

    @shared
    async def cancel_job(self, job_id: str) -> None:
        """Ask a job to stop; it ends as cancelled soon after."""
        await self._wire.send(Call("DELETE", _job(job_id)))

    @shared
    async def maps(self, domain: str) -> tuple[MapVersion, ...]:
        """A domain's history of maps, newest version first."""
        return await self._wire.model_list(MapVersion, "maps", f"{_domain(domain)}/maps")

    @shared
    async def warm(self, domain: str) -> None:
        """Let the service load a domain's map, which will soon be asked for. Raises NoActiveMapError."""
        await self._wire.send(Call("POST", f"{_domain(domain)}/warm"))

    @shared
    async def activate(self, domain: str, version: int, *, expected: int | None = None) -> MapVersion:
        """Serve another version, newer or older, if `expected` (absent: whichever) is the active one now.

        Raises LostActivationError (another one was active), RetiredMapError (the version's file was removed).
        """
        # After a lost answer, a repetition of a conditional switch would report its own success as a lost race.
        call = Call.with_json(
            "PUT",
            f"{_domain(domain)}/active-map",
            {"version": int(version), "expected": None if expected is None else int(expected)},
            repeat=Repeat.ALWAYS if expected is None else Repeat.IF_UNTOUCHED,
        )
        return await self._wire.model(MapVersion, call)

    @shared
    async def rollback(self, domain: str) -> MapVersion:
        """Serve again the version that served before the active one; called twice, it restores the present one.

        Raises NoEarlierMapError, LostActivationError (another version was activated meanwhile).
        """
        maps = await AdminCalls.maps(self, domain)
        active = next((version.version for version in maps if version.state == "active"), None)
        earlier_maps = [version for version in maps if version.state == "retired" and version.removed_at is None]
        if not earlier_maps:
            raise NoEarlierMapError(
                f"no map of domain {domain} has served before the present one and is still there: "
                f"list them with `deepsimbad-client maps {domain}`"
            )
        # Times of one form sort as texts; a service that does not tell them has the highest number last.
        last_map = max(earlier_maps, key=lambda version: (version.retired_at or "", version.version))
        rolled_back: MapVersion = await AdminCalls.activate(self, domain, last_map.version, expected=active)
        return rolled_back

    @shared
    async def delete_map(self, domain: str, version: int) -> None:
        """Remove the file of a version; its place in the history stays."""
        await self._wire.send(Call.delete(f"{_domain(domain)}/maps/{int(version)}"))

    @shared
    async def download_map(
        self, domain: str, version: int, path: str | Path, *, on_progress: OnBytes = lambda *_: None
    ) -> MapFile:
        """Fetch the sealed file of a version, to keep or to import it elsewhere.

        It is written beside `path`, checked against the digest that the service names, and then renamed. A download
        that was interrupted goes on where it stopped, this time or the next. Raises RetiredMapError,
        DamagedDownloadError, NotSavedError.
        """
        # Not compressed on the way: the parts of compressed bytes could not be put together.
        headers = {"Accept": "application/vnd.sqlite3, application/octet-stream", "Accept-Encoding": "identity"}
        call = Call("GET", f"{_domain(domain)}/maps/{int(version)}/file", headers=headers)
        try:
            return await download(self._wire, call, Path(path), on_progress)
        except OSError as error:
            raise NotSavedError(f"{path} cannot be written: {error.strerror or error}") from error

    @shared
    async def sessions(self, domain: str | None = None) -> tuple[ListedSession, ...]:
        """Living sessions, newest first, of one domain or all; `Client.attach_session` looks into one or ends it."""
        return await self._wire.model_list(ListedSession, "sessions", "/v1/admin/sessions", domain=domain)

    @shared
    async def delete_session(self, session_id: str) -> None:
        """End a session, whichever key began it."""
        await self._wire.send(Call.delete(session_path(session_id)))


class Admin(AdminCalls, Blocking):
    """The administrator's calls of a `Client`."""


class AsyncAdmin(AdminCalls, Awaiting):
    """The administrator's calls of an `AsyncClient`."""


def _domain(name: str) -> str:
    return f"/v1/admin/domains/{in_path('domain', name)}"


def _traverse(domain: str, name: str) -> str:
    return f"{_domain(domain)}/traverses/{in_path('traverse', name)}"


def _replace_param(replace: bool) -> dict[str, str]:
    return {} if replace else {"replace": "false"}


def _job(job_id: str) -> str:
    return f"{_JOBS}/{in_path('job', job_id)}"


def remap(
    client: "Client",
    domain: str,
    training_traverse: str,
    *,
    on_progress: Callable[[Job], None] = lambda _: None,
    patience_s: float = PATIENCE_S,
    **options: Unpack[RemapOptions],
) -> Job:
    """Make a new map of `training_traverse` by the `RemapOptions`, and follow its job to its end.

    The `result` of the job holds `map_version`, `active` and `metrics`. Where the new map lost against the active one
    by more than the gate's margin, `active` is false and `check["why"]` says so. The rest is as in `follow_job`.
    """
    job = client.admin.remap(domain, training_traverse=training_traverse, **options)
    on_progress(job)
    return follow_job(client, job.job_id, on_progress, patience_s=patience_s)


def follow_job(
    client: "Client",
    job_id: str,
    on_progress: Callable[[Job], None] = lambda _: None,
    *,
    on_silence: Callable[[float], None] = lambda _: None,
    patience_s: float = PATIENCE_S,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Job:
    """Follow a job until it has succeeded, through lost connections and restarted services.

    Listens to its event stream; where that breaks off or there is none, asks for the job now and then, and tries to
    listen anew. `on_progress` is called with the job each time it is heard of, `on_silence` with the seconds since then
    each time the service has not answered. Raises JobFailedError, JobCancelledError, TransportError (nothing was heard
    for `patience_s`; the job itself may go on), ApiError.
    """
    last_heard_s, wait_s = clock(), POLL_S

    def hear(job: Job) -> bool:
        """Report a job just heard of, and return whether it succeeded."""
        nonlocal last_heard_s, wait_s
        last_heard_s, wait_s = clock(), POLL_S
        on_progress(job)
        if job.state == "cancelled":
            raise JobCancelledError(f"job {job.job_id} was cancelled", job)
        if job.ended and job.state != "succeeded":
            raise JobFailedError(f"job {job.job_id} failed: {job.error_text or 'the service gave no reason'}", job)
        return job.ended

    while True:
        with suppress(TransportError, ApiError):  # what lasts is raised by the question below
            for job in client.admin.job_events(job_id):
                if hear(job):
                    return job
        try:
            job = client.admin.job(job_id)
        except (TransportError, ApiError) as error:
            if not _is_passing(error) or clock() - last_heard_s > patience_s:
                raise
            on_silence(clock() - last_heard_s)
            wait_s = min(2 * wait_s, LONGEST_POLL_S)
        else:
            if hear(job):
                return job
        sleep(wait_s)


def _is_passing(error: TransportError | ApiError) -> bool:
    """Whether the service may answer again later."""
    return isinstance(error, TransportError) or error.status >= 500 or error.status in RETRIED_STATUSES
