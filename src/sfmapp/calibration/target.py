"""A camera from one photograph of points with known places: the direct linear transform, or Tsai's method on a plane.

Points that are not in one plane give the projection matrix, and K, R and t from it (:mod:`sfmapp.geometry.dlt`); those
of a plane the pose and the focal length from directions alone (:mod:`sfmapp.geometry.radial_alignment`), with the
principal point held near the middle, for a plane tells only one of the two. Both starts are found from samples of the
points, so that some may be wrong; then everything is refined at once, points that all others contradict are named, and
the lens is chosen by how well it foretells points that were left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.one_view import (
    MIN_DEGREES,
    Noise,
    OneView,
    Prior,
    bent_covariance,
    deletion_statistics,
    fit_view,
    misfit_under,
    noise_of,
    without_wrong_points,
)
from sfmapp.calibration.one_view_kernels import POSE
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.camera.camera import Camera, pixels_to_rays, simple_camera
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.geometry import dlt, pnp, rigid3
from sfmapp.geometry.radial_alignment import views_of_plane

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Points = tuple[Array, Array]

ENOUGH_FOR_DISTORTION = 20
"""Points below which the distortion of a lens is not looked for unless the user asks, and then with a warning."""

# What is tried where the user has named no lens: the first, unless another surely foretells left-out points better.
# With points enough, all distortion is free: what is held at zero wrongly, for it is just too small to show,
# takes the focal length along, and no sigma would say so.
_FEW_IN_SPACE, _FEW_IN_PLANE = (CameraModel.PINHOLE,), (CameraModel.SIMPLE_PINHOLE,)
_MANY_IN_SPACE, _MANY_IN_PLANE = (CameraModel.OPENCV, CameraModel.OPENCV_FISHEYE), (CameraModel.OPENCV,)
# Standard errors by which another lens has to be better.
_SURELY_BETTER = 3.0
_PERSPECTIVE = ("BROWN", "RATIONAL", "SKEW", "DIVISION")
# Samples of the points that starts are taken from: with 40 % of them wrong, 23 of 500 samples of six have none.
_MAX_SAMPLES = 500
# So many first of them are enough if this is the chance that none was without a wrong point.
_FIRST_SAMPLES, _MISSED = (30, 90), 1e-4
# Share of the longer side within which principal points lie of the middle: phones and cars have two per cent.
_CENTER_SHARE = 0.02
# On a plane the rest has to be said as well: pixels are square to some tenths of a per cent, and p1 and p2, which move
# the middle of the distortion away from the principal point, are one or two thousandths in real lenses. Without p1 and
# p2, 11 of 26 photographs of OpenCV's chessboards gave a focal length beyond three sigmas; with them one does.
_ASPECT_SIGMA, _DECENTERING_SIGMA = 2e-3, 2e-3
# Flatter than this, as a share of its width, a target is a plane, thinner still a line: rounding of what was written.
_FLAT, _THIN = 1e-6, 1e-6
# Sigmas that a focal length has to be away from zero to be one.
_HELD_SIGMAS = 3.0
# Of the picture, in which the points should lie.
_COVERED = 0.5
# Share of the focal length that its sigma may be before this is said.
_UNSURE = 0.05


@dataclass(frozen=True)
class LensTrial:
    """A lens that was tried.

    Attributes:
        model: of the camera. num_unknown: its free parameters and the pose.
        num_used: points that agree with it.
        rms_px: of these.
        left_out_px: root mean square distance of each point from where the others put it, clipped at three sigmas; None
            where the points are too few.
        is_chosen: the first lens is, unless another predicts points that were left out surely better.
    """

    model: CameraModel
    num_unknown: int
    num_used: int
    rms_px: float
    left_out_px: float | None
    is_chosen: bool = False


@dataclass(frozen=True)
class WrongPoint:
    """A point that all others contradict.

    Attributes:
        index: its place among the points. distance_px: from where they put it, at ``expected_px``.
        swapped_with: the point whose place it has, which has its own; None for none.
    """

    index: int
    distance_px: float
    expected_px: tuple[float, float]
    swapped_with: int | None


@dataclass(frozen=True)
class TargetFit:
    """One photograph of N known points, and the camera that took it.

    Attributes:
        view: the fit. covariance: (F + 6, F + 6) of the free parameters and the pose; see :class:`OneView`.
        noise: of a marked coordinate.
        is_plane: whether the points lie in one, and Tsai's constraint was used.
        linear: the direct linear transform of the points that agree; None on a plane.
        tilt_deg: of the plane against the picture; None without one.
        trials: lenses that were tried.
        wrong: points that were left aside, the worst first.
        distance: (N,) pixels of each point from where the others put it; NaN where nothing tells.
        unchecked: positions of points without which the camera would be open, so that nothing checks them.
        warnings: what a user has to know.
    """

    points: Points
    view: OneView
    covariance: Array
    noise: Noise
    is_plane: bool
    linear: dlt.LinearProjection | None
    tilt_deg: float | None
    trials: tuple[LensTrial, ...]
    wrong: tuple[WrongPoint, ...]
    distance: Array
    unchecked: tuple[int, ...]
    warnings: tuple[str, ...]

    @property
    def focal_sigma_px(self) -> float:
        """Of the mean focal length."""
        names = np.array(PARAM_NAMES[self.view.camera.model])[self.view.is_free]
        weights = np.zeros(len(self.covariance))
        weights[: len(names)] = [kind_of(name) == "focal" for name in names]
        weights /= weights.sum()
        return float(np.sqrt(weights @ self.covariance @ weights))

    @property
    def whole_covariance(self) -> Array:
        """(P + 6, P + 6) of all parameters and the pose."""
        num = len(self.view.is_free)
        place = np.concatenate([np.flatnonzero(self.view.is_free), num + np.arange(POSE)])
        whole = np.zeros((num + POSE, num + POSE))
        whole[np.ix_(place, place)] = self.covariance
        return whole

    def calibration(self, name: str) -> CameraCalibration:
        """As every calibration has it, with the name of the photograph."""
        view, (xyz, xy), whole = self.view, self.points, self.whole_covariance
        num = len(view.is_free)
        distance = np.linalg.norm(rigid3.apply(view.cam_from_world, xyz), axis=1)
        how = "Tsai's radial alignment on a plane" if self.is_plane else "direct linear transform"
        return CameraCalibration(
            camera=replace(view.camera, focal_source="user", focal_sigma=self.focal_sigma_px),
            covariance=whole[:num, :num],
            method=f"{how}, refined on {int(view.is_used.sum())} of {len(xy)} points of one photograph",
            noise_px=self.noise.sigma_px, degrees_of_freedom=round(view.degrees_of_freedom),
            views=(ViewFit(name, view.cam_from_world, xy, view.residual, view.is_used),), frame_covariance=whole,
            distances=(float(distance.min()), float(np.median(distance)), float(distance.max())),
            warnings=self.warnings,
        )  # fmt: skip


def calibrate_target(
    xyz: Array, xy: Array, size: tuple[int, int], *, camera_model: CameraModel | None = None,
    sigma_px: float | None = None,
) -> TargetFit:  # fmt: skip
    """The camera that took one photograph of points with known places.

    Args:
        xyz: (N, 3) places in any unit; N >= 6, or 5 on a plane. xy: (N, 2) the pixels that show them.
        size: width and height of the photograph.
        camera_model: None: PINHOLE, from 20 points on OPENCV, or OPENCV_FISHEYE where that foretells points that were
            left out surely better; on a plane SIMPLE_PINHOLE and OPENCV. ``PINHOLE_SKEW`` takes the skew as it comes.
        sigma_px: standard deviation of a marked coordinate, if known; None: from the residuals.

    Returns:
        Camera, pose, covariance, and which points are wrong.

    Raises:
        InputError: too few points, on a line, the same place twice, not finite, or mirrored.
        NoReconstructionError: the points do not tell the focal length: a plane seen frontally, or too flat a target.
        UsageError: a camera model that nothing can refine.
    """
    xyz, xy = _checked(xyz, xy)
    points = xyz, xy
    if camera_model == CameraModel.EQUIRECTANGULAR:
        raise UsageError(f"{camera_model.name} has nothing to calibrate", "a panorama is known by its size")
    is_plane = _flatness(xyz) < _FLAT
    least = 5 if is_plane else dlt.MIN_POINTS
    if len(xy) < least:
        kind = "in a plane" if is_plane else "in space"
        raise InputError(
            f"expected at least {least} points that lie {kind}, found {len(xy)}", "measure and mark more of them"
        )
    start = _start_on_plane(points, size) if is_plane else _start_in_space(points, size)
    share = _CENTER_SHARE if is_plane else None
    lenses = _lenses(camera_model, len(xy), is_plane)
    view, trials = _trials([_fit_lens(model, start, points, share, sigma_px) for model in lenses], sigma_px)
    if view is None:
        raise InputError(
            f"{len(xy)} points are too few for {lenses[0].name}, or its lens sees none of them",
            "use more points, or a camera model with fewer parameters",
        )
    return _told(points, view, is_plane, trials, sigma_px)


def _checked(xyz: Array, xy: Array) -> Points:
    xyz, xy = np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(xy, np.float64)
    if xyz.shape != (len(xyz), 3) or xy.shape != (len(xyz), 2):
        raise InputError(f"expected places (N, 3) and pixels (N, 2), found {xyz.shape} and {xy.shape}")
    is_finite = np.isfinite(xyz).all(1) & np.isfinite(xy).all(1)
    if not is_finite.all():
        raise InputError(f"expected finite numbers, found others in point {int(np.argmin(is_finite)) + 1}")
    _, first, number = np.unique(xyz, axis=0, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[number.ravel()] != np.arange(len(xyz)))
    if len(again):
        i, j = int(first[number.ravel()][again[0]]), int(again[0])
        raise InputError(
            f"expected every place once, found points {i + 1} and {j + 1} at the same",
            "leave one out, or correct its coordinates",
        )
    return xyz, xy


def _lenses(camera_model: CameraModel | None, count: int, is_plane: bool) -> tuple[CameraModel, ...]:
    """Camera models to try."""
    if camera_model is not None:
        return (camera_model,)
    if count < ENOUGH_FOR_DISTORTION:
        return _FEW_IN_PLANE if is_plane else _FEW_IN_SPACE
    return _MANY_IN_PLANE if is_plane else _MANY_IN_SPACE


def _flatness(xyz: Array) -> float:
    """Thickness of the points over their width. Raises InputError if they lie on a line."""
    widths = np.linalg.svd(xyz - xyz.mean(0), compute_uv=False)
    widths = np.pad(widths, (0, 3 - len(widths)))
    if len(xyz) > 2 and not widths[1] > _THIN * widths[0]:
        raise InputError(
            "expected points in space or in a plane, found them on one line",
            "a camera can turn about a line without a change: measure points beside it",
        )
    return float(widths[2] / max(widths[0], 1e-300))


# --------------------------------------------------------------------------------------------------------------- starts


@dataclass(frozen=True)
class _Start:
    """A camera without distortion, its pose, and which points agree."""

    camera: Camera
    cam_from_world: Array
    is_used: Bools


@lru_cache(maxsize=64)
def _samples(count: int, size: int) -> NDArray[np.int64]:
    """(S, size) different points each: all there are, or so many of them, the same at every call."""
    if math.comb(count, size) <= _MAX_SAMPLES:
        return np.array(list(itertools.combinations(range(count), size)))
    draw = np.random.default_rng([0, count, size])
    return np.argsort(draw.random((_MAX_SAMPLES, count)), axis=1)[:, :size]


def _agreeing_points(places: Array, xy: Array, size: int, find: Callable[[Array, Array], Array]) -> Bools:
    """(N,) points that agree with the best of maps (S, 3, D + 1) of samples of them, and of all.

    Args:
        places: (N, D). xy: (N, 2).
        size: of a sample.
        find: maps of samples (S, size, D) and (S, size, 2).
    """
    chosen = _samples(len(xy), size)
    squares = [_squared_errors(find(places[None], xy[None]), places, xy)]
    first = 0
    for num in (*_FIRST_SAMPLES, len(chosen)):
        part = chosen[first:num]
        squares.append(_squared_errors(find(places[part], xy[part]), places, xy))
        first = num
        is_used = _agreeing(np.concatenate(squares), size)
        # the chance that each of these samples had a wrong point
        if num >= len(chosen) or (1.0 - is_used.mean() ** size) ** num < _MISSED:
            break
    return is_used


def _squared_errors(maps: Array, places: Array, xy: Array) -> Array:
    """(S, N) square pixels between what maps (S, 3, D + 1) make of places (N, D) and pixels (N, 2); infinite where a
    point is not seen."""
    u, v, w = np.moveaxis(maps @ dlt.homogeneous(places).T, 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = (u / w - xy[:, 0]) ** 2 + (v / w - xy[:, 1]) ** 2
    # the sign of a homography is that of its first point, and all have to have it; of a projection it is open
    is_seen = np.isfinite(squares) if places.shape[1] == 3 else np.isfinite(squares) & (w > 0.0)
    seen: Array = np.where(is_seen, squares, np.inf)
    return seen


def _agreeing(squares: Array, size: int) -> Bools:
    """(N,) the points that agree with the best of S hypotheses, from their squared errors (S, N): the one with the
    least median (Rousseeuw and Leroy, "Robust Regression and Outlier Detection", 1987)."""
    count = squares.shape[1]
    half = min(count, (count + size) // 2 + 1)
    ranked = np.partition(squares, half - 1, axis=1)[:, half - 1]
    best = squares[int(np.argmin(ranked))]
    # their factor for few points; two coordinates have a median length of 1.177 sigma
    sigma = (1.0 + 5.0 / max(count - size, 1)) * np.sqrt(ranked.min()) / 1.1774
    agree: Bools = best <= max((2.5 * sigma) ** 2, ranked.min())
    return agree


def _start_in_space(points: Points, size: tuple[int, int]) -> _Start:
    xyz, xy = points
    is_used = _agreeing_points(xyz, xy, dlt.MIN_POINTS, dlt.find_projections)
    linear = dlt.find_projection(xyz[is_used], xy[is_used])
    behind = (dlt.homogeneous(xyz[is_used]) @ linear.matrix[2] <= 0.0).mean()
    if behind > 0.5 and linear.rank < 11:  # of a target that is too flat to tell its front from its back
        raise _open_camera(points, None, None)
    if behind > 0.5:
        raise InputError(
            "expected points in front of the camera, found a camera that has them behind it: the picture is the mirror "
            "image of one of these places",
            "x, y, z have to be right-handed, u counts to the right and v down; a mirrored picture fits no camera",
        )
    try:
        k, rotation, translation = dlt.decompose_projection(linear.matrix)
    except ValueError:
        k, rotation, translation = np.diag([np.nan, np.nan, 1.0]), np.eye(3), np.zeros(3)
    if not np.isfinite(k).all():
        raise _open_camera(points, None, None)
    camera = Camera(CameraModel.PINHOLE, *size, np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]))
    return _Start(camera, rigid3.from_matrix(rotation, translation), is_used)


def _start_on_plane(points: Points, size: tuple[int, int]) -> _Start:
    xyz, xy = points
    middle, axes = _plane_of(xyz)
    flat = (xyz - middle) @ axes.T
    is_used = _agreeing_points(flat[:, :2], xy, 4, dlt.find_homographies)
    found = views_of_plane(flat[is_used, :2], xy[is_used] - np.array(size) / 2.0)
    if not found:
        return _start_by_focal(simple_camera(CameraModel.SIMPLE_PINHOLE, *size, 1.0), points, is_used)
    pose = rigid3.from_matrix(
        found[0].rotation @ axes, found[0].translation - found[0].rotation @ axes @ middle
    )  # fmt: skip
    return _Start(simple_camera(CameraModel.SIMPLE_PINHOLE, *size, found[0].focal_px), pose, is_used)


def _plane_of(xyz: Array) -> tuple[Array, Array]:
    """Middle (3,) and right-handed axes (3, 3), rows, of points in a plane; the last is its normal."""
    middle = xyz.mean(0)
    axes = np.linalg.svd(xyz - middle)[2]
    axes[2] = np.cross(axes[0], axes[1])
    return middle, axes


def _start_by_focal(camera: Camera, points: Points, is_used: Bools) -> _Start:
    """The best of focal lengths from a fifth of the picture's side to five of it, each with the pose that fits best."""
    xyz, xy = points
    best, least = None, np.inf
    for focal in max(camera.width, camera.height) * np.geomspace(0.2, 5.0, 12):
        tried = camera.with_focal(focal)
        rays = pixels_to_rays(tried, xy)
        seen = is_used & np.isfinite(rays).all(1)
        if seen.sum() < 4:
            continue
        for pose in pnp.poses_of_points(xyz[seen], rays[seen])[:1]:
            view = fit_view(tried, pose, points, is_used)
            if view.cost < least:
                best, least = _Start(view.camera, view.cam_from_world, is_used), view.cost
    if best is None:
        raise _open_camera(points, None, None)
    return best


