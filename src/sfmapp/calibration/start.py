"""Where the refinement of a calibration begins: a camera and poses that are near enough for it.

Zhang's closed form knows no distortion, and a strong one ruins it. So lenses of known focal length, perspective and
equidistant, are tried beside it. Of the few that fit best the distortion is refined; the best of these is where every
other model starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import Fit, TargetView, observations_of, refine, residuals_of
from sfmapp.calibration.zhang import plane_poses
from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.models import plain_params
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]

# focal lengths over the longer side, from a fisheye lens of 220 degrees to a telescope
_FOCALS = np.geomspace(0.22, 6.0, 18)
# of each projection so many are refined
_KEPT = 3
# the lens that is refined of each projection
_PERSPECTIVE = (CameraModel.SIMPLE_PINHOLE, CameraModel.RADIAL)
_EQUIDISTANT = (CameraModel.SIMPLE_FISHEYE, CameraModel.OPENCV_FISHEYE)
# what lenses without a plain member begin with, where their derivatives are not zero
_BEGIN = {"omega": 0.5, "alpha": 0.5}
_NO_POSE_PX = 1e4
# a model with many parameters has valleys; the largest that it contains leads into the right one
_CONTAINS = {
    CameraModel.FULL_OPENCV: CameraModel.OPENCV,
    CameraModel.OPENCV_THIN_PRISM: CameraModel.FULL_OPENCV,
    CameraModel.THIN_PRISM_FISHEYE: CameraModel.OPENCV_FISHEYE,
    CameraModel.RAD_TAN_THIN_PRISM_FISHEYE: CameraModel.OPENCV_FISHEYE,
}


def first_fit(views: Sequence[TargetView], size: tuple[int, int], k_matrix: Array | None) -> Fit:
    """A camera with its distortion, and poses. ``k_matrix``: of Zhang's closed form; None where it has none."""
    obs = observations_of(views)
    found: list[Fit] = []
    for plain, full in (_PERSPECTIVE, _EQUIDISTANT):
        cameras = [simple_camera(plain, *size, float(focal) * max(size)) for focal in _FOCALS]
        if k_matrix is not None and plain == CameraModel.SIMPLE_PINHOLE:
            params = np.array([0.5 * (k_matrix[0, 0] + k_matrix[1, 1]), k_matrix[0, 2], k_matrix[1, 2]])
            if np.isfinite(params).all() and params[0] > 0:
                cameras.append(Camera(plain, *size, params))
        tried = [posed(camera, views) for camera in cameras]
        errors = [_typical_px(residuals_of(fit, obs)) for fit in tried]
        for i in np.argsort(errors)[:_KEPT]:
            start = replace(tried[i], camera=as_model(tried[i].camera, full))
            found.append(refine_robustly(start, views))
    return min(found, key=lambda fit: _typical_px(residuals_of(fit, obs)))


def posed(camera: Camera, views: Sequence[TargetView]) -> Fit:
    """The poses of flat targets in front of a camera that is known; far away where there is none."""
    poses = plane_poses(camera, views)
    for v in np.flatnonzero(~np.isfinite(poses).all(1)).tolist():
        poses[v] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 10.0 * float(np.ptp(views[v].xyz, axis=0).max())]
    return Fit(camera, poses, np.zeros(0), np.inf)


def refine_robustly(start: Fit, views: Sequence[TargetView]) -> Fit:
    """A refinement in which far points count little (Cauchy's weights, whose scale follows from the residuals)."""
    obs, fit = observations_of(views), start
    for _ in range(3):
        fit = refine(fit, obs._replace(weight=cauchy_weights(residuals_of(fit, obs))))
    return fit


def cauchy_weights(residuals: Array) -> Array:
    """(N,) weights of residuals (N, 2): 1 / (1 + (r / 3 s)^2), s by their median; 0 where there is none."""
    squared = (residuals**2).sum(1)
    is_known = np.isfinite(squared)
    if not is_known.any():
        return np.zeros(len(squared))
    # the median of a squared length of two normal numbers is 2 ln 2
    scale = max(float(np.median(squared[is_known])) / (2.0 * np.log(2.0)), 1e-20)
    weights: Array = np.where(is_known, 1.0 / (1.0 + np.where(is_known, squared, 0.0) / (9.0 * scale)), 0.0)
    return weights


def as_model(camera: Camera, model: CameraModel) -> Camera:
    """A camera of another model: the same where the models are of one kind and it has the parameters, otherwise near in
    the middle of the picture, without distortion."""
    params = plain_params(model, camera.width, camera.height, camera.focal)
    values = {"cx": camera.canonical[2], "cy": camera.canonical[3]} | _BEGIN
    if _projection(camera.model) == _projection(model) != "":
        own = _names(camera.model)
        values |= {name: value for name, value in zip(own, camera.params, strict=True) if name != "f"}
        values |= dict(zip(("fx", "fy"), camera.canonical[:2], strict=True))
    params = np.array([values.get(name, old) for name, old in zip(_names(model), params, strict=True)])
    return Camera(model, camera.width, camera.height, params)


def _projection(model: CameraModel) -> str:
    """What models share whose parameters of the same name do the same."""
    if model.family in ("BROWN", "RATIONAL", "SKEW"):
        return "perspective"
    is_polynomial = model.family in ("RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
    return "equidistant" if is_polynomial else ""


def _names(model: CameraModel) -> tuple[str, ...]:
    """Parameters under the names that the other models of their kind have for them."""
    if model.family != "RAD_TAN_THIN_PRISM_FISHEYE":
        return model.params
    return tuple(f"k{int(name[1]) + 1}" if name[0] == "k" else name for name in model.params)


def to_model(fit: Fit, model: CameraModel, views: Sequence[TargetView]) -> Fit:
    """The fit of another model, begun from the poses of a fit: step by step through the models that it contains, or its
    parameters alone first and then all together."""
    if fit.camera.model == model:
        return fit
    if _projection(fit.camera.model) == _projection(model) != "":
        before = _CONTAINS.get(model)
        if before is not None and len(before.params) > len(fit.camera.params):
            fit = to_model(fit, before, views)
        return refine_robustly(replace(fit, camera=as_model(fit.camera, model)), views)
    obs = observations_of(views)
    start = replace(fit, camera=as_model(fit.camera, model))
    for _ in range(2):
        weights = cauchy_weights(residuals_of(start, obs))
        start = refine(start, obs._replace(weight=weights), hold_poses=True)
    return refine_robustly(start, views)


def _typical_px(residuals: Array) -> float:
    length = np.hypot(residuals[:, 0], residuals[:, 1])
    return float(np.median(np.where(np.isfinite(length), np.minimum(length, _NO_POSE_PX), _NO_POSE_PX)))
