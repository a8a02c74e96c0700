"""Which topics of a bag hold the images of its cameras, what is known of these cameras, and which two are a pair."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.fields import camera_of_fields
from sfmapp.camera_files.reading import Calibration, calibration_of
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.bags import Bag
from sfmapp.formats.ros_messages import (
    CameraInfo,
    Message,
    MessageError,
    read_camera_info,
    read_compressed_image,
    read_raw_image,
    read_stamp,
)
from sfmapp.formats.text_input import nearest_rotation
from sfmapp.geometry import rigid3
from sfmapp.images.bag_sequence import COMPRESSED, RAW, size_of_message
from sfmapp.images.frame_reader import some
from sfmapp.images.headers import UnusableImage
from sfmapp.images.sequence import STAGE
from sfmapp.sequences.files import Size

Array = NDArray[np.float64]

CAMERA_INFO = "sensor_msgs/CameraInfo"
# Looked at to learn the size of the images of a topic: the first may be damaged.
_MESSAGES_SAMPLED = 9
# Depths in millimetres or metres, unless somebody says that they are pictures.
_ENCODINGS_OF_DEPTH = ("16uc1", "32fc1", "64fc1")
# image_rect, image_rect_color and rectified/image; not what is direct
_RECTIFIED = re.compile(r"(^|[/_])rect")
# P of two rectified cameras is the same but for its last column; text files of calibrations round it.
_SAME_PROJECTION = 1e-6


@dataclass(frozen=True)
class ImageTopic:
    """A topic with images.

    Attributes:
        name, is_compressed, size: what it holds.
        frame_id: of the camera, in the tree of transforms.
        is_depth: what it shows are depths.
        info, info_topic: of the camera that took them; None and empty where there is none that is calibrated.
    """

    name: str
    is_compressed: bool
    size: Size
    frame_id: str
    is_depth: bool
    info: CameraInfo | None
    info_topic: str

    @property
    def is_rectified(self) -> bool:
        """Whether images are what P says, without distortion: by its name, as ROS has no other sign."""
        return _RECTIFIED.search(self.name.lower()) is not None


def image_topics(bag: Bag) -> list[ImageTopic]:
    """The topics with images of a bag, by name.

    Raises:
        InputError: there are none, or no image of them can be read.
    """
    names = [name for name, topic in sorted(bag.topics.items()) if topic.type in (RAW, COMPRESSED)]
    if not names:
        found = some([f"{topic.name} ({topic.type or 'no type'})" for topic in bag.topics.values()]) or "no messages"
        raise InputError(
            f"{bag.path}: expected a topic of sensor_msgs/Image or CompressedImage, found {found}", _whole(bag)
        )
    foreign = [name for name in names if bag.topics[name].encoding not in ("ros1", "cdr")]
    if foreign:
        encoding = bag.topics[foreign[0]].encoding
        raise InputError(f"{bag.path}: {foreign[0]}: expected messages of ROS (ros1 or cdr), found {encoding!r}")
    infos = _camera_infos(bag)
    topics, problems = list[ImageTopic](), list[str]()
    for name in names:
        try:
            topics.append(_image_topic(bag, name, infos))
        except UnusableImage as reason:
            problems.append(f"{name}: {reason}")
    if not topics:
        raise InputError(f"{bag.path}: expected at least one image that can be read, found none: {problems[0]}")
    return topics


def _whole(bag: Bag) -> str | None:
    return f"{bag.damage}: copy it again" if bag.damage else None


def _image_topic(bag: Bag, name: str, infos: dict[str, CameraInfo]) -> ImageTopic:
    """Raises UnusableImage: of the first messages of the topic none can be read."""
    is_compressed = bag.topics[name].type == COMPRESSED
    reason = UnusableImage("no message can be read")
    for message in islice(bag.messages([name]), _MESSAGES_SAMPLED):
        try:
            size, frame_id = size_of_message(message, is_compressed), read_stamp(message).frame_id.lstrip("/")
            encoding = _encoding(message, is_compressed)
        except (UnusableImage, MessageError) as error:
            reason = error if isinstance(error, UnusableImage) else UnusableImage(str(error))
            continue
        info_topic = _info_topic(name, frame_id, infos)
        return ImageTopic(
            name, is_compressed, size, frame_id, encoding in _ENCODINGS_OF_DEPTH or "depth" in name.lower(),
            infos.get(info_topic), info_topic,
        )  # fmt: skip
    raise reason


def _encoding(message: Message, is_compressed: bool) -> str:
    """Small letters; of compressed images the first word of what their sender says."""
    text = read_compressed_image(message).format if is_compressed else read_raw_image(message).encoding
    return text.lower().partition(";")[0].strip()


def _camera_infos(bag: Bag) -> dict[str, CameraInfo]:
    """By topic, of those that hold a calibration: drivers without one send zeros."""
    found = {}
    for name, topic in sorted(bag.topics.items()):
        message = next(bag.messages([name]), None) if topic.type == CAMERA_INFO else None
        try:
            info = None if message is None else read_camera_info(message)
        except MessageError as error:
            raise InputError(f"{bag.path}: {name}: {error}") from error
        if info is not None and info.k[0, 0] > 0 and info.width > 0 and info.height > 0:
            found[name] = info
    return found


def _info_topic(name: str, frame_id: str, infos: dict[str, CameraInfo]) -> str:
    """``camera_info`` beside the images, or above the name of their compression; else the one of the same frame."""
    parts = name.split("/")
    for end in (len(parts) - 1, len(parts) - 2):
        beside = "/".join([*parts[:end], "camera_info"])
        if end > 0 and beside in infos:
            return beside
    same = [topic for topic, info in infos.items() if frame_id and info.stamp.frame_id.lstrip("/") == frame_id]
    return same[0] if len(same) == 1 else ""


# ------------------------------------------------------------------------------------------------------ the choice


def choose_cameras(bag: Bag, topics: list[ImageTopic], named: str | None, events: Events) -> list[ImageTopic]:
    """The topics to play: those that were named, else the one pair that is calibrated, else the one camera.

    Args:
        named: ``/left/image_raw`` or ``/left/image_raw,/right/image_raw``; None: find out.

    Raises:
        InputError: none is called so, or several could be meant.
    """
    listed = some([_described(topic) for topic in topics])
    if named is not None:
        by_name = {topic.name: topic for topic in topics}
        wanted = [name.strip() for name in named.split(",")]
        unknown = [name for name in wanted if name not in by_name]
        if unknown or not 1 <= len(set(wanted)) == len(wanted) <= 2:
            raise InputError(f"{bag.path}: expected one topic with images, or two of a pair, found {named!r}", listed)
        return [by_name[name] for name in wanted]
    cameras = _one_of_each([topic for topic in topics if not topic.is_depth] or topics)
    pairs = [pair for pair in map(_ordered, combinations(cameras, 2)) if pair is not None]
    chosen = list(pairs[0]) if len(pairs) == 1 else cameras
    if len(pairs) != 1 and len(cameras) > 1:
        what = f"{len(pairs)} stereo pairs" if pairs else f"{len(cameras)} cameras that no camera_info makes a pair"
        raise InputError(
            f"{bag.path}: expected one camera or one stereo pair, found {what}: {listed}",
            f"name one, --image-topic {cameras[0].name}, or a pair, --image-topic {cameras[0].name},{cameras[1].name}",
        )
    left_out = [topic.name for topic in topics if topic not in chosen]
    text = f"images of {' and '.join(topic.name for topic in chosen)}"
    events.decided(STAGE, text + (f"; not {some(left_out)}" if left_out else ""), left_out=left_out)
    return chosen


def _described(topic: ImageTopic) -> str:
    return f"{topic.name} ({topic.size[0]}x{topic.size[1]}{', depths' if topic.is_depth else ''})"


def _one_of_each(topics: list[ImageTopic]) -> list[ImageTopic]:
    """Of one camera the same pictures may be there raw, rectified and compressed: the rawest are taken."""
    cameras: dict[str, ImageTopic] = {}
    for topic in sorted(topics, key=lambda topic: (topic.is_compressed, topic.is_rectified, len(topic.name))):
        raw = topic.name.removesuffix("/compressed") if topic.is_compressed else topic.name
        cameras.setdefault(topic.info_topic or raw, topic)
    return sorted(cameras.values(), key=lambda topic: topic.name)


def _ordered(pair: tuple[ImageTopic, ImageTopic]) -> tuple[ImageTopic, ImageTopic] | None:
    """Left and right, by the baseline in P; None where that makes no pair of them."""
    for left, right in (pair, pair[::-1]):
        shift = _baseline(left, right)
        if shift is not None and shift[0] < 0:
            return left, right
    return None


def _baseline(left: ImageTopic, right: ImageTopic) -> Array | None:
    """(3,) what takes rectified points of the left camera to the right one; None where P does not say."""
    if left.info is None or right.info is None or left.size != right.size:
        return None
    ours, theirs = left.info.p, right.info.p
    scale = abs(ours[0, 0])
    is_same = scale > 0 and np.allclose(ours[:, :3], theirs[:, :3], rtol=0, atol=_SAME_PROJECTION * scale)
    if not is_same or ours[2, :3].tolist() != [0, 0, 1] or not np.isfinite([ours, theirs]).all():
        return None
    shift = np.asarray(np.linalg.solve(ours[:, :3], theirs[:, 3] - ours[:, 3]), np.float64)
    return shift if np.linalg.norm(shift) > 1e-6 else None


# ------------------------------------------------------------------------------------------------------ calibration


def calibration_of_topics(path: Path, chosen: list[ImageTopic], body_from_cam: Array | None) -> Calibration | None:
    """What camera_info says of one camera or two; None where the first has none.

    Args:
        body_from_cam: (7,) of the first camera; None if unknown.

    Raises:
        InputError: it does not fit the images, or is none.
    """
    known = chosen if all(topic.info is not None for topic in chosen) else chosen[:1]
    if known[0].info is None:
        return None
    cameras = []
    for topic in known:
        place = f"{path}: {topic.info_topic}"
        cameras.append(camera_of_fields(place, _fields(topic), topic.size))
    second, shift = None, _baseline(*known) if len(known) > 1 else None
    if shift is not None:
        # rectified points are R times those of the camera
        left, right = (_rectification(path, topic) for topic in known)
        second = rigid3.from_matrix(right.T @ left, right.T @ shift)
    return calibration_of(f"{path}: {known[0].info_topic}", cameras, [t.size for t in known], body_from_cam, second)


def _fields(topic: ImageTopic) -> dict[str, Any]:
    """As ``camera_info.yaml`` has them, of the pixels of the images: a region of the sensor begins at its corner."""
    info = topic.info
    assert info is not None
    matrix, d = (info.p[:, :3], np.zeros(0)) if topic.is_rectified and info.p[0, 0] > 0 else (info.k, info.d)
    x, y, width, height = info.region
    size = (width, height) if width > 0 and height > 0 else (info.width, info.height)
    shifted: Array = matrix - np.array([[0, 0, x], [0, 0, y], [0, 0, 0]]) if width > 0 and height > 0 else matrix
    binned = [max(1, by) for by in info.binning]
    if topic.size == (math.ceil(size[0] / binned[0]), math.ceil(size[1] / binned[1])) and max(binned) > 1:
        # pixel centres at whole numbers: the first of a bin of n lies (n - 1) / 2 before its middle
        scale = np.diag([1 / binned[0], 1 / binned[1], 1.0])
        shifted = scale @ (shifted - np.array([[0, 0, (binned[0] - 1) / 2], [0, 0, (binned[1] - 1) / 2], [0, 0, 0]]))
        size = topic.size
    return {
        "image_width": size[0], "image_height": size[1], "camera_matrix": shifted.ravel().tolist(),
        "distortion_coefficients": d.tolist(), "distortion_model": info.distortion_model if len(d) else "",
    }  # fmt: skip


def _rectification(path: Path, topic: ImageTopic) -> Array:
    assert topic.info is not None
    if topic.is_rectified or not topic.info.r.any():
        return np.eye(3)
    return nearest_rotation(f"{path}: {topic.info_topic}: R", topic.info.r)
