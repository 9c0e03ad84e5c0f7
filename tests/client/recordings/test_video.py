import struct
from collections import OrderedDict

import cv2
import numpy as np
import pytest

from deepsimbad_client.errors import BrokenFrameError, SourceError
from deepsimbad_client.http.upload import in_order
from deepsimbad_client.recordings import video as videos
from deepsimbad_client.recordings.sources import open_source

from .conftest import pixels_of


def filmed(path, codec):
    """Write thirty frames, ten a second; the grey of each is five times its number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10, (64, 48))
    for number in range(30):
        writer.write(np.full((48, 64, 3), 5 * number, np.uint8))
    writer.release()
    return path


@pytest.fixture
def video(tmp_path):
    return filmed(tmp_path / "drive.avi", "MJPG")


def grey(recording, frame):
    return float(pixels_of(recording.image(frame, None)).mean())


def test_a_video_is_its_frames_in_any_order_asked_for(video):
    recording = open_source(f"{video}#3:30:4", spacing_m=2)
    first, second = [(frame.name, frame.position_m, frame.timestamp_us) for frame in recording.frames[:2]]
    assert (first, second) == (("drive.avi/000003", 6, 300_000), ("drive.avi/000007", 14, 700_000))
    for frame in [*recording.frames[::-1], *recording.frames]:
        assert grey(recording, frame) == pytest.approx(5 * int(frame.name[-2:]), abs=2)
    shades = dict(in_order(lambda frame: grey(recording, frame), recording.frames, 4))
    assert [round(shade / 20 - 0.75) for shade in shades.values()] == list(range(7))


def test_frames_are_taken_by_time_or_by_distance(video):
    recording = open_source(f"{video}#1:", every_s=0.5)
    assert [(frame.index, frame.name[-2:]) for frame in recording.frames] == [(k, f"{5 * k:02}") for k in range(1, 6)]
    video.with_suffix(".csv").write_text("time_s,x_m,y_m\n0,0,0\n1,0,5\n1.5,0,5\n2.5,0,15\n3,0,20\n")
    recording = open_source(str(video), every_m=5)
    places_m = {frame.name[-2:]: round(frame.position_m, 1) for frame in recording.frames}
    assert places_m == {"00": 0, "10": 5, "20": 10, "25": 15}
    rows = (f"{1_400_000_000_000_000 + after_us},0,{y_m}" for after_us, y_m in ((0, 0), (1_000_000, 5), (2_900_000, 9)))
    video.with_suffix(".csv").write_text("\n".join(["time,x_m,y_m", *rows]))
    recording = open_source(str(video), time_offset_s=0.5)
    assert [round(recording.frames[number].position_m, 1) for number in (0, 5)] == [2.5, 5]
    late_names = [f"drive.avi/0000{number}" for number in range(25, 30)]
    assert recording.left_out_names["before or after the positions"] == late_names
    assert "begin together" in recording.remarks[0]
    with pytest.raises(SourceError, match="--every-s"):
        open_source(str(video), every_m=5, every_s=1)


def with_times(mp4, entries):
    """An .mp4 whose frames are shown at other times: its box `stts` is rebuilt of (frames, ticks of each) entries."""

    def boxes(start, end):
        while start < end:
            size, kind = struct.unpack(">I4s", mp4[start : start + 8])
            yield kind, start, size
            start += size

    chain, start, end = [], 0, len(mp4)
    for box_kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        chain.append(next((start, size) for kind, start, size in boxes(start, end) if kind == box_kind))
        start, end = chain[-1][0] + 8, sum(chain[-1])
    table = b"".join(struct.pack(">II", *entry) for entry in entries)
    box = struct.pack(">I4sII", 16 + len(table), b"stts", 0, len(entries)) + table
    start, size = chain[-1]
    new_mp4 = bytearray(mp4[:start] + box + mp4[start + size :])
    for outer, outer_size in chain[:-1]:
        new_mp4[outer : outer + 4] = struct.pack(">I", outer_size + len(box) - size)
    return bytes(new_mp4)


def test_frames_of_a_changing_rate_have_the_times_at_which_they_are_shown(tmp_path):
    path = filmed(tmp_path / "phone.mp4", "mp4v")
    path.write_bytes(with_times(path.read_bytes(), [(10, 1024), (20, 2048)]))  # of 10240 a second
    rows = (f"{number / 10},{number},0" for number in range(80))
    path.with_suffix(".CSV").write_text("\n".join(["time_s,x_m,y_m", *rows]))
    recording = open_source(str(path))
    assert [frame.position_m for frame in recording.frames] == pytest.approx([*range(10), *range(10, 30, 2)])
    assert "the file says that it has 30 frames, and 20 can be decoded" in recording.remarks[-1]  # of three seconds
    assert [grey(recording, frame) for frame in recording.frames[::19]] == pytest.approx([0, 95], abs=3)


def test_lines_for_every_frame_place_them(video):
    video.with_suffix(".csv").write_text("position_m\n" + "".join(f"{number / 2}\n" for number in range(30)))
    assert open_source(str(video)).frames[-1].position_m == 14.5


def test_a_camera_that_hangs_upside_down_is_turned(video):
    recording = open_source(str(video), rotate=90)
    assert pixels_of(recording.image(recording.frames[0], None)).shape == (64, 48, 3)


def test_a_video_cut_short_has_broken_frames_and_none_at_all_is_named(video, capfd):
    body = video.read_bytes()
    video.write_bytes(body[: len(body) // 2])
    recording = open_source(str(video))
    with pytest.raises(BrokenFrameError, match="no frame 29"):
        recording.image(recording.frames[29], None)
    video.write_bytes(b"no video")
    with pytest.raises(SourceError, match=r"drive\.avi is no video"):
        open_source(str(video))
    capfd.readouterr()  # FFmpeg's own words


def test_a_jump_ahead_keeps_few_frames_at_any_time(video, monkeypatch):
    class Counted(OrderedDict):
        n_most = 0

        def __setitem__(self, key, value):
            super().__setitem__(key, value)
            Counted.n_most = max(Counted.n_most, len(self))

    monkeypatch.setattr(videos, "N_KEPT", 4)
    recording = open_source(str(video))
    monkeypatch.setattr(recording.decoder, "_images", Counted())
    assert grey(recording, recording.frames[29]) == pytest.approx(145, abs=2)
    assert Counted.n_most == 5
