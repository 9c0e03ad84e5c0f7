"""`deepsimbad map`, `info` and `localize`: a route mapped and asked without a server."""

import dataclasses
import json
import os
import re
import shutil
import signal
import time

import cv2
import numpy as np
import pytest

from deepsimbad.engine.pictures import Pictures
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.layout import thumbnails_path
from deepsimbad.store.map_file import read_map

READY = ("--evaluator", "feature_l2:none")
SMALL = ("--evaluator", "feature_l2:gradient_grid", "--n-landmarks", 4, "--training-episodes", 0)


def sources(drives, part=""):
    return ("--landmarks", drives / "landmarks.npy", "--training", f"{drives / 'summer.npy'}{part}")


def contents(data_dir, version=1):
    with Catalog.open(data_dir) as catalog:
        return read_map(catalog.map_path("route", version))


@pytest.fixture
def mapped_pictures(deepsimbad, pictures):
    """A map `route` of the pictures, as an argument for its landmarks and training."""
    ran = deepsimbad("map", "route", "--landmarks", pictures, "--training", pictures, "--n-landmarks", 20)
    assert ran.code == 0, ran.err


def test_a_map_is_made_and_described(deepsimbad, drives, tmp_path):
    folder = ("--data-dir", tmp_path / "here")
    ran = deepsimbad("map", "route", *sources(drives), *READY, "--n-landmarks", 20, *folder)
    assert (ran.code, ran.out, ran.err) == (0, "map 1 of route is active: 80 images, 20 landmarks\n", "")
    ran = deepsimbad("info", "route", "--json", *folder)
    document = json.loads(ran.out)
    assert (ran.code, ran.err) == (0, "")
    assert set(document) >= {"name", "evaluator", "input_size", "index_bits_per_map_image"}
    expected = {"map_version": 1, "n_map_images": 80, "n_landmarks": 20, "list_length": 4, "route_length_m": 79.0}
    expected |= {"actions_m": list(range(1, 11)), "relevance": "composed"}
    assert {name: document[name] for name in expected} == expected
    table = deepsimbad("info", "route", *folder)
    assert (table.code, "n_map_images" in table.out) == (0, True)
    assert re.search(r"index_bits_per_map_image +[0-9.]{2,8} *\n", table.out)
    ran = deepsimbad("map", "route", *sources(drives, part="#10:40:2"), *READY, "--json", *folder)
    assert (ran.code, ran.err) == (0, "")
    second = json.loads(ran.out)
    assert (second["domain"], second["map_version"], second["active"]) == ("route", 2, True)
    assert second["metrics"]["n_map_images"] == 15
    map_ = contents(tmp_path / "here", 2)
    assert map_.position_m.tolist() == list(range(10, 40, 2)), "a slice keeps its frames' positions"
    assert map_.n_landmarks == 60, "landmarks default to every frame of a short recording"


def test_pictures_are_kept_where_the_domain_says_so_and_go_into_backups(deepsimbad, tmp_path):
    rng = np.random.default_rng(4)
    for drive in ("one", "two"):
        (tmp_path / drive).mkdir()
        for number in range(6):
            picture = cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (160, 120))
            cv2.imwrite(str(tmp_path / drive / f"{number}.jpg"), picture)
    for arguments in (
        ("map", "plain", "--training", "one", *SMALL, "--data-dir", "here"),
        ("map", "route", "--training", "one", *SMALL, "--thumbnails", "--data-dir", "here"),
        ("map", "route", "--landmarks", "one", "--training", "two", *SMALL, "--data-dir", "here"),  # as the domain does
        ("backup", "b.tar", "--data-dir", "here"),
        ("restore", "b.tar", "--data-dir", "there"),
        ("check", "--data-dir", "there"),
    ):
        assert deepsimbad(*arguments).code == 0
        assert not thumbnails_path(tmp_path / "here", "plain").exists()
    for drive, version in (("one", 1), ("two", 2)):
        map_ = dataclasses.replace(contents(tmp_path / "there", version), domain="route", version=version)
        images = [(drive, map_.frame_digest, number, name) for number, name in enumerate(map_.frames)]
        landmarks = [("one", map_.landmark_digest, number, name) for number, name in enumerate(map_.landmark_frame)]
        assert (len(images), len(landmarks)) == (6, 4)
        for of_drive, digests, number, name in images + landmarks:
            thumbnail = Pictures(tmp_path / "there", 1 << 24).of_frame(map_, digests, number)
            image = cv2.imread(str(tmp_path / of_drive / name))
            small_image = cv2.imdecode(np.frombuffer(thumbnail, np.uint8), cv2.IMREAD_COLOR)
            assert small_image.shape == (96, 128, 3)
            assert np.abs(cv2.resize(image, (128, 96)).astype(int) - small_image).mean() < 12


