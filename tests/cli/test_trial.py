"""`deepsimbad try`: two drives in, figures and a page out."""

import json
import os
import re
import shutil
from base64 import b64decode
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from deepsimbad.cli.trial import Album
from deepsimbad.core.drive import Drive
from deepsimbad.errors import CancelledError
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad_client.recordings.sources import open_source

QUICK = ("--evaluator", "feature_l2:gradient_grid")
SWAPPED = (7, 21)


@pytest.fixture(scope="module")
def queries(pictures, tmp_path_factory):
    """The same drive with noise, two of its thirty images taken for each other, one with a name that is markup."""
    folder = tmp_path_factory.mktemp("queries")
    rng = np.random.default_rng(5)
    place_of = dict(zip(SWAPPED, reversed(SWAPPED), strict=True))
    lines = ["name,position_m"]
    for place in range(30):
        image = cv2.imread(str(pictures / f"{place_of.get(place, place)}.png"))
        noisy = np.clip(image + rng.normal(0, 8, image.shape), 0, 255).astype(np.uint8)
        name = "3<script>.png" if place == 3 else f"{place}.png"
        cv2.imwrite(str(folder / name), noisy)
        lines.append(f"{name},{3 * place}")
    (folder / "positions.csv").write_text("\n".join(lines))
    return folder


class Parts(HTMLParser):
    """What a page holds, in order: (tag, attributes)."""

    def __init__(self, text):
        super().__init__()
        self.parts = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.parts.append((tag, dict(attrs)))

    def of(self, tag):
        return [attributes for name, attributes in self.parts if name == tag]


def test_queries_are_shown_by_the_grey_levels_of_the_map(deepsimbad, pictures, tmp_path):
    for name, gain in (("database", 16), ("queries", 4)):  # 12 bits, and the same camera at dusk
        (tmp_path / name).mkdir()
        for place in range(8):
            image = cv2.imread(str(pictures / f"{place}.png")).astype(np.uint16)
            cv2.imwrite(str(tmp_path / name / f"{place}.png"), image * (gain if place else 4))  # the first is in both
    assert deepsimbad("try", "database", "queries#:1", *QUICK, "--out", "out").code == 0
    files = [next((tmp_path / "out").rglob(f"{role}*.npz")) for role in ("database", "queries")]
    np.testing.assert_array_equal(*(np.load(file)["encodings"][0] for file in files))


def test_two_folders_give_figures_and_one_page_that_asks_for_nothing(deepsimbad, pictures, queries, tmp_path):
    ran = deepsimbad("try", pictures, queries, *QUICK, "--out", "out", "--json", "trial.json")
    assert (ran.code, ran.err) == (0, "")
    assert "it fails at" in ran.out
    document = json.loads((tmp_path / "trial.json").read_text())
    assert (document["n_queries"], document["n_left_out"], document["n_landmarks"]) == (30, 0, 30)
    assert document["recall_at_1"]["composed"] == pytest.approx(100 * 28 / 30), "the two that were swapped"
    assert document["recall_at"]["composed"]["1"] == document["recall_at_1"][document["default"]]
    assert {(stretch["n_wrong"], stretch["median_error_m"]) for stretch in document["fails"]} == {(1, 42.0)}
    assert document["belief_within_5_m"] > 90, "driving along, one wrong view does not carry the belief away"

    text = (tmp_path / document["page"]).read_text()
    page = Parts(text)
    images = page.of("img")
    assert len(images) == 2 * 30 + 2, "a true place beside each of the two wrong ones"
    assert all(image["src"].startswith("data:image/jpeg;base64,") and image["alt"] for image in images)
    assert page.of("script") == page.of("link") == []
    assert re.findall(r"(?:https?:)?//[a-z]", re.sub(r"base64,[\w+/=]+", "", text)) == []
    cards = [card["id"] for card in page.of("li") if card.get("class") == "card"]
    assert (len(cards), set(cards[:2])) == (30, {f"q{row}" for row in SWAPPED}), "the worst come first"
    assert {f"#q{row}" for row in SWAPPED} <= {link["href"] for link in page.of("a")}
    assert "prefers-color-scheme: dark" in text


