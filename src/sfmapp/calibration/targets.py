"""A camera from several photographs of points with known places, jointly.

Each photograph is calibrated by itself first, which names its wrong points; the surest of these cameras is where the
joint fit begins. Photographs that tell no camera by themselves (few points, a plane seen frontally) are located with it
and count all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import Fit, TargetView, normal_at, observations_of, residuals_of
from sfmapp.calibration.locate import locate_camera
from sfmapp.calibration.one_view_kernels import POSE
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.calibration.solve import inlier_fit
from sfmapp.calibration.target import TargetFit, calibrate_target
from sfmapp.calibration.uncertainty import frame_covariance
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# A point that agrees with a pose by a camera of one other photograph: what that leaves open moves the borders by some
# pixels. The joint fit judges anew.
_MAX_ERROR_PX = 20.0


def calibrate_targets(
    views: Sequence[TargetView], size: tuple[int, int], *, camera_model: CameraModel | None = None
) -> CameraCalibration:
    """The camera that took several photographs, each of points with known places.

    Args:
        views: name, places (N, 3) in a frame and unit that may differ from photograph to photograph, and the pixels
            (N, 2) that show them; some may be wrong.
        size: width and height of all photographs.
        camera_model: None: the one of the photograph that tells most; see
            :func:`sfmapp.calibration.target.calibrate_target`.

    Returns:
        The camera with its covariance, and every photograph with its pose, residuals, and which points are used.

    Raises:
        InputError: no photographs, points that are none, or photographs that leave a parameter open.
        NoReconstructionError: none of the photographs tells a camera by itself; why the first does not.
    """
    if not views:
        raise InputError("expected photographs of points with known places, found none")
    alone = [_alone(view, size, camera_model) for view in views]
    told = [one for one in alone if isinstance(one, TargetFit)]
    if not told:
        raise next(one for one in alone if isinstance(one, Exception))
    best = min(told, key=lambda one: one.focal_sigma_px / one.view.camera.focal)
    shown, lost = list[tuple[TargetView, Array]](), list[ViewFit]()
    for view, one in zip(views, alone, strict=True):
        found = _placed(view, one, best.view.camera)
        if isinstance(found, str):
            lost.append(
                ViewFit(view.name, None, view.xy, np.full_like(view.xy, np.nan), np.zeros(len(view.xy), bool), found)
            )
        else:
            shown.append((view, found))
    return _together([view for view, _ in shown], np.array([pose for _, pose in shown]), best.view.camera, lost)


def _alone(
    view: TargetView, size: tuple[int, int], camera_model: CameraModel | None
) -> TargetFit | InputError | NoReconstructionError:
    """The camera of one photograph, or why it tells none."""
    try:
        return calibrate_target(view.xyz, view.xy, size, camera_model=camera_model)
    except (InputError, NoReconstructionError) as error:
        return error


def _placed(view: TargetView, alone: TargetFit | Exception, camera: Camera) -> Array | str:
    """The pose (7,) of a photograph by a camera, or why there is none."""
    try:
        found = locate_camera(view.xyz, view.xy, camera, max_error_px=_MAX_ERROR_PX)
    except (InputError, NoReconstructionError) as error:
        return alone.view.cam_from_world if isinstance(alone, TargetFit) else str(error)
    return found.view.cam_from_world


def _together(views: Sequence[TargetView], poses: Array, camera: Camera, lost: Sequence[ViewFit]) -> CameraCalibration:
    """The joint fit, its covariance, and what it leaves."""
    fit, is_used = inlier_fit(Fit(camera, poses, np.zeros(0), np.inf), views)
    obs = observations_of(views)
    num, residual = len(fit.camera.params), residuals_of(fit, obs)
    degrees = 2 * int(is_used.sum()) - num - POSE * len(views)
    variance = float((residual[is_used] ** 2).sum()) / max(degrees, 1)
    normal = normal_at(fit, obs._replace(weight=is_used.astype(np.float64)))
    # of a Student distribution, which with few degrees of freedom is wider
    whole = frame_covariance(normal, num, variance * degrees / (degrees - 2.0)) if degrees > 2 else None
    if whole is None:
        raise InputError(
            f"expected photographs that hold all {num} parameters of {fit.camera.model.name}, found {len(views)} that "
            "leave some open",
            "use more points or photographs, or a camera model with fewer parameters",
        )
    shown, distances = [], []
    for v, view in enumerate(views):
        own = slice(obs.ptr[v], obs.ptr[v + 1])
        shown.append(ViewFit(view.name, fit.cam_from_target[v], view.xy, residual[own], is_used[own]))
        distances.append(np.linalg.norm(rigid3.apply(fit.cam_from_target[v], view.xyz), axis=1))
    near, middle, far = np.quantile(np.concatenate(distances), [0.0, 0.5, 1.0])
    num_bad = int((~is_used).sum())
    warnings = [f"{num_bad} of {len(is_used)} points were left aside: they agree with no camera"] if num_bad else []
    warnings += [f"{view.name} is left aside: {view.problem}" for view in lost]
    return CameraCalibration(
        camera=replace(fit.camera, focal_source="user"), covariance=whole[:num, :num],
        method=f"known points of {len(views)} photographs, {int(is_used.sum())} points, jointly",
        noise_px=float(np.sqrt(variance)), degrees_of_freedom=degrees, views=(*shown, *lost), frame_covariance=whole,
        distances=(float(near), float(middle), float(far)), warnings=tuple(warnings),
    )  # fmt: skip
