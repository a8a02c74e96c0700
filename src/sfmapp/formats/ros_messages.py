"""The messages of ROS that a sequence is made of, from their bytes: as ROS 1 writes them, and as ROS 2 does (CDR).

Their layouts are fixed (std_msgs, sensor_msgs, geometry_msgs, tf2_msgs): definitions that a bag brings along are not
looked at, and no code is made of them. Every length is held to the bytes that are there before anything is made of it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Representations of CDR that plain messages have: big and little endian.
_CDR_ORDERS = {b"\0\0": ">", b"\0\1": "<"}
_LARGEST_TEXT_BYTES = 4096
_MOST_COEFFICIENTS = 64


class MessageError(ValueError):
    """A message that is not what its type says, as a phrase that follows its name and a colon."""


class Message(NamedTuple):
    """A message as a bag holds it: its topic, the time of its recording in ns, its bytes, and whether they are CDR."""

    topic: str
    log_ns: int
    data: bytes
    is_cdr: bool


class Stamp(NamedTuple):
    """``std_msgs/Header``: nanoseconds of the sensor's clock, 0 where nobody set it, and the frame of reference."""

    ns: int
    frame_id: str


@dataclass(frozen=True)
class RawImage:
    """``sensor_msgs/Image``: ``data`` has ``height`` rows of ``step`` bytes."""

    stamp: Stamp
    height: int
    width: int
    encoding: str
    is_big_endian: bool
    step: int
    data: memoryview


@dataclass(frozen=True)
class CompressedImage:
    """``sensor_msgs/CompressedImage``: the bytes of an image file, and what the sender says of them."""

    stamp: Stamp
    format: str
    data: memoryview


@dataclass(frozen=True)
class CameraInfo:
    """``sensor_msgs/CameraInfo``: K (3, 3), D, R (3, 3), P (3, 4) as ROS defines them, pixel centres at whole numbers.

    Attributes:
        binning: of x and y; 0 and 1 are none.
        region: x, y, width and height in full pixels; width 0 for all.
    """

    stamp: Stamp
    height: int
    width: int
    distortion_model: str
    d: Array
    k: Array
    r: Array
    p: Array
    binning: tuple[int, int]
    region: tuple[int, int, int, int]


@dataclass(frozen=True)
class ImuSample:
    """``sensor_msgs/Imu``: (3,) rad/s and (3,) m/s^2; None what the sensor says that it does not measure."""

    stamp: Stamp
    gyro: Array | None
    accel: Array | None


@dataclass(frozen=True)
class Transform:
    """``geometry_msgs/TransformStamped``: (7,) pose that takes points of ``child`` to ``parent``, in metres."""

    parent: str
    child: str
    parent_from_child: Array


class _Cursor:
    """Reads a message from its beginning; CDR aligns every number to its own size."""

    def __init__(self, message: Message) -> None:
        self._data = memoryview(message.data)
        self._is_cdr = message.is_cdr
        self._order, self._position = "<", 0
        if message.is_cdr:
            order = _CDR_ORDERS.get(bytes(self._data[:2]))
            if order is None or len(self._data) < 4:
                raise MessageError("its data are damaged: they do not begin as CDR does")
            # alignment counts from behind the four bytes of the encapsulation
            self._order, self._data = order, self._data[4:]

    def numbers(self, code: str, count: int = 1) -> tuple[int, ...]:
        values: tuple[int, ...] = struct.unpack(f"{self._order}{count}{code}", self._take(code, count))
        return values

    def doubles(self, count: int) -> Array:
        return np.frombuffer(self._take("d", count), np.dtype(f"{self._order}f8")).astype(np.float64)

    def text(self) -> str:
        (length,) = self.numbers("I")
        if length > _LARGEST_TEXT_BYTES:
            raise MessageError(f"its data are damaged: a name of {length} bytes")
        return bytes(self._take("B", length)).decode("utf-8", "replace").rstrip("\0")

    def bytes(self) -> memoryview:
        (length,) = self.numbers("I")
        return self._take("B", length)

    def stamp(self) -> Stamp:
        if not self._is_cdr:
            self.numbers("I")  # seq, which ROS 2 has no more
        seconds, nanoseconds = self.numbers("I", 2)
        return Stamp(seconds * 10**9 + nanoseconds, self.text())

    def _take(self, code: str, count: int) -> memoryview:
        size = struct.calcsize("=" + code)
        start = self._position + (-self._position % size if self._is_cdr else 0)
        end = start + size * count
        if end > len(self._data):
            raise MessageError(f"its data are damaged: {end} bytes expected, {len(self._data)} found")
        self._position = end
        return self._data[start:end]


