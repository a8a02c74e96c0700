"""How far photographs look: depth maps, of the patches that they see or swept, for :mod:`sfmapp.carve.joined`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.views import View
from sfmapp.dense.maps import splat_view
from sfmapp.dense.scene import Patches
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# patches of a view by which it is told how far apart they lie in its picture
_SAMPLED = 4000
# a surface that is seen at less than this cosine is taken to face the camera: its slope in a map is noise
_LEAST_COSINE = 0.2
# a patch is drawn so far from its centre, a side, in distances to its nearest neighbour: squares that meet, as
# ``sfmapp dense --maps`` draws them, and a pixel at least
_REACH = 0.75


@dataclass(frozen=True)
class Sight:
    """The surface that one photograph sees, through a camera without distortion.

    Attributes:
        k: (4,) ``fx, fy, cx, cy`` in pixels of the map, the centre of the top-left one (0.5, 0.5).
        cam_from_world: (7,).
        depth: (H, W) float32, units of the world, NaN where nothing is known.
        normal: (H, W, 3) float32 in the frame of the camera, towards it.
        pixel: what a pixel measures at the surface, units of the world; the median.
    """

    k: Array
    cam_from_world: Array
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    pixel: float


def sights_of_patches(views: Sequence[View], patches: Patches, names: Sequence[str]) -> list[Sight]:
    """What each photograph sees of the patches that it is trusted with.

    A cloud that does not say who sees its points will not do: what has no texture has no points either, and behind it
    others would be seen that are hidden in truth.

    Args:
        views: calibrated cameras; those of other names than the patches' see nothing, and have no sight here.
        patches: of the same world.
        names: of the photographs that the patches count.

    Raises:
        InputError: no view has a patch, or one that has is a matrix without a camera.
    """
    patch_idx = np.repeat(np.arange(len(patches)), patches.num_views)
    position = {name: m for m, name in enumerate(names)}
    sights = []
    for view in views:
        if view.name not in position:
            continue
        mine = patch_idx[patches.view_idx == position[view.name]]
        if len(mine):
            sights.append(_sight(view, patches.xyz[mine], patches.normal[mine], patches.size[mine]))
    if not sights:
        raise InputError(
            f"expected patches that the {len(views)} photographs see, found none",
            "photographs and patches have to be of the same model, with the same names",
        )
    return sights


def sight_of_map(k: Array, cam_from_world: Array, depth: NDArray[np.float32]) -> Sight:
    """What a photograph sees by its depth map (H, W), NaN where nothing is known; normals by differences of it."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([(x - k[2]) / k[0], (y - k[3]) / k[1], np.ones_like(x)], axis=-1)
    points = ray * depth[..., None]
    across, down = np.full_like(points, np.nan), np.full_like(points, np.nan)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    normal = np.cross(down, across)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = -(normal * ray).sum(axis=-1)
    normal = np.where((cosine > _LEAST_COSINE)[..., None], normal, -ray).astype(np.float32)
    known = np.isfinite(depth)
    pixel = float(np.median(depth[known])) / float(np.sqrt(k[0] * k[1])) if known.any() else np.inf
    return Sight(k, cam_from_world, depth, normal, pixel)


def _sight(view: View, xyz: Array, normal: NDArray[np.float32], size: NDArray[np.float32]) -> Sight:
    """Draw patches (N) into a view at the resolution that they were found at."""
    if view.camera is None or view.cam_from_world is None:
        raise InputError(
            f"{view.name}: patches need a camera with a lens and a pose, found a projection matrix",
            "join patches with views of a model, or carve without them",
        )
    seen = rigid3.apply(view.cam_from_world, xyz)
    is_ahead = seen[:, 2] > 0.0
    focal = float(np.median(seen[is_ahead, 2] / size[is_ahead])) if is_ahead.any() else 1.0
    fx, fy, cx, cy = view.camera.k_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    scale = min(1.0, focal / float(np.sqrt(fx * fy)))
    width, height = max(1, round(view.width * scale)), max(1, round(view.height * scale))
    k = np.array([fx, fy, cx, cy]) * np.tile([width / view.width, height / view.height], 2)
    pixels = seen[is_ahead, :2] / seen[is_ahead, 2:] * k[:2] + k[2:]
    reach = max(1.0, _REACH * _distance_apart(pixels))
    depth, normals = splat_view(k, view.cam_from_world, width, height, xyz, normal, reach)
    pixel = float(np.median(seen[is_ahead, 2])) / float(np.sqrt(k[0] * k[1])) if is_ahead.any() else np.inf
    return Sight(k, view.cam_from_world, depth, normals, pixel)


def _distance_apart(pixels: Array) -> float:
    """Median distance from a pixel (N, 2) to the one nearest to it."""
    from scipy.spatial import cKDTree

    if len(pixels) < 2:
        return 0.0
    asked = pixels[:: max(1, len(pixels) // _SAMPLED)]
    return float(np.median(cKDTree(pixels).query(asked, k=[2])[0]))
