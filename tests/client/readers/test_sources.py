import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.encodings import EncodingRecording
from deepsimbad_client.errors import SourceError
from deepsimbad_client.recording import Frame, nearest_frame, positions_m, sliced
from deepsimbad_client.sources import open_source, split_slice

bounds = st.none() | st.integers(-30, 30)


def recording_of(n):
    frames = tuple(Frame(index=i, name=str(i), position_m=i * 0.7) for i in range(n))
    return EncodingRecording("r", frames, np.arange(n * 2, dtype=np.float32).reshape(n, 2), {"lost": 3})


@given(st.integers(1, 20), bounds, bounds, bounds.filter(lambda step: step != 0))
def test_a_slice_is_pythons_and_frames_keep_their_places(n, start, stop, step):
    whole = recording_of(n)
    text = ":".join("" if bound is None else str(bound) for bound in (start, stop, step))
    place, part = split_slice(f"some/folder#{text}")
    assert place == "some/folder"
    expected = list(range(n))[start:stop:step]
    if not expected:
        with pytest.raises(SourceError, match=f"leaves none of the {n} frames"):
            sliced(whole, part)
        return
    picked = sliced(whole, part)
    assert [frame.index for frame in picked.frames] == expected
    np.testing.assert_array_equal(positions_m(picked), np.array(expected) * 0.7)
    np.testing.assert_array_equal(picked.encodings, whole.encodings[expected])
    assert (picked.name, picked.left_out) == ("r", {"lost": 3})


@given(st.integers(1, 20), bounds, bounds)
def test_two_bounds_are_enough(n, start, stop):
    text = ":".join("" if bound is None else str(bound) for bound in (start, stop))
    assert split_slice(f"x#{text}") == ("x", slice(start, stop, None))


def test_slicing_a_slice_still_keeps_places():
    picked = sliced(sliced(recording_of(20), slice(10, None)), slice(None, None, 4))
    assert [frame.index for frame in picked.frames] == [10, 14, 18]
    np.testing.assert_array_equal(picked.encodings[:, 0], [20, 28, 36])


def test_sources_end_to_end_with_a_slice(tmp_path):
    np.save(tmp_path / "e.npy", np.arange(20.0).reshape(10, 2))
    recording = open_source(f"{tmp_path}/e.npy#2:8:3", spacing_m=1.5)
    assert [(frame.index, frame.position_m) for frame in recording.frames] == [(2, 3.0), (5, 7.5)]
    assert recording.encodings.tolist() == [[4, 5], [10, 11]]
    assert open_source(f"{tmp_path}/e.npy#:").encodings.shape == (10, 2)


@pytest.mark.parametrize("ending", ["5", "", "a:b", "1:2:3:4", "1.5:3", "1-2"])
def test_an_ending_that_is_no_slice_is_refused(tmp_path, ending):
    np.save(tmp_path / "e.npy", np.ones((3, 2)))
    with pytest.raises(SourceError, match="a slice is #START:STOP"):
        open_source(f"{tmp_path}/e.npy#{ending}")


def test_a_hash_in_a_name_does_no_harm(tmp_path):
    np.save(tmp_path / "run#1.npy", np.ones((3, 2)))
    assert len(open_source(f"{tmp_path}/run#1.npy").frames) == 3
    assert len(open_source(f"{tmp_path}/run#1.npy#1:").frames) == 2


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("", "no recording at ''"),
        ("/no/such/place", "no recording at '/no/such/place'"),
        ("e.npy#::0", "step 0"),
        ("e.npy#3:3", "#3:3 leaves none of the 3 frames"),
        ("e.txt", r"a \.npy or a \.csv"),
    ],
)
def test_bad_sources_say_what_to_write(tmp_path, monkeypatch, source, message):
    monkeypatch.chdir(tmp_path)
    np.save("e.npy", np.ones((3, 2)))
    (tmp_path / "e.txt").write_text("1")
    with pytest.raises(SourceError, match=message):
        open_source(source)


@pytest.mark.parametrize("spacing_m", [0, -1, float("nan"), float("inf")])
def test_frames_must_be_apart(tmp_path, spacing_m):
    with pytest.raises(SourceError, match="more than 0 m apart"):
        open_source(str(tmp_path), spacing_m=spacing_m)


@given(st.lists(st.floats(0, 100), min_size=1, max_size=20), st.floats(-5, 105))
def test_the_nearest_frame_is_the_nearest(positions, commanded):
    route = np.sort(np.array(positions))
    found = nearest_frame(route, commanded)
    if not route[0] <= commanded <= route[-1]:
        assert found is None
        return
    away = [abs(position - commanded) for position in route.tolist()]
    assert away[found] == min(away)
    assert found == 0 or route[found - 1] < route[found], "of frames at one place the first"


def test_the_nearest_frame_by_metres():
    route = np.array([0.0, 1.0, 1.0, 1.0, 2.5, 2.6])
    assert [nearest_frame(route, at) for at in (0, 0.5, 0.6, 1.0, 1.75, 1.8, 2.55, 2.6)] == [0, 0, 1, 1, 1, 4, 4, 5]
    assert nearest_frame(route, 2.61) is None, "a move past the end is impossible"
    assert nearest_frame(route, -0.1) is None
    assert nearest_frame(np.zeros(0), 0.0) is None
