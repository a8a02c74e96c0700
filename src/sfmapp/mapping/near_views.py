"""Photographs that a model puts side by side: do they show the same points?

Two pictures of one part of a scene, taken from nearly the same place, share most of what both can see. Where a model
has two images side by side whose points are each other's in next to no case, one of the two is in a wrong place: it
came there by repeated structure, or by sides that look alike. No pair needs to contradict it: what speaks is that none
was verified (Zach et al., "What can missing correspondences tell us about 3D structure and motion?", CVPR 2008).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.lens import project
from sfmapp.contradictions import Contradiction
from sfmapp.geometry.triangulation import Views
from sfmapp.mapping.report import NUM_NAMED, NearPair
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Views are near for a point if its rays enclose no more than this, and neither has it larger by more: descriptors stand
# twice as much. Pairs as far apart still share half of their points, the worst of 400 of ten sets of photographs 0.35.
MAX_ANGLE_DEG, MAX_ZOOM = 15.0, 1.5
_MIN_COS = math.cos(math.radians(MAX_ANGLE_DEG))
# Fewer points in view prove nothing.
MIN_VISIBLE = 50
# Pairs that share less of their points do not show the same: of 22 pairs of a model with four images at a wrong place
# the best shared 0.08.
MAX_MISSING_SHARE = 0.2
# Pairs that it takes to call a model wrong: one may have been lost to blur or to something that came before the camera.
MIN_PAIRS = 2


@dataclass(frozen=True)
class NearViews:
    """Pairs of images that see enough points from nearly the same place.

    Attributes:
        image_idx: (K, 2) int64. num_visible: (K,) points of either that are in view of the other, as near: the smaller
            of the two numbers. num_shared: (K,) those that both support, or all verified matches if these are more.
    """

    image_idx: Ints
    num_visible: Ints
    num_shared: Ints

    @property
    def is_missing(self) -> Bools:
        """(K,) bool: next to none of what both should see is matched."""
        return self.num_shared < MAX_MISSING_SHARE * self.num_visible


def near_views(model: Reconstruction, correspondences: Correspondences) -> NearViews:
    """The pairs of a model's images that stand side by side, of those between which matches were looked for."""
    registered = model.is_registered
    tried = np.flatnonzero(registered[correspondences.pair_image_idx].all(axis=1))
    images = correspondences.pair_image_idx[tried].astype(np.int64)
    sizes = np.array([(c.width, c.height) for c in model.cameras], np.float64)
    is_wide = np.array([c.is_wide for c in model.cameras], bool)
    tracks, counts = model.tracks, np.zeros((len(images), 3), np.int64)
    points = _Points(tracks.image_ptr, tracks.image_obs, tracks.obs_track_idx, model.obs_is_inlier, model.point_xyz)
    _count_in_view(images, points, model.views(), model.centers, sizes, is_wide, counts)
    visible = counts[:, :2].min(axis=1)
    shared = np.maximum(counts[:, 2], correspondences.num_inliers[tried])
    enough = visible >= MIN_VISIBLE
    return NearViews(images[enough], visible[enough], shared[enough])


def missing_between(
    union: Reconstruction, first: Bools, second: Bools, correspondences: Correspondences
) -> tuple[int, int, int]:
    """Pairs between two groups (I,) bool of a model's images that should share points and do not, if most do not.

    Returns:
        how many, the points that these should share, and those that they do; zeros if most do share what they should.
    """
    found = near_views(union, correspondences)
    i, j = found.image_idx.T
    between = (first[i] & second[j]) | (second[i] & first[j])
    missing = between & found.is_missing
    if 2 * found.num_visible[missing].sum() <= found.num_visible[between].sum():
        return 0, 0, 0
    return int(missing.sum()), int(found.num_visible[missing].sum()), int(found.num_shared[missing].sum())


