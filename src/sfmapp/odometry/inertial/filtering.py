"""An error-state Kalman filter over poses and inertial measurements: where the camera is, at the rate of the sensor.

Each sample of the sensor moves the state on, each pose with its covariance corrects it; of what comes later it knows
nothing. Sola, "Quaternion kinematics for the error-state Kalman filter", arXiv 1711.02508, 2017, sections 5 and 6; a
sample is integrated, and its slopes taken, by the preintegration of :mod:`sfmapp.odometry.inertial.integration`.

The state is that of the sensor: position in the world, rotation world_from_imu, velocity in the world, the biases of
gyroscope and accelerometer, and gravity in the world, which a map knows to its own accuracy only. The error state (18,)
has them in that order, the rotation's on the right: R exp(dtheta). Without a sensor the filter of
:mod:`sfmapp.odometry.inertial.smoothing` takes its place: the camera goes on as it moves.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.gyroscope import imu_steps
from sfmapp.odometry.inertial.integration import ACCEL_BIAS_SIGMA, GRAVITY, GYRO_BIAS_SIGMA, integrate
from sfmapp.odometry.inertial.smoothing import (
    MeasuredPoses,
    SmoothingOptions,
    compile_kernels,
    error_from_tangent,
    read_measured,
    segments,
    smooth_trajectory,
    unknown_rates,
)
from sfmapp.odometry.report import FilterConsistency

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Where the parts of the error state are.
_P, _R, _V, _BG, _BA, _G = (slice(3 * k, 3 * k + 3) for k in range(6))
_SIZE = 18
_DIAGONAL = np.diag_indices(_SIZE)
# Gravity is 9.78 to 9.83 m/s^2 from place to place.
_GRAVITY_SIGMA = 0.02
# Frames further apart than so many times their usual distance have lost some between them.
_DROPPED = 1.5
LIVE = SmoothingOptions(max_gap_s=5.0, is_causal=True)
"""Only the past counts, and gaps of up to five seconds are bridged."""


@dataclass(frozen=True)
class InertialSensor:
    """Measurements, and what is known of the sensor before the first pose.

    Attributes:
        imu: on the clock of the poses, mounted as it is.
        gravity: (3,) m/s^2 in the world of the poses, which is in metres; it points down. gravity_sigma_rad: of its
            direction.
        gyro_bias, accel_bias: (3,) rad/s and m/s^2, uncertain by what biases of small sensors may be.
    """

    imu: Imu
    gravity: Array
    gravity_sigma_rad: float
    gyro_bias: Array
    accel_bias: Array


@dataclass(frozen=True)
class FilteredTrajectory:
    """Poses at the times of the sensor's samples and of the frames.

    Attributes:
        timestamps_s: (N,) ascending.
        cam_from_world: (N, 7). covariance: (N, 6, 6) over rotation (radians) and translation of
            ``x_cam <- exp(w) x_cam + v``.
        since_pose_s: (N,) seconds since the last pose that was used.
        is_bridged: (N,) bool: a frame since then, or this one, brought no pose that was used.
        frame_row: (F,) int64 position of each frame in these, -1 of those that nothing reaches.
        nis: (F,) normalised innovations squared, 6 in the mean where all is as modelled; NaN where there was nothing to
            compare.
        is_rejected: (F,) bool: the pose disagreed with the motion and was not used.
        prediction: ``imu`` or ``constant velocity``.
        gyro_bias, accel_bias: (3,) in the end; zeros without a sensor.
        latency_s: (N,) seconds on the clock that finding a row took, after its sample or pose was there.
    """

    timestamps_s: Array
    cam_from_world: Array
    covariance: Array
    since_pose_s: Array
    is_bridged: Bools
    frame_row: Ints
    nis: Array
    is_rejected: Bools
    prediction: str
    gyro_bias: Array
    accel_bias: Array
    latency_s: Array

    @property
    def position_sigma(self) -> Array:
        """(N,) standard deviation of the camera's centre in the world, the root of the sum over the axes."""
        of_center = rigid3.center_covariance(self.cam_from_world, self.covariance)
        sigma: Array = np.sqrt(np.trace(of_center, axis1=1, axis2=2))
        return sigma

    @property
    def rotation_sigma_rad(self) -> Array:
        """(N,) standard deviation of the rotation, the root of the sum over the axes."""
        sigma: Array = np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))
        return sigma