# ----------------------------------------------------------------------------------------------------------- refinement


def _fit_lens(
    model: CameraModel, start: _Start, points: Points, center_share: float | None, sigma_px: float | None
) -> OneView | None:
    """The best fit of a lens to the points that agree with it; None if they are too few for it.

    Args:
        center_share: of the longer side that the principal point is off the middle by, one sigma; None for any.
        sigma_px: of a mark, if known.
    """
    camera = _with_lens(model, start.camera)
    is_free = np.ones(len(camera.params), bool)
    num_unknown = len(camera.params) + POSE
    if 2 * len(points[1]) < num_unknown - (2 if center_share else 0):
        return None
    if model.family not in _PERSPECTIVE:
        start = _start_by_focal(camera, points, np.ones(len(points[1]), bool))
        camera = start.camera
    prior = None if center_share is None else _prior_of_plane(camera, center_share)
    noise_px = sigma_px or 1.0

    def refit(view: OneView, is_used: Bools) -> OneView:
        return fit_view(
            view.camera, view.cam_from_world, points, is_used, is_free=is_free, prior=prior, noise_px=noise_px
        )  # fmt: skip

    def cleaned(is_used: Bools) -> OneView:
        view = fit_view(
            camera, start.cam_from_world, points, is_used, is_free=is_free, prior=prior, noise_px=noise_px
        )  # fmt: skip
        return without_wrong_points(view, refit, sigma_px)

    view = cleaned(start.is_used)
    if not view.is_used.all():
        # a start without distortion may leave aside what the distortion moved, and keep a wrong point in its place:
        # what begins with all points, and loses the wrong ones one by one, does not
        views = [view, cleaned(np.ones(len(points[1]), bool))]
        view = min(views, key=misfit_under(min(one.squares / max(one.degrees_of_freedom, 1.0) for one in views)))
    if prior is not None and sigma_px is None:  # it is weighed against the noise, which is known now
        noise_px = noise_of(view, None, points[1]).sigma_px
        view = without_wrong_points(refit(view, view.is_used), refit, None)
    return view if np.isfinite(view.cost) else None


