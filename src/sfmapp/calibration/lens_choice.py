"""Which lens model a camera has, by views that its parameters were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from sfmapp.calibration.adjustment import Fit, TargetView, observations_of, refine, residuals_of
from sfmapp.calibration.kernels import Observations
from sfmapp.camera.camera import pixels_to_rays
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# views are held out in so many groups, fewer where there are fewer views
_FOLDS = 5
# one good point in a hundred thousand is further off than this, squared, in sigmas of a coordinate
REJECTED = float(chi2.isf(1e-5, 2))
_ARITHMETIC_PX = 1e-6
# a model whose residuals are this many times the best's is not looked at further; cut off, they are 3.4 times at most
_HOPELESS = 2.0
# nor one whose worst sigma in the picture is this share of its diagonal: it fits where there were boards, and is
# anything elsewhere. A lens that few parameters do not describe is uncertain in the corners, and says so
_OPEN_SHARE = 1.0 / 40.0
# chance that held-out views speak against the right model, over all that are compared: the best of seventeen is better
# by luck too
_EXCLUDED = 0.05
# evidence below which a simpler model stays that is as good on views held out: ten is "very strong" (Kass and Raftery,
# "Bayes factors", 1995), and corners share errors that no criterion knows of
_STRONG_BIC = 10.0

# those that are tried: a panorama is no lens, and pixels of no camera of today are skewed
TRIED = tuple(
    sorted(
        (model for model in CameraModel if model not in (CameraModel.EQUIRECTANGULAR, CameraModel.PINHOLE_SKEW)),
        key=lambda model: (len(model.params), int(model)),
    )
)


@dataclass(frozen=True)
class Trial:
    """A lens model and how well it does.

    Attributes:
        model: that was fitted.
        fit: to all views.
        rms_px: of what it was fitted to.
        worst_px: largest sigma of a projection in the picture.
        bic: Schwarz's criterion, by all points.
        held_out: (V,) mean squared residual of each view while it was held out, far ones cut off, pixels squared; None
            where it was not worth it.
        reason: why it was not chosen, or that it was.
        is_rival: the views do not tell it from the chosen one.
    """

    model: CameraModel
    fit: Fit
    rms_px: float
    worst_px: float
    bic: float
    held_out: Array | None = None
    reason: str = ""
    is_rival: bool = False

    @property
    def held_out_px(self) -> float:
        """Root mean square of the held-out views, pixels; NaN without."""
        return float("nan") if self.held_out is None else float(np.sqrt(self.held_out.mean()))


@dataclass(frozen=True)
class Candidate:
    """A model fitted to all views.

    Attributes:
        fit: of it.
        is_used: (N,) bool, the points that count.
        worst_px: largest sigma of a projection in the picture; infinite where the views leave parameters open.
    """

    fit: Fit
    is_used: Bools
    worst_px: float


FitModel = Callable[[CameraModel], Candidate]


def try_models(
    models: Sequence[CameraModel], views: Sequence[TargetView], fit_model: FitModel, threads: int
) -> list[Trial]:
    """Fit every model, hold out views of those that fit, and choose: the first of the result.

    Held-out views say which models may be right: all but those that are worse than the best by Student's test of the
    differences view by view, at one in twenty over all models (Bonferroni). A bias below the noise of a view escapes
    them. So among these models Schwarz's criterion decides, chi2 + P ln N over all points ("Estimating the dimension of
    a model", 1978); where it is not sure, a simpler model that does as well on held-out views stays.

    All are judged by all points: one that a model leaves aside, or has no ray for, counts as the largest residual that
    a good point may have.

    Args:
        threads: how many are fitted at a time; the result does not depend on it.
    """
    with ThreadPoolExecutor(threads) as pool:
        fitted = list(zip(models, pool.map(fit_model, models), strict=True))
    obs = observations_of(views)
    squared = [_squared(residuals_of(found.fit, obs)) for _, found in fitted]
    # the noise of a coordinate by the model that fits most points best; half of the squared lengths are below 2 ln 2
    limit = REJECTED * min(float(np.median(one)) for one in squared) / (2.0 * np.log(2.0))
    # exact points have no noise but that of arithmetic
    limit = max(limit, _ARITHMETIC_PX**2)
    scores = [float(np.sqrt(np.minimum(one, limit).mean())) for one in squared]
    is_hopeless = [len(fitted) > 1 and score > _HOPELESS * min(scores) for score in scores]

    def tested(n: int) -> Trial:
        model, found = fitted[n]
        camera, own = found.fit.camera, squared[n][found.is_used]
        rms = float(np.sqrt(own.mean())) if len(own) else float("inf")
        chi2_sum = float(np.minimum(squared[n], limit).sum()) * REJECTED / limit
        bic = chi2_sum + len(model.params) * float(np.log(2 * len(squared[n])))
        trial = Trial(model, found.fit, rms, found.worst_px, bic)
        if is_hopeless[n]:
            return replace(trial, reason=f"its residuals are {scores[n] / min(scores):.1f} times the best's")
        if len(fitted) > 1 and not covers_picture(trial.fit):
            return replace(trial, reason="it has no ray for a part of the picture")
        if not trial.worst_px <= _OPEN_SHARE * np.hypot(camera.width, camera.height):
            reason = f"the views leave it open: sigmas of up to {trial.worst_px:.3g} px in the picture"
            return replace(trial, reason=reason)
        return replace(trial, held_out=hold_out(trial, views, found.is_used, limit))

    with ThreadPoolExecutor(threads) as pool:
        trials = list(pool.map(tested, range(len(fitted))))
    return _chosen_first(trials)


def _squared(residuals: Array) -> Array:
    """(N,) squared lengths; infinite where the lens does not look."""
    squared = (residuals**2).sum(1)
    return np.where(np.isfinite(squared), squared, np.inf)


def covers_picture(fit: Fit) -> bool:
    """Whether the lens has a ray for every pixel along the border of the picture, or for none but a disk."""
    camera = fit.camera
    steps = np.linspace(0.0, 1.0, 9)
    u, v = np.meshgrid(steps * camera.width, steps * camera.height)
    rays = pixels_to_rays(camera, np.stack([u, v], -1).reshape(-1, 2))
    is_known = np.isfinite(rays).all(1)
    # corners beyond the circle of a fisheye lens are no part of its picture
    return bool(is_known.all()) or (camera.is_wide and bool(is_known.mean() > 0.5))


def hold_out(trial: Trial, views: Sequence[TargetView], is_used: Bools, limit: float) -> Array:
    """(V,) mean squared residual of all points of each view, each at most ``limit``, under the parameters that fit the
    others best; parameters and the pose of a view follow from the points that the model takes for good."""
    num, ptr = len(views), observations_of(views).ptr
    num_folds = min(_FOLDS, num)
    errors = np.full(num, limit)
    for fold in range(num_folds):
        is_out = np.arange(num) % num_folds == fold
        trained = _refined(trial.fit, views, is_used, ptr, ~is_out)
        held = replace(trial.fit, camera=trained.camera, bend=trained.bend)
        for v in np.flatnonzero(is_out):
            obs, start = _of(held, views, is_used, ptr, np.arange(num) == v)
            found = residuals_of(refine(start, obs, hold_camera=True), obs)
            errors[v] = float(np.minimum(_squared(found), limit).mean())
    return errors


def _refined(fit: Fit, views: Sequence[TargetView], is_used: Bools, ptr: NDArray[np.int64], chosen: Bools) -> Fit:
    obs, start = _of(fit, views, is_used, ptr, chosen)
    return refine(start, obs)


def _of(
    fit: Fit, views: Sequence[TargetView], is_used: Bools, ptr: NDArray[np.int64], chosen: Bools
) -> tuple[Observations, Fit]:
    """The observations of some of the views, and the fit with their poses."""
    where = np.flatnonzero(chosen).tolist()
    obs = observations_of([views[v] for v in where])
    weight = np.concatenate([is_used[ptr[v] : ptr[v + 1]] for v in where]).astype(np.float64)
    return obs._replace(weight=weight), replace(fit, cam_from_target=fit.cam_from_target[where], bend=np.zeros(0))


def _chosen_first(trials: list[Trial]) -> list[Trial]:
    known = [trial for trial in trials if trial.held_out is not None]
    if not known:
        return sorted(trials, key=lambda trial: trial.rms_px)
    best = min(known, key=lambda trial: trial.held_out_px)
    worse = [_standard_errors(trial, best) for trial in known]
    limit = _limit(len(known), len(best.held_out) if best.held_out is not None else 0)
    likely = [trial for trial, errors in zip(known, worse, strict=True) if errors <= limit]
    chosen = min(likely, key=lambda trial: (trial.bic, len(trial.model.params)))
    simpler = [
        trial for trial in likely
        if len(trial.model.params) < len(chosen.model.params) and trial.held_out_px <= chosen.held_out_px
        and trial.bic <= chosen.bic + _STRONG_BIC
    ]  # fmt: skip
    chosen = min(simpler, key=lambda trial: trial.bic, default=chosen)
    why = "the best on views held out"
    if chosen is not best:
        why = f"no worse than {best.model.name} on views held out, and the best by all views and number of parameters"
    told = [replace(chosen, reason=why)]
    for trial, errors in zip(known, worse, strict=True):
        if trial is not chosen:
            reason = f"worse on views held out, by {errors:.1f} standard errors"
            if errors <= limit:
                more = len(trial.model.params) > len(chosen.model.params)
                does = "has parameters that its residuals do not need" if more else "leaves residuals"
                reason = f"{does} (BIC {trial.bic - chosen.bic:+.0f})"
            is_rival = errors <= limit and trial.bic <= chosen.bic + _STRONG_BIC
            told.append(replace(trial, reason=reason, is_rival=is_rival))
    told[1:] = sorted(told[1:], key=lambda trial: (trial.held_out_px, trial.rms_px))
    return told + sorted((trial for trial in trials if trial.held_out is None), key=lambda trial: trial.rms_px)


def _limit(num_models: int, num_views: int) -> float:
    """Standard errors by which a model has to be worse than the best on views held out to be none that may be right."""
    return float(student.isf(_EXCLUDED / max(num_models - 1, 1), max(num_views - 1, 1)))


def _standard_errors(trial: Trial, best: Trial) -> float:
    """By how many standard errors of the differences a model is worse than the best on views held out."""
    assert trial.held_out is not None
    assert best.held_out is not None
    worse = trial.held_out - best.held_out
    error = float(worse.std(ddof=1)) / np.sqrt(len(worse)) if len(worse) > 1 else 0.0
    return float(worse.mean()) / error if error > 0 else (np.inf if worse.mean() > 0 else 0.0)
