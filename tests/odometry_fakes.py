"""A sequence and a runner that need no images worth looking at: for tests of everything around odometry."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Frame, GroundTruth, Imu, Sequence
from sfmapp.odometry.inertial.scale import ScaleEstimate, ScaleRefusal
from sfmapp.odometry.keyframe_images import KeyframeImages
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.residual_memory import NOT_KNOWN
from sfmapp.odometry.result import FrameState, MapResult, OdometryResult
from sfmapp.odometry.snapshot import FrameSnapshot, MapSnapshot
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
WIDTH, HEIGHT, FPS = 160, 100, 10.0
POINTS_PER_KEYFRAME = 60
# Of live poses: a centimetre and a milliradian, in the unit of the map.
COVARIANCE = np.diag([1e-3] * 3 + [0.01] * 3) ** 2


def path(num: int) -> Array:
    """(num, 7) cam_from_world along an arc of radius 20, level, looking ahead."""
    angle = np.linspace(0, 1.2, num)
    centers = np.stack([20 * (1 - np.cos(angle)), np.zeros(num), 20 * np.sin(angle)], 1)
    rotation = rigid3.exp_so3(np.stack([np.zeros(num), -angle, np.zeros(num)], 1))
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


@dataclass
class FakeSequence:
    """Frames of noise along an arc; the ground truth is in metres, what the fake runner finds is in a unit of 2 m."""

    num_frames: int | None = 50
    kind: str = "folder"
    source: str = "fake"
    rig: Rig = field(default_factory=lambda: Rig.single(simple_camera(CameraModel.PINHOLE, WIDTH, HEIGHT, 120.0)))
    frames_per_second: float | None = FPS
    imu: Imu | None = None
    ground_truth: GroundTruth | None = None
    orientation: int = 1
    length: int = 50
    pause_s: float = 0.0

    def __post_init__(self) -> None:
        self.ground_truth = GroundTruth(np.arange(self.length) / FPS, path(self.length))

    def frames(self) -> Iterator[Frame]:
        rng = np.random.default_rng(0)
        for idx in range(self.length):
            time.sleep(self.pause_s)
            images = tuple(rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8) for _ in self.rig.cameras)
            yield Frame(idx, f"{idx:06d}.png", idx / FPS, images)


@dataclass
class FakeRunner:
    """Finds the ground truth at half its size, but for a centimetre; a keyframe every fifth frame.

    Attributes:
        lost: frames that get no pose.
        breaks_at: from this frame on everything is in a second map.
        inertial: what a sensor has said of each map, if it may.
    """

    lost: range = range(0)
    breaks_at: int | None = None
    finds_nothing: bool = False
    inertial: ScaleEstimate | ScaleRefusal | None = None

    def __call__(
        self,
        sequence: Sequence,
        options: OdometryOptions,
        *,
        seed: int,
        threads: int,
        events: Events,
        markers: object = None,
        with_imu: bool = True,
        known: object = None,
    ) -> OdometryResult:
        events.started("odometry", total=sequence.num_frames)
        assert sequence.ground_truth is not None
        self.poses = sequence.ground_truth.cam_from_world.copy()
        noise = np.random.default_rng(seed).normal(0, 0.01, (len(self.poses), 3))
        self.poses[:, 4:] = 0.5 * self.poses[:, 4:] + noise
        self.maps: list[KeyframeMap] = []
        self.images = KeyframeImages()
        rows = []
        for frame in sequence.frames():
            state = FrameState.LOST if frame.idx in self.lost or self.finds_nothing else FrameState.TRACKED
            if state == FrameState.LOST:
                map_idx, pose, xy = -1, np.full(7, np.nan), np.zeros((0, 2), np.float32)
            else:
                map_idx = int(self.breaks_at is not None and frame.idx >= self.breaks_at)
                pose, xy = self.poses[frame.idx], self._track(frame, map_idx, sequence.rig, events)
            is_mapped = np.arange(len(xy)) % 3 > 0
            snapshot = FrameSnapshot(
                frame.idx,
                frame.name,
                frame.timestamp_s,
                state,
                frame.images[0],
                xy,
                is_mapped,
                pose,
                COVARIANCE,
                NOT_KNOWN,
                rigid3.IDENTITY,
                map_idx,
                0.01,
            )
            events.advanced("odometry", snapshot=snapshot)
            rows.append((frame.idx, frame.name, frame.timestamp_s, state, map_idx, pose))
        if any(frame in self.lost for frame in range(50)):
            events.warned("odometry", f"tracking is lost at frame {self.lost[0]}")
        events.finished("odometry")
        result = self._result(rows)
        if with_imu and sequence.imu is not None:
            result.maps = [replace(entry, inertial=self.inertial) for entry in result.maps]
        return result

    def _track(self, frame: Frame, map_idx: int, rig: Rig, events: Events) -> NDArray[np.float32]:
        if map_idx >= len(self.maps):
            self.maps.append(KeyframeMap(rig))
        ours, pose = self.maps[map_idx], self.poses[frame.idx]
        rng = np.random.default_rng([1, frame.idx])
        in_cam = rng.uniform([-2, -1, 4], [2, 1, 8], (POINTS_PER_KEYFRAME, 3))
        xy = project(rig.cameras[0], in_cam)
        if not ours.keyframes or frame.idx % 5 == 0:
            ids = ours.new_points(len(xy))
            ours.point_xyz[ids] = rigid3.apply(rigid3.inverse(pose), in_cam)
            for before in ours.keyframes[-1:]:
                self._see_again(before, ours, ids, rig)
            self._add(ours, frame, pose, ids, rig)
            self.images.look(frame.idx, frame.images[0])
            recent = ours.keyframes[-3:]
            frames = np.array([k.frame_idx for k in recent])
            poses = np.array([k.rig_from_world for k in recent])
            snapshot = MapSnapshot(frame.idx, map_idx, frames, poses, ids, ours.point_xyz[ids])
            events.decided("odometry", "a keyframe: it was time", snapshot=snapshot, num_points=len(ids))
        return xy.astype(np.float32)

    def _add(self, ours: KeyframeMap, frame: Frame, pose: Array, ids: NDArray[np.int64], rig: Rig) -> None:
        ours.keyframes.append(
            Keyframe(
                frame.idx, frame.timestamp_s, frame.name, pose, np.zeros(0, np.int64),
                np.zeros((0, len(rig.cameras), 2)), np.zeros((0, len(rig.cameras)), bool),
            )
        )  # fmt: skip
        self._see_again(ours.keyframes[-1], ours, ids, rig)

    def _see_again(self, keyframe: Keyframe, ours: KeyframeMap, ids: NDArray[np.int64], rig: Rig) -> None:
        poses = rigid3.compose(rig.cam_from_rig, keyframe.rig_from_world[None])
        views = zip(rig.cameras, poses, strict=True)
        xy = np.stack([project(camera, rigid3.apply(pose, ours.point_xyz[ids])) for camera, pose in views], 1)
        inside = np.isfinite(xy).all((1, 2)) & (xy >= 0).all((1, 2)) & (xy < [WIDTH, HEIGHT]).all((1, 2))
        keyframe.point_id = np.concatenate([keyframe.point_id, ids[inside]])
        keyframe.xy = np.concatenate([keyframe.xy, xy[inside]])
        keyframe.is_inlier = np.concatenate([keyframe.is_inlier, np.ones((inside.sum(), len(rig.cameras)), bool)])

    def _result(self, rows: list) -> OdometryResult:  # type: ignore[type-arg]
        order = sorted(range(len(self.maps)), key=lambda m: -sum(row[4] == m for row in rows))
        place = {m: k for k, m in enumerate(order)} | {-1: -1}
        maps = []
        for m in order:
            ours = self.maps[m]
            count = len(ours.keyframes)
            model, _ = ours.reconstruction(np.arange(count))
            covariance = np.tile(np.diag([1e-6] * 3 + [1e-4] * 3), (count, 1, 1))
            frames = np.array([k.frame_idx for k in ours.keyframes])
            images = np.arange(count) * len(ours.rig.cameras)
            model.point_rgb = self.images.colors(model, frames, images)
            maps.append(MapResult(model, frames, images, covariance, "the first keyframe is held"))
        poses = np.array([row[5] for row in rows]).reshape(-1, 7)
        return OdometryResult(
            np.array([row[0] for row in rows], np.int64), [row[1] for row in rows], np.array([row[2] for row in rows]),
            poses, poses.copy(), np.array([place[row[4]] for row in rows], np.int32),
            np.array([row[3] for row in rows], np.uint8), maps, covariance=np.tile(1e-4 * np.eye(6), (len(rows), 1, 1)),
        )  # fmt: skip
