"""Odometry: a sequence to a trajectory and keyframe maps, frame by frame."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.odometry.frontend.active_tracks import ActiveTracks
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid
from sfmapp.odometry.inertial.gyroscope import GyroTrust, imu_rotation
from sfmapp.odometry.inertial.smoothing import smooth_trajectory
from sfmapp.odometry.initialize import MapInitializer, TwoViews, pose_between
from sfmapp.odometry.loops.sweep import is_too_large
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.local_map import LocalMap, View
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.recognition import Recognition
from sfmapp.odometry.records import FrameRecord, gather, leave_keyframe, measure_again
from sfmapp.odometry.refinement.early_calibration import is_time_to_ask, refine_early
from sfmapp.odometry.refinement.final_adjustment import adjust_finally
from sfmapp.odometry.result import FrameState, OdometryResult
from sfmapp.odometry.shutter import straighten
from sfmapp.odometry.snapshot import FrameSnapshot, MapSnapshot
from sfmapp.odometry.stereo_clock import StereoClock
from sfmapp.odometry.tracker import MIN_INLIERS, keyframe_reason, measure_pose, track

Array = NDArray[np.float64]

STAGE = "odometry"
# Frames are taken to come at a steady rate within this share of the time between them.
_STEADY_SHARE, _MAX_STEADY_SHARE = 0.2, 3.0
# Fewest points with depth that one look of a rig may begin a map with.
_MIN_STEREO_POINTS = 40


class Odometry:
    """The state between two frames. Push frames with :meth:`process`, then call :meth:`finish` once."""

    def __init__(
        self, sequence: Sequence, options: OdometryOptions, *, seed: int, threads: int, events: Events
    ) -> None:
        self.rig, self.options, self.seed, self.events = sequence.rig, options, seed, events
        self.given_rig, self.is_refined, self.asked = sequence.rig, False, set[tuple[int, int]]()
        self.executor = ThreadPoolExecutor(1, "adjust") if threads > 1 else None
        self.records: list[FrameRecord] = []
        self.maps: dict[int, LocalMap] = {}
        self.local: LocalMap | None = None
        self.num_begun = 0  # numbers of maps that were taken into others are not given again: live poses are in worlds
        self.recognition = Recognition(seed)
        self.initializer = MapInitializer(self.rig.cameras[0], options, seed)
        self.waiting: list[tuple[FrameRecord, View]] = []
        self.tracks, self.is_mapped = ActiveTracks.none(), np.zeros(0, bool)
        self.pose, self.step = rigid3.IDENTITY, rigid3.IDENTITY
        self.imu, self.gyro_trust = sequence.imu, GyroTrust()
        self.foretold: tuple[Array, Array] | None = None  # turns since the last frame, by the gyroscope and if steady
        self.clock = StereoClock(self.rig)
        self.previous: Pyramid | None = None
        self.num_mapped_at_keyframe = 0
        self.lost_since: float | None = None
        self.counts = {"relocalizations": 0, "losses": 0, "loops": 0, "keyframes_culled": 0}
        self.counts |= {"looked_still": 0, "looked_turned": 0}

    def process(self, frame: Frame) -> FrameRecord:
        """Find the pose of the next frame."""
        start = time.thread_time()
        view = View(
            frame.idx,
            frame.timestamp_s,
            frame.name,
            frame.images,
            tuple(build_pyramid(i) for i in frame.images[: len(self.rig.cameras)]),
        )
        record = FrameRecord(frame.idx, frame.name, frame.timestamp_s)
        self.records.append(record)
        if not (self._track(record, view) or self._recover(record, view)):
            self._begin(record, view)
        self.previous = view.pyramids[0]
        record.time_s = time.thread_time() - start
        snapshot = FrameSnapshot(
            frame.idx, frame.name, frame.shown_s, record.state, frame.images[0], self.tracks.xy.astype(np.float32),
            self.is_mapped, record.live, record.map_idx, record.time_s,
        )  # fmt: skip
        self.events.advanced(STAGE, message=frame.name, snapshot=snapshot)
        return record

    # ------------------------------------------------------------------ how a map begins

    def _begin(self, record: FrameRecord, view: View) -> None:
        """Look for a first map, or for another one after a loss that lasts."""
        if self.lost_since is not None:
            record.state = FrameState.LOST
            if record.timestamp_s == self.lost_since:
                self.events.warned(STAGE, f"{record.name}: tracking is lost", frame_idx=record.frame_idx)
        # to the millisecond: what a clock that began in 1970 rounds away may not decide
        is_open = self.lost_since is None or round(record.timestamp_s - self.lost_since, 3) >= self.options.max_lost_s
        if is_open:
            self.tracks, self.is_mapped = ActiveTracks.none(), np.zeros(0, bool)
        if self.rig.is_stereo:
            if is_open and self.clock.is_usable:
                self._begin_stereo(record, view)
            return
        views = self.initializer.add(view.pyramids[0])
        self.counts["looked_still"] += self.initializer.is_still
        self.counts["looked_turned"] += self.initializer.is_turn
        if len(self.initializer.seen) == 1:
            self.waiting.clear()  # a new first view: what was before it has no pose
        self.waiting.append((record, view))
        if views is not None and is_open:
            self._begin_from_two_views(views)

    def _begin_stereo(self, record: FrameRecord, view: View) -> None:
        local = self._new_map()
        tracks = local.add_keyframe(view, rigid3.IDENTITY, ActiveTracks.none(), len(self.records))
        if local.points_of(tracks)[1].sum() < _MIN_STEREO_POINTS:
            del self.maps[local.map_idx]
            local.backend.finish(local.keyframes)
            return
        self._enter(local, tracks, rigid3.IDENTITY)
        self._settle(record, FrameState.TRACKED, rigid3.IDENTITY, is_keyframe=True)
        self._remember(view)
        self._tell("a map begins with one look of the rig", num_mapped=self.num_mapped_at_keyframe)

    def _begin_from_two_views(self, views: TwoViews) -> None:
        """Make a map of two views, and give poses to the frames between them."""
        local, seen = self._new_map(), self.initializer.seen
        (first_record, first), (last_record, last) = self.waiting[0], self.waiting[-1]
        corners = local.begin(first, self.initializer.corners)
        local.keyframes.point_xyz[corners.point_id[views.track]] = views.xyz
        tracks = corners.moved(seen[-1]).subset(np.isfinite(seen[-1][:, 0]))
        tracks = local.add_keyframe(last, views.last_from_first, tracks, len(self.records))
        local.backend.finish(local.keyframes)
        self._enter(local, tracks, local.pose(1))
        self._settle(last_record, FrameState.TRACKED, self.pose, is_keyframe=True)
        self._settle(first_record, FrameState.WAITING, local.pose(0), is_keyframe=True, keyframe=0)
        before = local.pose(0)
        for n, (record, _) in enumerate(self.waiting[1:-1], 1):
            start = pose_between(local.pose(0), local.pose(1), n / (len(self.waiting) - 1))
            xyz = local.keyframes.point_xyz[corners.point_id]
            usable = np.isfinite(xyz[:, 0]) & np.isfinite(seen[n][:, 0])
            measured = measure_pose(local.camera, start, xyz[usable], seen[n][usable])
            before = start if measured is None else measured[0]
            self._settle(record, FrameState.WAITING, before, keyframe=0, tracks=corners.moved(seen[n]).subset(usable))
        self.step = rigid3.compose(self.pose, rigid3.inverse(before))
        self._remember(last)
        self._tell(
            f"a map begins with two views ({views.config.name.lower()})", median_angle_deg=views.median_angle_deg,
            num_inliers=views.num_inliers, num_tracks=views.num_tracks, num_mapped=self.num_mapped_at_keyframe,
        )  # fmt: skip
        self.waiting.clear()
        self.initializer = MapInitializer(self.rig.cameras[0], self.options, self.seed)

    def _new_map(self) -> LocalMap:
        number = self.num_begun
        self.maps[number] = LocalMap(self.rig, self.options, self.executor, number)
        return self.maps[number]

    def _enter(self, local: LocalMap, tracks: ActiveTracks, pose: Array) -> None:
        """Go on from the newest keyframe of a map."""
        self.local, self.tracks, self.pose, self.step = local, tracks, pose, rigid3.IDENTITY
        self.lost_since = None
        self.num_begun = local.map_idx + 1
        self._count_mapped()

    # ------------------------------------------------------------------ tracking

    def _track(self, record: FrameRecord, view: View) -> bool:
        """Measure the pose in the current map; make a keyframe where one is due. False if there is no pose."""
        local, number = self.local, len(self.records)
        if local is None or self.previous is None or self.lost_since is not None:
            return False
        self._take_over(local, number)
        tracked = track(local, self.tracks, self.pose, self._predicted_step(), self.previous, view.pyramids[0])
        if tracked is None:
            self._lose(record)
            return False
        self.step = rigid3.compose(tracked.pose, rigid3.inverse(self.pose))
        if self.foretold is not None:
            self.gyro_trust.learn(*self.foretold, rigid3.rotation_matrix(self.step))
        self.pose, self.tracks, self.is_mapped = tracked.pose, tracked.tracks, tracked.is_mapped
        local.witnesses.followed(view.frame_idx, tracked.num_followed, len(tracked.tracks))
        reason = keyframe_reason(local, tracked, self.num_mapped_at_keyframe, self.options)
        if reason is None:
            self._settle(record, FrameState.TRACKED, self.pose, tracks=self.tracks.subset(self.is_mapped))
        else:
            self._make_keyframe(record, view, FrameState.TRACKED, reason)
        return True

    def _predicted_step(self) -> Array:
        """The motion since the last frame: steady, over the time that has passed; turned as a gyroscope says."""
        self.foretold = None
        if len(self.records) < 3:
            return self.step
        before, last, now = (record.timestamp_s for record in self.records[-3:])
        # after a pause nobody knows: what has moved on so far would be nearly out of sight
        share = min(round((now - last) / (last - before), 2), _MAX_STEADY_SHARE)
        step = pose_between(rigid3.IDENTITY, self.step, share) if abs(share - 1) > _STEADY_SHARE else self.step
        turn = None if self.imu is None else imu_rotation(self.imu, last, now)
        self.foretold = None if turn is None else (turn, rigid3.rotation_matrix(step))
        if turn is None or not self.gyro_trust.is_better:
            return step
        return rigid3.from_matrix(self.gyro_trust.corrected(turn), step[4:])

    def _make_keyframe(self, record: FrameRecord, view: View, state: FrameState, reason: str) -> None:
        local = self.local
        assert local is not None
        assert self.previous is not None
        seen = self.clock.look(self.previous, view, self.records[-2].timestamp_s)
        self._take_over(local, None)
        self._cull(local)
        self.tracks = local.add_keyframe(seen, self.pose, self.tracks, len(self.records))
        self._count_mapped()
        self._settle(record, state, self.pose, is_keyframe=True)
        self._remember(view)
        self._tell(reason, num_tracks=len(self.tracks), num_mapped=self.num_mapped_at_keyframe)
        self._question_calibration(record)

    def _question_calibration(self, record: FrameRecord) -> None:
        """Go on with a refined calibration as soon as the map, whose newest keyframe is the frame, tells one."""
        local = self.local
        assert local is not None
        asked = (local.map_idx, local.newest)
        if not self.options.refine_camera or self.is_refined or asked in self.asked or not is_time_to_ask(local):
            return
        self.asked.add(asked)
        before = local.pose(local.newest)
        if not refine_early(local):
            return
        self.pose = local.pose(local.newest)
        self.is_refined, self.rig = True, local.rig
        record.live = self.pose.copy()
        scale = np.linalg.norm(self.pose[4:]) / max(float(np.linalg.norm(before[4:])), 1e-300)
        self.step = self.step * np.repeat([1.0, scale], [4, 3])
        self.tracks = local.tracks_of_newest()
        self._count_mapped()
        self._tell("the images contradict the given calibration: going on with a refined one", everything=True)

    def _cull(self, local: LocalMap) -> None:
        """Drop a keyframe that adds nothing, once it has left the window."""
        position = local.redundant_keyframe()
        if position is None or not self.recognition.forget(local.keyframes.keyframes[position].frame_idx):
            return
        dropped = local.remove_keyframe(position)
        before = local.keyframes.keyframes[position - 1]
        leave_keyframe(self.records, local.map_idx, position, dropped, before)
        self.tracks = self.tracks.after_removal(position)
        self.counts["keyframes_culled"] += 1

    def _take_over(self, local: LocalMap, number: int | None) -> None:
        """Let a finished adjustment count, and carry the current pose along with its keyframe."""
        before = local.pose(local.newest)
        if local.backend.finish(local.keyframes, number):
            self.pose = rigid3.compose(self.pose, rigid3.compose(rigid3.inverse(before), local.pose(local.newest)))

    def _count_mapped(self) -> None:
        assert self.local is not None
        self.is_mapped = self.local.points_of(self.tracks)[1]
        self.num_mapped_at_keyframe = int(self.is_mapped.sum())

    # ------------------------------------------------------------------ loss

    def _lose(self, record: FrameRecord) -> None:
        self.lost_since = record.timestamp_s
        self.counts["losses"] += 1
        self.step = rigid3.IDENTITY
        self.initializer = MapInitializer(self.rig.cameras[0], self.options, self.seed)
        self.waiting.clear()

    def _recover(self, record: FrameRecord, view: View) -> bool:
        """After a loss: the tracks where they were, or any place of any map that the frame looks like."""
        local = self.local
        if local is None or self.previous is None:
            return False
        self._take_over(local, None)
        if len(self.tracks) >= MIN_INLIERS:
            tracked = track(local, self.tracks, self.pose, rigid3.IDENTITY, self.previous, view.pyramids[0])
            if tracked is not None and tracked.num_inliers > 0.5 * tracked.num_found:
                self.pose, self.tracks, self.lost_since = tracked.pose, tracked.tracks, None
                self._make_keyframe(record, view, FrameState.RELOCALIZED, "the tracks are found again")
                return True
        found = self.recognition.find(self.maps, view)
        if found is None:
            return False
        self.local, frame_idx, self.pose, point_id, xy = found
        self.step, self.lost_since = rigid3.IDENTITY, None
        self.tracks = self.local.tracks_at(point_id, xy, self.pose)
        self.counts["relocalizations"] += 1
        self.waiting.clear()
        self._make_keyframe(record, view, FrameState.RELOCALIZED, f"relocalised at frame {frame_idx}")
        return True

    # ------------------------------------------------------------------ what is noted and told

    def _settle(
        self,
        record: FrameRecord,
        state: FrameState,
        pose: Array,
        *,
        is_keyframe: bool = False,
        keyframe: int | None = None,
        tracks: ActiveTracks | None = None,
    ) -> None:
        """Note the pose of a frame relative to a keyframe, the newest if none is named."""
        assert self.local is not None
        record.state, record.map_idx, record.is_keyframe = state, self.local.map_idx, is_keyframe
        record.keyframe = self.local.newest if keyframe is None else keyframe
        record.frame_from_keyframe = rigid3.compose(pose, rigid3.inverse(self.local.pose(record.keyframe)))
        if state != FrameState.WAITING:
            record.live = pose.copy()
        if tracks is not None:
            record.point_id, record.xy = tracks.point_id.astype(np.int32), tracks.xy.astype(np.float32)

    def _remember(self, view: View) -> None:
        """Remember the newest keyframe as a place; close the loop if that is one."""
        local = self.local
        assert local is not None
        if not self.options.loops:
            return
        mapped = self.tracks.subset(self.is_mapped)
        closure = self.recognition.remember(self.maps, local, view, mapped.xy, mapped.point_id)
        if closure is None:
            return
        for number in {closure.old_map, closure.new_map}:
            self.maps[number].backend.finish(self.maps[number].keyframes)
        self.local, scale = self.recognition.close(self.maps, self.records, closure)
        self.pose, self.step = self.local.pose(self.local.newest), self.step * np.repeat([1.0, scale], [4, 3])
        # the newest frame is given out after this: in the world, and with the unit, that those after it have as well
        self.records[-1].live = self.pose.copy()
        self.tracks = self.local.tracks_of_newest()
        self._count_mapped()
        self.counts["loops"] += 1
        self._tell(
            "a loop is closed" if closure.old_map == closure.new_map else "two maps are joined", everything=True,
            shift_in_depths=closure.shift, rotation_deg=closure.rotation_deg, scale=closure.scale,
            num_inliers=list(closure.num_inliers), rms_px=closure.rms_px,
        )  # fmt: skip

    def _tell(self, message: str, everything: bool = False, **data: Any) -> None:
        """Say that the map has changed, with what is new in it, or all of it."""
        local = self.local
        assert local is not None
        keyframes = local.keyframes
        recent = np.arange(0 if everything else max(0, local.newest - self.options.window), local.newest + 1)
        ids = np.unique(np.concatenate([keyframes.keyframes[k].point_id for k in recent]))
        ids = ids[keyframes.is_triangulated(ids)]
        frames = np.array([keyframes.keyframes[k].frame_idx for k in recent], np.int64)
        poses = np.array([local.pose(int(k)) for k in recent])
        snapshot = MapSnapshot(int(frames[-1]), local.map_idx, frames, poses, ids, keyframes.point_xyz[ids], everything)
        self.events.decided(STAGE, message, snapshot=snapshot, frame_idx=int(frames[-1]), keyframe=local.newest, **data)

    # ------------------------------------------------------------------ the end

    def finish(self) -> OdometryResult:
        """Adjust what there is once more, and gather the result."""
        conclusions, maps = {}, dict[int, KeyframeMap]()
        for number, local in self.maps.items():
            local.backend.finish(local.keyframes)
            maps[number] = local.keyframes
            self.events.started("adjustment", f"adjusting {local.newest + 1} keyframes together")
            straightened = self._straighten(local)
            conclusions[number] = adjust_finally(local.keyframes, self.options, self.events, self.given_rig)
            conclusions[number].report["shutter"] = straightened
            conclusions[number].contradictions.extend(self.clock.contradictions(local.keyframes))
            conclusions[number].contradictions.extend(local.witnesses.contradictions(local.keyframes))
            measure_again(self.records, local.keyframes, number)
            self.events.finished("adjustment", **conclusions[number].report)
        if self.executor is not None:
            self.executor.shutdown()
        result = gather(self.records, maps, conclusions)
        for m, entry in enumerate(result.maps):
            if entry.covariance_gap:
                self.events.warned("adjustment", f"map {m}, covariances are missing: {entry.covariance_gap}")
        if self.options.smooth:
            # given the map, whose errors neighbouring frames have in common
            covariance = np.array([record.covariance for record in self.records]).reshape(-1, 6, 6)
            for m in range(len(result.maps)):
                poses = np.where((result.frame_map == m)[:, None], result.cam_from_world, np.nan)
                result.smoothed.append(smooth_trajectory(result.timestamps_s, poses, covariance))
        result.report = self._report(result)
        return result

    def _straighten(self, local: LocalMap) -> dict[str, Any]:
        """Undo a rolling shutter where the images clearly show one; the numbers behind that."""
        if self.rig.is_stereo or not self.options.refine_camera or is_too_large(local.keyframes):
            return {}
        numbers = straighten(self.records, local.keyframes, local.map_idx)
        self.events.raise_if_cancelled()
        if numbers["readout"]:
            self.events.decided("adjustment", "the images show a rolling shutter, which is undone", **numbers)
        return numbers

    def _report(self, result: OdometryResult) -> dict[str, Any]:
        tracked = np.isfinite(result.cam_from_world[:, 0])
        backend = sum(local.backend.cpu_s for local in self.maps.values())
        return {
            "num_frames": len(self.records), "num_tracked": int(tracked.sum()), "num_maps": len(result.maps),
            "num_keyframes": [len(m.keyframe_frame_idx) for m in result.maps],
            "tracking_cpu_s": sum(record.time_s for record in self.records), "backend_cpu_s": backend, **self.counts,
            "right_late_frames": self.clock.shift, "pairs": [c.describe() for c in self.clock.contradictions()],
        }  # fmt: skip


def run_odometry(
    sequence: Sequence, options: OdometryOptions, *, seed: int = 0, threads: int = 1, events: Events | None = None
) -> OdometryResult:
    """Follow the camera through a sequence.

    Args:
        sequence: frames and the rig that took them.
        seed: of everything that is drawn.
        threads: with more than one the local adjustment runs beside the tracking. The result does not depend on it.
        events: told of every frame (``advanced`` with a FrameSnapshot) and of every change of the map (``decided`` with
            a MapSnapshot).

    Raises:
        InterruptedRunError: on cancellation.
    """
    events = events or Events()
    odometry = Odometry(sequence, options, seed=seed, threads=threads, events=events)
    events.started(STAGE, total=sequence.num_frames)
    for frame in odometry.clock.pair(sequence.frames(), events):
        odometry.process(frame)
    events.finished(STAGE)
    return odometry.finish()
