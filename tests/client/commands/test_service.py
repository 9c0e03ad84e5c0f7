"""The client against the real service, with nothing simulated between them."""

import json
import re
import threading

import cv2
import numpy as np
import pytest

from deepsimbad_client import errors
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import in_order, upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.passive import replay
from deepsimbad_client.replay.report import summarise

from ..conftest import ENCODINGS, draw


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


def test_another_drive_or_corrected_positions_never_pass_for_what_is_there(client, tmp_path, command, out):
    def upload_of(seed, n, metres, first_us=1_700_000_000_000_000):
        folder = draw(tmp_path / f"season {seed}", n, seed)
        lines = [f"{number}.png,{metres * number},{first_us + 200_000 * number}" for number in range(n)]
        (folder / "positions.csv").write_text("\n".join(["name,position_m,timestamp_us", *lines]))
        return ["upload", folder, "--domain", "identity", "--traverse", "drive"]

    client.admin.put_domain("identity", {"kind": "feature_l2", "extractor": "gradient_grid"})
    summer = upload_of(1, 6, 1)
    out(*summer)
    first = client.admin.traverse("identity", "drive")
    assert (first.n_frames, first.length_m, first.span_us) == (6, 5.0, (1_700_000_000_000_000, 1_700_000_001_000_000))
    assert re.search("0 frames sent.*6 were there already", out(*summer))
    for changed, differ in (
        ((1, 6, 7), "5 of the 6 that both have differ in position (1.png, 2.png, 3.png, ...)"),
        ((1, 6, 1, 1_600_000_000_000_000), "6 of the 6 that both have differ in time"),
        ((2, 8, 1), "6 of the 6 that both have differ in content"),
    ):
        result = command(*upload_of(*changed))
        assert differ in result.line
        assert "--replace" in result.line
        assert client.admin.traverse("identity", "drive") == first
    assert re.search("5 frames sent.*1 were there already", out(*upload_of(1, 6, 7), "--replace"))
    corrected = client.admin.traverse("identity", "drive")
    assert (corrected.n_frames, corrected.length_m) == (6, 35.0)
    out(*upload_of(1, 6, 1), "--replace")
    assert client.admin.traverse("identity", "drive").digest == first.digest != corrected.digest
    out(*upload_of(2, 8, 1), "--replace")
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


def test_images_with_a_broken_one_among_them(client, tmp_path, command, ends):
    folder = draw(tmp_path / "images", 8, form="{}.jpg", size=(320, 240))
    (folder / "3.jpg").write_bytes((folder / "3.jpg").read_bytes()[:-500])
    client.admin.put_domain("pictures", {"kind": "feature_l2"})
    report = upload(client, open_source(str(folder)), "pictures", "t", concurrency=3)
    assert (report.n_sent, report.n_broken.total(), report.broken_names) == (7, 1, ["3.jpg"])
    remap(client, "pictures", "t", landmark_traverse="t", n_landmarks=5, list_length=2)
    result = replay(client, open_source(str(folder)), "pictures", tmp_path / "out", tolerance_m=0, concurrency=2)
    summary = summarise(result)
    assert (summary["n_queries"], summary["n_broken"], summary["left_out"]) == (7, *[dict(report.n_broken)] * 2)
    too_many = "frames_left_out: 12% of the frames of images are left out: 1 undecodable (3.jpg); more than 5% need"
    for words in (("upload", "--traverse", "again"), ("replay", "--out", tmp_path / "again", "--no-plots")):
        ends(1, too_many, *words, "--domain", "pictures", folder)
        result = command(*words, "--domain", "pictures", folder, "--allow-missing", "--verbose")
        assert (result.code, "images: left out: 1 undecodable (3.jpg)" in result.err) == (0, True), result
    answer = client.localize("pictures", folder / "5.jpg", shortlist=3)
    assert len(answer.retrieval) == 3


def test_the_command_line_end_to_end(command, out, ends, encodings, tmp_path):
    for name, n_sent in (("landmarks", 60), ("summer", 120)):
        report = out("upload", encodings / f"{name}.npy", "--domain", "cli", "--traverse", name, "--json")
        assert report["n_sent"] == n_sent
    remap_words = ("remap", "--domain", "cli", "--training")
    job = out(*remap_words, "summer", "--landmarks", "landmarks", "--n-landmarks", "50", "--json")
    assert job["result"]["map_version"] == 1
    folder = tmp_path / "out"
    replay_words = ("replay", f"{encodings / 'winter.npy'}#:40", "--domain", "cli", "--out", folder)
    summary = out(*replay_words, "--json")
    assert summary == json.loads((folder / "summary.json").read_text())
    assert len((folder / "steps.jsonl").read_text().splitlines()) == 40
    for picture in ("rank_along_route", "belief_along_drive"):
        assert (folder / f"{picture}.png").read_bytes().startswith(b"\x89PNG")
    assert out(*replay_words, "--json")["anr"] == summary["anr"]  # a second run has nothing left to ask
    ends(1, "tolerance_m", *replay_words, "--tolerance", "9")
    assert "ANR" in out(*replay_words, "--restart", "--no-plots")
    assert "cli" in out("domains")
    assert "succeeded" in out("jobs")
    unfused = "the drive is not fused: the two drives are said not to share"
    ends(0, unfused, *remap_words, "landmarks", "--append", "--no-same-route")
    ends(1, "nowhere", *remap_words, "summer", "--camera-of", "nowhere")
    assert "nothing" in command(*remap_words, "nothing").line


