"""Inertial measurements between poses of a map, integrated once, and a first scale, vertical and biases from them.

Between two keyframes the measurements are integrated once (Forster, Carlone, Dellaert and Scaramuzza, "On-manifold
preintegration for real-time visual-inertial odometry", T-RO 2017). The gyroscope's bias comes from the rotations;
scale, gravity and the accelerometer's bias from a linear system without velocities (Mur-Artal and Tardos,
"Visual-inertial monocular SLAM with map reuse", RA-L 2017; Martinelli, "Closed-form solution of visual-inertial
structure from motion", IJCV 2014).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.gyroscope import Turns, imu_steps, multiply, turn_by
from sfmapp.simd.copying import copy_into

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GRAVITY = 9.81
# Mean velocities over about a second are compared to start with: accelerations have shown in the positions by then.
_SPAN_S = 1.0
# What biases of small sensors may reasonably be, as standard deviations of their priors.
GYRO_BIAS_SIGMA, ACCEL_BIAS_SIGMA = 0.1, 0.3


@dataclass(frozen=True)
class InertialOptions:
    """How a map is aligned with its inertial measurements."""

    min_interval_s: float = 0.05  # poses closer in time than this to the one before are left out
    max_interval_s: float = 2.0  # over longer intervals nothing is integrated
    max_poses: int = 400  # of more poses fewer are taken, evenly in time as long as the intervals allow
    min_intervals: int = 10  # fewer say nothing reliable
    max_sigma_relative: float = 0.1  # a less certain scale is refused
    # chi2 a degree of freedom: noise of the map and the sensor that is twice what is stated leaves 4; a gravity that is
    # missing, an axis or a sign left 37 to 660 on rendered flights
    max_residual: float = 5.0
    max_rotation_residual: float = 0.25  # share of the rotations that the gyroscope may contradict (at least 1 degree)


@dataclass(frozen=True)
class Interval:
    """Measurements integrated from pose first to pose second: steps (n, 7) of duration, gyro, accel, and their result.

    delta is (60,): rotation (9) row by row, velocity (3), position (3), their slopes by the biases: rotation by gyro,
    velocity by gyro and accel, position by gyro and accel, (9) each.
    """

    first: int
    second: int
    steps: Array
    delta: Array

    @property
    def duration(self) -> float:
        return float(self.steps[:, 0].sum())

    @property
    def rotation(self) -> Array:
        return self.delta[:9].reshape(3, 3)

    def slope(self, n: int) -> Array:
        """Slopes in the order above, n from 0 to 4."""
        return self.delta[15 + 9 * n : 24 + 9 * n].reshape(3, 3)


def turns_of(times: Array, poses: Array, chosen: Ints, max_interval_s: float) -> Turns:
    """The rotations between neighbours of the chosen poses."""
    first, second = chosen[:-1], chosen[1:]
    near = times[second] - times[first] <= max_interval_s
    first, second = first[near], second[near]
    rotation = rigid3.rotation_matrix(poses)
    return Turns(times[first], times[second], rotation[first] @ rotation[second].swapaxes(1, 2))


def choose_poses(times: Array, poses: Array, options: InertialOptions) -> Ints:
    """Positions of poses that exist and are far enough apart in time."""
    known = np.flatnonzero(np.isfinite(poses).all(1))
    duration = float(np.ptp(times[known])) if len(known) else 0.0
    apart = max(options.min_interval_s, min(duration / options.max_poses, 0.5 * options.max_interval_s))
    chosen: list[int] = []
    for k in known:
        # times in floating point: ten thousandths of an interval do not count
        if not chosen or times[k] - times[chosen[-1]] >= 0.9999 * apart:
            chosen.append(int(k))
    return np.array(chosen, np.int64)


def map_from_imu_rotation(poses: Array, imu: Imu) -> Array:
    """(K, 3, 3)."""
    turned: Array = rigid3.rotation_matrix(poses).swapaxes(1, 2) @ rigid3.rotation_matrix(imu.imu_from_cam).T
    return turned


# ---- integration


@numba.njit(cache=True, nogil=True)
def integrate(steps: Array, gyro_bias: Array, out: Array) -> None:
    """Fill out (60,), see Interval (Forster et al. 2017, equations 33 and 44, and the appendix for the slopes)."""
    turn, new, step, slope = np.eye(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    half, cross, lean, a = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3)), np.empty(3)
    velocity, position = np.zeros(3), np.zeros(3)
    r_g, v_g, v_a, p_g, p_a = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for n in range(steps.shape[0]):
        h = steps[n, 0]
        wx, wy, wz = steps[n, 1] - gyro_bias[0], steps[n, 2] - gyro_bias[1], steps[n, 3] - gyro_bias[2]
        # the mean force of a step acts in the orientation of its middle
        turn_by(0.5 * wx * h, 0.5 * wy * h, 0.5 * wz * h, step, slope)
        multiply(turn, step, half)
        for i in range(3):
            a[i] = half[i, 0] * steps[n, 4] + half[i, 1] * steps[n, 5] + half[i, 2] * steps[n, 6]
        cross[0, 1], cross[0, 2], cross[1, 2] = -steps[n, 6], steps[n, 5], -steps[n, 4]
        cross[1, 0], cross[2, 0], cross[2, 1] = steps[n, 6], -steps[n, 5], steps[n, 4]
        multiply(half, cross, new)
        multiply(new, r_g, lean)
        for i in range(3):
            position[i] += velocity[i] * h + 0.5 * a[i] * h * h
            velocity[i] += a[i] * h
            for j in range(3):
                p_g[i, j] += v_g[i, j] * h - 0.5 * lean[i, j] * h * h
                p_a[i, j] += v_a[i, j] * h - 0.5 * half[i, j] * h * h
                v_g[i, j] -= lean[i, j] * h
                v_a[i, j] -= half[i, j] * h
        turn_by(wx * h, wy * h, wz * h, step, slope)
        multiply(turn, step, new)
        copy_into(turn, new)
        for i in range(3):
            for j in range(3):
                new[i, j] = step[0, i] * r_g[0, j] + step[1, i] * r_g[1, j] + step[2, i] * r_g[2, j] - slope[i, j] * h
        copy_into(r_g, new)
    for i in range(3):
        out[9 + i], out[12 + i] = velocity[i], position[i]
        for j in range(3):
            k = 3 * i + j
            out[k], out[15 + k], out[24 + k] = turn[i, j], r_g[i, j], v_g[i, j]
            out[33 + k], out[42 + k], out[51 + k] = v_a[i, j], p_g[i, j], p_a[i, j]


def reintegrate(interval: Interval, gyro_bias: Array) -> Interval:
    """The same with another bias (3,) taken off the gyroscope."""
    delta = np.empty(60)
    integrate(interval.steps, gyro_bias, delta)
    return Interval(interval.first, interval.second, interval.steps, delta)


def intervals_between(times: Array, chosen: Ints, imu: Imu, max_interval_s: float) -> list[Interval]:
    """Between neighbouring poses, where the measurements cover the time."""
    out = []
    for first, second in itertools.pairwise(chosen):
        steps = imu_steps(imu, times[first], times[second]) if times[second] - times[first] <= max_interval_s else None
        if steps is not None:
            out.append(reintegrate(Interval(int(first), int(second), steps, np.empty(60)), np.zeros(3)))
    return out


# ---- the start


def gyro_bias_of(intervals: list[Interval], map_from_imu: Array) -> tuple[Array, float, float]:
    """Bias (3,), robust rms of what it leaves of the rotations and rms of the rotations, radians an interval."""
    bias = np.zeros(3)
    first, second = np.array([(i.first, i.second) for i in intervals]).T
    seen = map_from_imu[first].swapaxes(1, 2) @ map_from_imu[second]
    for _ in range(4):
        intervals = [reintegrate(interval, bias) for interval in intervals]
        left = rigid3.log_so3(np.stack([i.rotation for i in intervals]).swapaxes(1, 2) @ seen)
        slopes = np.stack([i.slope(0) for i in intervals])
        scale = float(np.median(np.linalg.norm(left, axis=1))) + 1e-12
        weight = 1.0 / (1.0 + (left**2).sum(1) / (2.0 * scale) ** 2)
        normal = np.einsum("n,nki,nkj->ij", weight, slopes, slopes)
        bias = bias + np.linalg.solve(normal, np.einsum("n,nki,nk->i", weight, slopes, left))
    # of three normal components the median of the squared length is 2.366 variances
    residual = float(np.sqrt(np.median((left**2).sum(1)) * 3.0 / 2.366))
    return bias, residual, float(np.sqrt((rigid3.log_so3(seen) ** 2).sum(1).mean()))


@dataclass(frozen=True)
class LinearStart:
    """Map units per metre, gravity (3,) m/s^2 in the map's axes, accel bias, noise of a map position in map units."""

    inverse_scale: float
    gravity: Array
    accel_bias: Array
    position_sigma: float
    condition: float