def test_pictures_under_a_lens_cap_are_counted(deepsimbad, pictures, tmp_path):
    (tmp_path / "capped").mkdir()
    for place in range(12):
        picture = cv2.imread(str(pictures / f"{place}.png"))
        cv2.imwrite(str(tmp_path / "capped" / f"{place}.png"), picture * (not 3 <= place < 6))
    ran = deepsimbad("map", "route", "--training", "capped", "--evaluator", "feature_l2:gradient_grid")
    assert ran.code == 0, ran.err
    assert "warning: 3 of 12 pictures of the map show nothing" in ran.err


def test_every_option_of_a_map_is_heeded(deepsimbad, drives, tmp_path):
    expected = {"n_landmarks": 12, "list_length": 3, "relevance": "rrf", "training_episodes": 7, "seed": 5}
    options = [part for name, value in expected.items() for part in (f"--{name.replace('_', '-')}", value)]
    arguments = (*options, "--spacing-m", 2.5, "--closed", "--actions-m", "-2.5,0,5", "--data-dir", "here")
    ran = deepsimbad("map", "route", *sources(drives), *READY, *arguments)
    assert ran.code == 0, ran.err
    map_ = contents(tmp_path / "here")
    assert (map_.lists.shape, map_.landmark_model["prototypes"].shape) == ((3, 80), (12, 16))
    assert (map_.closed, map_.actions_m.tolist()) == (True, [-2.5, 0, 5])
    assert map_.position_m.tolist() == (2.5 * np.arange(80)).tolist()
    assert map_.statistics is None
    assert {name: map_.config[name] for name in expected} == expected


def test_two_seasons_are_learnt_from_where_the_route_is_said_to_be_one(deepsimbad, drives):
    """Of drives without x, y; and where their views differ, or too few are of the same places, people are told."""

    def make(landmarks, *options, part=""):
        pair = ("--landmarks", drives / f"{landmarks}.npy", "--training", f"{drives / 'summer.npy'}{part}")
        ran = deepsimbad("map", landmarks, *pair, *READY, "--n-landmarks", 40, "--training-episodes", 0, *options)
        assert ran.code == 0, ran.err
        return ran

    verdicts = [
        json.loads(make("winter", *options, "--json").out)["metrics"]["second_season"]
        for options in ((), ("--same-route",), ("--no-same-route",))
    ]
    assert [season["accepted"] for season in verdicts] == [False, True, False]
    assert make("winter", "--same-route").err == make("landmarks").err == ""
    assert "it learnt nothing of a second season: at equal positions" in make("landmarks", "--same-route").err
    errors = make("winter", "--same-route", part="#:29").err
    assert "it learnt nothing of a second season: the two drives share 29 places by their positions" in errors
    assert "second season" not in make("winter", part="#:29").err


def test_the_data_directory_comes_from_the_flag_the_environment_or_here(deepsimbad, drives, tmp_path, monkeypatch):
    arguments = ("map", "route", *sources(drives), *READY, "--n-landmarks", 20)
    monkeypatch.setenv("DEEPSIMBAD_DATA_DIR", str(tmp_path / "from environment"))
    for folder, flag in (("from flag", ("--data-dir", tmp_path / "from flag")), ("from environment", ())):
        assert deepsimbad(*arguments, *flag).code == 0
        assert [path.parent.name for path in tmp_path.glob("*/catalog.sqlite")] == [folder]
        shutil.rmtree(tmp_path / folder)  # here: as every other test has it


