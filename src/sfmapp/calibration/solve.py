"""From points of targets in photographs to a camera that says how sure it is."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from sfmapp.calibration.adjustment import Fit, TargetView, normal_at, observations_of, refine, residuals_of
from sfmapp.calibration.comparison import projection_difference
from sfmapp.calibration.kernels import Observations
from sfmapp.calibration.lens_choice import REJECTED, TRIED, Candidate, Trial, try_models
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.calibration.start import first_fit, refine_robustly, to_model
from sfmapp.calibration.uncertainty import frame_covariance, image_grid, projection_covariance, projection_sigma
from sfmapp.calibration.zhang import ClosedForm, closed_form
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

STAGE = "calibration"
LEAST_VIEWS, ADVISED_VIEWS = 3, 10
_ROUNDS = 4
# a view with fewer points does not hold its pose: six numbers, and two to judge them by
_LEAST_POINTS = 4
# a view whose typical residual is so many times that of all, and so many pixels, was not seen rightly
_WRONG_VIEW, _WRONG_VIEW_PX = 20.0, 3.0
# of the focal length: a sigma beyond is no calibration
_OPEN_FOCAL = 0.1
# where no perspective is seen the focal length runs away: beyond this many pictures no board shows any
_LONGEST = 50.0
# chance of a false alarm that a view is named, over all views; and how much worse it must be to matter, a ratio
_NAMED, _WORSE = 0.01, 1.5
_BLURRED = 1.5
_OBLIQUE_DEG = 65.0
# chance that a flat board is taken for a bent one
BENT_CHANCE = 1e-4
RESOLVED_SIGMAS = 4.0


@dataclass(frozen=True)
class Bend:
    """The shape of a board that is not flat: z = a u^2 + b v^2 + c u v, u and v from -1 to 1 over its points.

    Attributes:
        coefficients, sigmas: (3,) in the unit of the board.
        depth: largest distance of its points from a plane through them.
        rms_before_px: of the residuals as if it were flat.
    """

    coefficients: Array
    sigmas: Array
    depth: float
    rms_before_px: float


@dataclass(frozen=True)
class Solution:
    """A calibration and what was decided on the way.

    Attributes:
        calibration: the result.
        fit: of the views that count, in their order.
        trials: lens models, the chosen one first.
        closed_form: of Zhang's method, before any refinement.
        bend: of the board; None where it is flat as far as the views tell.
        bend_note: why it was not looked for, or what was found.
    """

    calibration: CameraCalibration
    fit: Fit
    trials: tuple[Trial, ...]
    closed_form: ClosedForm
    bend: Bend | None = None
    bend_note: str = ""


@dataclass(frozen=True)
class ViewFacts:
    """What detection knows of a view.

    Attributes:
        sharpness_px: width of its edges.
        is_whole: every point of the board was found, so that it is known which is which.
    """

    sharpness_px: float = float("nan")
    is_whole: bool = True


@dataclass
class _Work:
    views: list[TargetView]
    facts: list[ViewFacts]
    size: tuple[int, int]
    events: Events
    unit: str = "m"
    warnings: list[str] = field(default_factory=list)
    wrong: list[ViewFit] = field(default_factory=list)


def solve_views(
    views: Sequence[TargetView], size: tuple[int, int], model: CameraModel | None = None, *,
    facts: Sequence[ViewFacts] | None = None, bends: bool = True, threads: int = 1, events: Events | None = None,
    unit: str = "m",
) -> Solution:  # fmt: skip
    """Calibrate a camera from views of flat targets.

    Args:
        views: of one camera and one target; z of their points is 0.
        size: width and height of the pictures.
        model: of the lens; None: by views that are held out.
        facts: of each view.
        bends: look whether the target is bent.
        threads: how many lens models are tried at a time.
        events: decisions and warnings.
        unit: of the targets, for messages.

    Raises:
        InputError: fewer than three views, or views that do not tell the focal length; it says which and why.
    """
    facts = [ViewFacts()] * len(views) if facts is None else list(facts)
    work = _Work(list(views), list(facts), size, events or Events(), unit)
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"expected at least {LEAST_VIEWS} photographs of the board, found {len(views)}: two planes leave the "
            "parameters open",
            f"take {ADVISED_VIEWS} or more, from all sides, tilted by 20 to 50 degrees, out to the corners",
        )
    linear = closed_form(work.views, size)
    base = _without_wrong_views(work, first_fit(work.views, size, linear.k_matrix))
    _check_tells_focal(work, base, linear)
    if len(work.views) < ADVISED_VIEWS:
        work.warnings.append(f"{len(work.views)} views are few: {ADVISED_VIEWS} or more are advised")

    def fit_model(one: CameraModel) -> Candidate:
        work.events.raise_if_cancelled()
        fit, is_used = inlier_fit(to_model(base, one, work.views), work.views)
        return Candidate(fit, is_used, _worst_px(fit, is_used, work.views))

    models = TRIED if model is None else (model,)
    trials = try_models(models, work.views, fit_model, threads)
    chosen = trials[0]
    fit, is_used = inlier_fit(chosen.fit, work.views)
    work.events.decided(STAGE, f"lens model {chosen.model.name}: {chosen.reason or 'as asked for'}")
    bend, note = None, "not looked for"
    if bends:
        fit, is_used, bend, note = _bent(work, fit, is_used)
    calibration = _with_rivals(_result(work, fit, is_used), trials)
    return Solution(calibration, fit, tuple(trials), linear, bend, note)


def inlier_fit(start: Fit, views: Sequence[TargetView], bends: Sequence[Array] | None = None) -> tuple[Fit, Bools]:
    """The least-squares fit to the points that agree with it, and which these are, (N,) bool.

    A point is left aside whose residual one good point in a hundred thousand would have; the sigma is that of the
    points that are left, at first by their median. A view goes whole where fewer than four of its points are left.
    """
    obs = observations_of(views, bends)
    fit = start
    squared = (residuals_of(fit, obs) ** 2).sum(1)
    variance = float(np.nanmedian(squared)) / (2.0 * np.log(2.0))
    is_used = _of_placed_views(np.isfinite(squared) & (squared <= REJECTED * variance), obs.ptr)
    for _ in range(_ROUNDS):
        fit = refine(fit, obs._replace(weight=is_used.astype(np.float64)))
        squared = (residuals_of(fit, obs) ** 2).sum(1)
        variance = float(squared[is_used].sum()) / max(_degrees_of_freedom(fit, is_used, obs.ptr), 1)
        now = _of_placed_views(np.isfinite(squared) & (squared <= REJECTED * variance), obs.ptr)
        if (now == is_used).all():
            break
        is_used = now
    return fit, is_used


def _of_placed_views(is_used: Bools, ptr: NDArray[np.int64]) -> Bools:
    """Those of the points (N,) that belong to views with enough of them."""
    counts = np.array([is_used[a:b].sum() for a, b in itertools.pairwise(ptr)])
    placed: Bools = is_used & np.repeat(counts >= _LEAST_POINTS, np.diff(ptr))
    return placed


def _degrees_of_freedom(fit: Fit, is_used: Bools, ptr: NDArray[np.int64]) -> int:
    num_seen = sum(bool(is_used[a:b].any()) for a, b in itertools.pairwise(ptr))
    return int(2 * is_used.sum() - len(fit.camera.params) - len(fit.bend) - 6 * num_seen)


def _without_wrong_views(work: _Work, base: Fit) -> Fit:
    """Leave out views that fit no board where all the others do: something else was taken for one."""
    obs = observations_of(work.views)
    r = residuals_of(base, obs)
    squared = np.where(np.isfinite(r).all(1), (r**2).sum(1), np.inf)
    typical = [float(np.sqrt(np.median(squared[a:b]))) for a, b in zip(obs.ptr[:-1], obs.ptr[1:], strict=True)]
    limit = max(_WRONG_VIEW * float(np.median(typical)), _WRONG_VIEW_PX)
    is_wrong = np.array([value > limit for value in typical])
    if not is_wrong.any() or (~is_wrong).sum() < LEAST_VIEWS:
        return base
    for v in np.flatnonzero(is_wrong):
        view, own = work.views[v], slice(obs.ptr[v], obs.ptr[v + 1])
        why = f"left out: its points are {typical[v]:.1f} px off, those of the others {np.median(typical):.2f} px"
        none = np.zeros(len(view.xy), np.bool_)
        work.wrong.append(ViewFit(view.name, base.cam_from_target[v], view.xy, r[own], none, why))
        work.events.warned(STAGE, f"{view.name}: {why}")
    kept = np.flatnonzero(~is_wrong)
    work.views, work.facts = [work.views[v] for v in kept], [work.facts[v] for v in kept]
    return refine_robustly(replace(base, cam_from_target=base.cam_from_target[kept]), work.views)


def _check_tells_focal(work: _Work, base: Fit, linear: ClosedForm) -> None:
    """Refuse views that leave the focal length open: planes that are parallel to each other, or to the picture."""
    found = inlier_fit(to_model(base, _plain_of(base.camera), work.views), work.views)
    covariance = _covariance(*found, work.views)
    sigma = np.inf
    if covariance is not None:
        focals = [kind_of(name) == "focal" for name in PARAM_NAMES[found[0].camera.model]]
        sigma = float(np.sqrt(np.diag(covariance[0])[: len(focals)][focals].max())) / found[0].camera.focal
    if found[0].camera.focal > _LONGEST * max(work.size):
        sigma = np.inf
    if not sigma < _OPEN_FOCAL:
        known = f"to {sigma:.0%} of itself only" if np.isfinite(sigma) and sigma < 10.0 else "not at all"
        raise InputError(
            f"expected views that tell the focal length, found {len(work.views)} that tell it {known} (Zhang's system "
            f"has rank {linear.rank}, five are needed): the boards are parallel to each other or to the picture",
            "tilt the board by 20 to 50 degrees, about both of its axes, from photograph to photograph",
        )


def _plain_of(camera: Camera) -> CameraModel:
    """A model with one distortion of the kind of a first fit."""
    is_perspective = camera.model.family == "BROWN"
    return CameraModel.SIMPLE_RADIAL if is_perspective else CameraModel.SIMPLE_RADIAL_FISHEYE


def _covariance(fit: Fit, is_used: Bools, views: Sequence[TargetView]) -> tuple[Array, float, int] | None:
    """Covariance of parameters and frame, the sigma of a coordinate, and the degrees of freedom."""
    bends = None if not len(fit.bend) else [bend_basis(view, views) for view in views]
    obs = observations_of(views, bends)._replace(weight=is_used.astype(np.float64))
    dof = _degrees_of_freedom(fit, is_used, obs.ptr)
    if dof < 1:
        return None
    r = residuals_of(fit, obs)[is_used]
    variance = float((r**2).sum()) / dof
    found = frame_covariance(normal_at(fit, obs), len(fit.camera.params), variance)
    return None if found is None else (found, float(np.sqrt(variance)), dof)


def _worst_px(fit: Fit, is_used: Bools, views: Sequence[TargetView]) -> float:
    """Largest sigma of a projection in the picture; infinite where the views leave parameters open."""
    found = _covariance(fit, is_used, views)
    if found is None:
        return float("inf")
    num = len(fit.camera.params)
    middle = float(np.median(np.linalg.norm(_points(fit, views), axis=1)))
    made = CameraCalibration(fit.camera, found[0][:num, :num], "", found[1], found[2], frame_covariance=found[0])
    variance = 0.5 * np.trace(projection_covariance(made, image_grid(fit.camera), middle), axis1=1, axis2=2)
    known = variance[~np.isnan(variance)]
    # a variance below 0 is one that rounding has eaten: the parameters are open along it
    is_told = len(known) > 0 and bool((known >= 0.0).all() and np.isfinite(known).all())
    return float(np.sqrt(known.max())) if is_told else float("inf")


def _points(fit: Fit, views: Sequence[TargetView]) -> Array:
    """(N, 3) all points in the camera's frame."""
    return np.concatenate([
        rigid3.apply(pose, view.xyz) for pose, view in zip(fit.cam_from_target, views, strict=True)
    ])  # fmt: skip


