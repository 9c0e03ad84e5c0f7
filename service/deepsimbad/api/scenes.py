"""Views that are told: a text, objects that a detector found, and either beside an image as `multipart/form-data`."""

from collections.abc import Mapping, Sequence
from typing import Any

from deepsimbad.api.requests import JSON, Services
from deepsimbad.core.frames import Camera
from deepsimbad.engine.decoders import Decoded
from deepsimbad.engine.worker import Priority
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.grey_levels import GreyLevels
from deepsimbad.evaluators.image_files import MEDIA_TYPES
from deepsimbad.evaluators.scenes import FORM_DATA, LONGEST_LABEL, LONGEST_TEXT, MOST_OBJECTS, TEXT, Scene

SCENE_MEMBERS = frozenset({"objects", "text"})  # members of a JSON body
MOST_PARTS = 100_000  # of a body of objects: far more than are taken, so that it is their number that is refused

_SHARE = {"type": "number", "minimum": 0, "maximum": 1}
_OBJECT = {
    "type": "object",
    "required": ["label", "box"],
    "properties": {
        "label": {"type": "string", "minLength": 1, "maxLength": LONGEST_LABEL, "pattern": r"\S"},
        "box": {
            "type": "array",
            "items": _SHARE,
            "minItems": 4,
            "maxItems": 4,
            "description": "Left, top, right, bottom in shares of the image's sides; left < right, top < bottom.",
        },
        "score": {**_SHARE, "default": 1},
    },
    "additionalProperties": False,
}
_OBJECTS = {"type": "array", "items": _OBJECT, "maxItems": MOST_OBJECTS}
_TEXT = {"type": "string", "minLength": 1, "maxLength": LONGEST_TEXT, "pattern": r"\S"}
SCENE_SCHEMA: dict[str, Any] = {
    "type": "object",
    "anyOf": [{"required": ["objects"]}, {"required": ["text"]}],
    "properties": {"objects": _OBJECTS, "text": _TEXT},
    "additionalProperties": False,
    "description": "What a detector found (none: the view tells nothing), and what is seen in words, where taken.",
}
SCENE_BODIES: dict[str, dict[str, Any]] = {
    TEXT: {**_TEXT, "description": "What is seen, in words, where the domain takes them."},
    FORM_DATA: {
        "type": "object",
        "properties": {"image": {"type": "string", "format": "binary"}, "objects": _OBJECTS, "text": _TEXT},
        "description": "Several forms of one view, where the domain takes them; `objects` is JSON.",
    },
}


async def scene_in(
    body: bytes,
    media_type: str,
    document: Mapping[str, Any],
    services: Services,
    evaluator: Evaluator,
    priority: Priority,
    levels: GreyLevels | None,
    cameras: Sequence[Camera] = (),
) -> tuple[Scene, Decoded | None]:
    """The scene in a body, and the image in it, decoded.

    Args:
        document: The members of a JSON body, parsed.

    Raises:
        InvalidSceneError: The body holds no scene that can be read.
        UnsupportedMediaTypeError: The evaluator does not take it in this form; and as `Decoders.decoded`.
    """
    image: bytes | None = None
    if media_type in MEDIA_TYPES:
        scene, image = Scene(), body
    elif media_type == FORM_DATA:
        scene, image = Scene.of_form(body)
    else:
        scene = Scene.read(document) if media_type == JSON else Scene.of_body(body, media_type)
    scene.check_forms(evaluator.forms)
    if image is None:
        return scene, None
    picture = await services.decoders.decoded(image, evaluator, priority, levels, cameras)
    return scene.with_image(picture.image), picture
