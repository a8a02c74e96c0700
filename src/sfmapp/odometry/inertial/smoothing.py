"""An error-state Kalman filter over measured poses, and its smoother.

Position, orientation, velocity and turn rate; the camera goes on as it moves, disturbed by white acceleration and white
angular acceleration. Real accelerations last, so that what is white over a frame is too little over a gap: densities
are fitted to each span apart, and a gap is bridged with that of its own length. Sola, "Quaternion kinematics for the
error-state Kalman filter", arXiv 1711.02508, 2017, sections 5 and 6; Rauch, Tung and Striebel, "Maximum likelihood
estimates of linear dynamic systems", AIAA Journal 1965.

The error state is (position in the world, orientation in the camera's frame, velocity in the world, turn rate in the
camera's frame): p + dp, R exp(dtheta), v + dv, w + dw with R = R_world_from_cam.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.gyroscope import fill_turn

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# 75 % quantile of chi2 with 3 degrees of freedom. The process noise is fitted to this quantile of the changes of
# velocity: a quarter of them may be outliers, and of motion that comes in bursts it sees more than the median would.
_QUANTILE, _CHI2_3 = 0.75, 4.1083
_SIZE = 12
# Velocities start out unknown: so many times larger than those seen.
_DIFFUSE = 10.0


@dataclass(frozen=True)
class SmoothingOptions:
    """How a trajectory is filtered."""

    acceleration_noise: float | None = None  # density, map units/s^2/sqrt(Hz); None: from the measurements
    turn_noise: float | None = None  # density of the angular acceleration, rad/s^2/sqrt(Hz); None: the same
    max_gap_s: float = 1.0  # gaps up to this long are bridged
    max_nis: float = 38.3  # innovations squared over their covariance, 6 dof: 1e-6 of the good ones are rejected
    max_rejected: int = 3  # after so many in a row it is the prediction that was wrong, and the next is believed
    is_causal: bool = False  # use the past alone, as a live filter does; else the whole trajectory


@dataclass(frozen=True)
class SmoothedTrajectory:
    """A pose for every frame that is in reach of a measurement.

    Attributes:
        cam_from_world: (F, 7), NaN before the first measurement and in longer gaps.
        covariance: (F, 6, 6) over rotation (radians) and translation of ``x_cam <- exp(w) x_cam + v``, as it came in.
        is_predicted: (F,) bool: has a pose but no measurement of its own that was used.
        is_rejected: (F,) bool: the measurement disagreed with the motion and was not used.
        velocity: (F, 3) map units/s in the world. turn_rate: (F, 3) rad/s in the camera's frame.
        nis: (F,) normalised innovations squared, 6 in the mean where noise and motion are as modelled; NaN where
            there was nothing to compare.
        acceleration_noise, turn_noise: the densities used from frame to frame, as in the options; over gaps they are
            larger where the motion is not white.
    """

    cam_from_world: Array
    covariance: Array
    is_predicted: Bools
    is_rejected: Bools
    velocity: Array
    turn_rate: Array
    nis: Array
    acceleration_noise: float
    turn_noise: float

    def at(self, rows: NDArray[np.int64]) -> SmoothedTrajectory:
        """The same of the frames at other positions, some of them more than once."""
        return SmoothedTrajectory(
            self.cam_from_world[rows], self.covariance[rows], self.is_predicted[rows], self.is_rejected[rows],
            self.velocity[rows], self.turn_rate[rows], self.nis[rows], self.acceleration_noise, self.turn_noise,
        )  # fmt: skip


def smooth_trajectory(
    timestamps_s: ArrayLike,
    cam_from_world: ArrayLike,
    covariance: ArrayLike,
    options: SmoothingOptions = SmoothingOptions(),
) -> SmoothedTrajectory:
    """Filter measured poses, bridge short gaps, and smooth over past and future.

    Args:
        timestamps_s: (F,) strictly ascending.
        cam_from_world: (F, 7) in one world; NaN in gaps.
        covariance: (F, 6, 6) as :func:`~sfmapp.adjust.pose.refine_pose` gives it; a pose whose covariance is not
            finite and positive counts as a gap.

    Raises:
        ValueError: times that do not ascend.
    """
    poses_in = read_measured(timestamps_s, cam_from_world, covariance)
    speed, turn = unknown_rates(poses_in)
    motion = _Motion(*_process_noises(poses_in, options), speed, turn, options.max_nis, options.max_rejected)
    found = _Filtered.of_length(len(poses_in.times))
    for start, stop in segments(poses_in, options.max_gap_s):
        part = slice(start, stop)
        _filter(poses_in.part(part), motion, found.part(part))
        if not options.is_causal:
            _smooth(poses_in.times[part], found.predicted_states[part], found.predicted[part], found.states[part],
                    found.covariances[part])  # fmt: skip
    return _trajectory(poses_in, found, motion)


class MeasuredPoses(NamedTuple):
    """Poses (F) as the filter reads them.

    Attributes:
        times: (F,) seconds.
        position: (F, 3), rotation: (F, 3, 3) world_from_cam, noise: (F, 6, 6) covariance in the order of the error
            state; zeros and identity in gaps.
        is_there: (F,) bool, not in gaps.
    """

    times: Array
    position: Array
    rotation: Array
    noise: Array
    is_there: Bools

    def pose(self, row: int) -> tuple[Array, Array, Array] | None:
        """Position, rotation and noise of a frame; None in a gap."""
        return (self.position[row], self.rotation[row], self.noise[row]) if self.is_there[row] else None

    def part(self, rows: slice) -> MeasuredPoses:
        return MeasuredPoses(
            self.times[rows], self.position[rows], self.rotation[rows], self.noise[rows], self.is_there[rows]
        )


class _Motion(NamedTuple):
    """What the filter expects of the motion.

    Attributes:
        spans: (M,) ascending seconds. q_position, q_rotation: (M,) power densities of acceleration and angular
            acceleration over as long a time without a measurement; they do not descend.
        speed, turn_rate: standard deviations of what nothing is known of.
        max_nis, max_rejected: see :class:`SmoothingOptions`.
    """

    spans: Array
    q_position: Array
    q_rotation: Array
    speed: float
    turn_rate: float
    max_nis: float
    max_rejected: int


class _Filtered(NamedTuple):
    """What the filter finds.

    Attributes:
        predicted_states, states: (F, 18) before and after the measurement of a frame.
        predicted, covariances: (F, 12, 12) theirs.
        nis: (F,), rejected: (F,) bool, see :class:`SmoothedTrajectory`.
    """

    predicted_states: Array
    predicted: Array
    states: Array
    covariances: Array
    nis: Array
    rejected: Bools

    @staticmethod
    def of_length(num: int) -> _Filtered:
        return _Filtered(
            np.full((num, 18), np.nan), np.full((num, _SIZE, _SIZE), np.nan), np.full((num, 18), np.nan),
            np.full((num, _SIZE, _SIZE), np.nan), np.full(num, np.nan), np.zeros(num, bool),
        )  # fmt: skip

    def part(self, rows: slice) -> _Filtered:
        """Views of some of the frames."""
        return _Filtered(
            self.predicted_states[rows], self.predicted[rows], self.states[rows], self.covariances[rows],
            self.nis[rows], self.rejected[rows],
        )  # fmt: skip


def read_measured(timestamps_s: ArrayLike, cam_from_world: ArrayLike, covariance: ArrayLike) -> MeasuredPoses:
    """Poses as a filter reads them; arguments and errors as of :func:`smooth_trajectory`."""
    times = np.ascontiguousarray(timestamps_s, np.float64)
    poses, covariances = np.asarray(cam_from_world, np.float64), np.asarray(covariance, np.float64)
    if len(times) > 1 and not (np.diff(times) > 0).all():
        raise ValueError("the times of a trajectory must ascend strictly")
    measured: Bools = np.asarray(np.isfinite(poses).all(1) & np.isfinite(covariances).all((1, 2)), bool)
    measured[measured] = np.linalg.eigvalsh(covariances[measured])[:, 0] > 0
    num = len(poses)
    position, rotation, noise = np.zeros((num, 3)), np.tile(np.eye(3), (num, 1, 1)), np.zeros((num, 6, 6))
    position[measured] = rigid3.center(poses[measured])
    rotation[measured] = rigid3.rotation_matrix(poses[measured]).swapaxes(1, 2)
    # x_cam <- exp(w) x_cam + v turns R_world_from_cam by exp(-w) on the right and moves the centre by -R v
    change = error_from_tangent(rotation[measured])
    noise[measured] = change @ covariances[measured] @ change.swapaxes(1, 2)
    return MeasuredPoses(times, position, rotation, noise, measured)


def error_from_tangent(rotation: Array) -> Array:
    """(N, 6, 6): (position in the world, orientation in the camera) of (w, v), for R_world_from_cam (N, 3, 3)."""
    change = np.zeros((len(rotation), 6, 6))
    change[:, :3, 3:], change[:, 3:, :3] = -rotation, -np.eye(3)
    return change


def segments(measured: MeasuredPoses, max_gap_s: float) -> list[tuple[int, int]]:
    """Runs of frames [start, stop) that are filtered together: no gap in them is longer than allowed."""
    times, index = measured.times, np.flatnonzero(measured.is_there)
    if not len(index):
        return []
    breaks = np.flatnonzero(np.diff(times[index]) > max_gap_s)
    starts, lasts = index[np.r_[0, breaks + 1]], index[np.r_[breaks, len(index) - 1]]
    stops = lasts + 1
    if times[-1] - times[index[-1]] <= max_gap_s:
        stops[-1] = len(times)
    return [(int(a), int(b)) for a, b in zip(starts, stops, strict=True)]


def unknown_rates(measured: MeasuredPoses) -> tuple[float, float]:
    """Standard deviations of speeds and turn rates of which nothing is known: several times those between measurements,
    never zero."""
    index = np.flatnonzero(measured.is_there)
    if len(index) < 2:
        return _DIFFUSE, _DIFFUSE
    dt = np.diff(measured.times[index])
    speed = np.linalg.norm(np.diff(measured.position[index], axis=0), axis=1) / dt
    turn = np.linalg.norm(_turns(measured.rotation, index[:-1], index[1:]), axis=1) / dt
    tiny = 1e-12
    return _DIFFUSE * float(np.sqrt((speed**2).mean())) + tiny, _DIFFUSE * float(np.sqrt((turn**2).mean())) + tiny


def _turns(rotation: Array, first: NDArray[np.int64], second: NDArray[np.int64]) -> Array:
    return rigid3.log_so3(rotation[first].swapaxes(1, 2) @ rotation[second])


def _process_noises(measured: MeasuredPoses, options: SmoothingOptions) -> tuple[Array, Array, Array]:
    """Spans, and power densities (squares of the options' noises) of acceleration and angular acceleration."""
    position, rotation, index = measured.position, measured.rotation, np.flatnonzero(measured.is_there)
    times, lags = measured.times[index], _lags(len(index))
    spans = np.array([np.median(times[lag:] - times[:-lag]) for lag in lags]) if len(index) > 1 else np.ones(1)
    q: list[Array] = []
    for given, is_rotation in ((options.acceleration_noise, False), (options.turn_noise, True)):
        if given is not None:
            q.append(np.full(len(lags), given**2))
            continue
        own = slice(3, 6) if is_rotation else slice(0, 3)
        variance = np.trace(measured.noise[index, own, own], axis1=1, axis2=2) / 3.0

        def moves(first: NDArray[np.int64], second: NDArray[np.int64], turning: bool = is_rotation) -> Array:
            i, j = index[first], index[second]
            return _turns(rotation, i, j) if turning else position[j] - position[i]

        q.append(_fit_densities(times, variance, moves, lags))
    return spans, q[0], q[1]


def _lags(num: int) -> list[int]:
    """Over how many measurements motion is looked at, twice as many each time, while there are enough spans of them."""
    lags = [1]
    while num // (2 * lags[-1]) >= 8:
        lags.append(2 * lags[-1])
    return lags


def _fit_densities(
    times: Array, variance: Array, moves: Callable[[NDArray[np.int64], NDArray[np.int64]], Array], lags: list[int]
) -> Array:
    """Power densities (M,) of the white acceleration that explains how mean velocities change, by span.

    Mean velocities over two adjacent spans dt1 and dt2 differ by a variance of q (dt1 + dt2) / 3 beside the noise of
    the three measurements. From frame to frame the shortest span at which the motion outweighs the noise is believed.
    Acceleration that lasts adds up to more over longer spans, so the largest of all shorter ones counts.
    """
    num, found = len(times), np.full(len(lags), np.nan)
    floor, is_told = 1e-12, False
    for n, lag in enumerate(lags):
        if 2 * lag >= num:
            break
        first = np.arange(num - 2 * lag)
        second, third = first + lag, first + 2 * lag
        dt1, dt2 = times[second] - times[first], times[third] - times[second]
        change2 = ((moves(second, third) / dt2[:, None] - moves(first, second) / dt1[:, None]) ** 2).sum(1)
        blur = variance[first] / dt1**2 + variance[third] / dt2**2 + variance[second] * (1 / dt1 + 1 / dt2) ** 2
        gain = (dt1 + dt2) / 3.0
        floor = max(1e-4 * float(np.median(blur / gain)), 1e-300)
        q = _match_quantile(change2, blur, gain, floor)
        if not is_told:  # what shorter spans say is noise
            is_told = q * float(np.median(gain)) > float(np.median(blur))
            found[:n] = np.nan
        found[n] = q
    known = np.flatnonzero(np.isfinite(found))
    if not len(known):
        return np.full(len(lags), floor)
    filled = found[np.maximum(np.minimum(np.arange(len(lags)), known[-1]), known[0])]
    return np.maximum(np.maximum.accumulate(filled), floor)


def _match_quantile(change2: Array, blur: Array, gain: Array, floor: float) -> float:
    """The q at which the quantile of change2 / (q gain + blur) is that of chi2 with 3 dof, at least floor."""
    low, high = math.log(floor), math.log(max(float((change2 / gain).max()), 2.0 * floor))
    if np.quantile(change2 / (floor * gain + blur), _QUANTILE) <= _CHI2_3:
        return floor
    for _ in range(40):
        middle = 0.5 * (low + high)
        if np.quantile(change2 / (math.exp(middle) * gain + blur), _QUANTILE) > _CHI2_3:
            low = middle
        else:
            high = middle
    return math.exp(0.5 * (low + high))


def _trajectory(measured: MeasuredPoses, found: _Filtered, motion: _Motion) -> SmoothedTrajectory:
    """Out of the filter's arrays and its order of the error state."""
    states, num = found.states, len(found.states)
    cam_from_world, out = np.full((num, 7), np.nan), np.full((num, 6, 6), np.nan)
    has_pose = np.isfinite(states[:, 0])
    rotation = states[has_pose, 3:12].reshape(-1, 3, 3)
    cam_from_world[has_pose] = rigid3.inverse(rigid3.from_matrix(rotation, states[has_pose, :3]))
    change = np.linalg.inv(error_from_tangent(rotation))
    out[has_pose] = change @ found.covariances[has_pose, :6, :6] @ change.swapaxes(1, 2)
    is_predicted = has_pose & ~(measured.is_there & ~found.rejected)
    return SmoothedTrajectory(
        cam_from_world, out, is_predicted, found.rejected, states[:, 12:15].copy(), states[:, 15:].copy(), found.nis,
        math.sqrt(motion.q_position[0]), math.sqrt(motion.q_rotation[0]),
    )  # fmt: skip


# ---- kernels. A state is a row (18,): position, rotation row by row, velocity, turn rate.


class _Scratch(NamedTuple):
    """Room for matrices of the filter.

    Attributes:
        phi, product, factor, keep: (12, 12). gain: (12, 6). turn, slope: (3, 3).
    """

    phi: Array
    product: Array
    factor: Array
    keep: Array
    gain: Array
    turn: Array
    slope: Array


@numba.njit(cache=True, nogil=True)
def _cholesky(a: Array, factor: Array, n: int) -> bool:
    """Lower factor of the leading (n, n) block; False if it is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@numba.njit(cache=True, nogil=True)
def _solve_rows(factor: Array, n: int, b: Array, rows: int) -> None:
    """b <- b A^-1 in place for the first n columns of so many rows, A = L L^T symmetric."""
    for r in range(rows):
        for i in range(n):
            total = b[r, i]
            for k in range(i):
                total -= factor[i, k] * b[r, k]
            b[r, i] = total / factor[i, i]
        for i in range(n - 1, -1, -1):
            total = b[r, i]
            for k in range(i + 1, n):
                total -= factor[k, i] * b[r, k]
            b[r, i] = total / factor[i, i]


@numba.njit(cache=True, nogil=True)
def _rotation_of(wx: float, wy: float, wz: float, out: Array, slope: Array) -> None:
    """exp(w) and its right Jacobian (Sola 2017, equation 183), both (3, 3)."""
    angle2 = wx * wx + wy * wy + wz * wz
    angle = math.sqrt(angle2)
    if angle > 1e-5:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    else:
        a, b, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    fill_turn((wx, wy, wz), (a, b, c), out, slope)


@numba.njit(cache=True, nogil=True)
def _log_relative(r: Array, s: Array, out: Array) -> None:
    """Rotation vector of R^T S for rows (9,) of matrices."""
    m = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            m[i, j] = r[i] * s[j] + r[3 + i] * s[3 + j] + r[6 + i] * s[6 + j]
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    sine2 = math.sqrt(x * x + y * y + z * z)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    angle = math.atan2(sine2, trace - 1.0)
    if trace < -0.99:
        # near half a turn the difference of the sides vanishes: the axis is the largest column of R^T S + 1
        k = 0
        for i in range(1, 3):
            k = i if m[i, i] > m[k, k] else k
        norm = math.sqrt((m[0, k] + (k == 0)) ** 2 + (m[1, k] + (k == 1)) ** 2 + (m[2, k] + (k == 2)) ** 2)
        sign = -1.0 if (x, y, z)[k] < 0.0 else 1.0
        for i in range(3):
            out[i] = sign * angle * (m[i, k] + (i == k)) / norm
        return
    factor = angle / sine2 if sine2 > 1e-9 else 0.5
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@numba.njit(cache=True, nogil=True)
def _move(state: Array, step: Array, turn: Array, slope: Array, out: Array) -> None:
    """out <- state + error state (12,)."""
    _rotation_of(step[3], step[4], step[5], turn, slope)
    for i in range(3):
        out[i] = state[i] + step[i]
        out[12 + i] = state[12 + i] + step[6 + i]
        out[15 + i] = state[15 + i] + step[9 + i]
    for i in range(3):
        a, b, c = state[3 + 3 * i], state[4 + 3 * i], state[5 + 3 * i]
        for j in range(3):
            out[3 + 3 * i + j] = a * turn[0, j] + b * turn[1, j] + c * turn[2, j]


@numba.njit(cache=True, nogil=True)
def _transition(state: Array, dt: float, turn: Array, slope: Array, phi: Array) -> None:
    """Linearised motion (12, 12) over dt (Sola 2017, section 5.4)."""
    phi[:] = 0.0
    _rotation_of(state[15] * dt, state[16] * dt, state[17] * dt, turn, slope)
    for i in range(3):
        phi[i, i] = phi[6 + i, 6 + i] = phi[9 + i, 9 + i] = 1.0
        phi[i, 6 + i] = dt
        for j in range(3):
            phi[3 + i, 3 + j] = turn[j, i]
            phi[3 + i, 9 + j] = slope[i, j] * dt


@numba.njit(cache=True, nogil=True)
def _sandwich(phi: Array, p: Array, scratch: Array, out: Array) -> None:
    """out <- phi P phi^T, symmetric."""
    n = phi.shape[0]
    for i in range(n):
        for j in range(n):
            scratch[i, j] = 0.0
        for k in range(n):
            if phi[i, k] != 0.0:
                for j in range(n):
                    scratch[i, j] += phi[i, k] * p[k, j]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += scratch[i, k] * phi[j, k]
            out[i, j] = out[j, i] = total


@numba.njit(cache=True, nogil=True)
def _add_process_noise(p: Array, dt: float, q_position: float, q_rotation: float) -> None:
    for i in range(6):
        q = q_position if i < 3 else q_rotation
        p[i, i] += q * dt * dt * dt / 3.0
        p[i, 6 + i] += q * dt * dt / 2.0
        p[6 + i, i] += q * dt * dt / 2.0
        p[6 + i, 6 + i] += q * dt


@numba.njit(cache=True, nogil=True)
def _update(
    state: Array, p: Array, innovation: Array, noise: Array, scratch: _Scratch, out_state: Array, out: Array
) -> None:
    """Kalman update in Joseph's form; the factor of the scratch is Cholesky's of the innovation's covariance."""
    gain, keep, product, step = scratch.gain, scratch.keep, scratch.product, np.zeros(12)
    for i in range(12):
        for j in range(6):
            gain[i, j] = p[i, j]
    _solve_rows(scratch.factor, 6, gain, 12)
    keep[:] = 0.0
    for i in range(12):
        keep[i, i] = 1.0
        for j in range(6):
            keep[i, j] -= gain[i, j]
            step[i] += gain[i, j] * innovation[j]
    _sandwich(keep, p, product, out)
    for i in range(12):
        for j in range(6):
            product[i, j] = 0.0
            for k in range(6):
                product[i, j] += gain[i, k] * noise[k, j]
    for i in range(12):
        for j in range(12):
            for k in range(6):
                out[i, j] += product[i, k] * gain[j, k]
    _move(state, step, scratch.turn, scratch.slope, out_state)


@numba.njit(cache=True, nogil=True)
def _begin(
    position: Array, rotation: Array, noise: Array, speed: float, turn_rate: float, state: Array, p: Array
) -> None:
    """The first pose as measured, at rest as far as one knows."""
    state[:] = 0.0
    p[:] = 0.0
    p[:6, :6] = noise
    state[:3] = position
    for i in range(3):
        state[3 + 3 * i : 6 + 3 * i] = rotation[i]
        p[6 + i, 6 + i], p[9 + i, 9 + i] = speed * speed, turn_rate * turn_rate


@numba.njit(cache=True, nogil=True)
def _density(spans: Array, densities: Array, since: float) -> float:
    """That of the time since a measurement, between those of the spans."""
    if since <= spans[0]:
        return float(densities[0])
    for n in range(1, len(spans)):
        if since <= spans[n]:
            share = (since - spans[n - 1]) / (spans[n] - spans[n - 1])
            return float((1.0 - share) * densities[n - 1] + share * densities[n])
    return float(densities[-1])


@numba.njit(cache=True, nogil=True)
def _predict(
    before: Array, p_before: Array, dt: float, since: float, motion: _Motion, scratch: _Scratch, state: Array, p: Array
) -> None:
    """On by dt, to a time since the last measurement that was used."""
    step = np.zeros(12)
    for i in range(3):
        step[i], step[3 + i] = before[12 + i] * dt, before[15 + i] * dt
    _move(before, step, scratch.turn, scratch.slope, state)
    _transition(before, dt, scratch.turn, scratch.slope, scratch.phi)
    _sandwich(scratch.phi, p_before, scratch.product, p)
    # what longer spans bring in more, they bring in from the last measurement on
    now, then = _density(motion.spans, motion.q_position, since), _density(motion.spans, motion.q_position, since - dt)
    turning = _density(motion.spans, motion.q_rotation, since)
    turned = _density(motion.spans, motion.q_rotation, since - dt)
    _add_process_noise(p, dt, then, turned)
    _add_process_noise(p, since, now - then, turning - turned)


@numba.njit(cache=True, nogil=True)
def _normalize(p: Array, noise: Array, innovation: Array, s: Array, factor: Array, whitened: Array) -> float:
    """Factorise the innovation's covariance; its normalised square, infinite if there is no factor."""
    for i in range(6):
        whitened[0, i] = innovation[i]
        for j in range(6):
            s[i, j] = p[i, j] + noise[i, j]
    if not _cholesky(s, factor, 6):
        return math.inf
    _solve_rows(factor, 6, whitened, 1)
    value = 0.0
    for i in range(6):
        value += whitened[0, i] * innovation[i]
    return value


@numba.njit(cache=True, nogil=True)
def _forget(p: Array, innovation: Array, speed: float, turn_rate: float) -> None:
    """The motion jumped: what was predicted says little about where and how fast."""
    for i in range(3):
        for k in range(3):
            p[i, i] += innovation[k] * innovation[k]
            p[3 + i, 3 + i] += innovation[3 + k] * innovation[3 + k]
        p[6 + i, 6 + i] += speed * speed
        p[9 + i, 9 + i] += turn_rate * turn_rate


@numba.njit(cache=True, nogil=True)
def _filter(measured: MeasuredPoses, motion: _Motion, found: _Filtered) -> None:
    """Fill what is found; the first frame is measured."""
    scratch = _Scratch(
        np.empty((12, 12)), np.empty((12, 12)), np.empty((12, 12)), np.empty((12, 12)), np.empty((12, 6)),
        np.empty((3, 3)), np.empty((3, 3)),
    )  # fmt: skip
    s, innovation, whitened = np.empty((6, 6)), np.empty(6), np.empty((1, 6))
    position, rotation, noise, times = measured.position, measured.rotation, measured.noise, measured.times
    states, covariances = found.states, found.covariances
    _begin(position[0], rotation[0], noise[0], motion.speed, motion.turn_rate, states[0], covariances[0])
    found.predicted_states[0], found.predicted[0] = states[0], covariances[0]
    in_a_row, last_s = 0, times[0]
    for f in range(1, len(times)):
        state, p = found.predicted_states[f], found.predicted[f]
        dt = times[f] - times[f - 1]
        _predict(states[f - 1], covariances[f - 1], dt, times[f] - last_s, motion, scratch, state, p)
        states[f], covariances[f] = state, p
        if not measured.is_there[f]:
            continue
        for i in range(3):
            innovation[i] = position[f, i] - state[i]
        _log_relative(state[3:12], rotation[f].ravel(), innovation[3:])
        found.nis[f] = _normalize(p, noise[f], innovation, s, scratch.factor, whitened)
        if found.nis[f] > motion.max_nis:
            in_a_row += 1
            if in_a_row <= motion.max_rejected:
                found.rejected[f] = True
                continue
            _forget(p, innovation, motion.speed, motion.turn_rate)
            _normalize(p, noise[f], innovation, s, scratch.factor, whitened)
        in_a_row, last_s = 0, times[f]
        _update(state, p, innovation, noise[f], scratch, states[f], covariances[f])


@numba.njit(cache=True, nogil=True)
def _smooth(times: Array, predicted_states: Array, predicted: Array, states: Array, covariances: Array) -> None:
    """Rauch, Tung and Striebel's backward pass, in place over the updated states and covariances."""
    phi, scratch, factor = np.empty((12, 12)), np.empty((12, 12)), np.empty((12, 12))
    gain, change, out = np.empty((12, 12)), np.empty((12, 12)), np.empty((12, 12))
    turn, slope, away, step, moved = np.empty((3, 3)), np.empty((3, 3)), np.empty(12), np.empty(12), np.empty(18)
    for f in range(len(times) - 2, -1, -1):
        _transition(states[f], times[f + 1] - times[f], turn, slope, phi)
        if not _cholesky(predicted[f + 1], factor, 12):
            continue
        for i in range(12):
            for j in range(12):
                total = 0.0
                for k in range(12):
                    total += covariances[f, i, k] * phi[j, k]
                gain[i, j] = total
        _solve_rows(factor, 12, gain, 12)
        after, expected = states[f + 1], predicted_states[f + 1]
        for i in range(3):
            away[i] = after[i] - expected[i]
            away[6 + i] = after[12 + i] - expected[12 + i]
            away[9 + i] = after[15 + i] - expected[15 + i]
        _log_relative(expected[3:12], after[3:12], away[3:6])
        for i in range(12):
            step[i] = 0.0
            for j in range(12):
                step[i] += gain[i, j] * away[j]
                change[i, j] = covariances[f + 1, i, j] - predicted[f + 1, i, j]
        _move(states[f], step, turn, slope, moved)
        states[f] = moved
        _sandwich(gain, change, scratch, out)
        for i in range(12):
            for j in range(12):
                covariances[f, i, j] += out[i, j]


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    smooth_trajectory(np.arange(3.0), np.tile(rigid3.IDENTITY, (3, 1)), np.tile(np.eye(6), (3, 1, 1)))
