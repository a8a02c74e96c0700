"""What takes part in one adjustment, gathered from a reconstruction into flat arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.kernels import ImageArrays, LensArrays, PointArrays
from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import ROW
from sfmapp.camera.models import PARAM_NAMES, canonical_from_params, kind_of
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import RigImages

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Varying:
    """What of a reconstruction takes part in an adjustment, and what of that may change.

    Attributes:
        images: (I,) bool, which poses may change; None for all registered ones. Images that share a rig's pose
            (``reconstruction.rig``) move together: those that take part must all be marked or none.
        cameras: (C,) bool, which intrinsics may change, beside ``options.refine_*``; cameras with ``is_fixed`` never
            do. None for all.
        centers: (C,) bool, of which cameras the principal points may change where the options let them; None for all.
            In a rig, that of another camera than the first stands for how it is turned.
        points: (T,) bool, which points take part and vary; None for those that a variable image observes.
        constant_points: (T,) bool, which of the points take part without moving; None for none.
    """

    images: Mask | None = None
    cameras: Mask | None = None
    centers: Mask | None = None
    points: Mask | None = None
    constant_points: Mask | None = None


EVERYTHING = Varying()


@dataclass(frozen=True)
class FreeIntrinsics:
    """Which parameters of the cameras may change, as the kernels want them.

    Attributes:
        params: for each local camera, (Q,) positions in ``Camera.params``; empty where the camera is constant.
        ptr: (C + 1,) int64; slot, column: for camera c in ``ptr[c]:ptr[c + 1]`` the canonical slot of each derivative
            and the column of the block that it belongs to, from 8 on that of a second block behind it.
    """

    params: list[NDArray[np.int64]]
    ptr: NDArray[np.int64]
    slot: NDArray[np.int64]
    column: NDArray[np.int64]


@dataclass
class Problem:
    """Flat arrays over local images (I), cameras (C), points (P) and observations (O), and the blocks (B) of unknowns.

    The state is ``poses``, ``canonical`` and ``xyz``. Poses (Q) are those of single images and of rigs, in the order of
    their first image: image i has the pose ``image_pose[i]``, and if ``image_mount[i] >= 0`` the constant cam_from_rig
    ``mounts[image_mount[i]]`` (M, 12) on top. Blocks are numbered poses first, then cameras of their own, then points
    that are not eliminated, then variables that only other factors know; ``image_block[i]`` is
    ``pose_block[image_pose[i]]``, -1 where constant.
    """

    image_idx: NDArray[np.int64]
    camera_idx: NDArray[np.int64]
    track_idx: NDArray[np.int64]
    poses: Array
    image_pose: NDArray[np.int32]
    image_mount: NDArray[np.int32]
    mounts: Array
    canonical: Array
    xyz: Array
    is_constant: Mask
    point_block: NDArray[np.int32]
    point_ptr: NDArray[np.int64]
    obs_image: NDArray[np.int32]
    obs_xy: Array
    image_camera: NDArray[np.int32]
    pose_block: NDArray[np.int32]
    image_block: NDArray[np.int32]
    camera_block: NDArray[np.int32]
    block_dim: NDArray[np.int64]
    penalty: Array
    free: FreeIntrinsics

    @property
    def second_block(self) -> NDArray[np.int32]:
        """(C,) the block with what a camera has beyond eight free parameters, -1 where it has no more."""
        is_wide = np.array([len(params) > 8 for params in self.free.params], bool)
        return np.where(is_wide & (self.camera_block >= 0), self.camera_block + 1, -1).astype(np.int32)

    @property
    def points(self) -> PointArrays:
        """For the kernels, at the current state; so are the two below."""
        return PointArrays(self.point_ptr, self.obs_image, self.obs_xy, self.xyz, self.is_constant, self.point_block)

    def images(self, rows: Array) -> ImageArrays:
        """Images with rows (I, 12) of their poses."""
        return ImageArrays(rows, self.image_mount, self.mounts, self.image_camera, self.image_block)

    @property
    def lenses(self) -> LensArrays:
        free, block = self.free, self.camera_block
        return LensArrays(self.canonical, self.penalty, block, self.second_block, free.ptr, free.slot, free.column)

    @property
    def num_blocks(self) -> int:
        return len(self.block_dim)

    @property
    def num_pose_blocks(self) -> int:
        return int((self.pose_block >= 0).sum())

    @property
    def pose_images(self) -> NDArray[np.int64]:
        """(Q,) the first local image of each pose."""
        return np.unique(self.image_pose, return_index=True)[1]

    @property
    def has_baseline(self) -> bool:
        """Images that share a pose were taken from different places: lengths are known."""
        place, on = np.zeros((len(self.image_idx), 3)), self.image_mount >= 0
        rows = self.mounts[self.image_mount[on]]
        place[on] = np.einsum("nji,nj->ni", rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
        apart = np.abs(place - place[self.pose_images][self.image_pose]).max(initial=0.0)
        return bool(apart > 1e-12 * np.abs(place).max(initial=0.0))

    @property
    def num_observations(self) -> int:
        return len(self.obs_image)


def free_params(camera: Camera, focal: bool, distortion: bool, principal_point: bool) -> NDArray[np.int64]:
    """(Q,) positions of the parameters of a camera that may change; none if the user has fixed it."""
    if camera.is_fixed:
        return np.zeros(0, np.int64)
    wanted = [
        {"focal": focal, "center": principal_point, "distortion": distortion, "size": False}[kind_of(name)]
        for name in PARAM_NAMES[camera.model]
    ]
    return np.flatnonzero(wanted)


@dataclass(frozen=True)
class Mentioned:
    """What factors beside the reprojections are over: positions of images, cameras and points, which take part even
    where nothing else sees them (a point: one inlier is enough), and the dimensions of their own variables.
    """

    images: Sequence[int] = ()
    cameras: Sequence[int] = ()
    points: Sequence[int] = ()
    dims: Sequence[int] = ()


NOTHING = Mentioned()


def make_problem(
    reconstruction: Reconstruction,
    *,
    refine: tuple[bool, bool, bool],
    varying: Varying = EVERYTHING,
    mentioned: Mentioned = NOTHING,
    merge: bool = True,
) -> Problem:
    """Gather the observations of the points that take part.

    Args:
        refine: may focal lengths, distortion, principal points change.
        mentioned: by other factors; these points are not eliminated.
        merge: give a camera with one image and at most two free parameters a place in the block of its image, unless
            other images share that.

    Raises:
        ValueError: of the images that share a rig's pose and take part, some may vary and some not.
    """
    tracks = reconstruction.tracks
    registered = reconstruction.is_registered
    varies = registered if varying.images is None else registered & np.asarray(varying.images, bool)
    if varying.points is None:
        if varying.images is None:
            selected = np.flatnonzero(reconstruction.is_triangulated)
        else:
            selected = _tracks_of_images(np.flatnonzero(varies), tracks.image_ptr, tracks.image_obs,
                                         tracks.obs_track_idx, tracks.num_tracks)  # fmt: skip
    else:
        selected = np.flatnonzero(varying.points)
    is_mentioned = np.zeros(tracks.num_tracks, bool)
    is_mentioned[[t for t in mentioned.points if t < tracks.num_tracks]] = True
    if is_mentioned.any():
        selected = np.union1d(selected, np.flatnonzero(is_mentioned))
    is_constant = np.zeros(len(selected), bool)
    if varying.constant_points is not None:
        is_constant = np.asarray(varying.constant_points)[selected]
    kept, point_ptr, obs_image, obs_xy, image_used = _gather(
        selected, is_constant | is_mentioned[selected], tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy,
        reconstruction.obs_is_inlier, np.isfinite(reconstruction.cam_from_world[:, 0]), reconstruction.point_xyz,
    )  # fmt: skip
    image_used[[i for i in mentioned.images if i < len(registered) and registered[i]]] = True
    image_idx = np.flatnonzero(image_used)
    known_cameras = [c for c in mentioned.cameras if c < len(reconstruction.cameras)]
    image_of = np.full(len(registered), -1, np.int32)
    image_of[image_idx] = np.arange(len(image_idx))
    camera_idx = np.unique(np.concatenate([reconstruction.image_camera_idx[image_idx], known_cameras]).astype(np.int64))
    image_camera = np.searchsorted(camera_idx, reconstruction.image_camera_idx[image_idx]).astype(np.int32)
    cameras = [reconstruction.cameras[c] for c in camera_idx]
    focal, distortion, center = refine
    moves = np.full(len(reconstruction.cameras), center) if varying.centers is None else varying.centers & center
    params = [free_params(reconstruction.cameras[c], focal, distortion, bool(moves[c])) for c in camera_idx]
    if varying.cameras is not None:
        params = [p if varying.cameras[c] else p[:0] for p, c in zip(params, camera_idx, strict=True)]
    poses, pose_of_image = reconstruction.distinct_poses(image_idx)
    image_pose = pose_of_image.astype(np.int32)
    image_mount, mounts = _mounts(reconstruction.rig, image_idx)
    pose_varies = _varying_poses(varies[image_idx], image_pose, len(poses))
    pose_block, camera_block, block_dim = _number_blocks(pose_varies, image_pose, image_camera, params, merge)
    track_idx, is_constant = selected[kept], is_constant[kept]
    point_block = np.full(len(track_idx), -1, np.int32)
    is_block = is_mentioned[track_idx] & ~is_constant
    point_block[is_block] = len(block_dim) + np.arange(is_block.sum())
    block_dim = np.concatenate([block_dim, np.full(is_block.sum(), 3), np.array(mentioned.dims)]).astype(np.int64)
    return Problem(
        image_idx=image_idx,
        camera_idx=camera_idx,
        track_idx=track_idx,
        poses=poses,
        image_pose=image_pose,
        image_mount=image_mount,
        mounts=mounts,
        canonical=np.array([camera.canonical for camera in cameras]).reshape(-1, ROW),
        xyz=reconstruction.point_xyz[track_idx],
        is_constant=is_constant,
        point_block=point_block,
        point_ptr=point_ptr,
        obs_image=image_of[obs_image],
        obs_xy=obs_xy,
        image_camera=image_camera,
        pose_block=pose_block,
        image_block=pose_block[image_pose],
        camera_block=camera_block,
        block_dim=block_dim,
        # a point behind the camera misses by the image's diagonal
        penalty=np.array([float(camera.width**2 + camera.height**2) for camera in cameras]),
        free=_free_columns(cameras, params, camera_block, int(pose_varies.sum())),
    )


def pose_rows(poses: Array) -> Array:
    """(I, 12) rotation row by row and translation of poses (I, 7)."""
    return np.concatenate([rigid3.rotation_matrix(poses).reshape(-1, 9), poses[:, 4:]], 1)


def free_values(problem: Problem, canonical: Array, camera: int) -> Array:
    """(Q,) values of the free parameters of a local camera."""
    free = problem.free
    begin, end = free.ptr[camera], free.ptr[camera + 1]
    columns, values = free.column[begin:end], np.zeros(len(free.params[camera]))
    values[columns - columns.min(initial=8)] = canonical[camera, free.slot[begin:end]]
    return values


def _mounts(rig: RigImages | None, image_idx: NDArray[np.int64]) -> tuple[NDArray[np.int32], Array]:
    """image_mount (I,) and mounts (M, 12) of :class:`Problem`."""
    if rig is None:
        return np.full(len(image_idx), -1, np.int32), np.zeros((0, 12))
    mount = np.where(rig.is_mounted[image_idx], rig.sensor_idx[image_idx], -1)
    return mount.astype(np.int32), pose_rows(rig.cam_from_rig)


def _varying_poses(varies: Mask, image_pose: NDArray[np.int32], num_poses: int) -> Mask:
    """(Q,) bool from what the images (I,) say, which must agree."""
    out = np.zeros(num_poses, bool)
    out[image_pose[varies]] = True
    if (out[image_pose] != varies).any():
        raise ValueError("images that share a rig's pose must all vary or all be constant, found both in one frame")
    return out


def _number_blocks(
    varies: Mask,
    image_pose: NDArray[np.int32],
    image_camera: NDArray[np.int32],
    params: list[NDArray[np.int64]],
    merge: bool,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """Blocks of poses and cameras, and their numbers of rows."""
    num_poses = int(varies.sum())
    pose_block = np.full(len(varies), -1, np.int32)
    pose_block[varies] = np.arange(num_poses)
    camera_block = np.full(len(params), -1, np.int32)
    dims = [6] * num_poses
    moving = varies[image_pose]
    uses = np.bincount(image_camera[moving], minlength=len(params))
    only = np.full(len(params), -1, np.int64)
    only[image_camera[moving]] = pose_block[image_pose[moving]]
    shares = np.bincount(pose_block[image_pose[moving]], minlength=num_poses)
    for c, free in enumerate(params):
        if len(free) == 0:
            continue
        if merge and uses[c] == 1 and len(free) <= 2 and shares[only[c]] == 1:
            camera_block[c] = only[c]
            dims[only[c]] += len(free)
        else:
            camera_block[c] = len(dims)
            dims += [min(len(free), 8)] + [len(free) - 8] * (len(free) > 8)
    return pose_block, camera_block, np.array(dims, np.int64)


def _free_columns(
    cameras: list[Camera], params: list[NDArray[np.int64]], camera_block: NDArray[np.int32], num_pose_blocks: int
) -> FreeIntrinsics:
    ptr, slots, columns = [0], [], []
    for c, camera in enumerate(cameras):
        first = 6 if 0 <= camera_block[c] < num_pose_blocks else 0
        spread = canonical_from_params(camera.model)
        for n, param in enumerate(params[c]):
            for slot in np.flatnonzero(spread[:, param]):
                slots.append(slot)
                columns.append(first + n)
        ptr.append(len(slots))
    return FreeIntrinsics(params, np.array(ptr, np.int64), np.array(slots, np.int64), np.array(columns, np.int64))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _tracks_of_images(
    images: NDArray[np.int64], image_ptr: NDArray[np.int64], image_obs: NDArray[np.int64],
    obs_track_idx: NDArray[np.int32], num_tracks: int,
) -> NDArray[np.int64]:  # fmt: skip
    """Ascending tracks that some of the images observe."""
    seen = np.zeros(num_tracks, np.bool_)
    for i in images:
        for k in range(image_ptr[i], image_ptr[i + 1]):
            seen[obs_track_idx[image_obs[k]]] = True
    return np.flatnonzero(seen)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(
    selected: NDArray[np.int64], is_constant: Mask, track_ptr: NDArray[np.int64], obs_image_idx: NDArray[np.int32],
    obs_xy: Array, is_inlier: Mask, registered: Mask, xyz: Array,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32], Array, Mask]:  # fmt: skip
    """Points that are kept, as positions in ``selected``, and their observations.

    An observation counts if it is an inlier of a registered image with finite pixels, a point if it is triangulated and
    has two of them (one, if it is constant).
    """
    total = 0
    for t in selected:
        total += track_ptr[t + 1] - track_ptr[t]
    kept = np.empty(selected.shape[0], np.int64)
    ptr = np.zeros(selected.shape[0] + 1, np.int64)
    image = np.empty(total, np.int32)
    xy = np.empty((total, 2))
    used = np.zeros(registered.shape[0], np.bool_)
    num_kept = n = 0
    for s in range(selected.shape[0]):
        t = selected[s]
        if not np.isfinite(xyz[t, 0] + xyz[t, 1] + xyz[t, 2]):
            continue
        start = n
        for o in range(track_ptr[t], track_ptr[t + 1]):
            i = obs_image_idx[o]
            if is_inlier[o] and registered[i] and np.isfinite(obs_xy[o, 0] + obs_xy[o, 1]):
                image[n] = i
                xy[n, 0] = obs_xy[o, 0]
                xy[n, 1] = obs_xy[o, 1]
                n += 1
        if n - start < (1 if is_constant[s] else 2):
            n = start
            continue
        for o in range(start, n):
            used[image[o]] = True
        kept[num_kept] = s
        num_kept += 1
        ptr[num_kept] = n
    return kept[:num_kept].copy(), ptr[: num_kept + 1].copy(), image[:n].copy(), xy[:n].copy(), used


def write_back(problem: Problem, reconstruction: Reconstruction) -> None:
    """Put the state of a problem into its reconstruction; what was constant is not touched."""
    moved = np.flatnonzero(problem.image_block >= 0)
    reconstruction.move_images(problem.image_idx[moved], problem.poses[problem.image_pose[moved]])
    free = ~problem.is_constant
    reconstruction.point_xyz[problem.track_idx[free]] = problem.xyz[free]
    for c, camera_idx in enumerate(problem.camera_idx):
        if problem.camera_block[c] >= 0:
            camera = reconstruction.cameras[camera_idx]
            params = np.array(camera.params)
            params[problem.free.params[c]] = free_values(problem, problem.canonical, c)
            reconstruction.cameras[camera_idx] = camera.with_params(params)
