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
from sfmapp.calibration.locate import Location, locate_camera, with_camera
from sfmapp.calibration.one_view import Noise, deletion_statistics, fit_view, with_noise
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
    views: Sequence[TargetView], size: tuple[int, int], *, camera_model: CameraModel | None = None,
    sigma_px: float | None = None,
) -> CameraCalibration:  # fmt: skip
    """The camera that took several photographs, each of points with known places.

    Args:
        views: name, places (N, 3) in a frame and unit that may differ from photograph to photograph, and the pixels
            (N, 2) that show them; some may be wrong.
        size: width and height of all photographs.
        camera_model: None: the one of the photograph that tells most; see
            :func:`sfmapp.calibration.target.calibrate_target`.
        sigma_px: standard deviation of a marked coordinate, if known; None: from the residuals.

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
    poses = np.array([pose for _, pose in shown])
    return _together([view for view, _ in shown], poses, best.view.camera, lost, sigma_px)


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


def located_views(made: CameraCalibration, views: Sequence[TargetView]) -> list[Location | None]:
    """Where the camera of a joint fit stood in each of its photographs, with the covariance that this has with the
    camera; None for a photograph that was left aside. Arguments as of :func:`calibrate_targets`, and what it returned.
    """
    fits = {view.name: view for view in made.views}
    noise = Noise(made.noise_px, made.noise_px**2, f"residuals of all, {made.degrees_of_freedom} degrees of freedom")
    found: list[Location | None] = []
    for view in views:
        fit = fits[view.name]
        own = None
        if fit.cam_from_target is not None:
            one = fit_view(
                made.camera, fit.cam_from_target, (view.xyz, view.xy), fit.is_used, noise_px=made.noise_px
            )  # fmt: skip
            own = with_noise(one, noise)
        if own is None:
            found.append(None)
            continue
        found.append(Location(
            view=one, covariance=with_camera(one, own, made.covariance, view.xyz), noise=noise,
            distance=deletion_statistics(one, made.noise_px)[1], others=(), method=made.method,
        ))  # fmt: skip
    return found


def _together(
    views: Sequence[TargetView], poses: Array, camera: Camera, lost: Sequence[ViewFit], sigma_px: float | None
) -> CameraCalibration:
    """The joint fit, its covariance, and what it leaves."""
    fit, is_used = inlier_fit(Fit(camera, poses, np.zeros(0), np.inf), views)
    obs = observations_of(views)
    num, residual = len(fit.camera.params), residuals_of(fit, obs)
    degrees = 2 * int(is_used.sum()) - num - POSE * len(views)
    variance = float((residual[is_used] ** 2).sum()) / max(degrees, 1)
    normal = normal_at(fit, obs._replace(weight=is_used.astype(np.float64)))
    # of a Student distribution, which with few degrees of freedom is wider
    spread = variance * degrees / max(degrees - 2.0, 0.5) if sigma_px is None else sigma_px**2
    whole = frame_covariance(normal, num, spread) if degrees > 2 or sigma_px is not None else None
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
        noise_px=float(np.sqrt(variance)) if sigma_px is None else sigma_px, degrees_of_freedom=degrees,
        views=(*shown, *lost), frame_covariance=whole,
        distances=(float(near), float(middle), float(far)), warnings=tuple(warnings),
    )  # fmt: skip
