"""What an odometry run hands over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustReport
from sfmapp.contradictions import Contradiction
from sfmapp.images.sequence import RepeatedFrame
from sfmapp.odometry.inertial.filtering import FilteredTrajectory
from sfmapp.odometry.inertial.markers import MarkerSightings
from sfmapp.odometry.inertial.scale import ScaleEstimate, ScaleRefusal
from sfmapp.odometry.inertial.smoothing import SmoothedTrajectory
from sfmapp.odometry.report import OdometryReport, PlaneEvidence
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]


class FrameState(IntEnum):
    """What became of a frame."""

    WAITING = 0  # no pose at its time; has one if a map that began, or was found again, reached back to it
    TRACKED = 1  # its pose was measured against the map
    RELOCALIZED = 2  # the first one found again after a loss
    LOST = 3  # no pose: a gap in the trajectory
    REPEATED = 4  # shows what the frame before it shows, to the byte: has what that one has


@dataclass
class MapResult:
    """One connected map: keyframes, points, and how sure they are.

    Attributes:
        reconstruction: images are keyframes (stereo: two images each, tied by ``rig``), named as the frames; points
            have the mean grey of where the keyframes saw them.
        keyframe_frame_idx: (K,) int64, the frame that each keyframe is.
        keyframe_image_idx: (K,) int64, its image (of the first camera) in the reconstruction.
        covariance: (K, 6, 6) of rotation (radians) and translation of ``x_cam <- exp(w) x_cam + v`` in the map's gauge
            (see ``gauge``); NaN where it could not be had. None if it was not asked for.
        gauge: what the covariance holds fixed, in words.
        scale_source: ``stereo``, ``none`` (arbitrary unit), ``marker``, ``distance``, ``camera_height`` or ``imu``.
        scale_sigma: relative standard deviation of the unit of length; None for an arbitrary unit.
        contradictions: evidence against the map that was not resolved; covariance and scale_sigma hold what it adds.
        covariance_gap: why keyframes lack a covariance; empty where none does, or none was asked for.
        noise_covariance: (K, 6, 6) the part of ``covariance`` that the noise of the observations makes; the rest
            (calibration, contradictions) is common to neighbouring keyframes. In the map's first unit of length.
        sightings: the markers in the keyframes, where they were looked for.
        adjustment: the closing adjustment; None for a map that was adjusted piece by piece, or read from files.
        inertial: what an inertial sensor that took part in it says of the unit of length, or why it does not.
        plane: that of a camera on wheels, held, dropped or offered; None where the motion is free and looks so.
    """

    reconstruction: Reconstruction
    keyframe_frame_idx: NDArray[np.int64]
    keyframe_image_idx: NDArray[np.int64]
    covariance: Array | None = None
    gauge: str = ""
    scale_source: str = "none"
    scale_sigma: float | None = None
    contradictions: list[Contradiction] = field(default_factory=list)
    covariance_gap: str = ""
    noise_covariance: Array | None = None
    sightings: MarkerSightings = field(default_factory=MarkerSightings.none)
    adjustment: AdjustReport | None = None
    inertial: ScaleEstimate | ScaleRefusal | None = None
    plane: PlaneEvidence | None = None


@dataclass
class OdometryResult:
    """The trajectory and the maps of a run, over frames (F) in order, the unreadable ones left out.

    Attributes:
        frame_idx: (F,) int64 as in :class:`~sfmapp.images.sequence.Frame`.
        frame_names, timestamps_s: F of each.
        cam_from_world: (F, 7) final poses of the rig's first camera, NaN in gaps. Each in the world of its map.
        live_cam_from_world: (F, 7) the poses as they were given out at the time of the frame, NaN in gaps.
        frame_map: (F,) int32 position in ``maps``, -1 in gaps.
        frame_state: (F,) uint8 of :class:`FrameState`.
        maps: the largest (most frames) first; each has a world and, without a scale, a unit of its own.
        covariance: (F, 6, 6) of the final poses in the gauge of their map, over rotation (radians) and translation of
            ``x_cam <- exp(w) x_cam + v``; NaN where not measured, or where the map's keyframes have none. None for a
            result read from files.
        smoothed: for each map its frames as the error-state filter has them; empty if not asked for.
        report: counts, times and decisions, JSON-able.
        measured_covariance: (F, 6, 6) of the final poses given the map, whose errors neighbouring frames share, over
            the same; NaN where not measured. None for a result read from files.
        filtered: the largest map as the error-state filter that knows the past alone has it; None if not asked for.
    """

    frame_idx: NDArray[np.int64]
    frame_names: list[str]
    timestamps_s: Array
    cam_from_world: Array
    live_cam_from_world: Array
    frame_map: NDArray[np.int32]
    frame_state: NDArray[np.uint8]
    maps: list[MapResult]
    covariance: Array | None = None
    smoothed: list[SmoothedTrajectory] = field(default_factory=list)
    report: OdometryReport | None = None
    measured_covariance: Array | None = None
    filtered: FilteredTrajectory | None = None

    @property
    def twin_rows(self) -> NDArray[np.int64]:
        """(F,) positions of the frames that were looked at: for those that repeat another, the position of that one."""
        rows = np.arange(len(self.frame_state))
        rows[self.frame_state == FrameState.REPEATED] = 0
        return np.maximum.accumulate(rows)

    def with_repeated(self, repeated: Sequence[RepeatedFrame]) -> OdometryResult:
        """The same with frames that repeat others, each with the pose, the map and the covariance of its twin."""
        position = {int(idx): k for k, idx in enumerate(self.frame_idx)}
        added = [frame for frame in repeated if frame.twin_idx in position and frame.idx not in position]
        if not added:
            return self
        every = np.concatenate([self.frame_idx, np.array([frame.idx for frame in added], np.int64)])
        order = np.argsort(every, kind="stable")
        row = np.concatenate([np.arange(len(self.frame_idx)), [position[frame.twin_idx] for frame in added]])[order]
        state = np.where(order < len(self.frame_idx), self.frame_state[row], np.uint8(FrameState.REPEATED))
        names = [*self.frame_names, *(frame.name for frame in added)]
        times = np.concatenate([self.timestamps_s, [frame.timestamp_s for frame in added]])
        return OdometryResult(
            every[order], [names[k] for k in order], times[order], self.cam_from_world[row],
            self.live_cam_from_world[row], self.frame_map[row], state.astype(np.uint8), self.maps,
            None if self.covariance is None else self.covariance[row],
            [smoothed.at(row) for smoothed in self.smoothed], self.report,
            None if self.measured_covariance is None else self.measured_covariance[row], self.filtered,
        )  # fmt: skip
