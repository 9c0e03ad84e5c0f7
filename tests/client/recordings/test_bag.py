import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from deepsimbad_client.errors import BrokenFrameError, MissingExtraError, SourceError
from deepsimbad_client.recordings.sources import open_source

from .conftest import pixels_of

START_NS = 1_400_000_000_000_000_000
TYPES = get_typestore(Stores.ROS2_HUMBLE)
IMAGE = "sensor_msgs/msg/Image"
PIXELS = {"encoding": "mono8", "is_bigendian": 0, "data": np.zeros(12, np.uint8), "height": 3, "width": 4, "step": 4}
PICTURE = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)


class Bag:
    """Writes messages of a drive of 1 m/s: images five a second, positions twenty a second."""

    def __init__(self, path, kind):
        self.path, self.ros1 = path, kind == "bag"
        self.types = get_typestore(Stores.ROS1_NOETIC) if self.ros1 else TYPES
        storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=storage)
        self.topics = {}

    def type(self, name):
        return self.types.types[name]

    def header(self, ns):
        stamp = self.type("builtin_interfaces/msg/Time")(sec=ns // 10**9, nanosec=ns % 10**9)
        seq = {"seq": 0} if self.ros1 else {}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id="map", **seq)

    def write(self, topic, name, at_ns, late_ns=2_000_000, **fields):
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, name, typestore=self.types)
        message = self.type(name)(header=self.header(at_ns), **fields)
        encode = self.types.serialize_ros1 if self.ros1 else self.types.serialize_cdr
        self.writer.write(self.topics[topic], START_NS + at_ns % START_NS + late_ns, encode(message, name))

    def image(self, at_ns, topic="/front", pixels=PICTURE, encoding="bgr8"):
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": len(data) // pixels.shape[0]}
        self.write(topic, "sensor_msgs/msg/Image", at_ns, encoding=encoding, is_bigendian=0, data=data, **size)

    def compressed(self, at_ns, body, topic="/front/compressed"):
        data = np.frombuffer(body, np.uint8)
        self.write(topic, "sensor_msgs/msg/CompressedImage", at_ns, format="jpeg", data=data)

    def pose(self, x, y, yaw):
        turn = self.type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        return self.type("geometry_msgs/msg/Pose")(
            position=self.type("geometry_msgs/msg/Point")(x=x, y=y, z=0.0), orientation=turn
        )

    def poses(self, topic="/pose", seconds=4, name="geometry_msgs/msg/PoseStamped"):
        for k in range(20 * seconds + 1):
            pose = self.pose(k / 20, 7.0, 0.5)
            if name == "nav_msgs/msg/Odometry":
                zero = self.type("geometry_msgs/msg/Vector3")(x=0.0, y=0.0, z=0.0)
                twist = self.type("geometry_msgs/msg/Twist")(linear=zero, angular=zero)
                fields = {
                    "child_frame_id": "base",
                    "pose": self.type("geometry_msgs/msg/PoseWithCovariance")(pose=pose, covariance=np.zeros(36)),
                    "twist": self.type("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=np.zeros(36)),
                }
            else:
                fields = {"pose": pose}
            self.write(topic, name, START_NS + 50_000_000 * k, **fields)

    def fixes(self, topic="/fix", seconds=4):
        """Writes fixes north from Greenwich, without a fix in the first half second and with one of 0, 0."""
        for k in range(20 * seconds + 1):
            degrees = 51.5 + k / 20 / 111_250, 0.0 if k < 10 else 0.5
            latitude, longitude = (0.0, 0.0) if k == 40 else degrees
            status = self.type("sensor_msgs/msg/NavSatStatus")(status=-1 if k < 10 else 0, service=1)
            place = {"latitude": latitude, "longitude": longitude, "altitude": 0.0}
            place |= {"position_covariance": np.zeros(9), "position_covariance_type": 0}
            self.write(topic, "sensor_msgs/msg/NavSatFix", START_NS + 50_000_000 * k, status=status, **place)


@pytest.fixture
def bag(tmp_path):
    """A function that writes a bag of a kind (bag, folder, mcap) by its parts, and returns its SOURCE."""

    def write_bag(kind, *parts):
        path = tmp_path / ("drive.bag" if kind == "bag" else kind)
        drive = Bag(path, kind)
        drive.writer.open()
        for part in parts:
            part(drive)
        drive.writer.close()
        if kind == "mcap":
            (inner,) = path.glob("*.mcap")
            shutil.move(inner, tmp_path / "drive.mcap")
            return str(tmp_path / "drive.mcap")
        return f"rosbag:{path}"

    return write_bag


def images(drive):
    for k in range(20):
        drive.image(START_NS + 200_000_000 * k)


def odometry(drive):
    drive.poses("/odom", name="nav_msgs/msg/Odometry")


def sent_pixels(recording, row=0):
    return pixels_of(recording.image(recording.frames[row], None))


@pytest.mark.parametrize("kind", ["bag", "folder", "mcap"])
def test_images_are_placed_by_poses_at_the_times_in_their_headers(bag, kind):
    source = bag(kind, images, Bag.poses)
    recording = open_source(f"{source}#5:15:2")
    assert [round(frame.position_m, 6) for frame in recording.frames] == [1, 1.4, 1.8, 2.2, 2.6]
    first = recording.frames[0]
    assert (first.index, first.timestamp_us) == (5, START_NS // 1000 + 1_000_000)
    assert (first.x_m, first.y_m, first.heading_rad) == pytest.approx((1, 7, 0.5))
    assert first.name.endswith(f"/front/{START_NS + 1_002_000_000}")
    for row in (3, 0, 4):
        np.testing.assert_array_equal(sent_pixels(recording, row), PICTURE)
    assert open_source(f"{source}#/front,/pose#:3").frames[2].position_m == pytest.approx(0.4)


def test_fixes_are_metres_of_one_plane_and_those_without_a_fix_are_not_used(bag):
    recording = open_source(bag("mcap", images, Bag.fixes))
    assert recording.left_out == {"before or after the positions": 3}
    ahead = [frame.position_m for frame in recording.frames]
    assert ahead[-1] - ahead[0] == pytest.approx(3.2, abs=0.05)
    assert recording.frames[0].x_m == pytest.approx(5_709_000, abs=20_000), "north of the equator in UTM"


def test_odometry_measures_but_gives_no_plane_that_another_drive_shares(bag):
    recording = open_source(bag("folder", images, odometry))
    assert recording.frames[-1].position_m == pytest.approx(3.8)
    assert recording.frames[-1].x_m is None
    recording = open_source(bag("bag", images, Bag.fixes, odometry))
    assert "positions of /fix (there are /fix, /odom)" in recording.remarks[0]


def test_without_positions_images_are_evenly_spaced(bag):
    recording = open_source(bag("mcap", images), spacing_m=0.5, every_s=0.4)
    assert [frame.position_m for frame in recording.frames] == [float(k) for k in range(10)]


def test_one_of_several_topics_is_named(bag):
    source = bag("folder", images, lambda drive: drive.image(START_NS, "/rear"), Bag.poses)
    with pytest.raises(SourceError, match=r"images in several topics: name one of /front, /rear as rosbag:"):
        open_source(source)
    assert len(open_source(f"{source}#/front").frames) == 20
    with pytest.raises(SourceError, match="no images in /side"):
        open_source(f"{source}#/side")
    with pytest.raises(SourceError, match="holds no images"):
        open_source(bag("bag", Bag.poses))


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", PICTURE[:, :, ::-1], PICTURE),
        ("bgra8", np.dstack((PICTURE, PICTURE[:, :, 0])), PICTURE),
        ("mono8", PICTURE[:, :, 0], PICTURE[:, :, [0, 0, 0]]),
        ("rgb16", PICTURE[:, :, ::-1].astype(np.uint16) * 257, PICTURE),
        ("mono16", PICTURE[:, :, 0].astype(np.uint16) * 257, PICTURE[:, :, [0, 0, 0]]),
        ("16UC1", PICTURE[:, :, 0].astype(np.uint16) * 16, PICTURE[:, :, [0, 0, 0]]),
        ("bayer_rggb8", np.full((12, 16), 90, np.uint8), np.full((12, 16, 3), 90, np.uint8)),
    ],
)
def test_raw_images_of_every_layout_become_bgr(bag, encoding, pixels, expected):
    recording = open_source(bag("mcap", lambda drive: drive.image(START_NS, pixels=pixels, encoding=encoding)))
    np.testing.assert_allclose(sent_pixels(recording).astype(int), expected, atol=1)