def test_a_data_directory_may_have_any_name(deepsimbad, drives):
    folder = ("--data-dir", os.fsdecode(b"caf\xe9"))  # no UTF-8
    for arguments in (("map", "route", *sources(drives), *READY), ("backup", "b.tar")):
        assert deepsimbad(*arguments, *folder).code == 0


def test_images_are_found_where_they_were_taken(deepsimbad, mapped_pictures, pictures, tmp_path):
    views = [pictures / "7.png", pictures / "21.png"]
    ran = deepsimbad("localize", "route", *views, "--json")
    assert (ran.code, ran.err) == (0, "")
    answers = json.loads(ran.out)
    assert [answer["image"] for answer in answers] == [str(view) for view in views]
    for answer, place in zip(answers, (7, 21), strict=True):
        assert set(answer) >= {"image", "map_version", "timings_ms", "belief", "retrieval", "next_best_view"}
        best, top, move = answer["retrieval"][0], answer["belief"]["top"][0], answer["next_best_view"]
        assert (best["map_image"], best["frame"], top["frame"]) == (place, f"{place}.png", f"{place}.png")
        assert (answer["belief"]["mode_m"], answer["warnings"]) == (3.0 * place, [])
        assert (move["planner"], move["action_m"] in range(1, 11)) == ("informed", True)
    lying = tmp_path / "lying.png"
    cv2.imwrite(str(lying), cv2.rotate(cv2.imread(str(views[0])), cv2.ROTATE_90_CLOCKWISE))
    (answer,) = json.loads(deepsimbad("localize", "route", lying, "--json").out)
    (warning,) = [warning for warning in answer["warnings"] if "they lie on their side" in warning]
    table = deepsimbad("localize", "route", *views, lying)
    assert table.code == 0
    assert f"warning: {warning}: 1 of 3 ({lying})\n" in table.err
    assert re.search(r"/7\.png +│ 7\.png +│ 21\.0 m", table.out), table.out
    assert "63.0 m" in table.out


def test_named_errors_are_one_line_and_make_nothing(deepsimbad, drives, pictures, tmp_path, monkeypatch):
    route = ("map", "route", *sources(drives), *READY)
    images = ("map", "route", "--landmarks", pictures, "--training", pictures, "--n-landmarks", 20)
    folder = tmp_path / "deepsimbad-data"
    for command in (("info", "route"), ("localize", "route", "view.png")):
        assert re.search("no domains in deepsimbad-data.*--data-dir", deepsimbad(*command).line)
    line = deepsimbad(*route, "--n-landmarks", 61).line
    assert re.search(r"60 candidates for 61 landmarks.*60 is the most that fit", line)
    with monkeypatch.context() as patched:
        patched.setenv("DEEPSIMBAD_MAX_PIXELS", "many")
        assert "max_pixels" in deepsimbad(*route).line
    assert not folder.exists()
    mistyped = deepsimbad("map", "route", "--training", pictures, "--evaluator", "feature_l2:netvlad:mistyped.mat")
    assert re.search(r"missing_weights.*mistyped\.mat", mistyped.line)
    assert "no domains" in deepsimbad("info", "route").line
    for evaluator in (READY[1], "objects"):  # a domain that holds nothing is left by neither, to forbid the other
        line = deepsimbad(
            "map", "route", "--training", sources(drives, part="#::-1")[-1], "--evaluator", evaluator
        ).line
        assert "domain_differs" not in line
    assert "unknown_domain" in deepsimbad("info", "route").line
    backwards = deepsimbad("map", "route", *sources(drives, part="#::-1"), *READY, "--n-landmarks", 20)
    assert "backwards" in backwards.line
    assert not list(folder.rglob("0*"))
    for command, word in (
        ((*route, "--n-landmarks", 4, "--list-length", 5), "list_length 5"),
        (("map", "route", "--landmarks", "nowhere", "--training", pictures, *READY), "nowhere"),
        ((*images, *READY), "ready encodings"),
        ((*route, "--actions-m", "5,-5"), "ascend"),
        ((*route, "--n-landmarks", 20, "--camera-of", "yard"), "yard"),
        (("map", "no/name", *sources(drives), *READY), "1 to 64 letters"),
        (("map", "route", *sources(drives), "--evaluator", "feature_l2:crystal_ball"), "extractor"),
        (("info", "nowhere"), "nowhere"),
        (("localize", "nowhere", pictures / "1.png"), "nowhere"),
        (("localize", "route", pictures / "1.png"), "route"),  # it has no map
        ((*images, "--evaluator", "feature_l2"), "delete it first"),  # it has frames
    ):
        assert word in deepsimbad(*command).line


