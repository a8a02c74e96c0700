"""The state of a reconstruction: cameras, poses and points beside the tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import ROW, across_seam, project
from sfmapp.geometry import rigid3
from sfmapp.geometry.triangulation import Views
from sfmapp.reporting import Report
from sfmapp.scene.rig import RigImages
from sfmapp.scene.tracks import Tracks


class ModelSummary(Report):
    """Counts and errors of a model; lengths of residuals in pixels, over its observations."""

    num_images: int
    num_registered: int
    num_points: int
    num_observations: int
    mean_track_length: float
    mean_observations_per_image: float
    mean_reprojection_error_px: float
    rms_reprojection_error_px: float


@dataclass
class Reconstruction:
    """Flat arrays over images (I), tracks (T) and observations (O).

    Attributes:
        cameras: intrinsics, few.
        image_names: I names, relative to the image folder, with forward slashes.
        image_camera_idx: (I,) int32, position in ``cameras``.
        cam_from_world: (I, 7) float64, quaternion x y z w and translation; NaN where unregistered.
        tracks: the observations.
        point_xyz: (T, 3) float64, world; NaN where not triangulated.
        obs_is_inlier: (O,) bool: the observation supports its point. False wherever the image is unregistered or the
            point not triangulated.
        point_rgb: (T, 3) uint8.
        rig: which images share a rig's pose; None if every image has a pose of its own.
    """

    cameras: list[Camera]
    image_names: list[str]
    image_camera_idx: NDArray[np.int32]
    cam_from_world: NDArray[np.float64]
    tracks: Tracks
    point_xyz: NDArray[np.float64]
    obs_is_inlier: NDArray[np.bool_]
    point_rgb: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    rig: RigImages | None = None

    def __post_init__(self) -> None:
        if len(self.point_rgb) != self.tracks.num_tracks:
            self.point_rgb = np.zeros((self.tracks.num_tracks, 3), np.uint8)

    @staticmethod
    def empty(
        cameras: list[Camera], image_names: list[str], image_camera_idx: NDArray[np.int32], tracks: Tracks
    ) -> Reconstruction:
        """Nothing registered and nothing triangulated yet."""
        return Reconstruction(
            list(cameras),
            list(image_names),
            np.asarray(image_camera_idx, np.int32),
            np.full((len(image_names), 7), np.nan),
            tracks,
            np.full((tracks.num_tracks, 3), np.nan),
            np.zeros(tracks.num_observations, bool),
        )

    def copy(self) -> Self:
        """A copy that shares only the tracks, the rig and the (immutable) cameras."""
        return replace(
            self,
            cameras=list(self.cameras),
            image_names=list(self.image_names),
            image_camera_idx=self.image_camera_idx.copy(),
            cam_from_world=self.cam_from_world.copy(),
            point_xyz=self.point_xyz.copy(),
            obs_is_inlier=self.obs_is_inlier.copy(),
            point_rgb=self.point_rgb.copy(),
        )

    @property
    def is_registered(self) -> NDArray[np.bool_]:
        """(I,) bool."""
        return ~np.isnan(self.cam_from_world[:, 0])

    @property
    def registered_idx(self) -> NDArray[np.int64]:
        """(R,) positions of the registered images."""
        return np.flatnonzero(self.is_registered)

    @property
    def is_triangulated(self) -> NDArray[np.bool_]:
        """(T,) bool."""
        return ~np.isnan(self.point_xyz[:, 0])

    @property
    def centers(self) -> NDArray[np.float64]:
        """(I, 3) camera centres in the world, NaN where unregistered."""
        return rigid3.center(self.cam_from_world)

    def canonical_cameras(self) -> NDArray[np.float64]:
        """(C, 17) canonical intrinsics for the kernels, see ``Camera.canonical``."""
        return np.array([camera.canonical for camera in self.cameras]).reshape(-1, ROW)

    def views(self) -> Views:
        """Poses and lenses of all images, for the kernels."""
        rotation, translation = rigid3.rotation_matrix(self.cam_from_world), self.cam_from_world[:, 4:].copy()
        return Views(rotation, translation, self.image_camera_idx, self.canonical_cameras())

    def distinct_poses(self, image_idx: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Poses (Q, 7) that registered images (N,) do not share, in the order of their first image, and (N,) whose is
        which: for images on a rig its pose, rig_from_world, for others their own.
        """
        poses = self.cam_from_world[image_idx]
        if self.rig is None:
            return poses, np.arange(len(image_idx))
        frame = self.rig.frame_idx[image_idx].astype(np.int64)
        on_rig = frame >= 0
        poses[on_rig] = self.rig.rig_from_world(self.cam_from_world)[frame[on_rig]]
        frame[~on_rig] = frame.max(initial=0) + 1 + np.flatnonzero(~on_rig)
        _, first, number = np.unique(frame, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(first))
        return poses[np.sort(first)], rank[number]

    def move_images(self, image_idx: NDArray[np.integer], poses: NDArray[np.float64]) -> None:
        """Give images (N,) new poses (N, 7): for an image on a rig that of the rig, which moves the whole frame.

        Unregistered images of such a frame stay so.
        """
        if self.rig is None:
            self.cam_from_world[image_idx] = poses
            return
        frame = self.rig.frame_idx[image_idx]
        self.cam_from_world[image_idx[frame < 0]] = poses[frame < 0]
        rig_from_world = np.full((int(self.rig.frame_idx.max(initial=-1)) + 1, 7), np.nan)
        rig_from_world[frame[frame >= 0]] = poses[frame >= 0]
        pose_of = rig_from_world[self.rig.frame_idx]
        moved = np.flatnonzero((self.rig.frame_idx >= 0) & self.is_registered & ~np.isnan(pose_of[:, 0]))
        self.cam_from_world[moved] = self.rig.cam_from_world(moved, pose_of[moved])

    def residuals_px(self) -> NDArray[np.float64]:
        """(O, 2) projected minus observed pixel; NaN where the image or the point is missing, or behind the camera."""
        out = np.empty((self.tracks.num_observations, 2))
        tracks = self.tracks
        reprojection_residuals(
            self.views(), self.point_xyz, tracks.obs_image_idx, tracks.obs_track_idx, tracks.obs_xy, out
        )
        return out

    def errors_px(self) -> NDArray[np.float64]:
        """(O,) lengths of residuals in pixels, NaN as theirs."""
        x, y = self.residuals_px().T
        lengths: NDArray[np.float64] = np.sqrt(x * x + y * y)  # several times as fast as norms of rows of two
        return lengths

    def summary(self) -> ModelSummary:
        """Counts and errors."""
        used = self.obs_is_inlier
        errors = self.errors_px()[used]
        num_points = int(self.is_triangulated.sum())
        num_registered = int(self.is_registered.sum())
        return ModelSummary(
            num_images=len(self.image_names),
            num_registered=num_registered,
            num_points=num_points,
            num_observations=int(used.sum()),
            mean_track_length=float(used.sum() / num_points) if num_points else 0.0,
            mean_observations_per_image=float(used.sum() / num_registered) if num_registered else 0.0,
            mean_reprojection_error_px=float(errors.mean()) if len(errors) else 0.0,
            rms_reprojection_error_px=float(np.sqrt((errors**2).mean())) if len(errors) else 0.0,
        )


