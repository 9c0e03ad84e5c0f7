"""The calls that remap domains, follow jobs and switch maps; they need a key of scope `admin`."""

from collections.abc import Mapping
from typing import Any
from uuid import uuid4

from deepsimbad_client.admin_calls import domain_path
from deepsimbad_client.answers import model, nothing, page
from deepsimbad_client.call import JSON, Call, json_body, name_in_path, query
from deepsimbad_client.models import Job, MapVersion
from deepsimbad_client.observation import Numbers
from deepsimbad_client.page import PAGE_LENGTH, Page
from deepsimbad_client.retry import Repeat
from deepsimbad_client.session_calls import KEY_HEADER, known_positions

JOBS = "/v1/admin/jobs"
EVENT_STREAM = "text/event-stream"
MAP_FILE = "application/vnd.sqlite3"


def remap(domain: str, config: Mapping[str, Any], idempotency_key: str | None = None) -> Call[Job]:
    """Ask for a new map; its key makes it one job however often it is sent."""
    return _making_a_job(f"{domain_path(domain)}/remaps", config, idempotency_key)


def feed_experience(
    domain: str, session_id: str, true_positions_m: Numbers, idempotency_key: str | None = None
) -> Call[Job]:
    """Feed back where a session's robot truly was, None or NaN where unknown; its key makes it one job.

    Raises:
        InvalidArgumentError: A position is infinite or no number.
    """
    told = {"session_id": session_id, "true_positions_m": known_positions(true_positions_m)}
    return _making_a_job(f"{domain_path(domain)}/experience", told, idempotency_key)


def jobs(domain: str | None, after: str | None) -> Call[Page[Job]]:
    """A page of the jobs, newest first, of one domain or all."""
    return Call("GET", JOBS, page(Job, "jobs"), params=query(domain=domain, limit=PAGE_LENGTH, after=after))


def job(job_id: str) -> Call[Job]:
    """One job."""
    return Call("GET", _job(job_id), model(Job))


def job_events(job_id: str) -> Call[None]:
    """The stream of a job's progress; whoever follows a job decides when to listen again."""
    return Call("GET", f"{_job(job_id)}/events", nothing, headers={"Accept": EVENT_STREAM}, repeat=Repeat.NEVER)


def cancel_job(job_id: str) -> Call[None]:
    """Ask a job to stop."""
    return Call("DELETE", _job(job_id), nothing)


def maps(domain: str, after: str | None) -> Call[Page[MapVersion]]:
    """A page of a domain's maps, newest first."""
    return Call(
        "GET", f"{domain_path(domain)}/maps", page(MapVersion, "maps"), params=query(limit=PAGE_LENGTH, after=after)
    )


def activate(domain: str, version: int, expected: int | None) -> Call[MapVersion]:
    """Serve another version, if the active one is still the `expected` one.

    Sent again only when surely unseen: after a lost answer a repetition would report its own success as a lost race.
    """
    document = json_body({"version": int(version)})
    if expected is not None:
        document = json_body({"version": int(version), "expected": int(expected)})
    return Call(
        "PUT",
        f"{domain_path(domain)}/active-map",
        model(MapVersion),
        headers=JSON,
        body=document,
        repeat=Repeat.IF_UNTOUCHED if expected is not None else Repeat.ALWAYS,
    )


def delete_map(domain: str, version: int) -> Call[None]:
    """Remove the file of a version that does not serve."""
    return Call("DELETE", f"{domain_path(domain)}/maps/{int(version)}", nothing, gone_is_done=True)


def map_file(domain: str, version: int) -> Call[None]:
    """The sealed file of a version, as its bytes are: compressed on the way, its parts could not be put together."""
    return Call(
        "GET",
        f"{domain_path(domain)}/maps/{int(version)}/file",
        nothing,
        headers={"Accept": f"{MAP_FILE}, application/octet-stream", "Accept-Encoding": "identity"},
    )


def _making_a_job(path: str, document: Mapping[str, Any], idempotency_key: str | None) -> Call[Job]:
    headers = {**JSON, KEY_HEADER: idempotency_key or uuid4().hex}
    return Call("POST", path, model(Job), headers=headers, body=json_body(document))


def _job(job_id: str) -> str:
    return f"{JOBS}/{name_in_path('job', job_id)}"
