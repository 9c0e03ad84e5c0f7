"""The JSON bodies of a session's calls."""

from typing import Annotated

from pydantic import FailFast, Field, StrictFloat

from deepsimbad.api.bodies import GREATEST_EXACT_INTEGER, JsonBody, Name
from deepsimbad.core.filters import FilterKind
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.engine.session_config import DEFAULT_START_STD_M, SessionConfig

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


class TruthsBody(JsonBody):
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


class ExperienceBody(TruthsBody):
    """Where the robot of a session truly was."""

    session_id: Name


DECLARED_SESSION_BODIES: tuple[type[JsonBody], ...] = (SessionBody, PriorBody, TruthsBody, ExperienceBody)