def filter_trajectory(
    timestamps_s: ArrayLike,
    cam_from_world: ArrayLike,
    covariance: ArrayLike,
    sensor: InertialSensor | None = None,
    options: SmoothingOptions = LIVE,
) -> FilteredTrajectory:
    """Filter measured poses of frames, using at each time what came before it.

    Poses that the motion contradicts (``options.max_nis``) are left out, up to ``options.max_rejected`` in a row. After
    a gap that is too long, or that the sensor was silent in, the filter begins anew with the biases that it has.
    Without a sensor the level of the accelerations is that of the whole trajectory.

    Args:
        timestamps_s: (F,) strictly ascending.
        cam_from_world: (F, 7) in one world; NaN in gaps.
        covariance: (F, 6, 6) as :func:`~sfmapp.adjust.pose.refine_pose` gives it; a pose whose covariance is not
            finite and positive counts as a gap.
        sensor: None: the camera goes on as it moves, and rows are those of the frames.

    Raises:
        ValueError: times that do not ascend.
    """
    if sensor is None:
        return _at_constant_velocity(timestamps_s, cam_from_world, covariance, options)
    measured = read_measured(timestamps_s, cam_from_world, covariance)
    run = _Run(measured, sensor, options)
    for start, stop in segments(measured, options.max_gap_s):
        run.go_through(start, stop)
    return run.result()


def consistency(nis: Array) -> FilterConsistency | None:
    """Hold normalised innovations squared (F,) of six degrees of freedom against chi-squared; None without any."""
    from scipy.stats import chi2  # heavy to load

    known = nis[np.isfinite(nis)]
    if not len(known):
        return None
    low, high = chi2.ppf([0.025, 0.975], 6.0)
    mean_low, mean_high = chi2.ppf([0.025, 0.975], 6.0 * len(known)) / (6.0 * len(known))
    return FilterConsistency(
        num_innovations=len(known), mean=float(known.mean() / 6.0), mean_low=float(mean_low),
        mean_high=float(mean_high), share_inside=float(np.mean((known >= low) & (known <= high))),
    )  # fmt: skip


def _at_constant_velocity(
    timestamps_s: ArrayLike, cam_from_world: ArrayLike, covariance: ArrayLike, options: SmoothingOptions
) -> FilteredTrajectory:
    """The same by the frames alone."""
    compile_kernels()  # which is no latency
    times, begin = np.asarray(timestamps_s, np.float64), time.perf_counter()
    found = smooth_trajectory(times, cam_from_world, covariance, options)
    spent = time.perf_counter() - begin
    rows = np.flatnonzero(np.isfinite(found.cam_from_world[:, 0]))
    frame_row = np.full(len(times), -1, np.int64)
    frame_row[rows] = np.arange(len(rows))
    used = np.where(found.is_predicted, -1, np.arange(len(times)))[rows]
    since = times[rows] - times[np.maximum.accumulate(used)] if len(rows) else np.zeros(0)
    return FilteredTrajectory(
        times[rows], found.cam_from_world[rows], found.covariance[rows], since, found.is_predicted[rows], frame_row,
        found.nis, found.is_rejected, "constant velocity", np.zeros(3), np.zeros(3),
        np.full(len(rows), spent / max(len(rows), 1)),
    )  # fmt: skip


class _Row(NamedTuple):
    """A pose that was found: rotation world_from_cam (3, 3), centre (3,), and their covariance (6, 6), centre first."""

    timestamp_s: float
    rotation: Array
    center: Array
    covariance: Array
    since_pose_s: float
    is_bridged: bool
    latency_s: float


