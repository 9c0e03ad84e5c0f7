"""The scene of a replay, a domain's map, a recording and the truth by core's own rules, and the folder it fills."""

import json
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from deepsimbad.core.route import Route, true_images_of
from deepsimbad_client.errors import (
    BrokenFrameError,
    IdempotencyKeyReusedError,
    InvalidInputError,
    InvalidMoveError,
    ReplayError,
)
from deepsimbad_client.http.client import Client, Session
from deepsimbad_client.http.models import Domain, Localization, SessionAnswer
from deepsimbad_client.http.upload import UNUSABLE_IMAGE_CODES
from deepsimbad_client.recordings import Recording, columns_of
from deepsimbad_client.recordings.annotations import as_taken

Record = TypeVar("Record")

MASS_DIGITS = 5
_IDENTITY_FILE = "replay.json"
DEFAULT_PLANNER = "default"  # the service's default planner


@dataclass(frozen=True)
class ViewOutcome:
    """The service's answer to one view, and how it came about."""

    answer: SessionAnswer
    latency_ms: float  # from posting the view to the answer
    forgot: bool  # the belief had no room for the move and was set back to knowing nothing


class Viewer(Protocol):
    """Shows a replay to people as it goes, one view after another, from one thread at a time."""

    def begin(self, scene: "Scene") -> None:
        """Show the route, which stays."""

    def show(self, row: int, view: Mapping[str, Any], outcome: ViewOutcome) -> None:
        """Show a frame's view, and the belief after it."""