def solve_linear(
    intervals: list[Interval], gyro_bias: Array, poses: Array, imu: Imu, *, is_metric: bool
) -> LinearStart:
    """Scale, gravity and accelerometer bias from mean velocities over neighbouring intervals."""
    system = _linear_system(intervals, gyro_bias, poses, imu)
    if system is None:
        return LinearStart(0.0, np.zeros(3), np.zeros(3), np.nan, np.inf)
    return constrain(*system, is_metric)


def _linear_system(intervals: list[Interval], gyro_bias: Array, poses: Array, imu: Imu) -> tuple[Array, Array] | None:
    """Design (N, 3, 7) and target (N, 3) of :func:`constrain`; None of too few.

    With rho = 1 / scale the change of the camera's mean velocity in map units is
    rho (what was integrated, less what the lever arm moved) + rho g (dt1 + dt2) / 2 + rho (slopes) bias:
    the noisy positions stand alone on one side, so that noise does not shrink the scale.
    """
    pairs = _long_pairs(intervals, gyro_bias)
    centers, map_from_imu = rigid3.center(poses), map_from_imu_rotation(poses, imu)
    lever = np.einsum("kij,j->ki", rigid3.rotation_matrix(poses).swapaxes(1, 2), rigid3.inverse(imu.imu_from_cam)[4:])
    rows, left, blur = [], [], []
    for a, b in pairs:
        dt1, dt2 = a.duration, b.duration
        r1, r2 = map_from_imu[a.first], map_from_imu[b.first]
        index = [a.first, a.second, b.second]
        felt = r1 @ (a.delta[9:12] - a.delta[12:15] / dt1) + r2 @ b.delta[12:15] / dt2
        by_bias = r1 @ (a.slope(2) - a.slope(4) / dt1) + r2 @ b.slope(4) / dt2
        of_lever = _velocity_change(lever[index], dt1, dt2)
        rows.append(np.column_stack([felt - of_lever, 0.5 * (dt1 + dt2) * np.eye(3), by_bias]))
        left.append(_velocity_change(centers[index], dt1, dt2))
        blur.append(np.sqrt(1 / dt1**2 + 1 / dt2**2 + (1 / dt1 + 1 / dt2) ** 2))
    if len(pairs) < 4:
        return None
    weight = 1.0 / np.array(blur)
    return np.array(rows) * weight[:, None, None], np.array(left) * weight[:, None]


