"""`deepsimbad map`, `info` and `localize`: a route mapped and asked without a server."""

import dataclasses
import json
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
INFO_KEYS = {
    *("name", "map_version", "route_length_m", "n_map_images", "n_landmarks", "list_length", "evaluator", "input_size"),
    *("index_bits_per_map_image", "actions_m"),
}


def sources(drives, part=""):
    return ("--landmarks", drives / "landmarks.npy", "--training", f"{drives / 'summer.npy'}{part}")


def contents(data_dir, version=1, domain="route"):
    with Catalog.open(data_dir) as catalog:
        return read_map(catalog.map_path(domain, version))


def test_a_map_is_made_and_described(deepsimbad, drives, tmp_path):
    ran = deepsimbad("map", "route", *sources(drives), *READY, "--n-landmarks", 20, "--data-dir", tmp_path / "here")
    assert (ran.code, ran.out, ran.err) == (0, "map 1 of route is active: 80 images, 20 landmarks\n", "")
    ran = deepsimbad("info", "route", "--json", "--data-dir", tmp_path / "here")
    document = json.loads(ran.out)
    assert (ran.code, ran.err) == (0, "")
    assert set(document) >= INFO_KEYS
    assert document["map_version"] == 1
    assert (document["n_map_images"], document["n_landmarks"], document["list_length"]) == (80, 20, 4)
    assert document["route_length_m"] == 79.0
    assert document["actions_m"] == list(range(1, 11))
    assert document["relevance"] == "composed"
    table = deepsimbad("info", "route", "--data-dir", tmp_path / "here")
    assert table.code == 0
    assert "n_map_images" in table.out
    assert re.search(r"index_bits_per_map_image +[0-9.]{2,8} *\n", table.out)
    sliced = sources(drives, part="#10:40:2")
    ran = deepsimbad("map", "route", *sliced, *READY, "--json", "--data-dir", tmp_path / "here")
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
    small = ("--evaluator", "feature_l2:gradient_grid", "--n-landmarks", 4, "--training-episodes", 0)
    assert deepsimbad("map", "plain", "--training", "one", *small, "--data-dir", "here").code == 0
    assert not thumbnails_path(tmp_path / "here", "plain").exists()
    assert deepsimbad("map", "route", "--training", "one", *small, "--thumbnails", "--data-dir", "here").code == 0
    two = ("--landmarks", "one", "--training", "two")
    assert deepsimbad("map", "route", *two, *small, "--data-dir", "here").code == 0, "as the domain does"
    assert deepsimbad("backup", "b.tar", "--data-dir", "here").code == 0
    assert deepsimbad("restore", "b.tar", "--data-dir", "there").code == 0
    assert deepsimbad("check", "--data-dir", "there").code == 0
    for drive, version in (("one", 1), ("two", 2)):
        map_ = contents(tmp_path / "there", version)
        map_ = dataclasses.replace(map_, domain="route", version=version)
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
    options = ("--n-landmarks", 12, "--list-length", 3, "--relevance", "rrf", "--training-episodes", 7, "--seed", 5)
    arguments = (*options, "--spacing-m", 2.5, "--closed", "--actions-m", "-2.5,0,5", "--data-dir", "here")
    ran = deepsimbad("map", "route", *sources(drives), *READY, *arguments)
    assert ran.code == 0, ran.err
    map_ = contents(tmp_path / "here")
    assert map_.lists.shape == (3, 80)
    assert map_.landmark_model["prototypes"].shape == (12, 16)
    assert (map_.closed, map_.actions_m.tolist()) == (True, [-2.5, 0, 5])
    assert map_.position_m.tolist() == (2.5 * np.arange(80)).tolist()
    assert map_.statistics is None
    expected = {"n_landmarks": 12, "list_length": 3, "relevance": "rrf", "training_episodes": 7, "seed": 5}
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
    assert deepsimbad(*arguments).code == 0
    assert (tmp_path / "deepsimbad-data" / "catalog.sqlite").exists()
    monkeypatch.setenv("DEEPSIMBAD_DATA_DIR", str(tmp_path / "from environment"))
    assert deepsimbad(*arguments).code == 0
    assert (tmp_path / "from environment" / "catalog.sqlite").exists()
    assert deepsimbad(*arguments, "--data-dir", tmp_path / "from flag").code == 0
    assert (tmp_path / "from flag" / "catalog.sqlite").exists()


