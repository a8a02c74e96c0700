"""What a live view draws, as plain arrays: maps that grow and move, and the trajectory that moves with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.errors import InputError
from sfmapp.evaluation.trajectory import Alignment, Trajectory, absolute_error, associate
from sfmapp.geometry import rigid3, similarity

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Things are drawn in blocks, so that a change of a few of them does not repeat all: the sizes balance the bytes of a
# recording against the number of entities that the viewer has to walk through.
POINT_BLOCK, KEYFRAME_BLOCK, FRAME_BLOCK = 1024, 32, 64
# Cameras are drawn this long, as a share of the distance to what they see.
FRUSTUM_SHARE = 0.06
_UNKNOWN_GREY = 128


@dataclass
class Changed:
    """Blocks of a map that have to be drawn again."""

    points: set[int] = field(default_factory=set)
    keyframes: set[int] = field(default_factory=set)
    frames: set[int] = field(default_factory=set)

    def add(self, other: Changed) -> None:
        """These as well."""
        self.points |= other.points
        self.keyframes |= other.keyframes
        self.frames |= other.frames


class LiveMap:
    """One map as it is known so far. The path hangs on the keyframes: when they move, it moves along.

    Attributes:
        placement: (7,) scene_from_map: maps without a link begin where the camera was last.
        frustum: length of the cameras as they are drawn.
        changed: what has changed since it was drawn.
    """

    def __init__(self, placement: Array) -> None:
        self.placement = placement
        self.changed = Changed()
        self.frustum = 0.0
        self.keyframes: dict[int, Array] = {}
        self._order: dict[int, int] = {}
        self.point_xyz = np.full((POINT_BLOCK, 3), np.nan, np.float32)
        self.point_grey = np.full(POINT_BLOCK, _UNKNOWN_GREY, np.uint8)
        self._uncoloured: Ints = np.zeros(0, np.int64)
        # of each frame with a pose: its number in the run, the keyframe it hangs on (-1: none), and its pose from that
        self._frame_number: list[int] = []
        self._frame_keyframe: list[int] = []
        self._frame_pose: list[Array] = []
        self._time: list[float] = []

    # ------------------------------------------------------------------ what happens

    def add_frame(self, number: int, timestamp_s: float, cam_from_world: Array) -> int:
        """Append a pose to the path; returns its block."""
        keyframe = next(reversed(self.keyframes), -1)
        pose = cam_from_world
        if keyframe >= 0:
            pose = rigid3.compose(cam_from_world, rigid3.inverse(self.keyframes[keyframe]))
        self._frame_number.append(number)
        self._frame_keyframe.append(keyframe)
        self._frame_pose.append(pose)
        self._time.append(timestamp_s)
        return (len(self._frame_number) - 1) // FRAME_BLOCK

    def change(self, message: Mapping[str, Any]) -> None:
        """Take over new and moved keyframes and points."""
        frames, poses = message["keyframe_frame_idx"].tolist(), np.asarray(message["keyframe_cam_from_world"])
        ids, xyz = np.asarray(message["point_id"], np.int64), message["point_xyz"]
        changed = Changed()
        if message["is_complete"]:
            self._forget(frames, poses, changed)
        for frame_idx, pose in zip(frames, poses, strict=True):
            self.keyframes[frame_idx] = pose
            self._order.setdefault(frame_idx, len(self._order))
            changed.keyframes.add(self._order[frame_idx] // KEYFRAME_BLOCK)
        moved = set(frames)
        changed.frames |= {k // FRAME_BLOCK for k, idx in enumerate(self._frame_keyframe) if idx in moved}
        self._make_room(int(ids.max(initial=-1)) + 1)
        is_new = np.isnan(self.point_xyz[ids, 0])
        self._uncoloured = np.union1d(self._uncoloured, ids[is_new])
        self.point_xyz[ids] = xyz
        changed.points |= set(np.unique(ids // POINT_BLOCK).tolist())
        self._set_frustum(poses[-1] if len(poses) else None, xyz, changed)
        self.changed.add(changed)

    def colour(self, camera: Camera, cam_from_world: Array, image: NDArray[np.uint8]) -> None:
        """Give new points the grey that they have in the image of the keyframe that they came with."""
        ids = self._uncoloured[np.isfinite(self.point_xyz[self._uncoloured, 0])]
        self._uncoloured = np.zeros(0, np.int64)
        if not len(ids) or not np.isfinite(cam_from_world[0]):
            return
        xy = project(camera, rigid3.apply(cam_from_world, self.point_xyz[ids].astype(np.float64)))
        inside = np.isfinite(xy).all(1) & (xy >= 0).all(1) & (xy < np.array(image.shape[::-1])).all(1)
        column, row = xy[inside].astype(np.int64).T
        self.point_grey[ids[inside]] = image[row, column]

    def absorb(self, other: LiveMap) -> None:
        """Take over the path of a map that was joined to this one, whose keyframes are in this one now."""
        shared = [idx for idx in other.keyframes if idx in self.keyframes]
        pair = (np.array([keyframes[idx] for idx in shared]) for keyframes in (other.keyframes, self.keyframes))
        scale = _scale_between(*pair) if len(shared) > 1 else 1.0
        entries = [
            *zip(self._frame_number, self._frame_keyframe, self._frame_pose, self._time, strict=True),
            *(
                (number, keyframe, np.concatenate([pose[:4], scale * pose[4:]]), time_s)
                for number, keyframe, pose, time_s in zip(
                    other._frame_number, other._frame_keyframe, other._frame_pose, other._time, strict=True
                )
            ),
        ]
        entries.sort(key=lambda entry: entry[0])
        self._frame_number = [entry[0] for entry in entries]
        self._frame_keyframe = [entry[1] for entry in entries]
        self._frame_pose = [entry[2] for entry in entries]
        self._time = [entry[3] for entry in entries]
        self.changed.frames |= set(range(-(-len(entries) // FRAME_BLOCK)))

    def _forget(self, frames: list[int], poses: Array, changed: Changed) -> None:
        """All keyframes and points are told anew: the others are gone, and the unit of length may be another."""
        old = [(self.keyframes[idx], pose) for idx, pose in zip(frames, poses, strict=True) if idx in self.keyframes]
        if len(old) >= 2:
            scale = _scale_between(np.array([a for a, _ in old]), np.array([b for _, b in old]))
            self._frame_pose = [np.concatenate([pose[:4], scale * pose[4:]]) for pose in self._frame_pose]
        kept = set(frames)
        for idx in [idx for idx in self.keyframes if idx not in kept]:
            del self.keyframes[idx]
        # the path of a frame whose keyframe is gone stands still
        changed.keyframes |= {place // KEYFRAME_BLOCK for place in self._order.values()}
        changed.points |= set(range(len(self.point_xyz) // POINT_BLOCK))
        changed.frames |= {k // FRAME_BLOCK for k in range(len(self._frame_number))}
        self.point_xyz[:] = np.nan
        self.frustum = 0.0

    def _make_room(self, count: int) -> None:
        if count > len(self.point_xyz):
            length = POINT_BLOCK * -(-max(count, 2 * len(self.point_xyz)) // POINT_BLOCK)
            xyz = np.full((length, 3), np.nan, np.float32)
            grey = np.full(length, _UNKNOWN_GREY, np.uint8)
            xyz[: len(self.point_xyz)], grey[: len(self.point_grey)] = self.point_xyz, self.point_grey
            self.point_xyz, self.point_grey = xyz, grey

    def _set_frustum(self, pose: Array | None, xyz: NDArray[np.float32], changed: Changed) -> None:
        """Once, and again when the scene has become very different."""
        if pose is None or len(xyz) < 10:
            return
        depth = float(np.median(rigid3.apply(pose, np.asarray(xyz, np.float64))[:, 2]))
        length = FRUSTUM_SHARE * depth
        if depth > 0 and not 0.4 < self.frustum / length < 2.5:
            self.frustum = length
            changed.keyframes |= {place // KEYFRAME_BLOCK for place in self._order.values()}

    # ------------------------------------------------------------------ what is drawn

    @property
    def first_time_s(self) -> float:
        return self._time[0]

    @property
    def last_time_s(self) -> float:
        return self._time[-1]

    def points(self, block: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Points (N, 3) of a block and their greys (N,)."""
        rows = slice(block * POINT_BLOCK, (block + 1) * POINT_BLOCK)
        known = np.isfinite(self.point_xyz[rows, 0])
        return self.point_xyz[rows][known], self.point_grey[rows][known]

    def keyframe_poses(self, block: int) -> Array:
        """(K, 7) of a block."""
        ours = [idx for idx, place in self._order.items() if place // KEYFRAME_BLOCK == block and idx in self.keyframes]
        return np.array([self.keyframes[idx] for idx in ours]).reshape(-1, 7)

    def frame_poses(self, first: int = 0, stop: int | None = None) -> Array:
        """(N, 7) poses along the path as the keyframes stand now; NaN where the keyframe is gone."""
        out = []
        for keyframe, pose in zip(self._frame_keyframe[first:stop], self._frame_pose[first:stop], strict=True):
            if keyframe < 0:
                out.append(pose)
            elif keyframe in self.keyframes:
                out.append(rigid3.compose(pose, self.keyframes[keyframe]))
            else:
                out.append(np.full(7, np.nan))
        return np.array(out).reshape(-1, 7)

    @property
    def frame_numbers(self) -> Ints:
        """(N,) of the frames along the path."""
        return np.array(self._frame_number, np.int64)

    def strips(self, block: int) -> list[Array]:
        """The path of a block, from the end of the block before it, as lines (N, 3) that gaps interrupt."""
        first = max(0, block * FRAME_BLOCK - 1)
        stop = min(len(self._frame_number), (block + 1) * FRAME_BLOCK)
        return unbroken(rigid3.center(self.frame_poses(first, stop)), self.frame_numbers[first:stop])

    def against(self, ground_truth: Trajectory, alignment: Alignment) -> tuple[Array, float] | None:
        """``map_from_ground_truth`` (8,) over the path so far, and the newest frame's distance from the ground truth;
        None so far."""
        times = np.array(self._time)
        if len(times) < 3:
            return None
        ours = Trajectory.from_cam_from_world(self.frame_poses(), times)
        try:
            pairs = associate(ours, ground_truth, max_difference_s=float(np.median(np.diff(times))) / 2)
            error = absolute_error(pairs, alignment)
        except InputError:
            return None
        if not error.scale > 0:
            return None
        return similarity.inverse(error.ground_truth_from_estimate), float(error.translation_m[-1])


def unbroken(xyz: Array, number: Ints) -> list[Array]:
    """Lines (N, 3) through points (M, 3), broken where numbers are left out or points are NaN."""
    known = np.isfinite(xyz[:, 0])
    xyz, number = xyz[known], number[known]
    cuts = np.flatnonzero(np.diff(number) != 1) + 1
    return [line for line in np.split(xyz, cuts) if len(line) > 1]


def _scale_between(before: Array, after: Array) -> float:
    """How much longer the same keyframes (K, 7) have become; 1 if they are all in one place."""
    a, b = rigid3.center(before), rigid3.center(after)
    spread = float(np.linalg.norm(a - a.mean(0)))
    return float(np.linalg.norm(b - b.mean(0))) / spread if spread > 0 else 1.0


def frustum_lines(camera: Camera, cam_from_world: Array, length: float) -> NDArray[np.float32]:
    """Each camera (K, 7) as one line (K, 11, 3) around its image and through its centre."""
    fx, fy, cx, cy = camera.canonical[:4]
    u, v = np.array([0.0, camera.width]), np.array([0.0, camera.height])
    left, right = (u - cx) / fx
    top, bottom = (v - cy) / fy
    corners = np.array([[left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]]) * length
    center = np.zeros(3)
    around = [center, corners[0], corners[1], center, corners[2], corners[3], center, corners[0], corners[3]]
    path = np.array([*around, corners[2], corners[1]])
    world_from_cam = rigid3.inverse(cam_from_world)
    rotation = rigid3.rotation_matrix(world_from_cam)
    return np.asarray(np.einsum("kij,nj->kni", rotation, path) + world_from_cam[:, None, 4:], np.float32)
