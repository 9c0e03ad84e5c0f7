from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.errors import InvalidArgumentError, SourceError
from deepsimbad_client.recordings import Frame, Recording
from deepsimbad_client.recordings.sources import open_source, split_slice

bounds = st.none() | st.integers(-30, 30)


def recording_of(n):
    frames = tuple(Frame(index=i, name=str(i), position_m=i * 0.7) for i in range(n))
    return Recording("r", frames, {"lost": list("abc")}, np.arange(n * 2, dtype=np.float32).reshape(n, 2))


@given(st.integers(1, 20), bounds, bounds, bounds.filter(lambda step: step != 0))
def test_a_slice_is_pythons_and_frames_keep_their_places(n, start, stop, step):
    recording = recording_of(n)
    text = ":".join("" if bound is None else str(bound) for bound in (start, stop, step))
    place, part = split_slice(f"some/folder#{text}")
    assert place == "some/folder"
    expected = list(range(n))[start:stop:step]
    if not expected:
        with pytest.raises(SourceError, match=f"leaves none of the {n} frames"):
            recording.sliced(part)
        return
    picked = recording.sliced(part)
    assert [frame.index for frame in picked.frames] == expected
    assert [frame.position_m for frame in picked.frames] == [index * 0.7 for index in expected]
    np.testing.assert_array_equal(picked.encodings, recording.encodings[expected])
    assert (picked.name, picked.left_out) == ("r", {"lost": 3})


def test_sources_end_to_end_with_a_slice(tmp_path):
    np.save(tmp_path / "e.npy", np.arange(20.0).reshape(10, 2))
    recording = open_source(f"{tmp_path}/e.npy#2:8:3", spacing_m=1.5)
    assert [(frame.index, frame.position_m) for frame in recording.frames] == [(2, 3.0), (5, 7.5)]
    assert recording.encodings.tolist() == [[4, 5], [10, 11]]
    assert [frame.index for frame in recording.sliced(slice(1, None)).frames] == [5]
    assert open_source(f"{tmp_path}/e.npy#:").encodings.shape == (10, 2)
    np.save(tmp_path / "run#1.npy", np.ones((3, 2)))
    assert len(open_source(f"{tmp_path}/run#1.npy").frames) == 3, "a hash in a name does no harm"
    assert len(open_source(f"{tmp_path}/run#1.npy#1:").frames) == 2
    (tmp_path / "run#1:3").mkdir()
    (tmp_path / "run#1:3" / "1.png").write_bytes(b"")
    assert open_source(f"{tmp_path}/run#1:3").frames[0].name == "1.png"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        *((f"e.npy#{end}", "a slice is #START:STOP") for end in ("5", "", "a:b", "1:2:3:4", "1.5:3", "1-2")),
        ("", "no recording at ''"),
        ("/no/such/place", "no recording at '/no/such/place'"),
        ("e.npy#::0", "step 0"),
        ("e.npy#3:3", "#3:3 leaves none of the 3 frames"),
        ("e.txt", r"a \.npy or \.csv"),
    ],
)
def test_bad_sources_say_what_to_write(tmp_path, monkeypatch, source, message):
    monkeypatch.chdir(tmp_path)
    np.save("e.npy", np.ones((3, 2)))
    (tmp_path / "e.txt").write_text("1")
    with pytest.raises(SourceError, match=message):
        open_source(source)
    for spacing_m in (0, -1, float("nan"), float("inf")):
        with pytest.raises(SourceError, match="more than 0 m apart"):
            open_source("e.npy", spacing_m=spacing_m)


TABLE = np.random.default_rng(0).normal(size=(5, 3))


