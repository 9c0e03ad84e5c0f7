import cv2
import numpy as np
import pytest

from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.recordings.sources import open_source


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "summer"
    folder.mkdir()
    for name in ("10.png", "9.png", "8.png", "11.png"):
        cv2.imwrite(str(folder / name), np.full((12, 16, 3), int(name[:-4]), np.uint8))
    return folder


def positions(folder, *lines):
    (folder / "positions.csv").write_text("\n".join(lines) + "\n")


def placed(folder):
    return [(frame.name, frame.position_m) for frame in open_source(str(folder)).frames]


def test_images_come_in_name_order_evenly_spaced(folder):
    (folder / "inner.png").mkdir()
    (folder / ".hidden.png").write_bytes(b"")
    (folder / "notes.txt").write_text("")
    recording = open_source(str(folder), spacing_m=2.5)
    assert recording.name == "summer"
    names = [(frame.index, frame.name, frame.position_m) for frame in recording.frames]
    assert names == [(0, "8.png", 0.0), (1, "9.png", 2.5), (2, "10.png", 5.0), (3, "11.png", 7.5)]
    assert recording.frames[0].x_m is None
    assert recording.left_out == {}
    assert recording.encodings is None


@pytest.mark.parametrize(
    "lines",
    [
        ["position_m", "0", "1.5", "4", "9"],
        ["0", "1.5", "4", "9"],
        ["name,position_m", "11.png,9", "8.png,0", "10,4", "9.png,1.5"],
        ["8.png,0", "9.png,1.5", "10.png,4", "11.png,9"],
        ["Index, Position_M ,weather", "0,0,rain", "1,1.5,", "3,9,sun", "2,4,x"],
        ["image,route_position_m", "summer/8.png,0", "summer/9.png,1.5", "summer/10.png,4", "summer/11.png,9"],
        ["\ufeffposition_m", "", "0", "1.5", "", "4", "9"],
    ],
)
def test_positions_are_read_in_every_documented_form(folder, lines):
    (folder / "positions.csv").write_text("\n".join(lines), encoding="utf-8")
    assert placed(folder) == [("8.png", 0.0), ("9.png", 1.5), ("10.png", 4.0), ("11.png", 9.0)]


@pytest.mark.parametrize(
    "lines",
    [["x_m,y_m", "0,0", "3,4", "3,14", "3,15"], ["8.png,0,0", "9.png,3,4", "10.png,3,14", "11.png,3,15"]],
)
def test_ground_coordinates_alone_give_the_distance_along_them(folder, lines):
    positions(folder, *lines)
    assert placed(folder) == [("8.png", 0.0), ("9.png", 5.0), ("10.png", 15.0), ("11.png", 16.0)]
    frame = open_source(str(folder)).frames[1]
    assert (frame.x_m, frame.y_m) == (3.0, 4.0)


def test_everything_known_of_a_frame_is_kept_and_blanks_are_unknown(folder):
    header = "name,position_m,x_m,y_m,timestamp_us,heading_rad"
    positions(folder, header, "8.png,0,1,2,1326030975726043,0.5", "9.png,1,,,,")
    first, second = open_source(str(folder)).frames
    assert (first.timestamp_us, first.x_m, first.y_m, first.heading_rad) == (1_326_030_975_726_043, 1, 2, 0.5)
    assert (second.timestamp_us, second.x_m, second.y_m, second.heading_rad) == (None, None, None, None)


def test_unlisted_images_and_lines_without_an_image_are_counted(folder):
    positions(folder, "name,position_m", "8.png,0", "11.png,3", "99.png,5", "98.png,6", "97.png,7")
    recording = open_source(str(folder))
    assert [(frame.index, frame.name) for frame in recording.frames] == [(0, "8.png"), (1, "11.png")]
    assert recording.left_out == {"not in positions.csv": 2, "in positions.csv without an image": 3}


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["position_m", "0", "1", "two", "3"], r"positions\.csv, line 4: position_m is 'two'"),
        (["position_m", "0", "nan", "2", "3"], r"line 3: position_m is 'nan', not a finite number"),
        (["position_m", "0", "1", "2"], r"3 lines for 4 images: add a column `name`"),
        (["name,position_m", "8.png,0", "9.png,1", "8.png,2"], r"line 4: 8\.png stands in line 2 already"),
        (["name,position_m", "8.png,0", "9.png"], r"line 3: 1 values where 2 are needed"),
        (["name,x_m", "8.png,0"], r"among them position_m, or x_m and y_m.*it is: name,x_m"),
        (["0,1", "1,2", "2,3", "3,4"], r"the first line must name the columns"),
        (["index,position_m", "first,0"], r"line 2: the index 'first'"),
        (["position,position_m", "0,0"], r"two columns mean the same"),
        (["name,position_m", "a.png,0"], r"names none of the 4 images"),
        ([""], r"is empty"),
        (["x_m,y_m", "0,0", "0,inf", "0,0", "0,0"], r"line 3: y_m is 'inf'"),
        (["position_m,x_m,y_m", "0,0,0", "1,one,0", "2,0,0", "3,0,0"], r"line 3: x_m is 'one'"),
    ],
)
def test_positions_that_make_no_sense_are_refused_with_their_line(folder, lines, message):
    positions(folder, *lines)
    with pytest.raises(SourceError, match=message):
        open_source(str(folder))


def test_a_small_image_goes_as_it_is_and_a_larger_one_resized_as_jpeg(folder):
    recording = open_source(str(folder))
    frame = recording.frames[0]
    for input_size in (None, (16, 12), (100, 100)):
        sent = recording.image(frame, input_size)
        assert (sent.body, sent.content_type) == ((folder / "8.png").read_bytes(), "image/png")
    for input_size in ((15, 100), (100, 11), (4, 4)):
        sent = recording.image(frame, input_size)
        assert sent.content_type == "image/jpeg"
        image = cv2.imdecode(np.frombuffer(sent.body, np.uint8), cv2.IMREAD_COLOR)
        assert (image.shape[1], image.shape[0]) == input_size
        assert abs(float(image.mean()) - 8) < 2


def test_a_format_nobody_posts_goes_as_png_without_loss(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.bmp"), image)
    recording = open_source(str(tmp_path))
    sent = recording.image(recording.frames[0], None)
    assert sent.content_type == "image/png"
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(sent.body, np.uint8), cv2.IMREAD_COLOR), image)


def test_a_broken_image_is_named_when_it_is_read(folder):
    whole = (folder / "9.png").read_bytes()
    (folder / "9.png").write_bytes(whole[:-20])
    recording = open_source(str(folder))
    with pytest.raises(BrokenFrameError, match=r"9\.png is truncated"):
        recording.image(recording.frames[1], None)
    recording.image(recording.frames[2], None)


def test_a_folder_without_images_says_what_it_looked_for(tmp_path):
    with pytest.raises(SourceError, match=r"holds no images \(\.bmp, \.jpeg"):
        open_source(str(tmp_path))
    (tmp_path / "lb3").mkdir()
    with pytest.raises(SourceError, match=f"for NCLT write nclt:{tmp_path}"):
        open_source(str(tmp_path))
