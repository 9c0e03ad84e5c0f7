import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.sources import open_source

TABLE = np.random.default_rng(0).normal(size=(5, 3))


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_npy_rows_become_frames(tmp_path, dtype):
    np.save(tmp_path / "winter.npy", TABLE.astype(dtype))
    recording = open_source(str(tmp_path / "winter.npy"), spacing_m=2)
    assert recording.name == "winter"
    assert recording.encodings.dtype == np.float32
    np.testing.assert_array_equal(recording.encodings, TABLE.astype(dtype).astype(np.float32))
    assert [(frame.index, frame.position_m) for frame in recording.frames] == [(i, 2.0 * i) for i in range(5)]
    assert recording.frames[3].name == "winter[3]"
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
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(SourceError, match=r"not a \.npy of numbers"):
        open_source(str(path))
    path.write_bytes(b"")
    with pytest.raises(SourceError, match=r"not a \.npy of numbers"):
        open_source(str(path))
    with path.open("wb") as file:
        np.savez(file, a=TABLE)
    with pytest.raises(SourceError, match="npz archive"):
        open_source(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2\n3\n", "line 2: 1 values where the lines before have 2"),
        ("1,2\n3,x\n", "line 2: could not convert"),
        ("", "holds no encodings"),
        ("a,b\n", "holds no encodings"),
        ("1,2\n\n3,nan\n", "1 rows hold NaN.*row 1"),
    ],
)
def test_a_bad_csv_is_refused_with_its_line(tmp_path, text, message):
    (tmp_path / "e.csv").write_text(text)
    with pytest.raises(SourceError, match=message):
        open_source(str(tmp_path / "e.csv"))
