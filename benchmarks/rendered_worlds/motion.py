"""Smooth motions with exact derivatives, and what an inertial sensor measures on them.

A motion is six sums of quintic B-splines of time: the place of a body in the world (z up) and its yaw, pitch and roll,
so that velocity, acceleration and angular velocity are derivatives of polynomials. The body's axes: x forward, y left,
z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

DEGREE = 5
GRAVITY = 9.81
# a camera that looks along the body's x axis: its x axis is the body's -y, its y axis the body's -z
CAM_FROM_BODY: Array = rigid3.from_matrix(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))


@dataclass(frozen=True)
class Motion:
    """A moving body.

    Attributes:
        splines: scipy BSplines of time with values (6,) that add up: x, y, z in metres, yaw, pitch, roll in radians.
    """

    splines: tuple[Any, ...]

    def _state(self, times_s: ArrayLike, order: int) -> Array:
        total: Array = sum(spline(np.asarray(times_s, np.float64), nu=order) for spline in self.splines)
        return total

    def body_from_world(self, times_s: ArrayLike) -> Array:
        """(N, 7) poses."""
        state = self._state(times_s, 0)
        return rigid3.inverse(rigid3.from_matrix(_euler_matrix(state[:, 3:]), state[:, :3]))

    def velocity(self, times_s: ArrayLike) -> Array:
        """(N, 3) m/s in the world."""
        return self._state(times_s, 1)[:, :3]

    def acceleration(self, times_s: ArrayLike) -> Array:
        """(N, 3) m/s^2 in the world, gravity not included."""
        return self._state(times_s, 2)[:, :3]

    def angular_velocity(self, times_s: ArrayLike) -> Array:
        """(N, 3) rad/s in the body's frame."""
        angle, rate = self._state(times_s, 0)[:, 3:], self._state(times_s, 1)[:, 3:]
        sin_p, cos_p, sin_r, cos_r = np.sin(angle[:, 1]), np.cos(angle[:, 1]), np.sin(angle[:, 2]), np.cos(angle[:, 2])
        yaw, pitch, roll = rate.T
        return np.stack(
            [roll - yaw * sin_p, pitch * cos_r + yaw * sin_r * cos_p, -pitch * sin_r + yaw * cos_r * cos_p], 1
        )


def _euler_matrix(yaw_pitch_roll: Array) -> Array:
    """world_from_body rotations Rz(yaw) Ry(pitch) Rx(roll), (N, 3, 3)."""
    axes = np.eye(3)
    yaw, pitch, roll = (
        rigid3.exp_so3(yaw_pitch_roll[:, i, None] * axes[axis]) for i, axis in enumerate((2, 1, 0))
    )  # fmt: skip
    return yaw @ pitch @ roll


def interpolate(times_s: ArrayLike, values: ArrayLike) -> Any:
    """The quintic spline through values (N, 6) at ascending times."""
    from scipy.interpolate import make_interp_spline

    return make_interp_spline(np.asarray(times_s, np.float64), np.asarray(values, np.float64), k=DEGREE)


def control_spline(controls: ArrayLike, step_s: float, start_s: float = 0.0) -> Any:
    """The uniform quintic B-spline with control values (C, 6), one each ``step_s``.

    It runs from ``start_s`` for ``C - 5`` steps, stays inside the hull of its controls and has next to no power above
    half a cycle a step.
    """
    from scipy.interpolate import BSpline

    controls = np.asarray(controls, np.float64)
    knots = start_s + step_s * (np.arange(len(controls) + DEGREE + 1) - DEGREE)
    return BSpline(knots, controls, DEGREE, extrapolate=True)


def tremor(rng: np.random.Generator, duration_s: float, step_s: float, sigma: ArrayLike) -> Any:
    """Band-limited noise of standard deviations (6,) over 0 to ``duration_s``."""
    controls = rng.standard_normal((int(np.ceil(duration_s / step_s)) + DEGREE + 1, 6))
    # rms of the quintic B-spline basis: white controls come out smaller by this factor
    return control_spline(controls * np.asarray(sigma) / 0.627, step_s)


@dataclass(frozen=True)
class ImuSamples:
    """What an inertial sensor says, in its own frame.

    Attributes:
        timestamps_s: (M,). gyro: (M, 3) rad/s. accel: (M, 3) m/s^2, 9.81 upwards at rest.
        gyro_bias, accel_bias: (M, 3) the part of them that is bias.
        imu_from_world: (M, 7), velocity: (M, 3) m/s in the world: the true motion of the sensor.
        gyro_noise, accel_noise, gyro_walk, accel_walk: densities as in ``images.sequence.Imu``.
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    gyro_bias: Array
    accel_bias: Array
    imu_from_world: Array
    velocity: Array
    gyro_noise: float
    accel_noise: float
    gyro_walk: float
    accel_walk: float


@dataclass(frozen=True)
class ImuOptions:
    """Noise of an inertial sensor; the defaults are the data sheet's of an ADIS16448."""

    rate_hz: float = 200.0
    gyro_noise: float = 1.7e-4  # rad/s/sqrt(Hz)
    accel_noise: float = 2.0e-3  # m/s^2/sqrt(Hz)
    gyro_walk: float = 1.9e-5  # rad/s^2/sqrt(Hz)
    accel_walk: float = 3.0e-3  # m/s^3/sqrt(Hz)
    gyro_bias: tuple[float, float, float] = (-0.002, 0.02, 0.07)  # rad/s at the start
    accel_bias: tuple[float, float, float] = (-0.02, 0.12, 0.06)  # m/s^2 at the start


def measure_inertia(
    motion: Motion, times_s: ArrayLike, imu_from_body: ArrayLike, options: ImuOptions, rng: np.random.Generator
) -> ImuSamples:
    """Samples of a sensor at the body's origin, turned by the rotation of ``imu_from_body`` (7,).

    White noise of density d has the standard deviation d sqrt(rate) in a sample, a bias of walk w takes steps of
    w / sqrt(rate) (Trawny and Roumeliotis, "Indirect Kalman filter for 3D attitude estimation", 2005).
    """
    times = np.asarray(times_s, np.float64)
    turn = rigid3.rotation_matrix(imu_from_body)
    from_world = rigid3.rotation_matrix(motion.body_from_world(times))
    force = motion.acceleration(times) + np.array([0.0, 0.0, GRAVITY])
    root = np.sqrt(options.rate_hz)

    def bias(start: tuple[float, float, float], walk: float) -> Array:
        drift: Array = np.asarray(start) + np.cumsum(walk / root * rng.standard_normal((len(times), 3)), 0)
        return drift

    gyro_bias, accel_bias = bias(options.gyro_bias, options.gyro_walk), bias(options.accel_bias, options.accel_walk)
    gyro = motion.angular_velocity(times) @ turn.T + gyro_bias
    accel = np.einsum("nij,nj->ni", from_world, force) @ turn.T + accel_bias
    gyro += options.gyro_noise * root * rng.standard_normal(gyro.shape)
    accel += options.accel_noise * root * rng.standard_normal(accel.shape)
    turned = rigid3.from_matrix(turn, np.zeros(3))
    return ImuSamples(
        times, gyro, accel, gyro_bias, accel_bias, rigid3.compose(turned, motion.body_from_world(times)),
        motion.velocity(times), options.gyro_noise, options.accel_noise, options.gyro_walk, options.accel_walk,
    )  # fmt: skip
