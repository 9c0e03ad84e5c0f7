"""A replay in the Rerun viewer, by its own library: the route, the belief on it, the images, the next move."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from deepsimbad_client.errors import MissingExtraError, ReplayError
from deepsimbad_client.replay import Scene, Seen
from deepsimbad_client.replay.drawn import AMBER, BLUE, GREEN, QUIET, Clock, Ground, asked

try:
    import rerun as rr
    from rerun import blueprint
except ImportError as error:
    raise MissingExtraError("--rerun needs Rerun's viewer: pip install 'deep-simbad[rerun]'") from error


def show_window(stream: Any, layout: Any) -> None:
    """Open the viewer's window, or use the one that is open. Raises ReplayError."""
    beside = str(Path(sys.executable).parent)  # where pip puts it, in an environment that is not activated too
    os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", ""), beside])
    try:
        stream.spawn(default_blueprint=layout)
    except RuntimeError as error:
        raise ReplayError(f"Rerun's viewer does not open: {str(error).splitlines()[0]}") from error


class RerunViewer:
    """See `Viewer`; a context that ends the stream, the window stays."""

    def __init__(self) -> None:
        self._stream = rr.RecordingStream("deepsimbad_replay")
        self._clock, self._n_views = Clock(), 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.disconnect()

    def begin(self, scene: Scene) -> None:
        """See `Viewer`."""
        self._scene, self._ground = scene, Ground.of(scene.route)
        world = blueprint.Spatial3DView(origin="/world", name="Route and belief")
        beside = blueprint.Vertical(
            blueprint.Spatial2DView(origin="/view", name="The view"),
            blueprint.BarChartView(origin="/moves", name="What each move would tell"),
            blueprint.TimeSeriesView(origin="/figures", name="Entropy, lost, error"),
        )
        layout = blueprint.Blueprint(blueprint.Horizontal(world, beside, column_shares=[2, 1]))
        show_window(self._stream, layout)
        log, radius = self._stream.log, self._ground.highest_m / 60
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log("world/route", rr.LineStrips3D([self._ground.line], colors=QUIET, radii=radius), static=True)

    def show(self, row: int, view: Mapping[str, Any], seen: Seen) -> None:
        """See `Viewer`."""
        ground, frame, belief = self._ground, self._scene.recording.frames[row], seen.answer.belief
        stream, log, size = self._stream, self._stream.log, self._ground.highest_m / 25
        stream.set_time("view", sequence=self._n_views)
        stream.set_time("time", timestamp=self._clock.of(frame) / 1e6)
        self._n_views += 1
        feet, share = ground.belief(belief)
        tops = feet + np.outer(share, [0.0, 0.0, ground.highest_m])
        log("world/belief", rr.LineStrips3D(np.stack([feet, tops], axis=1), colors=BLUE, radii=size / 3))
        log("world/likeliest", rr.Points3D(ground.at(belief.mode_m), colors=BLUE, radii=size))
        right = self._scene.nearest_right(row)
        if right is None:
            log("world/truth", rr.Clear(recursive=False))
        else:
            log("world/truth", rr.Points3D(ground.at(self._scene.route.position_m[right]), colors=GREEN, radii=size))
        if view.get("content_type", "").startswith("image/"):
            log("view", rr.EncodedImage(contents=view["image"], media_type=view["content_type"]))
        log("figures/entropy_bits", rr.Scalars(belief.entropy_bits))
        log("figures/lost_percent", rr.Scalars(100 * (belief.off_route or 0.0)))
        if right is not None:
            error_m = self._scene.route.offset_m(self._scene.route.position_m[[right]], belief.mode_m)[0]
            log("figures/error_m", rr.Scalars(abs(float(error_m))))
        log("said", rr.TextLog(f"{frame.name}: likeliest at {belief.mode_m:.1f} m"))
        if (plan := seen.answer.next_best_view) is not None:
            ahead = rr.Points3D(ground.ahead(belief, plan), colors=AMBER, radii=size, labels=[asked(plan)])
            log("world/next_move", ahead)
            values = [move.q_value if move.expected_bits is None else move.expected_bits for move in plan.actions]
            log("moves", rr.BarChart(values, color=AMBER, abscissa=[move.action_m for move in plan.actions]))
