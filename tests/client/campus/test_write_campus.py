import itertools

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from deepsimbad_client.campus import PAPER_DATES, write_campus
from deepsimbad_client.campus.command import campus_command
from deepsimbad_client.errors import InvalidArgumentError, SourceError
from deepsimbad_client.recordings.sources import open_source

WINTER, SUMMER = PAPER_DATES["winter"], PAPER_DATES["summer"]


@pytest.fixture(scope="module")
def campus(tmp_path_factory):
    root = tmp_path_factory.mktemp("campus")
    drives = write_campus(root, ["winter", "summer"], 12, seed=1)
    return root, drives


def _files(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_the_layout_is_that_of_nclt(campus):
    root, drives = campus
    assert [(d.date, d.n_frames, d.n_rendered) for d in drives] == [(WINTER, 12, 12), (SUMMER, 12, 12)]
    for drive in drives:
        pictures = sorted((root / drive.date / "lb3" / "Cam5").iterdir())
        assert len(pictures) == 12
        assert all(len(path.stem) == 16 and path.suffix == ".tiff" for path in pictures)
        truth = (root / "ground_truth" / f"groundtruth_{drive.date}.csv").read_text().splitlines()
        assert all(len(line.split(",")) == 7 for line in truth)
        assert truth[0].split(",")[1] == "nan"
        assert len(truth[0].split(",")[0]) == 16


def _tags(body):
    """The first directory of a TIFF, tag to value, read by hand."""
    order = {b"II": "little", b"MM": "big"}[body[:2]]

    def number(at, size):
        return int.from_bytes(body[at : at + size], order)

    start = number(4, 4)
    entries = (start + 2 + 12 * k for k in range(number(start, 2)))
    return {number(at, 2): number(at + 8, 2 if number(at + 2, 2) == 3 else 4) for at in entries}


def test_pictures_are_jpeg_compressed_tiffs_as_the_camera_stores_them(campus):
    root, _ = campus
    path = sorted((root / WINTER / "lb3" / "Cam5").iterdir())[3]
    tags = _tags(path.read_bytes())
    assert (tags[256], tags[257], tags[259]) == (1616, 1232, 7)  # width, height, JPEG
    assert 100_000 < path.stat().st_size < 1_200_000
    assert cv2.imread(str(path)).shape == (1232, 1616, 3)


def test_our_reader_reads_it(campus):
    root, _ = campus
    recording = open_source(f"nclt:{root}/{SUMMER}")
    assert 5 <= len(recording.frames) < 12
    assert sum(recording.left_out.values()) == 12 - len(recording.frames)
    image = recording.image(recording.frames[0], (154, 202))
    decoded = cv2.imdecode(np.frombuffer(image.body, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert decoded.shape == (202, 154, 3)
    assert decoded[:30, :, 0].mean() > decoded[-30:, :, 0].mean() + 20  # blue sky up


def test_equal_seeds_give_equal_bytes_whatever_the_threads(campus, tmp_path):
    root, _ = campus
    write_campus(tmp_path, ["winter"], 12, seed=1, n_threads=1)
    mine = _files(tmp_path)
    assert len(mine) == 14
    assert mine == {name: body for name, body in _files(root).items() if WINTER in name}


def test_other_seeds_give_other_pictures(campus, tmp_path):
    root, _ = campus
    write_campus(tmp_path, ["winter"], 1, seed=2)
    (other,) = (tmp_path / WINTER / "lb3" / "Cam5").iterdir()
    first = min((root / WINTER / "lb3" / "Cam5").iterdir())
    assert other.read_bytes() != first.read_bytes()


class _CutShortError(Exception):
    pass


def test_it_goes_on_where_it_was_cut_short(campus, tmp_path):
    root, _ = campus

    def stop(done, total):
        if done == 5:
            raise _CutShortError

    with pytest.raises(_CutShortError):
        write_campus(tmp_path, ["winter"], 12, seed=1, on_progress=stop, n_threads=1)
    folder = tmp_path / WINTER / "lb3" / "Cam5"
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.tiff")}
    assert 5 <= len(before) < 12
    (folder / f".{min(before).name}.part").write_bytes(b"half a pict")
    (drive,) = write_campus(tmp_path, ["winter"], 12, seed=1)
    assert drive.n_rendered == 12 - len(before)
    assert all(path.stat().st_mtime_ns == at for path, at in before.items())
    assert _files(tmp_path) == {name: body for name, body in _files(root).items() if WINTER in name}


def test_more_frames_are_added_to_those_there(campus, tmp_path):
    root, _ = campus
    write_campus(tmp_path, ["winter"], 4, seed=1)
    (drive,) = write_campus(tmp_path, ["winter"], 12, seed=1)
    assert drive.n_rendered == 8
    assert _files(tmp_path) == {name: body for name, body in _files(root).items() if WINTER in name}


def test_progress_counts_every_picture_of_every_drive(tmp_path):
    seen = []
    write_campus(tmp_path, ["2012-05-11", "autumn"], 3, on_progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (6, 6)
    assert all(total == 6 for _, total in seen)
    assert all(a <= b for (a, _), (b, _) in itertools.pairwise(seen))
    again = []
    write_campus(tmp_path, ["2012-05-11", "autumn"], 3, on_progress=lambda done, total: again.append(done))
    assert again == [3, 6]


@pytest.mark.parametrize(
    "change", [{"seed": 4}, {"n_frames": 2}, {"spacing_m": 1.0}], ids=["seed", "fewer frames", "spacing"]
)
def test_drives_made_otherwise_are_not_mixed(tmp_path, change):
    write_campus(tmp_path, ["spring"], 3, seed=0)
    before = _files(tmp_path)
    with pytest.raises(SourceError, match="choose another folder"):
        write_campus(tmp_path, **{"seasons": ["spring"], "n_frames": 3, "seed": 0, **change})
    assert _files(tmp_path) == before


@pytest.mark.parametrize(
    "there", [f"{SUMMER}/lb3/Cam5/1344104400000000.tiff", f"ground_truth/groundtruth_{SUMMER}.csv"]
)
def test_a_real_recording_is_never_touched(tmp_path, there):
    (tmp_path / there).parent.mkdir(parents=True)
    (tmp_path / there).write_bytes(b"real")
    with pytest.raises(SourceError, match="not as a rendered campus"):
        write_campus(tmp_path, ["winter", "summer"], 2)
    assert _files(tmp_path) == {there: b"real"}


def test_a_damaged_order_is_named(tmp_path):
    (tmp_path / SUMMER).mkdir()
    (tmp_path / SUMMER / "campus.json").write_text("[]")
    with pytest.raises(SourceError, match="damaged"):
        write_campus(tmp_path, ["summer"], 2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_frames": 0},
        {"spacing_m": 0.0},
        {"spacing_m": float("nan")},
        {"seed": -1},
        {"seasons": []},
        {"seasons": ["winter", "2012-01-22"]},
        {"seasons": ["mud"]},
    ],
)
def test_impossible_arguments_are_refused_before_anything_is_written(tmp_path, wrong):
    with pytest.raises(InvalidArgumentError):
        write_campus(tmp_path, **{"seasons": ["winter"], "n_frames": 1, **wrong})
    assert not list(tmp_path.iterdir())


def test_the_command_renders_and_says_what_to_open(tmp_path):
    result = CliRunner().invoke(campus_command, [str(tmp_path), "--seasons", "winter, autumn", "--frames", "2"])
    assert result.exit_code == 0, result.output
    sources = [line for line in result.stdout.splitlines() if line.startswith("nclt:")]
    assert sources == [f"nclt:{tmp_path}/2012-01-22", f"nclt:{tmp_path}/2012-11-17"]
    assert len(list(tmp_path.rglob("*.tiff"))) == 4