class _Run:
    """The filter on its way through the frames."""

    def __init__(self, measured: MeasuredPoses, sensor: InertialSensor, options: SmoothingOptions) -> None:
        num = len(measured.times)
        self._measured, self._imu, self._options = measured, sensor.imu, options
        self._state = _State(sensor, unknown_rates(measured)[0])
        self._interval_s = float(np.median(np.diff(measured.times))) if num > 1 else np.inf
        self._rows, self._frame_row = list[_Row](), np.full(num, -1, np.int64)
        self._nis, self._is_rejected = np.full(num, np.nan), np.zeros(num, bool)
        self._last_s, self._in_a_row = 0.0, 0

    def go_through(self, start: int, stop: int) -> None:
        """Frames [start, stop), the first of which has a pose."""
        is_under_way = False
        for f in range(start, stop):
            steps = imu_steps(self._imu, self._measured.times[f - 1], self._measured.times[f]) if is_under_way else None
            if steps is not None:
                self._go_to(f, steps)
            elif self._measured.is_there[f]:
                self._begin_at(f)
                is_under_way = True
            else:
                is_under_way = False

    def _begin_at(self, f: int) -> None:
        begin, measured = time.perf_counter(), self._measured
        self._state.begin(measured.position[f], measured.rotation[f], measured.noise[f])
        self._last_s, self._in_a_row, self._frame_row[f] = measured.times[f], 0, len(self._rows)
        self._note(measured.times[f], False, begin)

    def _go_to(self, f: int, steps: Array) -> None:
        """From the frame before, with the steps (n, 7) of the sensor between them."""
        measured, since = self._measured, self._measured.times[f] - self._last_s
        is_waiting = self._last_s < measured.times[f - 1]
        for n, now in enumerate(measured.times[f - 1] + np.cumsum(steps[:, 0])):
            begin = time.perf_counter()
            self._state.predict(steps[n])
            if n < len(steps) - 1:
                self._note(now, is_waiting or now - self._last_s > _DROPPED * self._interval_s, begin)
        is_used = bool(measured.is_there[f]) and self._correct(f)
        if is_used:
            self._last_s, since = measured.times[f], 0.0
        self._frame_row[f] = len(self._rows)
        self._note(measured.times[f], since > 0.0, begin)

    def _correct(self, f: int) -> bool:
        """By the pose of a frame, if the motion does not contradict it."""
        measured, options = self._measured, self._options
        innovation = self._state.innovation(measured.position[f], measured.rotation[f])
        self._nis[f] = self._state.nis(innovation, measured.noise[f])
        if self._nis[f] > options.max_nis:
            self._in_a_row += 1
            if self._in_a_row <= options.max_rejected:
                self._is_rejected[f] = True
                return False
            self._state.forget(innovation)
        self._in_a_row = 0
        self._state.correct(innovation, measured.noise[f])
        return True

    def _note(self, now: float, is_bridged: bool, begin: float) -> None:
        rotation, center, covariance = self._state.camera()
        spent = time.perf_counter() - begin
        self._rows.append(_Row(now, rotation, center, covariance, now - self._last_s, is_bridged, spent))

    def result(self) -> FilteredTrajectory:
        """Out of the filter's order of the error state."""
        rows = self._rows
        rotation = np.array([row.rotation for row in rows]).reshape(-1, 3, 3)
        centers = np.array([row.center for row in rows]).reshape(-1, 3)
        change = np.linalg.inv(error_from_tangent(rotation))
        covariance = np.array([row.covariance for row in rows]).reshape(-1, 6, 6)
        return FilteredTrajectory(
            np.array([row.timestamp_s for row in rows]), rigid3.inverse(rigid3.from_matrix(rotation, centers)),
            change @ covariance @ change.swapaxes(1, 2), np.array([row.since_pose_s for row in rows]),
            np.array([row.is_bridged for row in rows], bool), self._frame_row, self._nis, self._is_rejected, "imu",
            self._state.gyro_bias, self._state.accel_bias, np.array([row.latency_s for row in rows]),
        )  # fmt: skip


