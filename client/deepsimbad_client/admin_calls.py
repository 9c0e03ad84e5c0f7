"""The calls that make and fill domains; they need a key of scope `admin`, as those of `map_calls`."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

from deepsimbad_client.answers import model, nothing, page, require_numpy
from deepsimbad_client.call import JSON, Call, json_body, name_in_path, query
from deepsimbad_client.models import Domain, FramesStored, FrameStored, Traverse
from deepsimbad_client.observation import Observation
from deepsimbad_client.page import PAGE_LENGTH, Page

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

DOMAINS = "/v1/admin/domains"


def put_domain(
    name: str, evaluator: Mapping[str, Any], closed: bool, actions_m: Sequence[float] | None
) -> Call[Domain]:
    """Make a domain, or find that it is there already as described."""
    document = {
        "evaluator": dict(evaluator),
        "closed": closed,
        "actions_m": None if actions_m is None else [float(action) for action in actions_m],
    }
    return Call("PUT", domain_path(name), model(Domain), headers=JSON, body=json_body(document))


def delete_domain(name: str) -> Call[None]:
    """Remove a domain with all its maps and traverses."""
    return Call("DELETE", domain_path(name), nothing, gone_is_done=True)


def create_traverse(domain: str, name: str) -> Call[Traverse]:
    """Make an empty traverse; one of that name that is there stays as it is."""
    name_in_path("traverse", name)
    return Call(
        "POST",
        f"{domain_path(domain)}/traverses",
        model(Traverse),
        headers=JSON,
        body=json_body({"name": name}),
    )


def traverses(domain: str, after: str | None) -> Call[Page[Traverse]]:
    """A page of a domain's traverses, by name."""
    return Call(
        "GET",
        f"{domain_path(domain)}/traverses",
        page(Traverse, "traverses"),
        params=query(limit=PAGE_LENGTH, after=after),
    )


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


def domain_path(name: str) -> str:
    """Where the admin calls of a domain begin."""
    return f"{DOMAINS}/{name_in_path('domain', name)}"


def _traverse(domain: str, name: str) -> str:
    return f"{domain_path(domain)}/traverses/{name_in_path('traverse', name)}"
