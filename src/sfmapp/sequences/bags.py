"""A bag of ROS 1 or 2, or an MCAP file, as a sequence: its topics by type, its times, its IMU.

It is walked through once to learn the times of its messages; images are decoded when they are played.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.bags import Bag
from sfmapp.formats.clocks import Times
from sfmapp.formats.ros_messages import ImuSample, Message, MessageError, read_imu_sample, read_stamp, read_transforms
from sfmapp.geometry import rigid3
from sfmapp.images.bag_sequence import BagFrames
from sfmapp.images.frame_reader import some
from sfmapp.images.sequence import STAGE, Imu, SequenceOptions
from sfmapp.sequences.bag_topics import ImageTopic, calibration_of_topics, choose_cameras, image_topics
from sfmapp.sequences.euroc import USUAL_NOISE
from sfmapp.sequences.files import Recording, ascending, warn_of_missing

Array = NDArray[np.float64]

_IMU = "sensor_msgs/Imu"
_STATIC_TRANSFORMS = "/tf_static"
# Two shutters that are released together stamp their images within this; at 1 m/s it is 2 mm of the baseline.
_SAME_MOMENT_NS = 2_000_000
# Times of recording, which differ by how long messages took, are of one moment within this share of an interval.
_SAME_MOMENT_SHARE = 0.25
_GRAVITY_M_S2 = 9.81
# What moves without falling feels gravity in the mean: another unit (g), or gravity taken out, is further off.
_WORST_GRAVITY = 1.6
# Messages between two words on progress: an IMU sends hundreds a second.
_PROGRESS_STEP = 64


def read_bag_sequence(path: Path, options: SequenceOptions, events: Events) -> Recording:
    """The images of a bag that can be played, with what it says of cameras and IMU.

    Raises:
        InputError: it cannot be read, holds no images, or several cameras of which none is named.
        MissingPackageError: the package that reads it is not installed.
    """
    with Bag(path) as bag:
        if bag.damage:
            events.warned(STAGE, f"{bag.path}: {bag.damage}: what comes before is played")
        chosen = choose_cameras(bag, image_topics(bag), options.image_topic, events)
        chosen = chosen[:1] if options.mono else chosen
        imu_topic = _imu_topic(bag, options, events)
        stamps = _read_stamps(bag, [topic.name for topic in chosen], imu_topic, events)
        tree = _Tree.of(bag)
    kept = _paired(stamps, chosen, events)
    chosen = chosen[: kept.shape[1]]
    times = _times([stamps.frames[0][i] for i in kept[:, 0].tolist()])
    imu, imu_from_cam = None, None
    if imu_topic is not None:
        imu_from_cam = tree.pose(stamps.imu_frame_id, chosen[0].frame_id)
        imu = _imu(bag.path, imu_topic, stamps, imu_from_cam, times, events)
    # a camera that the user gives needs nothing of what camera_info says
    calibration = calibration_of_topics(bag.path, chosen, imu_from_cam) if options.camera is None else None
    names = [f"{position:06d}" for position in kept[:, 0].tolist()]
    # frames need not be files: what they are called is all that the paths say
    paths = [(bag.path.parent / name,) * int((row >= 0).sum()) for name, row in zip(names, kept, strict=True)]
    frames = BagFrames(bag.path, tuple((topic.name, topic.is_compressed) for topic in chosen), kept)
    return Recording(
        "bag", bag.path.parent, names, times, paths, tuple(topic.size for topic in chosen), calibration, imu, bag=frames
    )  # fmt: skip


def _imu_topic(bag: Bag, options: SequenceOptions, events: Events) -> str | None:
    """The one that is named, or the only one; none where a file takes its place or lengths are not asked of it."""
    names = sorted(name for name, topic in bag.topics.items() if topic.type == _IMU)
    if options.imu_topic is not None:
        if options.imu_topic not in names:
            found = some(names) or "none"
            raise InputError(f"{bag.path}: expected a topic of {_IMU} called {options.imu_topic}, found {found}")
        return options.imu_topic
    if options.imu is not None or not names:
        return None
    if len(names) > 1:
        events.warned(STAGE, f"no IMU is used: several are there, {some(names)}; name one with --imu-topic")
        return None
    return names[0]


# ------------------------------------------------------------------------------------------------------------ times


@dataclass
class _Stamps:
    """Nanoseconds of the messages of each camera, and the samples of an IMU with theirs."""

    frames: list[list[int]]
    imu_ns: list[int] = field(default_factory=list)
    imu: list[ImuSample] = field(default_factory=list)
    imu_frame_id: str = ""
    is_of_log: bool = False


def _read_stamps(bag: Bag, cameras: list[str], imu_topic: str | None, events: Events) -> _Stamps:
    """Times of all messages, by the clock of the sensors, or of the recording where that stood at zero."""
    of_header: list[list[int]] = [[] for _ in cameras]
    of_log: list[list[int]] = [[] for _ in cameras]
    imu, imu_log_ns, num_broken = list[ImuSample](), list[int](), 0
    topics = cameras if imu_topic is None else [*cameras, imu_topic]
    total = sum(bag.topics[name].num_messages for name in topics)
    events.started(STAGE, f"reading the times of {bag.path.name}", total)
    for count, message in enumerate(_until_damaged(bag, topics, events), 1):
        if count % _PROGRESS_STEP == 0:
            events.advanced(STAGE, _PROGRESS_STEP)
        if message.topic != imu_topic:
            camera = cameras.index(message.topic)
            of_header[camera].append(_stamp_ns(message))
            of_log[camera].append(message.log_ns)
            continue
        try:
            imu.append(read_imu_sample(message))
            imu_log_ns.append(message.log_ns)
        except MessageError:
            num_broken += 1
    events.finished(STAGE, f"{sum(map(len, of_log)) + len(imu)} messages")
    if num_broken:
        events.warned(STAGE, f"{num_broken} messages of {imu_topic} are damaged and left out")
    if not of_header[0]:
        raise InputError(f"{bag.path}: expected images of {cameras[0]}, found none that can be read")
    imu_ns = [sample.stamp.ns for sample in imu]
    unset = [name for name, ns in zip(topics, [*of_header, imu_ns], strict=False) if ns and not any(ns)]
    if unset:
        text = f"the headers of {' and '.join(unset)} hold no times: those of the recording are used"
        events.decided(STAGE, text, topics=unset)
    return _Stamps(
        of_log if unset else of_header, imu_log_ns if unset else imu_ns, imu,
        imu[0].stamp.frame_id.lstrip("/") if imu else "", bool(unset),
    )  # fmt: skip


def _stamp_ns(message: Message) -> int:
    """0 of a damaged image, which keeps its place, so that the positions of the others hold."""
    try:
        return read_stamp(message).ns
    except MessageError:
        return 0


def _until_damaged(bag: Bag, topics: list[str], events: Events) -> Iterator[Message]:
    """The messages before the first that cannot be read, if there are any: a bag that was cut off is still of use."""
    has_any = False
    try:
        for message in bag.messages(topics):
            has_any = True
            yield message
    except InputError as error:
        if not has_any:
            raise
        events.warned(STAGE, f"what comes before is played: {error}")


def _times(stamps: list[int]) -> Times:
    # of whole numbers Python divides without rounding twice
    return Times(
        np.array([ns / 10**9 for ns in stamps]), "ns", "", Decimal(stamps[0]).scaleb(-9),
        np.array([(ns - stamps[0]) / 10**9 for ns in stamps]),
    )  # fmt: skip


def _paired(stamps: _Stamps, chosen: list[ImageTopic], events: Events) -> NDArray[np.int64]:
    """(N, 1) or (N, 2) positions of the messages of each frame; -1 where the second camera has none."""
    first = np.array(stamps.frames[0], np.int64)
    alone = np.arange(len(first))[:, None]
    if len(chosen) < 2 or not stamps.frames[1]:
        return alone
    second = np.array(stamps.frames[1], np.int64)
    order = ascending((second - second.min()).astype(np.float64))
    tolerance = _SAME_MOMENT_NS
    if stamps.is_of_log and len(first) > 1:
        tolerance = int(_SAME_MOMENT_SHARE * np.median(np.diff(np.sort(first))))
    at = np.clip(np.searchsorted(second[order], first), 1, max(1, len(order) - 1))
    near = np.stack([order[at - 1], order[np.minimum(at, len(order) - 1)]])
    apart = np.abs(second[near] - first)
    best = np.where(apart[0] <= apart[1], near[0], near[1])
    best[apart.min(0) > tolerance] = -1
    # messages are read in their order, each once
    matched = np.flatnonzero(best >= 0)
    rising = matched[ascending(best[matched].astype(np.float64))]
    partner = np.full(len(first), -1, np.int64)
    partner[rising] = best[rising]
    if not len(rising):
        text = f"{chosen[1].name} is not used: none of its images is of the moment of one of {chosen[0].name}"
        events.warned(STAGE, text)
        return alone
    lonely = [f"{i:06d}" for i in np.flatnonzero(partner < 0).tolist()]
    warn_of_missing(events, f"images of {chosen[0].name} have no partner of the same time in {chosen[1].name}", lonely)
    return np.stack([alone[:, 0], partner], 1)


# -------------------------------------------------------------------------------------------------------------- IMU


def _imu(
    path: Path, topic: str, stamps: _Stamps, imu_from_cam: Array | None, frames: Times, events: Events
) -> Imu | None:  # fmt: skip
    """Its measurements; None where there are too few. A pose that nothing tells is NaN."""
    rows = [
        (ns, *sample.gyro, *sample.accel)
        for ns, sample in zip(stamps.imu_ns, stamps.imu, strict=True)
        if sample.gyro is not None and sample.accel is not None
        and np.isfinite(sample.gyro).all() and np.isfinite(sample.accel).all()
    ]  # fmt: skip
    rows = sorted({row[0]: row for row in rows}.values())
    if len(rows) < 2:
        events.warned(STAGE, f"{path}: {topic} is not used: expected turn rates and accelerations, found {len(rows)}")
        return None
    values = np.array([row[1:] for row in rows], np.float64)
    force = float(np.median(np.linalg.norm(values[:, 3:], axis=1)))
    if not 1 / _WORST_GRAVITY < force / _GRAVITY_M_S2 < _WORST_GRAVITY:
        text = (
            f"{path}: {topic} is not used: accelerations are {force:.3g} m/s^2 in the median, where gravity is in them"
        )
        events.warned(STAGE, text)
        return None
    events.decided(STAGE, f"IMU {topic}: bags do not state its noise, which is taken to be that of a common sensor")
    assert frames.origin is not None
    origin_ns = int(frames.origin.scaleb(9))
    gyro_noise, accel_noise, gyro_walk, accel_walk = USUAL_NOISE.values()
    pose = np.full(7, np.nan) if imu_from_cam is None else imu_from_cam
    return Imu(
        np.array([row[0] / 10**9 for row in rows]), values[:, :3].copy(), values[:, 3:].copy(), pose,
        gyro_noise, accel_noise, gyro_walk, accel_walk, np.array([(row[0] - origin_ns) / 10**9 for row in rows]),
    )  # fmt: skip


class _Tree:
    """The static transforms of a bag: where its frames of reference are, by their parents."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    @classmethod
    def of(cls, bag: Bag) -> _Tree:
        """Raises InputError: a message cannot be read."""
        tree = cls()
        if _STATIC_TRANSFORMS in bag.topics:
            for message in bag.messages([_STATIC_TRANSFORMS]):
                try:
                    for transform in read_transforms(message):
                        tree._parents[transform.child] = transform.parent, transform.parent_from_child
                except MessageError as error:
                    raise InputError(f"{bag.path}: {_STATIC_TRANSFORMS}: {error}") from error
        return tree

    def pose(self, imu: str, camera: str) -> Array | None:
        """(7,) imu_from_cam; None where no chain of transforms leads from one to the other."""
        of_imu, of_camera = self._ancestors(imu), self._ancestors(camera)
        shared = next((name for name in of_camera if name in of_imu), None)
        if shared is None or imu == camera:  # one name for two places says nothing
            return None
        return np.asarray(rigid3.compose(rigid3.inverse(of_imu[shared]), of_camera[shared]))

    def _ancestors(self, name: str) -> dict[str, Array]:
        """Poses of a frame of reference in each of those above it, itself first."""
        found, pose = {name: rigid3.IDENTITY}, rigid3.IDENTITY
        while name in self._parents:
            name, step = self._parents[name]
            if name in found:  # a circle
                break
            pose = rigid3.compose(step, pose)
            found[name] = pose
        return found
