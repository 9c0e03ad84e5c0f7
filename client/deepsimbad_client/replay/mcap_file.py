"""A replay as an MCAP file of Foxglove's schemas in JSON: route and belief, pose, place on Earth, images, figures."""

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from deepsimbad.core.earth import on_earth
from deepsimbad_client.errors import MissingExtraError, ReplayError
from deepsimbad_client.replay import Scene, Seen
from deepsimbad_client.replay.drawn import AMBER, BLUE, GREEN, QUIET, Clock, Ground, Points, asked

try:
    from mcap.writer import Writer
except ImportError as error:
    raise MissingExtraError("--mcap needs the library mcap: pip install 'deep-simbad[mcap]'") from error

_FRAME = "map"  # of x and y
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_LIST, _OBJECT = {"type": "array", "items": {"type": "object"}}, {"type": "object"}
_FIGURES = ("mode_m", "entropy_bits", "off_route", "error_m", "next_action_m", "latency_ms")
_STAMPED = {"timestamp": _STAMP, "frame_id": _TEXT}
_PLACE = {"latitude": _NUMBER, "longitude": _NUMBER, "altitude": _NUMBER}
_COVARIANCE = {
    "position_covariance": {"type": "array", "items": _NUMBER},
    "position_covariance_type": {"type": "integer"},
}
_BYTES = {"type": "string", "contentEncoding": "base64"}
# Topic -> the schema of that name, as https://docs.foxglove.dev/docs/sdk/schemas has it, and its members
_TOPICS: dict[str, tuple[str, dict[str, Any]]] = {
    "/scene": ("foxglove.SceneUpdate", {"deletions": _LIST, "entities": _LIST}),
    "/pose": ("foxglove.PoseInFrame", {**_STAMPED, "pose": _OBJECT}),
    "/location": ("foxglove.LocationFix", {**_STAMPED, **_PLACE, **_COVARIANCE}),
    "/image": ("foxglove.CompressedImage", {**_STAMPED, "format": _TEXT, "data": _BYTES}),
    "/figures": ("deepsimbad.Figures", {"frame": _TEXT, **{name: {"type": ["number", "null"]} for name in _FIGURES}}),
}


