import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from deepsimbad_client.errors import BrokenFrameError, InvalidArgumentError, SourceError, TooManyLeftOutError
from deepsimbad_client.recordings import LeftOut
from deepsimbad_client.recordings.sources import open_source

from .conftest import empty_files, pixels_of


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "summer"
    folder.mkdir()
    for name in ("10.png", "9.png", "8.png", "11.png"):
        cv2.imwrite(str(folder / name), np.full((12, 16, 3), int(name[:-4]), np.uint8))
    return folder


def positions(folder, *lines):
    (folder / "positions.csv").write_text("\n".join(map(str, lines)) + "\n")


def places_of(folder):
    return {frame.name: frame.position_m for frame in open_source(str(folder)).frames}


def test_the_table_is_found_in_any_letter_case(folder):
    (folder / "Positions.CSV").write_text("position_m\n0\n1\n2\n3\n")
    assert list(places_of(folder).values()) == [0, 1, 2, 3]
    positions(folder, "position_m", "0", "2", "4", "6")
    assert list(places_of(folder).values()) == [0, 2, 4, 6]


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
    assert ["4 images are taken 2.5 m apart" in remark for remark in recording.remarks] == [True]


@pytest.mark.parametrize(
    "lines",
    [
        ["position_m", "0", "1.5", "4", "9"],
        ["0", "1.5", "4", "9"],
        ["name,position_m", "11.png,9", "8.png,0", "10,4", "9.png,1.5"],
        ["8.png,0", "9.png,1.5", "10.png,4", "11.png,9"],
        ["Index, Position_M ,weather", "0,0,rain", "1,1.5,", "3,9,sun", "2,4,x"],
        ["#name, position_m", "11.png,9", "8.png,0", "10.png,4", "9.png,1.5"],
        ["image,route_position_m", "summer/8.png,0", "summer/9.png,1.5", "summer/10.png,4", "summer/11.png,9"],
        ["name;position_m", "8.png;0", "9.png;1.5", "10.png;4", "11.png;9"],
        ["position_m", "", "0", "1.5", "", "4", "9"],
        ["position_m\r", "0\r", "1.5\r", "4\r", "9\r"],
        ["position_m;x_m", "0,0;1", "1,5;2", "4;2", "9,0;2"],
        ["name,position_m", "Images\\8.PNG,0", "Images\\9.PNG,1.5", "Images\\10.PNG,4", "Images\\11.PNG,9"],
    ],
)
def test_positions_are_read_in_every_documented_form(folder, lines):
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        (folder / "positions.csv").write_bytes("\n".join(lines).encode(encoding))
        assert places_of(folder) == {"8.png": 0.0, "9.png": 1.5, "10.png": 4.0, "11.png": 9.0}


@pytest.mark.parametrize(
    "lines", [["x_m,y_m", "0,0", "3,4", "3,14", "3,15"], ["8.png,0,0", "9.png,3,4", "10.png,3,14", "11.png,3,15"]]
)
def test_ground_coordinates_alone_give_the_distance_along_them(folder, lines):
    positions(folder, *lines)
    assert places_of(folder) == {"8.png": 0.0, "9.png": 5.0, "10.png": 15.0, "11.png": 16.0}
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


