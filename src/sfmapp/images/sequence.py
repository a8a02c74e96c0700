"""What a sequence is: frames in time, the rig that took them, and what else was recorded beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import UsageError
from sfmapp.option_checks import Range, check_options
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
SequenceKind = Literal["kitti", "tum", "euroc", "folder", "video", "bag", "arrays"]

STAGE = "sequence"
"""Stage of the events that tell of opening and reading a sequence."""


@dataclass(frozen=True)
class SequenceOptions:
    """What to play of a sequence, and what is known about it that it does not say itself.

    Attributes:
        camera: ``MODEL,PARAMETER,...`` in COLMAP's order and pixel rule (the centre of the top-left pixel is 0.5), or
            the path of a calibration file (see :func:`sfmapp.camera_files.reading.read_calibration`). None: what
            lies beside the frames.
        mono: use the first camera alone, also where there are two.
        start, stop: first frame and the one behind the last, as positions in the sequence; None: to its end.
        step: play every step-th frame.
        reverse: play backwards. Time still ascends: a frame of time t comes at first + last - t, so that the intervals
            stay what they are; the ground truth is mirrored with it, and the IMU, whose rates of rotation change sign.
        fps: frames a second, in place of the times that the sequence holds; None: its times, and where it holds none
            10 for KITTI, 30 else, with a note.
        imu: path of IMU measurements in EuRoC's form, ``sensor.yaml`` beside it. None: what the sequence holds.
        ground_truth: path of a trajectory of TUM, KITTI or EuRoC. None: what the sequence holds.
        image_topic: of a bag, the topic with the images, or two of a pair with a comma between them, the left one
            first. None: the one camera, or the one pair that ``camera_info`` gives a baseline.
        imu_topic: of a bag, the topic of the IMU. None: the only one there is.
    """

    camera: str | None = None
    mono: bool = False
    start: int = 0
    stop: int | None = None
    step: int = 1
    reverse: bool = False
    fps: float | None = None
    imu: str | None = None
    ground_truth: str | None = None
    image_topic: str | None = None
    imu_topic: str | None = None

    def __post_init__(self) -> None:
        check_options("sequence", self, {"start": Range(0), "step": Range(1), "fps": Range(1e-3, 1e5)})
        if self.stop is not None and self.stop <= self.start:
            raise UsageError(f"stop is {self.stop}, expected more than start ({self.start})")


@dataclass(frozen=True)
class Frame:
    """All images of one moment.

    Attributes:
        idx: position among the frames that are played, those that could not be read counted as well.
        name: the file of the first camera relative to the sequence, or ``000123`` in a video.
        timestamp_s: seconds, strictly ascending.
        images: one (H, W) uint8 grey image for each camera of the rig; the first alone where the others lack it.
        elapsed_s: seconds since the sequence began, which a clock since 1970 tells to a quarter of a microsecond only;
            None where nothing more exact than ``timestamp_s`` is known.
        given_s: what ``timestamp_s`` was before the time that has elapsed took its place; None while it is that itself.
        captured_s: of a live source, when the frame came, on the clock of ``time.monotonic``; None of recorded ones.
    """

    idx: int
    name: str
    timestamp_s: float
    images: tuple[NDArray[np.uint8], ...]
    elapsed_s: float | None = None
    given_s: float | None = None
    captured_s: float | None = None

    @property
    def shown_s(self) -> float:
        """The time on the sequence's own clock, to be told and written."""
        return self.timestamp_s if self.given_s is None else self.given_s


@dataclass(frozen=True)
class RepeatedFrame:
    """A frame that shows what the one before it shows, to the byte: a camera that was read twice.

    Attributes:
        idx, name, timestamp_s: as of :class:`Frame`.
        twin_idx: ``idx`` of the frame that it repeats.
    """

    idx: int
    name: str
    timestamp_s: float
    twin_idx: int


@dataclass(frozen=True)
class Imu:
    """Inertial measurements, in the IMU's own frame.

    Attributes:
        timestamps_s: (M,) ascending, on the clock of the frames.
        gyro: (M, 3) rad/s. accel: (M, 3) m/s^2, gravity included (at rest it points up and is 9.81 long).
        imu_from_cam: (7,) pose that takes points of the rig's first camera to the IMU's frame, in metres.
        gyro_noise, accel_noise: white noise densities, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
        gyro_walk, accel_walk: random walks of the biases, rad/s^2/sqrt(Hz) and m/s^3/sqrt(Hz).
        elapsed_s: (M,) on the clock of :attr:`Frame.elapsed_s`; None where that is not known.
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    imu_from_cam: Array
    gyro_noise: float
    accel_noise: float
    gyro_walk: float
    accel_walk: float
    elapsed_s: Array | None = None


@dataclass(frozen=True)
class GroundTruth:
    """Where the rig's first camera truly was: (N,) ascending seconds, and cam_from_world (N, 7) in metres."""

    timestamps_s: Array
    cam_from_world: Array


class Sequence(Protocol):
    """Frames that can be walked through from the start as often as one likes (a live stream: once).

    Attributes:
        kind: the layout it was recognised as.
        source: what the user gave.
        rig: its cameras; more than one means stereo, in metres.
        num_frames: how many there are, unreadable ones included (of a video: what its header says); None where only
            reading tells.
        frames_per_second: nominal rate; None where unknown.
        imu, ground_truth: None where there is none.
        orientation: EXIF orientation 1 to 8 of the frames, for whoever shows them to people.
    """

    kind: SequenceKind
    source: str
    rig: Rig
    num_frames: int | None
    frames_per_second: float | None
    imu: Imu | None
    ground_truth: GroundTruth | None
    orientation: int

    def frames(self) -> Iterator[Frame]:
        """The frames in order, decoded ahead in a thread; what cannot be read is warned of and left out."""
        ...