@numba.njit(cache=True, nogil=True)
def reprojection_residuals(
    views: Views,
    point_xyz: NDArray[np.float64],
    obs_image_idx: NDArray[np.int32],
    obs_track_idx: NDArray[np.int32],
    obs_xy: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill out (O, 2) with projected minus observed pixels; NaN for missing images and points and behind the camera."""
    rotation, translation, image_camera_idx, canonical = views
    for o in range(obs_image_idx.shape[0]):
        i = obs_image_idx[o]
        p = obs_track_idx[o]
        x0, x1, x2 = point_xyz[p, 0], point_xyz[p, 1], point_xyz[p, 2]
        z = rotation[i, 2, 0] * x0 + rotation[i, 2, 1] * x1 + rotation[i, 2, 2] * x2 + translation[i, 2]
        if math.isnan(z):  # while a map grows, most have no pose or no point yet, which a lens would find out slowly
            out[o, 0] = out[o, 1] = math.nan
            continue
        x = rotation[i, 0, 0] * x0 + rotation[i, 0, 1] * x1 + rotation[i, 0, 2] * x2 + translation[i, 0]
        y = rotation[i, 1, 0] * x0 + rotation[i, 1, 1] * x1 + rotation[i, 1, 2] * x2 + translation[i, 1]
        k = image_camera_idx[i]
        u, v = project(canonical[k], x, y, z)
        out[o, 0] = across_seam(canonical[k], u - obs_xy[o, 0])
        out[o, 1] = v - obs_xy[o, 1]
