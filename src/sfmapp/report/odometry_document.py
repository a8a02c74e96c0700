"""What came of a sequence: frames and gaps, maps, the error against the ground truth, and checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.evaluation.trajectory import (
    MIN_PAIRS,
    AbsoluteError,
    Alignment,
    Pairs,
    Trajectory,
    absolute_error,
    associate,
    statistics,
)
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import GroundTruth
from sfmapp.odometry.report import FilterReport, KnownMapReport
from sfmapp.odometry.result import FrameState, MapResult, OdometryResult
from sfmapp.report.document import check, check_contradictions
from sfmapp.report.model import (
    Check,
    FramesReport,
    Gap,
    GroundTruthReport,
    Light,
    LiveReport,
    MapReport,
    MedianMax,
    TimingReport,
)

FORMAT = "sfmapp odometry report 2"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameTable:
    """What was seen of each frame while it was tracked, over frames (F); NaN where nothing was told.

    Attributes:
        num_tracked, num_mapped: (F,) float64 points followed, and those that the pose was measured with.
        time_ms: (F,) CPU milliseconds of tracking, back end not included.
        live_map: (F,) int64, the map whose world its live pose is in, as maps were counted then; -1 without one.
    """

    num_tracked: Array
    num_mapped: Array
    time_ms: Array
    live_map: NDArray[np.int64]

    def live_maps(self) -> list[int]:
        """Numbers of the live maps, the one with the most frames first. Each had a world of its own."""
        numbers, counts = np.unique(self.live_map[self.live_map >= 0], return_counts=True)
        return [int(number) for number in numbers[np.argsort(-counts, kind="stable")]]


@dataclass(frozen=True)
class GroundTruthFit:
    """One map's trajectory against the ground truth."""

    pairs: Pairs
    error: AbsoluteError
    alignment: str


def frame_summary(result: OdometryResult) -> FramesReport:
    """Counts of the frames by what became of them, and the gaps."""
    counts = {state.name.lower(): int((result.frame_state == state).sum()) for state in FrameState}
    has_pose = np.isfinite(result.cam_from_world[:, 0])
    played = int(result.frame_idx[-1] - result.frame_idx[0]) + 1 if len(result.frame_idx) else 0
    return FramesReport(
        num_frames=len(result.frame_idx),
        num_unreadable=played - len(result.frame_idx),
        num_with_pose=int(has_pose.sum()),
        num_in_largest_map=int((result.frame_map == 0).sum()),
        **counts,
        gaps=gaps(result),
    )


def gaps(result: OdometryResult) -> list[Gap]:
    """Stretches of frames without a pose, in order; one of no frames where one map follows right after another."""
    has_pose = np.isfinite(result.cam_from_world[:, 0])
    edges = np.diff(np.concatenate([[0], (~has_pose).astype(np.int8), [0]]))
    rows = []
    for first, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        before, after = max(int(first) - 1, 0), min(int(end), len(has_pose) - 1)
        rows.append(
            Gap(
                first_frame=int(result.frame_idx[first]),
                last_frame=int(result.frame_idx[end - 1]),
                num_frames=int(end - first),
                duration_s=float(result.timestamps_s[after] - result.timestamps_s[before]),
                map_before=int(result.frame_map[first - 1]) if first else None,
                map_after=int(result.frame_map[end]) if end < len(has_pose) else None,
            )
        )
    changes = (np.diff(result.frame_map) != 0) & has_pose[1:] & has_pose[:-1]
    for k in np.flatnonzero(changes):
        rows.append(
            Gap(
                first_frame=int(result.frame_idx[k + 1]),
                last_frame=int(result.frame_idx[k]),
                num_frames=0,
                duration_s=float(result.timestamps_s[k + 1] - result.timestamps_s[k]),
                map_before=int(result.frame_map[k]),
                map_after=int(result.frame_map[k + 1]),
            )
        )
    return sorted(rows, key=lambda gap: gap.first_frame)


