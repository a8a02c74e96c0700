"""An error-state Kalman filter over poses and inertial measurements: where the camera is, at the rate of the sensor.

Each sample of the sensor moves the state on, each pose with its covariance corrects it; of what comes later it knows
nothing. Sola, "Quaternion kinematics for the error-state Kalman filter", arXiv 1711.02508, 2017, sections 5 and 6; a
sample is integrated, and its slopes taken, by the preintegration of :mod:`sfmapp.odometry.inertial.integration`.

The state is that of the sensor: position in the world, rotation world_from_imu, velocity in the world, the biases of
gyroscope and accelerometer, and gravity in the world, which a map knows to its own accuracy only; and how far the map
has drifted from that world: shift, rotation and scale. Poses of neighbouring frames err together, as they see the same
points, and a map that is made with them keeps their errors: taken for new in each frame, they would make innovations
too small and the pose too sure (cf. Roumeliotis and Burdick, "Stochastic cloning", ICRA 2002). The error state (25,)
has all in that order, the rotation's on the right, R exp(dtheta), that of the drift on the left, exp(dphi) C.

Without a sensor the filter of :mod:`sfmapp.odometry.inertial.smoothing` takes its place: the camera goes on as it
moves.
"""

from __future__ import annotations

import copy
import itertools
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.gyroscope import MAX_SILENCE_S
from sfmapp.odometry.inertial.integration import ACCEL_BIAS_SIGMA, GRAVITY, GYRO_BIAS_SIGMA, integrate
from sfmapp.odometry.inertial.smoothing import (
    SmoothingOptions,
    compile_kernels,
    error_from_tangent,
    read_measured,
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
_P, _R, _V, _BG, _BA, _G, _CP, _CR = (slice(3 * k, 3 * k + 3) for k in range(8))
_S, _C = slice(24, 25), slice(18, 25)
_SIZE = 25
_ROWS = np.arange(_SIZE)
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
        scale_sigma: relative standard deviation of the unit of length of the poses; 0: they are in metres.
    """

    imu: Imu
    gravity: Array
    gravity_sigma_rad: float
    gyro_bias: Array
    accel_bias: Array
    scale_sigma: float = 0.0


class Shared(NamedTuple):
    """How the errors of poses hang together in time, as shares of their covariance.

    Attributes:
        white: what is new in each frame and gone in the next.
        walk: what is new in each frame and stays, as the map is made with it: variance added from frame to frame.
    """

    white: float
    walk: float


INDEPENDENT = Shared(1.0, 0.0)


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
    imu = sensor.imu
    found = InertialFilter(sensor, unknown_rates(measured)[0], options)
    n = 0
    for f, frame_s in enumerate(measured.times):
        while n < len(imu.timestamps_s) and imu.timestamps_s[n] <= frame_s:
            found.add_sample(float(imu.timestamps_s[n]), imu.gyro[n], imu.accel[n])
            n += 1
        found.add_frame(float(frame_s), measured.pose(f))
    return found.result()


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


class _Sample(NamedTuple):
    """What the sensor said at a moment: gyro and accel (6,)."""

    timestamp_s: float
    value: Array


class InertialFilter:
    """The filter on its way: fed with samples and poses as they come, each kind in the order of its times.

    A sample moves the state on, and is a row at once. A pose corrects the state at its own time, also where samples
    have gone on meanwhile: these are integrated anew from there.

    Args:
        sensor: its ``imu`` tells mounting and noises here, its measurements come one by one.
        speed: standard deviation of a velocity of which nothing is known, m/s.
    """

    def __init__(self, sensor: InertialSensor, speed: float, options: SmoothingOptions = LIVE) -> None:
        self._options, self._start = options, _State(sensor, speed)
        self._anchor: _State | None = None  # at the last frame, which was used or not; None: begins with the next pose
        self._head: _State | None = None  # at the newest sample
        self._anchor_s = self._head_s = self._used_s = -math.inf
        self._samples: list[_Sample] = []  # from the last one before the anchor on
        self._in_a_row, self._is_waiting, self._interval_s = 0, False, math.inf
        self._rows = list[_Row]()
        self._nis, self._is_rejected, self._frame_s = list[float](), list[bool](), list[float]()

    def add_sample(self, timestamp_s: float, gyro: Array, accel: Array) -> None:
        """Move on to a sample: rad/s and m/s^2. One that is no later than the last is left out."""
        begin = time.perf_counter()
        sample = _Sample(timestamp_s, np.concatenate([gyro, accel]))
        if self._samples and not timestamp_s > self._samples[-1].timestamp_s:
            return
        is_silent = bool(self._samples) and timestamp_s - self._samples[-1].timestamp_s > MAX_SILENCE_S
        self._samples.append(sample)
        if is_silent or timestamp_s - self._used_s > self._options.max_gap_s:
            self._stop()
        if self._head is not None and timestamp_s > self._head_s:
            self._head.predict(self._step(self._head_s, timestamp_s))
            self._head_s = timestamp_s
            is_late = timestamp_s - self._used_s > _DROPPED * self._interval_s
            self._note(self._head, timestamp_s, self._is_waiting or is_late, begin)
        elif self._head is None:
            del self._samples[:-2]

    def add_frame(
        self, timestamp_s: float, pose: tuple[Array, Array, Array] | None, shared: Shared = INDEPENDENT,
        map_moved: Array = rigid3.IDENTITY,
    ) -> None:  # fmt: skip
        """Correct by a frame, later than those before it.

        Args:
            pose: centre (3,), rotation world_from_cam (3, 3) and their covariance (6, 6); None of a frame without.
            shared: how far its error is that of the frames before.
            map_moved: (7,) a place x of the map was at map_moved(x) in the frame before: what an adjustment has changed
                is no motion, and the sensor knew nothing of it.
        """
        begin = time.perf_counter()
        self._frame_s.append(timestamp_s)
        self._nis.append(math.nan)
        self._is_rejected.append(False)
        if self._anchor is not None and not self._reaches(timestamp_s):
            self._stop()
        if self._anchor is None:
            if pose is not None:
                self._begin_at(timestamp_s, pose, shared, begin)
            return
        at_frame = self._anchor.copied()
        self._go_through(at_frame, self._anchor_s, timestamp_s)
        at_frame.move_map(map_moved)
        is_used = pose is not None and self._correct(at_frame, pose, shared)
        if is_used:
            self._interval_s = timestamp_s - self._anchor_s
            self._used_s = timestamp_s
        self._is_waiting = not is_used
        self._hold(at_frame, timestamp_s)
        self._note(at_frame, timestamp_s, not is_used, begin)

    def result(self) -> FilteredTrajectory:
        """All rows in the order of time, out of the filter's order of the error state."""
        rows = sorted(self._rows, key=lambda row: row.timestamp_s)
        times = np.array([row.timestamp_s for row in rows])
        rotation = np.array([row.rotation for row in rows]).reshape(-1, 3, 3)
        centers = np.array([row.center for row in rows]).reshape(-1, 3)
        change = np.linalg.inv(error_from_tangent(rotation))
        covariance = np.array([row.covariance for row in rows]).reshape(-1, 6, 6)
        at = {float(row.timestamp_s): k for k, row in enumerate(rows)}
        state = self._anchor or self._start
        return FilteredTrajectory(
            times, rigid3.inverse(rigid3.from_matrix(rotation, centers)),
            change @ covariance @ change.swapaxes(1, 2), np.array([row.since_pose_s for row in rows]),
            np.array([row.is_bridged for row in rows], bool),
            np.array([at.get(frame_s, -1) for frame_s in self._frame_s], np.int64), np.array(self._nis),
            np.array(self._is_rejected, bool), "imu",
            state.gyro_bias, state.accel_bias, np.array([row.latency_s for row in rows]),
        )  # fmt: skip

    def _begin_at(self, timestamp_s: float, pose: tuple[Array, Array, Array], shared: Shared, begin: float) -> None:
        state = self._start.copied()
        state.begin(pose[0], pose[1], shared.white * pose[2])
        self._used_s, self._in_a_row, self._is_waiting = timestamp_s, 0, False
        self._hold(state, timestamp_s)
        self._note(state, timestamp_s, False, begin)

    def _stop(self) -> None:
        """Begin anew with the next pose, with the biases and the gravity that are known by now."""
        if self._anchor is not None:
            self._start = self._anchor
        self._anchor = self._head = None

    def _reaches(self, timestamp_s: float) -> bool:
        """Whether there are samples all the way to a frame."""
        if timestamp_s - self._used_s > self._options.max_gap_s or len(self._samples) < 2:
            return False
        return timestamp_s - self._samples[-1].timestamp_s <= MAX_SILENCE_S

    def _hold(self, state: _State, timestamp_s: float) -> None:
        """Go on from a state at the time of a frame, and take what came since then with it."""
        self._anchor, self._anchor_s = state, timestamp_s
        before = [n for n, sample in enumerate(self._samples) if sample.timestamp_s <= timestamp_s]
        del self._samples[: max(0, len(before) - 2)]
        self._head, self._head_s = state.copied(), timestamp_s
        newest = self._samples[-1].timestamp_s if self._samples else -math.inf
        if newest > timestamp_s:
            self._go_through(self._head, timestamp_s, newest)
            self._head_s = newest

    def _go_through(self, state: _State, start_s: float, stop_s: float) -> None:
        """Move a state on by the samples in between."""
        between = [sample.timestamp_s for sample in self._samples if start_s < sample.timestamp_s < stop_s]
        for now, then in itertools.pairwise([start_s, *between, stop_s]):
            if then > now:
                state.predict(self._step(now, then))

    def _step(self, start_s: float, stop_s: float) -> Array:
        """(7,) duration and mean measurements between two moments with no sample between them."""
        return np.concatenate([[stop_s - start_s], 0.5 * (self._value(start_s) + self._value(stop_s))])

    def _value(self, timestamp_s: float) -> Array:
        """Measurements (6,) between two samples; after the newest one as the last two go on."""
        samples = self._samples
        n = min(max(1, next((k for k, s in enumerate(samples) if s.timestamp_s >= timestamp_s), len(samples))),
                len(samples) - 1)  # fmt: skip
        if n < 1:
            return samples[0].value
        (first_s, first), (second_s, second) = samples[n - 1], samples[n]
        share = min(max((timestamp_s - first_s) / (second_s - first_s), 0.0), 2.0)
        value: Array = first + share * (second - first)
        return value

    def _correct(self, state: _State, pose: tuple[Array, Array, Array], shared: Shared) -> bool:
        """By the pose of a frame, if the motion does not contradict it."""
        center, rotation, noise = pose
        state.drift(shared.walk * noise)
        noise = shared.white * noise
        innovation = state.innovation(center, rotation)
        self._nis[-1] = state.nis(innovation, noise)
        if self._nis[-1] > self._options.max_nis:
            self._in_a_row += 1
            if self._in_a_row <= self._options.max_rejected:
                self._is_rejected[-1] = True
                return False
            state.forget(innovation)
        self._in_a_row = 0
        state.correct(innovation, noise)
        return True

    def _note(self, state: _State, now: float, is_bridged: bool, begin: float) -> None:
        rotation, center, covariance = state.camera()
        spent = time.perf_counter() - begin
        self._rows.append(_Row(now, rotation, center, covariance, now - self._used_s, is_bridged, spent))


class _State:
    """Where the sensor is believed to be, how far the map has drifted below it, and how sure that is.

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
        # a place in the world is at scale turn x + shift in the map, whose unit was said to be a metre
        self._shift, self._turn, self._log_scale = np.zeros(3), np.eye(3), 0.0
        self._scale_sigma = sensor.scale_sigma
        self._p = np.zeros((_SIZE, _SIZE))
        self._p[_BG, _BG], self._p[_BA, _BA] = GYRO_BIAS_SIGMA**2 * np.eye(3), ACCEL_BIAS_SIGMA**2 * np.eye(3)
        along = np.outer(down, down)
        tilt = GRAVITY * sensor.gravity_sigma_rad
        self._p[_G, _G] = tilt**2 * (np.eye(3) - along) + _GRAVITY_SIGMA**2 * along
        self._p[_S, _S] = sensor.scale_sigma**2

    def copied(self) -> _State:
        """Another that goes its own way from here."""
        other = copy.copy(self)
        other._p, other._delta = self._p.copy(), np.empty(60)
        return other

    def begin(self, center: Array, rotation: Array, noise: Array) -> None:
        """At a pose of the camera (centre, world_from_cam and their covariance), with any velocity. The world is that
        of the map as it is now."""
        self._shift, self._turn = np.zeros(3), np.eye(3)
        self.rotation = rotation @ self._imu_from_cam.T
        self.position = center / math.exp(self._log_scale) - self.rotation @ self._arm
        self.velocity = np.zeros(3)
        known = np.r_[_BG, _BA, _G, _S]
        kept = self._p[np.ix_(known, known)]
        self._p[:] = 0.0
        self._p[np.ix_(known, known)] = kept
        # another unit of length would not move the camera from where it is
        here = self._in_map()[:, None]
        self._p[_CP], self._p[:, _CP] = -here @ self._p[_S], -self._p[:, _S] @ here.T
        self._p[_CP, _CP] = here @ self._p[_S, _S] @ here.T
        back = np.linalg.inv(self._measurement()[:, :6])
        self._p[:6, :6] = back @ noise @ back.T
        self._p[_V, _V] = self._speed**2 * np.eye(3)

    def move_map(self, moved: Array) -> None:
        """The map was put elsewhere: a place x of it was at moved(x). The camera stays."""
        back = rigid3.inverse(moved)
        turn = rigid3.rotation_matrix(back)
        self._turn, self._shift = turn @ self._turn, turn @ self._shift + back[4:]
        # the errors of the drift are along the axes of the map
        change = np.eye(_SIZE)
        change[_CP, _CP] = change[_CR, _CR] = turn
        self._p = change @ self._p @ change.T

    def drift(self, walk: Array) -> None:
        """The map errs otherwise than at the last frame, here by a covariance (6, 6) of the centre and of the rotation
        in the camera's frame; what was mapped before stays as it was."""
        in_map, rotation = self._in_map(), self._turn @ self.rotation @ self._imu_from_cam
        spread = np.zeros((7, 6))
        spread[:3, :3], spread[:3, 3:], spread[3:6, 3:] = np.eye(3), rigid3.skew(in_map) @ rotation, rotation
        grown = spread @ walk @ spread.T
        if self._scale_sigma > 0.0:
            # new points are as far wrong along their rays as across them, as a share of their depths
            size = float(np.trace(walk[3:, 3:])) / 3.0
            grown[6, 6] += size
            grown[:3, :3] += size * np.outer(in_map, in_map)
            grown[:3, 6] -= size * in_map
            grown[6, :3] -= size * in_map
        self._p[_C, _C] += grown

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
        moving = _ROWS[: _G.start]
        self._p[moving, moving] += np.repeat([accel * h * h / 3.0, gyro, accel, gyro_walk, accel_walk], 3)
        for k in range(3):
            self._p[k, 6 + k] += accel * h / 2.0
            self._p[6 + k, k] += accel * h / 2.0
        self.position = self.position + self.velocity * h + 0.5 * h * h * self._gravity + r @ moved
        self.velocity = self.velocity + h * self._gravity + r @ velocity
        self.rotation = r @ turn

    def _in_map(self) -> Array:
        """(3,) where the camera's centre is in the map, the shift left out."""
        y: Array = math.exp(self._log_scale) * self._turn @ (self.position + self.rotation @ self._arm)
        return y

    def _measurement(self) -> Array:
        """(6, 25) slopes of the camera's centre in the map and of its rotation, in its own frame."""
        h, size = np.zeros((6, _SIZE)), math.exp(self._log_scale)
        h[:3, _P], h[:3, _R] = size * self._turn, -size * self._turn @ self.rotation @ rigid3.skew(self._arm)
        h[3:, _R] = self._imu_from_cam.T
        in_map = self._in_map()
        h[:3, _CP], h[:3, _CR], h[:3, 24] = np.eye(3), -rigid3.skew(in_map), in_map
        h[3:, _CR] = (self._turn @ self.rotation @ self._imu_from_cam).T
        return h

    def camera(self) -> tuple[Array, Array, Array]:
        """Rotation world_from_cam (3, 3), centre (3,) and their covariance (6, 6)."""
        h = np.zeros((6, _SIZE))
        h[:3, _P], h[:3, _R] = np.eye(3), -self.rotation @ rigid3.skew(self._arm)
        h[3:, _R] = self._imu_from_cam.T
        center = self.position + self.rotation @ self._arm
        return self.rotation @ self._imu_from_cam, center, h @ self._p @ h.T

    def innovation(self, center: Array, rotation: Array) -> Array:
        """(6,) what a measured pose says beyond the state."""
        ours = self._turn @ self.rotation @ self._imu_from_cam
        return np.concatenate([center - self._in_map() - self._shift, rigid3.log_so3(ours.T @ rotation)])

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
        turn = rigid3.exp_so3(step[_CR])
        self._turn, self._shift = turn @ self._turn, self._shift + step[_CP]
        self._log_scale += float(step[24])

    def forget(self, innovation: Array) -> None:
        """The motion jumped: what was predicted says little about where and how fast."""
        squares = [(innovation[:3] ** 2).sum(), (innovation[3:] ** 2).sum(), self._speed**2]
        moving = _ROWS[: _BG.start]
        self._p[moving, moving] += np.repeat(squares, 3)
