"""A map and an inertial sensor: scale, the vertical, velocities, biases, and the offset between the clocks.

Between two keyframes the measurements are integrated once (Forster, Carlone, Dellaert and Scaramuzza, "On-manifold
preintegration for real-time visual-inertial odometry", T-RO 2017). The gyroscope's bias comes from the rotations;
scale, gravity and the accelerometer's bias from a linear system without velocities (Mur-Artal and Tardos,
"Visual-inertial monocular SLAM with map reuse", RA-L 2017; Martinelli, "Closed-form solution of visual-inertial
structure from motion", IJCV 2014); all of it is then refined in a gtsam factor graph in which the map's poses are
measurements with noise, taken at their time and an offset that all share (Qin and Shen, "Online temporal calibration
for monocular visual-inertial systems", IROS 2018).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.inertial.gyroscope import Turns, imu_steps, multiply, read_as_given, turn_by
from sfmapp.odometry.inertial.scale import ScaleEstimate, ScaleRefusal
from sfmapp.odometry.report import InertialEvidence

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GRAVITY = 9.81
# Mean velocities over about a second are compared to start with: accelerations have shown in the positions by then.
_SPAN_S = 1.0
# What biases of small sensors may reasonably be, as standard deviations of their priors.
_GYRO_BIAS_SIGMA, ACCEL_BIAS_SIGMA = 0.1, 0.3
MAX_BIAS = 5 * ACCEL_BIAS_SIGMA
# What the gyroscope leaves of the offset between the clocks is a millisecond where the rotations tell it; where they do
# not, cameras and sensors that are meant to be synchronous are within half a hundred.
_CLOCK_SIGMA_S = 0.05


@dataclass(frozen=True)
class InertialOptions:
    """How a map is aligned with its inertial measurements."""

    min_interval_s: float = 0.2  # poses closer in time than this to the one before are left out
    max_interval_s: float = 2.0  # over longer intervals nothing is integrated
    max_poses: int = 400  # of more poses fewer are taken, evenly in time as long as the intervals allow
    min_intervals: int = 10  # fewer say nothing reliable
    max_sigma_relative: float = 0.1  # a less certain scale is refused
    # chi2 a degree of freedom: noise of the map and the sensor that is twice what is stated leaves 4; a gravity that is
    # missing, an axis or a sign left 37 to 660 on rendered flights
    max_residual: float = 5.0
    max_rotation_residual: float = 0.25  # share of the rotations that the gyroscope may contradict (at least 1 degree)


@dataclass(frozen=True)
class InertialAlignment:
    """How a map lies in the world that its inertial sensor feels.

    Attributes:
        scale: metres per map unit; 1 for a metric map. sigma_relative: its relative standard deviation.
        world_from_map: (8,) similarity into a world in metres, z up, with the map's origin and the smallest turn.
        gravity_in_map: (3,) m/s^2 along the map's axes, downwards. gravity_sigma_rad: of its direction, both angles.
        pose_idx: (J,) positions of the poses that took part, ascending.
        velocity: (J, 3) m/s of the sensor in the z-up world.
        clock_offset_s: to be added to a time of the frames for the time that the measurements carry; clock_sigma_s.
        gyro_bias, accel_bias: (3,) means over the poses; gyro_bias_sigma, accel_bias_sigma: (3,) at the middle one.
        residual: chi2 over degrees of freedom of the refined graph, 1 where all noises are as modelled.
        evidence: numbers for the report.
    """

    scale: float
    sigma_relative: float
    world_from_map: Array
    gravity_in_map: Array
    gravity_sigma_rad: float
    pose_idx: Ints
    velocity: Array
    clock_offset_s: float
    clock_sigma_s: float
    gyro_bias: Array
    accel_bias: Array
    gyro_bias_sigma: Array
    accel_bias_sigma: Array
    residual: float
    evidence: InertialEvidence

    @property
    def scale_estimate(self) -> ScaleEstimate:
        """For the report."""
        return ScaleEstimate(self.scale, self.sigma_relative, "imu", self.evidence)


@dataclass(frozen=True)
class _Interval:
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


@dataclass(frozen=True)
class _MapPath:
    """What the map says: poses (K, 7) at times (K,), their covariances (K, 6, 6) if they have any, and whether its
    unit is the metre."""

    times: Array
    poses: Array
    covariance: Array | None
    is_metric: bool


def align_imu(
    timestamps_s: ArrayLike,
    cam_from_world: ArrayLike,
    imu: Imu,
    *,
    is_metric: bool,
    covariance: ArrayLike | None = None,
    options: InertialOptions = InertialOptions(),
) -> InertialAlignment | ScaleRefusal:
    """Scale and vertical of a map from inertial measurements.

    Args:
        timestamps_s: (K,) ascending, on the clock of the measurements or up to a second off, which is found.
        cam_from_world: (K, 7) poses of the rig's first camera in one map; NaN where there is none.
        is_metric: the map is in metres (stereo): the scale is 1 and only the rest is found.
        covariance: (K, 6, 6) over rotation and translation of ``x_cam <- exp(w) x_cam + v``, of errors that are
            independent from pose to pose; poses where it is not finite are left out. None to judge the noise by how the
            poses fit: better than covariances in a map's gauge, which count the drift that neighbours have in common.

    Returns:
        The alignment, or why the measurements do not give one: too few, contradicting the map (then the refusal holds a
        contradiction), or a motion too even to tell the scale.
    """
    times, poses = np.asarray(timestamps_s, np.float64), np.array(cam_from_world, np.float64)
    if covariance is not None:
        covariance = np.asarray(covariance, np.float64)
        poses[~np.isfinite(covariance).all((1, 2))] = np.nan
    chosen = choose_poses(times, poses, options)
    intervals = _intervals(times, chosen, imu, options.max_interval_s)
    evidence = InertialEvidence(num_poses=len(chosen), num_intervals=len(intervals))
    if len(intervals) < options.min_intervals:
        return ScaleRefusal("imu", _too_few(intervals, times[chosen], imu, options), evidence)
    clock = read_as_given(turns_of(times, poses, chosen, options.max_interval_s), imu)
    if np.isfinite(clock.offset_sigma_s):
        imu = replace(imu, timestamps_s=imu.timestamps_s - clock.offset_s)
        intervals = _intervals(times, chosen, imu, options.max_interval_s)
    found = _fit(_MapPath(times, poses, covariance, is_metric), imu, intervals, options, evidence)
    if isinstance(found, ScaleRefusal):
        return found
    offset = found.clock_offset_s + (clock.offset_s if np.isfinite(clock.offset_sigma_s) else 0.0)
    evidence = replace(found.evidence, clock_offset_s=offset, clock_sigma_s=found.clock_sigma_s)
    return _accept(replace(found, clock_offset_s=offset, evidence=evidence), options)


def _too_few(intervals: list[_Interval], times: Array, imu: Imu, options: InertialOptions) -> str:
    """Why there is nothing to align with."""
    reason = (
        f"{len(intervals)} intervals between poses have inertial measurements, "
        f"at least {options.min_intervals} are asked for"
    )
    first, last = (imu.timestamps_s[0], imu.timestamps_s[-1]) if len(imu.timestamps_s) else (np.nan, np.nan)
    if len(times) and not (first < times[-1] and last > times[0]):
        reason += (
            f"; they run from {first:.3f} to {last:.3f} s, the map from {times[0]:.3f} to {times[-1]:.3f} s: "
            "the clocks have other beginnings"
        )
    return reason


def _fit(
    path: _MapPath, imu: Imu, intervals: list[_Interval], options: InertialOptions, evidence: InertialEvidence
) -> InertialAlignment | ScaleRefusal:
    """The alignment with measurements as they are, accepted or not."""
    map_from_imu = _map_from_imu_rotation(path.poses, imu)
    gyro_bias, rotation_residual, rotation = _gyro_bias(intervals, map_from_imu)
    evidence = replace(
        evidence, rotation_residual_deg=float(np.degrees(rotation_residual)), rotation_deg=float(np.degrees(rotation))
    )
    if not rotation_residual <= max(np.radians(1.0), options.max_rotation_residual * rotation):
        reason = (
            f"the gyroscope contradicts the map's rotations by {np.degrees(rotation_residual):.1f} of "
            f"{np.degrees(rotation):.1f} degrees an interval"
        )
        return contradicted(reason, "", evidence)
    intervals = [_reintegrate(interval, gyro_bias) for interval in intervals]
    start = _solve_linear(intervals, gyro_bias, map_from_imu, path, imu)
    evidence = replace(evidence, condition=start.condition, position_sigma_map_units=start.position_sigma)
    if not start.inverse_scale > 0:
        return ScaleRefusal("imu", "the motion does not tell the scale: accelerations and positions disagree", evidence)
    graph = _Graph(path, imu, intervals, start, gyro_bias, rotation_residual / np.sqrt(2.0))
    return graph.solve(evidence)


def _accept(found: InertialAlignment, options: InertialOptions) -> InertialAlignment | ScaleRefusal:
    """Refuse a fit that leaves far more than noise, and a scale that is too uncertain."""
    bias = float(np.linalg.norm(found.accel_bias))
    is_fitted = found.residual <= options.max_residual
    if is_fitted and not found.sigma_relative <= options.max_sigma_relative:
        reason = (
            f"the motion gives the scale to {found.sigma_relative:.0%} only, at most "
            f"{options.max_sigma_relative:.0%} are allowed: move and turn the camera more briskly"
        )
        return ScaleRefusal("imu", reason, found.evidence)
    if is_fitted and bias <= MAX_BIAS:
        return found
    reason = (
        f"the inertial measurements contradict the map: the fit leaves {found.residual:.3g} a degree of freedom "
        f"(noise alone 1, allowed {options.max_residual:g}), with a bias of the accelerometer of {bias:.2g} m/s^2"
    )
    return contradicted(reason, "", found.evidence)


def contradicted(reason: str, advice: str, evidence: InertialEvidence) -> ScaleRefusal:
    """A refusal because map and measurements say different things. The map in its own unit is not touched by it."""
    numbers = {key: value for key, value in evidence.items() if not isinstance(value, float) or np.isfinite(value)}
    return ScaleRefusal("imu", reason, evidence, Contradiction("inertial measurements", reason, advice, numbers))


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


def _map_from_imu_rotation(poses: Array, imu: Imu) -> Array:
    """(K, 3, 3)."""
    turned: Array = rigid3.rotation_matrix(poses).swapaxes(1, 2) @ rigid3.rotation_matrix(imu.imu_from_cam).T
    return turned


# ---- integration


@numba.njit(cache=True, nogil=True)
def _integrate(steps: Array, gyro_bias: Array, out: Array) -> None:
    """Fill out (60,), see _Interval (Forster et al. 2017, equations 33 and 44, and the appendix for the slopes)."""
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
        turn[:] = new
        for i in range(3):
            for j in range(3):
                new[i, j] = step[0, i] * r_g[0, j] + step[1, i] * r_g[1, j] + step[2, i] * r_g[2, j] - slope[i, j] * h
        r_g[:] = new
    out[:9], out[9:12], out[12:15] = turn.ravel(), velocity, position
    out[15:24], out[24:33], out[33:42] = r_g.ravel(), v_g.ravel(), v_a.ravel()
    out[42:51], out[51:60] = p_g.ravel(), p_a.ravel()


def _reintegrate(interval: _Interval, gyro_bias: Array) -> _Interval:
    delta = np.empty(60)
    _integrate(interval.steps, gyro_bias, delta)
    return _Interval(interval.first, interval.second, interval.steps, delta)


def _intervals(times: Array, chosen: Ints, imu: Imu, max_interval_s: float) -> list[_Interval]:
    """Between neighbouring poses, where the measurements cover the time."""
    out = []
    for first, second in itertools.pairwise(chosen):
        steps = imu_steps(imu, times[first], times[second]) if times[second] - times[first] <= max_interval_s else None
        if steps is not None:
            out.append(_reintegrate(_Interval(int(first), int(second), steps, np.empty(60)), np.zeros(3)))
    return out


# ---- the start


def _gyro_bias(intervals: list[_Interval], map_from_imu: Array) -> tuple[Array, float, float]:
    """Bias (3,), robust rms of what it leaves of the rotations and rms of the rotations, radians an interval."""
    bias = np.zeros(3)
    first, second = np.array([(i.first, i.second) for i in intervals]).T
    seen = map_from_imu[first].swapaxes(1, 2) @ map_from_imu[second]
    for _ in range(4):
        intervals = [_reintegrate(interval, bias) for interval in intervals]
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


def _solve_linear(
    intervals: list[_Interval], gyro_bias: Array, map_from_imu: Array, path: _MapPath, imu: Imu
) -> LinearStart:
    """Scale, gravity and accelerometer bias from mean velocities over neighbouring intervals."""
    system = _linear_system(intervals, gyro_bias, rigid3.center(path.poses), map_from_imu, path.poses, imu)
    if system is None:
        return LinearStart(0.0, np.zeros(3), np.zeros(3), np.nan, np.inf)
    return constrain(*system, path.is_metric)


def _linear_system(
    intervals: list[_Interval], gyro_bias: Array, centers: Array, map_from_imu: Array, poses: Array, imu: Imu
) -> tuple[Array, Array] | None:
    """Design (N, 3, 7) and target (N, 3) of :func:`constrain`; None of too few.

    With rho = 1 / scale the change of the camera's mean velocity in map units is
    rho (what was integrated, less what the lever arm moved) + rho g (dt1 + dt2) / 2 + rho (slopes) bias:
    the noisy positions stand alone on one side, so that noise does not shrink the scale.
    """
    pairs = _long_pairs(intervals, gyro_bias)
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
    """The same from poses as :func:`align_imu` takes them."""
    chosen = choose_poses(times, poses, options)
    intervals = [_reintegrate(i, gyro_bias) for i in _intervals(times, chosen, imu, options.max_interval_s)]
    return _linear_system(intervals, gyro_bias, rigid3.center(poses), _map_from_imu_rotation(poses, imu), poses, imu)


def _long_pairs(intervals: list[_Interval], gyro_bias: Array) -> list[tuple[_Interval, _Interval]]:
    """Neighbouring spans of about a second, from every pose: what motion adds grows with the span, noise does not."""
    spans: dict[int, _Interval] = {}
    for n, start in enumerate(intervals):
        joined, duration = [start], start.duration
        for after in intervals[n + 1 :]:
            if duration >= _SPAN_S or after.first != joined[-1].second:
                break
            joined.append(after)
            duration += after.duration
        if duration >= _SPAN_S:
            steps = np.concatenate([i.steps for i in joined])
            span = _Interval(start.first, joined[-1].second, steps, np.empty(60))
            spans[start.first] = _reintegrate(span, gyro_bias)
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


# ---- the refinement


def _upright(gravity: Array) -> Array:
    """The smallest rotation (3, 3) that turns the direction against gravity to z."""
    up = -gravity / np.linalg.norm(gravity)
    axis, sine = np.cross(up, [0.0, 0.0, 1.0]), np.hypot(up[0], up[1])
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return rigid3.exp_so3(axis / sine * np.arctan2(sine, up[2]))


class _Graph:
    """Poses X, velocities V and biases B of the sensor in the z-up world, and A: log scale, two angles of tilt, and the
    seconds after its time at which a pose of the map was taken."""

    def __init__(
        self, path: _MapPath, imu: Imu, intervals: list[_Interval], start: LinearStart, gyro_bias: Array,
        rotation_sigma: float,
    ) -> None:  # fmt: skip
        self._poses, self._imu, self._intervals, self._is_metric = path.poses, imu, intervals, path.is_metric
        self._covariance = path.covariance
        self._start, self._gyro_bias = start, gyro_bias
        self._index = sorted({k for interval in intervals for k in (interval.first, interval.second)})
        rates = np.stack([np.interp(path.times, imu.timestamps_s, column) for column in imu.gyro.T], 1)
        self._rates = rates - gyro_bias
        # rounding alone leaves less than this; zero noise would make the graph singular
        self._sigmas = np.r_[np.full(3, max(rotation_sigma, 1e-7)), np.full(3, max(start.position_sigma, self._tiny()))]
        self._world_from_map = _upright(start.gravity)

    def _tiny(self) -> float:
        centers = rigid3.center(self._poses[self._index])
        return 1e-7 * float(np.linalg.norm(np.ptp(centers, axis=0))) + 1e-300

    def solve(self, evidence: InertialEvidence) -> InertialAlignment | ScaleRefusal:
        """Refine; poses without covariances are weighed twice: by the start's residuals, then by the graph's own."""
        values = self._initial()
        rounds = 2 if self._covariance is None else 1
        for n in range(rounds):
            graph = self._build()
            try:
                values = _optimize(graph, values)
            except RuntimeError:
                return ScaleRefusal(
                    "imu", "the motion leaves scale or gravity open: the refinement is singular", evidence
                )
            if n + 1 < rounds:
                self._weigh(values)
        try:
            return self._read(graph, values, evidence)
        except RuntimeError:
            return ScaleRefusal("imu", "the motion leaves scale or gravity open: no covariance can be had", evidence)

    def _initial(self) -> Any:
        import gtsam
        from gtsam.symbol_shorthand import A, B, V, X

        values, scale = gtsam.Values(), 1.0 / self._start.inverse_scale
        values.insert(A(0), np.array([np.log(scale), 0.0, 0.0, 0.0]))
        sensor = {}
        for k in self._index:
            map_from_cam = rigid3.inverse(self._poses[k])
            rotation = self._world_from_map @ rigid3.rotation_matrix(map_from_cam)
            center = scale * self._world_from_map @ map_from_cam[4:]
            pose = rigid3.compose(rigid3.from_matrix(rotation, center), rigid3.inverse(self._imu.imu_from_cam))
            sensor[k] = pose
            values.insert(X(k), gtsam.Pose3(gtsam.Rot3(rigid3.rotation_matrix(pose)), pose[4:]))
            values.insert(B(k), gtsam.imuBias.ConstantBias(self._start.accel_bias, self._gyro_bias))
        down = np.array([0.0, 0.0, -GRAVITY])
        velocity: dict[int, Array] = {}
        for i in self._intervals:
            dt, turn = i.duration, rigid3.rotation_matrix(sensor[i.first])
            gained = i.delta[12:15] + i.slope(4) @ self._start.accel_bias
            velocity[i.first] = (sensor[i.second][4:] - sensor[i.first][4:] - turn @ gained) / dt - 0.5 * down * dt
            velocity[i.second] = (
                velocity[i.first] + down * dt + turn @ (i.delta[9:12] + i.slope(2) @ self._start.accel_bias)
            )
        for k in self._index:
            values.insert(V(k), velocity[k])
        return values

    def _build(self) -> Any:
        import gtsam
        from gtsam.symbol_shorthand import A, B, V, X

        graph, loss = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.mEstimator.Huber.Create(3.0)
        parameters = _preintegration(self._imu)
        bias = gtsam.imuBias.ConstantBias(self._start.accel_bias, self._gyro_bias)
        floor = np.diag(np.repeat([1e-7, self._tiny()], 3) ** 2)  # a pose that holds the gauge has a covariance of zero
        linked: set[int] = set()
        for i in self._intervals:
            sums = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
            for step in _midway(i.steps, self._gyro_bias):
                sums.integrateMeasurement(step[4:], step[1:4], step[0])
            a, b = i.first, i.second
            graph.push_back(gtsam.CombinedImuFactor(X(a), V(a), X(b), V(b), B(a), B(b), sums))
            if a not in linked:  # the first of a chain of intervals
                sigmas = np.repeat([ACCEL_BIAS_SIGMA, _GYRO_BIAS_SIGMA], 3)
                prior = gtsam.imuBias.ConstantBias(np.zeros(3), self._gyro_bias)
                graph.push_back(gtsam.PriorFactorConstantBias(B(a), prior, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
            linked.update((a, b))
        for k in self._index:
            noise = (
                gtsam.noiseModel.Diagonal.Sigmas(self._sigmas)
                if self._covariance is None
                else gtsam.noiseModel.Gaussian.Covariance(self._covariance[k] + floor)
            )
            link = _MapPose(self._poses[k], self._imu, self._world_from_map, self._rates[k])
            robust = gtsam.noiseModel.Robust.Create(loss, noise)
            graph.push_back(gtsam.CustomFactor(robust, [X(k), A(0), V(k)], link.error))
        # the tilt is only kept from running away; a metric map's scale is known (1e-9 would be a constraint to gtsam)
        sigmas = np.array([1e-6 if self._is_metric else 10.0, 10.0, 10.0, _CLOCK_SIGMA_S])
        scale = 1.0 if self._is_metric else 1.0 / self._start.inverse_scale
        center = np.array([np.log(scale), 0.0, 0.0, 0.0])
        graph.push_back(gtsam.PriorFactorVector(A(0), center, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        return graph

    def _links(self, values: Any) -> Array:
        """(J, 6) residuals of the map's poses: radians and map units."""
        from gtsam.symbol_shorthand import A, V, X

        out = np.empty((len(self._index), 6))
        for n, k in enumerate(self._index):
            link = _MapPose(self._poses[k], self._imu, self._world_from_map, self._rates[k])
            out[n] = link.residual(values.atPose3(X(k)), values.atVector(A(0)), values.atVector(V(k)))
        return out

    def _weigh(self, values: Any) -> None:
        """Noise of rotations and positions from their residuals, robustly; the sums over all that was fitted with."""
        squares = self._links(values).reshape(-1, 2, 3) ** 2
        sigma = np.sqrt(np.median(squares.sum(2), 0) / 2.366)
        # the graph bends towards the poses: it may not talk their noise away
        self._sigmas = np.maximum(np.repeat(sigma, 3), 0.3 * self._sigmas)

    def _read(self, graph: Any, values: Any, evidence: InertialEvidence) -> InertialAlignment:
        from gtsam.symbol_shorthand import A, B, V

        log_scale, *tilt, offset = values.atVector(A(0))
        rotation = rigid3.exp_so3(np.r_[tilt, 0.0]) @ self._world_from_map
        gravity = rotation.T @ [0.0, 0.0, -GRAVITY]
        upright = _upright(gravity)
        keep_heading = upright @ rotation.T
        covariance, bias_covariance = _covariances(graph, values, A(0), B(self._index[len(self._index) // 2]))
        # rows: 15 an interval, 6 a pose, 6 a chain; unknowns: 15 a pose and 4
        chains = len(self._index) - len(self._intervals)
        num_free = 15 * len(self._intervals) + 6 * len(self._index) + 6 * chains + 4 - 15 * len(self._index) - 4
        residual = 2.0 * graph.error(values) / num_free
        widen = np.sqrt(max(residual, 1.0))
        biases = np.array([values.atConstantBias(B(k)).vector() for k in self._index]).mean(0)
        bias_sigma = widen * np.sqrt(np.diag(bias_covariance))
        sigma = 0.0 if self._is_metric else float(widen * np.sqrt(covariance[0, 0]))
        gravity_sigma = float(widen * np.sqrt(covariance[1, 1] + covariance[2, 2]))
        evidence = replace(
            evidence, residual=float(residual), gravity_sigma_deg=float(np.degrees(gravity_sigma)),
            rotation_sigma_deg=float(np.degrees(self._sigmas[0])),
            position_sigma_map_units=float(self._sigmas[3]),
            gyro_bias=biases[3:].tolist(), accel_bias=biases[:3].tolist(),
        )  # fmt: skip
        scale = 1.0 if self._is_metric else float(np.exp(log_scale))
        return InertialAlignment(
            scale, sigma, similarity.from_parts(upright, np.zeros(3), scale), gravity, gravity_sigma,
            np.array(self._index), np.array([values.atVector(V(k)) for k in self._index]) @ keep_heading.T,
            float(offset), float(widen * np.sqrt(covariance[3, 3])), biases[3:], biases[:3], bias_sigma[3:],
            bias_sigma[:3], float(residual), evidence,
        )  # fmt: skip


def _optimize(graph: Any, values: Any) -> Any:
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(30)
    parameters.setRelativeErrorTol(1e-6)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def _covariances(graph: Any, values: Any, last: int, before: int) -> tuple[Array, Array]:
    """Marginal covariances of two variables, by QR: Cholesky gives up on weak motion, where information cancels."""
    import gtsam

    linear = graph.linearize(values)
    ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, [before, last], True)
    net = linear.eliminateSequential(ordering, gtsam.EliminateQR)
    end, middle = net.at(net.size() - 1), net.at(net.size() - 2)
    if list(end.keys()) != [last] or list(middle.keys()) != [before, last]:
        raise RuntimeError("gtsam did not keep the order of elimination")
    root = np.linalg.inv(end.R())
    covariance = root @ root.T
    root = np.linalg.inv(middle.R())
    return covariance, root @ (np.eye(len(root)) + middle.S() @ covariance @ middle.S().T) @ root.T


def _preintegration(imu: Imu) -> Any:
    """gtsam's parameters, z up."""
    import gtsam

    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    tiny = 1e-8  # zero densities would make the factors singular
    parameters.setAccelerometerCovariance(max(imu.accel_noise, tiny) ** 2 * np.eye(3))
    parameters.setGyroscopeCovariance(max(imu.gyro_noise, tiny) ** 2 * np.eye(3))
    parameters.setBiasAccCovariance(max(imu.accel_walk, tiny) ** 2 * np.eye(3))
    parameters.setBiasOmegaCovariance(max(imu.gyro_walk, tiny) ** 2 * np.eye(3))
    # what is lost between samples: 0.03 mm over a second, far below what any camera sees
    parameters.setIntegrationCovariance(1e-9 * np.eye(3))
    return parameters


def _midway(steps: Array, gyro_bias: Array) -> Array:
    """Steps with the force turned to the middle of each: gtsam applies it in the orientation of the start."""
    half = rigid3.exp_so3(0.5 * steps[:, :1] * (steps[:, 1:4] - gyro_bias))
    return np.column_stack([steps[:, :4], np.einsum("nij,nj->ni", half, steps[:, 4:])])


class _MapPose:
    """A pose of the map as a measurement of the sensor's pose, given the map's scale, its tilt and the clocks' offset.

    The residual (6,) is the (w, v) of ``x_cam <- exp(w) x_cam + v`` that carries what is measured to what is predicted,
    up to the sign: radians and map units, so that covariances of the map apply as they are. Over the offset, some
    milliseconds by now, the sensor turns at its rate (3,) in rad/s and moves at its velocity.
    """

    def __init__(self, cam_from_map: Array, imu: Imu, world_from_map: Array, rate: Array) -> None:
        self._cam_from_map = rigid3.rotation_matrix(cam_from_map)
        self._center = rigid3.center(cam_from_map)
        self._imu_from_cam = rigid3.rotation_matrix(imu.imu_from_cam)
        self._arm, self._rate = imu.imu_from_cam[4:], rate
        self._world_from_map = world_from_map

    def residual(self, pose: Any, alignment: Array, velocity: Array) -> Array:
        """(6,) at a gtsam.Pose3 of the sensor, (4,) log scale, tilt and offset, and its velocity (3,)."""
        cam_from_world, rotation, center = self._later(pose, alignment, velocity)
        angle = rigid3.log_so3(cam_from_world @ rotation @ self._imu_from_cam)
        moved = cam_from_world @ center / np.exp(alignment[0]) - self._cam_from_map @ self._center
        differences: Array = np.r_[angle, moved]
        return differences

    def _later(self, pose: Any, alignment: Array, velocity: Array) -> tuple[Array, Array, Array]:
        """Of the camera, as the map has it, from the z-up world; and the sensor's rotation and the camera's centre
        there, when the picture was taken."""
        tilt = rigid3.exp_so3([-alignment[1], -alignment[2], 0.0])
        rotation = pose.rotation().matrix() @ rigid3.exp_so3(alignment[3] * self._rate)
        center = pose.translation() + alignment[3] * velocity + rotation @ self._arm
        return np.asarray(self._cam_from_map @ self._world_from_map.T @ tilt), rotation, center

    def slopes(self, pose: Any, alignment: Array, velocity: Array) -> tuple[Array, Array, Array]:
        """Of the residual, (6, 6) by the pose's tangent, (6, 4) by the alignment and (6, 3) by the velocity."""
        cam_from_world, rotation, center = self._later(pose, alignment, velocity)
        scale, at_time = np.exp(alignment[0]), pose.rotation().matrix()
        turned = rotation @ self._imu_from_cam
        of_tilt = (np.eye(3) + 0.5 * rigid3.skew([alignment[1], alignment[2], 0.0]))[:, :2]
        # inverse right Jacobian, to first order
        of_angle = np.eye(3) + 0.5 * rigid3.skew(rigid3.log_so3(cam_from_world @ turned))
        by_pose, by_alignment, by_velocity = np.zeros((6, 6)), np.zeros((6, 4)), np.zeros((6, 3))
        by_pose[:3, :3] = of_angle @ turned.T @ at_time
        by_pose[3:, :3] = -cam_from_world @ at_time @ rigid3.skew(at_time.T @ rotation @ self._arm) / scale
        by_pose[3:, 3:] = cam_from_world @ at_time / scale
        by_alignment[:3, 1:3] = -of_angle @ turned.T @ of_tilt
        by_alignment[:3, 3] = of_angle @ self._imu_from_cam.T @ self._rate
        by_alignment[3:, 0] = -cam_from_world @ center / scale
        by_alignment[3:, 1:3] = cam_from_world @ rigid3.skew(center) @ of_tilt / scale
        by_alignment[3:, 3] = cam_from_world @ (velocity + rotation @ np.cross(self._rate, self._arm)) / scale
        by_velocity[3:] = alignment[3] * cam_from_world / scale
        return by_pose, by_alignment, by_velocity

    def error(self, factor: Any, values: Any, slopes: Any) -> Array:
        """For gtsam.CustomFactor."""
        pose_key, alignment_key, velocity_key = factor.keys()
        at = values.atPose3(pose_key), values.atVector(alignment_key), values.atVector(velocity_key)
        if slopes is not None:
            slopes[0], slopes[1], slopes[2] = self.slopes(*at)
        return self.residual(*at)


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    steps = np.zeros((1, 7))
    _integrate(steps, np.zeros(3), np.empty(60))
