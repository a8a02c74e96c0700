"""Odometry: a sequence to a trajectory and keyframe maps, frame by frame."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import project
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.odometry.early_calibration import EarlyCalibration
from sfmapp.odometry.frames_adjustment import adjust_frames
from sfmapp.odometry.frontend.active_tracks import ActiveTracks
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid
from sfmapp.odometry.frontend.twins import is_twin
from sfmapp.odometry.inertial.markers import MarkerDetector
from sfmapp.odometry.inertial.smoothing import smooth_trajectory
from sfmapp.odometry.initialize import MapInitializer, TwoViews
from sfmapp.odometry.keyframe_images import KeyframeImages
from sfmapp.odometry.known_map_check import KnownMapCheck
from sfmapp.odometry.live_shutter import LiveShutter
from sfmapp.odometry.loops.relocalize import position_of
from sfmapp.odometry.loops.sweep import is_too_large
from sfmapp.odometry.map.atlas import Atlas
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.known_map import PREFIX, KnownMap, known_keyframes
from sfmapp.odometry.map.local_map import LocalMap, View
from sfmapp.odometry.missed_frames import MissedFrames
from sfmapp.odometry.motion_model import MotionModel
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.recognition import Recognition
from sfmapp.odometry.records import FrameRecord, gather, leave_keyframe, measure_again
from sfmapp.odometry.refinement.final_adjustment import FinalAdjustment, adjust_finally
from sfmapp.odometry.report import OdometryReport, ShutterReport
from sfmapp.odometry.residual_memory import NOT_KNOWN, Correlation, ResidualMemory
from sfmapp.odometry.result import FrameState, OdometryResult
from sfmapp.odometry.shutter import straighten, undo
from sfmapp.odometry.snapshot import FrameSnapshot, MapSnapshot
from sfmapp.odometry.state import Phase, RunState
from sfmapp.odometry.stereo_clock import StereoClock
from sfmapp.odometry.tracker import MIN_INLIERS, keyframe_reason, measure_pose, track

Array = NDArray[np.float64]

STAGE = "odometry"
# Fewest points with depth that one look of a rig may begin a map with.
_MIN_STEREO_POINTS = 40


@dataclass
class _Tracked:
    """What goes on from one frame to the next.

    Attributes:
        pose: (7,) cam_from_world of the last frame.
        tracks: of the last frame. is_mapped: (N,) which of them its pose was measured with.
        previous: pyramid of the last frame; None before the first.
        num_mapped_at_keyframe: how many were mapped when the newest keyframe was made.
        covariance: (6, 6) of the pose given the map; not finite where it was not measured.
        map_moved: (8,) see :class:`~sfmapp.odometry.snapshot.FrameSnapshot`, since the last frame was told of.
        residual_px: standard deviation of the points that measured it, a coordinate.
    """

    pose: Array = field(default_factory=rigid3.IDENTITY.copy)
    tracks: ActiveTracks = field(default_factory=ActiveTracks.none)
    is_mapped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    previous: Pyramid | None = None
    num_mapped_at_keyframe: int = 0
    covariance: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    map_moved: Array = field(default_factory=similarity.IDENTITY.copy)
    residual_px: float = 0.0

    def move_map(self, moved: Array) -> None:
        """The map below the camera has moved by a similarity (8,), as of ``map_moved``."""
        self.map_moved = similarity.compose(self.map_moved, moved)

    def stay_in_map(self, pose: Array, zoom: float) -> None:
        """The map was put elsewhere, and its lengths are so many times longer: the camera has another pose (7,) in it,
        and is where it was."""
        seen = similarity.compose(np.append(rigid3.IDENTITY, 1.0 / zoom), np.append(pose, 1.0))
        self.move_map(similarity.compose(np.append(rigid3.inverse(self.pose), 1.0), seen))
        self.pose = pose

    def drop_tracks(self) -> None:
        """Nothing is followed any more."""
        self.tracks, self.is_mapped = ActiveTracks.none(), np.zeros(0, bool)


@dataclass
class _Counts:
    """What happened how often, for the report."""

    relocalizations: int = 0
    losses: int = 0
    loops: int = 0
    keyframes_culled: int = 0
    looked_still: int = 0
    looked_turned: int = 0
    twins: int = 0


class Odometry:
    """The state between two frames. Push frames with :meth:`process`, then call :meth:`finish` once.

    :meth:`_go_through_phases` is where it is decided what becomes of a frame.
    """

    def __init__(
        self,
        sequence: Sequence,
        options: OdometryOptions,
        *,
        seed: int,
        threads: int,
        events: Events,
        markers: MarkerDetector | None = None,
        with_imu: bool = True,
        known: KnownMap | None = None,
    ) -> None:
        if known is not None:  # its points were made with the cameras as they are: a refined one would not fit them
            options = replace(options, refine_camera=False)
        self.rig, self.options, self.seed, self.events = sequence.rig, options, seed, events
        self.given_rig = sequence.rig
        # windows; and, seldom, a vocabulary and the calibration, neither of which may keep a window waiting
        self.executor = ThreadPoolExecutor(3, "adjust") if threads > 1 else None
        self.state, self.counts = RunState(), _Counts()
        self.records: list[FrameRecord] = []
        self.imu = sequence.imu if with_imu else None
        alone = self.imu is None and not self.rig.is_stereo
        self.shutter = LiveShutter(options.refine_camera and alone, self.records)
        self.calibration = EarlyCalibration(options.refine_camera, self.shutter, self.executor)
        # a rig holds rotations well enough
        self.atlas = Atlas(options, self.executor, None if self.rig.is_stereo else self.imu)
        self.local: LocalMap | None = None  # the map that the camera is in, or was in when it was lost
        self.recognition, self.keyframe_images = Recognition(seed, self.executor), KeyframeImages(markers)
        self.tracked, self.motion, self.missed = _Tracked(), MotionModel(sequence.imu), MissedFrames()
        self.residuals = ResidualMemory()
        self.clock = StereoClock(self.rig)
        self.known = None if known is None else self._enter_known_map(known)
        self._begin_to_wait()

    def _enter_known_map(self, known: KnownMap) -> KnownMapCheck:
        """Have a known map beside those that the run makes; whether the camera is in it the frames say."""
        local = self.atlas.new_map(self.rig)
        local.keyframes, local.known = known_keyframes(known, self.rig)
        self.atlas.begin(local)
        self.recognition.know(local)
        for position, picture in local.known.pictures.items():
            self.keyframe_images.look(local.keyframes.keyframes[position].frame_idx, picture)
        self.state.expect_known_map()
        self.local = local
        return KnownMapCheck(known, local.keyframes, local.map_idx, self.recognition.num_places)

    def process(self, frame: Frame) -> FrameRecord:
        """Find the pose of the next frame."""
        start = time.thread_time()
        belief = self.recognition.belief
        num_looks = 0 if belief is None else belief.num_looks
        view = View(
            frame.idx,
            frame.timestamp_s,
            frame.name,
            frame.images,
            tuple(build_pyramid(i) for i in frame.images[: len(self.rig.cameras)]),
        )
        record = FrameRecord(frame.idx, frame.name, frame.timestamp_s)
        self.records.append(record)
        self._go_through_phases(record, view)
        if record.has_pose:
            self.missed.forget()
        else:
            self.missed.note(record, view.pyramids[0])
        if not record.is_twin:  # later ones are compared with the frame that was measured: what is small may add up
            self.tracked.previous = view.pyramids[0]
        record.cpu_s = time.thread_time() - start
        if record.is_keyframe:
            self.keyframe_images.look(frame.idx, frame.images[0])
        latency_s = math.nan if frame.captured_s is None else time.monotonic() - frame.captured_s
        snapshot = FrameSnapshot(
            frame.idx, frame.name, frame.shown_s, record.state, frame.images[0],
            self.tracked.tracks.xy.astype(np.float32), self.tracked.is_mapped, record.live, record.live_covariance,
            record.correlation, self.tracked.map_moved, record.map_idx, record.cpu_s, latency_s,
            None if belief is None or belief.num_looks == num_looks else belief.state(),
        )  # fmt: skip
        self.tracked.map_moved = similarity.IDENTITY
        self.events.advanced(STAGE, message=frame.name, snapshot=snapshot)
        return record

    def _go_through_phases(self, record: FrameRecord, view: View) -> None:
        """What becomes of a frame, phase by phase; one that is lost is looked for at once. See :class:`Phase`."""
        if self.state.phase is Phase.TRACKING:
            if self._track(record, view):
                return
            self._lose(record)
        if self.state.is_lost:
            if self._find_by_tracks(record, view) or self._find_by_places(record, view):
                return
            self._note_loss(record)
        if self.rig.is_stereo:
            self._wait_for_depth(record, view)
        else:
            self._wait_for_two_views(record, view)

    # ------------------------------------------------------------------ how a map begins

    def _begin_to_wait(self) -> None:
        """Forget the views that a map might have begun with."""
        self.initializer = MapInitializer(self.rig.cameras[0], self.options, self.seed)
        self.waiting: list[tuple[FrameRecord, View]] = []

    def _wait_for_depth(self, record: FrameRecord, view: View) -> None:
        """Begin a map with one look of a rig, if a map may begin."""
        if not self.state.may_begin_map:
            return
        self.tracked.drop_tracks()
        if self.clock.is_usable:
            self._begin_from_one_look(record, view)

    def _wait_for_two_views(self, record: FrameRecord, view: View) -> None:
        """Begin a map as soon as this view and an earlier one make one, if a map may begin."""
        if self.state.may_begin_map:
            self.tracked.drop_tracks()
        views = self.initializer.add(view.pyramids[0])
        self.counts.looked_still += self.initializer.is_still
        self.counts.looked_turned += self.initializer.is_turn
        if len(self.initializer.seen) == 1:
            self.waiting.clear()  # a new first view: what was before it has no pose
        self.waiting.append((record, view))
        if views is not None and self.state.may_begin_map:
            self._begin_from_two_views(views)

    def _begin_from_one_look(self, record: FrameRecord, view: View) -> None:
        """Make a map of the depths that one look of a rig shows, if there are enough."""
        local = self.atlas.new_map(self.rig)
        tracks = local.add_keyframe(view, rigid3.IDENTITY, ActiveTracks.none(), len(self.records))
        if local.points_of(tracks)[1].sum() < _MIN_STEREO_POINTS:
            self.atlas.discard(local)
            return
        self._enter(local, tracks, rigid3.IDENTITY)
        self._settle(record, FrameState.TRACKED, rigid3.IDENTITY, is_keyframe=True)
        self._reach_back(0)
        self._remember(view)
        self._tell("a map begins with one look of the rig", num_mapped=self.tracked.num_mapped_at_keyframe)

    def _begin_from_two_views(self, views: TwoViews) -> None:
        """Make a map of two views, and give poses to the frames between them."""
        local, seen = self.atlas.new_map(self.rig), self.initializer.seen
        (first_record, first), (last_record, last) = self.waiting[0], self.waiting[-1]
        corners = local.begin(first, self.initializer.corners)
        local.keyframes.point_xyz[corners.point_id[views.track]] = views.xyz
        tracks = corners.moved(seen[-1]).subset(np.isfinite(seen[-1][:, 0]))
        tracks = local.add_keyframe(last, views.last_from_first, tracks, len(self.records))
        local.backend.finish(local.keyframes)
        self._enter(local, tracks, local.pose(1))
        self._settle(last_record, FrameState.TRACKED, self.tracked.pose, is_keyframe=True)
        self._settle(first_record, FrameState.WAITING, local.pose(0), is_keyframe=True, keyframe=0)
        before = local.pose(0)
        for n, (record, _) in enumerate(self.waiting[1:-1], 1):
            start = rigid3.interpolate(local.pose(0), local.pose(1), n / (len(self.waiting) - 1))
            xyz = local.keyframes.point_xyz[corners.point_id]
            usable = np.isfinite(xyz[:, 0]) & np.isfinite(seen[n][:, 0])
            measured = measure_pose(local.camera, start, xyz[usable], seen[n][usable])
            before = start if measured is None else measured[0]
            self._settle(record, FrameState.WAITING, before, keyframe=0, tracks=corners.moved(seen[n]).subset(usable))
        self.motion.step = rigid3.compose(self.tracked.pose, rigid3.inverse(before))
        self._reach_back(0)
        self._remember(last)
        self._tell(
            f"a map begins with two views ({views.config.name.lower()})", median_angle_deg=views.median_angle_deg,
            num_inliers=views.num_inliers, num_tracks=views.num_tracks, num_mapped=self.tracked.num_mapped_at_keyframe,
        )  # fmt: skip
        self._begin_to_wait()

    def _enter(self, local: LocalMap, tracks: ActiveTracks, pose: Array) -> None:
        """Go on from the newest keyframe of a map that has begun."""
        self.state.track()
        self.atlas.begin(local)
        self.local, self.tracked.tracks, self.tracked.pose = local, tracks, pose
        self.motion.stop()
        self._count_mapped()

    # ------------------------------------------------------------------ tracking

    def _track(self, record: FrameRecord, view: View) -> bool:
        """Measure the pose in the current map; make a keyframe where one is due. False if there is no pose."""
        local, tracked = self.local, self.tracked
        assert local is not None
        assert tracked.previous is not None
        self._take_over(local, len(self.records))
        if self._repeat(record, view):
            return True
        step = self.motion.predict([r.timestamp_s for r in self.records[-3:]])
        readout = self.shutter.rows().readout
        found = track(local, tracked.tracks, tracked.pose, step, tracked.previous, view.pyramids[0], readout)
        if found is None:
            return False
        self.motion.learn(rigid3.compose(found.pose, rigid3.inverse(tracked.pose)))
        tracked.pose, tracked.tracks, tracked.is_mapped = found.pose, found.tracks, found.is_mapped
        tracked.covariance = record.live_covariance = found.covariance
        record.correlation = self._compare_residuals(local)
        tracked.residual_px = found.residual_px
        local.witnesses.followed(view.frame_idx, found.num_followed, len(found.tracks))
        reason = keyframe_reason(local, found, tracked.num_mapped_at_keyframe, self.options)
        if reason is None:
            self._settle(record, FrameState.TRACKED, found.pose, tracks=found.tracks.subset(found.is_mapped))
        else:
            self._make_keyframe(record, view, FrameState.TRACKED, reason)
        return True

    def _compare_residuals(self, local: LocalMap) -> Correlation:
        """Of the frame whose pose has been measured, with those of the frames before it, if a filter wants to know."""
        if not self.options.filter:
            return NOT_KNOWN
        seen = self.tracked.tracks.subset(self.tracked.is_mapped)
        xyz = local.keyframes.point_xyz[seen.point_id]
        expected = project(local.camera, rigid3.apply(self.tracked.pose, xyz))
        rows = self.shutter.rows(self.motion.step)
        straight = seen.xy - rows.shift_px(local.camera, self.tracked.pose, xyz, seen.xy)
        return self.residuals.look(seen.point_id, straight - expected)

    def _repeat(self, record: FrameRecord, view: View) -> bool:
        """Give a frame that shows what the last one shows the pose of that one, if it is so."""
        local, tracked, last = self.local, self.tracked, self.records[-2]
        assert local is not None
        seen = tracked.tracks.subset(tracked.is_mapped)
        if last.state is not FrameState.TRACKED or tracked.previous is None or not len(seen):
            return False
        together_px = tracked.residual_px * math.sqrt(3.0 / len(seen))  # six numbers of 2 N coordinates
        if not is_twin(tracked.previous, view.pyramids[0], seen.xy, tracked.residual_px, together_px):
            return False
        self._settle(record, FrameState.TRACKED, tracked.pose, tracks=seen)
        record.be_twin_of(last)
        record.live_covariance, record.correlation = last.live_covariance, self._compare_residuals(local)
        self.motion.stop()
        self.counts.twins += 1
        return True

    def _make_keyframe(self, record: FrameRecord, view: View, state: FrameState, reason: str) -> None:
        local, tracked = self.local, self.tracked
        assert local is not None
        seen = view  # the first frame of all, which a known map may have told a pose, has none before it
        if tracked.previous is not None:
            seen = self.clock.look(tracked.previous, view, self.records[-2].timestamp_s)
        self._take_over(local, None)
        self._cull(local)
        self.shutter.straighten(local.keyframes, local.map_idx, max(local.newest + 1 - self.options.window, 0))
        rows = self.shutter.rows(self.motion.step)
        tracked.tracks = local.add_keyframe(seen, tracked.pose, tracked.tracks, len(self.records), rows)
        self._count_mapped()
        self._settle(record, state, tracked.pose, is_keyframe=True)
        self._remember(view)
        self._tell(
            reason, everything=state is FrameState.RELOCALIZED and local.keyframes.num_known > 0,
            num_tracks=len(tracked.tracks), num_mapped=tracked.num_mapped_at_keyframe,
        )  # fmt: skip
        self._question_calibration(record)

    def _question_calibration(self, record: FrameRecord) -> None:
        """Go on with a refined calibration as soon as the map, whose newest keyframe is the frame, tells one."""
        local = self.local
        assert local is not None
        before = local.pose(local.newest)
        reason = self.calibration.refines(local, len(self.records))
        if not reason:
            return
        self.rig, pose = local.rig, local.pose(local.newest)
        record.give_out(pose)
        zoom = float(np.linalg.norm(pose[4:]) / max(float(np.linalg.norm(before[4:])), 1e-300))
        self.motion.rescale(zoom)
        self.tracked.stay_in_map(pose, zoom)
        self.tracked.tracks = local.tracks_of_newest()
        self._count_mapped()
        self._tell(reason, everything=True)

    def _cull(self, local: LocalMap) -> None:
        """Drop a keyframe that adds nothing, once it has left the window."""
        position = None if self.calibration.is_asking else local.redundant_keyframe()
        if position is None or not self.recognition.forget(local.keyframes.keyframes[position].frame_idx):
            return
        dropped = local.remove_keyframe(position)
        before = local.keyframes.keyframes[position - 1]
        leave_keyframe(self.records, local.map_idx, position, dropped, before)
        self.tracked.tracks = self.tracked.tracks.after_removal(position)
        self.counts.keyframes_culled += 1

    def _take_over(self, local: LocalMap, number: int | None) -> None:
        """Let a finished adjustment count, and carry the current pose along with its keyframe."""
        before = local.pose(local.newest)
        if local.backend.finish(local.keyframes, number):
            moved = rigid3.compose(rigid3.inverse(before), local.pose(local.newest))
            self.tracked.pose = rigid3.compose(self.tracked.pose, moved)
            self.tracked.move_map(np.append(moved, 1.0))

    def _count_mapped(self) -> None:
        assert self.local is not None
        self.tracked.is_mapped = self.local.points_of(self.tracked.tracks)[1]
        self.tracked.num_mapped_at_keyframe = int(self.tracked.is_mapped.sum())

    # ------------------------------------------------------------------ loss

    def _lose(self, record: FrameRecord) -> None:
        self.residuals.forget()
        self.state.lose(record.timestamp_s)
        self.counts.losses += 1
        self.motion.stop()
        self._begin_to_wait()

    def _find_by_tracks(self, record: FrameRecord, view: View) -> bool:
        """After a loss: look for the tracks where they were. They are dropped where a map may begin."""
        local, tracked = self.local, self.tracked
        assert local is not None
        self._take_over(local, None)
        if len(tracked.tracks) < MIN_INLIERS:
            return False
        assert tracked.previous is not None
        found = track(local, tracked.tracks, tracked.pose, rigid3.IDENTITY, tracked.previous, view.pyramids[0])
        if found is None or found.num_inliers <= 0.5 * found.num_found:
            return False
        self.state.track()
        self._begin_to_wait()
        tracked.pose, tracked.tracks = found.pose, found.tracks
        self._make_keyframe(record, view, FrameState.RELOCALIZED, "the tracks are found again")
        self._reach_back()
        return True

    def _find_by_places(self, record: FrameRecord, view: View) -> bool:
        """After a loss: look for the frame at every place of every map."""
        found = self.recognition.find(self.atlas.maps, view)
        if found is None:
            return False
        self.state.track()
        self._begin_to_wait()
        self.local, frame_idx, self.tracked.pose, point_id, xy = found
        self.tracked.tracks = self.local.tracks_at(point_id, xy, self.tracked.pose)
        self._find_known(view)
        self.motion.stop()
        self.counts.relocalizations += 1
        reason = f"relocalised at frame {frame_idx}"
        if frame_idx < 0:
            seen = self.local.keyframes.keyframes[position_of(self.local.keyframes, frame_idx)]
            reason = f"found in the known map at {seen.name.removeprefix(PREFIX)}"
        self._make_keyframe(record, view, FrameState.RELOCALIZED, reason)
        self._reach_back()
        return True

    def _find_known(self, view: View) -> None:
        """Go by the pictures of a known map, in place of the corners that led there, where enough of it is found so."""
        assert self.local is not None
        found = self.local.find_known(view.pyramids[0], self.tracked.pose)
        xyz = self.local.keyframes.point_xyz[found.point_id]
        measured = measure_pose(self.local.camera, self.tracked.pose, xyz, found.xy)
        if measured is not None:
            self.tracked.pose, self.tracked.tracks = measured[0], found.subset(measured[2])

    def _note_loss(self, record: FrameRecord) -> None:
        if self.counts.losses == 0:  # nothing is lost yet: the camera has not been found in the known map
            return
        record.state = FrameState.LOST
        if record.timestamp_s == self.state.lost_since_s:
            self.events.warned(STAGE, f"{record.name}: tracking is lost", frame_idx=record.frame_idx)
        self.state.wait(record.timestamp_s, self.options.max_lost_s)

    def _reach_back(self, keyframe: int | None = None) -> None:
        """Give poses to the frames without one that came just before a keyframe, the newest if none is named, as far as
        they show what it shows."""
        local = self.local
        assert local is not None
        keyframe = local.newest if keyframe is None else keyframe
        placed = self.missed.reach_back(local, keyframe)
        for frame in placed:
            self._settle(frame.record, FrameState.WAITING, frame.pose, keyframe=keyframe, tracks=frame.tracks)
        if placed:
            message = f"{len(placed)} frames without a pose are followed back"
            self.events.decided(STAGE, message, num_frames=len(placed), frame_idx=placed[-1].record.frame_idx)

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
        position = self.local.newest if keyframe is None else keyframe
        relative = rigid3.compose(pose, rigid3.inverse(self.local.pose(position)))
        record.settle(state, self.local.map_idx, position, relative, is_keyframe=is_keyframe)
        if state != FrameState.WAITING:
            record.give_out(pose)
        if tracks is not None:
            record.see(tracks.point_id, tracks.xy)

    def _remember(self, view: View) -> None:
        """Remember the newest keyframe as a place; close the loop if that is one."""
        local = self.local
        assert local is not None
        if not self.options.loops:
            return
        mapped, maps = self.tracked.tracks.subset(self.tracked.is_mapped), self.atlas.maps
        closure = self.recognition.remember(maps, local, view, mapped.xy, mapped.point_id, self.tracked.covariance)
        if closure is None:
            return
        self.calibration.forget()
        old_frame_idx = maps[closure.old_map].keyframes.keyframes[closure.views[-1].old_idx].frame_idx
        for number in {closure.old_map, closure.new_map}:
            maps[number].backend.finish(maps[number].keyframes)
        self.local, scale = self.recognition.close(maps, self.records, closure)
        self.tracked.stay_in_map(self.local.pose(self.local.newest), scale)
        self.tracked.tracks = self.local.tracks_of_newest()
        self.motion.rescale(scale)
        # the newest frame is given out after this: in the world, and with the unit, that those after it have as well
        self.records[-1].give_out(self.tracked.pose)
        self._count_mapped()
        self.counts.loops += 1
        self._tell(
            "a loop is closed" if closure.old_map == closure.new_map else "two maps are joined", everything=True,
            old_frame_idx=old_frame_idx, shift_in_depths=closure.shift, rotation_deg=closure.rotation_deg,
            scale=closure.scale, num_inliers=list(closure.num_inliers), rms_px=closure.rms_px,
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
        if self.known is not None and not self.known.is_entered(self.records):
            del self.atlas.maps[self.known.map_idx]
            self.events.warned(STAGE, "no frame was found in the known map: the sequence is a map of its own")
        for number, local in self.atlas.maps.items():
            local.backend.finish(local.keyframes)
            is_known = self.known is not None and number == self.known.map_idx
            self.events.started("adjustment", f"adjusting {local.newest + 1} keyframes together")
            straightened = None if is_known else self._straighten(local)
            conclusion = self._conclude_known(local) if is_known else adjust_finally(
                local.keyframes, self.options, self.events, self.given_rig, self.imu
            )  # fmt: skip
            maps[number] = local.keyframes
            conclusion.contradictions.extend(self.clock.contradictions(local.keyframes))
            conclusion.contradictions.extend(local.witnesses.contradictions(local.keyframes))
            measure_again(self.records, local.keyframes, number)
            num_frames = self._adjust_frames(local, conclusion)
            if num_frames and is_known:
                self._restore_known_frame(local)
            report = replace(conclusion.report, shutter=straightened, num_frames=num_frames)
            conclusions[number] = replace(conclusion, report=report)
            self.events.finished("adjustment", **conclusions[number].report)
        if self.executor is not None:
            self.executor.shutdown()
        result = gather(self.records, maps, conclusions, self.keyframe_images)
        if self.known is not None and self.known.map_idx in maps:
            self.known.hand_on(result, self.records)
        for m, entry in enumerate(result.maps):
            if entry.covariance_gap:
                self.events.warned("adjustment", f"map {m}, covariances are missing: {entry.covariance_gap}")
        if self.options.smooth:
            assert result.measured_covariance is not None
            for m in range(len(result.maps)):
                poses = np.where((result.frame_map == m)[:, None], result.cam_from_world, np.nan)
                result.smoothed.append(smooth_trajectory(result.timestamps_s, poses, result.measured_covariance))
        result.report = self._report(result, maps)
        return result

    def _conclude_known(self, local: LocalMap) -> FinalAdjustment:
        """Hold what was seen against the known map, and adjust both together where they agree; where they do not, the
        sequence keeps a map of its own, in the known one's frame."""
        assert self.known is not None
        against = self.known.compare(local.keyframes)
        if against is None or not against.is_contradiction:
            # photographs of the map were not taken from a vehicle
            options = replace(self.options, motion="free")
            conclusion = adjust_finally(local.keyframes, options, self.events, self.given_rig)
            self.known.restore_frame(local.keyframes)
            return conclusion
        found = self.known.contradiction(against)
        self.events.warned(STAGE, found.message, subject=found.subject)
        together = local.keyframes
        local.keyframes = self.known.take_apart(together, self.records)
        conclusion = adjust_finally(local.keyframes, self.options, self.events, self.given_rig)
        self.known.lay_onto(local.keyframes, together)
        conclusion.contradictions.append(found)
        return conclusion

    def _restore_known_frame(self, local: LocalMap) -> None:
        """Bring the known map, and what hangs on it, back to where it was and to its size."""
        assert self.known is not None
        before = rigid3.spread(np.array([k.rig_from_world for k in local.keyframes.keyframes]))
        self.known.restore_frame(local.keyframes)
        zoom = rigid3.spread(np.array([k.rig_from_world for k in local.keyframes.keyframes])) / max(before, 1e-300)
        for record in self.records:
            if record.map_idx == local.map_idx and record.has_pose:
                record.frame_from_keyframe[4:] *= zoom

    def _adjust_frames(self, local: LocalMap, conclusion: FinalAdjustment) -> int | None:
        """Adjust the frames between the keyframes with them, where images of one camera alone hold the map; how many
        took part, None for none."""
        by_others = self.rig.is_stereo or self.imu is not None or self.options.motion != "free"
        if by_others or conclusion.adjustment is None:
            return None
        num = adjust_frames(self.records, local.keyframes, local.map_idx, self.events)
        if num:
            message = f"the {num} frames between the keyframes are adjusted with them"
            self.events.decided("adjustment", message, num_frames=num)
        return num or None

    def _straighten(self, local: LocalMap) -> ShutterReport | None:
        """Undo a rolling shutter where the images clearly show one; the numbers behind that, None where it was not
        looked for."""
        if self.rig.is_stereo or not self.options.refine_camera or is_too_large(local.keyframes):
            if self.shutter.found.readout:
                undo(self.records, local.keyframes, local.map_idx, self.shutter.found.readout)
            return None
        numbers = straighten(self.records, local.keyframes, local.map_idx, self.imu, self.shutter.found)
        self.events.raise_if_cancelled()
        if numbers.readout:
            self.events.decided("adjustment", "the images show a rolling shutter, which is undone", **numbers)
        return numbers

    def _report(self, result: OdometryResult, maps: Mapping[int, KeyframeMap]) -> OdometryReport:
        tracked = np.isfinite(result.cam_from_world[:, 0])
        known_map = None
        if self.known is not None:
            inside = maps.get(self.known.map_idx)
            assert self.recognition.belief is not None
            known_map = self.known.report(self.records, inside, self.recognition.belief.report())
        return OdometryReport(
            num_frames=len(self.records), num_tracked=int(tracked.sum()), num_maps=len(result.maps),
            num_keyframes=[len(m.keyframe_frame_idx) for m in result.maps],
            tracking_cpu_s=sum(record.cpu_s for record in self.records),
            backend_cpu_s=sum(local.backend.cpu_s for local in self.atlas), **asdict(self.counts),
            right_late_frames=self.clock.shift, pairs=self.clock.contradictions(),
            known_map=known_map, loops_open=self.recognition.num_open_loops,
        )  # fmt: skip


