"""What the calls of a session answer."""

from typing import Annotated

from pydantic import Field

from deepsimbad.api.schemas import Answer, BeliefAnswer, Next, NextBestViewAnswer, RetrievedAnswer, Timings


class SessionAnswer(Answer):
    """A session as it stands."""

    session_id: str
    domain: str
    map_version: Annotated[int, Field(description="The map it began on and keeps.")]
    n_observations: Annotated[int, Field(description="Views that its belief rests on.")]
    expires_at: Annotated[str, Field(description="When it ends unless something happens to it; ISO 8601, UTC.")]
    belief: BeliefAnswer
    next_best_view: Annotated[NextBestViewAnswer | None, Field(description="null where the map can name none.")]


class ObservationAnswer(SessionAnswer):
    """A session after one more observation."""

    timings_ms: Timings
    retrieval: Annotated[list[RetrievedAnswer], Field(description="Map images most relevant to this view, best first.")]


class ListedSessionAnswer(Answer):
    """A session in a list, without its belief."""

    session_id: str
    domain: str
    map_version: Annotated[int, Field(description="The map it began on and keeps.")]
    n_observations: Annotated[int, Field(description="Views that were told.")]
    created_at: Annotated[str, Field(description="ISO 8601, UTC.")]
    expires_at: Annotated[str, Field(description="When it ends unless something happens to it; ISO 8601, UTC.")]


class SessionList(Answer):
    """Living sessions, newest first."""

    sessions: list[ListedSessionAnswer]
    next: Next


class TruthsAnswer(Answer):
    """How well a session knew where its robot was."""

    n_scored: Annotated[int, Field(description="Observations whose true position is known.", ge=0)]
    n_left_out: Annotated[int, Field(description="Observations whose true position is unknown.", ge=0)]
    anr: Annotated[
        float | None,
        Field(
            description="Averaged normalised rank of the true map image in the belief, in percent: 0 is perfect, 50 "
            "chance; null where no true position is known.",
            ge=0,
            le=100,
        ),
    ]
    retrieval_ranks: Annotated[
        list[float | None] | None,
        Field(
            description="For each observation told of, how many map images its own view placed before the best of its "
            "`true_map_images`, others tied with that one counted half; null where there is none, null for all where "
            "none were told."
        ),
    ]
    map_version: Annotated[int, Field(description="The map that the session is pinned to.")]
