"""The steps of a replay as lines of JSON, appended as they come and read again when it goes on."""

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from deepsimbad_client.journal import Journal


@dataclass(frozen=True)
class Step:
    """One query of a replay and what came back.

    Attributes:
        query: Place among the replayed frames, from 0.
        index: Place in the whole recording.
        name: The frame's name.
        position_m: True distance along the query's own route.
        x_m: True place; None where unknown.
        y_m: True place; None where unknown.
        broken: Why the frame could not be asked; None when it was.
        n_true: Map images that are right answers.
        rank: Images placed before the best right answer, ties half; None without a right answer.
        rank_percent: `rank` in percent of the map's images.
        best_map_image: The most relevant map image.
        best_position_m: Where it lies along the route.
        best_x_m: Where it lies in the plane.
        best_y_m: Where it lies in the plane.
        best_relevance: Its relevance.
        true_relevance: The relevance of the best right answer.
        error_m: Distance from the truth to the most relevant map image.
        latency_ms: Time from asking to answer, preparation of the image left out.
    """

    query: int
    index: int
    name: str
    position_m: float
    x_m: float | None
    y_m: float | None
    broken: str | None = None
    n_true: int | None = None
    rank: float | None = None
    rank_percent: float | None = None
    best_map_image: int | None = None
    best_position_m: float | None = None
    best_x_m: float | None = None
    best_y_m: float | None = None
    best_relevance: float | None = None
    true_relevance: float | None = None
    error_m: float | None = None
    latency_ms: float | None = None


_FIELDS = frozenset(field.name for field in fields(Step))


class StepLog:
    """A passive replay's folder: `replay.json` says what is replayed, `steps.jsonl` what came back so far.

    Args:
        folder: Made when it does not exist.
        identity: What must be the same for the replay to go on.
        restart: Throw away what an earlier replay left.

    Raises:
        ReplayError: The folder holds another replay, or cannot be written.
    """

    def __init__(self, folder: Path, identity: dict[str, Any], *, restart: bool = False) -> None:
        self._journal = Journal(folder, "steps.jsonl", identity, _step, "step", restart=restart)
        self.done = {step.query: step for step in self._journal.earlier}

    def append(self, step: Step) -> None:
        """Write a step down; it is in the hands of the operating system when this returns."""
        self._journal.append(asdict(step))
        self.done[step.query] = step

    def steps(self) -> list[Step]:
        """Every step so far, in order."""
        return [self.done[query] for query in sorted(self.done)]

    def close(self) -> None:
        """Close the file."""
        self._journal.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def _step(document: dict[str, Any]) -> Step:
    return Step(**{key: value for key, value in document.items() if key in _FIELDS})
