"""What the service answers, as frozen pydantic models.

Fields the contract adds later are kept (`extra="allow"`), states are plain words rather than enums, and values that
may be unknown are None: a client of this version goes on reading what a newer service says.
"""

from contextlib import suppress
from typing import Any, Self

from pydantic import BaseModel, ConfigDict

ENDED_STATES = frozenset({"succeeded", "failed", "cancelled"})


class Answer(BaseModel):
    """Root of the answers."""

    model_config = ConfigDict(frozen=True, extra="allow")
    __slots__ = ("_request_id",)  # beside the fields: it is neither compared nor dumped

    @property
    def request_id(self) -> str | None:
        """The id of this answer's request in the service's log; None in a stream of events."""
        with suppress(AttributeError):
            request_id: str | None = object.__getattribute__(self, "_request_id")
            return request_id
        return None

    def answering(self, request_id: str | None) -> Self:
        """Set `request_id` and return this answer."""
        object.__setattr__(self, "_request_id", request_id)
        return self


class Health(Answer):
    """`GET /healthz` and `/readyz`."""

    status: str


class Domain(Answer):
    """One domain and its active map; the map's figures are None while it has none."""

    name: str
    map_version: int | None = None
    map_problem: str | None = None  # Code of what keeps the active map from answering; its figures are None then
    route_length_m: float | None = None
    n_map_images: int | None = None
    n_landmarks: int | None = None
    list_length: int | None = None
    evaluator: str | dict[str, Any] | None = None
    input_size: tuple[int, int] | None = None
    """(width, height) an image is best resized to before it is sent; None: as it is, or no images at all."""
    grey_levels: tuple[int, int] | None = None
    """Levels shown as black and white in views of more than 8 bits, as in the map's pictures; None: those had 8."""
    takes: tuple[str, ...] = ("image",)
    encoding_dim: int | None = None
    """Length of an image's encoding; None: no images are taken. Ready ones may have any one length."""
    relevance: str | None = None
    index_bits_per_map_image: float | None = None
    landmark_model_digest: str | None = None  # SHA-256 of the landmarks that `Client.on_board` fetches
    actions_m: tuple[float, ...] = ()
    closed: bool = False
    anchor: dict[str, float] | None = None  # where x = y = 0 is on Earth: lat_deg, lon_deg, bearing_deg, height_m


class Histogram(Answer):
    """Belief mass in equal stretches of the route."""

    edges_m: tuple[float, ...]  # One longer than `mass`
    mass: tuple[float, ...]


class Place(Answer):
    """A map image the belief favours."""

    map_image: int
    frame: str | None = None  # what the map image is called in its recording
    route_position_m: float
    x_m: float | None = None
    y_m: float | None = None
    mass: float


class Belief(Answer):
    """Where on the route the robot probably is."""

    mean_m: float
    mode_m: float
    std_m: float
    credible_95_m: tuple[float, float]  # (lo, hi), hull of the sets; on a closed route lo > hi crosses the start
    credible_95_sets_m: tuple[tuple[float, float], ...] = ()  # pieces of the smallest set that holds 95 %
    entropy_bits: float
    off_route: float | None = None  # probability to be lost: off the route, or carried along it
    confident: bool = False  # whether enough of the mass is within 5 m of the mode
    histogram: Histogram
    top: tuple[Place, ...]


class Retrieved(Answer):
    """A map image and how well it answers the query; larger is better."""

    map_image: int
    frame: str | None = None  # as in `Place`
    route_position_m: float
    relevance: float


class ActionValue(Answer):
    """The value that the planner expects of one move."""

    action_m: float
    q_value: float | None = None
    expected_bits: float | None = None  # of information in the view after the move


class NextBestView(Answer):
    """The move that would tell the robot most."""

    planner: str
    action_m: float
    stop: bool = False  # the robot is as sure of its place as its session asked to be
    actions: tuple[ActionValue, ...] = ()


class Localization(Answer):
    """The answer to one view, best first."""

    map_version: int
    timings_ms: dict[str, float]
    belief: Belief
    informative: bool = True  # whether the view told anything
    warnings: tuple[str, ...] = ()  # what a person should know, in sentences
    retrieval: tuple[Retrieved, ...]
    next_best_view: NextBestView | None = None


class LikelyDomain(Answer):
    """A domain that the robot may be on, with the answer of a `Localization` if it is."""

    domain: str
    map_version: int
    probability: float  # that the robot is on this route
    log_evidence: float  # by how much likelier the view is here than elsewhere, as a natural logarithm
    belief: Belief
    informative: bool = True  # whether the view told anything
    retrieval: tuple[Retrieved, ...]
    next_best_view: NextBestView | None = None


class LikelyPlace(Place):
    """A map image of a domain; `mass` is of all domains together."""

    domain: str


class OtherDomains(Answer):
    """The domains that answered but are not listed."""

    n_domains: int
    probability: float  # of all of them together


class LeftOutDomain(Answer):
    """A domain that could not answer."""

    domain: str
    code: str  # of the error that its own localizations would have
    detail: str


class Whereabouts(Answer):
    """The answer to one view of many domains, best first."""

    timings_ms: dict[str, float]
    domains: tuple[LikelyDomain, ...]
    others: OtherDomains
    elsewhere: float  # probability that it is none of them
    top: tuple[LikelyPlace, ...]
    informative: bool = True
    warnings: tuple[str, ...] = ()  # what a person should know, in sentences
    left_out: tuple[LeftOutDomain, ...] = ()  # a hundred at most
    n_left_out: int = 0