# ----------------------------------------------------------------------------------------------- a board's own shape


def bend_basis(view: TargetView, views: Sequence[TargetView]) -> Array:
    """(N, 3) u^2, v^2 and u v of a view's points, u and v from -1 to 1 over the points of all views."""
    low = np.min([one.xyz[:, :2].min(0) for one in views], axis=0)
    high = np.max([one.xyz[:, :2].max(0) for one in views], axis=0)
    u, v = (2.0 * (view.xyz[:, :2] - low) / (high - low) - 1.0).T
    return np.stack([u * u, v * v, u * v], 1)


def _bent(work: _Work, flat: Fit, is_used: Bools) -> tuple[Fit, Bools, Bend | None, str]:
    """The fit with a board that is bent where the views show it, or the flat one; and what was found."""
    if not all(fact.is_whole for fact in work.facts):
        return flat, is_used, None, "not looked for: boards that are seen in part have no places of their own"
    bends = [bend_basis(view, work.views) for view in work.views]
    start = replace(flat, bend=np.zeros(3))
    fit, now_used = inlier_fit(start, work.views, bends)
    obs = observations_of(work.views)
    before = (residuals_of(flat, obs)[is_used] ** 2).sum()
    bent_obs = observations_of(work.views, bends)
    # both costs over the same points
    both = is_used & now_used
    cost_flat = float((residuals_of(flat, obs)[both] ** 2).sum())
    cost_bent = float((residuals_of(fit, bent_obs)[both] ** 2).sum())
    dof = _degrees_of_freedom(fit, both, obs.ptr)
    if dof < 1 or not cost_bent > 0:
        return flat, is_used, None, "not looked for: there are too few points"
    ratio = (cost_flat - cost_bent) / 3.0 / (cost_bent / dof)
    chance = float(fisher.sf(ratio, 3, dof))
    covariance = np.linalg.pinv(_bend_information(fit, bent_obs._replace(weight=now_used.astype(np.float64))))
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0) * cost_bent / dof)
    is_resolved = bool((np.abs(fit.bend) > RESOLVED_SIGMAS * sigmas).any())
    if not (chance < BENT_CHANCE and is_resolved):
        return flat, is_used, None, f"flat as far as the views tell (F {ratio:.1f}, chance {chance:.2g})"
    depth = bend_depth(fit.bend)
    rms = float(np.sqrt(before / max(is_used.sum(), 1)))
    text = f"{1000.0 * depth:.2f} mm" if work.unit == "m" else f"{depth:.4f} {work.unit}"
    note = f"the board is bent: up to {text} out of its plane (F {ratio:.0f}); taken into account"
    work.warnings.append(note)
    work.events.decided(STAGE, note)
    return fit, now_used, Bend(fit.bend, sigmas, depth, rms), note


