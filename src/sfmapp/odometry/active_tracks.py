"""The points that are being followed from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.alignment import align_patches
from sfmapp.odometry.pyramid import Pyramid
from sfmapp.scene.camera import Camera, project

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ActiveTracks:
    """Tracks (N) as arrays. The patch of a track is looked for as it was in its reference keyframe, so that it cannot
    drift from frame to frame.

    Attributes:
        point_id: (N,) int64, ascending.
        xy: (N, 2) float64, pixels in the last frame.
        reference: (N,) int64, keyframe whose image holds the patch.
        reference_xy: (N, 2) float64, pixels there. reference_ray: (N, 2), the same as normalised image points.
        inverse_depth: (N,) float64, along z in the reference keyframe; a guess until the point is triangulated.
        zncc: (N,) float32, likeness of the patches at the last alignment.
    """

    point_id: NDArray[np.int64]
    xy: Array
    reference: NDArray[np.int64]
    reference_xy: Array
    reference_ray: Array
    inverse_depth: Array
    zncc: NDArray[np.float32]

    @staticmethod
    def none() -> ActiveTracks:
        """No tracks."""
        integers, pairs = np.zeros(0, np.int64), np.zeros((0, 2))
        return ActiveTracks(integers, pairs, integers, pairs, pairs, np.zeros(0), np.zeros(0, np.float32))

    def __len__(self) -> int:
        return len(self.point_id)

    def subset(self, chosen: Mask | NDArray[np.int64]) -> ActiveTracks:
        """The chosen tracks, in the order of choice."""
        return ActiveTracks(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def moved(self, xy: Array) -> ActiveTracks:
        """The same tracks at other places (N, 2)."""
        return replace(self, xy=xy)

    def joined(self, other: ActiveTracks) -> ActiveTracks:
        """These tracks and others, sorted by point."""
        both = ActiveTracks(
            *(np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        )
        return both.subset(np.argsort(both.point_id, kind="stable"))

    def world_points(self, keyframe_poses: Mapping[int, Array]) -> Array:
        """(N, 3) where the tracks are believed to be, from their reference keyframes and inverse depths."""
        xyz = np.empty((len(self), 3))
        for keyframe in np.unique(self.reference):
            mine = self.reference == keyframe
            rays = np.column_stack([self.reference_ray[mine], np.ones(mine.sum())])
            xyz[mine] = rigid3.apply(
                rigid3.inverse(keyframe_poses[int(keyframe)]), rays / self.inverse_depth[mine, None]
            )
        return xyz


def patch_warp(camera_from_reference: Array, reference_ray: Array, depth_ratio: Array) -> Array:
    """(N, 2, 2) how an offset in the image becomes one in the reference image, for surfaces that face the camera.

    Args:
        camera_from_reference: (7,) pose.
        reference_ray: (N, 2) normalised image points in the reference.
        depth_ratio: (N,) depth in the image over depth in the reference.
    """
    rotation = rigid3.rotation_matrix(camera_from_reference).T[:, :2]
    return depth_ratio[:, None, None] * (rotation[:2] - reference_ray[:, :, None] * rotation[2])


def follow(
    tracks: ActiveTracks,
    xyz: Array,
    camera: Camera,
    predicted: Array,
    keyframe_poses: Mapping[int, Array],
    keyframe_pyramids: Mapping[int, Pyramid],
    pyramid: Pyramid,
    coarsest_level: int,
) -> tuple[ActiveTracks, Mask]:
    """Find the tracks in a new image, near where a predicted pose puts them.

    Args:
        xyz: (N, 3) world points of the tracks.
        predicted: (7,) cam_from_world of the new image.
        keyframe_poses, keyframe_pyramids: of all reference keyframes.
        coarsest_level: pyramid level at which the search begins: the worse the prediction, the coarser.

    Returns:
        All tracks with new positions, and (N,) which of them were found.
    """
    in_camera = rigid3.apply(predicted, xyz)
    guess = project(camera, in_camera)
    xy, zncc, found = tracks.xy.copy(), tracks.zncc.copy(), np.zeros(len(tracks), bool)
    for keyframe in np.unique(tracks.reference):
        mine = np.flatnonzero((tracks.reference == keyframe) & np.isfinite(guess[:, 0]))
        from_reference = rigid3.compose(predicted, rigid3.inverse(keyframe_poses[int(keyframe)]))
        ratio = in_camera[mine, 2] / rigid3.apply(keyframe_poses[int(keyframe)], xyz[mine])[:, 2]
        # a patch that has grown or shrunk beyond that is not the same patch any more
        mine, ratio = mine[(ratio > 0.4) & (ratio < 2.5)], ratio[(ratio > 0.4) & (ratio < 2.5)]
        aligned = align_patches(
            keyframe_pyramids[int(keyframe)], tracks.reference_xy[mine], pyramid, guess[mine],
            affine=patch_warp(from_reference, tracks.reference_ray[mine], ratio), coarsest_level=coarsest_level,
        )  # fmt: skip
        xy[mine], zncc[mine], found[mine] = aligned.xy, aligned.zncc, aligned.is_converged
    return replace(tracks, xy=xy, zncc=zncc), found
