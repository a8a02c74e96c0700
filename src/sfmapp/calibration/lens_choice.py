"""Which lens model a camera has, by views that its parameters were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import Fit, TargetView, observations_of, refine, residuals_of
from sfmapp.calibration.kernels import Observations
from sfmapp.camera.camera import pixels_to_rays
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# views are held out in so many groups, fewer where there are fewer views
_FOLDS = 5
# a model whose residuals are this many times the best's is not looked at further
_HOPELESS = 3.0
# nor one whose worst sigma in the picture is this many times the least of any, and this share of its diagonal: it fits
# where there were boards, and is anything elsewhere
_OPEN, _OPEN_SHARE = 3.0, 1.0 / 400.0

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
        held_out: (V,) mean squared residual of each view while it was held out, pixels squared; None where it was not
            worth it.
        reason: why it was not chosen, or that it was.
    """

    model: CameraModel
    fit: Fit
    rms_px: float
    worst_px: float
    held_out: Array | None = None
    reason: str = ""

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

    The model with the fewest parameters is taken that is no worse than the best by more than one standard error of
    the differences, view by view (Breiman et al., "Classification and regression trees", 1984, the rule of one
    standard error).

    Args:
        threads: how many are fitted at a time; the result does not depend on it.
    """
    fitted: list[tuple[Trial, Bools]] = []
    with ThreadPoolExecutor(threads) as pool:
        candidates = list(pool.map(fit_model, models))
    for model, found in zip(models, candidates, strict=True):
        r = residuals_of(found.fit, observations_of(views))[found.is_used]
        rms = float(np.sqrt((r**2).sum(1).mean())) if len(r) and np.isfinite(r).all() else float("inf")
        fitted.append((Trial(model, found.fit, rms, found.worst_px), found.is_used))
    best_rms = min(trial.rms_px for trial, _ in fitted)
    fits = [trial for trial, _ in fitted if trial.rms_px <= _HOPELESS * best_rms]
    open_px = _OPEN * min((trial.worst_px for trial in fits), default=np.inf)

    def tested(entry: tuple[Trial, Bools]) -> Trial:
        trial, is_used = entry
        camera = trial.fit.camera
        if len(fitted) > 1 and not trial.rms_px <= _HOPELESS * best_rms:
            return replace(trial, reason=f"its residuals are {trial.rms_px / best_rms:.1f} times the best's")
        if len(fitted) > 1 and not covers_picture(trial.fit):
            return replace(trial, reason="it has no ray for a part of the picture")
        if not np.isfinite(trial.worst_px) or not trial.worst_px <= max(
            open_px, _OPEN_SHARE * np.hypot(camera.width, camera.height)
        ):
            reason = f"the views leave it open: sigmas of up to {trial.worst_px:.3g} px in the picture"
            return replace(trial, reason=reason)
        return replace(trial, held_out=hold_out(trial, views, is_used))

    with ThreadPoolExecutor(threads) as pool:
        trials = list(pool.map(tested, fitted))
    return _chosen_first(trials)


def covers_picture(fit: Fit) -> bool:
    """Whether the lens has a ray for every pixel along the border of the picture, or for none but a disk."""
    camera = fit.camera
    steps = np.linspace(0.0, 1.0, 9)
    u, v = np.meshgrid(steps * camera.width, steps * camera.height)
    rays = pixels_to_rays(camera, np.stack([u, v], -1).reshape(-1, 2))
    is_known = np.isfinite(rays).all(1)
    # corners beyond the circle of a fisheye lens are no part of its picture
    return bool(is_known.all()) or (camera.is_wide and bool(is_known.mean() > 0.5))


def hold_out(trial: Trial, views: Sequence[TargetView], is_used: Bools) -> Array:
    """(V,) mean squared residual of each view under the parameters that fit the others best."""
    num, ptr = len(views), observations_of(views).ptr
    num_folds = min(_FOLDS, num)
    errors = np.full(num, np.inf)
    for fold in range(num_folds):
        is_out = np.arange(num) % num_folds == fold
        trained = _refined(trial.fit, views, is_used, ptr, ~is_out)
        held = replace(trial.fit, camera=trained.camera, bend=trained.bend)
        for v in np.flatnonzero(is_out):
            own = np.arange(num) == v
            obs, start = _of(held, views, is_used, ptr, own)
            found = residuals_of(refine(start, obs, hold_camera=True), obs)[obs.weight > 0]
            errors[v] = float((found**2).sum(1).mean()) if np.isfinite(found).all() and len(found) else np.inf
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
    known = [trial for trial in trials if trial.held_out is not None and np.isfinite(trial.held_out).all()]
    if not known:
        return sorted(trials, key=lambda trial: trial.rms_px)
    best = min(known, key=lambda trial: trial.held_out_px)
    assert best.held_out is not None
    chosen = best
    for trial in sorted(known, key=lambda trial: (len(trial.model.params), trial.held_out_px)):
        assert trial.held_out is not None
        worse = trial.held_out - best.held_out
        error = float(worse.std(ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
        if float(worse.mean()) <= error:
            chosen = trial
            break
    why = "the best on views held out"
    if chosen is not best:
        why = f"as good as {best.model.name} on views held out, within one standard error, with fewer parameters"
    others = [trial for trial in trials if trial is not chosen]
    others.sort(key=lambda trial: (trial.held_out is None, trial.held_out_px, trial.rms_px))
    return [replace(chosen, reason=why), *others]
