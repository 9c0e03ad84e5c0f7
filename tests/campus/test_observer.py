"""The detections and captions of a campus's pictures, and how a recording brings them."""

import csv
import json

import cv2
import numpy as np
import pytest

from deepsimbad.evaluators.objects import ObjectLayouts
from deepsimbad.evaluators.scenes import Objects, Scene
from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings.annotations import as_taken
from deepsimbad_client.recordings.sources import open_source


def test_detections_of_two_seasons_are_alike_at_a_place_and_differ_elsewhere(rendered):
    layouts = []
    for date in ("2012-01-22", "2012-08-04"):
        lines = [json.loads(line) for line in (rendered / date / "detections.jsonl").read_text().splitlines()]
        assert [line["name"] for line in lines] == sorted(
            file.name for file in (rendered / date / "lb3/Cam5").iterdir()
        )
        layouts.append(ObjectLayouts("none").encode([Scene(objects=Objects.read(line["objects"])) for line in lines]))
    likeness = np.einsum("nd,nd->n", *layouts)
    far_likeness = [row @ layouts[1][(place + 18) % 36] for place, row in enumerate(layouts[0])]
    assert np.median(likeness) > np.median(far_likeness)
    assert (likeness < 0.999).all()  # misses, false alarms, jitter


def test_a_recording_is_seen_as_its_domain_takes_it(rendered):
    recording = open_source(f"nclt:{rendered}/2012-08-04#2:5")
    objects = as_taken(recording, {"objects"})
    body = objects.image(objects.frames[0], None)
    assert body.content_type == "application/json"
    assert json.loads(body.body)["objects"]
    rows = csv.DictReader((rendered / "2012-08-04/captions.csv").read_text().splitlines())
    by_name = {row["name"]: row["text"] for row in rows}
    captions = as_taken(recording, {"text"})
    assert json.loads(captions.image(captions.frames[1], None).body) == {"text": by_name[captions.frames[1].name]}
    assert as_taken(recording, {"image"}) is recording
    form = as_taken(recording, {"image", "text"})
    assert form.image(form.frames[0], (64, 64)).content_type.startswith("multipart/form-data")


def test_what_is_not_told_is_named(tmp_path):
    for frame in range(2):
        (tmp_path / f"{frame}.png").write_bytes(_png())
    with pytest.raises(SourceError, match=r"has no captions\.csv"):
        as_taken(open_source(str(tmp_path)), {"text"})
    (tmp_path / "captions.csv").write_text("name,text\n0.png,a tree\n")
    captions = as_taken(open_source(str(tmp_path)), {"text"})
    with pytest.raises(BrokenFrameError, match=r"captions\.csv says nothing of 1\.png"):
        captions.image(captions.frames[1], None)


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("detections.jsonl", '{"name": "0.png"}', "line 1: expected"),
        ("detections.jsonl", '{"name": "0.png", "objects": null}', "line 1: expected"),
        ("detections.jsonl", '{"name": "0.png", "objects": []}\n{"name": "0.png", "objects": []}', r"0\.png twice"),
        ("captions.csv", "name,text\n0.png,a tree\n0.png,a car", r"0\.png twice"),
        ("captions.csv", "name,text\n0.png,a tree, and a car", "line 2: more cells than the first"),
    ],
)
def test_what_is_told_wrongly_is_named(tmp_path, file, text, says):
    (tmp_path / "0.png").write_bytes(_png())
    (tmp_path / file).write_text(text)
    with pytest.raises(SourceError, match=says):
        as_taken(open_source(str(tmp_path)), {"objects" if file == "detections.jsonl" else "text"})


def _png():
    return cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (20, 20, 3), np.uint8))[1].tobytes()