def run_odometry(
    sequence: Sequence,
    options: OdometryOptions,
    *,
    seed: int = 0,
    threads: int = 1,
    events: Events | None = None,
    markers: MarkerDetector | None = None,
    with_imu: bool = True,
    known: KnownMap | None = None,
) -> OdometryResult:
    """Follow the camera through a sequence.

    Args:
        sequence: frames and the rig that took them.
        seed: of everything that is drawn.
        threads: with more than one the local adjustment runs beside the tracking. The result does not depend on it.
        events: told of every frame (``advanced`` with a FrameSnapshot) and of every change of the map (``decided`` with
            a MapSnapshot). The result does not depend on them.
        markers: looks for markers in the keyframes; what it finds is in the result's maps.
        with_imu: inertial measurements of the sequence count, in the windows of one camera and in the closing
            adjustment.
        known: a map that the camera may be in from the start. What is seen of it is localised there, in its frame and
            unit; the rest is mapped anew. The calibration is not refined then, and what lies in the known map is
            adjusted by the images alone.

    Raises:
        InterruptedRunError: on cancellation.
    """
    events = events or Events()
    odometry = Odometry(
        sequence, options, seed=seed, threads=threads, events=events, markers=markers, with_imu=with_imu,
        known=known,
    )  # fmt: skip
    events.started(STAGE, total=sequence.num_frames)
    for frame in odometry.clock.pair(sequence.frames(), events):
        odometry.process(frame)
    events.finished(STAGE)
    return odometry.finish()
