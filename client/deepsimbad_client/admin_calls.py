"""The calls that make, fill, remap and switch domains; they need a key of scope `admin`."""

import math
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

from deepsimbad_client.answers import model, models, nothing, require_numpy
from deepsimbad_client.call import JSON, Call, json_body, name_in_path, query
from deepsimbad_client.models import Domain, FramesStored, FrameStored, Job, MapVersion, Traverse
from deepsimbad_client.observation import Numbers, Observation
from deepsimbad_client.retry import Repeat

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

DOMAINS = "/v1/admin/domains"
JOBS = "/v1/admin/jobs"
EVENT_STREAM = "text/event-stream"


def put_domain(
    name: str, evaluator: Mapping[str, Any], closed: bool, actions_m: Sequence[float] | None
) -> Call[Domain]:
    """Make a domain, or find that it is there already as described."""
    document = {
        "evaluator": dict(evaluator),
        "closed": closed,
        "actions_m": None if actions_m is None else [float(action) for action in actions_m],
    }
    return Call("PUT", _domain(name), model(Domain), headers=JSON, body=json_body(document))


def delete_domain(name: str) -> Call[None]:
    """Remove a domain with all its maps and traverses."""
    return Call("DELETE", _domain(name), nothing, gone_is_done=True)


def create_traverse(domain: str, name: str) -> Call[Traverse]:
    """Make an empty traverse."""
    name_in_path("traverse", name)
    return Call(
        "POST",
        f"{_domain(domain)}/traverses",
        model(Traverse),
        headers=JSON,
        body=json_body({"name": name}),
        repeat=Repeat.IF_UNTOUCHED,
    )


def traverses(domain: str) -> Call[tuple[Traverse, ...]]:
    """Every traverse of a domain."""
    return Call("GET", f"{_domain(domain)}/traverses", models(Traverse, "traverses"))


def traverse(domain: str, name: str) -> Call[Traverse]:
    """One traverse: what has arrived and what is missing."""
    return Call("GET", _traverse(domain, name), model(Traverse))


def delete_traverse(domain: str, name: str) -> Call[None]:
    """Remove a traverse and its frames."""
    return Call("DELETE", _traverse(domain, name), nothing, gone_is_done=True)


def put_frame(
    domain: str,
    traverse: str,
    index: int,
    seen: Observation,
    *,
    position_m: float,
    timestamp_us: int | None,
    x_m: float | None,
    y_m: float | None,
) -> Call[FrameStored]:
    """Send one frame; the same index again replaces it."""
    return Call(
        "PUT",
        f"{_traverse(domain, traverse)}/frames/{int(index)}",
        model(FrameStored),
        params=query(position_m=position_m, timestamp_us=timestamp_us, x_m=x_m, y_m=y_m),
        headers={"Content-Type": seen.content_type},
        body=seen.body,
    )


def put_frames(
    domain: str,
    traverse: str,
    *,
    encodings: "ArrayLike",
    index: "ArrayLike",
    position_m: "ArrayLike",
    timestamp_us: "ArrayLike | None",
    x_m: "ArrayLike | None",
    y_m: "ArrayLike | None",
) -> Call[FramesStored]:
    """Send a batch of frames whose encodings [n, d] are known; the same indices again replace them.

    Raises:
        MissingExtraError: numpy is not installed.
    """
    np = require_numpy()
    arrays = {
        "encodings": np.asarray(encodings, np.float32),
        "index": np.asarray(index, np.int64),
        "position_m": np.asarray(position_m, np.float64),
    }
    if timestamp_us is not None:
        arrays["timestamp_us"] = np.asarray(timestamp_us, np.int64)
    if x_m is not None and y_m is not None:
        arrays["x_m"] = np.asarray(x_m, np.float64)
        arrays["y_m"] = np.asarray(y_m, np.float64)
    packed = BytesIO()
    np.savez(packed, **arrays)
    return Call(
        "POST",
        f"{_traverse(domain, traverse)}/frames",
        model(FramesStored),
        headers={"Content-Type": "application/octet-stream"},
        body=packed.getvalue(),
    )


def remap(domain: str, config: Mapping[str, Any]) -> Call[Job]:
    """Ask for a new map; a second request would be a second job, so it is sent again only when surely unseen."""
    return Call(
        "POST",
        f"{_domain(domain)}/remaps",
        model(Job),
        headers=JSON,
        body=json_body(config),
        repeat=Repeat.IF_UNTOUCHED,
    )


def feed_experience(domain: str, session_id: str, true_positions_m: Numbers) -> Call[Job]:
    """Feed back where a session's robot truly was, None or NaN where unknown; a second request would be a second job.

    Raises:
        InvalidArgumentError: A position is infinite or no number.
    """
    plain = true_positions_m.tolist() if hasattr(true_positions_m, "tolist") else list(true_positions_m)
    known = [None if isinstance(each, float) and math.isnan(each) else each for each in plain]
    return Call(
        "POST",
        f"{_domain(domain)}/experience",
        model(Job),
        headers=JSON,
        body=json_body({"session_id": session_id, "true_positions_m": known}),
        repeat=Repeat.IF_UNTOUCHED,
    )


def jobs(domain: str | None) -> Call[tuple[Job, ...]]:
    """Jobs, newest first, of one domain or all."""
    return Call("GET", JOBS, models(Job, "jobs"), params=query(domain=domain))


def job(job_id: str) -> Call[Job]:
    """One job."""
    return Call("GET", _job(job_id), model(Job))


def job_events(job_id: str) -> Call[None]:
    """The stream of a job's progress; whoever follows a job decides when to listen again."""
    return Call("GET", f"{_job(job_id)}/events", nothing, headers={"Accept": EVENT_STREAM}, repeat=Repeat.NEVER)


def cancel_job(job_id: str) -> Call[None]:
    """Ask a job to stop."""
    return Call("DELETE", _job(job_id), nothing)


def maps(domain: str) -> Call[tuple[MapVersion, ...]]:
    """A domain's history of maps."""
    return Call("GET", f"{_domain(domain)}/maps", models(MapVersion, "maps"))


def activate(domain: str, version: int, expected: int | None) -> Call[MapVersion]:
    """Serve another version, if the active one is still the `expected` one.

    Sent again only when surely unseen: after a lost answer a repetition would report its own success as a lost race.
    """
    document = json_body({"version": int(version)})
    if expected is not None:
        document = json_body({"version": int(version), "expected": int(expected)})
    return Call(
        "PUT",
        f"{_domain(domain)}/active-map",
        model(MapVersion),
        headers=JSON,
        body=document,
        repeat=Repeat.IF_UNTOUCHED if expected is not None else Repeat.ALWAYS,
    )


def _domain(name: str) -> str:
    return f"{DOMAINS}/{name_in_path('domain', name)}"


def _traverse(domain: str, name: str) -> str:
    return f"{_domain(domain)}/traverses/{name_in_path('traverse', name)}"


def _job(job_id: str) -> str:
    return f"{JOBS}/{name_in_path('job', job_id)}"