def test_a_robot_that_may_go_backward_drives_a_map_of_its_own_landmarks(encodings, tmp_path, out, ends):
    upload_words = ("upload", encodings / "summer.npy", "--domain", "own", "--traverse", "summer", "--actions-m")
    ends(2, "give metres as -5,0,1,10", *upload_words, "1,x")
    ends(1, "ascend", *upload_words, "1,-5")
    out(*upload_words, "-5,0,1,10")
    remap_words = ("remap", "--domain", "own", "--training", "summer", "--n-landmarks", "40", "--json")
    assert out(*remap_words)["result"]["metrics"]["landmarks"] == "training_traverse"
    (answer,) = out("localize", "--json", "--domain", "own", f"{encodings / 'winter.npy'}#30:31")
    assert answer["belief"]["mode_m"] == 30
    assert out(*remap_words)["result"]["metrics"]["landmarks"] == "active_map"
    planners = ("constant:-5", "constant:0")
    planner_words = [word for planner in planners for word in ("--planner", planner)]
    drive_words = ("--domain", "own", "--out", tmp_path, "--no-plots", "--episodes", "2", "--steps", "2")
    out("replay", encodings / "winter.npy", *drive_words, *planner_words)
    steps = [json.loads(line) for line in (tmp_path / "steps.jsonl").read_text().splitlines()]
    moves_m = {planner: [step["action_m"] for step in steps if step["planner"] == planner] for planner in planners}
    assert moves_m == {"constant:-5": 2 * [0, -5, -5], "constant:0": 6 * [0]}
    assert max(step["travelled_m"] for step in steps) == 10
    assert all(step["error_m"] < 1 for step in steps if step["step"] == 2)


def test_places_on_the_command_line(client, encodings, tmp_path, command, out, ends):
    folder = draw(tmp_path / "look [here]", 6)
    client.admin.put_domain("places", {"kind": "feature_l2"})
    upload(client, open_source(str(folder)), "places", "t")
    remap(client, "places", "t", landmark_traverse="t", n_landmarks=6, list_length=2)
    localize = ("localize", "--domain", "places")
    answers = out(*localize, "--json", folder / "4.png", f"{folder}#1:3")
    assert [answer["retrieval"][0]["map_image"] for answer in answers] == [4, 1, 2]
    assert [answer["belief"]["top"][0]["frame"] for answer in answers] == ["4.png", "1.png", "2.png"]
    (answer,) = out("localize", "--json", "--domain", "route", f"{encodings / 'summer.npy'}#7:8")
    assert answer["retrieval"][0]["map_image"] == 7
    cv2.imwrite(str(tmp_path / "dark.png"), np.zeros((48, 64), np.uint8))
    result = command(*localize, folder / "4.png", tmp_path / "dark.png")
    assert (result.code, "likeliest [m]" in result.out) == (0, True)
    assert re.search(r"4\.png +│ 4\.png +│ +4\.0", result.out), result.out
    assert f"warning: the view told nothing of the place: 1 of 2 ({tmp_path / 'dark.png'})\n" in result.err
    client.admin.warm("places")
    for domains in ("places,route", "*"):
        (anywhere,) = out("localize", "--json", domains, folder / "4.png")
        assert (anywhere["domains"][0]["domain"], anywhere["top"][0]["map_image"]) == ("places", 4)
        assert "route" in [out["domain"] for out in anywhere["left_out"]]
    result = command("localize", "places,route", folder / "4.png")
    assert re.search(r"4\.png +│ places +│ +\d+\.\d +│ 4\.png", result.out), result.out
    assert (result.code, "elsewhere" in result.out, "route is left out" in result.err) == (0, True, True)
    answer = client.localize_anywhere(folder / "4.png", domains=["places", "route"], in_full=1)
    assert [out.code for out in answer.left_out] == ["unsupported_media_type"]
    assert answer.domains[0].probability + answer.others.probability + answer.elsewhere == pytest.approx(1)
    ends(1, "no recording", *localize, folder / "9.png")


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


def test_a_closed_domain_takes_one_turn_unasked(client, tmp_path, ends):
    turns = (2 * np.pi * number / 40 for number in range(60))
    lines = (f"{number}.png,{20 * np.cos(turn):.3f},{20 * np.sin(turn):.3f}" for number, turn in enumerate(turns))
    (draw(tmp_path, 60) / "positions.csv").write_text("\n".join(["name,x_m,y_m", *lines]))
    client.admin.put_domain("ring", {"kind": "feature_l2", "extractor": "gradient_grid"}, closed=True)
    second_turn = "19 frames of a second turn are not used"
    ends(0, second_turn, "upload", tmp_path, "--domain", "ring", "--traverse", "t")
    assert client.admin.traverse("ring", "t").n_frames == 41
