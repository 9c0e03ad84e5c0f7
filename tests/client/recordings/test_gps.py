from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepsimbad_client.errors import MissingExtraError, SourceError
from deepsimbad_client.recordings.gps import GPS_DEADBAND_M, utm
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.recordings.track import arc_length_m

from .conftest import pixels_of

START = 1_305_031_103  # 2011-05-10T12:38:23Z


def test_degrees_become_utm_metres_and_the_unknown_stays_unknown():
    north, east = utm(np.array([43.642567, 0.0, np.nan, 91.0]), np.array([-79.387139, 0.0, 1.0, 1.0]))
    assert (north[0], east[0]) == pytest.approx((4_833_438.6, 630_084.3), abs=0.1)
    assert np.isnan(north[1:]).all()
    north, east = utm(np.array([-33.9]), np.array([151.2]))
    assert north[0] == pytest.approx(-3_752_900, abs=1_500), "south of the equator"


def pictures(folder, names, **exif_of):
    folder.mkdir(exist_ok=True)
    for place, name in enumerate(names):
        exif = Image.Exif()
        for tag, value in exif_of.get("base", lambda _: {})(place).items():
            exif.get_ifd(0x8769)[tag] = value
        for tag, value in exif_of.get("gps", lambda _: {})(place).items():
            exif.get_ifd(0x8825)[tag] = value
        Image.fromarray(np.full((12, 16, 3), 10 * place % 250, np.uint8)).save(folder / name, exif=exif)
    return str(folder)


def table(source, header, rows):
    (Path(source) / "positions.csv").write_text("\n".join([header, *rows]))


def gpx(path, n=60):
    """Write a fix a second, each 2 m farther north; the twentieth has no place."""
    points = "".join(
        f'<trkpt lat="{0 if k == 20 else 51 + 2 * k / 111_270}" lon="{0 if k == 20 else 9}">'
        f"<ele>3</ele><time>2011-05-10T12:{38 + (23 + k) // 60}:{(23 + k) % 60:02}Z</time></trkpt>"
        for k in range(n)
    )
    path.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>')


def test_images_with_times_for_names_are_placed_by_the_gpx_beside_them(tmp_path):
    source = pictures(tmp_path / "drive", [f"{START + 2 * k}.5.png" for k in range(-1, 31)])
    gpx(tmp_path / "drive" / "a.gpx")
    recording = open_source(source)
    assert recording.left_out == {"before or after the track": 2}
    ahead = np.diff([frame.position_m for frame in recording.frames])
    np.testing.assert_allclose(ahead, 4, atol=0.02)
    assert recording.frames[0].x_m == pytest.approx(5_650_300, abs=600)
    track = (tmp_path / "drive" / "a.gpx").read_text()
    track = track.replace("2011-05-10T12:38:40Z", "at noon").replace("<time>2011-05-10T12:38:50Z</time>", "")
    (tmp_path / "drive" / "a.gpx").write_text(track)
    assert any("3 rows of the track are not used" in remark for remark in open_source(source).remarks)
    assert open_source(source, time_offset_s=10).frames[0].position_m == pytest.approx(17, abs=0.1)
    gpx(tmp_path / "drive" / "b.gpx")
    with pytest.raises(SourceError, match=r"several tracks \(a\.gpx, b\.gpx\)"):
        open_source(source)


def test_exif_tells_the_time_where_names_do_not(tmp_path):
    def exif_times(place):
        return {36867: f"2011:05:10 14:38:{25 + place}", 36881: "+02:00", 37521: "5"} if place else {}

    source = pictures(tmp_path / "drive", [f"{k}.jpg" for k in range(5)], base=exif_times)
    gpx(tmp_path / "drive" / "track.gpx")
    recording = open_source(source)
    assert recording.left_out_names == {"without a time": ["0.jpg"]}
    assert recording.frames[0].position_m == pytest.approx(7, abs=0.05)
    source = pictures(tmp_path / "local", ["a.jpg"], base=lambda _: {36867: "2011:05:10 14:38:30"})
    gpx(tmp_path / "local" / "track.gpx")
    with pytest.raises(SourceError, match=r"they are of 2011-05-10T14:38.*--time-offset-s"):
        open_source(source)
    recording = open_source(source, time_offset_s=-7200)
    assert recording.frames[0].position_m == pytest.approx(14, abs=0.1)
    assert "without a zone" in recording.remarks[1]
    gpx(tmp_path / "track.gpx")
    source = pictures(tmp_path, ["a.png"])
    with pytest.raises(SourceError, match="no image tells its time"):
        open_source(source)


def nmea(seconds, latitude, valid="A"):
    minutes = 60 * (latitude % 1)
    body = (
        f"GPRMC,{12 * 10000 + 3800 + seconds:06}.00,{valid},{int(latitude)}{minutes:09.6f},N,00900.000,E,1,0,100511,,"
    )
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}"


def test_nmea_is_read_without_what_is_damaged_or_has_no_fix(tmp_path):
    source = pictures(tmp_path / "drive", [f"{START + k}.png" for k in range(5)])
    lines = [nmea(23 + k, 51 + k / 111_270, "V" if k == 2 else "A") for k in range(30)]
    lines[3] = lines[3].replace("51", "57", 1)  # its checksum no longer fits
    lines[29] = lines[29].partition("*")[0].replace(",N,", ",,")  # says neither north nor south, and has no checksum
    lines[4] = f"12:38:27.1 {lines[4]}"  # as loggers write
    (tmp_path / "drive" / "log.nmea").write_text("\r\n".join(["$GPGSV,1", *lines, "$GPRM"]))
    recording = open_source(source)
    assert [frame.position_m for frame in recording.frames] == pytest.approx([0, 1, 2, 3, 4], abs=0.02)
    assert "3 rows of the track are not used" in recording.remarks[1]
    (tmp_path / "drive" / "log.nmea").write_text("nothing")
    with pytest.raises(SourceError, match="of its 0 RMC sentences, which alone say the date, fewer than two"):
        open_source(source)


