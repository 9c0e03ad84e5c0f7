"""Public benchmark sets, in folders laid out as they are downloaded."""

import cv2
import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.sources import open_source

from .conftest import pixels_of

TIME_US = 1_418_132_000_000_000


def picture(path, grey=90, shape=(24, 32, 3)):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full(shape, grey, np.uint8))


def names(recording):
    return [frame.name for frame in recording.frames]


def test_nordland_frames_are_those_of_the_clean_list_and_one_number_is_one_place(tmp_path):
    for season in ("summer", "winter"):
        for number in range(1, 13):
            if (season, number) != ("winter", 4):
                picture(tmp_path / season / f"images-{number:05d}.png")
    summer = open_source(f"nordland:{tmp_path}/summer")
    winter = open_source(f"nordland:{tmp_path}/winter", spacing_m=2)
    assert [frame.position_m for frame in winter.frames] == [2 * n for n in (1, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12)]
    assert (summer.tolerance_m, winter.tolerance_m) == (10.5, 21.0), "ten frames, whatever their spacing"
    (tmp_path / "cleanImageNames.txt").write_text("".join(f"images-{number:05d}.png\n" for number in (2, 3, 4, 7)))
    clean = open_source(f"nordland:{tmp_path}/winter")
    assert names(clean) == [f"images-{number:05d}.png" for number in (2, 3, 7)]
    assert [frame.position_m for frame in clean.frames] == [0, 1, 3], "places in the list, as the summer's"
    assert clean.left_out == {"not in cleanImageNames.txt": 8}


def test_gardens_point_counts_within_two_frames(tmp_path):
    for number in range(5):
        picture(tmp_path / "day_left" / f"Image{number:03d}.jpg")
    drive = open_source(f"gardens_point:{tmp_path}/day_left")
    assert [frame.position_m for frame in drive.frames] == [0, 1, 2, 3, 4]
    assert drive.tolerance_m == 2.5


@pytest.mark.parametrize("prefix", ["", "svox:", "st_lucia:", "msls:"])
def test_names_that_tell_utm_places_need_no_prefix(tmp_path, prefix):
    gallery = tmp_path / "images" / "test" / "gallery"
    for frame, (east, north) in enumerate([(30, 400), (10, 400), (20, 430)]):
        picture(gallery / f"@{east:010.2f}@{north:010.2f}@55@J@-27.5@153.0@drive_{frame:05d}@@@@@@@@.jpg")
    recording = open_source(f"{prefix}{gallery}")
    assert [(frame.x_m, frame.y_m) for frame in recording.frames] == [(400, 30), (400, 10), (430, 20)], "by their ids"
    assert [frame.position_m for frame in recording.frames] == pytest.approx([0, 20, 20 + np.hypot(30, 10)])
    assert recording.tolerance_m == 25
    assert any("true within 25 m" in remark for remark in recording.remarks)


def test_msls_goes_by_its_tables_and_leaves_panoramas_out(tmp_path):
    city = tmp_path / "train_val" / "cph" / "query"
    for key in ("a", "b", "c", "d"):
        picture(city / "images" / f"{key}.jpg")
    (city / "postprocessed.csv").write_text(
        ",key,easting,northing,unique_cluster,night,control_panel,view_direction\n"
        "0,a,10,0,1,False,False,Forward\n1,b,0,0,1,False,False,Forward\n2,c,5,0,1,False,False,Forward\n"
        "3,d,90,0,1,False,False,Forward\n4,gone,90,0,1,False,False,Forward\n"
    )
    (city / "seq_info.csv").write_text(
        ",key,sequence_key,frame_number\n0,a,s,2\n1,b,s,0\n2,c,s,10\n3,d,s,11\n4,gone,s,12\n"
    )
    (city / "raw.csv").write_text(",key,lon,lat,ca,captured_at,pano\n3,d,0,0,0,2018-01-01,True\n")
    recording = open_source(str(city))
    assert names(recording) == ["b.jpg", "a.jpg", "c.jpg"]
    assert [frame.position_m for frame in recording.frames] == [0, 10, 15]
    assert recording.left_out == {"panorama": 1, "in postprocessed.csv without an image": 1}
    assert recording.image(recording.frames[0], None).body, "images lie one folder deeper"
    with (city / "postprocessed.csv").open("a") as rows:
        rows.write("5,cut")  # short
    assert len(open_source(str(city)).frames) == 3
    (city / "seq_info.csv").write_text(",key,sequence_key,frame_number\n0,a,s,two\n")
    with pytest.raises(SourceError, match=r"seq_info\.csv: the columns key and frame_number"):
        open_source(str(city))


def test_robotcar_is_placed_by_its_ins_and_its_mosaics_become_colours(tmp_path):
    drive = tmp_path / "2014-12-09-13-21-02"
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[1::2, ::2] = 255  # of G B / R G, what is red
    folder = drive / "stereo" / "centre"
    folder.mkdir(parents=True)
    for number in range(4):
        cv2.imwrite(str(folder / f"{TIME_US + 500_000 * number}.png"), mosaic)
    (drive / "gps").mkdir()
    rows = [f"{TIME_US + 200_000 * row},INS,51.7,-1.2,110,{100 + row},{200},-110,30U,0,0,0,0,0,0.5" for row in range(8)]
    head = "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,"
    head += "velocity_north,velocity_east,velocity_down,roll,pitch,yaw"
    (drive / "gps" / "ins.csv").write_text("\n".join([head, *rows]))
    for source in (drive, folder, f"robotcar:{drive}"):
        recording = open_source(str(source))
        assert [frame.x_m for frame in recording.frames] == pytest.approx([100, 102.5, 105])
        assert recording.left_out == {"before or after the positions": 1}
    blue, green, red = pixels_of(recording.image(recording.frames[0], None))[2:-2, 2:-2].reshape(-1, 3).T
    assert red.min() > 200, "every pixel, by those beside it"
    assert max(blue.max(), green.max()) == 0


def test_st_lucia_is_a_video_with_a_fix_a_frame(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "webcam_video.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 15, (64, 48))
    for number in range(6):
        writer.write(np.full((48, 64, 3), 20 * number, np.uint8))
    writer.release()
    (tmp_path / "fGPS.txt").write_text("".join(f"{27.5 + 1e-4 * row:.6f},153.000000\n" for row in range(6)))
    recording = open_source(str(tmp_path))
    assert len(recording.frames) == 6
    assert recording.frames[5].position_m == pytest.approx(5 * 11.08, abs=0.3)
    assert recording.frames[5].x_m < recording.frames[0].x_m < 0, "southwards, south of the equator"
    assert recording.tolerance_m == 25


def test_a_folder_that_is_none_of_them_is_named(tmp_path):
    picture(tmp_path / "other" / "a.png")
    with pytest.raises(SourceError, match="is not laid out as MSLS is"):
        open_source(f"msls:{tmp_path}/other")
    with pytest.raises(SourceError, match="there is no folder"):
        open_source("nordland:/nowhere/summer")
    plain = open_source(str(tmp_path / "other"))
    assert plain.tolerance_m is None
    assert "1 images are taken" in plain.remarks[0], "an ordinary folder stays one"
