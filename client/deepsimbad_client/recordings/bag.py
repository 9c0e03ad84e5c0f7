"""ROS bags and MCAP files: images of one topic, placed by poses, fixes or odometry of another (library `rosbags`).

    rosbag:FILE.bag, rosbag:FOLDER, FILE.mcap, FILE.db3     and behind each #IMAGE_TOPIC or #IMAGE_TOPIC,POSITION_TOPIC

Images are `sensor_msgs/Image` or `CompressedImage`. Positions are the first available of `geometry_msgs/PoseStamped`,
`PoseWithCovarianceStamped`, `sensor_msgs/NavSatFix` and `nav_msgs/Odometry`, whose x, y begin anew with every drive
and are not kept. Times are those of the headers, or of the recording where headers have none.
"""

import dataclasses
import math
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.grey_levels import in_eight_bits
from deepsimbad_client.errors import BrokenFrameError, MissingExtraError, SourceError
from deepsimbad_client.recordings import (
    EncodedImage,
    Frame,
    Recording,
    as_png,
    decode_deep,
    ready,
    stamp_of,
    turned,
    with_grey_levels,
)
from deepsimbad_client.recordings.folder import shape_in, shape_remarks
from deepsimbad_client.recordings.gps import GPS_DEADBAND_M, utm
from deepsimbad_client.recordings.placing import Placement, place_on_track
from deepsimbad_client.recordings.track import track_of

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

BAG_PREFIX = "rosbag:"
BAG_SUFFIXES = frozenset({".bag", ".mcap", ".db3"})
MOST_LATE_US = 1_000_000  # by which the time of an image may step back in the order of recording
_MENDED_BY = "`rosbag reindex`, `ros2 bag reindex` or `mcap recover` mends what was cut off"
METADATA = "metadata.yaml"  # in the folder that is a ROS 2 bag

_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_IMAGES = ("sensor_msgs/msg/Image", _COMPRESSED)
_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_FIX, _ODOMETRY = "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry"
_POSITIONS = (*_POSES, _FIX, _ODOMETRY)  # first those by which drives can be compared best
_LAYOUTS: dict[str, tuple[type, int, int | None]] = {  # sample type, channels, OpenCV's conversion to BGR
    "mono8": (np.uint8, 1, None),
    "8UC1": (np.uint8, 1, None),
    "bgr8": (np.uint8, 3, None),
    "8UC3": (np.uint8, 3, None),
    "rgb8": (np.uint8, 3, cv2.COLOR_RGB2BGR),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2BGR),
    "bgr16": (np.uint16, 3, None),
    "rgb16": (np.uint16, 3, cv2.COLOR_RGB2BGR),
    "mono16": (np.uint16, 1, None),
    "16UC1": (np.uint16, 1, None),
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (np.uint8, 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (np.uint8, 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (np.uint8, 2, cv2.COLOR_YUV2BGR_YUY2),
}

_Rows = list[tuple[int, float, float, float]]  # microseconds, two coordinates, heading


@dataclass(frozen=True, eq=False, kw_only=True)
class BagRecording(Recording):
    """The images of one topic."""

    path: Path
    topic: str
    received_ns: Mapping[str, int]  # by frame name: when the recorder received it, by which it is read again
    rotate: int = 0  # degrees clockwise by which images are turned
    reader_lock: threading.Lock = field(default_factory=threading.Lock, repr=False)  # the reader serves one thread

    def stamp(self, frame: Frame) -> str:
        """The stamp of the bag and the frame's name; see `Recording.stamp`."""
        return f"{stamp_of(self.path)} {frame.name}"

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read a frame: a compressed one as it is, a raw one as PNG; see `Recording.image`."""
        kind, message = self._read(frame)
        if kind == _COMPRESSED and "compresseddepth" in message.format.lower():
            raise BrokenFrameError(f"{frame.name} is a depth image: name a camera's topic", "depth image")
        if kind == _COMPRESSED:
            return ready(bytes(message.data), Path(frame.name), input_size, self.rotate, self.grey_levels)
        image, _ = in_eight_bits(_pixels(message, frame.name), self.grey_levels)
        return as_png(turned(image, self.rotate), input_size)

    def deep(self, row: int) -> NDArray[Any]:
        """A frame's pixels in BGR, uint8, or uint16 with all of 9 to 16 bits; raises BrokenFrameError."""
        kind, message = self._read(self.frames[row])
        name = self.frames[row].name
        return decode_deep(bytes(message.data), Path(name)) if kind == _COMPRESSED else _pixels(message, name)

    def _read(self, frame: Frame) -> tuple[str, Any]:
        """A frame's message and its type. Raises BrokenFrameError."""
        received_ns = self.received_ns[frame.name]
        with self.reader_lock:
            try:
                entry = next(_messages(self._reader, {self.topic}, start=received_ns, stop=received_ns + 1), None)
            except SourceError as error:
                raise BrokenFrameError(f"{frame.name}: {error}", "undecodable") from error
            if entry is None:
                raise BrokenFrameError(f"{frame.name} is not in {self.path} any more", "unreadable file")
            _, kind, _, raw = entry
            return kind, _message(self._reader, raw, kind, frame.name)

    @cached_property
    def _reader(self) -> "AnyReader":
        """The bag's reader, opened with the first image, closed with the recording."""
        reader = _bag_reader(self.path)
        reader.open()
        weakref.finalize(self, reader.close)
        return reader


def read_bag(
    path: Path,
    topics: str,
    spacing_m: float,
    rotate: int = 0,
    time_offset_us: int = 0,
    on_progress: Callable[[float], None] = lambda _: None,
) -> BagRecording:
    """Open a bag; `topics` is IMAGE, or IMAGE,POSITION, or "" for those it has.

    All messages of both topics are read once, for the times in their headers. Raises SourceError (the library cannot
    read it, or it has several topics to choose from), MissingExtraError.
    """
    image_topic, _, position_topic = topics.partition(",")
    remarks: list[str] = []
    with _bag_reader(path) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections if connection.msgcount}
        image_topic = _choose_topic(
            image_topic, [name for name, kind in types.items() if kind in _IMAGES], "images", path
        )
        position_topics = sorted(
            (name for name in types if types[name] in _POSITIONS), key=lambda name: _POSITIONS.index(types[name])
        )
        if position_topic or position_topics:
            position_topic = _choose_topic(position_topic, position_topics, "positions", path, take_first=True)
            choice = f" (there are {', '.join(position_topics)})" if len(position_topics) > 1 else ""
            remarks.append(f"images of {image_topic}, positions of {position_topic}{choice}")
        else:
            remarks.append(f"images of {image_topic}, {spacing_m:g} m apart: there are no poses, fixes or odometry")
        content = _Content(image_topic, position_topic, time_offset_us)
        span = max(1, reader.end_time - reader.start_time)
        for topic, kind, received_ns, raw in _messages(reader, {image_topic, position_topic}):
            on_progress((received_ns - reader.start_time) / span)
            content.take(reader, topic, kind, received_ns, raw, f"{path.name}{topic}/{received_ns}")
    if not content.images:
        raise SourceError(f"{path}: {image_topic} holds no image that can be read")
    remarks += content.check_clock()
    images = sorted(content.images, key=lambda image: image[1])
    if position_topic:
        placement = _place_images(images, content.rows, types[position_topic], f"{path}, {position_topic}")
    else:
        placement = Placement([Frame(i, name, i * spacing_m, time_us) for i, (name, time_us) in enumerate(images)])
    placement.left_out_names |= content.lost_images
    if content.n_lost_positions:
        remarks.append(f"{content.n_lost_positions} messages of {position_topic} cannot be read and are not used")
    recording = BagRecording(
        path.stem,
        tuple(placement.frames),
        placement.left_out_names,
        remarks=[*remarks, *placement.remarks, *shape_remarks(content.shapes)],
        path=path,
        topic=image_topic,
        received_ns=content.received_ns,
        rotate=rotate,
    )
    return with_grey_levels(recording, recording.deep)


