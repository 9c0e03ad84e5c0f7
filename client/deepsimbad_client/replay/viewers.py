"""Replays shown as they go: in Rerun's viewer by its own library, and as an MCAP file for Foxglove.

Both draw the same, in metres: the route, the belief standing on it and the next move; and hold images and figures.
"""

import base64
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route, on_earth
from deepsimbad_client.errors import MissingExtraError, ReplayError
from deepsimbad_client.http.models import Belief, NextBestView
from deepsimbad_client.recordings import Frame
from deepsimbad_client.replay import Scene, ViewOutcome

LEAST_SHARE = 0.002  # of the fullest bin; less is not drawn
BLUE, QUIET, AMBER, GREEN = (31, 95, 191), (138, 151, 163), (217, 119, 6), (26, 110, 60)

_FRAME = "map"  # of x and y
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_LIST, _OBJECT = {"type": "array", "items": {"type": "object"}}, {"type": "object"}
_FIGURES = ("mode_m", "entropy_bits", "off_route", "error_m", "next_action_m", "latency_ms")
_HEADER = {"timestamp": _STAMP, "frame_id": _TEXT}
_PLACE = {"latitude": _NUMBER, "longitude": _NUMBER, "altitude": _NUMBER}
_COVARIANCE = {
    "position_covariance": {"type": "array", "items": _NUMBER},
    "position_covariance_type": {"type": "integer"},
}
_BYTES = {"type": "string", "contentEncoding": "base64"}
# Topic -> the name of its schema in https://docs.foxglove.dev/docs/sdk/schemas, and the schema's properties
_TOPICS: dict[str, tuple[str, dict[str, Any]]] = {
    "/scene": ("foxglove.SceneUpdate", {"deletions": _LIST, "entities": _LIST}),
    "/pose": ("foxglove.PoseInFrame", {**_HEADER, "pose": _OBJECT}),
    "/location": ("foxglove.LocationFix", {**_HEADER, **_PLACE, **_COVARIANCE}),
    "/image": ("foxglove.CompressedImage", {**_HEADER, "format": _TEXT, "data": _BYTES}),
    "/figures": ("deepsimbad.Figures", {"frame": _TEXT, **{name: {"type": ["number", "null"]} for name in _FIGURES}}),
}

Points = NDArray[np.float64]  # [k, 3] x, y, height


@dataclass(frozen=True)
class Ground:
    """A route as it lies in the plane, or along x where its x and y are unknown."""

    route: Route
    line: Points  # a point for each map image whose place is known
    at_m: NDArray[np.float64]  # [k] their positions along the route

    @classmethod
    def of(cls, route: Route) -> "Ground":
        """The ground of a route, without images whose place is unknown."""
        x_m, y_m = route.x_m, route.y_m
        if x_m is None or y_m is None:
            x_m, y_m = route.position_m, np.zeros_like(route.position_m)
        is_known = np.isfinite(x_m) & np.isfinite(y_m)
        line = np.stack([x_m, y_m, np.zeros_like(x_m)], axis=1)[is_known]
        return cls(route, line, route.position_m[is_known])

    def at(self, position_m: NDArray[np.float64] | float) -> Points:
        """The points [k, 3] at positions along the route, round a closed one and never past an open one's ends."""
        wrapped_m = np.atleast_1d(self.route.wrapped(np.asarray(position_m, np.float64)))
        return np.stack([np.interp(wrapped_m, self.at_m, axis) for axis in self.line.T], axis=1)

    def belief(self, belief: Belief) -> tuple[Points, NDArray[np.float64]]:
        """Feet of the bars that stand for a belief, and their heights in metres."""
        edges_m, mass = np.array(belief.histogram.edges_m), np.array(belief.histogram.mass)
        shares = mass / max(mass.max(), 1e-12)
        is_drawn = shares > LEAST_SHARE
        return self.at((edges_m[:-1] + edges_m[1:])[is_drawn] / 2), shares[is_drawn] * self.highest_m

    @property
    def highest_m(self) -> float:
        """The height in metres of the highest bar, so that it is visible beside the whole route."""
        return float(max(np.ptp(self.line, axis=0).max() / 8, 1.0))

    def ahead(self, belief: Belief, next_best_view: NextBestView) -> Points:
        """The likeliest place after the next move; the present one where the robot is told to stop."""
        return self.at(belief.mode_m + (0.0 if next_best_view.stop else next_best_view.action_m))


