"""Replays as other programs show them: an MCAP file read back by its library, and what Rerun is sent."""

import base64
import json
import sys

import numpy as np
import pytest

from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay import viewers

from ..conftest import draw

ANCHOR = {"lat_deg": 42.29, "lon_deg": -83.71, "bearing_deg": 0.0, "height_m": 270.0}
N_FRAMES = 12


@pytest.fixture
def seen_route(client, tmp_path):
    """A folder of images on a quarter of a circle, mapped as a domain with an anchor."""
    folder = draw(tmp_path / "drive", N_FRAMES, form="{:02d}.jpg", size=(160, 120))
    lines = (f"{n:02d}.jpg,{5 * n},{40 * np.cos(n / 8)},{40 * np.sin(n / 8)}" for n in range(N_FRAMES))
    (folder / "positions.csv").write_text("\n".join(["name,position_m,x_m,y_m", *lines]))
    client.admin.put_domain("shown", {"kind": "feature_l2", "extractor": "gradient_grid"}, anchor=ANCHOR)
    upload(client, open_source(str(folder)), "shown", "t")
    remap(client, "shown", "t", list_length=2, training_episodes=10)
    yield folder
    client.admin.delete_domain("shown")


@pytest.fixture
def replayed(command, seen_route, tmp_path):
    """Replays the drive into a folder of this name."""

    def replayed(name, *options):
        return command("replay", seen_route, "--domain", "shown", "--out", tmp_path / name, "--no-plots", *options)

    return replayed


def messages(path):
    reader = pytest.importorskip("mcap.reader")
    by_topic = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            document = json.loads(message.data)
            assert set(document) <= set(json.loads(schema.data)["properties"])
            by_topic.setdefault((channel.topic, schema.name), []).append((message.log_time, document))
    return by_topic


def test_an_mcap_file_holds_what_foxglove_shows(replayed, seen_route, tmp_path):
    pytest.importorskip("mcap")
    path = tmp_path / "new" / "drive.mcap"
    assert replayed("out", "--mcap", path).code == 0
    by_topic = messages(path)
    poses = by_topic["/pose", "foxglove.PoseInFrame"]
    assert len(poses) == N_FRAMES
    assert [time for time, _ in poses] == sorted({time for time, _ in poses}), "every view has a later time"
    scenes = [document for _, document in by_topic["/scene", "foxglove.SceneUpdate"]]
    (line,) = scenes[0]["entities"][0]["lines"]
    assert [point["x"] for point in line["points"]] == pytest.approx(40 * np.cos(np.arange(N_FRAMES) / 8), abs=1e-3)
    last = {entity["id"]: entity for entity in scenes[-1]["entities"]}
    assert {"belief", "likeliest", "truth", "next_move"} == set(last)
    assert max(cube["size"]["z"] for cube in last["belief"]["cubes"]) > 1
    assert last["next_move"]["texts"][0]["text"]
    final = poses[-1][1]["pose"]["position"]
    assert (final["x"], final["y"]) == pytest.approx((40 * np.cos(11 / 8), 40 * np.sin(11 / 8)), abs=3), "it knows"
    places = [place for _, place in by_topic["/location", "foxglove.LocationFix"]]
    assert places[-1]["latitude"] == pytest.approx(42.29 + 40 * np.sin(11 / 8) / 111_077, abs=4e-5)
    images = [document for _, document in by_topic["/image", "foxglove.CompressedImage"]]
    body = base64.b64decode(images[4]["data"])
    assert (images[4]["format"], body) == ("jpeg", (seen_route / "04.jpg").read_bytes())
    figures = [document for _, document in by_topic["/figures", "deepsimbad.Figures"]]
    assert figures[-1]["entropy_bits"] < figures[0]["entropy_bits"]
    assert "is there already: name another file" in replayed("again", "--mcap", path).line


def test_episodes_of_an_active_replay_follow_each_other(replayed, tmp_path):
    pytest.importorskip("mcap")
    moves = ("--planner", "constant:5", "--episodes", 3, "--steps", 2)
    assert replayed("out", *moves, "--mcap", tmp_path / "a.mcap").code == 0
    assert len(messages(tmp_path / "a.mcap")["/figures", "deepsimbad.Figures"]) == 3 * 3


def test_rerun_is_sent_the_route_the_belief_the_images_and_the_next_move(replayed, tmp_path, monkeypatch):
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    path = tmp_path / "drive.rrd"
    monkeypatch.setattr(viewers, "show_window", lambda stream, layout: stream.save(path, layout))
    assert replayed("out", "--rerun").code == 0
    store = chunk.RrdReader(str(path)).store()
    paths = {str(entity) for entity in store.schema().entity_paths()}
    world = {f"/world/{part}" for part in ("route", "belief", "likeliest", "truth", "next_move")}
    assert world | {"/view", "/moves", "/figures/entropy_bits", "/said"} <= paths
    assert {column.name for column in store.schema().index_columns()} >= {"view", "time"}
    rows = {}
    for piece in store.stream().to_chunks():
        rows[piece.entity_path] = rows.get(piece.entity_path, 0) + piece.num_rows
    assert {rows[f"/{path}"] for path in ("view", "moves", "world/belief", "world/next_move")} == {N_FRAMES}


@pytest.mark.parametrize(
    ("words", "module", "library"),
    [(["--rerun"], "rerun", "Rerun's viewer"), (["--mcap", "x.mcap"], "mcap.writer", "the library mcap")],
    ids=["rerun", "mcap"],
)
def test_without_the_library_one_line_says_what_to_install(replayed, monkeypatch, words, module, library):
    monkeypatch.setitem(sys.modules, module, None)
    option = words[0]
    install = f"pip install 'deep-simbad[{option.strip('-')}]'"
    assert replayed("out", *words).line == f"deepsimbad-client: missing_extra: {option} needs {library}: {install}"