def test_no_frame_is_left_out_of_a_map_without_a_word(deepsimbad, pictures, tmp_path):
    drive = shutil.copytree(pictures, tmp_path / "drive")
    (drive / "1.png").write_bytes(b"no image")
    command = ("map", "route", "--training", drive, "--training-episodes", 0)
    ran = deepsimbad(*command)
    assert (ran.code, ran.err) == (0, "training: left out: 1 undecodable (1.png)\n")
    shutil.rmtree(tmp_path / "deepsimbad-data")
    positions = (drive / "positions.csv").read_text()
    (drive / "positions.csv").write_text(positions.replace("0.png", "x.png"))  # 0, 10 and 20
    lost = (
        "3 not in positions.csv (0.png, 10.png, 20.png)",
        "3 in positions.csv without an image (x.png, 1x.png, 2x.png)",
    )
    line = deepsimbad(*command).line
    assert all(word in line for word in ("frames_left_out", *lost, "--allow-missing"))
    assert not (tmp_path / "deepsimbad-data").exists()
    ran = deepsimbad(*command, "--allow-missing", "--verbose")
    assert (ran.code, len(ran.err.splitlines())) == (0, 3)
    assert all(line in ran.err for line in lost)


def test_a_raw_image_of_nclt_is_turned_upright_in_map_and_localize(deepsimbad, pictures, tmp_path):
    camera = tmp_path / "lb3" / "Cam5"
    camera.mkdir(parents=True)
    for place in range(8):
        lying = cv2.rotate(
            cv2.imread(str(pictures / f"{place}.png")).transpose(1, 0, 2), cv2.ROTATE_90_COUNTERCLOCKWISE
        )
        cv2.imwrite(str(camera / f"{1_326_030_975_000_000 + place}.tiff"), lying)
    ran = deepsimbad("map", "route", "--training", camera, "--training-episodes", 0)
    assert (ran.code, ran.err.count("turned upright")) == (0, 1)
    ran = deepsimbad("localize", "route", camera / "1326030975000005.tiff", "--json")
    assert "turned upright" in ran.err
    (answer,) = json.loads(ran.out)
    assert answer["belief"]["mode_m"] == 5
    upright = cv2.rotate(cv2.imread(str(camera / "1326030975000005.tiff")), cv2.ROTATE_90_CLOCKWISE)
    cv2.imwrite(str(tmp_path / "upside_down.png"), cv2.rotate(upright, cv2.ROTATE_180))
    ran = deepsimbad("localize", "route", tmp_path / "upside_down.png", "--rotate", 180, "--json")
    assert json.loads(ran.out)[0]["belief"] == answer["belief"]


def test_a_view_that_cannot_be_used_is_named(deepsimbad, mapped_pictures, pictures, tmp_path):
    assert "missing.png" in deepsimbad("localize", "route", tmp_path / "missing.png").line
    (tmp_path / "words.png").write_text("words")
    line = deepsimbad("localize", "route", pictures / "1.png", tmp_path / "words.png").line
    assert re.search(r"words\.png.* image", line)
    (tmp_path / "half.png").write_bytes((pictures / "1.png").read_bytes()[:-200])
    assert "half.png" in deepsimbad("localize", "route", tmp_path / "half.png").line


