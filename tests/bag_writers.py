"""Bags of ROS 1, ROS 2 and MCAP, written by rosbags' and mcap's own writers: what our readers are held to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Array = NDArray[np.float64]

FORMATS = ("ros1", "ros1-lz4", "ros2-sqlite3", "ros2-mcap", "mcap", "mcap-plain", "mcap-ros1")


@dataclass(frozen=True)
class Sent:
    """A message to be written: when it was recorded, where, and what it says, by the names of ROS 2."""

    log_ns: int
    topic: str
    type: str
    fields: dict[str, Any]


@cache
def store(is_ros1: bool) -> Any:
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:  # tf2 is no part of the messages that rosbags knows of ROS 1
        name = "tf2_msgs/msg/TFMessage"
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", name))
    return types


def made(is_ros1: bool, kind: str, fields: dict[str, Any]) -> Any:
    """The object that rosbags has for a message; ROS 1 spells matrices of cameras in capitals and counts headers."""
    types = store(is_ros1).types
    spelled = {name.upper() if is_ros1 and len(name) == 1 and name in "dkrp" else name: v for name, v in fields.items()}
    if is_ros1 and kind == "std_msgs/msg/Header":
        spelled["seq"] = 7
    return types[kind](**spelled)


class Maker:
    """Fields of messages, nested ones as the objects of one generation of ROS."""

    def __init__(self, is_ros1: bool) -> None:
        self._is_ros1 = is_ros1

    def __call__(self, kind: str, **fields: Any) -> Any:
        return made(self._is_ros1, kind, fields)

    def header(self, ns: int, frame_id: str = "cam0") -> Any:
        stamp = self("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def bytes_of(self, sent: Sent) -> bytes:
        message = self(sent.type, **self._nested(sent.fields))
        types = store(self._is_ros1)
        return bytes(
            types.serialize_ros1(message, sent.type) if self._is_ros1 else types.serialize_cdr(message, sent.type)
        )

    def _nested(self, fields: dict[str, Any]) -> dict[str, Any]:
        return {name: value(self) if callable(value) else value for name, value in fields.items()}


# --------------------------------------------------------------------------------------------------------- messages


def image(
    pixels: NDArray[Any], encoding: str, stamp_ns: int, topic: str = "/cam0/image_raw", *, log_ns: int | None = None,
    frame_id: str = "cam0", is_big_endian: bool = False,
) -> Sent:  # fmt: skip
    """Pixels as they are; rows have four bytes more than they need."""
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
    rows = (rows.astype(rows.dtype.newbyteorder(">")) if is_big_endian else rows).view(np.uint8)
    padded = np.concatenate([rows, np.full((len(rows), 4), 99, np.uint8)], 1)
    return Sent(
        stamp_ns if log_ns is None else log_ns, topic, "sensor_msgs/msg/Image",
        {
            "header": lambda make: make.header(stamp_ns, frame_id), "height": pixels.shape[0],
            "width": pixels.shape[1], "encoding": encoding, "is_bigendian": int(is_big_endian),
            "step": padded.shape[1], "data": padded.ravel(),
        },
    )  # fmt: skip


def compressed(data: bytes, text: str, stamp_ns: int, topic: str = "/cam0/image_raw/compressed") -> Sent:
    fields = {"header": lambda make: make.header(stamp_ns), "format": text, "data": np.frombuffer(data, np.uint8)}
    return Sent(stamp_ns, topic, "sensor_msgs/msg/CompressedImage", fields)


def camera_info(
    size: tuple[int, int], k: Sequence[float], baseline_m: float = 0.0, topic: str = "/cam0/camera_info", *,
    d: Sequence[float] = (), rotation: Array | None = None, rectified: Sequence[float] | None = None,
    frame_id: str = "cam0", log_ns: int = 1,
) -> Sent:  # fmt: skip
    """``k`` is fx, fy, cx, cy of K, ``rectified`` those of P, pixel centres at whole numbers."""
    fx, fy, cx, cy = k
    gx, gy, ux, uy = rectified or k
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return Sent(
        log_ns, topic, "sensor_msgs/msg/CameraInfo",
        {
            "header": lambda make: make.header(log_ns, frame_id), "height": size[1], "width": size[0],
            "distortion_model": "plumb_bob", "d": np.array(d, float),
            "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], float),
            "r": (np.eye(3) if rotation is None else rotation).ravel(),
            "p": np.array([gx, 0, ux, -gx * baseline_m, 0, gy, uy, 0, 0, 0, 1, 0], float),
            "binning_x": 0, "binning_y": 0,
            "roi": lambda make: make("sensor_msgs/msg/RegionOfInterest", **region),
        },
    )  # fmt: skip


def imu(stamp_ns: int, gyro: Sequence[float], accel: Sequence[float], frame_id: str = "imu") -> Sent:
    def vector(values: Sequence[float]) -> Any:
        return lambda make: make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, values), strict=True)))

    covariance = np.zeros(9)
    return Sent(
        stamp_ns, "/imu/data", "sensor_msgs/msg/Imu",
        {
            "header": lambda make: make.header(stamp_ns, frame_id),
            "orientation": lambda make: make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            "orientation_covariance": covariance, "angular_velocity": vector(gyro),
            "angular_velocity_covariance": covariance, "linear_acceleration": vector(accel),
            "linear_acceleration_covariance": covariance,
        },
    )  # fmt: skip


def transform(parent: str, child: str, pose: Array, log_ns: int = 1) -> Sent:
    """``pose`` (7,) takes points of the child to the parent."""

    def stamped(make: Maker) -> Any:
        turn = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, pose[:4]), strict=True)))
        shift = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, pose[4:]), strict=True)))
        both = make("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
        header = make.header(log_ns, parent)
        return [make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=both)]

    return Sent(log_ns, "/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": stamped})


# -------------------------------------------------------------------------------------------------------------- bags


def write_bag(folder: Path, kind: str, messages: Sequence[Sent]) -> Path:
    """A bag of one of the FORMATS; the path to be given to sfmapp."""
    messages = sorted(messages, key=lambda sent: sent.log_ns)
    folder.mkdir(parents=True, exist_ok=True)
    if kind.startswith("ros1"):
        return _write_ros1(folder / "drive.bag", messages, is_compressed=kind.endswith("lz4"))
    if kind.startswith("ros2"):
        plugin = StoragePlugin.SQLITE3 if kind.endswith("sqlite3") else StoragePlugin.MCAP
        return _write_ros2(folder / "drive", messages, plugin)
    return _write_mcap(folder / "drive.mcap", messages, kind)


def _write_ros1(path: Path, messages: Sequence[Sent], is_compressed: bool) -> Path:
    make, connections = Maker(is_ros1=True), {}
    writer = Ros1Writer(path)
    if is_compressed:
        writer.set_compression(Ros1Writer.CompressionFormat.LZ4)
    with writer:
        for sent in messages:
            if sent.topic not in connections:
                connections[sent.topic] = writer.add_connection(sent.topic, sent.type, typestore=store(True))
            writer.write(connections[sent.topic], sent.log_ns, make.bytes_of(sent))
    return path


def _write_ros2(path: Path, messages: Sequence[Sent], plugin: StoragePlugin) -> Path:
    make, connections = Maker(is_ros1=False), {}
    with Ros2Writer(path, version=9, storage_plugin=plugin) as writer:
        for sent in messages:
            if sent.topic not in connections:
                connections[sent.topic] = writer.add_connection(sent.topic, sent.type, typestore=store(False))
            writer.write(connections[sent.topic], sent.log_ns, make.bytes_of(sent))
    return path


def _write_mcap(path: Path, messages: Sequence[Sent], kind: str) -> Path:
    """Compressed in chunks of 64 kB, or with neither chunks nor an index; messages of ROS 2, or of ROS 1."""
    is_plain, is_ros1 = kind.endswith("plain"), kind.endswith("ros1")
    make, channels = Maker(is_ros1), {}
    compression = CompressionType.NONE if is_plain else CompressionType.ZSTD
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=1 << 16, compression=compression, use_chunking=not is_plain)
        writer.start(profile="" if is_plain else "ros1" if is_ros1 else "ros2")
        for sent in messages:
            if sent.topic not in channels:
                name = sent.type.replace("/msg/", "/") if is_ros1 else sent.type
                schema = writer.register_schema(name, "ros1msg" if is_ros1 else "ros2msg", b"")
                channels[sent.topic] = writer.register_channel(sent.topic, "ros1" if is_ros1 else "cdr", schema)
            writer.add_message(channels[sent.topic], sent.log_ns, make.bytes_of(sent), sent.log_ns)
        writer.finish()
    return path
