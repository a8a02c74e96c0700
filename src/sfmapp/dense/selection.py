"""Which images to match with which: by the points that they share, else by how their cameras stand."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.report import NeighborsReport
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# a pair with fewer common points is judged by its cameras
MIN_SHARED = 10
# under less than this the depth is as good as unknown; over more the images have little in common
MIN_ANGLE_DEG, MAX_ANGLE_DEG = 1.0, 60.0
# full weight between these (Goesele et al., ICCV 2007); beyond the wider one it falls by this deviation
GOOD_ANGLES_DEG, WIDE_SIGMA_DEG = (8.0, 20.0), 12.0
# cameras without points: between views as seen from what they look at, and between their axes
MIN_GEOMETRIC_DEG, BEST_GEOMETRIC_DEG, MAX_AXES_DEG = 1.5, 10.0, 70.0


@dataclass(frozen=True)
class CommonPoints:
    """What points say of pairs of views, (V, V) each.

    Attributes:
        score: sum of the weights of common points. angle_deg: their mean angle. shared: how many there are.
    """

    score: Array
    angle_deg: Array
    shared: Array


def weigh_common_points(
    focal: Array,
    cam_from_world: Array,
    point_xyz: Array,
    point_ptr: NDArray[np.int64],
    point_view_idx: NDArray[np.int32],
    good_deg: tuple[float, float] = GOOD_ANGLES_DEG,
) -> CommonPoints:
    """How well pairs of views suit the measuring of what both show.

    A common point counts the more the nearer its triangulation angle is to the good ones (Goesele et al., ICCV 2007)
    and the more alike its scales in the two images are.

    Args:
        focal: (V,) pixels.
        cam_from_world: (V, 7).
        point_xyz: (P, 3) sparse points, world.
        point_ptr, point_view_idx: (P + 1,) and (O,), the views that see each point; see :class:`DenseScene`.
        good_deg: between these angles a point has its full weight.
    """
    num_views = len(cam_from_world)
    sums = np.zeros((3, num_views, num_views))
    axis = np.ascontiguousarray(rigid3.rotation_matrix(cam_from_world)[:, 2])
    center = rigid3.center(cam_from_world)
    _score_points(point_xyz, point_ptr, point_view_idx, center, axis, focal, good_deg, sums)
    score, angle, shared = sums
    return CommonPoints(score, angle / np.maximum(shared, 1.0), shared)


def select_neighbors(
    focal: Array,
    cam_from_world: Array,
    point_xyz: Array,
    point_ptr: NDArray[np.int64],
    point_view_idx: NDArray[np.int32],
    max_neighbors: int,
) -> tuple[NDArray[np.int32], NeighborsReport]:
    """Choose the neighbours of every view.

    Those with which common points have most weight, as :func:`weigh_common_points` has it. A view that shares too few
    points with others gets the rest from the places and directions of the cameras. Views without a baseline between
    them are never neighbours.

    Args:
        focal: (V,) pixels, at working resolution.
        cam_from_world: (V, 7).
        point_xyz: (P, 3) sparse points, world.
        point_ptr, point_view_idx: (P + 1,) and (O,), the views that see each point; see :class:`DenseScene`.
        max_neighbors: K.

    Returns:
        (V, K) int32 positions of views, best first, -1 behind the last; and the report.
    """
    num_views = len(cam_from_world)
    common = weigh_common_points(focal, cam_from_world, point_xyz, point_ptr, point_view_idx)
    score, angle, shared = common.score, common.angle_deg, common.shared
    rotation, center = rigid3.rotation_matrix(cam_from_world), rigid3.center(cam_from_world)
    by_points = (shared >= MIN_SHARED) & (angle >= MIN_ANGLE_DEG) & (angle <= MAX_ANGLE_DEG) & (score > 0.0)
    cost, geometric_angle = _camera_costs(center, rotation[:, 2], _targets(center, rotation[:, 2], point_xyz,
                                                                           point_ptr, point_view_idx))  # fmt: skip
    # what points say of a pair holds: too few of them in common is no reason to match, unless they are few everywhere
    cost[shared >= MIN_SHARED] = np.inf
    neighbors = np.full((num_views, max_neighbors), -1, np.int32)
    angles: list[float] = []
    counts = [0, 0]
    for m in range(num_views):
        first = np.flatnonzero(by_points[m])
        first = first[np.argsort(-score[m, first], kind="stable")][:max_neighbors]
        rest = np.zeros(0, np.int64)
        if len(first) < min(2, max_neighbors):
            rest = np.setdiff1d(np.flatnonzero(np.isfinite(cost[m])), first)
            rest = rest[np.argsort(cost[m, rest], kind="stable")][: max_neighbors - len(first)]
        row = np.concatenate([first, rest])
        neighbors[m, : len(row)] = row
        counts[0] += len(first)
        counts[1] += len(rest)
        angles += [*angle[m, first], *geometric_angle[m, rest]]
    return neighbors, NeighborsReport(
        num_without=int((neighbors[:, 0] < 0).sum()),
        num_by_points=counts[0],
        num_by_cameras=counts[1],
        median_angle_deg=float(np.median(angles)) if angles else None,
    )


@numba.njit(cache=True, nogil=True)
def _score_points(
    point_xyz: NDArray[np.float64], point_ptr: NDArray[np.int64], point_view_idx: NDArray[np.int32],
    center: NDArray[np.float64], axis: NDArray[np.float64], focal: NDArray[np.float64], good_deg: tuple[float, float],
    sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Add to (3, V, V) sums over common points: weights, angles in degrees, counts."""
    good, wide = good_deg
    for p in range(point_xyz.shape[0]):
        for a in range(point_ptr[p], point_ptr[p + 1]):
            i = point_view_idx[a]
            di = point_xyz[p] - center[i]
            ni = np.sqrt((di * di).sum())
            footprint_i = (di * axis[i]).sum() / focal[i]
            for b in range(a + 1, point_ptr[p + 1]):
                j = point_view_idx[b]
                dj = point_xyz[p] - center[j]
                nj = np.sqrt((dj * dj).sum())
                footprint_j = (dj * axis[j]).sum() / focal[j]
                if i == j or ni == 0.0 or nj == 0.0 or footprint_i <= 0.0 or footprint_j <= 0.0:
                    continue
                degrees = np.degrees(np.arccos(min(1.0, max(-1.0, (di * dj).sum() / (ni * nj)))))
                weight = min(1.0, degrees / good) ** 2
                if degrees > wide:
                    weight = np.exp(-0.5 * ((degrees - wide) / WIDE_SIGMA_DEG) ** 2)
                weight *= min(footprint_i / footprint_j, footprint_j / footprint_i)
                for x, y in ((i, j), (j, i)):
                    sums[0, x, y] += weight
                    sums[1, x, y] += degrees
                    sums[2, x, y] += 1.0