class McapFile:
    """See `Viewer`; a context that finishes its file, whatever happens."""

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except FileExistsError as error:
            raise ReplayError(f"{path} is there already: name another file, or remove it") from error
        except OSError as error:
            raise ReplayError(f"cannot write {path}: {error.strerror or error}") from error
        self._writer, self._clock, self._now_us = Writer(self._file), Clock(), 0
        self._writer.start(library="deepsimbad")
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def begin(self, scene: Scene) -> None:
        """See `Viewer`."""
        self._scene, self._ground, self._is_begun = scene, Ground.of(scene.route), False

    def show(self, row: int, view: Mapping[str, Any], seen: Seen) -> None:
        """See `Viewer`."""
        frame, belief, plan = self._scene.recording.frames[row], seen.answer.belief, seen.answer.next_best_view
        route, ground = self._scene.route, self._ground
        self._now_us = self._clock.of(frame)
        if not self._is_begun:  # the route has the first view's time: a player begins there
            self._is_begun = True
            line = {**_placed(np.zeros(3)), "type": 0, "thickness": 2.0, "scale_invariant": True, "indices": []}
            line |= {"points": [_xyz(point) for point in ground.line], "color": _colour(QUIET), "colors": []}
            self._write("/scene", _scene(self._entity("route", lines=[line])))
        size, right = ground.highest_m / 25, self._scene.nearest_right(row)
        feet, share = ground.belief(belief)
        bars = [
            {
                **_placed(foot, height / 2),
                "size": {"x": size / 2, "y": size / 2, "z": height},
                "color": _colour(BLUE, 0.8),
            }
            for foot, height in zip(feet, share * ground.highest_m, strict=True)
        ]
        entities = [
            self._entity("belief", cubes=bars),
            self._entity("likeliest", spheres=[_ball(ground.at(belief.mode_m), size, BLUE)]),
        ]
        balls = [] if right is None else [_ball(ground.at(float(route.position_m[right])), size, GREEN)]
        entities.append(self._entity("truth", spheres=balls))
        if plan is not None:
            ahead = ground.ahead(belief, plan)
            text = {**_placed(ahead[0], 2 * size), "billboard": True, "font_size": 14.0, "text": asked(plan)}
            text |= {"scale_invariant": True, "color": _colour(AMBER)}
            entities.append(self._entity("next_move", spheres=[_ball(ahead, size, AMBER)], texts=[text]))
        self._write("/scene", _scene(*entities))
        self._where(belief.mode_m, belief.std_m)
        kind, _, form = view.get("content_type", "").partition("/")
        if kind == "image":
            self._write("/image", {**self._stamped, "data": base64.b64encode(view["image"]).decode(), "format": form})
        error_m = None if right is None else abs(float(route.offset_m(route.position_m[[right]], belief.mode_m)[0]))
        figures = (belief.mode_m, belief.entropy_bits, belief.off_route, error_m)
        named = zip(_FIGURES, (*figures, None if plan is None else plan.action_m, seen.latency_ms), strict=True)
        self._write("/figures", {"frame": frame.name, **dict(named)})

    def _where(self, mode_m: float, std_m: float) -> None:
        """The likeliest place as a pose, and on Earth where the domain has an anchor."""
        image = int(np.abs(self._scene.route.position_m - mode_m).argmin())
        heading = float(np.nan_to_num(self._scene.route.heading_rad[image]))
        self._write("/pose", {**self._stamped, **_placed(self._ground.at(mode_m)[0], heading_rad=heading)})
        anchor, (x_m, y_m) = self._scene.domain.anchor, self._scene.place(image)
        if anchor is not None and x_m is not None and y_m is not None:
            latitude, longitude = on_earth(x_m, y_m, **anchor)
            place = {"latitude": latitude, "longitude": longitude, "altitude": anchor["height_m"]}
            covariance = {"position_covariance": [std_m**2, 0, 0, 0, std_m**2, 0, 0, 0, 0]}
            self._write("/location", {**self._stamped, **place, **covariance, "position_covariance_type": 1})

    @property
    def _stamped(self) -> dict[str, Any]:
        sec, micro = divmod(self._now_us, 1_000_000)
        return {"timestamp": {"sec": sec, "nsec": 1000 * micro}, "frame_id": _FRAME}

    def _entity(self, name: str, **primitives: list[dict[str, Any]]) -> dict[str, Any]:
        """A thing of the scene, which takes the place of the one of its name."""
        kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
        about = {"id": name, "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": False, "metadata": []}
        return {**self._stamped, **about, **{kind: primitives.get(kind, []) for kind in kinds}}

    def _write(self, topic: str, message: dict[str, Any]) -> None:
        if topic not in self._channels:
            name, properties = _TOPICS[topic]
            schema = json.dumps({"title": name, "type": "object", "properties": properties}).encode()
            schema_id = self._writer.register_schema(name, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", schema_id)
        data, now_ns = json.dumps(message, allow_nan=False).encode(), 1000 * self._now_us
        self._writer.add_message(self._channels[topic], now_ns, data, now_ns)


def _scene(*entities: dict[str, Any]) -> dict[str, Any]:
    return {"deletions": [], "entities": list(entities)}


def _xyz(point: Points) -> dict[str, float]:
    return dict(zip("xyz", map(float, point), strict=True))


def _placed(point: Points, above_m: float = 0.0, heading_rad: float = 0.0) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(heading_rad / 2)), "w": float(np.cos(heading_rad / 2))}
    return {"pose": {"position": {**_xyz(point), "z": above_m}, "orientation": turn}}


def _ball(at: Points, size: float, colour: tuple[int, int, int]) -> dict[str, Any]:
    return {**_placed(at[0]), "size": {"x": size, "y": size, "z": size}, "color": _colour(colour)}


def _colour(colour: tuple[int, int, int], opacity: float = 1.0) -> dict[str, float]:
    return {**{name: part / 255 for name, part in zip("rgb", colour, strict=True)}, "a": opacity}
