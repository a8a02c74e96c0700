"""The largest map's trajectory as an error-state filter has it, and what that says of itself."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.filtering import (
    LIVE,
    FilteredTrajectory,
    InertialSensor,
    consistency,
    filter_trajectory,
)
from sfmapp.odometry.inertial.scale import ScaleRefusal
from sfmapp.odometry.report import FilterGap, FilterReport, InertialEvidence, RejectedPose
from sfmapp.odometry.result import MapResult, OdometryResult

Array = NDArray[np.float64]

STAGE = "filter"
COLUMNS = ("timestamp_s", "position_sigma", "rotation_sigma_deg", "since_pose_s", "is_bridged", "latency_ms")


def filter_largest_map(result: OdometryResult, imu: Imu | None, given_s: Array, events: Events) -> FilterReport:
    """Filter the final poses of the largest map, with their covariances given the map, and put that into the result.

    Args:
        imu: None without one; on the clock of the result.
        given_s: (F,) the times of the frames on the sequence's own clock, on which those of the poses will be.
    """
    assert result.measured_covariance is not None
    sensor = "" if imu is None else _sensor(result.maps[0], imu)
    poses = np.where((result.frame_map == 0)[:, None], result.cam_from_world, np.nan)
    found = filter_trajectory(
        result.timestamps_s, poses, result.measured_covariance, sensor if isinstance(sensor, InertialSensor) else None
    )
    found = replace(found, timestamps_s=np.interp(found.timestamps_s, result.timestamps_s, given_s))
    result.filtered = found
    report = _report(result, found, given_s, sensor if isinstance(sensor, str) and sensor else None)
    events.decided(STAGE, _told(report), **report)
    return report


def filtered_csv(found: FilteredTrajectory) -> str:
    """How sure each pose is, and what it hangs on."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    position, rotation = found.position_sigma, np.degrees(found.rotation_sigma_rad)
    for n, timestamp_s in enumerate(found.timestamps_s):
        writer.writerow([
            repr(float(timestamp_s)), f"{position[n]:.6g}", f"{rotation[n]:.6g}", f"{found.since_pose_s[n]:.6g}",
            int(found.is_bridged[n]), f"{1e3 * found.latency_s[n]:.4g}",
        ])  # fmt: skip
    return text.getvalue()


def _sensor(entry: MapResult, imu: Imu) -> InertialSensor | str:
    """The sensor as the closing adjustment has found it, or why it cannot predict."""
    if entry.inertial is None:
        return "the map was made without the inertial measurements"
    if isinstance(entry.inertial, ScaleRefusal):
        return entry.inertial.reason
    told = entry.inertial.evidence
    assert isinstance(told, InertialEvidence)
    if told.gravity_in_map is None or told.gravity_sigma_deg is None:
        return "the motion leaves open where down is"
    cam_from_imu = rigid3.inverse(imu.imu_from_cam)
    turn = np.radians(told.mounting_turn_deg if told.mounting_turn_deg is not None else np.zeros(3))
    shift = np.asarray(told.mounting_shift_m if told.mounting_shift_m is not None else np.zeros(3))
    mounted = rigid3.from_matrix(rigid3.rotation_matrix(cam_from_imu) @ rigid3.exp_so3(turn), cam_from_imu[4:] + shift)
    # what the adjustment has found the sensor to be noisier by
    excess = math.sqrt(max(1.0, told.residual or 1.0))
    imu = replace(
        imu, timestamps_s=imu.timestamps_s - (told.clock_offset_s or 0.0), imu_from_cam=rigid3.inverse(mounted),
        gyro_noise=excess * imu.gyro_noise, accel_noise=excess * imu.accel_noise,
        gyro_walk=excess * imu.gyro_walk, accel_walk=excess * imu.accel_walk,
    )  # fmt: skip
    gyro_bias, accel_bias = (np.zeros(3) if b is None else np.asarray(b) for b in (told.gyro_bias, told.accel_bias))
    return InertialSensor(
        imu, np.asarray(told.gravity_in_map), float(np.radians(told.gravity_sigma_deg)), gyro_bias, accel_bias
    )


def _report(result: OdometryResult, found: FilteredTrajectory, given_s: Array, reason: str | None) -> FilterReport:
    latency = 1e3 * found.latency_s if len(found.latency_s) else np.zeros(1)
    rate = 1.0 / float(np.median(np.diff(found.timestamps_s))) if len(found.timestamps_s) > 1 else 0.0
    rejected = [
        RejectedPose(
            name=result.frame_names[f], timestamp_s=float(given_s[f]),
            reason=f"the motion contradicts it: NIS {found.nis[f]:.0f} of 6 degrees of freedom, at most "
            f"{LIVE.max_nis:g} is believed",
        )
        for f in np.flatnonzero(found.is_rejected)
    ]  # fmt: skip
    rows = found.frame_row[found.frame_row >= 0]
    return FilterReport(
        prediction=found.prediction, num_poses=len(found.timestamps_s), rate_hz=round(rate, 3),
        num_used=int((found.since_pose_s[rows] == 0.0).sum()), rejected=rejected, gaps=list(_gaps(found)),
        latency_ms_median=float(np.median(latency)), latency_ms_p95=float(np.percentile(latency, 95)),
        latency_ms_max=float(latency.max()), reason=reason, consistency=consistency(found.nis),
    )  # fmt: skip


def _gaps(found: FilteredTrajectory) -> Iterator[FilterGap]:
    """Stretches of poses that were bridged, each from the last pose that was used."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], found.is_bridged.astype(np.int8), [0]])))
    position, rotation = found.position_sigma, found.rotation_sigma_rad
    for last in edges[1::2] - 1:
        yield FilterGap(
            first_s=float(found.timestamps_s[last] - found.since_pose_s[last]), last_s=float(found.timestamps_s[last]),
            position_sigma=float(position[last]), rotation_sigma_deg=float(np.degrees(rotation[last])),
        )  # fmt: skip


def _told(report: FilterReport) -> str:
    text = (
        f"filtered by {report.prediction.replace('imu', 'the IMU')}: {report.num_poses} poses at {report.rate_hz:.4g} "
        f"Hz, {report.num_used} measured ones used, {len(report.rejected)} rejected, {len(report.gaps)} gaps bridged"
    )
    if report.consistency is not None:
        told = report.consistency
        text += (
            f"; innovations {told.mean:.2f} of what is expected ({told.mean_low:.2f} to {told.mean_high:.2f} by "
            f"chance), {told.share_inside:.0%} inside 95 %"
        )
    return text if report.reason is None else f"{text}; not by the IMU: {report.reason}"