@pytest.mark.parametrize("size", [(640, 320), (320, 640), (900, 90), (120, 60)])
def test_a_picture_is_small_and_of_the_frames_shape(tmp_path, size):
    view = np.random.default_rng(0).integers(0, 20, (size[1], size[0], 3), np.uint8)  # a copy in few pixels is shorter
    view[:, size[0] // 2 :] += 230
    cv2.imwrite(str(tmp_path / "0.png"), view)
    drive = Drive(position_m=np.zeros(1), encodings=np.ones((1, 2), np.float32))
    album = Album(open_source(str(tmp_path)), drive, 10**6)
    picture = album.entry(0)["picture"]
    shrunk = max(1.0, max(size) / 200)
    assert (picture["width"], picture["height"]) == (round(size[0] / shrunk), round(size[1] / shrunk))
    body = b64decode(picture["uri"].partition("base64,")[2])
    image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[:2] == (picture["height"], picture["width"])
    assert (image[:, : picture["width"] // 3] < 60).all()
    assert (image[:, -picture["width"] // 3 :] > 200).all()
    assert album.n_bytes == len(body)


def test_a_second_run_encodes_nothing_and_one_that_was_stopped_goes_on(
    deepsimbad, pictures, queries, tmp_path, monkeypatch
):
    encoded = []
    encode = FeatureL2.encode

    def counted(self, images):
        if len(encoded) == 40:
            raise CancelledError("cancelled while it was at: read queries")
        encoded.extend(images)
        return encode(self, images)

    monkeypatch.setattr(FeatureL2, "encode", counted)
    monkeypatch.setattr(FeatureL2, "largest_batch", 5)
    stopped = deepsimbad("try", pictures, queries, *QUICK, "--out", "out")
    assert (stopped.code, "the same command goes on where it stopped" in stopped.err) == (130, True)
    monkeypatch.setattr(FeatureL2, "encode", encode)
    uninterrupted = deepsimbad("try", pictures, queries, *QUICK, "--out", "elsewhere", "--json")

    encoded.clear()
    monkeypatch.setattr(FeatureL2, "encode", counted)
    gone_on = deepsimbad("try", pictures, queries, *QUICK, "--out", "out", "--json")
    assert (gone_on.code, len(encoded)) == (0, 20)
    figures = [
        {name: json.loads(ran.out)[name] for name in ("anr", "recall_at", "fails", "config")}
        for ran in (uninterrupted, gone_on)
    ]
    assert figures[0] == figures[1]

    another = shutil.copytree(queries, tmp_path / "another")
    for recording, is_damaged, n_encoded in ((queries, False, 0), (queries, True, 30), (another, False, 30)):
        encoded.clear()
        if is_damaged:
            (tmp_path / "out" / "queries-encodings.npz").write_bytes(b"damaged")
        assert deepsimbad("try", pictures, recording, *QUICK, "--out", "out").code == 0
        assert len(encoded) == n_encoded


def test_ready_encodings_have_figures_and_a_page_without_pictures(deepsimbad, drives, tmp_path):
    np.save(tmp_path / "truth.npy", np.array([[(place + 40) % 80] if place else [-1] for place in range(80)]))
    ready = (drives / "summer.npy", drives / "winter.npy", "--evaluator", "feature_l2:none")
    document = json.loads(deepsimbad("try", *ready, "--json").out)
    assert document["recall_at_1"]["composed"] > 80
    assert document["page"] == "try-summer-winter/index.html"
    page = Parts((tmp_path / document["page"]).read_text())
    assert page.of("img") == []
    assert len([card for card in page.of("li") if card.get("class") == "card"]) == 80
    other = json.loads(deepsimbad("try", *ready, "--ground-truth", tmp_path / "truth.npy", "--json").out)
    assert (other["n_queries"], other["n_left_out"]) == (79, 1)
    assert other["anr"]["composed"] > 30, "half a route away is about chance"
    far = (drives / "summer.npy", f"{drives / 'winter.npy'}#0:1", "--evaluator", "feature_l2:none")
    np.save(tmp_path / "truth.npy", np.array([[-1]]))
    none = json.loads(deepsimbad("try", *far, "--ground-truth", tmp_path / "truth.npy", "--json").out)
    assert (none["n_queries"], none["anr"]["composed"]) == (0, None)


def test_names_that_are_no_utf_8_are_shown_in_page_and_json(deepsimbad, pictures, tmp_path):
    queries = tmp_path / os.fsdecode(b"f\xfcnf")
    queries.mkdir()
    shutil.copy(pictures / "7.png", queries / os.fsdecode(b"pl\xe4tze.png"))
    ran = deepsimbad("try", pictures, queries, *QUICK, "--out", "out", "--json", "trial.json")
    assert ran.code == 0, ran.err
    assert json.loads((tmp_path / "trial.json").read_text())["config"]["queries"] == str(queries)
    text = (tmp_path / "out" / "index.html").read_text()
    assert ("f\ufffdnf" in text, "pl\ufffdtze.png" in text) == (True, True)


def test_queries_that_the_map_was_made_of_are_warned_of_in_the_page_too(deepsimbad, drives, tmp_path):
    ran = deepsimbad("try", drives / "summer.npy", drives / "summer.npy", "--evaluator", "feature_l2:none", "--json")
    document = json.loads(ran.out)
    assert ran.err.startswith("warning: test_drive_known: ")
    assert "in the database drive too" in document["warnings"][0]
    assert "test_drive_known" in (tmp_path / document["page"]).read_text()


def test_landmarks_of_another_drive_are_taken_where_they_are_given(deepsimbad, drives):
    sources = (drives / "summer.npy", drives / "winter.npy", "--landmarks", drives / "landmarks.npy")
    document = json.loads(deepsimbad("try", *sources, "--evaluator", "feature_l2:none", "--json").out)
    assert (document["n_landmarks"], document["config"]["landmarks"]) == (60, str(drives / "landmarks.npy"))
    missing = deepsimbad("try", drives / "summer.npy", "nowhere")
    assert (missing.code, missing.out, len(missing.err.splitlines())) == (1, "", 1)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize(
    ("drive", "part", "figure", "is_reached"),
    [
        (("corridor/ref", "corridor/query"), "", "recall_at_1", lambda percent: percent >= 75),
        (("nordland/summer", "nordland/winter"), "#0:400", "anr", lambda percent: percent <= 4.8),
    ],
)
def test_real_drives_without_landmarks_from_elsewhere(deepsimbad, real_data, drive, part, figure, is_reached, tmp_path):
    sources = [f"{real_data / source}{part}" for source in drive]
    document = json.loads(deepsimbad("try", *sources, "--json").out)
    assert is_reached(document[figure]["composed"])
    assert (tmp_path / document["page"]).stat().st_size < 4_000_000
