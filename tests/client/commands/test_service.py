"""The client against the real service, with nothing simulated between them."""

import json
import re
import threading

import cv2
import numpy as np
import pytest

from deepsimbad_client import errors
from deepsimbad_client.commands import run
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import in_order, upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.passive import replay
from deepsimbad_client.replay.report import summarise

from ..conftest import ENCODINGS


def test_an_upload_goes_on_where_it_stopped(client, encodings, monkeypatch):
    monkeypatch.setattr("deepsimbad_client.http.upload.BATCH_BYTES", 10 * 32 * 4)

    def stop(progress):
        if progress.n_done >= 20:
            raise KeyboardInterrupt

    client.admin.put_domain("again", ENCODINGS)
    with pytest.raises(KeyboardInterrupt):
        upload(client, open_source(f"{encodings / 'summer.npy'}#10:"), "again", "t", on_progress=stop)
    assert client.admin.traverse("again", "t").missing == ((0, 9),)
    report = upload(client, open_source(str(encodings / "summer.npy")), "again", "t")
    assert (report.n_skipped, report.n_sent) == (20, 100)
    stored = client.admin.traverse("again", "t")
    assert (stored.n_frames, stored.missing) == (120, ())
    report_again = upload(client, open_source(str(encodings / "summer.npy")), "again", "t")
    assert (report_again.n_skipped, report_again.n_sent) == (120, 0)
    with pytest.raises(errors.OtherFramesError, match="again/t holds other frames than winter: 120 of the 120 that"):
        upload(client, open_source(str(encodings / "winter.npy")), "again", "t")
    with pytest.raises(errors.OtherFramesError, match="90 frames there are not of this recording, so delete it"):
        upload(client, open_source(f"{encodings / 'winter.npy'}#:30"), "again", "t", replace=True)
    assert client.admin.traverse("again", "t") == stored


def test_another_drive_or_corrected_positions_never_pass_for_what_is_there(client, tmp_path, capsys):
    def drive(name, seed, n, metres, first_us=1_700_000_000_000_000):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        rng = np.random.default_rng(seed)
        for number in range(n):
            cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(rng.integers(0, 255, (4, 6, 3), np.uint8), (96, 64)))
        lines = [f"{number}.png,{metres * number},{first_us + 200_000 * number}" for number in range(n)]
        (folder / "positions.csv").write_text("\n".join(["name,position_m,timestamp_us", *lines]))
        return ["upload", str(folder), "--server", client.url, "--domain", "identity", "--traverse", "drive"]

    def run_and_read(command):
        code, (out, err) = run(command), capsys.readouterr()
        return code, out, err

    client.admin.put_domain("identity", {"kind": "feature_l2", "extractor": "gradient_grid"})
    summer = drive("summer", 1, 6, 1)
    assert run_and_read(summer)[0] == 0
    first = client.admin.traverse("identity", "drive")
    assert (first.n_frames, first.length_m, first.span_us) == (6, 5.0, (1_700_000_000_000_000, 1_700_000_001_000_000))
    code, out, _ = run_and_read(summer)
    assert (code, "0 frames sent" in out, "6 were there already" in out) == (0, True, True)
    for changed, differ in (
        (("summer", 1, 6, 7), "5 of the 6 that both have differ in position (1.png, 2.png, 3.png, ...)"),
        (("summer", 1, 6, 1, 1_600_000_000_000_000), "6 of the 6 that both have differ in time"),
        (("winter", 2, 8, 1), "6 of the 6 that both have differ in content"),
    ):
        code, out, err = run_and_read(drive(*changed))
        assert (code, out) == (1, "")
        assert differ in err
        assert "--replace" in err
        assert client.admin.traverse("identity", "drive") == first
    code, out, _ = run_and_read([*drive("summer", 1, 6, 7), "--replace"])
    assert (code, "5 frames sent" in out, "1 were there already" in out) == (0, True, True)
    corrected = client.admin.traverse("identity", "drive")
    assert (corrected.n_frames, corrected.length_m) == (6, 35.0)
    assert run_and_read([*drive("summer", 1, 6, 1), "--replace"])[0] == 0
    assert client.admin.traverse("identity", "drive").digest == first.digest != corrected.digest
    assert run_and_read([*drive("winter", 2, 8, 1), "--replace"])[0] == 0
    assert client.admin.traverse("identity", "drive").n_frames == 8


def test_results_come_in_order_and_work_never_runs_far_ahead():
    items: list[int] = []
    release = threading.Event()

    def work(item):
        items.append(item)
        if item == 0:
            release.wait(60)
        return item * item

    results = in_order(work, range(100), 4)
    release.set()
    assert next(results) == (0, 0)
    assert max(items) < 8
    assert [result for _, result in results] == [item * item for item in range(1, 100)]


def test_a_failure_comes_in_its_turn_and_stops_the_rest():
    items: list[int] = []

    def work(item):
        items.append(item)
        if item == 5:
            raise errors.ReplayError("five")
        return item

    with pytest.raises(errors.ReplayError, match="five"):
        list(in_order(work, range(1000), 2))
    assert len(items) < 20