def _prior_of_plane(camera: Camera, center_share: float) -> Prior:
    """What points of one plane leave open: where the principal point is, how oblong pixels are, decentering."""
    names = PARAM_NAMES[camera.model]
    sigmas = {"cx": center_share, "cy": center_share}
    sigmas = {name: share * max(camera.width, camera.height) for name, share in sigmas.items()}
    sigmas |= {"p1": _DECENTERING_SIGMA, "p2": _DECENTERING_SIGMA}
    rows = [np.eye(len(names))[i] / sigmas[name] for i, name in enumerate(names) if name in sigmas]
    if "fy" in names:
        oblong = np.zeros(len(names))
        oblong[names.index("fx")], oblong[names.index("fy")] = 1.0, -1.0
        rows.append(oblong / (_ASPECT_SIGMA * camera.focal))
    return Prior(camera.params, np.array(rows))


def _with_lens(model: CameraModel, pinhole: Camera) -> Camera:
    """A camera of a model with the focal length and the centre of a pinhole, and no distortion."""
    fx, fy, cx, cy = pinhole.canonical[:4]
    camera = simple_camera(model, pinhole.width, pinhole.height, 0.5 * (fx + fy))
    known = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    names = PARAM_NAMES[model]
    return camera.with_params([known.get(name, value) for name, value in zip(names, camera.params, strict=True)])