@pytest.mark.parametrize("dtype", [np.float64, np.float16])
def test_npy_rows_become_frames(tmp_path, dtype):
    np.save(tmp_path / "winter.npy", TABLE.astype(dtype))
    recording = open_source(str(tmp_path / "winter.npy"), spacing_m=2)
    assert recording.encodings.dtype == np.float32
    np.testing.assert_array_equal(recording.encodings, TABLE.astype(dtype).astype(np.float32))
    assert [(frame.index, frame.position_m) for frame in recording.frames] == [(i, 2.0 * i) for i in range(5)]
    assert (recording.name, recording.frames[3].name) == ("winter", "winter[3]")
    with pytest.raises(SourceError, match="ready encodings, not images"):
        recording.image(recording.frames[0], None)


@pytest.mark.parametrize("header", ["", "a,b,c\n"])
def test_csv_rows_become_frames(tmp_path, header):
    lines = [",".join(repr(float(value)) for value in row) for row in TABLE]
    (tmp_path / "e.csv").write_text(header + "\n".join(lines) + "\n\n")
    np.testing.assert_array_equal(open_source(str(tmp_path / "e.csv")).encodings, TABLE.astype(np.float32))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(4), r"this is \[4\]"),
        (np.zeros((2, 3, 4)), r"this is \[2, 3, 4\]"),
        (np.zeros((0, 4)), r"this is \[0, 4\]"),
        (np.zeros((4, 0)), r"this is \[4, 0\]"),
        (np.array([[1, 2], [np.nan, 1], [np.inf, 1]]), r"2 rows hold NaN.*first is row 1"),
        (np.array([[1e300, 1]]), r"beyond float32"),
        (np.zeros((2, 2), complex), r"real numbers"),
        (np.array([["a", "b"]]), r"real numbers"),
        (np.array([[object()]]), r"not a \.npy of numbers"),
    ],
)
def test_what_is_not_encodings_is_refused(tmp_path, array, message):
    np.save(tmp_path / "e.npy", array, allow_pickle=True)
    with pytest.raises(SourceError, match=message):
        open_source(str(tmp_path / "e.npy"))


def test_damaged_and_disguised_files_are_refused(tmp_path):
    path = tmp_path / "e.npy"
    np.save(path, TABLE)
    for body in (path.read_bytes()[:-8], b""):
        path.write_bytes(body)
        with pytest.raises(SourceError, match=r"not a \.npy of numbers"):
            open_source(str(path))
    with path.open("wb") as file:
        np.savez(file, a=TABLE)
    with pytest.raises(SourceError, match="npz archive"):
        open_source(str(path))


@pytest.mark.parametrize(
    "text", ["1.5,2\n-3,4e1", "a;b\n1,5;2\n-3;40,0", "1.5\t2\n-3\t40", "# a b\n1.5 2\n\n -3  40\n"]
)
def test_a_csv_is_numbers_as_programs_separate_them(tmp_path, text):
    (tmp_path / "e.csv").write_text(text)
    encodings = open_source(str(tmp_path / "e.csv")).encodings
    assert encodings is not None
    assert encodings.tolist() == [[1.5, 2], [-3, 40]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2\n3\n", "line 2: 1 values where the lines before have 2"),
        ("1,2\n3,x\n", "line 2: could not convert"),
        ("", "holds no encodings"),
        ("a,b\n", "holds no encodings"),
        ("1,2\n\n3,nan\n", "1 rows hold NaN.*row 1"),
        ("nan,nan\n3,4\n", "1 rows hold NaN.*row 0"),
        ("a,b\nc,d\n3,4\n", "line 2: could not convert"),
    ],
)
def test_a_bad_csv_is_refused_with_its_line(tmp_path, text, message):
    (tmp_path / "e.csv").write_text(text)
    with pytest.raises(SourceError, match=message):
        open_source(str(tmp_path / "e.csv"))


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"time_offset_s": 1}, "time-offset-s"),
        ({"rotate": 90}, "rotate"),
        ({"undistortion": Path("/")}, "undistortion"),
    ],
)
def test_an_option_that_does_not_go_with_the_recording_is_refused(tmp_path, options, option):
    np.save(tmp_path / "a.npy", np.ones((3, 2)))
    with pytest.raises(InvalidArgumentError, match=f"--{option} does not go with"):
        open_source(str(tmp_path / "a.npy"), **options)
