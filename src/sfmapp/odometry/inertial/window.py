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
from sfmapp.odometry.inertial.integration import gyro_bias_of, intervals_between, map_from_imu_rotation, reintegrate

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
    intervals = intervals_between(times_s, np.arange(len(times_s)), imu, _MAX_INTERVAL_S)
    if len(intervals) < _MIN_INTERVALS:
        return []
    bias, left, turned = gyro_bias_of(intervals, map_from_imu_rotation(cam_from_world, imu))
    if not left < _MAX_LEFT * max(turned, _MIN_TURN_RAD):
        return []
    imu_from_cam, out = rigid3.rotation_matrix(imu.imu_from_cam), []
    for interval in intervals:
        rotation = imu_from_cam.T @ reintegrate(interval, bias).rotation @ imu_from_cam
        sigma = np.hypot(_EXCESS * imu.gyro_noise * np.sqrt(interval.duration), left / _ROOT_3)
        out.append(Turn(first + interval.first, first + interval.second, rotation, float(sigma)))
    return out


def swings_at(times_s: Array, imu: Imu) -> Array:
    """Angular velocities (N, 3) of the camera, in its own frame in rad/s, at some times, beyond their means from the
    time before each to the time after: what poses at these times do not tell. A bias falls out.

    Args:
        times_s: (N,) ascending, N >= 2; the first and the last have one neighbour.

    Returns:
        NaN at times that the measurements do not cover.
    """

    def at(when: Array, values: Array) -> Array:
        return np.stack([np.interp(when, imu.timestamps_s, column, np.nan, np.nan) for column in values.T], 1)

    steps = 0.5 * np.diff(imu.timestamps_s)[:, None] * (imu.gyro[1:] + imu.gyro[:-1])
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])
    before, after = np.append(times_s[:1], times_s[:-1]), np.append(times_s[1:], times_s[-1:])
    mean = (at(after, turned) - at(before, turned)) / (after - before)[:, None]
    swings: Array = (at(times_s, imu.gyro) - mean) @ rigid3.rotation_matrix(imu.imu_from_cam)
    return swings


def turn_factor(first_key: int, second_key: int, turn: Turn) -> Any:
    """gtsam.BetweenFactorPose3 of two poses world_from_cam, with which their positions have nothing to do."""
    import gtsam

    between = gtsam.Pose3(gtsam.Rot3(turn.first_from_second), np.zeros(3))
    # no map is so large that this holds anything in it
    sigmas = np.repeat([turn.sigma_rad, 1e9], 3)
    return gtsam.BetweenFactorPose3(first_key, second_key, between, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
