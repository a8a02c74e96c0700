"""The relative poses that two views show, and whether they tell them apart.

Over a short way, and before a plane, several motions explain the same two images within their noise (Malis and Vargas
2007; Longuet-Higgins 1984: a plane leaves two). A map that begins with the wrong one is bent for good, and says that it
is sure. So all of them are looked for; views in between may tell them apart, else it waits for parallax.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.geometry import epipolar, homography, rigid3
from sfmapp.geometry.relative_pose import refine_relative_pose

Array = NDArray[np.float64]

# Directions of the way from which a search begins, over half a sphere: some 30 degrees apart, as valleys are wide.
_NUM_STARTS = 20
# Poses whose ways differ by less are one: an adjustment brings a map that began so far off to its right shape. A rival
# explains the views if its cost is no more than so many times the least: errors of patches hang together, so that
# chance makes much of that.
_SAME_DEG, RIVAL_SHARE = 12.0, 1.5
# Patches are located to that at best, pixels: what is left below it tells nothing apart.
_FINEST_PX = 0.05
# How well the way must be known (one standard deviation), and what correlated errors do to a formal one.
_MAX_SIGMA_DEG, _INFLATION = 5.0, 2.0
_STEP = 1e-6


def explaining_poses(
    camera: Camera, xy1: Array, xy2: Array, given: Array, limit_px: float
) -> tuple[list[Array], Array]:
    """Poses cam2_from_cam1 (7,) with unit translation that explain matches nearly as well as the best, which is first.

    Args:
        camera: of both views.
        xy1, xy2: (N, 2) matched pixels.
        given: (7,) a pose to try among others.
        limit_px: residuals beyond it count like that.

    Returns:
        The poses (K), whose ways differ, and (K,) the sums of their squared residuals, pixels squared.
    """
    xn1, xn2 = pixels_to_normalized(camera, xy1), pixels_to_normalized(camera, xy2)
    turned = homography.rotation_from_rays(xn1, xn2, np.ones(len(xn1)))
    starts = [given, *(rigid3.from_matrix(turned, way) for way in _half_sphere(_NUM_STARTS))]
    found, costs = [], []
    for start in starts:
        pose = refine_relative_pose(start, xn1, xn2, 0.5 * limit_px / camera.focal)
        other = np.concatenate([pose[:4], -pose[4:]])
        pose, in_front, _ = epipolar.choose_in_front(np.stack([pose, other]), xn1, xn2)
        squared = camera.focal**2 * epipolar.sampson_errors(epipolar.essential_from_pose(pose), xn1, xn2)
        found.append(pose)
        costs.append(float(np.where(in_front, np.minimum(squared, limit_px**2), limit_px**2).sum()))
    kept: list[int] = []
    ways = rigid3.center(np.array(found))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    for k in np.argsort(costs, kind="stable"):
        is_new = all(ways[k] @ ways[other] < np.cos(np.radians(_SAME_DEG)) for other in kept)
        if is_new and not (kept and tells_apart(costs[kept[0]], costs[k], len(xn1))):
            kept.append(int(k))
    return [found[k] for k in kept], np.array(costs)[kept]


def tells_apart(least: float, other: float, num: int, share: float = RIVAL_SHARE) -> bool:
    """Whether a sum of squared residuals (pixels squared, of num matches) is more than so many times the least."""
    return other > share * (least + num * _FINEST_PX**2)


def is_way_known(camera: Camera, pose: Array, xy1: Array, xy2: Array, cost: float) -> bool:
    """Whether the matches (N, 2) determine the direction of the way; ``cost``: their squared residuals, pixels."""
    xn1, xn2 = pixels_to_normalized(camera, xy1), pixels_to_normalized(camera, xy2)
    squared = max(cost, len(xn1) * _FINEST_PX**2) / camera.focal**2
    return _sigma_of_way_deg(pose, xn1, xn2, squared) < _MAX_SIGMA_DEG


def _half_sphere(count: int) -> Array:
    """(count, 3) unit vectors evenly over half a sphere, along a spiral."""
    z = (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _sigma_of_way_deg(pose: Array, xn1: Array, xn2: Array, cost: float) -> float:
    """Standard deviation of the direction of the way in degrees, from the residuals and how they change with it."""
    rotation, way = rigid3.rotation_matrix(pose), pose[4:] / np.linalg.norm(pose[4:])
    across = np.linalg.svd(way[None])[2][1:]
    at = _signed(rotation, way, xn1, xn2)
    columns = [_signed(rigid3.exp_so3(_STEP * axis) @ rotation, way, xn1, xn2) - at for axis in np.eye(3)]
    columns += [_signed(rotation, way + _STEP * side, xn1, xn2) - at for side in across]
    jacobian = np.column_stack(columns) / _STEP
    information = jacobian.T @ jacobian
    if np.linalg.cond(information) > 1e14:
        return float("inf")
    variance = cost / max(len(xn1) - 5, 1) * np.trace(np.linalg.inv(information)[3:, 3:]) / 2
    return float(np.degrees(_INFLATION * np.sqrt(variance)))


def _signed(rotation: Array, way: Array, xn1: Array, xn2: Array) -> Array:
    """(N,) Sampson distances with their sign (Hartley and Zisserman 2004, 11.9)."""
    e = rigid3.skew(way) @ rotation
    line2, line1 = xn1 @ e[:2, :2].T + e[:2, 2], xn2 @ e[:2, :2] + e[2, :2]
    value = (xn2 * line2).sum(1) + xn1 @ e[2, :2] + e[2, 2]
    return np.asarray(value / np.sqrt((line2**2).sum(1) + (line1**2).sum(1)), np.float64)