@dataclass
class _Content:
    """The content of the messages of both topics."""

    image_topic: str
    position_topic: str
    time_offset_us: int
    received_ns: dict[str, int] = field(default_factory=dict)
    images: list[tuple[str, int]] = field(default_factory=list)
    rows: _Rows = field(default_factory=list)
    lost_images: dict[str, list[str]] = field(default_factory=dict)  # names by reason
    shapes: list[tuple[str, str | None]] = field(default_factory=list)  # (name, shape) of each image
    n_lost_positions: int = 0

    def check_clock(self) -> list[str]:
        """Remarks on the headers' times; where all are equal, images get the times of the recording."""
        times = [time_us for _, time_us in self.images]
        if len(times) > 2 and len(set(times)) == 1:
            images = ((name, self.received_ns[name] // 1000 + self.time_offset_us) for name, _ in self.images)
            self.images = sorted(images, key=lambda image: image[1])
            return ["all headers say one time: images have the times at which they were recorded"]
        steps_us = np.diff(times, prepend=times[0])
        row = int(np.argmin(steps_us))
        if steps_us[row] > -MOST_LATE_US:
            return []
        step_text = f"{self.images[row][0]} says {-steps_us[row] / 1e6:.1f} s before the image recorded before it"
        return [f"{step_text}: images are taken in the order of their headers' times. Was a clock set on the way?"]

    def take(self, reader: "AnyReader", topic: str, kind: str, received_ns: int, raw: bytes, name: str) -> None:
        """Add one message."""
        try:
            message: Any = _message(reader, raw, kind, name)
        except BrokenFrameError:
            if topic == self.image_topic:
                self.lost_images.setdefault("unreadable message", []).append(name)
            else:
                self.n_lost_positions += 1
            return
        header = message.header.stamp
        time_us = (header.sec * 10**9 + header.nanosec) // 1000 or received_ns // 1000
        if topic == self.position_topic:
            self.rows.append((time_us, *_place(message, kind)))
        elif name in self.received_ns:
            self.lost_images.setdefault("received at the time of another", []).append(name)
        else:
            self.received_ns[name] = received_ns
            is_raw = kind != _COMPRESSED
            shape = f"{message.width} x {message.height}" if is_raw else shape_in(BytesIO(bytes(message.data)))
            self.shapes.append((name, shape))
            self.images.append((name, time_us + self.time_offset_us))


def _bag_reader(path: Path) -> "AnyReader":
    """A reader that has yet to be entered; raises MissingExtraError, SourceError, the latter on entering too."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("bags and MCAP files need rosbags: pip install 'deep-simbad[rosbag]'") from error

    class Reader(AnyReader):
        def open(self) -> None:
            try:
                super().open()
            except (AnyReaderError, OSError, ValueError, KeyError) as error:
                raise SourceError(f"{path} cannot be read: {_first_line(error)}; {_MENDED_BY}") from error

    try:
        return Reader([path], default_typestore=get_typestore(Stores.LATEST))
    except (AnyReaderError, OSError) as error:
        raise SourceError(f"{path} cannot be read as a bag: {_first_line(error)}") from error


def _messages(reader: "AnyReader", topics: set[str], **between_ns: int) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield (topic, type, nanoseconds of receipt, body) of every message; raises SourceError (the bag is damaged)."""
    connections = [connection for connection in reader.connections if connection.topic in topics]
    try:
        for connection, received_ns, raw in reader.messages(connections, **between_ns):
            yield connection.topic, connection.msgtype, received_ns, raw
    except Exception as error:  # rosbags lets struct's, sqlite's and its own through
        reason = _first_line(error)
        raise SourceError(
            f"{reader.paths[0]} is damaged: its messages cannot be read: {reason}; {_MENDED_BY}"
        ) from error


def _message(reader: "AnyReader", raw: bytes, kind: str, name: str) -> object:
    try:
        return reader.deserialize(raw, kind)
    except Exception as error:  # rosbags lets struct's, numpy's and its own through
        raise BrokenFrameError(f"{name} cannot be read: {_first_line(error)}", "undecodable") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _choose_topic(topic: str, topics: list[str], contents: str, path: Path, *, take_first: bool = False) -> str:
    if topic in topics:
        return topic
    if not topic and topics and (take_first or len(topics) == 1):
        return topics[0]
    if not topics:
        raise SourceError(f"{path} holds no {contents}: none of its topics has a type that is read")
    trouble = f"no {contents} in {topic}" if topic else f"{contents} in several topics"
    raise SourceError(f"{path}: {trouble}: name one of {', '.join(sorted(topics))} as {BAG_PREFIX}{path}#TOPIC")


def _place(message: Any, kind: str) -> tuple[float, float, float]:
    """Two coordinates, a fix's in degrees, and the heading; NaN where unknown."""
    if kind == _FIX:
        is_fixed = message.status.status >= 0
        return (message.latitude if is_fixed else math.nan, message.longitude if is_fixed else math.nan, math.nan)
    pose = message.pose if kind == _POSES[0] else message.pose.pose
    q = pose.orientation
    heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return pose.position.x, pose.position.y, heading


def _place_images(images: list[tuple[str, int]], rows: _Rows, kind: str, source: str) -> Placement:
    time_us = np.array([row[0] for row in rows], np.int64)
    x_m, y_m, heading_rad = np.array(rows, np.float64).reshape(-1, 4)[:, 1:].T
    if kind == _FIX:
        track = track_of(time_us, *utm(x_m, y_m), deadband_m=GPS_DEADBAND_M)
    else:
        track = track_of(time_us, x_m, y_m, heading_rad)
    if track is None:
        raise SourceError(f"{source}: fewer than two positions can be used")
    placement = place_on_track(track, images, source)
    if kind == _ODOMETRY:
        # x, y and heading are of this drive's own beginning and no other's
        placement.frames = [
            dataclasses.replace(frame, x_m=None, y_m=None, heading_rad=None) for frame in placement.frames
        ]
    return placement


def _pixels(message: Any, name: str) -> NDArray[Any]:
    """The BGR pixels of a raw image in its own depth, uint8 or uint16; raises BrokenFrameError."""
    layout = _LAYOUTS.get(message.encoding)
    if layout is None:
        raise BrokenFrameError(f"{name}: nobody reads the encoding {message.encoding!r}", "unknown encoding")
    sample, channels, to_bgr = layout
    dtype = np.dtype(sample).newbyteorder(">" if message.is_bigendian else "<")
    try:
        lines = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
        width = message.width * channels * dtype.itemsize
        pixels = np.ascontiguousarray(lines[:, :width]).view(dtype).reshape(message.height, message.width, channels)
    except ValueError as error:
        raise BrokenFrameError(f"{name}: {error}", "undecodable") from error
    pixels = pixels.astype(sample)
    if to_bgr is None:
        to_bgr = cv2.COLOR_GRAY2BGR if channels == 1 else None
    return pixels if to_bgr is None else np.asarray(cv2.cvtColor(pixels, to_bgr))
