"""A recording driven as an active robot drives: where it may start, what it comes to when it moves, what it sees."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepsimbad_client.errors import BrokenFrameError, InvalidInputError, PastTheEndError, ReplayError
from deepsimbad_client.http.client import Session
from deepsimbad_client.http.models import SessionAnswer
from deepsimbad_client.http.upload import UNUSABLE_IMAGE_CODES
from deepsimbad_client.recordings.recording import Frame, Recording


@dataclass(frozen=True)
class Seen:
    """One view of an episode and the service's answer.

    Attributes:
        step: 0 for the first view, then the number of moves made.
        row: Which of the recording's frames it was.
        commanded_m: The move asked for; None before the first.
        action_m: Metres really moved, to the recorded frame nearest to the commanded place.
        answer: What the service believes now and asks for next.
        latency_ms: Time from posting the view to the answer.
        forgot: The belief had no room left for the move, so the session was set back to knowing nothing.
    """

    step: int
    row: int
    commanded_m: float | None
    action_m: float
    answer: SessionAnswer
    latency_ms: float
    forgot: bool = False


class Walk:
    """A recording to drive along by metres.

    Args:
        recording: What there is to see.
        input_size: (width, height) the domain asks images for.

    Raises:
        ReplayError: It has no frames, or its positions go backwards.
    """

    def __init__(self, recording: Recording, input_size: tuple[int, int] | None) -> None:
        self.recording = recording
        self.position_m = np.array([frame.position_m for frame in recording.frames], np.float64)
        self._input_size = input_size
        if not len(self.position_m):
            raise ReplayError(f"{recording.name} has no frames to drive along")
        if (np.diff(self.position_m) < 0).any():
            raise ReplayError(f"the positions of {recording.name} go backwards: a robot cannot drive along it")

    def frame(self, row: int) -> Frame:
        """One of the recording's frames."""
        return self.recording.frames[row]

    def start(self, steps: int, longest_m: float, seed: int, episode: int) -> tuple[int, int]:
        """Draw where an episode starts, uniform over the frames from which all its moves fit, and a seed for it.

        The draw depends on `seed` and `episode` alone, so every planner starts from the same places.

        Returns:
            The row, and the seed of the episode's session.

        Raises:
            ReplayError: The recording is too short for that many moves.
        """
        room_m = float(self.position_m[-1]) - steps * longest_m
        n_starts = int(np.searchsorted(self.position_m, room_m, side="right"))
        if n_starts == 0:
            length_m = float(self.position_m[-1] - self.position_m[0])
            raise ReplayError(
                f"{steps} moves of up to {longest_m:g} m do not fit the {length_m:g} m of {self.recording.name}: "
                "ask for fewer steps"
            )
        rng = np.random.default_rng([seed, episode])
        return int(rng.integers(n_starts)), int(rng.integers(2**31))

    def nearest(self, commanded_m: float, broken: frozenset[int], beyond_m: float = -np.inf) -> int:
        """The usable row recorded nearest to a place; past the recording's end its last, before it its first.

        Args:
            commanded_m: The place.
            broken: Rows that cannot be used.
            beyond_m: Only frames farther along than this, where there are any: a robot told to move does move, though
                the next frame may be farther than it was told, and does not look at the same picture twice.

        Raises:
            ReplayError: Every frame is broken.
        """
        usable = np.delete(np.arange(len(self.position_m)), sorted(broken))
        if not usable.size:
            raise ReplayError(f"none of the frames of {self.recording.name} can be used")
        ahead = usable[self.position_m[usable] > beyond_m]
        usable = ahead if ahead.size else usable
        return int(usable[np.abs(self.position_m[usable] - commanded_m).argmin()])

    def view(self, row: int) -> dict[str, Any]:
        """What is seen there, as arguments of `Session.observe`.

        Raises:
            BrokenFrameError: The image cannot be read.
        """
        return self.recording.view(row, self._input_size)


def drive(
    session: Session,
    walk: Walk,
    start: int,
    steps: int,
    clock: Callable[[], float],
    *,
    route_middle_m: float,
    route_length_m: float,
) -> Iterator[Seen]:
    """Drive one episode: look, ask for the next-best view, move there, look again.

    A frame that cannot be used is passed over for the nearest that can. A belief that is wrong may leave no room for
    the move that was really made; the robot then starts anew from knowing nothing.

    Yields:
        `steps` + 1 views, the first without a move.

    Raises:
        ReplayError: No frame can be used, or the planner names no next move.
        ApiError: The service refused more than a frame.
        TransportError: The service did not answer.
    """
    broken: frozenset[int] = frozenset()
    here_m, commanded_m = float(walk.position_m[start]), None
    row = start
    for step in range(steps + 1):
        forgot = False
        while True:
            action_m = float(walk.position_m[row]) - here_m
            try:
                view = walk.view(row)
                began = clock()
                try:
                    answer = session.observe(**view, action_m=action_m if step else None)
                except PastTheEndError:
                    session.set_prior(route_middle_m, 100 * max(route_length_m, 1.0))
                    forgot = True
                    answer = session.observe(**view)
                latency_ms = 1000 * (clock() - began)
                break
            except BrokenFrameError:
                broken |= {row}
            except InvalidInputError as error:
                if error.code not in UNUSABLE_IMAGE_CODES:
                    raise
                broken |= {row}
            row = walk.nearest(here_m + (commanded_m or 0.0), broken, here_m if commanded_m else -np.inf)
        yield Seen(step, row, commanded_m, action_m if step else 0.0, answer, latency_ms, forgot)
        if step == steps:
            return
        if answer.next_best_view is None:
            raise ReplayError(
                f"the map of {session.domain} names no next-best view for this planner: remap with training episodes"
            )
        here_m = float(walk.position_m[row])
        commanded_m = answer.next_best_view.action_m
        row = walk.nearest(here_m + commanded_m, broken, here_m if commanded_m > 0 else -np.inf)