class Stretch(Answer):
    """A part of a route where views are placed rightly less often than elsewhere."""

    from_m: float
    to_m: float
    chance: float
    worst_map_image: int
    worst_frame: str | None = None


class Coverage(Answer):
    """`GET /v1/domains/{domain}/coverage`: how surely every map image's place is recognised; columns in route order."""

    map_version: int
    within_m: float
    basis: str | None
    stretches: tuple[Stretch, ...]  # worst first
    route_position_m: tuple[float, ...]
    chance: tuple[float | None, ...] | None


class Landmarks(Answer):
    """`GET /v1/domains/{domain}/landmarks`: the frame that each landmark began as; columns in landmark order."""

    map_version: int
    n_map_images: tuple[int, ...]  # that list the landmark
    map_image: tuple[int | None, ...]  # made of the frame that the landmark began as
    frame: tuple[str | None, ...]
    drive: tuple[str | None, ...]


class SessionState(Answer):
    """A live session between two observations."""

    session_id: str
    domain: str
    map_version: int
    n_observations: int
    expires_at: str | float | None = None
    belief: Belief
    next_best_view: NextBestView | None = None


class SessionAnswer(Localization):
    """The answer to one observation of a session: the belief over all its views so far, and the move to make next."""

    n_observations: int | None = None
    retrieval: tuple[Retrieved, ...] = ()


class ListedSession(Answer):
    """A living session in a list, without its belief."""

    session_id: str
    domain: str
    map_version: int
    n_observations: int
    key_id: str | None = None
    created_at: str | None = None
    expires_at: str | float | None = None


class TruthScore(Answer):
    """How well a session knew where its robot was, by true positions sent later."""

    n_scored: int
    n_left_out: int
    anr: float | None = None
    """Averaged normalised rank in percent, 0 is perfect, 50 chance; None where no truth is known."""
    retrieval_ranks: tuple[float | None, ...] | None = None
    """Rank, from 0, of the best true map image by each view alone; None where no true map image was given."""
    map_version: int


class Traverse(Answer):
    """One recorded drive as the service holds it."""

    name: str
    n_frames: int = 0
    missing: tuple[tuple[int, int], ...] = ()
    """(first, last) ranges of indices that have not arrived, below the greatest that has."""
    length_m: float | None = None  # from the least position to the greatest
    span_us: tuple[int, int] | None = None  # first and last known time of a frame
    cameras: tuple[dict[str, Any], ...] = ()  # name, width, height, aspect_ratio, orientation; of most frames first
    warnings: tuple[str, ...] = ()  # what a person should know of its pictures, in sentences
    digest: str | None = None  # SHA-256 over indices, contents, places and times; one drive, one digest
    n_uninformative: int = 0  # frames whose pictures show nothing, or seem to, being so unlike all others
    n_spooled: int = 0  # pictures that wait for the domain's evaluator to be fitted
    spooled_bytes: int = 0
    grey_levels: tuple[int, int] | None = None
    """Levels shown as black and white in pictures of more than 8 bits; None: none came."""


class FrameStored(Answer):
    """One frame has arrived."""

    index: int
    n_frames: int


class FramesStored(Answer):
    """A batch of frames has arrived."""

    n_new: int
    n_replaced: int
    n_frames: int


class Job(Answer):
    """A job that makes a map, under way or ended."""

    job_id: str
    domain: str
    state: str
    stage: str | None = None
    progress: float = 0.0
    eta_s: float | None = None
    result: dict[str, Any] | None = None
    error: str | dict[str, Any] | None = None
    created_at: str | None = None
    finished_at: str | None = None

    @property
    def stage_name(self) -> str:
        """The present stage in words; the state where no stage is known yet."""
        return (self.stage or ("beginning" if self.state == "running" else self.state)).replace("_", " ")

    @property
    def ended(self) -> bool:
        """Whether the job succeeded, failed or was cancelled."""
        return self.state in ENDED_STATES

    @property
    def check(self) -> dict[str, Any]:
        """How the new map compares with the one active before; empty where they were not compared."""
        return _subdocument(self.result, "metrics", "check")

    @property
    def warnings(self) -> list[str]:
        """What a person should know of the job's drives, in sentences."""
        return [*_subdocument(self.result, "metrics").get("warnings", ()), *self.check.get("warnings", ())]

    @property
    def second_season(self) -> dict[str, Any]:
        """Whether the map learnt from a second drive of the route, and why not; empty where there was none."""
        return _subdocument(self.result, "metrics", "second_season")

    @property
    def error_text(self) -> str:
        """What went wrong, in the service's words; "" when nothing did."""
        if isinstance(self.error, dict):
            words = (self.error.get(key) for key in ("detail", "message", "title", "code"))
            return str(next(filter(None, words), self.error))
        return self.error or ""


class MapVersion(Answer):
    """One map in a domain's history; what a service of an older release does not say is None."""

    version: int
    state: str | None = None  # building, sealed (never served), active or retired
    created_at: str | None = None
    activated_at: str | None = None  # When it last began to serve
    retired_at: str | None = None  # When it last ceased to
    removed_at: str | None = None  # When its file was removed; it cannot be served any more
    sha256: str | None = None
    file_bytes: int | None = None
    config: dict[str, Any] | None = None
    metrics: dict[str, Any] | None = None

    @property
    def check(self) -> dict[str, Any]:
        """How it compares with the map that was active when it was made; empty where they were not compared."""
        return _subdocument(self.metrics, "check")


def _subdocument(document: Any, *names: str) -> dict[str, Any]:
    """The mapping under the keys `names` of a nested document; empty where there is none."""
    for name in names:
        document = document.get(name) if isinstance(document, dict) else None
    return document if isinstance(document, dict) else {}
