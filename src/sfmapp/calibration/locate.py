"""Where a camera stood, from points with known places in its photograph, and how sure that is.

Three points allow up to four poses, a plane often two. Where some of the points may be wrong, poses of samples of three
(P3P) are tried, otherwise all points are taken at once; every pose that explains them nearly as well as the best is
returned beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.one_view import (
    MIN_DEGREES,
    Noise,
    OneView,
    Refit,
    deletion_statistics,
    fit_view,
    inverse,
    misfit_under,
    noise_of,
    with_noise,
    without_wrong_points,
)
from sfmapp.calibration.one_view_kernels import POSE
from sfmapp.camera.camera import Camera, pixels_to_rays, project_jacobian
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.geometry import p3p, pnp, resection, rigid3

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Method = Literal["auto", "p3p", "all"]

MIN_POINTS = 4
"""Three allow up to four poses; the fourth tells which."""
MAX_ERROR_PX = 8.0
"""Largest distance of a point that agrees with a pose of three others, which the noise of those has moved."""

# Chance that a second pose is given up although it is the true one.
_GIVEN_UP = 1e-3
# twice the logarithm of the likelihood ratio, beyond which that happens: chi-square of the six numbers of a pose
_RATIO = 22.457744484825323
# So many of the best poses are tried without the points that contradict them.
_CLEANED = 3
# Times the squares that are told: what a pose of the least error in space may have before it is fitted to pixels.
_HOPELESS = 100.0
# Poses that differ by less are one: a millionth of a turn.
_SAME_DEG = 1e-3


@dataclass(frozen=True)
class OtherPose:
    """A second pose that the points allow.

    Attributes:
        cam_from_world: (7,). rms_px: of the points that agree with the first.
        turn_deg: from the first. shift: of the camera's centre from that of the first, in the unit of the points.
    """

    cam_from_world: Array
    rms_px: float
    turn_deg: float
    shift: float


@dataclass(frozen=True)
class Location:
    """The pose of a camera.

    Attributes:
        view: the fit to N points; its camera is as it was given.
        covariance: (P + 6, P + 6) of the camera's parameters and the pose, of ``x_cam <- exp(w) x_cam + v``: noise of
            the marks and, where the camera has a covariance, its own, which moves the pose along.
        noise: of a mark.
        distance: (N,) pixels of each point from where the others put it; NaN where nothing tells.
        others: poses that explain the points nearly as well: if there is one, the points do not tell which is true.
        method: how the pose was searched.
    """

    view: OneView
    covariance: Array
    noise: Noise
    distance: Array
    others: tuple[OtherPose, ...]
    method: str


def locate_camera(
    xyz: Array, xy: Array, camera: Camera, *, method: Method = "auto", max_error_px: float = MAX_ERROR_PX,
    sigma_px: float | None = None, camera_covariance: Array | None = None,
) -> Location:  # fmt: skip
    """The pose of a calibrated camera from N >= 4 points.

    Args:
        xyz: (N, 3) places in any unit. xy: (N, 2) the pixels that show them; some may be wrong.
        camera: with its lens, which may see beyond a right angle from its axis.
        method: ``p3p`` draws samples of three points, ``all`` takes all at once and searches every rotation; ``auto``
            is the first where the points are many enough for one of them to be wrong, else the second.
        max_error_px: farthest point that agrees with a pose while it is searched; afterwards the noise decides.
        sigma_px: standard deviation of a marked coordinate, if known; None: from the residuals.
        camera_covariance: (P, P) of the camera's parameters; None: they are taken as exact.

    Raises:
        InputError: too few points, on a line, or not finite.
        NoReconstructionError: no pose that four of them agree with, or one that they leave open.
    """
    points = _checked(xyz, xy)
    found = resection.estimate_pose(
        points[0], pixels_to_rays(camera, points[1]), max_error_px / camera.focal,
        method="all" if method == "all" or (method == "auto" and len(points[1]) <= MIN_POINTS) else "p3p",
    )  # fmt: skip
    if found is None:
        raise NoReconstructionError(
            f"no pose agrees with four of {len(points[1])} points to {max_error_px:g} px",
            "check that places and pixels belong together line by line, that u counts to the right and v down, the "
            "camera, and its lens; --max-error-px allows for coarser marks",
        )
    is_used = np.ones(len(points[1]), bool) if method == "all" else found.is_inlier
    view = fit_view(camera, found.cam_from_world, points, is_used, noise_px=sigma_px or 1.0)

    def refit(other: OneView, used: Bools) -> OneView:
        return fit_view(camera, other.cam_from_world, points, used, noise_px=sigma_px or 1.0)

    views = _minima(view, points, refit)
    if method != "all":
        # residuals hold what is wrong with the camera as well, where that is known roughly: then they tell the noise
        given = sigma_px if camera_covariance is None else None
        # from each pose that may be true: seen from the wrong one of two, good points look wrong
        cleaned = [without_wrong_points(one, refit, given) for one in views[:_CLEANED]]
        best = min(cleaned, key=misfit_under(min(one.squares / max(one.degrees_of_freedom, 1.0) for one in cleaned)))
        if not np.array_equal(best.is_used, view.is_used):
            views = _minima(best, points, refit)
    view = views[0]
    noise = noise_of(view, sigma_px, points[1])
    own = with_noise(view, noise)
    if own is None or not np.isfinite(view.cost):
        raise NoReconstructionError(
            f"the pose is open: {int(view.is_used.sum())} points leave a motion of the camera that they do not see",
            "use points that are not on one line, nor all far away",
        )
    return Location(
        view=view, covariance=with_camera(view, own, camera_covariance, points[0]), noise=noise,
        distance=deletion_statistics(view, sigma_px)[1], others=_others(views, noise, sigma_px),
        method="P3P in samples" if method != "all" and len(points[1]) > MIN_POINTS else "all points at once",
    )  # fmt: skip


def _checked(xyz: Array, xy: Array) -> tuple[Array, Array]:
    xyz, xy = np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(xy, np.float64)
    if xyz.shape != (len(xyz), 3) or xy.shape != (len(xyz), 2):
        raise InputError(f"expected places (N, 3) and pixels (N, 2), found {xyz.shape} and {xy.shape}")
    if not (np.isfinite(xyz).all() and np.isfinite(xy).all()):
        raise InputError("expected finite places and pixels, found others")
    distinct = np.array(list(dict.fromkeys(map(tuple, xyz.tolist()))))
    if len(distinct) < MIN_POINTS:
        raise InputError(
            f"expected at least {MIN_POINTS} points, found {len(distinct)}", "three points allow up to four poses"
        )
    widths = np.linalg.svd(distinct - distinct.mean(0), compute_uv=False)
    if not widths[1] > 1e-6 * widths[0]:
        raise InputError("expected points that are not on one line", "a camera can turn about a line without a change")
    return xyz, xy


def _minima(view: OneView, points: tuple[Array, Array], refit: Refit) -> list[OneView]:
    """A fit and those from all other poses that its points allow in space, the best first.

    A pose whose squares are a hundred times what :func:`_others` would still tell does not come down to that.
    """
    rays = pixels_to_rays(view.camera, points[1])
    seen = view.is_used & np.isfinite(rays[:, 0])
    xyz, rays = points[0][seen], rays[seen]
    told = view.squares * math.exp(_RATIO / max(view.degrees_of_freedom, MIN_DEGREES)) + _RATIO * view.noise_px**2
    hopeless = _HOPELESS * told / view.camera.focal**2
    found = [view]
    for pose in pnp.poses_of_points(xyz, rays):
        if p3p.squared_errors(pose, xyz, rays).sum() > hopeless:
            continue
        other = refit(replace(view, cam_from_world=pose), view.is_used)
        if np.isfinite(other.cost) and min(_turn_deg(other, one) for one in found) > _SAME_DEG:
            found.append(other)
    return sorted(found, key=lambda one: one.cost)


def _turn_deg(view: OneView, other: OneView) -> float:
    """Angle of the turn between two views: of their quaternions, whose signs say nothing, it is twice that."""
    p, q = view.cam_from_world[:4], other.cam_from_world[:4]
    apart = min(float(np.linalg.norm(p - q)), float(np.linalg.norm(p + q)))
    return math.degrees(4.0 * math.asin(0.5 * apart))


def _others(views: list[OneView], noise: Noise, sigma_px: float | None) -> tuple[OtherPose, ...]:
    """Poses that a likelihood ratio does not rule out: of the noise that is known, or else found with each pose.

    The residuals of the wrong pose are smaller by chance by what its six numbers can take of the noise.
    """
    view = views[0]
    degrees = view.degrees_of_freedom
    floor = noise.sigma_px**2 * max(degrees, 1.0) * 1e-6
    found: list[OtherPose] = []
    for other in views[1:]:
        if sigma_px is not None or degrees < MIN_DEGREES:
            ratio = (other.squares - view.squares) / noise.sigma_px**2
        else:
            ratio = degrees * float(np.log((other.squares + floor) / (view.squares + floor)))
        if ratio < _RATIO:
            shift = rigid3.center(other.cam_from_world) - rigid3.center(view.cam_from_world)
            rms = float(np.sqrt(other.squares / max(view.is_used.sum(), 1)))
            found.append(
                OtherPose(other.cam_from_world, rms, _turn_deg(view, other), float(np.linalg.norm(shift)))
            )  # fmt: skip
    return tuple(found)


def with_camera(view: OneView, own: Array, camera_covariance: Array | None, xyz: Array) -> Array:
    """(P + 6, P + 6) covariance of a camera and of the pose of a view that was fitted with it held, ``own`` (6, 6): the
    pose follows the camera's parameters by -(J^T J)^-1 J^T J_camera.

    Of photographs that tell the camera jointly it is that of the whole adjustment, by Schur's complement.
    """
    num = len(view.camera.params)
    whole = np.zeros((num + POSE, num + POSE))
    whole[num:, num:] = own
    if camera_covariance is None:
        return whole
    by_params = project_jacobian(view.camera, rigid3.apply(view.cam_from_world, xyz))[2]
    rows = view.slope[view.is_used].reshape(-1, POSE)
    cofactor = inverse(rows.T @ rows)
    assert cofactor is not None
    follows = -cofactor @ rows.T @ by_params[view.is_used].reshape(-1, num)
    whole[:num, :num] = camera_covariance
    whole[num:, :num] = follows @ camera_covariance
    whole[:num, num:] = whole[num:, :num].T
    whole[num:, num:] += follows @ camera_covariance @ follows.T
    return whole
