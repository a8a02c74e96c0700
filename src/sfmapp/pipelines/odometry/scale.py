"""Metres for the maps of one camera: from what the user knows, map by map, and said in the report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import widened_scale_sigma
from sfmapp.errors import UsageError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Sequence
from sfmapp.odometry.inertial.markers import MarkerDetector, MarkerKind, parse_marker, scale_from_markers
from sfmapp.odometry.inertial.scale import (
    KnownDistance,
    Length,
    ScaleEstimate,
    ScaleRefusal,
    apply_scale,
    parse_distance,
    parse_length,
    scale_covariance,
    scale_from_camera_height,
    scale_from_distance,
    scale_from_path,
)
from sfmapp.odometry.report import DistanceEvidence, InertialEvidence, ScaleEvidence, ScaleReport
from sfmapp.odometry.result import MapResult, OdometryResult

STAGE = "scale"
# Clocks that differ by less are as good as one: exposures alone shift them by so much.
_WORTH_SAYING_S = 5e-3
# Mountings as calibrations give them are good to this.
_WORTH_SAYING_DEG, _WORTH_SAYING_M = 0.5, 0.01
Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScaleRequest:
    """What a scale is to come from; one of the four is set.

    Attributes:
        text: as the user wrote it.
        camera_height: of the camera over the ground.
    """

    text: str
    marker: MarkerKind | None = None
    distance: KnownDistance | None = None
    camera_height: Length | None = None
    imu: bool = False

    def detector(self) -> MarkerDetector | None:
        """What looks for the markers, if it is they."""
        return None if self.marker is None else MarkerDetector(self.marker.dictionary)


def parse_scale(text: str) -> ScaleRequest | None:
    """``marker:DICT:METRES``, ``distance:A:B:METRES``, ``distance:path:METRES``, ``camera_height:METRES``, ``imu``, or
    ``arbitrary``, which is None.

    Raises:
        UsageError: none of these.
    """
    kind, _, rest = text.strip().partition(":")
    match kind:
        case "marker":
            return ScaleRequest(text, marker=parse_marker(rest))
        case "distance":
            return ScaleRequest(text, distance=parse_distance(rest.replace(":", ",")))
        case "camera_height":
            return ScaleRequest(text, camera_height=parse_length(rest))
        case "imu" if not rest:
            return ScaleRequest(text, imu=True)
        case "arbitrary" if not rest:
            return None
    raise UsageError(
        f"--scale {text}: expected marker, distance, camera_height or imu",
        "marker:DICT_4X4_50:0.16, distance:FRAME:FRAME:2.5, distance:path:120, camera_height:1.65, imu or arbitrary",
    )


def resolve_scale_request(scale_request: ScaleRequest | None, is_auto: bool, sequence: Sequence) -> ScaleRequest | None:
    """What the scale will come from; what the sequence cannot give is refused before an hour is spent on it.

    Args:
        is_auto: the user has said nothing.

    Raises:
        UsageError: a stereo sequence, which is in metres already, or no IMU.
    """
    if scale_request is None:
        has_imu = is_auto and sequence.imu is not None and not sequence.rig.is_stereo
        return ScaleRequest("imu", imu=True) if has_imu else None
    if sequence.rig.is_stereo:
        raise UsageError(
            f"--scale {scale_request.text}: the sequence is stereo and in metres", "leave it out, or add --mono"
        )
    if scale_request.imu and sequence.imu is None:
        raise UsageError("--scale imu: the sequence has no inertial measurements", "name them: --imu FILE")
    return scale_request


def takes_imu(scale_request: ScaleRequest | None, is_auto: bool) -> bool:
    """Whether inertial measurements count in the closing adjustment: unless metres come from elsewhere, or not at all.

    Args:
        scale_request, is_auto: as of :func:`resolve_scale_request`.
    """
    return is_auto or (scale_request is not None and scale_request.imu)


def scale_maps(result: OdometryResult, scale_request: ScaleRequest, events: Events) -> list[ScaleReport]:
    """Put each map in metres that the request can be met for, in place; returns a row for each, with the evidence."""
    rows = []
    for m in range(len(result.maps)):
        found = _estimate(result, m, scale_request)
        row = ScaleReport(map=m, source=found.source, evidence=found.evidence)
        if isinstance(found, ScaleEstimate):
            rescale(result, m, found)
            row = replace(row, metres_per_unit=found.scale, sigma_relative=found.sigma_relative)
            text = f"map {m} is in metres, from {found.source.replace('_', ' ')}, to {100 * found.sigma_relative:.2g} %"
            events.decided(STAGE, text, **row)
            for apart in (_clocks_apart(found.evidence), _mounted_otherwise(found.evidence)):
                if apart:
                    events.warned(STAGE, f"map {m}: {apart}")
        else:
            row = replace(row, reason=found.reason)
            if found.contradiction is not None:
                entry = result.maps[m]
                result.maps[m] = replace(entry, contradictions=[*entry.contradictions, found.contradiction])
            events.warned(STAGE, f"map {m} keeps an arbitrary unit of length: {found.reason}", **row)
        rows.append(row)
    return rows


def _clocks_apart(evidence: ScaleEvidence) -> str:
    """What the offset between the clocks is, where it is one; empty elsewhere."""
    if not isinstance(evidence, InertialEvidence) or evidence.clock_offset_s is None or evidence.clock_sigma_s is None:
        return ""
    offset, sigma = evidence.clock_offset_s, evidence.clock_sigma_s
    if not abs(offset) > max(_WORTH_SAYING_S, 3 * sigma):
        return ""
    side = "late" if offset > 0 else "early"
    return f"the inertial measurements are stamped {1e3 * abs(offset):.1f} ms {side}; this is taken into account"


def _mounted_otherwise(evidence: ScaleEvidence) -> str:
    """How the sensor sits on the camera, where that is clearly not what was given; empty elsewhere."""
    if not isinstance(evidence, InertialEvidence):
        return ""
    turn = _if_clear(evidence.mounting_turn_deg, evidence.mounting_turn_sigma_deg, _WORTH_SAYING_DEG)
    way = _if_clear(evidence.mounting_shift_m, evidence.mounting_shift_sigma_m, _WORTH_SAYING_M)
    parts = [f"turned by ({turn}) degrees"] * bool(turn) + [f"({way}) m away"] * bool(way)
    if not parts:
        return ""
    return (
        f"the inertial sensor is {' and '.join(parts)} from where the given mounting (T_BS, imu_from_cam) has it; "
        "this is taken into account"
    )


def _if_clear(value: Iterable[float] | None, sigma: Iterable[float] | None, least: float) -> str:
    """Components with their standard deviations, if any is larger than three of these and than what is worth saying."""
    if value is None or sigma is None or not any(abs(v) > max(least, 3 * s) for v, s in zip(value, sigma, strict=True)):
        return ""
    return ", ".join(f"{v:.3f} +- {s:.3f}" for v, s in zip(value, sigma, strict=True))


def rescale(result: OdometryResult, map_idx: int, found: ScaleEstimate) -> None:
    """A map and its part of the trajectory in metres; live poses stay what they were, in the unit of their time."""
    entry, mine = result.maps[map_idx], result.frame_map == map_idx
    covariance = None if entry.covariance is None else scale_covariance(entry.covariance, found.scale)
    result.maps[map_idx] = replace(
        entry, reconstruction=apply_scale(entry.reconstruction, found.scale), covariance=covariance,
        scale_source=found.source, scale_sigma=widened_scale_sigma(found.sigma_relative, entry.contradictions),
    )  # fmt: skip
    result.cam_from_world[mine, 4:] *= found.scale
    if result.covariance is not None:
        result.covariance[mine] = scale_covariance(result.covariance[mine], found.scale)
    if result.measured_covariance is not None:
        result.measured_covariance[mine] = scale_covariance(result.measured_covariance[mine], found.scale)
    if result.smoothed:
        smooth = result.smoothed[map_idx]
        poses = np.concatenate([smooth.cam_from_world[:, :4], found.scale * smooth.cam_from_world[:, 4:]], 1)
        covariance = scale_covariance(smooth.covariance, found.scale)
        velocity = found.scale * smooth.velocity
        result.smoothed[map_idx] = replace(smooth, cam_from_world=poses, covariance=covariance, velocity=velocity)


def _estimate(result: OdometryResult, m: int, scale_request: ScaleRequest) -> ScaleEstimate | ScaleRefusal:
    entry = result.maps[m]
    if scale_request.marker is not None:
        return scale_from_markers(entry.reconstruction, entry.sightings, scale_request.marker.side)
    if scale_request.camera_height is not None:
        return scale_from_camera_height(entry.reconstruction, entry.keyframe_image_idx, scale_request.camera_height)
    if scale_request.distance is not None:
        return _from_distance(result, m, scale_request.distance)
    return _from_imu(entry)


def _from_distance(result: OdometryResult, m: int, scale_request: KnownDistance) -> ScaleEstimate | ScaleRefusal:
    entry = result.maps[m]
    if scale_request.frames is None:
        return scale_from_path(entry.reconstruction.cam_from_world[entry.keyframe_image_idx], scale_request.length)
    positions = [_frame_named(result, name) for name in scale_request.frames]
    for name, k in zip(scale_request.frames, positions, strict=True):
        if k is None:
            shown = ", ".join(result.frame_names[:2])
            reason = f"there is no frame {name!r}; they are named such as {shown}, or by number"
            return ScaleRefusal("distance", reason, DistanceEvidence())
        if result.frame_map[k] != m:
            return ScaleRefusal("distance", f"frame {name} has no pose in it", DistanceEvidence())
    a, b = (k for k in positions if k is not None)
    poses = result.cam_from_world
    return scale_from_distance(
        poses[a], poses[b], scale_request.length, _covariance_near(result, entry, a), _covariance_near(result, entry, b)
    )


def _frame_named(result: OdometryResult, name: str) -> int | None:
    """Position of a frame given by its name, with or without folder and suffix, or by its number."""
    for k, full in enumerate(result.frame_names):
        if name in (full, full.rpartition("/")[2], full.rpartition("/")[2].rpartition(".")[0]):
            return k
    found = np.flatnonzero(result.frame_idx == int(name)) if name.isdigit() else np.zeros(0, np.int64)
    return int(found[0]) if len(found) else None


def _covariance_near(result: OdometryResult, entry: MapResult, position: int) -> Array | None:
    """That of the keyframe which is nearest in the order of frames; None where there is none."""
    if entry.covariance is None or not len(entry.covariance):
        return None
    nearest = int(np.abs(entry.keyframe_frame_idx - result.frame_idx[position]).argmin())
    covariance = entry.covariance[nearest]
    return covariance if np.isfinite(covariance).all() else None


def _from_imu(entry: MapResult) -> ScaleEstimate | ScaleRefusal:
    found = entry.inertial
    if found is None:
        reason = "the map was made without the inertial measurements"
        return ScaleRefusal("imu", reason, InertialEvidence(num_poses=0, num_intervals=0))
    if isinstance(found, ScaleRefusal):
        return found
    return replace(found, sigma_relative=math.hypot(found.sigma_relative, _bend(entry)))


def _bend(entry: MapResult) -> float:
    """By how much of its size a map may be bent, beyond the noise of its observations: a length that is told by a part
    of the map is no better known than that for the rest. What contradictions add to a length they say themselves."""
    if entry.covariance is None or entry.noise_covariance is None:
        return 0.0
    variance = np.trace((entry.covariance - entry.noise_covariance)[:, 3:, 3:], axis1=1, axis2=2)
    spread = rigid3.spread(entry.reconstruction.cam_from_world[entry.keyframe_image_idx])
    known = np.isfinite(variance)
    if not (known.any() and spread > 0):
        return 0.0
    said = 3.0 * sum(c.position_sigma_share**2 for c in entry.contradictions)
    return math.sqrt(max(float(variance[known].mean()) / spread**2 - said, 0.0))
