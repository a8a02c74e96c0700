"""What a sequence is: frames in time, the rig that took them, and what else was recorded beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """All images of one moment.

    Attributes:
        idx: position in the sequence, frames that could not be read counted as well.
        name: the file of the first camera relative to the sequence, or ``000123`` in a video.
        timestamp_s: seconds, ascending.
        images: one (H, W) uint8 grey image for each camera of the rig.
    """

    idx: int
    name: str
    timestamp_s: float
    images: tuple[NDArray[np.uint8], ...]


@dataclass(frozen=True)
class Imu:
    """Inertial measurements, in the IMU's own frame.

    Attributes:
        timestamps_s: (M,) ascending, on the clock of the frames.
        gyro: (M, 3) rad/s. accel: (M, 3) m/s^2, gravity included (at rest it points up and is 9.81 long).
        imu_from_cam: (7,) pose that takes points of the rig's first camera to the IMU's frame, in metres.
        gyro_noise, accel_noise: white noise densities, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
        gyro_walk, accel_walk: random walks of the biases, rad/s^2/sqrt(Hz) and m/s^3/sqrt(Hz).
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    imu_from_cam: Array
    gyro_noise: float
    accel_noise: float
    gyro_walk: float
    accel_walk: float


@dataclass(frozen=True)
class Truth:
    """Where the rig's first camera truly was: (N,) seconds, and cam_from_world (N, 7) in metres."""

    timestamps_s: Array
    cam_from_world: Array


class Sequence(Protocol):
    """Frames that can be walked through from the start as often as one likes.

    Attributes:
        kind: the layout it was recognised as.
        source: what the user gave.
        rig: its cameras; more than one means stereo, in metres.
        num_frames: how many there are; None where only reading tells.
        frames_per_second: nominal rate; None where unknown.
        imu, truth: None where there is none.
    """

    kind: Literal["kitti", "tum", "euroc", "folder", "video"]
    source: str
    rig: Rig
    num_frames: int | None
    frames_per_second: float | None
    imu: Imu | None
    truth: Truth | None

    def frames(self) -> Iterator[Frame]:
        """The frames in order, decoded ahead in a thread; what cannot be read is warned of and left out."""
        ...