def _trials(fits: Sequence[OneView | None], sigma_px: float | None) -> tuple[OneView | None, tuple[LensTrial, ...]]:
    """The fit to go on with, and all that were tried.

    A point counts by its distance from where the others put it, as far as three sigmas of the best fit: a lens may not
    win by calling what it does not fit wrong.
    """
    found = [view for view in fits if view is not None]
    if not found:
        return None, ()
    told = [v.squares / v.degrees_of_freedom for v in found if v.degrees_of_freedom > 2.0]
    far = 3.0 * np.sqrt(2.0 * min(told)) if told else np.inf
    squares = [
        np.minimum(np.nan_to_num(deletion_statistics(view, sigma_px)[1], nan=far), far) ** 2 if told else None
        for view in found
    ]
    best = 0
    for k in range(1, len(found)):
        first, other = squares[best], squares[k]
        if first is not None and other is not None:
            gain = first - other
            if gain.mean() > _SURELY_BETTER * gain.std() / np.sqrt(len(gain)):
                best = k
    trials = [
        LensTrial(
            model=view.camera.model, num_unknown=view.num_unknown, num_used=int(view.is_used.sum()),
            rms_px=float(np.sqrt(view.squares / max(view.is_used.sum(), 1))),
            left_out_px=None if square is None else float(np.sqrt(square.mean())), is_chosen=k == best,
        )
        for k, (view, square) in enumerate(zip(found, squares, strict=True))
    ]  # fmt: skip
    return found[best], tuple(trials)