class _State:
    """Where the sensor is believed to be, and how sure that is.

    Args:
        speed: standard deviation of a velocity of which nothing is known, m/s.
    """

    def __init__(self, sensor: InertialSensor, speed: float) -> None:
        imu, down = sensor.imu, sensor.gravity / np.linalg.norm(sensor.gravity)
        self._imu_from_cam, self._arm = rigid3.rotation_matrix(imu.imu_from_cam), imu.imu_from_cam[4:]
        self._noises = np.array([imu.gyro_noise, imu.accel_noise, imu.gyro_walk, imu.accel_walk]) ** 2
        self._speed, self._delta = speed, np.empty(60)
        self.position, self.rotation, self.velocity = np.zeros(3), np.eye(3), np.zeros(3)
        self.gyro_bias, self.accel_bias, self._gravity = sensor.gyro_bias, sensor.accel_bias, sensor.gravity
        self._p = np.zeros((_SIZE, _SIZE))
        self._p[_BG, _BG], self._p[_BA, _BA] = GYRO_BIAS_SIGMA**2 * np.eye(3), ACCEL_BIAS_SIGMA**2 * np.eye(3)
        along = np.outer(down, down)
        tilt = GRAVITY * sensor.gravity_sigma_rad
        self._p[_G, _G] = tilt**2 * (np.eye(3) - along) + _GRAVITY_SIGMA**2 * along

    def begin(self, center: Array, rotation: Array, noise: Array) -> None:
        """At a pose of the camera (centre, world_from_cam and their covariance), with any velocity."""
        self.rotation = rotation @ self._imu_from_cam.T
        self.position, self.velocity = center - self.rotation @ self._arm, np.zeros(3)
        self._p[: _BG.start], self._p[:, : _BG.start] = 0.0, 0.0
        back = np.linalg.inv(self._measurement()[:, :6])
        self._p[:6, :6] = back @ noise @ back.T
        self._p[_V, _V] = self._speed**2 * np.eye(3)

    def predict(self, step: Array) -> None:
        """On by a step (7,) of the sensor: duration, mean rate and mean force."""
        h, delta, r = float(step[0]), self._delta, self.rotation
        integrate(step[None], self.gyro_bias, delta)
        slope = delta[15:].reshape(5, 3, 3)
        velocity = delta[9:12] + slope[2] @ self.accel_bias
        moved = delta[12:15] + slope[4] @ self.accel_bias
        turn, f = delta[:9].reshape(3, 3), np.eye(_SIZE)
        f[_P, _R], f[_V, _R] = -r @ rigid3.skew(moved), -r @ rigid3.skew(velocity)
        f[_R, _R], f[_R, _BG] = turn.T, slope[0]
        f[_V, _BG], f[_V, _BA], f[_P, _BG], f[_P, _BA] = r @ slope[1], r @ slope[2], r @ slope[3], r @ slope[4]
        for k in range(3):
            f[k, 6 + k], f[k, 15 + k], f[6 + k, 15 + k] = h, 0.5 * h * h, h
        self._p = f @ self._p @ f.T
        gyro, accel, gyro_walk, accel_walk = self._noises * h
        self._p[_DIAGONAL] += np.repeat([accel * h * h / 3.0, gyro, accel, gyro_walk, accel_walk, 0.0], 3)
        for k in range(3):
            self._p[k, 6 + k] += accel * h / 2.0
            self._p[6 + k, k] += accel * h / 2.0
        self.position = self.position + self.velocity * h + 0.5 * h * h * self._gravity + r @ moved
        self.velocity = self.velocity + h * self._gravity + r @ velocity
        self.rotation = r @ turn

    def _measurement(self) -> Array:
        """(6, 18) slopes of the camera's centre in the world and of its rotation, in its own frame."""
        h = np.zeros((6, _SIZE))
        h[:3, _P], h[:3, _R] = np.eye(3), -self.rotation @ rigid3.skew(self._arm)
        h[3:, _R] = self._imu_from_cam.T
        return h

    def camera(self) -> tuple[Array, Array, Array]:
        """Rotation world_from_cam (3, 3), centre (3,) and their covariance (6, 6)."""
        h = self._measurement()
        center = self.position + self.rotation @ self._arm
        return self.rotation @ self._imu_from_cam, center, h @ self._p @ h.T

    def innovation(self, center: Array, rotation: Array) -> Array:
        """(6,) what a measured pose says beyond the state."""
        ours, our_center, _ = self.camera()
        return np.concatenate([center - our_center, rigid3.log_so3(ours.T @ rotation)])

    def nis(self, innovation: Array, noise: Array) -> float:
        """Normalised innovation squared."""
        h = self._measurement()
        return float(innovation @ np.linalg.solve(h @ self._p @ h.T + noise, innovation))

    def correct(self, innovation: Array, noise: Array) -> None:
        """Kalman's update, the covariance in Joseph's form."""
        h = self._measurement()
        gain = np.linalg.solve(h @ self._p @ h.T + noise, h @ self._p).T
        step, keep = gain @ innovation, np.eye(_SIZE) - gain @ h
        self._p = keep @ self._p @ keep.T + gain @ noise @ gain.T
        self._p = 0.5 * (self._p + self._p.T)
        self.position, self.velocity = self.position + step[_P], self.velocity + step[_V]
        self.rotation = rigid3.rotation_matrix(rigid3.quaternion(self.rotation @ rigid3.exp_so3(step[_R])))
        self.gyro_bias, self.accel_bias = self.gyro_bias + step[_BG], self.accel_bias + step[_BA]
        self._gravity = self._gravity + step[_G]

    def forget(self, innovation: Array) -> None:
        """The motion jumped: what was predicted says little about where and how fast."""
        squares = [(innovation[:3] ** 2).sum(), (innovation[3:] ** 2).sum(), self._speed**2, 0.0, 0.0, 0.0]
        self._p[_DIAGONAL] += np.repeat(squares, 3)