def test_a_misspelt_name_is_one_frame_left_out_named_on_each_side(tmp_path):
    def misspell(*misspelt):
        rows = (f"{number}{'x' * (number in misspelt)}.png,{number}" for number in range(21))
        positions(tmp_path, "name,position_m", *rows)

    empty_files(tmp_path, (f"{number}.png" for number in range(21)))
    misspell(7)
    sides = {"not in positions.csv": ["7.png"], "in positions.csv without an image": ["7x.png"]}
    assert LeftOut(open_source(str(tmp_path)), allow_missing=False).names == sides
    misspell(7, 8)
    with pytest.raises(TooManyLeftOutError, match="10% of the frames"):
        LeftOut(open_source(str(tmp_path)), allow_missing=False)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["position_m", "0", "1", "two", "3"], r"positions\.csv, line 4: position_m is 'two'"),
        (["position_m", "0", "1", "2"], r"3 lines for 4 images: add a column `name`"),
        (["name,position_m", "8.png,0", "9.png,1", "8.png,2"], r"line 4: 8\.png stands in line 2 already"),
        (["name,position_m", "8.png,0", "9.png"], r"line 3: 1 values where 2 are needed"),
        (["name,x_m", "8.png,0"], r"among them position_m, or x_m and y_m.*it is: name,x_m"),
        (["0,1", "1,2", "2,3", "3,4"], r"the first line must name the columns"),
        (["index,position_m", "first,0"], r"line 2: the index 'first'"),
        (["position,position_m", "0,0"], r"two columns mean the same"),
        (["name,position_m", "a.png,0"], r"names none of the 4 images"),
        ([""], r"is empty"),
        (["position_m", "nan", "-", "NA", "null"], r"none of 4 frames has a position"),
        (["position_m", "3", "2", "1", "0"], r"positions fall along the drive, from 3 m \(8\.png\) to 0 m.*--reverse"),
        (["position_m", "0", "5", "2", "6"], r"to and fro: 10\.png is at 2\.00 m after 5\.00 m \(9\.png\)"),
        (
            ["name,position_m,timestamp", "8.png,0,0.1", "9.png,1,0.2"],
            r"line 2: nobody can tell the unit of the time 0\.1",
        ),
        (
            ["name,position_m,time", "8.png,0,1305031103", "9.png,1,1305031103000"],
            r"several units: .*line 2 is in s; .*ms",
        ),
        (["name,position_m,time", "8.png,0,noon"], r"line 2: 'noon' is not a time"),
        (["position_m,x_m,y_m", "0,0,0", "1,one,0", "2,0,0", "3,0,0"], r"line 3: x_m is 'one'"),
        (["name,position_m", "8.png,0,5", "9.png,1,5"], r"line 2: 3 values, and the first line has 2.*semicolons"),
        (["index,position_m", "1,0", "2,1", "3,2", "4,3"], r"counts from 1 to 4: count from 0"),
        (["lat,lon", *["148,11"] * 4], r"latitude 148, longitude 11 is no place in degrees.*changed over"),
        (["position_m", "1e308", "1e308", "-2e9", "3.4e38"], r"none of 4 frames has a position"),
        *(
            (["position_m,timestamp_s", "0,1", "1,2", f"2,{time}", "3,4"], "line 4")
            for time in ("Infinity", "sNaN", "1e400", "1e17")
        ),
    ],
)
def test_positions_that_make_no_sense_are_refused_with_their_line(folder, lines, message):
    positions(folder, *lines)
    with pytest.raises(SourceError, match=message):
        open_source(str(folder))


def test_a_frame_without_a_place_is_left_out_by_name(folder):
    positions(folder, "name,position_m", "8.png,0", "9.png,-1e308", "10.png,nan", "11.png,4")
    recording = open_source(str(folder))
    assert [frame.index for frame in recording.frames] == [0, 1]
    assert places_of(folder) == {"8.png": 0.0, "11.png": 4.0}
    assert recording.left_out_names == {"without a position": ["9.png", "10.png"]}


def test_falling_positions_are_reversed_when_asked_for(folder):
    positions(folder, "position_m", "3.5", "2", "2.01", "0")
    frames = open_source(str(folder), reverse=True).frames
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.name for frame in frames] == ["11.png", "10.png", "9.png", "8.png"]
    assert [frame.position_m for frame in frames] == [0.0, 2.0, 2.0, 3.5]
    (folder / "positions.csv").unlink()
    assert [frame.position_m for frame in open_source(str(folder), reverse=True, spacing_m=2).frames] == [0, 2, 4, 6]


@pytest.mark.parametrize(
    ("column", "unit_us"),
    [("timestamp", 1), ("timestamp", 1000), ("time", 1_000_000), ("timestamp_us", 0.001), ("timestamp_us", 1000)],
)
def test_units_of_times_are_told_by_their_magnitude(folder, column, unit_us):
    at_us = [1_400_000_000_000_000 + 100_000 * place for place in range(4)]
    times = [f"{time_us // unit_us if unit_us >= 1 else time_us * 1000:.0f}" for time_us in at_us]
    rows = (f"{n}.png,{n},{time}" for n, time in zip(range(8, 12), times, strict=True))
    positions(folder, f"name,position_m,{column}", *rows)
    if unit_us == 1_000_000:
        at_us = [at_us[0]] * 4
    recording = open_source(str(folder))
    assert [frame.timestamp_us for frame in recording.frames] == at_us
    assert len(recording.remarks) == 1


