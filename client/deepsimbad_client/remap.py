"""Map a domain anew: submit the job and follow it to its end."""

from collections.abc import Callable
from typing import Any

from deepsimbad_client.client import Client
from deepsimbad_client.follow import PATIENCE_S, follow_job
from deepsimbad_client.models import Job


def remap(
    client: Client,
    domain: str,
    training_traverse: str,
    *,
    landmark_traverse: str | None = None,
    n_landmarks: int | None = None,
    list_length: int | None = None,
    relevance: str | None = None,
    training_episodes: int | None = None,
    seed: int | None = None,
    activate: bool | None = None,
    check_traverse: str | None = None,
    gate_margin: float | None = None,
    append: bool | None = None,
    same_route: bool | None = None,
    on_progress: Callable[[Job], None] | None = None,
    patience_s: float = PATIENCE_S,
) -> Job:
    """Make a new map of a domain and wait for it; what is None is left to the service's default.

    Args:
        client: The client.
        domain: The domain to map.
        training_traverse: The traverse that becomes the map.
        landmark_traverse: Where landmarks are chosen; None: the active map's landmarks stay.
        n_landmarks: r, how many landmarks.
        list_length: h, how many of them a map image keeps.
        relevance: How a map image is compared with a query.
        training_episodes: Length of the planner's training.
        seed: Seed of whatever is random.
        activate: Whether the new map serves at once.
        check_traverse: The drive that the new map and the active one are compared on.
        gate_margin: By how many percentage points of ANR the new map may be worse and still be activated.
        append: Whether the traverse is added to a copy of the active map.
        same_route: Whether the training and the landmark traverse count their positions along one route; None: only
            where both know x, y. `metrics["second_season"]` of the result says whether the map learnt from both.
        on_progress: Told of the job each time something is heard of it; first when it is submitted.
        patience_s: Longest silence of the service that is waited out.

    Returns:
        The job, succeeded; its `result` holds `map_version`, `active` and `metrics`. Where the new map lost against the
        active one by more than the gate's margin, `active` is false and `check["why"]` says so.

    Raises:
        JobFailedError: The service could not make the map.
        ApiError: The service refused the request.
        TransportError: Nothing was heard for `patience_s`.
    """
    job = client.admin.remap(
        domain,
        **_given(
            training_traverse=training_traverse,
            landmark_traverse=landmark_traverse,
            n_landmarks=n_landmarks,
            list_length=list_length,
            relevance=relevance,
            training_episodes=training_episodes,
            seed=seed,
            activate=activate,
            check_traverse=check_traverse,
            gate_margin=gate_margin,
            append=append,
            same_route=same_route,
        ),
    )
    if on_progress is not None:
        on_progress(job)
    return follow_job(client, job.job_id, on_progress, patience_s=patience_s)


def _given(**config: Any) -> dict[str, Any]:
    return {key: value for key, value in config.items() if value is not None}