def test_a_camera_of_twelve_bits_is_shown_by_the_levels_of_its_recording(bag):
    def dim_and_bright(drive):
        for k, peak in enumerate((1000, 4000)):
            grey = np.linspace(0, peak, 12 * 16).reshape(12, 16).astype(np.uint16)
            drive.image(START_NS + 10**9 * k, pixels=grey, encoding="mono16")

    recording = open_source(bag("mcap", dim_and_bright))
    assert recording.grey_levels == (0, 4095)
    assert [int(sent_pixels(recording, row).max()) for row in (0, 1)] == [62, 250]
    assert int(sent_pixels(recording.shown_by((0, 1023)), 0).max()) == 250


def test_a_compressed_image_goes_as_it_is_and_a_broken_one_is_named(bag):
    body = cv2.imencode(".jpg", PICTURE)[1].tobytes()

    def write_images(drive):
        drive.compressed(START_NS, body)
        drive.compressed(START_NS + 1_000, body[:-40])
        drive.image(START_NS, "/raw", encoding="depth")

    source = bag("folder", write_images)
    recording = open_source(f"{source}#/front/compressed")
    assert recording.image(recording.frames[0], None).body == body
    with pytest.raises(BrokenFrameError):
        recording.image(recording.frames[1], None)
    recording = open_source(f"{source}#/raw", rotate=90)
    with pytest.raises(BrokenFrameError, match="encoding 'depth'"):
        recording.image(recording.frames[0], None)


