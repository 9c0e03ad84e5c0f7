"""The JSON bodies of a session's calls."""

from typing import Annotated

from pydantic import FailFast, Field, StrictFloat, StrictInt

from deepsimbad.api.bodies import GREATEST_EXACT_INTEGER, GREATEST_ID, JsonBody, Name
from deepsimbad.core.filters import FilterKind
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.engine.session import DEFAULT_START_STD_M, SessionConfig

MAX_OBSERVATIONS_FED_BACK = 100_000


class SessionBody(JsonBody):
    """How a session begins. NaN and infinity are refused by what knows the route."""

    start_position_m: Annotated[
        StrictFloat | None, Field(description="Where on the route it begins; null: anywhere.")
    ] = None
    start_std_m: Annotated[
        StrictFloat | None, Field(description=f"How sure that is, a standard deviation; null: {DEFAULT_START_STD_M:g}.")
    ] = None
    seed: Annotated[
        Annotated[int, Field(strict=True, ge=0, le=GREATEST_EXACT_INTEGER)] | None,
        Field(description="Of whatever is random in it; null: 0."),
    ] = None
    planner: Annotated[
        Annotated[str, Field(min_length=1, max_length=64)] | None,
        Field(description="Who recommends moves: `telling`, `nnql`, `random`, `constant:<m>`; null: the default."),
    ] = None
    belief: Annotated[FilterKind | None, Field(description="The filter; null: grid.")] = None
    update: Annotated[
        UpdateRule | None, Field(description="How a view counts; null: as the map's relevance wants.")
    ] = None

    def config(self) -> SessionConfig:
        """The engine's form."""
        return SessionConfig(**{name: value for name, value in self if value is not None})


class PriorBody(JsonBody):
    """Where the robot is, from someone who knows."""

    position_m: Annotated[StrictFloat, Field(description="Metres along the route.")]
    std_m: Annotated[StrictFloat, Field(description="Standard deviation, above 0.")]


class TruePositions(JsonBody):
    """Where the robot truly was, known later."""

    true_positions_m: Annotated[
        list[StrictFloat | None],
        Field(
            min_length=1,
            max_length=MAX_OBSERVATIONS_FED_BACK,
            description="One route position for every observation of the session; null where it is unknown, which "
            "takes back nothing told before.",
        ),
        FailFast(),
    ]


class TruthsBody(TruePositions):
    """Where the robot truly was, known later; truths may be told bit by bit."""

    true_map_images: Annotated[
        list[list[Annotated[StrictInt, Field(ge=0, le=GREATEST_ID)]]] | None,
        Field(
            max_length=MAX_OBSERVATIONS_FED_BACK,
            description="For each of the same observations the map images that show its place: each view's own "
            "retrieval is then ranked by them. null: it is not.",
        ),
        FailFast(),
    ] = None
    first_observation: Annotated[
        int,
        Field(strict=True, ge=0, description="The observation, from 0, that the first of the lists belongs to."),
    ] = 0


class ExperienceBody(TruePositions):
    """Where the robot of a session truly was."""

    session_id: Name


DECLARED_SESSION_BODIES: tuple[type[JsonBody], ...] = (SessionBody, PriorBody, TruthsBody, ExperienceBody)