def test_encodings_and_what_is_told_are_localized_too(deepsimbad, drives, pictures, tmp_path):
    assert deepsimbad("map", "ready", *sources(drives), *READY, "--n-landmarks", 20).code == 0
    answers = json.loads(deepsimbad("localize", "ready", sources(drives)[-1] + "#3:5", "--json").out)
    places = [(answer["image"][-3:], answer["retrieval"][0]["map_image"]) for answer in answers]
    assert places == [("[3]", 3), ("[4]", 4)]
    assert re.search(r"1\.png: .*ready encodings alone", deepsimbad("localize", "ready", pictures / "1.png").line)
    drive = shutil.copytree(pictures, tmp_path / "told")
    scenes = [{"objects": [{"label": f"sign {at}", "box": [0.1, 0.1, 0.3, 0.2 + at / 50]}]} for at in range(30)]
    lines = [json.dumps({"name": f"{at}.png", **scene}) for at, scene in enumerate(scenes)]
    (drive / "detections.jsonl").write_text("\n".join(lines))
    ran = deepsimbad("map", "told", "--training", drive, "--evaluator", "objects", "--training-episodes", 0)
    assert ran.code == 0, ran.err
    (tmp_path / "view.json").write_text(json.dumps(scenes[7]))
    views = ("localize", "told", tmp_path / "view.json", drive / "9.png", f"{drive}#11:12")
    answers = json.loads(deepsimbad(*views, "--json").out)
    assert [answer["retrieval"][0]["map_image"] for answer in answers] == [7, 9, 11]
    (tmp_path / "view.json").write_text("[1]")
    assert "view.json: the JSON is no object" in deepsimbad(*views).line


@pytest.mark.slow
def test_a_damaged_map_is_named_in_one_line(mapped_pictures, process, pictures, tmp_path):
    """As a process, because a library's log would bypass what this one captures."""
    with Catalog.open(tmp_path / "deepsimbad-data") as catalog:
        path = catalog.map_path("route", 1)
    path.chmod(0o644)
    body = bytearray(path.read_bytes())
    body[4096:8192] = bytes(4096)
    path.write_bytes(body)
    out, err = process("localize", "route", pictures / "1.png").communicate(timeout=60)
    assert (out, len(err.splitlines())) == ("", 1), err
    assert err.startswith("deepsimbad: damaged_map: map 1 of domain route is damaged")
    described = process("info", "route", "--json")
    out, err = described.communicate(timeout=60)
    assert (described.returncode, err, json.loads(out)["map_problem"]) == (0, "", "damaged_map")


@pytest.mark.parametrize(
    "arguments",
    [
        *("map", "map route", "localize route", "info", "info route --yaml", "experiment vpr", "fly"),
        "map route --landmarks a --training b --n-landmarks 0",
        "map route --landmarks a --training b --relevance magic",
        "map route --landmarks a --training b --spacing-m 0",
        "map route --training b --actions-m far",
    ],
)
def test_wrong_usage_ends_with_2_and_explains(deepsimbad, arguments):
    ran = deepsimbad(*arguments.split())
    assert (ran.code, ran.out) == (2, "")
    assert "Usage: " in ran.err


def test_the_version_is_the_distributions(process):
    out, err = process("--version").communicate(timeout=60)
    assert (out.split()[-1].count("."), err) == (2, "")


@pytest.mark.slow
def test_ctrl_c_cancels_a_map_and_leaves_no_half_of_one(process, tmp_path):
    rng = np.random.default_rng(0)
    for name, n_frames in (("many", 16_000), ("few", 60)):
        np.save(tmp_path / f"{name}.npy", rng.normal(size=(n_frames, 256)).astype(np.float32))
    running = process(
        *("map", "route", "--landmarks", "many.npy", "--training", "few.npy", *READY, "--data-dir", "here")
    )
    stored = tmp_path / "here" / "domains" / "route" / "traverses" / "training.sqlite"
    give_up = time.monotonic() + 60
    while not stored.exists():
        assert running.poll() is None, running.communicate()
        assert time.monotonic() < give_up
        time.sleep(0.005)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=60)
    assert (running.returncode, out) == (130, ""), err
    assert err.startswith("cancelled while it was at: ")
    assert "no map was made, and the same command begins again" in err
    assert list(stored.parent.parent.glob("maps/*")) == []
    with Catalog.open(tmp_path / "here") as catalog:
        assert (catalog.maps("route"), catalog.domain("route").active_version) == ([], None)


def test_a_domain_is_deleted_when_that_is_confirmed(deepsimbad, mapped_dir):
    ran = deepsimbad("delete-domain", "route", "--yes")
    assert (ran.code, ran.out) == (0, "domain route is deleted\n")
    for command in (("info", "route"), ("delete-domain", "route", "--yes")):
        assert "unknown_domain" in deepsimbad(*command).line