def test_images_are_found_where_they_were_taken(deepsimbad, pictures, tmp_path):
    ran = deepsimbad("map", "route", "--landmarks", pictures, "--training", pictures, "--n-landmarks", 20)
    assert ran.code == 0, ran.err
    views = [pictures / "7.png", pictures / "21.png"]
    ran = deepsimbad("localize", "route", *views, "--json")
    assert (ran.code, ran.err) == (0, "")
    answers = json.loads(ran.out)
    assert [answer["image"] for answer in answers] == [str(view) for view in views]
    for answer, place in zip(answers, (7, 21), strict=True):
        assert set(answer) >= {"image", "map_version", "timings_ms", "belief", "retrieval", "next_best_view"}
        assert answer["retrieval"][0]["map_image"] == place
        assert answer["retrieval"][0]["frame"] == answer["belief"]["top"][0]["frame"] == f"{place}.png"
        assert answer["belief"]["mode_m"] == 3.0 * place
        assert answer["next_best_view"]["planner"] == "informed"
        assert answer["next_best_view"]["action_m"] in range(1, 11)
        assert answer["warnings"] == []
    lying = tmp_path / "lying.png"
    cv2.imwrite(str(lying), cv2.rotate(cv2.imread(str(views[0])), cv2.ROTATE_90_CLOCKWISE))
    (answer,) = json.loads(deepsimbad("localize", "route", lying, "--json").out)
    assert any("they lie on their side" in warning for warning in answer["warnings"])
    table = deepsimbad("localize", "route", *views)
    assert table.code == 0
    assert re.search(r"/7\.png +│ 7\.png +│ 21\.0 m", table.out), table.out
    assert "63.0 m" in table.out


def named_error(ran, *words):
    assert ran.code == 1
    assert ran.out == ""
    assert len(ran.err.splitlines()) == 1, ran.err
    assert re.match(r"deepsimbad: [a-z_]+: ", ran.err)
    for word in words:
        assert word in ran.err


def test_named_errors_are_one_line_and_make_nothing(deepsimbad, drives, pictures, tmp_path, monkeypatch):
    route = ("map", "route", *sources(drives), *READY)
    for command in (("info", "route"), ("localize", "route", "view.png")):
        named_error(deepsimbad(*command), "no domains in deepsimbad-data", "--data-dir")
    named_error(deepsimbad(*route, "--n-landmarks", 61), "60 candidates for 61 landmarks", "60 is the most that fit")
    with monkeypatch.context() as patched:
        patched.setenv("DEEPSIMBAD_MAX_PIXELS", "many")
        named_error(deepsimbad(*route), "max_pixels")
    assert not (tmp_path / "deepsimbad-data").exists()
    mistyped = ("--training", pictures, "--evaluator", "feature_l2:netvlad:mistyped.mat")
    named_error(deepsimbad("map", "route", *mistyped), "missing_weights", "mistyped.mat")
    named_error(deepsimbad("info", "route"), "no domains")
    named_error(deepsimbad("map", "route", *sources(drives, part="#::-1"), *READY, "--n-landmarks", 20), "backwards")
    assert not list((tmp_path / "deepsimbad-data").rglob("0*"))
    named_error(deepsimbad(*route, "--n-landmarks", 4, "--list-length", 5), "list_length 5")
    named_error(deepsimbad("map", "route", "--landmarks", "nowhere", "--training", pictures, *READY), "nowhere")
    images = ("--landmarks", pictures, "--training", pictures, "--n-landmarks", 20)
    named_error(deepsimbad("map", "route", *images, *READY), "ready encodings")
    named_error(deepsimbad(*route, "--actions-m", "5,-5"), "ascend")
    named_error(deepsimbad(*route, "--n-landmarks", 20, "--camera-of", "yard"), "yard")
    named_error(deepsimbad("map", "no/name", *sources(drives), *READY), "1 to 64 letters")
    named_error(deepsimbad("map", "route", *sources(drives), "--evaluator", "feature_l2:crystal_ball"), "extractor")
    named_error(deepsimbad("info", "nowhere"), "nowhere")
    named_error(deepsimbad("localize", "nowhere", pictures / "1.png"), "nowhere")
    named_error(deepsimbad("localize", "route", pictures / "1.png"), "route")  # it has no map
    named_error(deepsimbad("map", "route", *images, "--evaluator", "feature_l2"), "another configuration")


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
    named_error(deepsimbad(*command), "frames_left_out", *lost, "--allow-missing")
    assert not (tmp_path / "deepsimbad-data").exists()
    ran = deepsimbad(*command, "--allow-missing", "--verbose")
    assert ran.code == 0
    assert len(ran.err.splitlines()) == 3
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


