"""How sure a calibration is: the covariance of its parameters, and of where it puts a point in the picture.

The covariance of the parameters alone says too much: a principal point that is off is made up for by boards that are
all turned, and does no harm. So the frame of the camera is an unknown too. Its error is the one motion that fits those
of all boards best, each weighted by its normal equations, and a projection moves by the errors of parameters and frame
together. mrcal's documentation calls this the uncertainty of projection.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.kernels import Normal
from sfmapp.calibration.result import CameraCalibration
from sfmapp.camera.camera import Camera, pixels_to_rays, project_jacobian
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

_GRID = (21, 15)


def frame_covariance(normal: Normal, num_params: int, variance: float) -> Array | None:
    """(P + 6, P + 6) covariance of the parameters and of the frame of the camera; None where the views do not hold
    them.

    With g the right sides of the normal equations, W the sum of the views' own blocks and B that of their cross blocks,
    the common motion is W^-1 (sum g_v - B^T dk). The sum is independent of dk, whose covariance is that of the reduced
    system.

    Args:
        normal: at the fit, unweighted but for what was left aside.
        variance: of one measured coordinate, pixels squared.
    """
    is_seen = normal.own[:, 0, 0] > 0
    own, cross = normal.own[is_seen], normal.cross[is_seen]
    try:
        reduced = normal.shared - np.einsum("vsi,vij,vtj->st", cross, np.linalg.inv(own), cross)
        scale = 1.0 / np.sqrt(np.diag(normal.shared))
        inverse = np.linalg.inv(reduced * scale[:, None] * scale[None, :]) * scale[:, None] * scale[None, :]
        weight = np.linalg.inv(own.sum(0))
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(inverse).all() or not (np.diag(inverse) > 0).all():
        return None
    params = variance * inverse[:num_params, :num_params]
    coupling = cross.sum(0)[:num_params] @ weight
    beside = -params @ coupling
    frame = variance * weight + coupling.T @ params @ coupling
    found = np.block([[params, beside], [beside.T, frame]])
    symmetric: Array = 0.5 * (found + found.T)
    return symmetric


def projection_covariance(calibration: CameraCalibration, xy: Array, distance: float | None = None) -> Array:
    """(N, 2, 2) covariance in pixels squared of where the camera puts points that are seen at pixels (N, 2); NaN where
    the lens has no ray.

    Args:
        distance: of the points, in the unit of the targets; None for infinity.
    """
    camera = calibration.camera
    rays = pixels_to_rays(camera, xy)
    by_param, by_frame = _derivatives(camera, rays, distance)
    if calibration.frame_covariance is None:
        # the frame is that in which the picture fits itself best
        turn, covariance = best_turn(camera, by_param, by_frame[:, :, :3]), calibration.covariance
        jacobian = by_param - by_frame[:, :, :3] @ turn
    else:
        covariance = calibration.frame_covariance
        jacobian = np.concatenate([by_param, by_frame], 2)
    found: Array = np.einsum("nia,ab,njb->nij", jacobian, covariance, jacobian)
    return found


def projection_sigma(calibration: CameraCalibration, xy: Array, distance: float | None = None) -> Array:
    """(N,) standard deviation of a coordinate, the root of the mean of both variances; see
    :func:`projection_covariance`."""
    covariance = projection_covariance(calibration, xy, distance)
    sigma: Array = np.sqrt(0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]))
    return sigma


def image_grid(camera: Camera, shape: tuple[int, int] = _GRID) -> Array:
    """(N, 2) pixels, the middles of so many columns and rows of equal cells, row by row."""
    u = (np.arange(shape[0]) + 0.5) * camera.width / shape[0]
    v = (np.arange(shape[1]) + 0.5) * camera.height / shape[1]
    return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)


def best_turn(camera: Camera, by_param: Array, by_turn: Array) -> Array:
    """(3, P) the turn of the camera that makes up best for a change of each parameter, over the pixels (N)."""
    is_known = np.isfinite(by_param).all((1, 2)) & np.isfinite(by_turn).all((1, 2))
    a, b = by_turn[is_known].reshape(-1, 3), by_param[is_known].reshape(-1, by_param.shape[2])
    found: Array = np.asarray(np.linalg.lstsq(a, b, rcond=None)[0], np.float64)
    return found


def _derivatives(camera: Camera, rays: Array, distance: float | None) -> tuple[Array, Array]:
    """Of pixels by the parameters (N, 2, P), and by a turn and a shift of the points (N, 2, 6)."""
    points = rays * (1.0 if distance is None else distance)
    _, by_point, by_param = project_jacobian(camera, points)
    shift = by_point if distance is not None else np.zeros_like(by_point)
    by_frame = np.concatenate([-by_point @ rigid3.skew(points), shift], 2)
    return by_param, by_frame
