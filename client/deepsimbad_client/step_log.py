"""The steps of a replay as lines of JSON, appended as they come and read again when it goes on."""

import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from deepsimbad_client.errors import ReplayError


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
    """A replay's folder: `replay.json` says what is replayed, `steps.jsonl` what came back so far.

    Args:
        folder: Made when it does not exist.
        identity: What must be the same for the replay to go on.
        restart: Throw away what an earlier replay left.

    Raises:
        ReplayError: The folder holds another replay, or cannot be written.
    """

    def __init__(self, folder: Path, identity: dict[str, Any], *, restart: bool = False) -> None:
        self.folder = folder
        self._steps_file = folder / "steps.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.done = self._resume(identity, restart)
            self._stream = self._steps_file.open("ab")
        except OSError as error:
            raise ReplayError(f"cannot write to {folder}: {error.strerror or error}") from error

    def append(self, step: Step) -> None:
        """Write a step down; it is in the hands of the operating system when this returns."""
        self._stream.write(json.dumps(asdict(step), allow_nan=False).encode() + b"\n")
        self._stream.flush()
        self.done[step.query] = step

    def steps(self) -> list[Step]:
        """Every step so far, in order."""
        return [self.done[query] for query in sorted(self.done)]

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _resume(self, identity: dict[str, Any], restart: bool) -> dict[int, Step]:
        identity_file = self.folder / "replay.json"
        if not restart and identity_file.exists():
            earlier = _document(identity_file)
            differing = [key for key in identity if earlier.get(key) != identity[key]]
            if differing:
                was = ", ".join(f"{key} {earlier.get(key)!r}, now {identity[key]!r}" for key in differing)
                raise ReplayError(
                    f"{self.folder} holds another replay ({was}): name another folder, or restart this one"
                )
            return self._read()
        self._steps_file.unlink(missing_ok=True)
        written = identity_file.with_suffix(".tmp")
        written.write_text(json.dumps(identity, indent=2) + "\n")
        written.replace(identity_file)
        return {}

    def _read(self) -> dict[int, Step]:
        """Read the whole lines; a torn last one, left by a crash, is cut off."""
        if not self._steps_file.exists():
            return {}
        content = self._steps_file.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) != len(content):
            os.truncate(self._steps_file, len(whole))
        done = {}
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                step = Step(**{key: value for key, value in json.loads(line).items() if key in _FIELDS})
            except (ValueError, TypeError, AttributeError) as error:
                raise ReplayError(
                    f"line {number} of {self._steps_file} is no step: restart the replay or repair it"
                ) from error
            done[step.query] = step
        return done


def _document(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty where the file holds none."""
    try:
        document = json.loads(path.read_bytes())
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}
