"""Frames from a bag, decoded one at a time: raw images in the encodings of ROS, and compressed ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.bags import Bag
from sfmapp.formats.ros_messages import Message, MessageError, RawImage, read_compressed_image, read_raw_image
from sfmapp.images.frame_reader import (
    LARGEST_FRAME_PX,
    FileReader,
    FileSequence,
    Skipped,
    check_size,
    decode_file_of,
    read_ahead,
    scaled_to_8_bits,
)
from sfmapp.images.headers import UnusableImage, read_header
from sfmapp.images.sequence import Frame

Pixels = NDArray[np.uint8]

RAW, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
# of sensor_msgs/image_encodings.h: channels, bits of each, and OpenCV's conversion to grey; empty for grey itself.
# OpenCV names mosaics by the second and third pixel of the second row, ROS by the first two of both.
_ENCODINGS = {
    "mono8": (1, 8, ""), "8uc1": (1, 8, ""), "mono16": (1, 16, ""), "16uc1": (1, 16, ""),
    "rgb8": (3, 8, "RGB2GRAY"), "8uc3": (3, 8, "BGR2GRAY"), "bgr8": (3, 8, "BGR2GRAY"),
    "rgba8": (4, 8, "RGBA2GRAY"), "bgra8": (4, 8, "BGRA2GRAY"), "8uc4": (4, 8, "BGRA2GRAY"),
    "rgb16": (3, 16, "RGB2GRAY"), "bgr16": (3, 16, "BGR2GRAY"),
    "rgba16": (4, 16, "RGBA2GRAY"), "bgra16": (4, 16, "BGRA2GRAY"),
    "yuv422": (2, 8, "YUV2GRAY_UYVY"), "uyvy": (2, 8, "YUV2GRAY_UYVY"),
    "yuv422_yuy2": (2, 8, "YUV2GRAY_YUY2"), "yuyv": (2, 8, "YUV2GRAY_YUY2"),
} | {
    f"bayer_{pattern}{bits}": (1, bits, f"Bayer{code}2GRAY")
    for pattern, code in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB"))
    for bits in (8, 16)
}  # fmt: skip


@dataclass(frozen=True)
class BagFrames:
    """Where the frames of a sequence lie in a bag.

    Attributes:
        path: of the bag.
        topics: of each camera: its name and whether its images are compressed.
        positions: (N, number of cameras) which message of each topic, from 0; -1 where the second has none.
    """

    path: Path
    topics: tuple[tuple[str, bool], ...]
    positions: NDArray[np.int64]


@dataclass
class BagSequence(FileSequence):
    """A :class:`~sfmapp.images.sequence.Sequence` of the messages of a bag; ``paths`` hold the names of its frames.

    Attributes:
        bag: where the frames that are played lie, one row each.
    """

    bag: BagFrames = field(kw_only=True)

    def frames(self) -> Iterator[Frame]:
        """See :class:`~sfmapp.images.sequence.Sequence`."""
        return self._teller.frames_without_problems(self._items())

    def _items(self) -> Iterator[Frame | Skipped]:
        reader = _BagReader(self)
        try:
            ahead: Iterator[Frame | Skipped] = read_ahead(reader)
            yield from ahead
        finally:
            reader.close()


class _Walk:
    """One topic from its beginning; every camera has one, as the two of a pair need not be recorded in turn."""

    def __init__(self, path: Path, topic: str) -> None:
        self._bag = Bag(path)
        self._messages = self._bag.messages([topic])
        self._position = -1
        self.is_cdr = False  # as the last message was

    def message(self, position: int) -> Message:
        """The message at a position that is beyond the last one asked for. Raises UnusableImage."""
        message = None
        try:
            while self._position < position:
                message = next(self._messages, None)
                self._position += 1
        except InputError as error:
            raise UnusableImage(f"the bag cannot be read from here on: {error}") from error
        if message is None:
            raise UnusableImage("the bag ends before it")
        self.is_cdr = message.is_cdr
        return message

    def close(self) -> None:
        self._messages.close()  # type: ignore[attr-defined]  # a generator
        self._bag.close()


class _BagReader(FileReader):
    """One walk over the frames of a bag."""

    def __init__(self, sequence: BagSequence) -> None:
        super().__init__(sequence)
        self._bag, self._rig = sequence.bag, sequence.rig
        self._walks: list[_Walk] = []

    def name_of(self, idx: int, camera_idx: int) -> str:
        return self._bag.topics[camera_idx][0]

    def read_bytes(self, idx: int) -> Iterator[bytes]:
        if not self._walks:
            self._walks = [_Walk(self._bag.path, topic) for topic, _ in self._bag.topics[: len(self._rig.cameras)]]
        for walk, position in zip(self._walks, self._bag.positions[idx].tolist(), strict=False):
            if position >= 0:
                yield walk.message(position).data

    def decode(self, camera_idx: int, data: bytes, white: int) -> tuple[Pixels, int]:
        topic, is_compressed = self._bag.topics[camera_idx]
        message = Message(topic, 0, data, self._walks[camera_idx].is_cdr)
        camera = self._rig.cameras[camera_idx]
        try:
            if is_compressed:
                return decode_file_of(camera, bytes(read_compressed_image(message).data), white)
            image = read_raw_image(message)
        except MessageError as reason:
            raise UnusableImage(str(reason)) from reason
        check_size(image.width, image.height, camera)
        return decode_raw(image, white)

    def close(self) -> None:
        """Give the bag back."""
        for walk in self._walks:
            walk.close()


def decode_raw(image: RawImage, white: int) -> tuple[Pixels, int]:
    """(H, W) uint8 of a raw image, and the new ``white``, as :func:`~sfmapp.images.frame_reader.decode_gray` has them.

    Raises:
        UnusableImage: an encoding that is not read, an absurd size, or less data than that takes.
    """
    import cv2

    known = _ENCODINGS.get(image.encoding.lower())
    if known is None:
        raise UnusableImage(f"of the encoding {image.encoding!r}, which is not read")
    num_channels, bits, conversion = known
    row_bytes = image.width * num_channels * bits // 8
    _check_raw_size(image, row_bytes)
    # the last row may be as short as its pixels
    rows = np.lib.stride_tricks.as_strided(
        np.frombuffer(image.data, np.uint8), (image.height, row_bytes), (image.step, 1), writeable=False
    )
    pixels = np.ascontiguousarray(rows)
    if bits == 16:
        deep = pixels.view(">u2" if image.is_big_endian else "<u2").astype(np.uint16)
        pixels, white = scaled_to_8_bits(deep, white)
    if not conversion:
        return pixels, white
    if num_channels > 1:
        pixels = pixels.reshape(image.height, image.width, num_channels)
    try:
        gray: Pixels = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))
    except cv2.error:  # halved colours of an odd width
        raise UnusableImage(f"{image.width}x{image.height} pixels, which {image.encoding} cannot have") from None
    return gray, white


def _check_raw_size(image: RawImage, row_bytes: int) -> None:
    """Raise UnusableImage where the size that a message claims is absurd, or needs more data than it has."""
    if not 0 < image.width * image.height <= LARGEST_FRAME_PX:
        raise UnusableImage(f"broken header: it claims {image.width}x{image.height} pixels")
    if image.step < row_bytes or len(image.data) < image.step * (image.height - 1) + row_bytes:
        raise UnusableImage(
            f"broken: {image.width}x{image.height} pixels of {image.encoding} in rows of {image.step} bytes, found "
            f"{len(image.data)} bytes"
        )


def size_of_message(message: Message, is_compressed: bool) -> tuple[int, int]:
    """(width, height) that an image message claims. Raises UnusableImage: it cannot be read, or the size is absurd."""
    try:
        if is_compressed:
            header = read_header(bytes(read_compressed_image(message).data))
            size = header.width, header.height
        else:
            image = read_raw_image(message)
            size = image.width, image.height
    except MessageError as reason:
        raise UnusableImage(str(reason)) from reason
    if not 0 < size[0] * size[1] <= LARGEST_FRAME_PX:
        raise UnusableImage(f"broken header: it claims {size[0]}x{size[1]} pixels")
    return size
