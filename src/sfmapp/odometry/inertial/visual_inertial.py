"""A map and an inertial sensor: scale, the vertical, velocities, biases, and the offset between the clocks.

The gyroscope's bias and the clocks come from the rotations, a first scale and vertical from the positions
(:mod:`sfmapp.odometry.inertial.integration`); then images and measurements are adjusted together
(:mod:`sfmapp.odometry.inertial.graph`), and what that leaves tells whether they belong together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustReport
from sfmapp.contradictions import Contradiction
from sfmapp.geometry import similarity
from sfmapp.odometry.inertial.gyroscope import read_as_given
from sfmapp.odometry.inertial.integration import (
    ACCEL_BIAS_SIGMA,
    GRAVITY,
    InertialOptions,
    Interval,
    choose_poses,
    gyro_bias_of,
    intervals_between,
    map_from_imu_rotation,
    reintegrate,
    solve_linear,
    turns_of,
    upright,
)
from sfmapp.odometry.inertial.scale import ScaleEstimate, ScaleRefusal
from sfmapp.odometry.inertial.seen_map import SeenMap
from sfmapp.odometry.report import InertialEvidence
from sfmapp.scene.reconstruction import Reconstruction

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu
    from sfmapp.odometry.inertial.graph import Solved

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# A bias that is larger is none.
MAX_BIAS = 5 * ACCEL_BIAS_SIGMA
_DEFAULTS = InertialOptions()


@dataclass(frozen=True)
class InertialAlignment:
    """A map that images and an inertial sensor hold together, and how it lies in the world that the sensor feels.

    Attributes:
        model: the map, bent to both, in the frame and the unit that it had.
        pose_covariance: (K, 6, 6) of its keyframes in the gauge of centroid, mean rotation and spread (of a metric map
            without the spread), over ``x_cam <- exp(w) x_cam + v``; None of more than 400.
        adjustment: of all together.
        scale: metres per map unit. sigma_relative: its relative standard deviation, that of the spread of the map.
        world_from_map: (8,) similarity into a world in metres, z up, with the map's origin and the smallest turn.
        gravity_in_map: (3,) m/s^2 along the map's axes, downwards. gravity_sigma_rad: of its direction, both angles.
        pose_idx: (J,) keyframes that the measurements link, ascending.
        velocity: (J, 3) m/s of the sensor in the z-up world.
        clock_offset_s: to be added to a time of the frames for the time that the measurements carry; clock_sigma_s.
        gyro_bias, accel_bias: (3,) means over these; gyro_bias_sigma, accel_bias_sigma: (3,) at the middle one.
        residual: what the sensor adds to the cost, twice, a degree of freedom; 1 where all noises are as modelled.
        evidence: numbers for the report.
    """

    model: Reconstruction
    pose_covariance: Array | None
    adjustment: AdjustReport
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


def align_imu(seen: SeenMap, imu: Imu, options: InertialOptions = _DEFAULTS) -> InertialAlignment | ScaleRefusal:
    """Adjust a map together with inertial measurements, for its scale, its vertical and better poses.

    Returns:
        The alignment, or why the measurements do not give one: too few, contradicting the map (then the refusal holds a
        contradiction), or a motion too even to tell the scale.
    """
    times, poses = seen.times_s, seen.poses
    chosen = choose_poses(times, poses, options)
    intervals = intervals_between(times, chosen, imu, options.max_interval_s)
    evidence = InertialEvidence(num_poses=len(chosen), num_intervals=len(intervals))
    if len(intervals) < options.min_intervals:
        return ScaleRefusal("imu", _too_few(intervals, times[chosen], imu, options), evidence)
    clock = read_as_given(turns_of(times, poses, chosen, options.max_interval_s), imu)
    if np.isfinite(clock.offset_sigma_s):
        imu = replace(imu, timestamps_s=imu.timestamps_s - clock.offset_s)
        intervals = intervals_between(times, chosen, imu, options.max_interval_s)
    found = _fit(seen, imu, intervals, options, evidence)
    if isinstance(found, ScaleRefusal):
        return found
    offset = found.clock_offset_s + (clock.offset_s if np.isfinite(clock.offset_sigma_s) else 0.0)
    evidence = replace(found.evidence, clock_offset_s=offset, clock_sigma_s=found.clock_sigma_s)
    return _accept(replace(found, clock_offset_s=offset, evidence=evidence), options)


def _too_few(intervals: list[Interval], times: Array, imu: Imu, options: InertialOptions) -> str:
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
    seen: SeenMap, imu: Imu, intervals: list[Interval], options: InertialOptions, evidence: InertialEvidence
) -> InertialAlignment | ScaleRefusal:
    """The alignment with measurements as they are, accepted or not."""
    from sfmapp.odometry.inertial.graph import solve_graph

    gyro_bias, rotation_residual, rotation = gyro_bias_of(intervals, map_from_imu_rotation(seen.poses, imu))
    evidence = replace(
        evidence, rotation_residual_deg=float(np.degrees(rotation_residual)), rotation_deg=float(np.degrees(rotation))
    )
    if not rotation_residual <= max(np.radians(1.0), options.max_rotation_residual * rotation):
        reason = (
            f"the gyroscope contradicts the map's rotations by {np.degrees(rotation_residual):.1f} of "
            f"{np.degrees(rotation):.1f} degrees an interval"
        )
        return contradicted(reason, "", evidence)
    intervals = [reintegrate(interval, gyro_bias) for interval in intervals]
    start = solve_linear(intervals, gyro_bias, seen.poses, imu, is_metric=seen.is_metric)
    evidence = replace(evidence, condition=start.condition, position_sigma_map_units=start.position_sigma)
    if not start.inverse_scale > 0:
        return ScaleRefusal("imu", "the motion does not tell the scale: accelerations and positions disagree", evidence)
    if np.linalg.norm(start.accel_bias) > MAX_BIAS:  # no place to begin from
        start = replace(start, accel_bias=np.zeros(3))
    solved = solve_graph(seen, imu, intervals, start, gyro_bias, max_residual=options.max_residual)
    return _read(solved, evidence)


def _read(solved: Solved, evidence: InertialEvidence) -> InertialAlignment:
    gravity = solved.world_from_map.T @ [0.0, 0.0, -GRAVITY]
    up = upright(gravity)
    keep_heading = up @ solved.world_from_map.T
    variance, scale = np.diag(solved.covariance), float(np.exp(solved.alignment[0]))
    gravity_sigma = float(np.sqrt(variance[1] + variance[2]))
    bias = solved.bias.mean(0)
    evidence = replace(
        evidence, residual=solved.residual,
        gravity_sigma_deg=float(np.degrees(gravity_sigma)) if np.isfinite(gravity_sigma) else None,
        gyro_bias=bias[3:].tolist(), accel_bias=bias[:3].tolist(), gravity_in_map=gravity.tolist(),
        mounting_turn_deg=np.degrees(solved.mounting[:3]).tolist(), mounting_shift_m=solved.mounting[3:].tolist(),
    )  # fmt: skip
    if np.isfinite(solved.mounting_covariance).all():
        sigma = np.sqrt(np.diag(solved.mounting_covariance))
        evidence = replace(
            evidence, mounting_turn_sigma_deg=np.degrees(sigma[:3]).tolist(), mounting_shift_sigma_m=sigma[3:].tolist()
        )
    return InertialAlignment(
        solved.model, solved.poses, solved.report, scale, float(np.sqrt(variance[0])),
        similarity.from_parts(up, np.zeros(3), scale), gravity, gravity_sigma, solved.linked,
        solved.velocity @ keep_heading.T, float(solved.alignment[3]), float(np.sqrt(variance[3])), bias[3:], bias[:3],
        solved.bias_sigma[3:], solved.bias_sigma[:3], solved.residual, evidence,
    )  # fmt: skip


def _accept(found: InertialAlignment, options: InertialOptions) -> InertialAlignment | ScaleRefusal:
    """Refuse a fit that leaves far more than noise, and a scale that is too uncertain."""
    bias = float(np.linalg.norm(found.accel_bias))
    is_fitted = found.residual <= options.max_residual
    if is_fitted and not np.isfinite(found.sigma_relative):
        return ScaleRefusal(
            "imu", "the motion leaves scale or gravity open: the adjustment is singular", found.evidence
        )
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
