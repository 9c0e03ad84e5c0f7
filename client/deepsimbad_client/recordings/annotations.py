"""Annotations of a recording's images: the objects of each in `detections.jsonl`, its words in `captions.csv`.

They lie with the images or, in NCLT's layout, in the drive's folder. A line of detections is `{"name": "1.jpg",
"objects": [{"label": "car", "box": [left, top, right, bottom], "score": 0.9}]}`; captions have the columns name and
text. Names are the image files'.
"""

import csv
import dataclasses
import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepsimbad.evaluators.grey_levels import GreyLevels
from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.http import scene_observation
from deepsimbad_client.recordings import EncodedImage, Frame, Recording

DETECTIONS, CAPTIONS = "detections.jsonl", "captions.csv"
ANNOTATION_SUFFIXES = {".txt": "text/plain", ".json": "application/json"}
"""The suffixes of files that annotate one view, and the media types they are posted as."""
FORMS = {"objects": DETECTIONS, "text": CAPTIONS}


@dataclass(frozen=True, eq=False, kw_only=True)
class AnnotatedRecording(Recording):
    """A recording whose views are annotations, with their images or in their place."""

    image_recording: Recording
    annotations: Mapping[str, Mapping[str, Any]]  # by form, by the frame's name
    with_image: bool

    def stamp(self, frame: Frame) -> str:
        """See `Recording.stamp`."""
        annotation_text = json.dumps([by_name.get(frame.name) for by_name in self.annotations.values()])
        return f"{self.image_recording.stamp(frame) if self.with_image else frame.name} {annotation_text}"

    def shown_by(self, levels: GreyLevels | None) -> "AnnotatedRecording":
        """See `Recording.shown_by`."""
        return dataclasses.replace(self, image_recording=self.image_recording.shown_by(levels))

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """The body of a frame's annotations, with its image where `with_image`; raises BrokenFrameError."""
        for form, by_name in self.annotations.items():
            if frame.name not in by_name:
                raise BrokenFrameError(f"{FORMS[form]} says nothing of {frame.name}", f"not in {FORMS[form]}")
        picture = self.image_recording.image(frame, input_size).body if self.with_image else None
        body = scene_observation({form: by_name[frame.name] for form, by_name in self.annotations.items()}, picture)
        return EncodedImage(body.body, body.content_type)


def as_taken(recording: Recording, takes: Collection[str]) -> Recording:
    """The recording in the forms that a domain takes, as `Domain.takes` names them; ready encodings as they are.

    Raises SourceError (the annotations of its images are missing, or cannot be understood).
    """
    forms = [form for form in FORMS if form in takes]
    if recording.encodings is not None or not forms or isinstance(recording, AnnotatedRecording):
        return recording
    annotations: dict[str, Mapping[str, Any]] = {}
    for form in forms:
        file = None if recording.folder is None else _file(recording.folder, FORMS[form])
        if file is not None:
            annotations[form] = _read(file, form)
    if not annotations and "image" in takes:
        return recording
    if not annotations:
        raise SourceError(
            f"{recording.name} has no {' nor '.join(FORMS[form] for form in forms)} beside its images, and the domain "
            f"takes {' and '.join(sorted(takes))}"
        )
    return AnnotatedRecording(
        **{field.name: getattr(recording, field.name) for field in dataclasses.fields(Recording)},
        image_recording=recording,
        annotations=annotations,
        with_image="image" in takes,
    )


def _file(folder: Path, name: str) -> Path | None:
    places = [folder, *folder.parents[:2]] if folder.parent.name.startswith("lb3") else [folder]
    return next((place / name for place in places if (place / name).is_file()), None)


def _read(file: Path, form: str) -> dict[str, Any]:
    annotations: dict[str, Any] = {}
    for name, annotation in _rows(file, form):
        if name in annotations:
            raise SourceError(f"{file} tells of {name} twice")
        annotations[name] = annotation
    return annotations


def _rows(file: Path, form: str) -> Iterator[tuple[str, Any]]:
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            if form == "text":
                table = csv.DictReader(lines)
                if not {"name", "text"} <= set(table.fieldnames or ()):
                    raise SourceError(f"{file}: its first line names the columns name and text")
                for row in table:
                    if None in row:
                        trouble = "more cells than the first: put a text with commas between quotes"
                        raise SourceError(f"{file}, line {table.line_num}: {trouble}")
                    yield row["name"], row["text"] or ""
                return
            for number, line in enumerate(lines, 1):
                if not line.strip():
                    continue
                try:
                    row = json.loads(line)
                    name, objects = row["name"], list(row["objects"])
                except (ValueError, KeyError, TypeError) as error:
                    raise SourceError(
                        f'{file}, line {number}: expected {{"name": "1.jpg", "objects": [...]}}'
                    ) from error
                yield name, objects
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"{file} cannot be read: {error}") from error