def test_a_view_that_cannot_be_used_is_named(deepsimbad, pictures, tmp_path):
    deepsimbad("map", "route", "--landmarks", pictures, "--training", pictures, "--n-landmarks", 20)
    named_error(deepsimbad("localize", "route", tmp_path / "missing.png"), "missing.png")
    (tmp_path / "words.png").write_text("words")
    named_error(deepsimbad("localize", "route", pictures / "1.png", tmp_path / "words.png"), "words.png", "image")
    (tmp_path / "half.png").write_bytes((pictures / "1.png").read_bytes()[:-200])
    named_error(deepsimbad("localize", "route", tmp_path / "half.png"))


def test_encodings_and_what_is_told_are_localized_too(deepsimbad, drives, pictures, tmp_path):
    assert deepsimbad("map", "ready", *sources(drives), *READY, "--n-landmarks", 20).code == 0
    answers = json.loads(deepsimbad("localize", "ready", sources(drives)[-1] + "#3:5", "--json").out)
    assert [answer["image"][-3:] for answer in answers] == ["[3]", "[4]"]
    assert [answer["retrieval"][0]["map_image"] for answer in answers] == [3, 4]
    named_error(deepsimbad("localize", "ready", pictures / "1.png"), "1.png: ", "ready encodings alone")
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
    named_error(deepsimbad(*views), "view.json: the JSON is no object")


@pytest.mark.slow
def test_a_damaged_map_is_named_in_one_line(deepsimbad, process, pictures, tmp_path):
    """As a process, because a library's log would bypass what this one captures."""
    deepsimbad("map", "route", "--landmarks", pictures, "--training", pictures, "--n-landmarks", 20)
    with Catalog.open(tmp_path / "deepsimbad-data") as catalog:
        path = catalog.map_path("route", 1)
    path.chmod(0o644)
    body = bytearray(path.read_bytes())
    body[4096:8192] = bytes(4096)
    path.write_bytes(body)
    out, err = process("localize", "route", pictures / "1.png").communicate(timeout=60)
    assert out == ""
    assert err.startswith("deepsimbad: damaged_map: map 1 of domain route is damaged")
    assert len(err.splitlines()) == 1, err
    described = process("info", "route", "--json")
    out, err = described.communicate(timeout=60)
    assert (described.returncode, err) == (0, "")
    assert json.loads(out)["map_problem"] == "damaged_map"


@pytest.mark.parametrize(
    "arguments",
    [
        ("map",),
        ("map", "route"),
        ("map", "route", "--landmarks", "a", "--training", "b", "--n-landmarks", "0"),
        ("map", "route", "--landmarks", "a", "--training", "b", "--relevance", "magic"),
        ("map", "route", "--landmarks", "a", "--training", "b", "--spacing-m", "0"),
        ("map", "route", "--training", "b", "--actions-m", "far"),
        ("localize", "route"),
        ("info",),
        ("info", "route", "--yaml"),
        ("experiment", "vpr"),
        ("fly",),
    ],
)
def test_wrong_usage_ends_with_2_and_explains(deepsimbad, arguments):
    ran = deepsimbad(*arguments)
    assert (ran.code, ran.out) == (2, "")
    assert "Usage: " in ran.err


def test_the_version_is_the_distributions(process):
    out, err = process("--version").communicate(timeout=60)
    assert out.split()[-1].count(".") == 2
    assert err == ""


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
    assert running.returncode == 130, err
    assert out == ""
    assert err.startswith("cancelled while it was at: ")
    assert "no map was made, and the same command begins again" in err
    maps = stored.parent.parent / "maps"
    assert not maps.exists() or not list(maps.iterdir())
    with Catalog.open(tmp_path / "here") as catalog:
        assert catalog.maps("route") == []
        assert catalog.domain("route").active_version is None


def test_a_domain_is_deleted_when_that_is_confirmed(deepsimbad, drives, tmp_path):
    data_dir = ("--data-dir", tmp_path / "here")
    deepsimbad("map", "route", *sources(drives), *READY, "--n-landmarks", 20, *data_dir)
    ran = deepsimbad("delete-domain", "route", "--yes", *data_dir)
    assert (ran.code, ran.out) == (0, "domain route is deleted\n")
    assert deepsimbad("info", "route", *data_dir).code == 1
    assert deepsimbad("delete-domain", "route", "--yes", *data_dir).code == 1