def test_times_say_how_far_and_in_which_order(folder):
    header = "name,x_m,y_m,timestamp_s"
    positions(folder, header, "8.png,30,0,3", "9.png,0,0,0", "10.png,10,0,1", "11.png,20,0,2")
    assert list(places_of(folder).items()) == [("9.png", 0), ("10.png", 10), ("11.png", 20), ("8.png", 30)]
    assert "order of their times" in open_source(str(folder)).remarks[0]
    positions(folder, header, "8.png,0,0,0", "9.png,10,0,1", "10.png,5735000,619000,2", "11.png,20,0,3")
    recording = open_source(str(folder))
    assert [frame.position_m for frame in recording.frames] == [0, 10, 20]
    assert recording.left_out_names == {"where no robot can have been": ["10.png"]}
    assert recording.remarks == ["10.png would be 5768299 m from 9.png"]


@pytest.mark.parametrize("column", ["x_m,y_m", "position_m"])
@pytest.mark.parametrize("ahead", [range(10, 20), range(10), range(12, 14)])
def test_a_clock_set_on_the_way_leaves_frames_in_the_order_of_names(tmp_path, column, ahead):
    empty_files(tmp_path, (f"{number}.png" for number in range(30)))
    y = ",0" * (column == "x_m,y_m")
    rows = (f"{number}{y},{1_700_000_000 + number + 3600 * (number in ahead)}" for number in range(30))
    positions(tmp_path, f"{column},timestamp_s", *rows)
    recording = open_source(str(tmp_path))
    assert list(places_of(tmp_path).items()) == [(f"{number}.png", number) for number in range(30)]
    assert {frame.timestamp_us for frame in recording.frames} == {None}
    next_row = ahead[-1] + 1
    (remark,) = recording.remarks
    assert f"{next_row}.png says 3599.0 s before {next_row - 1}.png" in remark
    assert "stay in the order of their names, and their times are not used" in remark


