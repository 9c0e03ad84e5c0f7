"""How well a belief knows where the robot truly is."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.episode_log import EpisodeStep
from deepsimbad_client.map_route import MapRoute, Truth, path_of_frames
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.replay import rank_of_truth
from deepsimbad_client.walk import Seen

TRUTH_WITHIN_M = 10.0
"""A frame farther than this from every map image is off the map and has no right answer."""
_MASS_DIGITS = 5


class Judge:
    """Scores beliefs against where the robot truly was.

    Args:
        recording: What is driven along.
        route: The map's images.
    """

    def __init__(self, recording: Recording, route: MapRoute) -> None:
        self.route = route
        self._frames = recording.frames
        self._truth = Truth(path_of_frames(recording.frames), route, TRUTH_WITHIN_M)

    def step(self, seen: Seen, masses: NDArray[np.float32], travelled_m: float) -> EpisodeStep:
        """One view's line.

        Args:
            seen: The view and the answer to it.
            masses: [n] the belief after it, over the map images.
            travelled_m: Metres moved since the episode's start.
        """
        frame = self._frames[seen.row]
        apart_m = self._truth.apart_m(seen.row)
        right = self._truth.true_images(seen.row)
        true = int(right[apart_m[right].argmin()]) if right.size else None
        rank = None if true is None else rank_of_truth(masses, np.array([true]))
        belief = seen.answer.belief
        path = self.route.path
        mode = int(np.abs(path.position_m - belief.mode_m).argmin())
        asked = seen.answer.next_best_view
        return EpisodeStep(
            step=seen.step,
            index=frame.index,
            name=frame.name,
            position_m=frame.position_m,
            x_m=frame.x_m,
            y_m=frame.y_m,
            commanded_m=seen.commanded_m,
            action_m=seen.action_m,
            travelled_m=travelled_m,
            forgot=seen.forgot,
            true_map_image=true,
            true_route_m=None if true is None else float(path.position_m[true]),
            rank=rank,
            rank_percent=None if rank is None else 100 * rank / self.route.n_images,
            mode_m=belief.mode_m,
            mode_x_m=_known(path.x_m[mode]),
            mode_y_m=_known(path.y_m[mode]),
            low_m=belief.credible_95_m[0],
            high_m=belief.credible_95_m[1],
            error_m=None if true is None else float(apart_m[mode]),
            entropy_bits=belief.entropy_bits,
            off_route=belief.off_route,
            next_action_m=None if asked is None else asked.action_m,
            latency_ms=round(seen.latency_ms, 3),
            mass=tuple(round(share, _MASS_DIGITS) for share in belief.histogram.mass),
        )


def _known(value: "np.floating[Any]") -> float | None:
    return float(value) if np.isfinite(value) else None
