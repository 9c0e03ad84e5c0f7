"""Campuses on disk: NCLT's layout, equal bytes for equal arguments, nothing mixed or overwritten."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from deepsimbad_campus import camera, writer
from deepsimbad_campus.__main__ import campus_command
from deepsimbad_campus.season import PAPER_DATES, CampusError
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.recordings.sources import open_source

WINTER, SUMMER = PAPER_DATES["winter"], PAPER_DATES["summer"]


class Painter:
    """Paints small pictures that differ in place of the campus's, which take a third of a second."""

    def __init__(self, *_):
        pass

    def stored_picture(self, frame):
        return np.full((48, 64, 3), 20 * frame, np.uint8)


@pytest.fixture
def painter(monkeypatch):
    monkeypatch.setattr(writer, "Renderer", Painter)


@pytest.fixture
def campus(tmp_path, painter):
    root = tmp_path / "campus"
    assert write_campus(root, ["winter", "summer"], 12, seed=1) == [f"nclt:{root}/{WINTER}", f"nclt:{root}/{SUMMER}"]
    return root


def _files(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_the_layout_and_the_compression_are_those_of_nclt(rendered):
    assert camera.UPRIGHT_SIZE == (1232, 1616), "of which tests render half"
    for date in (WINTER, SUMMER):
        pictures = sorted((rendered / date / "lb3" / "Cam5").iterdir())
        assert len(pictures) == 36
        assert all(len(path.stem) == 16 and path.suffix == ".tiff" for path in pictures)
        with Image.open(pictures[3]) as picture:
            assert (picture.format, picture.size, picture.info["compression"]) == ("TIFF", (808, 616), "jpeg")
        truth = (rendered / "ground_truth" / f"groundtruth_{date}.csv").read_text().splitlines()
        assert all(len(line.split(",")) == 7 for line in truth)
        assert truth[0].split(",")[1] == "nan"
        assert len(truth[0].split(",")[0]) == 16


def test_our_reader_reads_it(rendered):
    recording = open_source(f"nclt:{rendered}/{SUMMER}")
    assert 28 <= len(recording.frames) < 36
    assert sum(recording.left_out.values()) == 36 - len(recording.frames)
    image = recording.image(recording.frames[0], (154, 202))
    decoded = cv2.imdecode(np.frombuffer(image.body, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert decoded.shape == (202, 154, 3)
    assert decoded[:30, :, 0].mean() > decoded[-30:, :, 0].mean() + 20  # blue sky up


def test_it_goes_on_where_it_was_cut_short_and_adds_frames_to_equal_bytes(campus, tmp_path, monkeypatch):
    def fail_at_nine(painter, frame, paint=Painter.stored_picture):
        if frame == 9:
            raise RuntimeError("cut short")
        return paint(painter, frame)

    def times(root):
        return {path: path.stat().st_mtime_ns for path in root.rglob("*.tiff")}

    root = tmp_path / "parts"
    write_campus(root, ["winter"], 4, seed=1)
    first_times = times(root)
    assert len(first_times) == 4
    with monkeypatch.context() as failing:
        failing.setattr(Painter, "stored_picture", fail_at_nine)
        with pytest.raises(RuntimeError, match="cut short"):
            write_campus(root, ["winter"], 12, seed=1)
    earlier_times = times(root)
    assert 9 <= len(earlier_times) < 12
    assert first_times.items() <= earlier_times.items()
    (min(earlier_times).parent / f".{min(earlier_times).name}.part").write_bytes(b"half a pict")
    calls = []
    write_campus(root, ["winter"], 12, seed=1, on_progress=lambda *call: calls.append(call))
    assert calls == [(n_written, 12) for n_written in range(1, 13)]
    assert earlier_times.items() <= times(root).items()
    assert _files(root) == {name: body for name, body in _files(campus).items() if WINTER in name}


@pytest.mark.parametrize("change", [{"seed": 4}, {"n_frames": 2}, {"spacing_m": 1.0}])
def test_drives_made_otherwise_are_not_mixed(campus, change):
    earlier_files = _files(campus)
    with pytest.raises(CampusError, match="choose another folder"):
        write_campus(campus, **{"seasons": ["winter"], "n_frames": 12, "seed": 1, **change})
    assert _files(campus) == earlier_files


def test_a_damaged_order_is_named(campus):
    (campus / WINTER / "campus.json").write_bytes(b"")
    with pytest.raises(CampusError, match=f"{WINTER}/campus.json is damaged: delete"):
        write_campus(campus, ["winter"], 12, seed=1)


@pytest.mark.parametrize("file", [f"{SUMMER}/lb3/Cam5/1344.tiff", f"ground_truth/groundtruth_{SUMMER}.csv"])
def test_a_real_recording_is_never_touched(tmp_path, file):
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_bytes(b"real")
    with pytest.raises(CampusError, match="not as a rendered campus"):
        write_campus(tmp_path, ["winter", "summer"], 2)
    assert _files(tmp_path) == {file: b"real"}


@pytest.mark.parametrize("seasons", [[], ["winter", "2012-01-22"], [""], ["Winter"], ["2012-13-01"], ["22.1.2012"]])
def test_seasons_that_cannot_be_are_refused_before_anything_is_written(tmp_path, seasons):
    with pytest.raises(CampusError):
        write_campus(tmp_path, seasons, 1)
    assert not list(tmp_path.iterdir())


def test_the_command_renders_and_says_what_to_open_or_what_is_wrong(tmp_path, painter):
    result = CliRunner().invoke(campus_command, [str(tmp_path), "--seasons", "winter, 2012-05-11", "--frames", "1"])
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [f"nclt:{tmp_path}/2012-01-22", f"nclt:{tmp_path}/2012-05-11"]
    assert len(list(tmp_path.rglob("*.tiff"))) == 2
    result = CliRunner().invoke(campus_command, [str(tmp_path), "--seasons", "mud"])
    assert result.exit_code == 1
    assert "season 'mud' is neither one of winter" in result.stderr