def map_row(result: OdometryResult, map_idx: int) -> MapReport:
    """One map in numbers; lengths in metres if its scale is known."""
    entry, mine = result.maps[map_idx], np.flatnonzero(result.frame_map == map_idx)
    summary = entry.reconstruction.summary()
    centers = rigid3.center(result.cam_from_world[mine])
    position, rotation_deg = _sigmas(entry)
    return MapReport(
        idx=map_idx,
        num_frames=len(mine),
        first_frame=int(result.frame_idx[mine[0]]) if len(mine) else None,
        last_frame=int(result.frame_idx[mine[-1]]) if len(mine) else None,
        num_keyframes=len(entry.keyframe_frame_idx),
        num_points=summary.num_points,
        num_observations=summary.num_observations,
        mean_track_length=summary.mean_track_length,
        mean_reprojection_error_px=summary.mean_reprojection_error_px,
        path_length=float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()),
        unit=unit_of(entry),
        scale_source=entry.scale_source,
        scale_sigma=entry.scale_sigma,
        gauge=entry.gauge,
        position_sigma=position,
        rotation_sigma_deg=rotation_deg,
        covariance_gap=entry.covariance_gap,
        contradictions=entry.contradictions,
        adjustment=entry.adjustment,
    )


def unit_of(entry: MapResult) -> str:
    """``m``, or empty where the unit of length is arbitrary."""
    return "" if entry.scale_source == "none" else "m"


def _sigmas(entry: MapResult) -> tuple[MedianMax | None, MedianMax | None]:
    """Standard deviations of the keyframes: position as the root of the trace, rotation in degrees likewise."""
    if entry.covariance is None or not np.isfinite(entry.covariance).any():
        return None, None
    diagonal = np.maximum(np.diagonal(entry.covariance, axis1=1, axis2=2), 0)
    rotation, position = np.sqrt(diagonal[:, :3].sum(1)), np.sqrt(diagonal[:, 3:].sum(1))
    return (
        MedianMax(median=float(np.nanmedian(position)), max=float(np.nanmax(position))),
        MedianMax(median=float(np.degrees(np.nanmedian(rotation))), max=float(np.degrees(np.nanmax(rotation)))),
    )


def fit_to_ground_truth(result: OdometryResult, ground_truth: GroundTruth, map_idx: int) -> GroundTruthFit | None:
    """A map's poses after an alignment to the ground truth: with a scale of its own where that is unknown.

    None if the two have too little in common.
    """
    is_metric = unit_of(result.maps[map_idx]) != ""
    return _against(
        result, np.where((result.frame_map == map_idx)[:, None], result.cam_from_world, np.nan), ground_truth, is_metric
    )


def fit_live_to_ground_truth(
    result: OdometryResult, ground_truth: GroundTruth, facts: FrameTable
) -> GroundTruthFit | None:
    """The same of the live poses of the longest live map. Metres from anywhere but a rig are known only in the end."""
    maps = facts.live_maps()
    if not maps:
        return None
    is_metric = any(entry.scale_source == "stereo" for entry in result.maps)
    poses = np.where((facts.live_map == maps[0])[:, None], result.live_cam_from_world, np.nan)
    return _against(result, poses, ground_truth, is_metric)


def _against(result: OdometryResult, poses: Array, ground_truth: GroundTruth, is_metric: bool) -> GroundTruthFit | None:
    alignment: Alignment = "se3" if is_metric else "sim3"
    times = ground_truth.timestamps_s
    # nearer than half a frame: a ground truth that is sampled more sparsely than the frames still names its own
    step = float(np.median(np.diff(result.timestamps_s))) if len(result.timestamps_s) > 1 else 0.02
    try:
        pairs = associate(
            Trajectory.from_cam_from_world(poses, result.timestamps_s),
            Trajectory.from_cam_from_world(ground_truth.cam_from_world, times),
            max_difference_s=step / 2,
        )
        if len(pairs) < MIN_PAIRS:
            return None
        return GroundTruthFit(pairs, absolute_error(pairs, alignment), alignment)
    except InputError:
        return None


