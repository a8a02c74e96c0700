"""How the keyframes of a window have turned, by the gyroscope: priors of its adjustment while a map grows.

Positions drift along with rotations, and those of a window are the worse the fewer points it sees and the more its
pictures are blurred; a gyroscope cares for neither. Accelerations are left to the closing adjustment, which has the
time to tell scale, gravity and their bias from the whole map.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.integration import (
    Interval,
    gyro_bias_of,
    intervals_between,
    map_from_imu_rotation,
    reintegrate,
)

Array = NDArray[np.float64]

# Keyframes that tell the bias, fewest intervals between them, and seconds beyond which nothing is integrated.
NUM_KEYFRAMES, _MIN_INTERVALS, _MAX_INTERVAL_S = 30, 5, 1.0
# A sensor that is shaken and heated is noisier than its data sheet says.
_EXCESS = 4.0
# A gyroscope that contradicts more than this share of the rotations, or of a degree where there are hardly any, is not
# read as it should be.
_MAX_LEFT, _MIN_TURN_RAD = 0.25, float(np.radians(1.0))
# Of three normal components the length has a variance of three.
_ROOT_3 = float(np.sqrt(3.0))


class Turn(NamedTuple):
    """What a gyroscope says of two keyframes.

    Attributes:
        first, second: their positions. first_from_second: (3, 3) rotation of the cameras. sigma_rad: about each axis.
    """

    first: int
    second: int
    first_from_second: Array
    sigma_rad: float


def turns_between(times_s: Array, cam_from_world: Array, imu: Imu, first: int = 0) -> list[Turn]:
    """How each of some keyframes has turned since the one before.

    The bias is the one with which the measurements agree best with the keyframes. What it leaves, of clocks or a
    mounting that are slightly off as well as of the keyframes' own noise, is part of the sigmas: then the measurements
    count for less.

    Args:
        times_s: (K,). cam_from_world: (K, 7). imu: measurements on the clock of the keyframes.
        first: position of the first of them.

    Returns:
        None of them where the measurements are too few, or contradict the keyframes.
    """
    found = _bias(times_s, cam_from_world, imu)
    if found is None:
        return []
    intervals, bias, left = found
    imu_from_cam, out = rigid3.rotation_matrix(imu.imu_from_cam), []
    for interval in intervals:
        rotation = imu_from_cam.T @ reintegrate(interval, bias).rotation @ imu_from_cam
        sigma = np.hypot(_EXCESS * imu.gyro_noise * np.sqrt(interval.duration), left / _ROOT_3)
        out.append(Turn(first + interval.first, first + interval.second, rotation, float(sigma)))
    return out


def rates_at(times_s: Array, keyframe_times_s: Array, cam_from_world: Array, imu: Imu) -> Array | None:
    """Angular velocities (N, 3) of the camera, in its own frame in rad/s, at some times, by the gyroscope.

    Args:
        times_s: (N,). keyframe_times_s: (K,), cam_from_world: (K, 7) keyframes that tell its bias.

    Returns:
        None where the measurements are too few, or contradict the keyframes; NaN at times that they do not cover.
    """
    found = _bias(keyframe_times_s, cam_from_world, imu)
    if found is None:
        return None
    rates = [np.interp(times_s, imu.timestamps_s, column, np.nan, np.nan) for column in (imu.gyro - found[1]).T]
    return np.stack(rates, 1) @ rigid3.rotation_matrix(imu.imu_from_cam)


def _bias(times_s: Array, cam_from_world: Array, imu: Imu) -> tuple[list[Interval], Array, float] | None:
    """What was measured between keyframes, the bias (3,) with which it agrees best with them, and what that leaves of a
    rotation in radians; None where that is too little, or too much is left."""
    intervals = intervals_between(times_s, np.arange(len(times_s)), imu, _MAX_INTERVAL_S)
    if len(intervals) < _MIN_INTERVALS:
        return None
    bias, left, turned = gyro_bias_of(intervals, map_from_imu_rotation(cam_from_world, imu))
    return (intervals, bias, left) if left < _MAX_LEFT * max(turned, _MIN_TURN_RAD) else None


def turn_factor(first_key: int, second_key: int, turn: Turn) -> Any:
    """gtsam.BetweenFactorPose3 of two poses world_from_cam, with which their positions have nothing to do."""
    import gtsam

    between = gtsam.Pose3(gtsam.Rot3(turn.first_from_second), np.zeros(3))
    # no map is so large that this holds anything in it
    sigmas = np.repeat([turn.sigma_rad, 1e9], 3)
    return gtsam.BetweenFactorPose3(first_key, second_key, between, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