def _targets(
    center: Array, axis: Array, point_xyz: Array, point_ptr: NDArray[np.int64], point_view_idx: NDArray[np.int32]
) -> Array:
    """(V, 3) what each view looks at: the middle of its points; without any, where all axes meet."""
    targets = np.tile(meeting_point(center, axis), (len(center), 1))
    point_idx = np.repeat(np.arange(len(point_xyz)), np.diff(point_ptr))
    for m in range(len(center)):
        mine = point_idx[point_view_idx == m]
        if len(mine) >= MIN_SHARED:
            targets[m] = np.median(point_xyz[mine], axis=0)
    return targets


def meeting_point(center: Array, axis: Array) -> Array:
    """(3,) the place nearest to all optical axes, in the sense of least squares.

    Args:
        center, axis: (V, 3) camera centres and unit viewing directions, world.

    Where the axes are parallel or meet behind the cameras: straight ahead, where neighbouring cameras are seen about
    ten degrees apart.
    """
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) < 1e6:
        place = np.linalg.solve(normal, np.einsum("vij,vj->i", across, center))
        if np.mean(((place - center) * axis).sum(axis=1) > 0.0) > 0.5:
            return np.asarray(place)
    distance = np.linalg.norm(center[:, None] - center, axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.min(axis=1)
    step = float(np.median(nearest[np.isfinite(nearest)])) if len(center) > 1 else 1.0
    forward = axis.mean(axis=0)
    length = float(np.linalg.norm(forward))
    return np.asarray(center.mean(axis=0) + forward / (length or 1.0) * step / np.radians(BEST_GEOMETRIC_DEG))


def _camera_costs(center: Array, axis: Array, target: Array) -> tuple[Array, Array]:
    """(V, V) how ill a second view suits a first one, infinite where it does not at all, and the angle in degrees."""
    rays = center - target[:, None]
    length = np.linalg.norm(rays, axis=2)
    own = np.einsum("vvi->vi", rays) / np.maximum(np.diagonal(length), 1e-300)[:, None]
    cosine = np.einsum("vsi,vi->vs", rays, own) / np.maximum(length, 1e-300)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    between_axes = np.degrees(np.arccos(np.clip(axis @ axis.T, -1.0, 1.0)))
    cost = np.where(angle < BEST_GEOMETRIC_DEG, 1.5 * (BEST_GEOMETRIC_DEG - angle), angle - BEST_GEOMETRIC_DEG)
    cost[(angle < MIN_GEOMETRIC_DEG) | (angle > MAX_ANGLE_DEG) | (between_axes > MAX_AXES_DEG)] = np.inf
    return cost, angle