# ----------------------------------------------------------------------------------------------------- what it comes to


def _told(
    points: Points, view: OneView, is_plane: bool, trials: tuple[LensTrial, ...], sigma_px: float | None
) -> TargetFit:
    """The result of a fit. Raises NoReconstructionError if the points do not hold it."""
    xyz, xy = points
    noise = noise_of(view, sigma_px, xy)
    covariance = bent_covariance(view, noise, points)
    if covariance is None:
        raise _open_camera(points, view, None)
    statistic, distance = deletion_statistics(view, sigma_px)
    linear = None
    if not is_plane:
        linear = dlt.find_projection(xyz[view.is_used], xy[view.is_used], noise_px=noise.sigma_px)
    fit = TargetFit(
        points=points, view=view, covariance=covariance, noise=noise, is_plane=is_plane, linear=linear,
        tilt_deg=_tilt_deg(xyz, view) if is_plane else None, trials=trials,
        wrong=_wrong_points(points, view, distance), distance=distance,
        unchecked=tuple(np.flatnonzero(np.isnan(statistic)).tolist()),
        warnings=(),
    )  # fmt: skip
    if not fit.focal_sigma_px * _HELD_SIGMAS < view.camera.focal:
        raise _open_camera(points, view, fit.focal_sigma_px)
    return replace(fit, warnings=tuple(_warnings(fit)))


