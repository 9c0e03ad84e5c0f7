"""Forms of an observation beside its image, or in its place: the objects that a detector finds, a text.

A label is any word; a box is left, top, right, bottom in shares of the image's sides; a text is of any length that a
person would speak.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.on_board import RANKS, UNIT_ENCODING
from deepsimbad.errors import InvalidSceneError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.image import decode_image, is_blank
from deepsimbad.evaluators.image_files import MEDIA_TYPES

TEXT, FORM_DATA = "text/plain", "multipart/form-data"
MOST_OBJECTS, LONGEST_LABEL, LONGEST_TEXT = 1000, 100, 4000
_LATIN_BELOW, _FOREIGN_SHARE = "\u0250", 0.5


class Form(StrEnum):
    """The forms of an observation that evaluators make encodings of; members of a `Scene`."""

    IMAGE = "image"
    OBJECTS = "objects"
    TEXT = "text"


_OTHERS = ("application/json", RANKS, UNIT_ENCODING)  # that every domain takes


@dataclass(frozen=True)
class Objects:
    """The objects that a detector finds in an image, in any order."""

    labels: tuple[str, ...]
    boxes: NDArray[np.float64]  # [n, 4] left, top, right, bottom, 0..1
    scores: NDArray[np.float64]  # [n] 0..1

    @classmethod
    def read(cls, raw: Any) -> Self:
        """Read a JSON list of {"label", "box", "score"}, a score of 1 where none is given; raises InvalidSceneError."""
        if not isinstance(raw, Sequence) or isinstance(raw, str):
            raise InvalidSceneError('objects is a list of {"label": "car", "box": [x0, y0, x1, y1], "score": 0.9}')
        if len(raw) > MOST_OBJECTS:
            raise InvalidSceneError(
                f"{len(raw)} objects: send the {MOST_OBJECTS} of highest score", most_objects=MOST_OBJECTS
            )
        rows = [_checked(number, member) for number, member in enumerate(raw)]
        boxes = np.array([row[1] for row in rows], np.float64).reshape(-1, 4)
        return cls(tuple(row[0] for row in rows), boxes, np.array([row[2] for row in rows], np.float64))


def _checked(number: int, raw: Any) -> tuple[str, list[float], float]:
    if not isinstance(raw, Mapping) or not {"label", "box"} <= set(raw) <= {"label", "box", "score"}:
        raise InvalidSceneError(
            f"object {number} has not the members label, box and, where known, score", object=number
        )
    label, box, score = raw["label"], raw["box"], raw.get("score", 1.0)
    if not isinstance(label, str) or not 1 <= len(label.strip()) <= LONGEST_LABEL:
        raise InvalidSceneError(f"object {number}: a label is a text of 1 to {LONGEST_LABEL} characters", object=number)
    if not _is_share(score):
        raise InvalidSceneError(f"object {number}: a score is a number within 0 and 1", object=number)
    if not isinstance(box, Sequence) or len(box) != 4 or not all(map(_is_share, box)):
        raise InvalidSceneError(
            f"object {number}: a box is [left, top, right, bottom] in shares of the image's sides, each within 0 and "
            "1: divide pixels by the image's width and height",
            object=number,
        )
    if not (box[0] < box[2] and box[1] < box[3]):
        raise InvalidSceneError(f"object {number}: its box is empty: left < right and top < bottom", object=number)
    return label, [float(side) for side in box], float(score)


def _is_share(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and 0 <= value <= 1


@dataclass(frozen=True)
class Scene:
    """One observation by its forms; None: it lacks this one."""

    image: Image | None = None
    objects: Objects | None = None
    text: str | None = None

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> Self:
        """Read JSON members `objects` and `text`, one at least; raises InvalidSceneError."""
        text, objects = document.get("text"), document.get("objects")
        if text is None and objects is None:
            raise InvalidSceneError("nothing is told: give objects, text, or both")
        if text is not None and (not isinstance(text, str) or not text.strip()):
            raise InvalidSceneError("the text is empty: say what is seen, in a sentence or two")
        if text is not None and len(text) > LONGEST_TEXT:
            raise InvalidSceneError(
                f"a text of {len(text)} characters: at most {LONGEST_TEXT} are taken", most_characters=LONGEST_TEXT
            )
        return cls(None, None if objects is None else Objects.read(objects), text)

    @classmethod
    def of_body(cls, body: bytes, media_type: str) -> Self:
        """Read a body `text/plain`, or else `application/json`; raises InvalidSceneError."""
        try:
            text = body.decode("utf-8-sig")
            document = {"text": text} if media_type == TEXT else json.loads(text)
        except (UnicodeDecodeError, RecursionError, ValueError) as error:
            raise InvalidSceneError(f"this is no {media_type} in UTF-8 that can be read") from error
        if not isinstance(document, dict):
            raise InvalidSceneError("the JSON is no object: give objects, text, or both as its members")
        return cls.read(document)

    @classmethod
    def of_form(cls, body: bytes) -> tuple[Self, bytes | None]:
        """The scene in `multipart/form-data` (RFC 7578), and the image file in it; raises InvalidSceneError."""
        delimiter = body.partition(b"\r\n")[0]
        pieces = (b"\r\n" + body).split(b"\r\n" + delimiter)
        if not delimiter.startswith(b"--") or len(pieces) < 3 or not pieces[-1].startswith(b"--"):
            raise InvalidSceneError("this is no whole multipart/form-data: send its parts as curl -F does")
        contents: dict[str, bytes] = {}
        for piece in pieces[1:-1]:
            head, _, content = piece.partition(b"\r\n\r\n")
            name = re.search(rb'\bname="?([a-z]{1,20})\b', head)
            word = "" if name is None else name[1].decode()
            if word not in set(Form) or word in contents:
                raise InvalidSceneError("the parts of a form are image, objects and text, each once")
            contents[word] = content
        try:
            text = contents["text"].decode("utf-8-sig") if "text" in contents else None
            objects = json.loads(contents["objects"]) if "objects" in contents else None
        except (RecursionError, ValueError) as error:
            raise InvalidSceneError("objects is no JSON, or the text no UTF-8") from error
        scene = cls() if set(contents) == {"image"} else cls.read({"text": text, "objects": objects})
        return scene, contents.get("image")

    def with_image(self, image: Image) -> Self:
        """The scene with an image."""
        return replace(self, image=image)

    @property
    def forms(self) -> frozenset[Form]:
        """The forms that it has."""
        return frozenset(form for form in Form if getattr(self, form.value) is not None)

    @property
    def informative_forms(self) -> frozenset[Form]:
        """The forms that tell something: an image may be blank."""
        return self.forms - ({Form.IMAGE} if self.image is not None and is_blank(self.image) else frozenset())

    @property
    def is_blank(self) -> bool:
        """Whether it has nothing but a blank image and an empty list of objects."""
        return self.informative_forms <= {Form.OBJECTS} and (self.objects is None or not self.objects.labels)

    def check_forms(self, accepted: frozenset[Form]) -> Self:
        """The scene itself; raises UnsupportedMediaTypeError where it has a form that an evaluator does not take."""
        if excess := self.forms - accepted:
            takes = " and ".join(sorted(accepted)) or "ready encodings alone"
            allowed = [
                *(MEDIA_TYPES if Form.IMAGE in accepted else ()),
                *_OTHERS,
                *((TEXT,) if Form.TEXT in accepted else ()),
            ]
            raise UnsupportedMediaTypeError(
                f"this domain takes {takes}, not {' or '.join(sorted(excess))}", allowed=allowed
            )
        return self

    @property
    def remarks(self) -> list[str]:
        """Sentences that a person should read about it."""
        letters = [letter for letter in self.text or "" if letter.isalpha()]
        if letters and sum(letter >= _LATIN_BELOW for letter in letters) > _FOREIGN_SHARE * len(letters):
            return ["the text is of another script than the language model knows best: English finds more"]
        return []


def picture_in(observation: Image | Scene) -> Image | None:
    """The image of an observation."""
    return observation.image if isinstance(observation, Scene) else observation


def read_observation(body: bytes, media_type: str, evaluator: Evaluator, max_pixels: int) -> Image | Scene:
    """The observation in a body, an image at its evaluator's size.

    Raises:
        InvalidImageError, InvalidSceneError: It cannot be read.
        UnsupportedMediaTypeError: The evaluator does not take it in this form.
    """
    if media_type.startswith("image/"):
        return evaluator.prepare(decode_image(body, max_pixels))
    scene, image = Scene.of_form(body) if media_type.startswith(FORM_DATA) else (Scene.of_body(body, media_type), None)
    scene.check_forms(evaluator.forms)
    return scene if image is None else scene.with_image(evaluator.prepare(decode_image(image, max_pixels)))


def shows_none(observation: Image | Scene) -> bool:
    """Whether an observation is blank."""
    return observation.is_blank if isinstance(observation, Scene) else is_blank(observation)


def check_whole(evaluator: Evaluator, observation: Image | Scene) -> None:
    """Raise InvalidSceneError where a map's frame lacks a form that its encoding is made of."""
    forms = observation.forms if isinstance(observation, Scene) else frozenset({Form.IMAGE})
    if lacking := evaluator.lacking(forms):
        raise InvalidSceneError(
            f"a frame of a map has every half of its evaluator, and this one lacks {' or '.join(sorted(lacking))}: "
            "send multipart/form-data, or JSON with objects and text",
            missing=sorted(lacking),
        )