def linear_system(
    times: Array, poses: Array, imu: Imu, gyro_bias: Array, options: InertialOptions
) -> tuple[Array, Array] | None:
    """The same from poses (K, 7), NaN where there is none, at times (K,)."""
    chosen = choose_poses(times, poses, options)
    intervals = [reintegrate(i, gyro_bias) for i in intervals_between(times, chosen, imu, options.max_interval_s)]
    return _linear_system(intervals, gyro_bias, poses, imu)


def _long_pairs(intervals: list[Interval], gyro_bias: Array) -> list[tuple[Interval, Interval]]:
    """Neighbouring spans of about a second, from every pose: what motion adds grows with the span, noise does not."""
    spans: dict[int, Interval] = {}
    for n, start in enumerate(intervals):
        joined, duration = [start], start.duration
        for after in intervals[n + 1 :]:
            if duration >= _SPAN_S or after.first != joined[-1].second:
                break
            joined.append(after)
            duration += after.duration
        if duration >= _SPAN_S:
            steps = np.concatenate([i.steps for i in joined])
            span = Interval(start.first, joined[-1].second, steps, np.empty(60))
            spans[start.first] = reintegrate(span, gyro_bias)
    long = [(a, spans[a.second]) for a in spans.values() if a.second in spans]
    return long or [(a, b) for a, b in itertools.pairwise(intervals) if a.second == b.first]


