"""What the service answers. Every field is always present; what is not known is null."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Next = Annotated[str | None, Field(description="Ask for the list `after` this for its next page; null: it ends here.")]
Timings = Annotated[
    dict[str, float],
    Field(
        description="Milliseconds by stage: `receive` (the body), `wait` (for its turn and the worker), `decode`, "
        "`describe`, `retrieve`, ..., `commit` (to the disk); and their `total`, with what is in no stage."
    ),
]
IndexRange = Annotated[tuple[int, int], Field(description="First and last index of a gap, both inside it.")]


class Answer(BaseModel):
    """Root of the answers."""

    model_config = ConfigDict(frozen=True)


class Problem(BaseModel):
    """An error, as RFC 9457 problem details. Further members hold what helps: limits, allowed values."""

    model_config = ConfigDict(extra="allow")

    type: Annotated[str, Field(description="`urn:deepsimbad:problem:` and the code.")]
    title: Annotated[str, Field(description="One sentence on this kind of problem.")]
    status: Annotated[int, Field(description="The HTTP status.", ge=400, le=599)]
    detail: Annotated[str, Field(description="One sentence on this occurrence.")]
    instance: Annotated[str, Field(description="The path that was asked.")]
    code: Annotated[str, Field(description="A stable word that scripts may test.", pattern="^[a-z0-9_]+$")]
    request_id: Annotated[str | None, Field(description="By which the server's log can be searched.")]


class Health(Answer):
    """The process lives."""

    status: Literal["alive"]


class Readiness(Answer):
    """The service answers queries."""

    status: Literal["ready"]
    damaged_maps: Annotated[
        list[str], Field(description="Domains whose active map cannot be loaded; all others are served.")
    ]


class DomainAnswer(Answer):
    """A domain and its active map; the map's members are null while it has none or it is damaged."""

    name: str
    evaluator: Annotated[dict[str, Any], Field(description="Its `kind` and options, defaults filled in.")]
    evaluator_problem: Annotated[
        str | None, Field(description="Code of what keeps the extractor from being loaded; images are then a 503.")
    ]
    input_size: Annotated[
        tuple[int, int] | None,
        Field(
            description="[width, height] in pixels to resize an image to; null: images are taken as they are, or not "
            "at all where `encoding_dim` is null too."
        ),
    ]
    encoding_dim: Annotated[
        int | None,
        Field(
            description="Length of an image's encoding; null: no images are taken. Ready ones may have any one length."
        ),
    ]
    weights_sha256: Annotated[
        str | None, Field(description="SHA-256 of the file of weights that images are encoded by; null: of none.")
    ]
    closed: Annotated[bool, Field(description="Whether the end of the route joins its start.")]
    actions_m: Annotated[list[float], Field(description="The moves a planner may choose, in metres.")]
    created_at: str
    map_version: Annotated[int | None, Field(description="The active one.")]
    map_problem: Annotated[str | None, Field(description="Code of what keeps the active map from answering.")]
    relevance: str | None
    route_length_m: float | None
    n_map_images: int | None
    n_landmarks: int | None
    list_length: int | None
    index_bits_per_map_image: float | None
    landmark_model_digest: Annotated[
        str | None, Field(description="SHA-256 of the landmarks that a robot may rank itself: see `landmark-model`.")
    ]


class DomainList(Answer):
    """All domains, by name."""

    domains: list[DomainAnswer]


class HistogramAnswer(Answer):
    """The belief in equal bins along the whole route, at most 200 of them whatever the number of map images."""

    edges_m: Annotated[list[float], Field(description="One longer than `mass`.", min_length=2, max_length=201)]
    mass: Annotated[list[float], Field(description="Sums to 1.", min_length=1, max_length=200)]


class PlaceAnswer(Answer):
    """A map image that the belief favours."""

    map_image: int
    route_position_m: float
    x_m: float | None
    y_m: float | None
    mass: float


class BeliefAnswer(Answer):
    """Where on the route the robot probably is."""

    mean_m: float
    mode_m: Annotated[float, Field(description="Position of the likeliest map image.")]
    std_m: float
    credible_95_m: Annotated[
        tuple[float, float],
        Field(description="Shortest stretch with 95 % of the mass; lo > hi crosses a closed route's start."),
    ]
    entropy_bits: Annotated[float, Field(description="Over map images.", ge=0)]
    off_route: Annotated[
        float | None, Field(description="Probability that the robot is nowhere on the route; null: unknown.")
    ]
    histogram: HistogramAnswer
    top: Annotated[list[PlaceAnswer], Field(description="Likeliest map images, best first.")]


class RetrievedAnswer(Answer):
    """A map image and how well it answers the view."""

    map_image: int
    route_position_m: float
    relevance: Annotated[float, Field(description="Larger is better.")]


class ActionAnswer(Answer):
    """What the experience database expects of a move."""

    action_m: float
    q_value: float | None


class NextBestViewAnswer(Answer):
    """The move that would tell most."""

    planner: str
    action_m: float
    actions: list[ActionAnswer]


class LocalizationAnswer(Answer):
    """Where one view places the robot, from a uniform prior."""

    map_version: int
    timings_ms: Timings
    belief: BeliefAnswer
    retrieval: Annotated[list[RetrievedAnswer], Field(description="Most relevant map images, best first.")]
    next_best_view: Annotated[NextBestViewAnswer | None, Field(description="null until the map was trained for it.")]


class TraverseAnswer(Answer):
    """A recorded drive and what of it has arrived."""

    name: str
    n_frames: int
    missing: Annotated[list[IndexRange], Field(description="Gaps below the greatest index that has arrived.")]


class TraverseList(Answer):
    """The traverses of a domain, by name."""

    traverses: list[TraverseAnswer]
    next: Next


class FrameAnswer(Answer):
    """A frame has been stored."""

    index: int
    n_frames: Annotated[int, Field(description="Of the traverse, now.")]


class BatchAnswer(Answer):
    """A batch of frames has been stored, all or none."""

    n_new: int
    n_replaced: int
    n_frames: Annotated[int, Field(description="Of the traverse, now.")]


class JobResult(Answer):
    """What a remap made."""

    map_version: int
    active: bool
    metrics: dict[str, Any]


class JobError(Answer):
    """Why a job failed."""

    code: str
    detail: str


class JobAnswer(Answer):
    """A job on its way, or ended."""

    job_id: str
    domain: str
    kind: str
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    stage: str | None
    progress: Annotated[float, Field(ge=0, le=1)]
    eta_s: float | None
    result: JobResult | None
    error: JobError | None
    config: dict[str, Any]
    created_at: str
    started_at: str | None
    finished_at: str | None


class JobList(Answer):
    """Jobs, newest first."""

    jobs: list[JobAnswer]
    next: Next


class MapAnswer(Answer):
    """One version in a domain's history."""

    version: int
    state: Literal["building", "sealed", "active", "retired"]
    created_at: str
    activated_at: Annotated[str | None, Field(description="When it last began to serve.")]
    retired_at: Annotated[str | None, Field(description="When it last ceased to serve.")]
    removed_at: Annotated[str | None, Field(description="When its file was removed; it cannot serve again.")]
    sha256: str | None
    file_bytes: int | None
    config: dict[str, Any]
    metrics: dict[str, Any]


class MapList(Answer):
    """The versions of a domain's map, newest first."""

    maps: list[MapAnswer]
    next: Next
