"""What is kept of every frame, and how a result is made of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import widened, widened_scale_sigma
from sfmapp.geometry import rigid3
from sfmapp.odometry.keyframe_images import KeyframeImages
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.options import MAX_COVARIANCE_KEYFRAMES
from sfmapp.odometry.refinement.final_adjustment import FinalAdjustment
from sfmapp.odometry.residual_memory import NOT_KNOWN, Correlation
from sfmapp.odometry.result import FrameState, MapResult, OdometryResult
from sfmapp.odometry.tracker import measure_pose

Array = NDArray[np.float64]

_NO_POSE, _NO_COVARIANCE = np.full(7, np.nan), np.full((6, 6), np.nan)


@dataclass
class FrameRecord:
    """What is kept of a frame: its pose relative to a keyframe, so that it moves with the map, and what it saw.

    Attributes:
        map_idx: number of the map in the order of their beginnings, -1 without one.
        keyframe: position in the map's keyframes. frame_from_keyframe: (7,), NaN without a pose.
        is_keyframe: it is that keyframe.
        live: (7,) cam_from_world as it was given out. live_covariance: (6, 6) of it given the map at that time, as of
            ``refine_pose``; NaN where it was not measured. correlation: of its residuals with those of frames before.
        covariance: (6, 6) of the pose given the map, as of ``refine_pose``; NaN where it was not measured.
        point_id: (N,) int32 and xy: (N, 2) float32, the points that its pose was measured with.
        cpu_s: CPU seconds of tracking, without the back end.
        is_twin: it shows what the frame before it shows, and has the pose of that one.
    """

    frame_idx: int
    name: str
    timestamp_s: float
    state: FrameState = FrameState.WAITING
    map_idx: int = -1
    keyframe: int = -1
    is_keyframe: bool = False
    frame_from_keyframe: Array = field(default_factory=_NO_POSE.copy)
    live: Array = field(default_factory=_NO_POSE.copy)
    live_covariance: Array = field(default_factory=_NO_COVARIANCE.copy)
    correlation: Correlation = NOT_KNOWN
    covariance: Array = field(default_factory=_NO_COVARIANCE.copy)
    point_id: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    xy: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    cpu_s: float = 0.0
    is_twin: bool = False

    @property
    def has_pose(self) -> bool:
        """Whether the frame has a place in its map."""
        return bool(np.isfinite(self.frame_from_keyframe[0]))

    def settle(
        self, state: FrameState, map_idx: int, keyframe: int, frame_from_keyframe: Array, *, is_keyframe: bool = False
    ) -> None:
        """Give the frame its place in a map: a pose (7,) relative to a keyframe, which it may be itself."""
        self.state, self.map_idx, self.keyframe, self.is_keyframe = state, map_idx, keyframe, is_keyframe
        self.frame_from_keyframe = frame_from_keyframe

    def give_out(self, cam_from_world: Array) -> None:
        """Note the pose (7,) as it is given out, in the world and the unit that the map has at this time."""
        self.live = cam_from_world.copy()

    def see(self, point_id: NDArray[np.integer], xy: Array) -> None:
        """Note the points (N,) that the pose was measured with, and the pixels (N, 2) at which they were seen."""
        self.point_id, self.xy = point_id.astype(np.int32), xy.astype(np.float32)

    def be_twin_of(self, before: FrameRecord) -> None:
        """Have seen what the frame before has seen, the same arrays where that is no keyframe."""
        self.is_twin = True
        if len(before.xy):
            self.point_id, self.xy = before.point_id, before.xy

    def measure(self, covariance: Array, frame_from_keyframe: Array) -> None:
        """Note how well the points hold the pose; a frame that is no keyframe takes the pose as well."""
        self.covariance = covariance
        if not self.is_keyframe:
            self.frame_from_keyframe = frame_from_keyframe

    def lose_keyframe(self, dropped_from_before: Array, dropped: Keyframe) -> None:
        """The keyframe that the frame is, or hangs on, is dropped: hang on the one before it."""
        self.frame_from_keyframe = rigid3.compose(self.frame_from_keyframe, dropped_from_before)
        self.keyframe -= 1
        if self.is_keyframe:
            self.is_keyframe = False
            good = dropped.is_inlier[:, 0]
            self.see(dropped.point_id[good], dropped.xy[good, 0])

    def move(self, scale: float, become: NDArray[np.int32], id_offset: int = 0) -> None:
        """The map has changed under the frame: another unit of length, and other ids of points.

        Args:
            scale: new unit of length from the old one. become: (P,) new id by old id, ``id_offset`` added to that.
        """
        self.frame_from_keyframe[4:] *= scale
        self.point_id = become[self.point_id + id_offset]

    def join(self, map_idx: int, keyframe: int) -> None:
        """The keyframe that the frame hangs on has another place, maybe in another map."""
        self.map_idx, self.keyframe = map_idx, keyframe


def leave_keyframe(
    records: list[FrameRecord], map_idx: int, position: int, dropped: Keyframe, before: Keyframe
) -> None:
    """Tie the frames of a dropped keyframe to the one before it, and its own frame with what it saw."""
    change = rigid3.compose(dropped.rig_from_world, rigid3.inverse(before.rig_from_world))
    for record in records:
        if record.map_idx != map_idx or record.keyframe < position:
            continue
        if record.keyframe == position:
            record.lose_keyframe(change, dropped)
        else:
            record.join(map_idx, record.keyframe - 1)


def measure_again(records: list[FrameRecord], keyframes: KeyframeMap, map_idx: int) -> None:
    """Poses of the frames between the keyframes of a map, from the points as they are in the end, and how well these
    hold them. Keyframes stay where the adjustment has put them."""
    camera, last = keyframes.rig.cameras[0], None
    for record in records:
        if record.map_idx != map_idx or not record.has_pose:
            continue
        if last is not None and shows_the_same(record, last):
            record.measure(last.covariance, last.frame_from_keyframe)
            continue
        last = record
        keyframe = keyframes.keyframes[record.keyframe]
        point_id, xy = record.point_id.astype(np.int64), record.xy.astype(np.float64)
        if record.is_keyframe:
            point_id, xy = keyframe.point_id[keyframe.is_inlier[:, 0]], keyframe.xy[keyframe.is_inlier[:, 0], 0]
        xyz = keyframes.point_xyz[point_id]
        known = np.isfinite(xyz[:, 0])
        start = rigid3.compose(record.frame_from_keyframe, keyframe.rig_from_world)
        measured = measure_pose(camera, start, xyz[known], xy[known])
        if measured is None:
            continue
        record.measure(measured[1], rigid3.compose(measured[0], rigid3.inverse(keyframe.rig_from_world)))


def shows_the_same(record: FrameRecord, before: FrameRecord) -> bool:
    """Whether a frame is the twin of the one before it, and saw what that one saw."""
    return record.is_twin and record.xy is before.xy and record.keyframe == before.keyframe


def gather(
    records: list[FrameRecord],
    maps: dict[int, KeyframeMap],
    conclusions: dict[int, FinalAdjustment],
    images: KeyframeImages,
) -> OdometryResult:
    """The result of a run, the map with the most frames first."""
    poses = np.full((len(records), 7), np.nan)
    frame_map = np.full(len(records), -1, np.int64)
    for n, record in enumerate(records):
        if record.has_pose:
            keyframe = maps[record.map_idx].keyframes[record.keyframe]
            poses[n] = rigid3.compose(record.frame_from_keyframe, keyframe.rig_from_world)
            frame_map[n] = record.map_idx
    order = sorted(maps, key=lambda m: (-int((frame_map == m).sum()), m))
    place = np.array([-1 if m < 0 else order.index(int(m)) for m in frame_map], np.int32)
    results = [_map_result(maps[m], conclusions[m], images) for m in order]
    covariance = [
        _covariance(record, results[m], maps[record.map_idx].num_known) if m >= 0 else _NO_COVARIANCE
        for record, m in zip(records, place, strict=True)
    ]
    return OdometryResult(
        np.array([r.frame_idx for r in records], np.int64), [r.name for r in records],
        np.array([r.timestamp_s for r in records]), poses, np.array([r.live for r in records]).reshape(-1, 7), place,
        np.array([r.state for r in records], np.uint8), results, np.array(covariance).reshape(-1, 6, 6),
        measured_covariance=np.array([r.covariance for r in records]).reshape(-1, 6, 6),
    )  # fmt: skip


def _covariance(record: FrameRecord, found: MapResult, num_known: int) -> Array:
    """(6, 6) of a frame's pose in the gauge of its map, which knew so many keyframes before; NaN where it is not known.

    Points near a frame err together with the keyframe that it hangs on, whose covariance goes through the adjoint of
    the frame's pose relative to it; what the frame was measured with, given the points, is independent of that.
    """
    if found.covariance is None:
        return _NO_COVARIANCE
    of_keyframe: Array = found.covariance[record.keyframe - num_known]
    if record.is_keyframe:
        return of_keyframe
    rotation, adjoint = rigid3.rotation_matrix(record.frame_from_keyframe), np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = rotation
    adjoint[3:, :3] = rigid3.skew(record.frame_from_keyframe[4:]) @ rotation
    return adjoint @ of_keyframe @ adjoint.T + record.covariance


def _map_result(keyframes: KeyframeMap, final: FinalAdjustment, images: KeyframeImages) -> MapResult:
    num, num_sensors = len(keyframes.keyframes), len(keyframes.rig.cameras)
    model, _ = keyframes.reconstruction(np.arange(num))
    frame_idx = np.array([k.frame_idx for k in keyframes.keyframes], np.int64)
    image_idx = np.arange(num, dtype=np.int64) * num_sensors
    model.point_rgb = images.colors(model, frame_idx, image_idx)
    own = slice(keyframes.num_known, None)  # keyframes of a known map are in the model, and no frames of this run
    frame_idx, image_idx = frame_idx[own], image_idx[own]
    final = replace(final, covariance=_own(final.covariance, own), noise_covariance=_own(final.noise_covariance, own))
    covariance, found = final.covariance, final.contradictions
    gap = _covariance_gap(final, len(frame_idx))
    if covariance is not None:
        poses = np.array([k.rig_from_world for k in keyframes.keyframes[own]])
        covariance = widened(covariance, rigid3.spread(poses), found)
    return MapResult(
        model, frame_idx, image_idx, covariance, final.gauge, "stereo" if num_sensors > 1 else "none",
        widened_scale_sigma(final.scale_sigma, found), found, gap, final.noise_covariance,
        images.sightings(frame_idx, image_idx), final.adjustment, final.inertial,
        final.report.plane,
    )  # fmt: skip


def _own(covariance: Array | None, own: slice) -> Array | None:
    return None if covariance is None else covariance[own]


def _covariance_gap(final: FinalAdjustment, num_keyframes: int) -> str:
    """Why keyframes have no covariance; empty where all have one, or none was asked for."""
    covariance = final.covariance
    if covariance is None:
        if num_keyframes < 2:
            return "a single keyframe has nothing that it could be uncertain against"
        if num_keyframes > MAX_COVARIANCE_KEYFRAMES or final.report.get("is_piecewise"):
            return f"{num_keyframes} keyframes are too many for covariances, {MAX_COVARIANCE_KEYFRAMES} the most"
        return ""
    num_known = int(np.isfinite(covariance).all((1, 2)).sum())
    if num_known == 0:
        return "the observations do not determine the poses: more than place and size of the map is open"
    unheld = f"{num_keyframes - num_known} of {num_keyframes} keyframes are held by no points"
    return unheld if num_known < num_keyframes else ""