def degrees(angle):
    return (int(angle), int(angle % 1 * 60), angle * 60 % 1 * 60)


def test_exif_places_the_images_that_have_it(tmp_path):
    def gps(place):
        if place == 20:
            return {}
        latitude = 51 + (9 if place == 10 else 2 * place / 111_270)  # the tenth is a spike
        if place % 3 == 0:  # without seconds
            return {1: "n", 2: (51, (latitude - 51) * 60), 3: "W", 4: (9,), 29: "2011:05:10", 7: (12, 38, place)}
        return {1: "N", 2: degrees(latitude), 3: "W", 4: degrees(9), 29: "2011:05:10", 7: (12, 38, place)}

    recording = open_source(pictures(tmp_path / "drive", [f"{k}.jpg" for k in range(30)], gps=gps))
    assert recording.left_out_names == {"without a position": ["20.jpg"], "where no robot can have been": ["10.jpg"]}
    assert recording.frames[-1].position_m == pytest.approx(58, abs=0.1)
    assert recording.frames[-1].timestamp_us == (1_305_031_080 + 29) * 1_000_000


def test_a_fix_of_nothing_is_of_no_zone(tmp_path):
    source = pictures(tmp_path / "drive", [f"{k}.png" for k in range(30)])
    table(source, "lat,lon", ("0,0" if k == 9 else f"{51 + k / 111_270},9" for k in range(30)))
    recording = open_source(source)
    assert (recording.left_out, list(recording.remarks)) == ({"without a position": 1}, [])


def test_latitude_and_longitude_stand_in_a_table_too(tmp_path):
    source = pictures(tmp_path / "drive", ["0.png", "1.png", "2.png"])
    table(source, "lat,lon", ["51,9", ",", f"{51 + 50 / 111_270},9"])
    recording = open_source(source)
    assert recording.left_out == {"without a position": 1}
    assert recording.frames[1].position_m == pytest.approx(50, abs=0.1)


def test_a_receiver_that_wanders_while_it_stands_goes_nowhere(tmp_path):
    rng = np.random.default_rng(0)
    wander = np.cumsum(rng.normal(0, 0.05, 600))  # correlated, as a receiver's is: no white noise to tell it by
    wander -= np.linspace(wander[0], wander[-1], 600)
    along_m = np.concatenate((np.arange(100.0), 100 + wander, np.arange(100.0, 200)))
    source = pictures(tmp_path / "drive", [f"{START + k}.png" for k in range(0, 800, 20)])
    table(source, "lat,lon,time", (f"{51 + metres / 111_270},9,{START + k}" for k, metres in enumerate(along_m)))
    assert open_source(source).frames[-1].position_m == pytest.approx(180, abs=8)


def test_a_video_begins_with_the_track_beside_it(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "drive.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for number in range(30):
        writer.write(np.full((48, 64, 3), number, np.uint8))
    writer.release()
    gpx(tmp_path / "drive.gpx")
    assert open_source(str(tmp_path / "drive.avi")).frames[-1].position_m == pytest.approx(5.8, abs=0.05)


def test_heic_is_read_or_its_library_is_named(tmp_path, monkeypatch):
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    picture = cv2.resize(np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8), (96, 64))
    Image.fromarray(picture).save(tmp_path / "a.HEIC", format="HEIF", quality=95)
    recording = open_source(str(tmp_path))
    encoded = recording.image(recording.frames[0], None)
    assert encoded.content_type == "image/png"
    assert np.abs(pixels_of(encoded)[..., ::-1].astype(int) - picture).mean() < 8
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    with pytest.raises(MissingExtraError, match=r"deep-simbad\[heic\]"):
        open_source(str(tmp_path))


def test_a_receiver_that_wanders_over_minutes_hardly_gets_on_and_circles_are_driven():
    rng = np.random.default_rng(1)
    along_m = np.concatenate([np.arange(200), np.full(300, 199), np.arange(199, 400)])
    wander = rng.normal(0, 2, (2, len(along_m)))
    for k in range(1, len(along_m)):  # correlated over a minute, 2 m
        wander[:, k] = np.exp(-1 / 60) * wander[:, k - 1] + np.sqrt(1 - np.exp(-2 / 60)) * wander[:, k]
    time_us = np.arange(len(along_m)) * 1_000_000
    assert arc_length_m(along_m + wander[0], wander[1], time_us, GPS_DEADBAND_M)[-1] == pytest.approx(399, abs=20)
    turn = np.arange(600) / 8
    circles = arc_length_m(8 * np.cos(turn), 8 * np.sin(turn), np.arange(600) * 1_000_000, GPS_DEADBAND_M)
    assert circles[-1] == pytest.approx(599, abs=12)


def test_the_zone_is_that_of_most_places():
    x_m, y_m = utm(np.full(5, 51.0), np.array([11.9999, 12.0001, 12.0002, 12.0003, 12.0004]))
    assert y_m[0] < y_m[1] < 300_000, "all in zone 33"
    assert np.ptp(x_m) < 5


def test_a_drive_across_a_zone_is_told(tmp_path):
    source = pictures(tmp_path / "drive", ["0.png", "1.png", "2.png"])
    table(source, "lat,lon", ["51,11.9999", "51,12.0001", "51,12.0002"])
    (remark,) = open_source(source).remarks
    assert "crosses UTM zones (32, 33): x, y are metres of zone 33" in remark