def test_headers_of_one_time_or_of_a_clock_that_was_set_are_told(bag):
    def stuck(drive):
        for k in range(20):
            drive.write("/front", IMAGE, START_NS, late_ns=200_000_000 * k, **PIXELS)

    recording = open_source(bag("bag", stuck, Bag.poses))
    assert [frame.position_m for frame in recording.frames] == pytest.approx(np.arange(20) / 5)
    assert "all headers say one time: images have the times at which they were recorded" in recording.remarks

    def set_back(drive):
        for k in range(20):
            back_ns = 2_000_000_000 * (k >= 10)
            drive.write("/front", IMAGE, START_NS + 200_000_000 * k - back_ns, late_ns=back_ns, **PIXELS)

    recording = open_source(bag("mcap", set_back, Bag.poses))
    assert any("says 1.8 s before the image recorded before it" in remark for remark in recording.remarks)


def test_images_of_several_sizes_are_told_and_depth_is_no_picture(bag):
    def several(drive):
        for k in range(4):
            drive.image(START_NS + 200_000_000 * k, pixels=PICTURE[: 12 - k % 2])
            for topic, body in (("/jpeg", cv2.imencode(".jpg", PICTURE[k // 3 :])[1]), ("/depth", b"\0" * 40)):
                kind = {"format": "16UC1; compressedDepth png" if topic == "/depth" else "jpeg"}
                data = np.frombuffer(body, np.uint8)
                drive.write(topic, "sensor_msgs/msg/CompressedImage", START_NS + 200_000_000 * k, data=data, **kind)

    source = bag("folder", several)
    assert "2 of 16 x 12 (" in open_source(f"{source}#/front").remarks[-1]
    assert "3 of 16 x 12 (" in open_source(f"{source}#/jpeg").remarks[-1]
    recording = open_source(f"{source}#/depth")
    with pytest.raises(BrokenFrameError, match="is a depth image: name a camera's topic"):
        recording.image(recording.frames[0], None)


def test_what_is_no_bag_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.mcap").write_bytes(b"no bag")
    with pytest.raises(SourceError, match=r"a\.mcap cannot be read"):
        open_source(str(tmp_path / "a.mcap"))
    with pytest.raises(SourceError, match="no bag at"):
        open_source(f"rosbag:{tmp_path}/none.bag")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(MissingExtraError, match=r"deep-simbad\[rosbag\]"):
        open_source(str(tmp_path / "a.mcap"))


def test_messages_that_cannot_be_used_are_counted_each_for_its_reason(bag):
    def broken(drive):
        for topic in ("/front", "/pose"):
            for k in range(2):
                drive.writer.write(drive.topics[topic], START_NS + 3_900_000_000 + k, b"\0\1")
        drive.image(START_NS)

    recording = open_source(bag("mcap", images, Bag.poses, broken))
    assert recording.left_out == {"unreadable message": 2, "received at the time of another": 1}
    assert "2 messages of /pose cannot be read and are not used" in recording.remarks


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_damaged_in_its_middle_is_named(bag, kind):
    source = bag(kind, images, Bag.poses)
    recording, path = open_source(source), Path(source.removeprefix("rosbag:"))
    body = bytearray(path.read_bytes())
    body[200 : len(body) // 2] = b"\xff" * (len(body) // 2 - 200)
    path.write_bytes(body)
    with pytest.raises(
        SourceError, match=r"drive\.\w+ (is damaged: its messages )?cannot be read: .*reindex"
    ) as refused:
        open_source(source)
    assert len(str(refused.value).splitlines()) == 1
    if kind == "mcap":  # the other's reader holds what it has read
        with pytest.raises(BrokenFrameError, match="is damaged"):
            recording.image(recording.frames[0], None)
