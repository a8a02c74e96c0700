"""A point from two views, in every way that there is: two lines of sight that do not quite meet.

Projection matrices (3, 4) may be in any frame, also a projective one; pixels (N, 2) are theirs. The main path, which
has more views and wrong ones among them, is :mod:`sfmapp.geometry.triangulation`. HZ stands for Hartley and Zisserman,
"Multiple View Geometry", 2004.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import decompose_projection, homogeneous
from sfmapp.geometry.epipolar import ray_depths
from sfmapp.geometry.fit import matched_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Method = Literal["homogeneous", "inhomogeneous", "midpoint", "optimal", "nonlinear"]
METHODS: tuple[Method, ...] = get_args(Method)

_MAX_STEPS = 10


@dataclass(frozen=True)
class PointsInfo:
    """What is known of N triangulated points.

    Attributes:
        is_inlier: (N,) bool, finite and in front of both cameras.
        num_iterations: steps taken; 1 for the linear ways.
        condition: (N,) of the pixels' derivatives by the three coordinates: large where the lines of sight are nearly
            parallel.
        covariance: (N, 3, 3), by first-order propagation of ``noise_px`` in the four coordinates through exact cameras;
            None where no noise was given.
    """

    is_inlier: Mask
    num_iterations: int
    condition: Array
    covariance: Array | None = None


def triangulate_pair(
    p1: Array, p2: Array, xy1: ArrayLike, xy2: ArrayLike, method: Method = "nonlinear", noise_px: float | None = None
) -> tuple[Array, PointsInfo]:
    """Points from their pixels in two views.

    - ``homogeneous``: 4 x 4 by SVD under |X| = 1 (HZ 12.2). Works in any projective frame, and for points at infinity.
    - ``inhomogeneous``: the same equations with the last coordinate held at one, by least squares. It fails for points
      far away, whose last coordinate is near zero.
    - ``midpoint``: of the common perpendicular of both lines of sight; of finite cameras only.
    - ``optimal``: pixels are moved as little as possible until their lines of sight meet (Lindstrom, "Triangulation
      made easy", CVPR 2010), which is the maximum likelihood estimate of Hartley and Sturm, CVIU 1997.
    - ``nonlinear``: the same minimum by Gauss-Newton steps on the reprojection error, from the homogeneous solution.

    Args:
        p1, p2: (3, 4) projection matrices with a positive determinant of the first three columns.
        xy1, xy2: (N, 2) corresponding pixels, N >= 1.
        noise_px: standard deviation of a coordinate, for the covariance.

    Returns:
        (N, 3) float64, not finite where the lines of sight are parallel, and what is known of them.

    Raises:
        ValueError: points that are not finite, an unknown method, or ``midpoint`` of a camera at infinity.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}, expected one of {', '.join(METHODS)}")
    a, b = matched_points(xy1, xy2, 1, "triangulation")
    taken = 1
    if method == "midpoint":
        xyz = _midpoints(p1, p2, a, b)
    elif method == "inhomogeneous":
        xyz = _inhomogeneous(p1, p2, a, b)
    else:
        if method == "optimal":
            a, b = move_to_meet(fundamental_of(p1, p2), a, b)
            taken = 2
        xyz = _homogeneous(p1, p2, a, b)
        if method == "nonlinear":
            xyz, taken = _refined(p1, p2, a, b, xyz)
    jacobian = np.concatenate([_projected(p, xyz)[1] for p in (p1, p2)], 1)
    is_finite = np.isfinite(jacobian).all((1, 2))
    singular = np.linalg.svd(np.where(is_finite[:, None, None], jacobian, 0.0), compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = singular[:, 0] / singular[:, 2]
    covariance = None
    if noise_px is not None:
        normal = jacobian.swapaxes(1, 2) @ jacobian
        is_known = is_finite & (condition < 1e7)
        covariance = np.full((len(xyz), 3, 3), np.inf)
        covariance[is_known] = noise_px**2 * np.linalg.inv(normal[is_known])
    is_there: Mask = np.asarray(np.isfinite(xyz).all(1), np.bool_)
    x1 = homogeneous(np.where(is_there[:, None], xyz, 0.0))
    in_front = is_there & (x1 @ p1[2] > 0) & (x1 @ p2[2] > 0)
    return xyz, PointsInfo(in_front, taken, np.asarray(condition, np.float64), covariance)


def fundamental_of(p1: Array, p2: Array) -> Array:
    """F (3, 3) of unit norm of two projection matrices: ``[e2]x P2 P1^+`` (HZ 9.1)."""
    center = np.linalg.svd(p1)[2][3]
    f = rigid3.skew(p2 @ center) @ p2 @ np.linalg.pinv(p1)
    unit: Array = f / np.linalg.norm(f)
    return unit


def _equations(p1: Array, p2: Array, xy1: Array, xy2: Array) -> Array:
    """(N, 4, 4) of both pixels: ``x p3 - p1`` and ``y p3 - p2``, each row of unit length."""
    of_each = [xy[:, :, None] * p[2] - p[:2] for p, xy in ((p1, xy1), (p2, xy2))]
    rows = np.concatenate(of_each, 1)
    scaled: Array = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    return scaled


def _homogeneous(p1: Array, p2: Array, xy1: Array, xy2: Array) -> Array:
    solution = np.linalg.svd(_equations(p1, p2, xy1, xy2))[2][:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        xyz: Array = solution[:, :3] / solution[:, 3:]
    return xyz


def _inhomogeneous(p1: Array, p2: Array, xy1: Array, xy2: Array) -> Array:
    rows = _equations(p1, p2, xy1, xy2)
    xyz: Array = -(np.linalg.pinv(rows[:, :, :3]) @ rows[:, :, 3:])[:, :, 0]
    return xyz


def _midpoints(p1: Array, p2: Array, xy1: Array, xy2: Array) -> Array:
    (k1, r1, t1), (k2, r2, t2) = decompose_projection(p1), decompose_projection(p2)
    cam1, cam2 = rigid3.from_matrix(r1, t1), rigid3.from_matrix(r2, t2)
    rays1, rays2 = (homogeneous(xy) @ np.linalg.inv(k).T for xy, k in ((xy1, k1), (xy2, k2)))
    depths, _ = ray_depths(rigid3.compose(cam2, rigid3.inverse(cam1)), rays1[:, :2], rays2[:, :2])
    on_first = rigid3.apply(rigid3.inverse(cam1), rays1 * depths[:, :1])
    on_second = rigid3.apply(rigid3.inverse(cam2), rays2 * depths[:, 1:])
    middle: Array = 0.5 * (on_first + on_second)
    return middle


def move_to_meet(fundamental: Array, xy1: Array, xy2: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) of both pictures moved as little as possible until ``x2^T F x1 = 0``.

    Two rounds of Lindstrom, "Triangulation made easy", CVPR 2010 (his listing 3), which end at the optimum to the
    digits of double precision for all but wild residuals.
    """
    inner = fundamental[:2, :2]
    x1, x2 = homogeneous(xy1), homogeneous(xy2)
    normal2, normal1 = x1 @ fundamental[:2].T, x2 @ fundamental[:, :2]
    a = ((normal2 @ inner) * normal1).sum(1)
    b = 0.5 * ((normal1**2).sum(1) + (normal2**2).sum(1))
    c = ((x2 @ fundamental) * x1).sum(1)
    d = np.sqrt(np.maximum(b * b - a * c, 0.0))
    step = c / np.where(b + d == 0.0, 1.0, b + d)
    move1, move2 = step[:, None] * normal1, step[:, None] * normal2
    normal1, normal2 = normal1 - move2 @ inner, normal2 - move1 @ inner.T
    squared = (normal1**2).sum(1) + (normal2**2).sum(1)
    step = step * 2.0 * d / np.where(squared == 0.0, 1.0, squared)
    return xy1 - step[:, None] * normal1, xy2 - step[:, None] * normal2


def _projected(p: Array, xyz: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) and their slopes (N, 2, 3) by the points."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mapped = homogeneous(xyz) @ p.T
        seen = mapped[:, :2] / mapped[:, 2:]
        slopes = (p[:2, :3] - seen[:, :, None] * p[2, :3]) / mapped[:, 2:, None]
    return seen, slopes


def _refined(p1: Array, p2: Array, xy1: Array, xy2: Array, xyz: Array) -> tuple[Array, int]:
    """Gauss-Newton on the reprojection error of each point; a step that makes it worse is not taken."""
    wanted = np.concatenate([xy1, xy2], 1)

    def linearize(points: Array) -> tuple[Array, Array, Array]:
        (seen1, slopes1), (seen2, slopes2) = _projected(p1, points), _projected(p2, points)
        left = wanted - np.concatenate([seen1, seen2], 1)
        return left, np.concatenate([slopes1, slopes2], 1), (left**2).sum(1)

    left, slopes, cost = linearize(xyz)
    taken = 0
    while taken < _MAX_STEPS:
        taken += 1
        is_open = np.isfinite(slopes).all((1, 2)) & np.isfinite(left).all(1)
        if not is_open.any():
            break
        step = np.zeros_like(xyz)
        step[is_open] = (np.linalg.pinv(slopes[is_open]) @ left[is_open, :, None])[:, :, 0]
        moved = np.where(np.isfinite(step), xyz + step, xyz)
        new_left, new_slopes, new_cost = linearize(moved)
        is_better = new_cost < cost
        xyz = np.where(is_better[:, None], moved, xyz)
        left, slopes = (
            np.where(is_better[:, None], new_left, left),
            np.where(is_better[:, None, None], new_slopes, slopes),
        )
        has_gained = is_better & (cost - new_cost > 1e-10 * cost)
        cost = np.where(is_better, new_cost, cost)
        if not has_gained.any():
            break
    return xyz, taken