def errors_of_frames(result: OdometryResult, against: Sequence[GroundTruthFit | None]) -> Array:
    """(F,) distance of each frame's final position from the ground truth, NaN where it is not known."""
    errors = np.full(len(result.frame_idx), np.nan)
    for fit in against:
        if fit is not None:
            errors[fit.pairs.estimate_idx] = fit.error.translation_m
    return errors


def ground_truth_row(fit: GroundTruthFit, map_idx: int, poses: Literal["final", "live"] = "final") -> GroundTruthReport:
    """The error of the poses of a map in numbers: metres and degrees."""
    translation, rotation = statistics(fit.error.translation_m), statistics(fit.error.rotation_deg)
    assert translation is not None
    assert rotation is not None
    return GroundTruthReport(
        map=map_idx,
        poses=poses,
        alignment=fit.alignment,
        num_pairs=len(fit.pairs),
        scale=fit.error.scale,
        true_path_m=fit.pairs.ground_truth.path_m,
        ate_m=translation,
        rotation_deg=rotation,
    )


def make_checks(
    frames: FramesReport,
    maps: Sequence[MapReport],
    pace: TimingReport | LiveReport | None,
    facts: FrameTable,
    known_map: KnownMapReport | None = None,
    filtered: FilterReport | None = None,
) -> list[Check]:
    """Traffic lights over a run, each with its thresholds in words; ``pace``: against the rate of the camera, or of a
    live source."""
    share = 100 * frames.num_in_largest_map / max(1, frames.num_frames)
    rows = [
        check("frames with a pose in the largest map", share, f"{share:.1f} %", 98, 80, "%"),
        check("separate maps", -len(maps), str(len(maps)), -1, -2),
    ]
    if np.isfinite(facts.num_mapped).any():
        mapped = float(np.nanmedian(facts.num_mapped))
        rows.append(check("points that a pose was measured with (median)", mapped, f"{mapped:.0f}", 100, 40))
    if maps:
        error = maps[0].mean_reprojection_error_px
        rows.append(check("reprojection error of the keyframes (mean)", -error, f"{error:.2f} px", -1, -2, "px"))
    if isinstance(pace, LiveReport):
        in_time = 100 * (1 - pace.num_dropped / max(1, pace.num_arrived))
        rows.append(check("frames that were tracked in time", in_time, f"{in_time:.1f} %", 95, 60, "%"))
    elif pace is not None and pace.times_real_time:
        speed = pace.times_real_time
        rows.append(check("speed against the camera's", speed, f"{speed:.2f} x", 1, 0.5, "x"))
    for found in maps:
        if found.covariance_gap:
            # a map without any is one whose sigmas nobody knows; one that lacks some states the others
            light: Light = "amber" if found.position_sigma is not None or found.num_keyframes < 2 else "red"
            thresholds = "green: every keyframe has a covariance, amber: some have"
            name = f"uncertainty of the keyframes of map {found.idx}"
            rows.append(Check(name=name, value=found.covariance_gap, light=light, thresholds=thresholds))
    if known_map is not None:
        rows.append(_known_map_check(known_map))
    contradictions = [each for found in maps for each in found.contradictions]
    return rows + check_contradictions([*contradictions, *(() if filtered is None else filtered.contradictions)])


def _known_map_check(row: KnownMapReport) -> Check:
    """Whether the sequence was found in the known map, and agrees with it."""
    name, thresholds = f"found in {row.source}", "green: and in agreement, amber: cannot be compared, red: not found"
    if not row.is_found:
        return Check(name=name, value="no frame", light="red", thresholds=thresholds)
    sigmas = [s for s in (row.position_sigmas, row.rotation_sigmas) if s is not None]
    light: Light = "amber" if not sigmas else "green" if max(sigmas) <= row.max_sigmas else "red"
    told = f", {max(sigmas):.1f} standard deviations off" if sigmas else ""
    return Check(name=name, value=f"{row.num_localised} frames{told}", light=light, thresholds=thresholds)
