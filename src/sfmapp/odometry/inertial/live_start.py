"""Where down is, how long the map's unit is, and what the sensor's biases are, from the first seconds of live poses.

The linear alignment of the closing graph (:func:`~sfmapp.odometry.inertial.integration.solve_linear`) on a few
seconds, with how sure it is: enough for a filter to begin with, which finds out the rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.inertial.filter_state import InertialSensor
from sfmapp.odometry.inertial.gyroscope import read_as_given
from sfmapp.odometry.inertial.integration import (
    InertialOptions,
    choose_poses,
    constrain,
    gyro_bias_of,
    intervals_between,
    linear_system,
    map_from_imu_rotation,
    turns_of,
)

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]

# What a start is looked for in, and how often.
SHORTEST_S, LONGEST_S, STEP_S = 2.5, 10.0, 0.5
# The filter is linear about where it begins.
_MAX_SCALE_SIGMA, _MAX_TILT_RAD = 0.15, float(np.radians(5.0))
# What the alignment is believed to: it says where to begin, not how sure that is.
_ANY_SCALE_SIGMA, _ANY_TILT_RAD = 0.3, float(np.radians(10.0))
_OPTIONS = InertialOptions(max_poses=100)
# The clock is believed to be off from so many of its sigmas on: errors of poses last, and on seven rendered flights
# without an offset what was found is 1.7 sigmas rms, 3.4 at most. What is below that the filter finds out: 95 % of what
# it is told to expect, and no more than moves a camera as a line does, however little rotations tell.
_CLOCK_SIGMAS = 5.0
_CLOCK_LEFT_SIGMAS, _MOST_CLOCK_SIGMA_S = _CLOCK_SIGMAS / 1.96, 0.005


class Start(NamedTuple):
    """What a filter begins with.

    Attributes:
        sensor: with gravity in the axes of the poses. scale: metres per unit of the poses.
        clock_offset_s: to be taken from the times of the samples.
    """

    sensor: InertialSensor
    scale: float
    clock_offset_s: float


def start_of(times: Array, poses: Array, imu: Imu, *, is_metric: bool) -> Start | str:
    """What a filter needs to know before it begins.

    Args:
        times: (N,) seconds. poses: (N, 7) cam_from_world, NaN where there is none.
        imu: what was measured until then.
        is_metric: the poses are in metres.

    Returns:
        What to begin with, or why it is too early.
    """
    chosen = choose_poses(times, poses, _OPTIONS)
    intervals = intervals_between(times, chosen, imu, _OPTIONS.max_interval_s)
    if len(intervals) < _OPTIONS.min_intervals:
        return f"{len(intervals)} intervals between poses have inertial measurements"
    clock = read_as_given(turns_of(times, poses, chosen, _OPTIONS.max_interval_s), imu)
    offset = clock.offset_s if abs(clock.offset_s) > _CLOCK_SIGMAS * clock.offset_sigma_s else 0.0
    imu = replace(imu, timestamps_s=imu.timestamps_s - offset)
    intervals = intervals_between(times, chosen, imu, _OPTIONS.max_interval_s)
    gyro_bias, left, turned = gyro_bias_of(intervals, map_from_imu_rotation(poses, imu))
    if not left <= max(np.radians(1.0), _OPTIONS.max_rotation_residual * turned):
        return f"the gyroscope contradicts the rotations by {np.degrees(left):.1f} of {np.degrees(turned):.1f} degrees"
    system = linear_system(times, poses, imu, gyro_bias, _OPTIONS)
    if system is None:
        return "too few poses"
    found = constrain(*system, is_metric)
    if not found.inverse_scale > 0.0:
        return "the motion does not tell the scale"
    # the accelerometer's bias is what the filter takes it for: that of the alignment hangs on gravity's
    scale_sigma = 0.0 if is_metric else _ANY_SCALE_SIGMA
    sensor = InertialSensor(
        imu, found.gravity, _ANY_TILT_RAD, gyro_bias, np.zeros(3), scale_sigma,
        min(_CLOCK_LEFT_SIGMAS * clock.offset_sigma_s, _MOST_CLOCK_SIGMA_S),
    )  # fmt: skip
    return Start(sensor, 1.0 / found.inverse_scale, offset)


def why_too_early(scale_sigma: float, tilt_sigma_rad: float) -> str:
    """Why a filter that has gone through the first seconds had better wait; empty: it had not."""
    if scale_sigma <= _MAX_SCALE_SIGMA and tilt_sigma_rad <= _MAX_TILT_RAD:
        return ""
    return (
        f"the motion tells the scale to {scale_sigma:.0%} and where down is to {np.degrees(tilt_sigma_rad):.0f} degrees"
    )


def in_metres(poses: Array, scale: float) -> Array:
    """Poses (..., 7), or similarities (..., 8), in another unit of length."""
    return np.concatenate([poses[..., :4], scale * poses[..., 4:7], poses[..., 7:]], -1)


def until(imu: Imu, timestamp_s: float) -> Imu:
    """What was measured until a moment."""
    num = int(np.searchsorted(imu.timestamps_s, timestamp_s, "right"))
    return replace(imu, timestamps_s=imu.timestamps_s[:num], gyro=imu.gyro[:num], accel=imu.accel[:num], elapsed_s=None)