@dataclass(frozen=True)
class Scene:
    """A recording before a domain's active map."""

    client: Client
    domain: Domain  # with an active map
    recording: Recording
    position_m: NDArray[np.float64]  # [m] along the recording's own route
    route: Route  # the map's images
    right_images: list[NDArray[np.int64]]  # for each frame the map images that are right answers
    viewers: Sequence[Viewer] = ()

    @classmethod
    def of(
        cls, client: Client, recording: Recording, domain: str, within_m: float, viewers: Sequence[Viewer] = ()
    ) -> Self:
        """The scene of a recording before a domain's active map, shown to the viewers.

        A right answer is `within_m` of the truth, in the plane where both sides know x and y, else along the route.
        Raises ReplayError (no active map, one that changed meanwhile, or no frame that can be used).
        """
        if not recording.frames:
            raise ReplayError(f"{recording.name} has no frames to replay")
        domain_answer = client.domain(domain)
        recording = as_taken(recording, domain_answer.takes).shown_by(domain_answer.grey_levels)
        if domain_answer.map_version is None or domain_answer.n_map_images is None:
            raise ReplayError(f"domain {domain} has no active map to replay against: remap it first")
        position_m = np.array([frame.position_m for frame in recording.frames], np.float64)
        route = _map_route(client, domain_answer, recording)
        right_images = right_answers(recording, route, within_m)
        scene = cls(client, domain_answer, recording, position_m, route, right_images, viewers)
        for viewer in viewers:
            viewer.begin(scene)
        return scene

    @property
    def identity(self) -> dict[str, Any]:
        """The facts, JSON-ready, that must be the same for a replay to go on."""
        frames = self.recording.frames
        return {
            "domain": self.domain.name,
            "map_version": self.domain.map_version,
            "n_map_images": self.route.n_images,
            "recording": self.recording.name,
            "n_frames": len(frames),
            "first_index": frames[0].index,
            "last_index": frames[-1].index,
        }

    def session(self, planner: str = DEFAULT_PLANNER, seed: int | None = None, *, keep: bool = False) -> Session:
        """Begin a session. Raises ReplayError, ApiError."""
        planner_name = None if planner == DEFAULT_PLANNER else planner
        session = self.client.session(self.domain.name, seed=seed, planner=planner_name, keep=keep)
        if session.map_version != self.domain.map_version:
            session.delete()
            raise changed_map(self.domain.name)
        return session

    def view(self, row: int) -> dict[str, Any] | str:
        """The view of a frame as arguments of `Session.observe`, or the reason why the frame is broken."""
        try:
            return self.recording.view(row, self.domain.input_size)
        except BrokenFrameError as error:
            return error.reason

    def look(
        self,
        session: Session,
        row: int,
        view: dict[str, Any],
        action_m: float | None,
        n_counted: int | None = None,
        **options: Any,
    ) -> ViewOutcome | str:
        """Send a session a move and the view after it; returns the outcome, or why the service cannot use the view.

        Viewers are shown the outcome. A belief that is wrong may leave no room for the move that was really made, and a
        recording may jump or go backwards; the robot then starts anew from knowing nothing. A prior needs a position,
        so that this is a normal belief a hundred routes wide, where `ActiveLocalizer.observe_or_restart` has an even
        one; and the view after it counts as one of a robot that stands. `n_counted` is how many views counted before
        this one, where an earlier run may have sent it: if so it is not forgotten. `options` are those of
        `Session.observe`.
        """
        start_s, forgot = time.perf_counter(), False
        try:
            try:
                answer = session.observe(**view, **options, action_m=action_m)
            except (InvalidMoveError, IdempotencyKeyReusedError):  # a reused key: an earlier run sent the view below
                if n_counted is None or session.state().n_observations == n_counted:
                    middle_m = float(np.median(self.route.position_m))
                    session.set_prior(middle_m, 100 * max(self.route.length_m, 1.0))
                forgot = True
                answer = session.observe(**view, **options)
        except InvalidInputError as error:
            if error.code not in UNUSABLE_IMAGE_CODES:
                raise
            return f"refused by the service as {error.code}"
        outcome = ViewOutcome(answer, round(1000 * (time.perf_counter() - start_s), 3), forgot)
        for viewer in self.viewers:
            viewer.show(row, view, outcome)
        return outcome

    def apart_m(self, row: int, images: NDArray[np.int64]) -> NDArray[np.float64]:
        """[k] distance from a frame to map images, as `Route.apart_m`."""
        frame = self.recording.frames[row]
        return self.route.apart_m(images, frame.position_m, frame.x_m, frame.y_m)

    def nearest_right(self, row: int) -> int | None:
        """The right answer nearest to a frame; None where the map does not hold its place."""
        images = self.right_images[row]
        return int(images[self.apart_m(row, images).argmin()]) if images.size else None

    def place(self, image: int) -> tuple[float | None, float | None]:
        """The x and y of a map image in metres; None where unknown."""
        axes = (self.route.x_m, self.route.y_m)
        x_m, y_m = (np.nan if axis is None else float(axis[image]) for axis in axes)
        return (None if np.isnan(x_m) else x_m, None if np.isnan(y_m) else y_m)


def changed_map(domain: str) -> ReplayError:
    """The error for a map that was switched while a replay ran."""
    return ReplayError(f"the active map of {domain} changed during the replay: restart it against the new one")


def right_answers(recording: Recording, route: Route, within_m: float) -> list[NDArray[np.int64]]:
    """For each frame the map images [k] that are right answers; frames in reverse order still look forwards."""
    columns = columns_of(recording.frames)
    position_m, x_m, y_m = (columns[name] for name in ("position_m", "x_m", "y_m"))
    order = np.argsort(position_m, kind="stable")
    knows_plane = bool(np.isfinite(x_m).any() and np.isfinite(y_m).any())
    plane = (x_m[order], y_m[order]) if knows_plane else (None, None)
    images = true_images_of(Route(position_m[order], False, *plane), route, within_m)
    return [images[place] for place in np.argsort(order)]


