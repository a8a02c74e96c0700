"""Motion-only adjustment: one camera against points that stay where they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.adjust.kernels import (
    CANON,
    LOSS_IDS,
    POINT,
    SCRATCH,
    ImageArrays,
    LensArrays,
    RobustLoss,
    State,
    add_loss,
    fill_rows,
    linearize,
    retract,
    total_loss,
)
from sfmapp.camera.lens import ROW
from sfmapp.geometry.damped import solve_damped
from sfmapp.simd.copying import copy_into
from sfmapp.simd.f64x8 import add2
from sfmapp.simd.pointers import pointer

Array = NDArray[np.float64]

_MAX_ITERATIONS = 30


@dataclass(frozen=True)
class RefinedPose:
    """A pose, perhaps with its focal length, and how well the points hold it.

    Attributes:
        cam_from_world: (7,) quaternion x y z w and translation.
        canonical: (17,) intrinsics; changed in the focal lengths alone, and only if they were free.
        covariance: (6, 6), or (7, 7) with the focal length in pixels last, over rotation (radians) and translation of
            ``x_cam <- exp(w) x_cam + v``, scaled by the inliers' residuals; infinite where the points do not hold it.
        is_inlier: (N,) bool: in front of the camera with a residual below the threshold.
        cost: half the sum of the losses, square pixels.
        num_iterations: steps tried.
    """

    cam_from_world: Array
    canonical: Array
    covariance: Array
    is_inlier: NDArray[np.bool_]
    cost: float
    num_iterations: int


def refine_pose(
    canonical: ArrayLike,
    cam_from_world: ArrayLike,
    xyz: ArrayLike,
    xy: ArrayLike,
    *,
    scale_px: float | None = 1.0,
    inlier_px: float = 4.0,
    focal_sigma_px: float = 0.0,
    relative_cost_tolerance: float = 1e-6,
) -> RefinedPose:
    """Minimise the robust reprojection error of known points over one pose, from a start such as PnP gives.

    Args:
        canonical: (17,) intrinsics, see ``Camera.canonical``.
        cam_from_world: (7,) start.
        xyz: (N, 3) world. xy: (N, 2) pixels.
        scale_px: residual length at which Cauchy's loss begins to bend; None for least squares.
        inlier_px: longest residual of an inlier.
        focal_sigma_px: Gaussian prior of a common change of the focal lengths; 0: they are constant, inf: free.
        relative_cost_tolerance: as in ``AdjustOptions``.
    """
    state = np.array(cam_from_world, np.float64)
    row = np.array(canonical, np.float64)
    points, pixels = np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(xy, np.float64)
    information, residuals2 = np.zeros((8, 8)), np.empty(len(points))
    size, weight = (7, 1.0 / focal_sigma_px**2) if focal_sigma_px > 0.0 else (6, 0.0)
    loss = RobustLoss(LOSS_IDS["cauchy"] if scale_px else LOSS_IDS["trivial"], (scale_px or 1.0) ** 2)
    cost, iterations = _refine(
        row, state, points, pixels, loss, size, weight, relative_cost_tolerance, information, residuals2
    )
    is_inlier = residuals2 <= inlier_px**2
    dof = 2 * int(is_inlier.sum()) - size
    covariance = np.full((size, size), np.inf)
    if dof > 0:
        try:
            inverse = np.linalg.inv(information[:size, :size])
            covariance = 0.5 * (inverse + inverse.T) * residuals2[is_inlier].sum() / dof
        except np.linalg.LinAlgError:
            pass
    return RefinedPose(state, row, covariance, is_inlier, cost, iterations)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(
    canonical: Array, rows: Array, xyz: Array, xy: Array, loss: RobustLoss, size: int, penalty: float, J: Array,
    information: Array, gradient: Array, residuals2: Array,
) -> float:  # fmt: skip
    """Fill information (64,), gradient (8,) and the squared residuals (N,), infinite behind; returns the cost."""
    information[:] = 0.0
    gradient[:] = 0.0
    total, product = 0.0, 1.0
    for n in range(xyz.shape[0]):
        s2 = linearize(
            pointer(rows), np.bool_(False), pointer(rows), pointer(canonical), (xyz[n, 0], xyz[n, 1], xyz[n, 2]),
            (xy[n, 0], xy[n, 1]), loss, -1.0, size > 6, pointer(J),
        )  # fmt: skip
        residuals2[n] = s2
        if s2 < 0.0:
            residuals2[n] = math.inf
            s2 = penalty
        total, product = add_loss(loss, s2, total, product)
        J[7] = J[15] = 0.0
        J[6] = J[CANON] + J[CANON + 2] if size > 6 else 0.0
        J[14] = J[CANON + 1] + J[CANON + 3] if size > 6 else 0.0
        add2(information, 0, J, 0, J, 0, 8)
        add2(gradient, 0, J, POINT + 3, J, 0, 1)
    return total_loss(loss, total, product)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine(
    c: Array, state: Array, xyz: Array, xy: Array, loss: RobustLoss, size: int, prior_weight: float, tolerance: float,
    information: Array, residuals2: Array,
) -> tuple[float, int]:  # fmt: skip
    """Move the state (7,), and the focal lengths of the row c if size is 7; returns cost and number of iterations."""
    J = np.zeros(SCRATCH)
    block, camera_block = np.zeros(1, np.int32), np.full(1, 0 if size > 6 else -1, np.int32)
    none, no_mounts = np.full(1, -1, np.int32), np.zeros((0, 12))
    free_ptr = np.array([0, 2 if size > 6 else 0])
    free_slot, free_column = np.array([0, 1]), np.array([6, 6])
    poses, new_poses = state.reshape(1, 7), np.empty((1, 7))
    rows, new_rows = np.empty((1, 12)), np.empty((1, 12))
    canonical, new_canonical = c.reshape(1, ROW), np.empty((1, ROW))
    images = ImageArrays(rows, none, no_mounts, block, block)
    lenses = LensArrays(canonical, np.zeros(1), camera_block, none, free_ptr, free_slot, free_column)
    new = State(new_rows, new_canonical, xyz)
    step, factor = np.zeros(8), np.empty((8, 8))
    fill_rows(poses, block, none, no_mounts, rows)
    focal = c[0]
    penalty = 8.0 * focal * focal  # gtsam's choice for points behind the camera
    H, g, new_H, new_g = np.zeros(64), np.zeros(8), np.zeros(64), np.zeros(8)
    new_residuals2 = np.empty(xyz.shape[0])
    cost = _normal_equations(canonical, rows, xyz, xy, loss, size, penalty, J, H, g, residuals2)
    H[54] += prior_weight
    damping, growth, iterations = 1e-4, 2.0, 0
    while iterations < _MAX_ITERATIONS and damping < 1e12:
        iterations += 1
        if not solve_damped(H.reshape(8, 8), g[:size], damping, factor, step):
            damping *= growth
            growth *= 2.0
            continue
        retract(poses, block, block, images, lenses, step, new_poses, new)
        new_cost = _normal_equations(
            new_canonical, new_rows, xyz, xy, loss, size, penalty, J, new_H, new_g, new_residuals2
        )  # fmt: skip
        away = new_canonical[0, 0] - focal
        new_cost += 0.5 * prior_weight * away * away
        new_g[6] += prior_weight * away
        new_H[54] += prior_weight
        decrease = cost - new_cost
        if decrease > 0.0:
            predicted = 0.0
            for k in range(size):
                predicted += 0.5 * step[k] * (damping * H[9 * k] * step[k] - g[k])
            copy_into(poses, new_poses)
            copy_into(canonical, new_canonical)
            copy_into(rows, new_rows)
            copy_into(H, new_H)
            copy_into(g, new_g)
            copy_into(residuals2, new_residuals2)
            done = decrease <= tolerance * cost
            cost = new_cost
            gain = decrease / predicted if predicted > 0.0 else 0.0
            damping = max(1e-10, damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3))
            growth = 2.0
            if done:
                break
        else:
            if -decrease <= tolerance * cost:
                break
            damping *= growth
            growth *= 2.0
    for i in range(8):
        for j in range(8):
            information[i, j] = H[8 * i + j]
    return cost, iterations
