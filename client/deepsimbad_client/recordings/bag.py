"""ROS bags and MCAP files: images of one topic, placed by poses, fixes or odometry of another (library `rosbags`).

    rosbag:FILE.bag, rosbag:FOLDER, FILE.mcap, FILE.db3     and behind each #IMAGE_TOPIC or #IMAGE_TOPIC,POSITION_TOPIC

Images are `sensor_msgs/Image` or `CompressedImage`. Positions are the first there is of `geometry_msgs/PoseStamped` and
`PoseWithCovarianceStamped`, `sensor_msgs/NavSatFix`, and `nav_msgs/Odometry`, whose x, y begin anew with every drive
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
from deepsimbad_client.recordings.placing import Placed, placed_on
from deepsimbad_client.recordings.track import DEADBAND_M, Track, track_of

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

BAG_PREFIX = "rosbag:"
BAG_SUFFIXES = frozenset({".bag", ".mcap", ".db3"})
MOST_LATE_US = 1_000_000  # an image may be recorded before another one of a time so much earlier
_MENDED_BY = "`rosbag reindex`, `ros2 bag reindex` or `mcap recover` mends what was cut off"
METADATA = "metadata.yaml"  # in the folder that is a ROS 2 bag

_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_IMAGES = ("sensor_msgs/msg/Image", _COMPRESSED)
_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_FIX, _ODOMETRY = "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry"
_POSITIONS = (*_POSES, _FIX, _ODOMETRY)  # by which drives can be compared best first
_LAYOUTS: dict[str, tuple[type, int, int | None]] = {  # sample type, channels, how to BGR
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
    """Images of one topic."""

    path: Path
    topic: str
    received_ns: Mapping[str, int]  # by frame name: when the recorder wrote it down, by which it is read again
    rotate: int = 0  # degrees clockwise by which images are turned
    turn: threading.Lock = field(default_factory=threading.Lock, repr=False)  # the reader serves one thread

    def stamp(self, frame: Frame) -> str:
        """Of its file and time; see `Recording.stamp`."""
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
        """A frame's pixels, of 9 to 16 bits all."""
        kind, message = self._read(self.frames[row])
        name = self.frames[row].name
        return decode_deep(bytes(message.data), Path(name)) if kind == _COMPRESSED else _pixels(message, name)

    def _read(self, frame: Frame) -> tuple[str, Any]:
        """A frame's message and its type. Raises BrokenFrameError."""
        at = self.received_ns[frame.name]
        with self.turn:
            try:
                found = next(_messages(self._reader, {self.topic}, start=at, stop=at + 1), None)
            except SourceError as error:
                raise BrokenFrameError(f"{frame.name}: {error}", "undecodable") from error
            if found is None:
                raise BrokenFrameError(f"{frame.name} is not in {self.path} any more", "unreadable file")
            _, kind, _, raw = found
            return kind, _message(self._reader, raw, kind, frame.name)

    @cached_property
    def _reader(self) -> "AnyReader":
        """Opened when the first image is asked for, closed with the recording."""
        reader = _opened(self.path)
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
    """Open a bag; `topics` is IMAGE, or IMAGE,POSITION, or "": what there is.

    All messages of both topics are gone through once, for the times in their headers. Raises SourceError (the library
    cannot read it, or which topic is meant cannot be told), MissingExtraError.
    """
    image_topic, _, position_topic = topics.partition(",")
    remarks: list[str] = []
    with _opened(path) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections if connection.msgcount}
        image_topic = _chosen(image_topic, [name for name, kind in types.items() if kind in _IMAGES], "images", path)
        placing = sorted(
            (name for name in types if types[name] in _POSITIONS), key=lambda name: _POSITIONS.index(types[name])
        )
        if position_topic or placing:
            position_topic = _chosen(position_topic, placing, "positions", path, take_first=True)
            others = f" (there are {', '.join(placing)})" if len(placing) > 1 else ""
            remarks.append(f"images of {image_topic}, positions of {position_topic}{others}")
        else:
            remarks.append(f"images of {image_topic}, {spacing_m:g} m apart: there are no poses, fixes or odometry")
        heard = _Heard(image_topic, position_topic, time_offset_us)
        span = max(1, reader.end_time - reader.start_time)
        for topic, kind, received, raw in _messages(reader, {image_topic, position_topic}):
            on_progress((received - reader.start_time) / span)
            heard.take(reader, topic, kind, received, raw, f"{path.name}{topic}/{received}")
    if not heard.images:
        raise SourceError(f"{path}: {image_topic} holds no image that can be read")
    remarks += heard.of_one_clock()
    images = sorted(heard.images, key=lambda image: image[1])
    if position_topic:
        result = _placed(images, heard.rows, types[position_topic], f"{path}, {position_topic}")
    else:
        result = Placed([Frame(i, name, i * spacing_m, time_us) for i, (name, time_us) in enumerate(images)])
    result.left_out_names |= heard.lost
    if heard.n_lost_positions:
        remarks.append(f"{heard.n_lost_positions} messages of {position_topic} cannot be read and are not used")
    recording = BagRecording(
        path.stem,
        tuple(result.frames),
        result.left_out_names,
        remarks=[*remarks, *result.remarks, *shape_remarks(heard.shapes)],
        path=path,
        topic=image_topic,
        received_ns=heard.received_ns,
        rotate=rotate,
    )
    return with_grey_levels(recording, recording.deep)


