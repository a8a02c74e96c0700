"""Where down is, how long the map's unit is, and what the sensor's biases are, from the first seconds of live poses.

The linear alignment of the closing graph (:func:`~sfmapp.odometry.inertial.integration.solve_linear`) on a few
seconds, with how sure it is: enough for a filter to begin with, which finds out the rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.inertial.filtering import InertialSensor
from sfmapp.odometry.inertial.gyroscope import read_as_given
from sfmapp.odometry.inertial.integration import (
    ACCEL_BIAS_SIGMA,
    GRAVITY,
    InertialOptions,
    LinearStart,
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
_OPTIONS = InertialOptions(max_poses=100)


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
    offset = clock.offset_s if abs(clock.offset_s) > 3.0 * clock.offset_sigma_s else 0.0
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
    scale_sigma, tilt = _sigmas(system[0], found, float(np.ptp(times[chosen])), is_metric)
    if not (scale_sigma <= _MAX_SCALE_SIGMA and tilt <= _MAX_TILT_RAD):
        return f"the motion tells the scale to {scale_sigma:.0%} and where down is to {np.degrees(tilt):.0f} degrees"
    sensor = InertialSensor(imu, found.gravity, tilt, gyro_bias, found.accel_bias, scale_sigma)
    return Start(sensor, 1.0 / found.inverse_scale, offset)


def _sigmas(design: Array, found: LinearStart, duration_s: float, is_metric: bool) -> tuple[float, float]:
    """Relative standard deviation of the scale, and that of the direction of gravity in radians."""
    x = np.concatenate([[1.0], found.gravity, found.accel_bias])
    basis = np.linalg.svd(found.gravity[None])[2][1:].T
    rho = found.inverse_scale
    slopes = np.concatenate(
        [(design @ x)[..., None] * rho, rho * GRAVITY * design[..., 1:4] @ basis, rho * design[..., 4:]], -1
    )
    slopes = slopes[..., 1:] if is_metric else slopes
    size = slopes.shape[2]
    # spans of a second begin at every pose: those in the same second are told the same
    repeated = max(1.0, len(design) / max(duration_s, 1.0))
    information = np.einsum("nki,nkj->ij", slopes, slopes) / (repeated * found.position_sigma**2)
    information[-3:, -3:] += np.eye(3) / ACCEL_BIAS_SIGMA**2
    try:
        variance = np.diag(np.linalg.inv(information))
    except np.linalg.LinAlgError:
        return float("inf"), float("inf")
    tilt = float(np.sqrt(variance[size - 5 : size - 3].max()))
    return (0.0 if is_metric else float(np.sqrt(variance[0]))), tilt


def in_metres(poses: Array, scale: float) -> Array:
    """Poses (N, 7) of another unit of length."""
    return np.concatenate([poses[..., :4], scale * poses[..., 4:]], -1)


def until(imu: Imu, timestamp_s: float) -> Imu:
    """What was measured until a moment."""
    num = int(np.searchsorted(imu.timestamps_s, timestamp_s, "right"))
    return replace(imu, timestamps_s=imu.timestamps_s[:num], gyro=imu.gyro[:num], accel=imu.accel[:num], elapsed_s=None)