def read_stamp(message: Message) -> Stamp:
    """The header that images, camera_info and IMU begin with. Raises MessageError."""
    return _Cursor(message).stamp()


def read_raw_image(message: Message) -> RawImage:
    """A ``sensor_msgs/Image``. Raises MessageError."""
    cursor = _Cursor(message)
    stamp = cursor.stamp()
    height, width = cursor.numbers("I", 2)
    encoding = cursor.text()
    (is_big_endian,) = cursor.numbers("B")
    (step,) = cursor.numbers("I")
    return RawImage(stamp, height, width, encoding, bool(is_big_endian), step, cursor.bytes())


def read_compressed_image(message: Message) -> CompressedImage:
    """A ``sensor_msgs/CompressedImage``. Raises MessageError."""
    cursor = _Cursor(message)
    return CompressedImage(cursor.stamp(), cursor.text(), cursor.bytes())


def read_camera_info(message: Message) -> CameraInfo:
    """A ``sensor_msgs/CameraInfo``. Raises MessageError."""
    cursor = _Cursor(message)
    stamp = cursor.stamp()
    height, width = cursor.numbers("I", 2)
    model = cursor.text()
    (num_coefficients,) = cursor.numbers("I")
    if num_coefficients > _MOST_COEFFICIENTS:
        raise MessageError(f"its data are damaged: {num_coefficients} coefficients of distortion")
    d = cursor.doubles(num_coefficients) if num_coefficients else np.zeros(0)
    k, r, p = (cursor.doubles(count) for count in (9, 9, 12))
    binning_x, binning_y, x, y, region_height, region_width = cursor.numbers("I", 6)
    return CameraInfo(
        stamp, height, width, model, d, k.reshape(3, 3), r.reshape(3, 3), p.reshape(3, 4),
        (binning_x, binning_y), (x, y, region_width, region_height),
    )  # fmt: skip


def read_imu_sample(message: Message) -> ImuSample:
    """A ``sensor_msgs/Imu``. Raises MessageError."""
    cursor = _Cursor(message)
    stamp = cursor.stamp()
    cursor.doubles(4 + 9)  # an orientation that the sensor's own filter made
    gyro, gyro_covariance = cursor.doubles(3), cursor.doubles(9)
    accel, accel_covariance = cursor.doubles(3), cursor.doubles(9)
    # -1 in place of the first variance: not measured
    return ImuSample(
        stamp, None if gyro_covariance[0] == -1 else gyro, None if accel_covariance[0] == -1 else accel
    )  # fmt: skip


def read_transforms(message: Message) -> list[Transform]:
    """The transforms of a ``tf2_msgs/TFMessage``. Raises MessageError."""
    cursor = _Cursor(message)
    (count,) = cursor.numbers("I")
    found = []
    for _ in range(count):  # each takes bytes, so that an absurd count ends with them
        parent, child = cursor.stamp().frame_id, cursor.text()
        shift, turn = cursor.doubles(3), cursor.doubles(4)
        norm = float(np.linalg.norm(turn))
        if not (np.isfinite(shift).all() and abs(norm - 1) < 1e-3):
            raise MessageError(f"the transform of {child} is none")
        # ROS 1 wrote names with a slash before them for a time
        found.append(Transform(parent.lstrip("/"), child.lstrip("/"), np.concatenate([turn / norm, shift])))
    return found