def move_text(next_best_view: NextBestView) -> str:
    """The next move in words."""
    if next_best_view.stop:
        return "stop: it knows where it is"
    return f"next view {next_best_view.action_m:+g} m"


class Drawing:
    """The base of both viewers: a scene, its ground, and the time of every view."""

    _scene: Scene
    _ground: Ground
    _now_us = 0  # Unix microseconds of the view that is shown

    def begin(self, scene: Scene) -> None:
        """See `Viewer`."""
        self._scene, self._ground = scene, Ground.of(scene.route)

    def _tick(self, frame: Frame) -> None:
        """Set the time of a view to its frame's if that is later than the last view's, else to a second after it."""
        frame_us = frame.timestamp_us or 0
        self._now_us = frame_us if frame_us > self._now_us else self._now_us + 1_000_000

    def _truth_m(self, row: int, belief: Belief) -> tuple[float, float] | None:
        """The true position along the route, and how far the likeliest place is off it; None where unknown."""
        true_image, route = self._scene.nearest_right(row), self._scene.route
        if true_image is None:
            return None
        truth_m = route.position_m[[true_image]]
        return float(truth_m[0]), abs(float(route.offset_m(truth_m, belief.mode_m)[0]))


class McapFile(Drawing):
    """A `Viewer` that writes an MCAP file of Foxglove's schemas in JSON; a context that finishes it in any case."""

    def __init__(self, path: Path) -> None:
        try:
            from mcap.writer import Writer  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise MissingExtraError("--mcap needs the library mcap: pip install 'deep-simbad[mcap]'") from error
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except FileExistsError as error:
            raise ReplayError(f"{path} is there already: name another file, or remove it") from error
        except OSError as error:
            raise ReplayError(f"cannot write {path}: {error.strerror or error}") from error
        self._writer = Writer(self._file)
        self._writer.start(library="deepsimbad")
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def begin(self, scene: Scene) -> None:
        """See `Viewer`."""
        super().begin(scene)
        self._is_begun = False

    def show(self, row: int, view: Mapping[str, Any], outcome: ViewOutcome) -> None:
        """See `Viewer`."""
        frame, belief, plan = self._scene.recording.frames[row], outcome.answer.belief, outcome.answer.next_best_view
        ground, truth_m = self._ground, self._truth_m(row, belief)
        self._tick(frame)
        if not self._is_begun:  # the route has the first view's time: a player begins there
            self._is_begun = True
            line = {**_pose(np.zeros(3)), "type": 0, "thickness": 2.0, "scale_invariant": True, "indices": []}
            line |= {"points": [_xyz(point) for point in ground.line], "color": _colour(QUIET), "colors": []}
            self._write("/scene", _scene(self._entity("route", lines=[line])))
        size = ground.highest_m / 25
        bars = [
            {
                **_pose(foot, height / 2),
                "size": {"x": size / 2, "y": size / 2, "z": height},
                "color": _colour(BLUE, 0.8),
            }
            for foot, height in zip(*ground.belief(belief), strict=True)
        ]
        entities = [
            self._entity("belief", cubes=bars),
            self._entity("likeliest", spheres=[_ball(ground.at(belief.mode_m), size, BLUE)]),
        ]
        balls = [] if truth_m is None else [_ball(ground.at(truth_m[0]), size, GREEN)]
        entities.append(self._entity("truth", spheres=balls))
        if plan is not None:
            ahead = ground.ahead(belief, plan)
            text = {**_pose(ahead[0], 2 * size), "billboard": True, "font_size": 14.0, "text": move_text(plan)}
            text |= {"scale_invariant": True, "color": _colour(AMBER)}
            entities.append(self._entity("next_move", spheres=[_ball(ahead, size, AMBER)], texts=[text]))
        self._write("/scene", _scene(*entities))
        self._write_place(belief.mode_m, belief.std_m)
        kind, _, form = view.get("content_type", "").partition("/")
        if kind == "image":
            self._write("/image", {**self._header, "data": base64.b64encode(view["image"]).decode(), "format": form})
        figures = (belief.mode_m, belief.entropy_bits, belief.off_route, None if truth_m is None else truth_m[1])
        values = zip(_FIGURES, (*figures, None if plan is None else plan.action_m, outcome.latency_ms), strict=True)
        self._write("/figures", {"frame": frame.name, **dict(values)})

    def _write_place(self, mode_m: float, std_m: float) -> None:
        """Write the likeliest place as a pose, and as a place on Earth where the domain has an anchor."""
        image = int(np.abs(self._scene.route.position_m - mode_m).argmin())
        heading = float(np.nan_to_num(self._scene.route.heading_rad[image]))
        self._write("/pose", {**self._header, **_pose(self._ground.at(mode_m)[0], heading_rad=heading)})
        anchor, (x_m, y_m) = self._scene.domain.anchor, self._scene.place(image)
        if anchor is not None and x_m is not None and y_m is not None:
            latitude, longitude = on_earth(x_m, y_m, **anchor)
            place = {"latitude": latitude, "longitude": longitude, "altitude": anchor["height_m"]}
            covariance = {"position_covariance": [std_m**2, 0, 0, 0, std_m**2, 0, 0, 0, 0]}
            self._write("/location", {**self._header, **place, **covariance, "position_covariance_type": 1})

    @property
    def _header(self) -> dict[str, Any]:
        sec, micro = divmod(self._now_us, 1_000_000)
        return {"timestamp": {"sec": sec, "nsec": 1000 * micro}, "frame_id": _FRAME}

    def _entity(self, name: str, **primitives: list[dict[str, Any]]) -> dict[str, Any]:
        """An entity of the scene, which replaces the earlier one of its name."""
        kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
        attributes = {"id": name, "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": False, "metadata": []}
        return {**self._header, **attributes, **{kind: primitives.get(kind, []) for kind in kinds}}

    def _write(self, topic: str, message: dict[str, Any]) -> None:
        if topic not in self._channels:
            name, properties = _TOPICS[topic]
            schema = json.dumps({"title": name, "type": "object", "properties": properties}).encode()
            schema_id = self._writer.register_schema(name, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", schema_id)
        data, now_ns = json.dumps(message, allow_nan=False).encode(), 1000 * self._now_us
        self._writer.add_message(self._channels[topic], now_ns, data, now_ns)


def show_window(stream: Any, layout: Any) -> None:
    """Open the viewer's window, or use the one that is open. Raises ReplayError."""
    bin_dir = str(Path(sys.executable).parent)  # pip puts the viewer there; PATH may lack it
    os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", ""), bin_dir])
    try:
        stream.spawn(default_blueprint=layout)
    except RuntimeError as error:
        raise ReplayError(f"Rerun's viewer does not open: {str(error).splitlines()[0]}") from error


class RerunViewer(Drawing):
    """A `Viewer` in Rerun's window; a context that ends the stream, while the window stays."""

    def __init__(self) -> None:
        try:
            import rerun  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise MissingExtraError("--rerun needs Rerun's viewer: pip install 'deep-simbad[rerun]'") from error
        self._rerun: Any = rerun
        self._stream = rerun.RecordingStream("deepsimbad_replay")
        self._n_views = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.disconnect()

    def begin(self, scene: Scene) -> None:
        """See `Viewer`."""
        super().begin(scene)
        rr, blueprint = self._rerun, self._rerun.blueprint
        world = blueprint.Spatial3DView(origin="/world", name="Route and belief")
        side_views = blueprint.Vertical(
            blueprint.Spatial2DView(origin="/view", name="The view"),
            blueprint.BarChartView(origin="/moves", name="What each move would tell"),
            blueprint.TimeSeriesView(origin="/figures", name="Entropy, lost, error"),
        )
        layout = blueprint.Blueprint(blueprint.Horizontal(world, side_views, column_shares=[2, 1]))
        show_window(self._stream, layout)
        log, radius = self._stream.log, self._ground.highest_m / 60
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log("world/route", rr.LineStrips3D([self._ground.line], colors=QUIET, radii=radius), static=True)

    def show(self, row: int, view: Mapping[str, Any], outcome: ViewOutcome) -> None:
        """See `Viewer`."""
        ground, frame, belief = self._ground, self._scene.recording.frames[row], outcome.answer.belief
        rr, stream, log, size = self._rerun, self._stream, self._stream.log, self._ground.highest_m / 25
        self._tick(frame)
        stream.set_time("view", sequence=self._n_views)
        stream.set_time("time", timestamp=self._now_us / 1e6)
        self._n_views += 1
        feet, height_m = ground.belief(belief)
        tops = feet + np.outer(height_m, [0.0, 0.0, 1.0])
        log("world/belief", rr.LineStrips3D(np.stack([feet, tops], axis=1), colors=BLUE, radii=size / 3))
        log("world/likeliest", rr.Points3D(ground.at(belief.mode_m), colors=BLUE, radii=size))
        if (truth_m := self._truth_m(row, belief)) is None:
            log("world/truth", rr.Clear(recursive=False))
        else:
            log("world/truth", rr.Points3D(ground.at(truth_m[0]), colors=GREEN, radii=size))
            log("figures/error_m", rr.Scalars(truth_m[1]))
        if view.get("content_type", "").startswith("image/"):
            log("view", rr.EncodedImage(contents=view["image"], media_type=view["content_type"]))
        log("figures/entropy_bits", rr.Scalars(belief.entropy_bits))
        log("figures/lost_percent", rr.Scalars(100 * (belief.off_route or 0.0)))
        log("said", rr.TextLog(f"{frame.name}: likeliest at {belief.mode_m:.1f} m"))
        if (plan := outcome.answer.next_best_view) is not None:
            ahead = rr.Points3D(ground.ahead(belief, plan), colors=AMBER, radii=size, labels=[move_text(plan)])
            log("world/next_move", ahead)
            values = [move.q_value if move.expected_bits is None else move.expected_bits for move in plan.actions]
            log("moves", rr.BarChart(values, color=AMBER, abscissa=[move.action_m for move in plan.actions]))


def _scene(*entities: dict[str, Any]) -> dict[str, Any]:
    return {"deletions": [], "entities": list(entities)}


def _xyz(point: Points) -> dict[str, float]:
    return dict(zip("xyz", map(float, point), strict=True))


def _pose(point: Points, above_m: float = 0.0, heading_rad: float = 0.0) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(heading_rad / 2)), "w": float(np.cos(heading_rad / 2))}
    return {"pose": {"position": {**_xyz(point), "z": above_m}, "orientation": turn}}


def _ball(places: Points, size: float, colour: tuple[int, int, int]) -> dict[str, Any]:
    return {**_pose(places[0]), "size": {"x": size, "y": size, "z": size}, "color": _colour(colour)}


def _colour(colour: tuple[int, int, int], opacity: float = 1.0) -> dict[str, float]:
    return {**{name: part / 255 for name, part in zip("rgb", colour, strict=True)}, "a": opacity}