def _map_route(client: Client, domain: Domain, recording: Recording) -> Route:
    """The map's route, by one answer that lists all map images; raises ReplayError."""
    for row in range(len(recording.frames)):
        try:
            view = recording.view(row, domain.input_size)
            answer: Localization = client.localize(domain.name, shortlist=domain.n_map_images, **view)
        except BrokenFrameError:
            continue
        except InvalidInputError as error:
            if error.code not in UNUSABLE_IMAGE_CODES:
                raise
            continue
        if answer.map_version != domain.map_version or len(answer.retrieval) != domain.n_map_images:
            raise changed_map(domain.name)
        position_m, x_m, y_m = np.full((3, len(answer.retrieval)), np.nan)
        for entry in answer.retrieval:
            position_m[entry.map_image] = entry.route_position_m
        for place in answer.belief.top:
            if place.x_m is not None and place.y_m is not None:
                x_m[place.map_image], y_m[place.map_image] = place.x_m, place.y_m
        plane = (x_m, y_m) if np.isfinite(x_m).any() else (None, None)
        return Route(position_m, domain.closed, *plane)
    raise ReplayError(f"none of the {len(recording.frames)} frames of {recording.name} can be used")


class Journal(Generic[Record]):
    """A replay's folder: `replay.json` holds its identity, a file of JSON lines its records, appended as they come.

    An earlier replay of the same `identity` goes on, unless `restart` throws it away: `document` is its identity and
    the facts noted beside it, `earlier` its records in order, each of the `kind`. `record_name` names a record in
    errors. Raises ReplayError (the folder holds another replay, or cannot be written).
    """

    def __init__(
        self,
        folder: Path,
        file_name: str,
        identity: Mapping[str, Any],
        kind: TypeAdapter[Record],
        record_name: str,
        *,
        restart: bool = False,
    ) -> None:
        self.folder = folder
        self.document: dict[str, Any] = dict(identity)
        self.earlier: list[Record] = []
        self._file = folder / file_name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not restart and (folder / _IDENTITY_FILE).exists():
                self.document = self._same_replay(identity)
                self.earlier = self._records(kind, record_name)
            else:
                self._file.unlink(missing_ok=True)
                self.note()
            self._stream = self._file.open("ab")
        except OSError as error:
            raise ReplayError(f"cannot write to {folder}: {error.strerror or error}") from error

    def note(self, **facts: Any) -> None:
        """Write facts about this replay beside its identity."""
        self.document |= facts
        part = self.folder / f"{_IDENTITY_FILE}.tmp"
        part.write_text(json.dumps(self.document, indent=2) + "\n")
        part.replace(self.folder / _IDENTITY_FILE)

    def append(self, document: object) -> None:
        """Write a record; the operating system has it when this returns."""
        self._stream.write(json.dumps(document, allow_nan=False).encode() + b"\n")
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def _same_replay(self, identity: Mapping[str, Any]) -> dict[str, Any]:
        try:
            earlier = json.loads((self.folder / _IDENTITY_FILE).read_bytes())
        except ValueError:
            earlier = {}
        earlier = earlier if isinstance(earlier, dict) else {}
        differing_keys = [key for key in identity if earlier.get(key) != identity[key]]
        if differing_keys:
            differences = ", ".join(f"{key} {earlier.get(key)!r}, now {identity[key]!r}" for key in differing_keys)
            raise ReplayError(
                f"{self.folder} holds another replay ({differences}): "
                "name another folder (--out), or --restart this one"
            )
        return earlier

    def _records(self, kind: TypeAdapter[Record], record_name: str) -> list[Record]:
        """Read the records; a torn last line, left by a crash, is cut off."""
        if not self._file.exists():
            return []
        content = self._file.read_bytes()
        lines = content[: content.rfind(b"\n") + 1]
        if len(lines) != len(content):
            os.truncate(self._file, len(lines))
        records = []
        for number, line in enumerate(lines.splitlines(), start=1):
            try:
                records.append(kind.validate_json(line))
            except ValueError as error:
                raise ReplayError(
                    f"line {number} of {self._file} is no {record_name}: restart the replay or repair it"
                ) from error
        return records


def write_lines(path: Path, documents: Iterable[dict[str, Any]]) -> None:
    """Write a file of JSON lines, without the beliefs' masses."""
    lines = ({name: document[name] for name in document if name != "mass"} for document in documents)
    path.write_text("".join(json.dumps(line, allow_nan=False) + "\n" for line in lines))