def test_images_with_a_broken_one_among_them(client, tmp_path, capsys):
    folder = tmp_path / "images"
    folder.mkdir()
    rng = np.random.default_rng(3)
    for number in range(8):
        picture = cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number}.jpg"), picture)
    (folder / "3.jpg").write_bytes((folder / "3.jpg").read_bytes()[:-500])
    client.admin.put_domain("pictures", {"kind": "feature_l2"})
    report = upload(client, open_source(str(folder)), "pictures", "t", concurrency=3)
    assert (report.n_sent, report.n_broken.total(), report.broken_names) == (7, 1, ["3.jpg"])
    remap(client, "pictures", "t", landmark_traverse="t", n_landmarks=5, list_length=2)
    result = replay(client, open_source(str(folder)), "pictures", tmp_path / "out", tolerance_m=0, concurrency=2)
    summary = summarise(result)
    assert (summary["n_queries"], summary["n_broken"], summary["left_out"]) == (7, *[dict(report.n_broken)] * 2)
    too_many = "frames_left_out: 12% of the frames of images are left out: 1 undecodable (3.jpg); more than 5% need"
    commands = (["upload", "--traverse", "again"], ["replay", "--out", str(tmp_path / "again"), "--no-plots"])
    for command in commands:
        command += ["--server", client.url, "--domain", "pictures", str(folder)]
        capsys.readouterr()
        assert run(command) == 1
        assert too_many in capsys.readouterr().err
        assert run([*command, "--allow-missing", "--verbose"]) == 0
        assert "images: left out: 1 undecodable (3.jpg)" in capsys.readouterr().err
    answer = client.localize("pictures", folder / "5.jpg", shortlist=3)
    assert len(answer.retrieval) == 3