def _tilt_deg(xyz: Array, view: OneView) -> float:
    normal = rigid3.rotation_matrix(view.cam_from_world) @ _plane_of(xyz)[1][2]
    return float(np.degrees(np.arccos(min(abs(normal[2]), 1.0))))


def _open_camera(points: Points, view: OneView | None, sigma_px: float | None) -> NoReconstructionError:
    """Why the points leave the camera open, and what to do."""
    xyz, xy = points
    how = "" if sigma_px is None else f" (sigma {sigma_px:.0f} px of {view.camera.focal:.0f})" if view else ""
    widths = np.linalg.svd(xyz - xyz.mean(0), compute_uv=False)
    if widths[2] <= _FLAT * widths[0]:
        tilt = "" if view is None else f", to {_tilt_deg(xyz, view):.1f} degrees"
        return NoReconstructionError(
            f"the focal length is open{how}: the plane of the {len(xy)} points is seen frontally{tilt}, and a camera "
            "with twice the focal length at twice the distance takes the same picture",
            "photograph it from the side, tilted by 30 to 50 degrees, or use points in space",
        )
    return NoReconstructionError(
        f"the focal length is open{how}: the {len(xy)} points are {widths[2] / widths[0]:.1%} as deep as they are "
        "wide, and what this moves in the picture is lost in the noise of the marks",
        "use points of more depth, come closer, or mark them more exactly; a plane is told from its equal z",
    )