@dataclass
class _Heard:
    """What the messages of both topics say."""

    image_topic: str
    position_topic: str
    time_offset_us: int
    received_ns: dict[str, int] = field(default_factory=dict)
    images: list[tuple[str, int]] = field(default_factory=list)
    rows: _Rows = field(default_factory=list)
    lost: dict[str, list[str]] = field(default_factory=dict)  # images, by reason
    shapes: list[tuple[str, str | None]] = field(default_factory=list)  # of each image
    n_lost_positions: int = 0

    def of_one_clock(self) -> list[str]:
        """What is to be said of the headers' times; where all are one, images get those of the recording."""
        times = [time_us for _, time_us in self.images]
        if len(times) > 2 and len(set(times)) == 1:
            received = ((name, self.received_ns[name] // 1000 + self.time_offset_us) for name, _ in self.images)
            self.images = sorted(received, key=lambda image: image[1])
            return ["all headers say one time: images have the times at which they were recorded"]
        steps_us = np.diff(times, prepend=times[0])
        at = int(np.argmin(steps_us))
        if steps_us[at] > -MOST_LATE_US:
            return []
        back = f"{self.images[at][0]} says {-steps_us[at] / 1e6:.1f} s before the image recorded before it"
        return [f"{back}: images are taken in the order of their headers' times. Was a clock set on the way?"]

    def take(self, reader: "AnyReader", topic: str, kind: str, received: int, raw: bytes, name: str) -> None:
        """One more message."""
        try:
            message: Any = _message(reader, raw, kind, name)
        except BrokenFrameError:
            if topic == self.image_topic:
                self.lost.setdefault("unreadable message", []).append(name)
            else:
                self.n_lost_positions += 1
            return
        header = message.header.stamp
        time_us = (header.sec * 10**9 + header.nanosec) // 1000 or received // 1000
        if topic == self.position_topic:
            self.rows.append((time_us, *_place(message, kind)))
        elif name in self.received_ns:
            self.lost.setdefault("received at the time of another", []).append(name)
        else:
            self.received_ns[name] = received
            is_raw = kind != _COMPRESSED
            shape = f"{message.width} x {message.height}" if is_raw else shape_in(BytesIO(bytes(message.data)))
            self.shapes.append((name, shape))
            self.images.append((name, time_us + self.time_offset_us))


def _opened(path: Path) -> "AnyReader":
    """A reader to be entered. Raises MissingExtraError, SourceError."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("bags and MCAP files need rosbags: pip install 'deep-simbad[rosbag]'") from error

    class Reader(AnyReader):  # whose faults are named as ours
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
    """Topic, type, when it was received and body of every message. Raises SourceError (the bag is damaged)."""
    connections = [connection for connection in reader.connections if connection.topic in topics]
    try:
        for connection, received, raw in reader.messages(connections, **between_ns):
            yield connection.topic, connection.msgtype, received, raw
    except Exception as error:  # rosbags lets struct's, sqlite's and its own through
        why = _first_line(error)
        raise SourceError(f"{reader.paths[0]} is damaged: its messages cannot be read: {why}; {_MENDED_BY}") from error


def _message(reader: "AnyReader", raw: bytes, kind: str, name: str) -> object:
    try:
        return reader.deserialize(raw, kind)
    except Exception as error:  # rosbags lets struct's, numpy's and its own through
        raise BrokenFrameError(f"{name} cannot be read: {_first_line(error)}", "undecodable") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _chosen(asked: str, there: list[str], what: str, path: Path, *, take_first: bool = False) -> str:
    if asked in there:
        return asked
    if not asked and there and (take_first or len(there) == 1):
        return there[0]
    if not there:
        raise SourceError(f"{path} holds no {what}: none of its topics has a type that is read")
    trouble = f"no {what} in {asked}" if asked else f"{what} in several topics"
    raise SourceError(f"{path}: {trouble}: name one of {', '.join(sorted(there))} as {BAG_PREFIX}{path}#TOPIC")


def _place(message: Any, kind: str) -> tuple[float, float, float]:
    """Two coordinates, of a fix in degrees, and the heading; NaN: not known."""
    if kind == _FIX:
        fixed = message.status.status >= 0
        return (message.latitude if fixed else math.nan, message.longitude if fixed else math.nan, math.nan)
    pose = message.pose if kind == _POSES[0] else message.pose.pose
    q = pose.orientation
    heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return pose.position.x, pose.position.y, heading


def _track(rows: _Rows, kind: str) -> Track | None:
    columns = np.array(rows, np.float64).reshape(-1, 4)
    time_us = np.array([row[0] for row in rows], np.int64)
    x_m, y_m, heading_rad = columns[:, 1], columns[:, 2], columns[:, 3]
    if kind == _FIX:
        return track_of(time_us, *utm(x_m, y_m), deadband_m=GPS_DEADBAND_M)
    return track_of(time_us, x_m, y_m, heading_rad, deadband_m=DEADBAND_M)


def _placed(images: list[tuple[str, int]], rows: _Rows, kind: str, where: str) -> Placed:
    track = _track(rows, kind)
    if track is None:
        raise SourceError(f"{where}: fewer than two positions can be used")
    result = placed_on(track, images, where)
    if kind == _ODOMETRY:
        # x, y and heading are of this drive's own beginning and no other's
        result.frames = [dataclasses.replace(frame, x_m=None, y_m=None, heading_rad=None) for frame in result.frames]
    return result


def _pixels(message: Any, name: str) -> NDArray[Any]:
    """A raw image as BGR, of its own depth: uint8 or uint16."""
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