def test_the_command_line_end_to_end(service, encodings, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("DEEPSIMBAD_URL", service)
    for name in ("landmarks", "summer"):
        assert run(["upload", str(encodings / f"{name}.npy"), "--domain", "cli", "--traverse", name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out.partition("}\n{")[0] + "}")["n_sent"] == 60
    command = ["remap", "--domain", "cli", "--training", "summer", "--landmarks", "landmarks", "--n-landmarks", "50"]
    assert run([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["map_version"] == 1
    out = tmp_path / "out"
    command = ["replay", f"{encodings / 'winter.npy'}#:40", "--domain", "cli", "--out", str(out)]
    assert run([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "summary.json").read_text())
    assert len((out / "steps.jsonl").read_text().splitlines()) == 40
    for picture in ("rank_along_route", "belief_along_drive"):
        assert (out / f"{picture}.png").read_bytes().startswith(b"\x89PNG")
    assert run([*command, "--json"]) == 0  # a second run has nothing left to ask
    assert json.loads(capsys.readouterr().out)["anr"] == printed["anr"]
    assert run([*command, "--tolerance", "9"]) == 1
    assert "tolerance_m" in capsys.readouterr().err
    assert run([*command, "--restart", "--no-plots"]) == 0
    assert "ANR" in capsys.readouterr().out
    assert run(["domains"]) == 0
    assert "cli" in capsys.readouterr().out
    assert run(["jobs"]) == 0
    assert "succeeded" in capsys.readouterr().out
    assert run(["remap", "--domain", "cli", "--training", "landmarks", "--append", "--no-same-route"]) == 0
    assert "the drive is not fused: the two drives are said not to share" in capsys.readouterr().err
    assert run(["remap", "--domain", "cli", "--training", "summer", "--camera-of", "nowhere"]) == 1
    assert "nowhere" in capsys.readouterr().err
    assert run(["remap", "--domain", "cli", "--training", "nothing"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_robot_that_may_go_backward_drives_a_map_of_its_own_landmarks(
    service, encodings, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("DEEPSIMBAD_URL", service)
    upload_command = ["upload", str(encodings / "summer.npy"), "--domain", "own", "--traverse", "summer", "--actions-m"]
    assert run([*upload_command, "1,x"]) == 2
    assert run([*upload_command, "1,-5"]) == 1
    assert "ascend" in capsys.readouterr().err
    assert run([*upload_command, "-5,0,1,10"]) == 0
    capsys.readouterr()
    command = ["remap", "--domain", "own", "--training", "summer", "--n-landmarks", "40", "--json"]
    assert run(command) == 0
    job = json.loads(capsys.readouterr().out)
    assert job["result"]["metrics"]["landmarks"] == "training_traverse"
    assert run(["localize", "--json", "--domain", "own", f"{encodings / 'winter.npy'}#30:31"]) == 0
    (answer,) = json.loads(capsys.readouterr().out)
    assert answer["belief"]["mode_m"] == 30
    assert run(command) == 0
    assert json.loads(capsys.readouterr().out)["result"]["metrics"]["landmarks"] == "active_map"
    planners = ("constant:-5", "constant:0")
    replay_command = ["replay", str(encodings / "winter.npy"), "--domain", "own", "--out", str(tmp_path), "--no-plots"]
    planner_words = [word for planner in planners for word in ("--planner", planner)]
    assert run([*replay_command, *planner_words, "--episodes", "2", "--steps", "2"]) == 0
    steps = [json.loads(line) for line in (tmp_path / "steps.jsonl").read_text().splitlines()]
    moves_m = {planner: [step["action_m"] for step in steps if step["planner"] == planner] for planner in planners}
    assert moves_m == {"constant:-5": 2 * [0, -5, -5], "constant:0": 6 * [0]}
    assert max(step["travelled_m"] for step in steps) == 10
    assert all(step["error_m"] < 1 for step in steps if step["step"] == 2)


def test_places_on_the_command_line(client, encodings, tmp_path, capsys):
    folder = tmp_path / "look [here]"
    folder.mkdir()
    rng = np.random.default_rng(5)
    for number in range(6):
        cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(rng.integers(0, 255, (4, 6, 3), np.uint8), (96, 64)))
    client.admin.put_domain("places", {"kind": "feature_l2"})
    upload(client, open_source(str(folder)), "places", "t")
    remap(client, "places", "t", landmark_traverse="t", n_landmarks=6, list_length=2)
    command = ["localize", "--server", client.url]
    assert run([*command, "--json", "--domain", "places", str(folder / "4.png"), f"{folder}#1:3"]) == 0
    answers = json.loads(capsys.readouterr().out)
    assert [answer["retrieval"][0]["map_image"] for answer in answers] == [4, 1, 2]
    assert [answer["belief"]["top"][0]["frame"] for answer in answers] == ["4.png", "1.png", "2.png"]
    assert run([*command, "--json", "--domain", "route", f"{encodings / 'summer.npy'}#7:8"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["retrieval"][0]["map_image"] == 7
    assert run([*command, "--domain", "places", str(folder / "4.png")]) == 0
    printed = capsys.readouterr().out
    assert "likeliest [m]" in printed
    assert re.search(r"4\.png +│ 4\.png +│ +4\.0", printed), printed
    client.admin.warm("places")
    for domains in ("places,route", "*"):
        assert run([*command, "--json", domains, str(folder / "4.png")]) == 0
        (anywhere,) = json.loads(capsys.readouterr().out)
        assert (anywhere["domains"][0]["domain"], anywhere["top"][0]["map_image"]) == ("places", 4)
        assert "route" in [out["domain"] for out in anywhere["left_out"]]
    assert run([*command, "places,route", str(folder / "4.png")]) == 0
    printed = capsys.readouterr()
    assert re.search(r"4\.png +│ places +│ +\d+\.\d +│ 4\.png", printed.out), printed.out
    assert "elsewhere" in printed.out
    assert "route is left out" in printed.err
    answer = client.localize_anywhere(folder / "4.png", domains=["places", "route"], in_full=1)
    assert [out.code for out in answer.left_out] == ["unsupported_media_type"]
    assert answer.domains[0].probability + answer.others.probability + answer.elsewhere == pytest.approx(1)
    assert run([*command, "--domain", "places", str(folder / "9.png")]) == 1
    assert "no recording" in capsys.readouterr().err


def test_a_second_drive_that_shares_no_frame_with_the_first_is_refused_and_a_part_of_one_goes_on(client, encodings):
    client.admin.put_domain("parts", ENCODINGS)
    summer, winter = (str(encodings / f"{season}.npy") for season in ("summer", "winter"))
    upload(client, open_source(f"{summer}#:60"), "parts", "t")
    stored = client.admin.traverse("parts", "t")
    for replace in (False, True):
        with pytest.raises(errors.OtherFramesError, match="another recording than winter: 60 beside"):
            upload(client, open_source(f"{winter}#60:"), "parts", "t", replace=replace)
    assert client.admin.traverse("parts", "t") == stored
    assert upload(client, open_source(f"{summer}#60:"), "parts", "t").n_sent == 60
    assert upload(client, open_source(f"{summer}#100:"), "parts", "t").n_skipped == 20


def test_a_closed_domain_takes_one_turn_unasked(client, tmp_path, capsys):
    lines = ["name,x_m,y_m"]
    for number in range(60):
        turn = 2 * np.pi * number / 40
        cv2.imwrite(str(tmp_path / f"{number:02d}.png"), np.full((48, 64, 3), number, np.uint8))
        lines.append(f"{number:02d}.png,{20 * np.cos(turn):.3f},{20 * np.sin(turn):.3f}")
    (tmp_path / "positions.csv").write_text("\n".join(lines))
    client.admin.put_domain("ring", {"kind": "feature_l2", "extractor": "gradient_grid"}, closed=True)
    assert run(["upload", str(tmp_path), "--server", client.url, "--domain", "ring", "--traverse", "t"]) == 0
    assert "19 frames of a second turn are not used" in capsys.readouterr().err
    assert client.admin.traverse("ring", "t").n_frames == 41