def test_two_drives_by_turns_are_refused_by_name_and_noise_is_not(tmp_path):
    empty_files(tmp_path, (f"{number}.png" for number in range(60)))
    rng = np.random.default_rng(2)
    for turns in (np.arange(60) % 2, rng.integers(0, 2, 60)):
        positions(tmp_path, "x_m,y_m", *(f"{number},{20 * turn}" for number, turn in enumerate(turns)))
        with pytest.raises(SourceError, match=r"\.png are 2[0-9] m apart: are these several drives by turns"):
            open_source(str(tmp_path))
    positions(tmp_path, "position_m", *(number // 2 + 50 * (number % 2) for number in range(60)))
    with pytest.raises(SourceError, match=r"0\.png and 1\.png are 50 m apart: are these several drives by turns"):
        open_source(str(tmp_path))
    rows = [f"{1_700_000_000 + number / 10},{number},{20 * (number % 2)}" for number in range(90)]
    positions(tmp_path, "time_s,x_m,y_m", *rows)
    for number in range(60):
        (tmp_path / f"{number}.png").rename(tmp_path / f"{1_700_000_000 + number / 10}.png")
    with pytest.raises(SourceError, match="rows of the positions leap to and fro from 2023-11-14"):
        open_source(str(tmp_path))
    for drive_m in (0, 1):
        steps = np.arange(60)[:, None] * (drive_m, 0) + rng.normal(0, 4, (60, 2))
        positions(tmp_path, "x_m,y_m", *(f"{x},{y}" for x, y in steps))
        assert len(open_source(str(tmp_path)).frames) == 60


def test_one_wrong_time_among_many_is_left_out_by_name(tmp_path):
    empty_files(tmp_path, (f"{number}.png" for number in range(40)))
    positions(tmp_path, "x_m,y_m,time_s", *(f"{number},0,{number + 1000 * (number == 20)}" for number in range(40)))
    recording = open_source(str(tmp_path))
    assert recording.left_out_names == {"whose time goes back": ["20.png"]}
    assert recording.frames[-1].position_m == 39


def test_lines_at_a_rate_of_their_own_are_interpolated_at_the_times_that_names_tell(tmp_path):
    empty_files(tmp_path, ("1305031103.05.png", "1305031103.5.png", "1305031109.9.png"))
    rows = (f"{1_305_031_103_000 + 100 * k},{k},7" for k in range(11))
    positions(tmp_path, "timestamp,x_m,y_m", *rows)
    recording = open_source(str(tmp_path))
    (first, second) = recording.frames
    assert (first.name, first.x_m, first.position_m, second.position_m) == ("1305031103.05.png", 0.5, 0.5, 5.0)
    assert recording.left_out_names == {"before or after the positions": ["1305031109.9.png"]}


def test_clocks_that_differ_are_told(tmp_path):
    empty_files(tmp_path, (f"{time}.png" for time in range(1_305_031_103, 1_305_031_106)))
    rows = (f"{1_305_031_103 + number},{number},{1_305_034_703 + 1.5 * number}" for number in range(3))
    positions(tmp_path, "name,position_m,time", *rows)
    (_, remark) = open_source(str(tmp_path)).remarks
    assert "by +3600.000 s at the first frame and +3601.000 s at the last" in remark


def test_a_small_image_goes_as_it_is_and_a_larger_one_resized_where_that_is_shorter(folder):
    cv2.imwrite(str(folder / "8.png"), np.random.default_rng(0).integers(0, 16, (12, 16, 3), np.uint8))
    recording = open_source(str(folder))
    frame = recording.frames[0]
    for input_size in (None, (16, 12), (100, 100), (15, 100)):
        encoded = recording.image(frame, input_size)
        assert (encoded.body, encoded.content_type) == ((folder / "8.png").read_bytes(), "image/png")
    for input_size in ((9, 12), (12, 9), (4, 4)):
        encoded = recording.image(frame, input_size)
        assert encoded.content_type == "image/png"
        image = pixels_of(encoded)
        assert (image.shape[1], image.shape[0]) == input_size
        assert abs(float(image.mean()) - 8) < 2


def test_a_format_nobody_posts_goes_as_png_without_loss(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.bmp"), image)
    recording = open_source(str(tmp_path))
    encoded = recording.image(recording.frames[0], None)
    assert encoded.content_type == "image/png"
    np.testing.assert_array_equal(pixels_of(encoded), image)


def test_images_of_several_shapes_are_told_by_number_and_name(folder):
    cv2.imwrite(str(folder / "9.png"), np.zeros((16, 12, 3), np.uint8))
    (folder / "10.png").write_bytes(b"no image")
    (remark,) = [remark for remark in open_source(str(folder)).remarks if "not of one kind" in remark]
    assert "2 of 16 x 12 (8.png, 11.png), 1 of 12 x 16 (9.png);" in remark


def test_cameras_that_exif_names_and_pictures_that_it_turns(tmp_path):
    for name, size, camera, orientation in (("1", (16, 12), "A", 1), ("2", (12, 16), "A", 6), ("3", (16, 12), "B", 1)):
        exif = Image.Exif()
        exif[0x0110], exif[0x0112] = camera, orientation
        Image.new("RGB", size).save(tmp_path / f"{name}.jpg", exif=exif)
    (remark,) = [remark for remark in open_source(str(tmp_path)).remarks if "not of one kind" in remark]
    assert "2 of 16 x 12 by A (1.jpg, 2.jpg), 1 of 16 x 12 by B (3.jpg);" in remark


def test_a_broken_image_is_named_when_it_is_read(folder):
    body = (folder / "9.png").read_bytes()
    (folder / "9.png").write_bytes(body[:-20])
    recording = open_source(str(folder))
    with pytest.raises(BrokenFrameError, match=r"9\.png cannot be read: .*its end is missing"):
        recording.image(recording.frames[1], None)
    recording.image(recording.frames[2], None)


def test_images_of_a_format_that_is_not_read_are_left_out_by_name(folder):
    (folder / "12.gif").write_bytes(b"GIF89a")
    (left_out,) = open_source(str(folder)).left_out_names.values()
    assert left_out == ["12.gif"]
    for path in folder.glob("*.png"):
        path.unlink()
    with pytest.raises(SourceError, match=r"12\.gif is of a format that is not read: convert it to PNG"):
        open_source(str(folder))
    (folder / "12.gif").rename(folder / "notes")
    (folder / "inner").mkdir()
    (folder / "inner" / "1.png").write_bytes(b"")
    with pytest.raises(SourceError, match=r"holds no images.*; \S*inner does"):
        open_source(str(folder))
    shutil.rmtree(folder / "inner")
    (folder / "2012-01-22" / "lb3").mkdir(parents=True)
    for source in (str(folder), f"nclt:{folder}", f"nclt:{folder}/2012-01-23"):  # above the drives, or beside them
        with pytest.raises(SourceError, match=rf"; there is nclt:{folder}/2012-01-22$"):
            open_source(source)


@pytest.mark.parametrize(("text", "encoding"), [("position_m\n0\n", "utf-16-le"), ("name,x_m\nstraße,0", "latin-1")])
def test_how_to_save_what_spreadsheets_write_is_said(folder, text, encoding):
    (folder / "positions.csv").write_text(text, encoding=encoding)
    with pytest.raises(SourceError, match="save it as CSV in UTF-8"):
        open_source(str(folder))


def test_a_folder_without_images_says_what_it_looked_for(tmp_path):
    with pytest.raises(SourceError, match=r"holds no images \(\.bmp, \.heic"):
        open_source(str(tmp_path))
    (tmp_path / "lb3").mkdir()
    with pytest.raises(SourceError, match=f"for NCLT write nclt:{tmp_path}"):
        open_source(str(tmp_path))


def test_degrees_in_the_columns_of_metres_are_told(folder):
    positions(folder, "x_m,y_m", *(f"{48.1 + k * 1e-5},11.5" for k in range(4)))
    (remark,) = open_source(str(folder)).remarks
    assert "x_m, y_m are no metres (degrees go into columns latitude, longitude)" in remark


def test_positions_that_all_are_one_and_tables_of_another_name_are_told(folder):
    positions(folder, *"7777")
    (remark,) = open_source(str(folder)).remarks
    assert "all frames lie within 0 m: the robot stood" in remark
    (folder / "positions.csv").rename(folder / "poses.csv")
    (folder / "captions.csv").write_text("name,text\n")
    (remark,) = open_source(str(folder)).remarks
    assert "(poses.csv is not read: it must be called positions.csv, or be" in remark
    (folder / "rear").mkdir()
    (folder / "rear" / "1.png").write_bytes(b"")
    assert open_source(str(folder)).remarks[-1] == "folders inside are not looked at, and rear holds images"


@pytest.mark.parametrize("offset_s", [float("nan"), 1e30])
def test_an_offset_that_is_none_is_refused(folder, offset_s):
    with pytest.raises(InvalidArgumentError, match="clocks are not so far apart"):
        open_source(str(folder), time_offset_s=offset_s)


def test_a_clock_coarser_than_the_frames_leaves_each_its_place(tmp_path):
    empty_files(tmp_path, (f"{number}.png" for number in range(40)))
    positions(tmp_path, "time_s,x_m,y_m", *(f"{1_400_000_000 + number // 5},{number},0" for number in range(40)))
    recording = open_source(str(tmp_path))
    assert [frame.position_m for frame in recording.frames] == pytest.approx(range(40))
    assert recording.frames[4].timestamp_us == 1_400_000_000_000_000


def test_one_missing_time_leaves_the_others_in_use(tmp_path):
    empty_files(tmp_path, (f"{number:02d}.png" for number in range(40)))
    rng = np.random.default_rng(3)
    rows = [
        [f"{k:02d}.png", f"{k + rng.normal(0, 0.02):.3f}", "0", str(1_700_000_000_000_000 + k * 100_000)]
        for k in range(40)
    ]
    rows[7][3] = rows[39][3] = ""
    rows[20][1] = "900"  # a spike
    rows[3][3], rows[4][3] = rows[4][3], rows[3][3]
    positions(tmp_path, "name,x_m,y_m,timestamp_us", *map(",".join, rows))
    recording = open_source(str(tmp_path))
    assert recording.left_out == {"where no robot can have been": 1, "whose time goes back": 1}
    assert any("2 frames say no time" in remark for remark in recording.remarks)
    assert recording.frames[-1].position_m == pytest.approx(39, abs=1)
    assert [frame.timestamp_us for frame in recording.frames if frame.name in ("07.png", "39.png")] == [None, None]


def test_a_damaged_picture_is_told_by_its_name_alone(tmp_path):
    """Pillow warns of what it holds where it should say how the picture was taken."""
    Image.new("RGB", (64, 48)).save(whole_picture := tmp_path / "whole.tiff")
    (tmp_path / "cut.tiff").write_bytes(whole_picture.read_bytes()[:20])
    program = "from deepsimbad_client.recordings.sources import open_source; print(open_source('.').remarks)"
    process = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert (process.stderr, "2 images" in process.stdout) == ("", True)