def _velocity_change(positions: Array, dt1: float, dt2: float) -> Array:
    changed: Array = (positions[2] - positions[1]) / dt2 - (positions[1] - positions[0]) / dt1
    return changed


def constrain(design: Array, target: Array, is_metric: bool, rounds: int = 15) -> LinearStart:
    """Reweighted least squares of design (N, 3, 7) x = target (N, 3) with |gravity| known; x = rho (1, g, bias).

    Started from the solution without that knowledge, and from gravity as it is felt on the average; the better end.
    """
    loose = np.linalg.lstsq(design[..., :4].reshape(-1, 4), target.ravel(), rcond=None)[0]
    felt = np.linalg.lstsq(design[..., 1:4].reshape(-1, 3), -design[..., 0].ravel(), rcond=None)[0]
    ends = []
    for gravity in (loose[1:] * np.sign(loose[0]), felt):
        down = np.asarray(gravity / max(float(np.linalg.norm(gravity)), 1e-300), np.float64)
        along = design[..., :4] @ np.r_[1.0, GRAVITY * down]
        rho = float((along * target).sum() / max(float((along**2).sum()), 1e-300))
        # not a sign, but a size to start from: what the positions do over what the sensor feels
        rho = 1.0 if is_metric else max(rho, 0.1 * float(np.sqrt((target**2).sum() / (along**2).sum())))
        ends.append(_descend(design, target, is_metric, rho, down, rounds))
    return min(ends, key=lambda end: end.position_sigma)


def _descend(design: Array, target: Array, is_metric: bool, rho: float, down: Array, rounds: int) -> LinearStart:
    bias, sigma = np.zeros(3), np.nan
    for _ in range(rounds):
        basis = np.linalg.svd(down[None])[2][1:].T
        x = np.concatenate([[1.0], GRAVITY * down, bias])
        left = target - rho * design @ x
        length2 = (left**2).sum(1)
        sigma = float(np.sqrt(np.median(length2) / 2.366)) + 1e-300
        weight = 1.0 / np.sqrt(1.0 + length2 / (3.0 * sigma) ** 2)
        slopes = np.concatenate(
            [(design @ x)[..., None], rho * GRAVITY * design[..., 1:4] @ basis, rho * design[..., 4:]], -1
        )
        slopes = slopes[..., 1:] if is_metric else slopes
        size = slopes.shape[2]
        prior = np.zeros((3, size))
        prior[:, -3:] = sigma / ACCEL_BIAS_SIGMA * np.eye(3)
        a = np.concatenate([(slopes * weight[:, None, None]).reshape(-1, size), prior])
        b = np.concatenate([(left * weight[:, None]).ravel(), -sigma / ACCEL_BIAS_SIGMA * bias])
        step = np.linalg.lstsq(a, b, rcond=None)[0]
        if not is_metric:
            rho = float(np.clip(rho + step[0], 0.3 * rho, 3.0 * rho))  # a scale does not change its sign
        down = down + basis @ np.clip(step[-5:-3], -0.5, 0.5)
        down /= np.linalg.norm(down)
        bias = bias + step[-3:]
    condition = float(np.linalg.cond(a / np.maximum(np.linalg.norm(a, axis=0), 1e-300)))
    return LinearStart(rho, GRAVITY * down, bias, sigma, condition)


def upright(gravity: Array) -> Array:
    """The smallest rotation (3, 3) that turns the direction against gravity to z."""
    up = -gravity / np.linalg.norm(gravity)
    axis, sine = np.cross(up, [0.0, 0.0, 1.0]), np.hypot(up[0], up[1])
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return rigid3.exp_so3(axis / sine * np.arctan2(sine, up[2]))


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    steps = np.zeros((1, 7))
    integrate(steps, np.zeros(3), np.empty(60))
