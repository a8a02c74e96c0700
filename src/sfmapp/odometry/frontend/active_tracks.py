"""The points that are being followed from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.pyramid import Pyramid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A patch that has grown or shrunk beyond that is not the same patch any more.
_MIN_SCALE = 0.4
# Nor is one that looks less alike: patches of unrelated images with texture correlate above it one time in a hundred.
_MIN_LIKENESS = 0.6


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

    def after_removal(self, keyframe: int) -> ActiveTracks:
        """The same tracks once a keyframe that none of them refers to is dropped."""
        return replace(self, reference=self.reference - (self.reference > keyframe))

    def joined(self, other: ActiveTracks) -> ActiveTracks:
        """These tracks and others, sorted by point."""
        both = ActiveTracks(
            *(np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        )
        return both.subset(np.argsort(both.point_id, kind="stable"))

    def world_points(self, references: References) -> Array:
        """(N, 3) where the tracks are believed to be, from their reference keyframes and inverse depths."""
        rays = np.column_stack([self.reference_ray, np.ones(len(self))]) / self.inverse_depth[:, None]
        k = references.position(self.reference)
        points: Array = np.einsum("nji,nj->ni", references.rotation[k], rays - references.translation[k])
        return points


@dataclass(frozen=True)
class References:
    """Poses of the keyframes that tracks refer to.

    Attributes:
        keyframe: (K,) int64 ascending. rotation: (K, 3, 3) and translation: (K, 3), cam_from_world.
    """

    keyframe: NDArray[np.int64]
    rotation: Array
    translation: Array

    @staticmethod
    def of(keyframe: NDArray[np.int64], cam_from_world: Array) -> References:
        """Of keyframes (K,) ascending with poses (K, 7)."""
        poses = cam_from_world.reshape(-1, 7)
        return References(keyframe, rigid3.rotation_matrix(poses), poses[:, 4:])

    def position(self, keyframe: NDArray[np.int64]) -> NDArray[np.int64]:
        """(N,) rows of keyframes."""
        return np.searchsorted(self.keyframe, keyframe)

    def camera_from(self, cam_from_world: Array) -> tuple[Array, Array]:
        """(K, 3, 3) rotations and (K, 3) translations that take points from the keyframes to a camera (7,)."""
        rotation = rigid3.rotation_matrix(cam_from_world) @ self.rotation.transpose(0, 2, 1)
        return rotation, cam_from_world[4:] - np.einsum("kij,kj->ki", rotation, self.translation)


def patch_warp(rotation: Array, reference_ray: Array, depth_ratio: Array) -> Array:
    """(N, 2, 2) how an offset in the image becomes one in the reference image, for surfaces that face the camera.

    Args:
        rotation: (N, 3, 3) or (3, 3), of the camera from the reference.
        reference_ray: (N, 2) normalised image points in the reference.
        depth_ratio: (N,) depth in the image over depth in the reference.
    """
    columns = np.swapaxes(rotation, -1, -2)[..., :2]
    return depth_ratio[:, None, None] * (columns[..., :2, :] - reference_ray[:, :, None] * columns[..., 2:, :])


def follow(
    tracks: ActiveTracks,
    xyz: Array,
    camera: Camera,
    predicted: Array,
    references: References,
    images: Mapping[int, Pyramid],
    pyramid: Pyramid,
    coarsest_level: int,
) -> tuple[ActiveTracks, Mask]:
    """Find the tracks in a new image, near where a predicted pose puts them.

    Args:
        xyz: (N, 3) world points of the tracks.
        predicted: (7,) cam_from_world of the new image.
        references, images: poses and pyramids of all reference keyframes.
        coarsest_level: pyramid level at which the search begins: the worse the prediction, the coarser.

    Returns:
        All tracks with new positions, and (N,) which of them were found.
    """
    in_camera = rigid3.apply(predicted, xyz)
    guess = project(camera, in_camera)
    k = references.position(tracks.reference)
    axis, offset = references.rotation[k, 2], references.translation[k, 2]
    ratio = in_camera[:, 2] / (np.einsum("ni,ni->n", axis, xyz) + offset)
    usable = np.isfinite(guess[:, 0]) & (ratio > _MIN_SCALE) & (ratio < 1 / _MIN_SCALE)
    rotation = references.camera_from(predicted)[0]
    warp = patch_warp(rotation[k], tracks.reference_ray, ratio)
    chosen = np.flatnonzero(usable)
    xy, zncc, found = tracks.xy.copy(), tracks.zncc.copy(), np.zeros(len(tracks), bool)
    xy[chosen], zncc[chosen], found[chosen] = align_to_references(
        tracks.subset(chosen), images, pyramid, guess[chosen], warp[chosen], coarsest_level
    )
    found &= zncc > _MIN_LIKENESS
    return replace(tracks, xy=xy, zncc=zncc), found


def align_to_references(
    tracks: ActiveTracks,
    images: Mapping[int, Pyramid],
    pyramid: Pyramid,
    guess: Array,
    warp: Array,
    coarsest_level: int,
) -> tuple[Array, NDArray[np.float32], Mask]:
    """Look for the patches of tracks, each as its reference keyframe saw it.

    Args:
        guess: (N, 2) pixels where they are expected. warp: (N, 2, 2) of :func:`patch_warp`.

    Returns:
        (N, 2) pixels, (N,) likeness, (N,) which alignments have converged.
    """
    xy, zncc, found = guess.copy(), np.zeros(len(tracks), np.float32), np.zeros(len(tracks), bool)
    keyframes, counts = np.unique(tracks.reference, return_counts=True)
    by_keyframe = np.split(np.argsort(tracks.reference, kind="stable"), np.cumsum(counts)[:-1])
    for keyframe, mine in zip(keyframes, by_keyframe, strict=False):  # without tracks there is a part all the same
        aligned = align_patches(
            images[int(keyframe)], tracks.reference_xy[mine], pyramid, guess[mine], affine=warp[mine],
            coarsest_level=coarsest_level,
        )  # fmt: skip
        xy[mine], zncc[mine], found[mine] = aligned.xy, aligned.zncc, aligned.is_converged
    return xy, zncc, found
