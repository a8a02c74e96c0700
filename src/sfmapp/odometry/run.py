"""Odometry: a sequence to a trajectory and keyframe maps, frame by frame."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.odometry.active_tracks import ActiveTracks
from sfmapp.odometry.backend import adjust_all
from sfmapp.odometry.initialize import Beginning, TwoViews, pose_between
from sfmapp.odometry.local_map import LocalMap, View
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.pyramid import Pyramid, build_pyramid
from sfmapp.odometry.result import FrameState, MapResult, OdometryResult
from sfmapp.odometry.snapshot import FrameSnapshot, MapSnapshot
from sfmapp.odometry.tracker import keyframe_reason, measure_pose, track

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STAGE = "odometry"
_NO_POSE = np.full(7, np.nan)
_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@dataclass
class FrameRecord:
    """What is kept of a frame: its pose relative to a keyframe, so that it moves with the map.

    Attributes:
        keyframe: position in the map's keyframes; frame_from_keyframe: (7,), NaN without a pose.
        live: (7,) cam_from_world as it was given out.
    """

    frame_idx: int
    name: str
    timestamp_s: float
    state: FrameState = FrameState.WAITING
    map_idx: int = -1
    keyframe: int = -1
    frame_from_keyframe: Array = field(default_factory=_NO_POSE.copy)
    live: Array = field(default_factory=_NO_POSE.copy)
    num_mapped: int = 0
    time_s: float = 0.0


class Odometry:
    """The state between two frames. Push frames with :meth:`process`, then call :meth:`finish` once."""

    def __init__(self, sequence: Sequence, options: OdometryOptions, *, seed: int, events: Events) -> None:
        self.rig, self.options, self.seed, self.events = sequence.rig, options, seed, events
        self.executor = ThreadPoolExecutor(1, "adjust")
        self.maps: list[LocalMap] = []
        self.records: list[FrameRecord] = []
        self.local: LocalMap | None = None
        self.beginning = Beginning(self.rig.cameras[0], options, seed)
        self.waiting: list[tuple[FrameRecord, View]] = []
        self.tracks = ActiveTracks.none()
        self.is_mapped = np.zeros(0, bool)
        self.pose, self.step = _IDENTITY, _IDENTITY
        self.previous: Pyramid | None = None
        self.num_mapped_at_keyframe = 0
        self.num_lost = 0

    # ------------------------------------------------------------------ one frame

    def process(self, frame: Frame) -> None:
        """Find the pose of the next frame."""
        start = time.thread_time()
        view = View(
            frame.idx, frame.timestamp_s, frame.name, tuple(build_pyramid(image) for image in frame.images)
        )  # fmt: skip
        record = FrameRecord(frame.idx, frame.name, frame.timestamp_s)
        self.records.append(record)
        if self.local is None:
            self._begin(record, view)
        else:
            self._track(record, view)
        self.previous = view.pyramids[0]
        record.time_s = time.thread_time() - start
        snapshot = FrameSnapshot(
            frame.idx, frame.name, frame.timestamp_s, record.state, frame.images[0],
            self.tracks.xy.astype(np.float32), self.is_mapped, record.live, record.map_idx, record.time_s,
        )  # fmt: skip
        self.events.advanced(STAGE, message=frame.name, snapshot=snapshot)

    def _begin(self, record: FrameRecord, view: View) -> None:
        """Look for a first map."""
        if self.rig.is_stereo:
            self._begin_stereo(record, view)
            return
        pyramid = view.pyramids[0]
        views = self.beginning.add(pyramid)
        if len(self.beginning.seen) == 1:
            self.waiting.clear()  # a new first view: what was before it has no pose
        self.waiting.append((record, view))
        self.tracks = ActiveTracks.none()
        self.is_mapped = np.zeros(0, bool)
        if views is not None:
            self._start_map(views)

    def _begin_stereo(self, record: FrameRecord, view: View) -> None:
        local = self._new_map()
        self.tracks = local.add_keyframe(view, _IDENTITY, ActiveTracks.none(), len(self.records))
        _, self.is_mapped = local.points_of(self.tracks)
        if self.is_mapped.sum() < 40:
            self.maps.pop().backend.finish(local.keyframes)
            self.tracks, self.is_mapped = ActiveTracks.none(), np.zeros(0, bool)
            return
        self.local, self.pose, self.step = local, _IDENTITY, _IDENTITY
        self._settle(record, FrameState.TRACKED, _IDENTITY)
        self._count_mapped()
        self._tell(local, "a map begins with one look of the rig", num_mapped=self.num_mapped_at_keyframe)

    def _new_map(self) -> LocalMap:
        self.maps.append(LocalMap(self.rig, self.options, self.executor, len(self.maps)))
        return self.maps[-1]

    def _start_map(self, views: TwoViews) -> None:
        """Make a map of two views, and give poses to the frames between them."""
        local, number = self._new_map(), len(self.records)
        seen, (first, last) = self.beginning.seen, (self.waiting[0][1], self.waiting[-1][1])
        corners = local.begin(first, self.beginning.corners)
        local.keyframes.point_xyz[corners.point_id[views.track]] = views.xyz
        tracks = corners.moved(seen[-1]).subset(np.isfinite(seen[-1][:, 0]))
        self.tracks = local.add_keyframe(last, views.last_from_first, tracks, number)
        local.backend.finish(local.keyframes)
        self.local, self.pose = local, local.pose(1)
        self._settle(self.waiting[-1][0], FrameState.TRACKED, self.pose)
        before = local.pose(0)
        for n, (record, _) in enumerate(self.waiting[:-1]):
            share = n / (len(self.waiting) - 1)
            before = self._pose_between(local, corners.moved(seen[n]), share)
            self._settle(record, FrameState.WAITING, before, live=False)
        self.step = rigid3.compose(self.pose, rigid3.inverse(before))
        self._count_mapped()
        self._tell(
            local, f"a map begins with two views ({views.config.name.lower()})",
            median_angle_deg=views.median_angle_deg, num_inliers=views.num_inliers, num_tracks=views.num_tracks,
        )  # fmt: skip
        self.waiting.clear()

    def _pose_between(self, local: LocalMap, tracks: ActiveTracks, share: float) -> Array:
        """Pose of a frame between the first two keyframes, from the points that were followed through it."""
        start = pose_between(local.pose(0), local.pose(1), share)
        xyz = local.keyframes.point_xyz[tracks.point_id]
        usable = np.isfinite(xyz[:, 0]) & np.isfinite(tracks.xy[:, 0])
        measured = measure_pose(local.camera, start, xyz[usable], tracks.xy[usable])
        return start if measured is None else measured[0]

    def _track(self, record: FrameRecord, view: View) -> None:
        """Measure the pose in the current map; make a keyframe where one is due."""
        local, number = self.local, len(self.records)
        assert local is not None
        assert self.previous is not None
        self._take_over(local, number)
        tracked = track(local, self.tracks, self.pose, self.step, self.previous, view.pyramids[0])
        if tracked is None:
            self._lose(record, local)
            return
        self.step = rigid3.compose(tracked.pose, rigid3.inverse(self.pose))
        self.pose, self.tracks, self.is_mapped = tracked.pose, tracked.tracks, tracked.is_mapped
        self.num_lost = 0
        reason = keyframe_reason(local, tracked, self.num_mapped_at_keyframe, self.options)
        if reason is not None:
            self._take_over(local, None)
            self.tracks = local.add_keyframe(view, self.pose, self.tracks, number)
            self._count_mapped()
            self._tell(local, reason, num_tracks=len(self.tracks), num_mapped=self.num_mapped_at_keyframe)
        self._settle(record, FrameState.TRACKED, self.pose)

    def _take_over(self, local: LocalMap, number: int | None) -> None:
        """Let a finished adjustment count, and carry the current pose along with its keyframe."""
        before = local.pose(local.newest)
        if local.backend.finish(local.keyframes, number):
            self.pose = rigid3.compose(self.pose, rigid3.compose(rigid3.inverse(before), local.pose(local.newest)))

    def _lose(self, record: FrameRecord, local: LocalMap) -> None:
        record.state, record.map_idx = FrameState.LOST, local.map_idx
        self.num_lost += 1
        if self.num_lost == 1:
            self.events.warned(STAGE, f"{record.name}: tracking is lost", frame_idx=record.frame_idx)

    def _count_mapped(self) -> None:
        assert self.local is not None
        _, self.is_mapped = self.local.points_of(self.tracks)
        self.num_mapped_at_keyframe = int(self.is_mapped.sum())

    def _settle(self, record: FrameRecord, state: FrameState, pose: Array, live: bool = True) -> None:
        """Note the pose of a frame relative to the newest keyframe."""
        assert self.local is not None
        record.state, record.map_idx, record.keyframe = state, self.local.map_idx, self.local.newest
        record.frame_from_keyframe = rigid3.compose(pose, rigid3.inverse(self.local.pose(self.local.newest)))
        record.num_mapped = int(self.is_mapped.sum())
        if live:
            record.live = pose.copy()

    def _tell(self, local: LocalMap, message: str, **data: Any) -> None:
        """Say that the map has changed, with what is new in it."""
        keyframes = local.keyframes
        recent = np.arange(max(0, local.newest - self.options.window), local.newest + 1)
        ids = np.unique(np.concatenate([keyframes.keyframes[k].point_id for k in recent]))
        ids = ids[keyframes.is_triangulated(ids)]
        frames = np.array([keyframes.keyframes[k].frame_idx for k in recent], np.int64)
        snapshot = MapSnapshot(
            int(frames[-1]), local.map_idx, frames, np.array([local.pose(int(k)) for k in recent]), ids,
            keyframes.point_xyz[ids],
        )  # fmt: skip
        self.events.decided(STAGE, message, snapshot=snapshot, frame_idx=int(frames[-1]), keyframe=local.newest, **data)

    # ------------------------------------------------------------------ the end

    def finish(self) -> OdometryResult:
        """Adjust what there is once more, and gather the result."""
        for local in self.maps:
            local.backend.finish(local.keyframes)
            if self.options.final_adjustment and local.newest > 0:
                for _ in adjust_all(local.keyframes):
                    self.events.raise_if_cancelled()
        self.executor.shutdown()
        return gather(self.records, self.maps)


def gather(records: list[FrameRecord], maps: list[LocalMap]) -> OdometryResult:
    """The result of a run, the map with the most frames first."""
    poses = np.full((len(records), 7), np.nan)
    frame_map = np.full(len(records), -1, np.int32)
    for n, record in enumerate(records):
        if np.isfinite(record.frame_from_keyframe[0]):
            poses[n] = rigid3.compose(record.frame_from_keyframe, maps[record.map_idx].pose(record.keyframe))
            frame_map[n] = record.map_idx
    sizes = [int((frame_map == m).sum()) for m in range(len(maps))]
    order = sorted(range(len(maps)), key=lambda m: -sizes[m])
    place = np.full(len(maps) + 1, -1, np.int32)
    place[order] = np.arange(len(maps))
    results = []
    for m in order:
        keyframes = maps[m].keyframes
        model, _ = keyframes.reconstruction(np.arange(len(keyframes.keyframes)))
        step = len(keyframes.rig.cameras)
        results.append(
            MapResult(
                model, np.array([k.frame_idx for k in keyframes.keyframes], np.int64),
                np.arange(len(keyframes.keyframes), dtype=np.int64) * step,
                scale_source="stereo" if keyframes.rig.is_stereo else "none",
                scale_sigma=0.0 if keyframes.rig.is_stereo else None,
            )
        )  # fmt: skip
    return OdometryResult(
        np.array([r.frame_idx for r in records], np.int64), [r.name for r in records],
        np.array([r.timestamp_s for r in records]), poses, np.array([r.live for r in records]).reshape(-1, 7),
        place[frame_map], np.array([r.state for r in records], np.uint8), results,
    )  # fmt: skip


def run_odometry(
    sequence: Sequence, options: OdometryOptions, *, seed: int = 0, threads: int = 1, events: Events | None = None
) -> OdometryResult:
    """Follow the camera through a sequence.

    Args:
        sequence: frames and the rig that took them.
        seed: of everything that is drawn.
        threads: with one, the local adjustment runs beside the tracking all the same; the result does not depend on it.
        events: told of every frame (``advanced`` with a FrameSnapshot) and of every change of the map (``decided`` with
            a MapSnapshot).

    Raises:
        InterruptedRunError: on cancellation.
    """
    events = events or Events()
    odometry = Odometry(sequence, options, seed=seed, events=events)
    events.started(STAGE, total=sequence.num_frames)
    for frame in sequence.frames():
        odometry.process(frame)
    result = odometry.finish()
    events.finished(STAGE, **result.report)
    return result