def _wrong_points(points: Points, view: OneView, distance: Array) -> tuple[WrongPoint, ...]:
    """Points that were left aside, the worst first, and those that seem to have changed places."""
    xy, is_used = points[1], view.is_used
    expected = xy - view.residual
    aside = np.flatnonzero(~is_used)
    limit = 4.0 * np.sqrt(2.0 * max(view.squares / max(view.degrees_of_freedom, 1.0), 0.25**2))
    found = []
    for i in aside[np.argsort(-np.nan_to_num(distance[aside], nan=np.inf))]:
        near = [j for j in aside if j != i and np.linalg.norm(xy[i] - expected[j]) < limit]
        mutual = [int(j) for j in near if np.linalg.norm(xy[j] - expected[i]) < limit]
        at = (float(expected[i, 0]), float(expected[i, 1]))
        found.append(WrongPoint(int(i), float(distance[i]), at, mutual[0] if mutual else None))
    return tuple(found)


def _warnings(fit: TargetFit) -> list[str]:
    view, xy = fit.view, fit.points[1]
    camera, count = view.camera, int(view.is_used.sum())
    found = []
    has_distortion = any(kind_of(name) == "distortion" and name != "s" for name in PARAM_NAMES[camera.model])
    if count < ENOUGH_FOR_DISTORTION:
        found.append(
            f"{count} points are few for the distortion of a lens: use {ENOUGH_FOR_DISTORTION} or more"
            if has_distortion
            else f"the distortion of the lens is taken as zero, for {count} points are few to tell it "
            f"({ENOUGH_FOR_DISTORTION} or more are needed): the sigmas do not count it"
        )
    if view.degrees_of_freedom < MIN_DEGREES:
        found.append(f"barely enough points: {fit.noise.source}")
    if fit.unchecked:
        names = ", ".join(str(i + 1) for i in fit.unchecked[:5])
        found.append(
            f"nothing checks point{'s' * (len(fit.unchecked) > 1)} {names}: without it the camera would be open"
        )
    if fit.focal_sigma_px > _UNSURE * camera.focal:
        found.append(f"the focal length is known to {fit.focal_sigma_px / camera.focal:.0%} only")
    if fit.is_plane:
        found.append(
            f"a plane tells either the principal point or the focal length: the point is taken as in the middle to "
            f"{_CENTER_SHARE:.0%} of the longer side, pixels as square to {_ASPECT_SIGMA:.1%}, and the plane as flat"
        )
    covered = np.ptp(xy[view.is_used], axis=0) / [camera.width, camera.height]
    if covered.min() < _COVERED:
        found.append(
            f"the points cover {covered[0]:.0%} of the width and {covered[1]:.0%} of the height of the picture: what "
            "the lens does elsewhere is guessed"
        )
    return found