def contradiction_of(model: Reconstruction, correspondences: Correspondences) -> list[Contradiction]:
    """What near views say against a model: nothing, or one contradiction."""
    found = near_views(model, correspondences)
    missing = np.flatnonzero(found.is_missing)
    if len(missing) < MIN_PAIRS:
        return []
    order = missing[np.argsort(-found.num_visible[missing], kind="stable")][:NUM_NAMED]
    named = [
        NearPair(
            images=[model.image_names[i] for i in found.image_idx[k]], num_visible=int(found.num_visible[k]),
            num_shared=int(found.num_shared[k]),
        )
        for k in order
    ]  # fmt: skip
    first = named[0]
    return [
        Contradiction(
            "near views",
            f"{len(missing)} pairs of photographs are side by side in the model but do not show the same points: "
            f"{first.images[0]} and {first.images[1]} should share {first.num_visible} and share {first.num_shared}",
            "parts that look alike have put some of them in the wrong place: add photographs between them and the rest "
            "that show more of the surroundings",
            {"num_pairs": len(missing), "num_near_pairs": len(found.num_visible), "pairs": named},
            # an image that is in a wrong place may be anywhere in the model
            rotation_sigma_deg=180.0, position_sigma_share=1.0,
        )
    ]  # fmt: skip


class _Points(NamedTuple):
    """Points (T) and which images see them: ``image_obs[image_ptr[i] : image_ptr[i + 1]]`` are observations (O).

    Attributes:
        image_ptr: (I + 1,). image_obs: (O,). obs_track: (O,) int32. is_inlier: (O,) bool.
        xyz: (T, 3), NaN where not triangulated.
    """

    image_ptr: NDArray[np.int64]
    image_obs: NDArray[np.int64]
    obs_track: NDArray[np.int32]
    is_inlier: NDArray[np.bool_]
    xyz: NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _count_in_view(
    images: NDArray[np.int64], points: _Points, views: Views, centers: NDArray[np.float64],
    sizes: NDArray[np.float64], is_wide: NDArray[np.bool_], counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Fill counts (K, 3): points of the first image in view of the second, of the second in that of the first, both's.

    sizes: (C, 2) pixels. is_wide: (C,) whether the lens sees beyond its half space.
    """
    image_ptr, image_obs, obs_track, is_inlier, xyz = points
    rotation, translation, camera_of, canonical = views
    mark = np.full(xyz.shape[0], -1)
    for p in range(len(images)):
        for side in range(2):
            i, j = images[p, side], images[p, 1 - side]
            c, zoom = camera_of[j], canonical[camera_of[j], 0] / canonical[camera_of[i], 0]
            for q in range(image_ptr[i], image_ptr[i + 1]):
                t = obs_track[image_obs[q]]
                if not is_inlier[image_obs[q]] or not math.isfinite(xyz[t, 0]):
                    continue
                if side == 0:
                    mark[t] = p
                x, y, z = xyz[t, 0], xyz[t, 1], xyz[t, 2]
                a0, a1, a2 = x - centers[i, 0], y - centers[i, 1], z - centers[i, 2]
                b0, b1, b2 = x - centers[j, 0], y - centers[j, 1], z - centers[j, 2]
                a, b = math.sqrt(a0 * a0 + a1 * a1 + a2 * a2), math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
                if not (zoom * a <= MAX_ZOOM * b and b <= MAX_ZOOM * zoom * a):
                    continue
                if a0 * b0 + a1 * b1 + a2 * b2 < _MIN_COS * a * b:
                    continue
                r, s = rotation[j], translation[j]
                depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + s[2]
                # beyond 80 degrees a lens model that is good in the picture may fold back into it
                if not depth > 0.17 * b and not is_wide[c]:
                    continue
                right = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + s[0]
                down = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + s[1]
                u, v = project(canonical[c], right, down, depth)
                if 0 <= u < sizes[c, 0] and 0 <= v < sizes[c, 1]:
                    counts[p, side] += 1
                    if side == 1 and mark[t] == p:
                        counts[p, 2] += 1


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene, true_correspondences

    scene = make_scene(0, 3, 60)
    near_views(scene.observed, true_correspondences(scene, min_matches=1))