def bend_depth(coefficients: Array) -> float:
    """How far a board of the shape (3,) is out of the plane that fits it best, in the unit of the board."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), -1).reshape(-1, 2)
    u, v = grid.T
    z = np.stack([u * u, v * v, u * v], 1) @ coefficients
    plane = np.stack([u, v, np.ones_like(u)], 1)
    return float(np.abs(z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]).max())


def _bend_information(fit: Fit, obs: Observations) -> Array:
    """(3, 3) what the views say of the shape once parameters and poses are free."""
    normal = normal_at(fit, obs)
    is_seen = normal.own[:, 0, 0] > 0
    cross = normal.cross[is_seen]
    reduced = normal.shared - np.einsum("vsi,vij,vtj->st", cross, np.linalg.inv(normal.own[is_seen]), cross)
    n = len(fit.camera.params)
    found: Array = reduced[n:, n:] - reduced[n:, :n] @ np.linalg.pinv(reduced[:n, :n], hermitian=True) @ reduced[:n, n:]
    return found


# -------------------------------------------------------------------------------------------------------- the result


def _result(work: _Work, fit: Fit, is_used: Bools) -> CameraCalibration:
    found = _covariance(fit, is_used, work.views)
    if found is None:
        raise InputError(
            f"expected views that hold all {len(fit.camera.params)} parameters of {fit.camera.model.name}, found "
            f"{len(work.views)} that leave some open",
            "take more photographs, out to the corners of the picture, or a lens with fewer parameters: --camera-model",
        )
    covariance, noise, dof = found
    bends = None if not len(fit.bend) else [bend_basis(view, work.views) for view in work.views]
    obs = observations_of(work.views, bends)
    r = residuals_of(fit, obs)
    problems = _problems(work, fit, r, is_used, obs.ptr)
    views = []
    for v, (view, problem) in enumerate(zip(work.views, problems, strict=True)):
        own = slice(obs.ptr[v], obs.ptr[v + 1])
        views.append(ViewFit(view.name, fit.cam_from_target[v], view.xy, r[own], is_used[own], problem))
    num_bad = int((~is_used).sum())
    if num_bad:
        work.warnings.append(f"{num_bad} of {len(is_used)} points were left aside: they agree with no camera")
    points = _points(fit, work.views)
    near, middle, far = np.quantile(np.linalg.norm(points, axis=1), [0.0, 0.5, 1.0])
    num = len(fit.camera.params)
    return CameraCalibration(
        camera=replace(fit.camera, focal_source="user"),
        covariance=covariance[:num, :num],
        method=f"boards: {len(views)} views, {int(is_used.sum())} points",
        noise_px=noise,
        degrees_of_freedom=dof,
        views=(*views, *work.wrong),
        frame_covariance=covariance,
        distances=(float(near), float(middle), float(far)),
        warnings=tuple(work.warnings),
    )


def _with_rivals(made: CameraCalibration, trials: Sequence[Trial]) -> CameraCalibration:
    """With a warning where a lens model that fits as well puts a part of the picture elsewhere than sigmas allow.

    Sigmas are those of a model that is right. Where no board was seen, models go on from what was in their own ways.
    """
    far = None
    for trial in trials:
        if not trial.is_rival:
            continue
        xy, difference, _ = projection_difference(made.camera, trial.fit.camera)
        length = np.linalg.norm(difference, axis=1)
        limit = np.maximum(RESOLVED_SIGMAS * projection_sigma(made, xy), made.noise_px)
        if not np.nanmax(length / limit) > 1.0:
            continue
        n = int(np.nanargmax(length))
        if far is None or length[n] > far[0]:
            far = float(length[n]), trial.model.name, xy[n]
    if far is None:
        return made
    warning = (
        f"the views do not tell {made.camera.model.name} from {far[1]}, which differ by up to {far[0]:.2g} px, most"
        f" near pixel ({far[2][0]:.0f}, {far[2][1]:.0f}); sigmas do not know of that: photograph the board there"
    )
    return replace(made, warnings=(*made.warnings, warning))


def _problems(work: _Work, fit: Fit, r: Array, is_used: Bools, ptr: NDArray[np.int64]) -> list[str | None]:
    """Why views stand out, by Fisher's test of their residuals against those of all others."""
    squared = np.where(is_used, (np.nan_to_num(r) ** 2).sum(1), 0.0)
    sums = np.add.reduceat(squared, ptr[:-1])
    counts = np.add.reduceat(is_used.astype(np.float64), ptr[:-1])
    widths = np.array([fact.sharpness_px for fact in work.facts])
    found: list[str | None] = []
    for v in range(len(work.views)):
        own, rest = 2.0 * counts[v] - 6.0, 2.0 * (counts.sum() - counts[v]) - 6.0 * (len(counts) - 1)
        if own < 1 or rest < 1:
            found.append("all of its points were left aside" if counts[v] == 0 else None)
            continue
        ratio = (sums[v] / own) / max((sums.sum() - sums[v]) / rest, 1e-300)
        is_worse = ratio > _WORSE**2 and fisher.sf(ratio, own, rest) < _NAMED / len(work.views)
        found.append(_reason(work, fit, v, ratio, widths) if is_worse else None)
    return found


def _reason(work: _Work, fit: Fit, v: int, ratio: float, widths: Array) -> str:
    text = f"its residuals are {np.sqrt(ratio):.1f} times those of the others"
    rotation = rigid3.rotation_matrix(fit.cam_from_target[v])
    middle = rigid3.apply(fit.cam_from_target[v], work.views[v].xyz.mean(0))
    cosine = abs(float(rotation[:, 2] @ middle)) / float(np.linalg.norm(middle))
    tilt = float(np.degrees(np.arccos(min(1.0, cosine))))
    typical = float(np.nanmedian(widths)) if np.isfinite(widths).any() else float("nan")
    if np.isfinite(widths[v]) and widths[v] > _BLURRED * typical:
        return f"{text}: it is blurred, its edges are {widths[v]:.1f} px wide, those of the others {typical:.1f}"
    if tilt > _OBLIQUE_DEG:
        return f"{text}: the board is seen from the side, {tilt:.0f} degrees off its normal"
    return f"{text}: the board or the camera moved, or its points were not found where they are"
