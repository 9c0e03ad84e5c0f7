"""The calls a robot makes: health, domains, localizations. See `admin_calls` for those that change a domain."""

from typing import TYPE_CHECKING

from deepsimbad_client.answers import float_array, model, models, on_board_encoder, text
from deepsimbad_client.call import Call, name_in_path, query
from deepsimbad_client.models import Domain, Health, Localization
from deepsimbad_client.observation import Observation
from deepsimbad_client.retry import Repeat

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad_client.on_board import OnBoardEncoder


def health() -> Call[Health]:
    """Is the process alive."""
    return Call("GET", "/healthz", model(Health))


def ready() -> Call[Health]:
    """Can it answer now; its 503 is the answer, so it is never asked again on its own."""
    return Call("GET", "/readyz", model(Health), repeat=Repeat.NEVER)


def metrics() -> Call[str]:
    """What Prometheus would scrape."""
    return Call("GET", "/metrics", text)


def domains() -> Call[tuple[Domain, ...]]:
    """Every domain."""
    return Call("GET", "/v1/domains", models(Domain, "domains"))


def domain(name: str) -> Call[Domain]:
    """One domain."""
    return Call("GET", f"/v1/domains/{name_in_path('domain', name)}", model(Domain))


def landmark_model(domain: str, map_version: int | None) -> "Call[OnBoardEncoder]":
    """The landmarks of a map, ready to rank by; raises MissingExtraError before anything is sent."""
    return Call(
        "GET",
        f"/v1/domains/{name_in_path('domain', domain)}/landmark-model",
        on_board_encoder(),
        params=query(map_version=map_version),
        headers={"Accept": "application/octet-stream"},
    )


def localize(domain: str, seen: Observation, *, shortlist: int | None) -> Call[Localization]:
    """Where one view probably is; stateless, so it may be asked again."""
    return Call(
        "POST",
        f"/v1/domains/{name_in_path('domain', domain)}/localizations",
        model(Localization),
        params=query(shortlist=shortlist),
        headers={**seen.headers, "Accept": "application/json"},
        body=seen.body,
    )


def relevances(domain: str, seen: Observation) -> "Call[NDArray[np.float32]]":
    """How well every map image answers one view: [n] float32, larger is better."""
    return Call(
        "POST",
        f"/v1/domains/{name_in_path('domain', domain)}/localizations",
        float_array,
        headers={**seen.headers, "Accept": "application/octet-stream"},
        body=seen.body,
    )
