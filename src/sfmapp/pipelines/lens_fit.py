"""A lens from the reconstruction of a few frames, and how far it can be trusted.

A reconstruction that grew with a wrong focal length has bent to it, and its adjustment creeps back through a flat
valley in which what it has bent wrongly looks like noise. Here the lens is fitted again with the noise judged anew in
every round, until it rests. Errors of matches are no independent noise, so the standard deviations are not only those
of the adjustment: fits of every second frame, and of both ends of the row, must agree within them, or widen them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import estimate_covariances
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES, kind_of, plain_params
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.report.model import LensEvidence
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The prior of a lens that nobody knows: from a wide action camera's distortion to none, and a centre that phones and
# cars have within two per cent of the longer side. The focal length has none.
_DISTORTION_SIGMA, _CENTER_SHARE = 0.3, 0.02
_ROUNDS, _RESTS = 25, 2e-4  # until the focal length changes by less than that share
# An observation counts while it lies within so many sigmas, or pixels: real corners are not found better.
_LIMIT_SIGMAS, _LIMIT_PX, _MIN_SIGMA_PX = 5.0, 0.2, 0.02
# A distortion counts from so many of its standard deviations on; it is zero below.
_MIN_DISTORTION_SIGMAS = 5.0
# Least frames of a part; and the least relative standard deviation: of rendered sequences whose parts agreed
# to a tenth of that, the worst was off by 0.4 %.
_MIN_PART, _FLOOR = 5, 2.5e-3


@dataclass(frozen=True)
class LensFit:
    """A camera and how well it is known.

    Attributes:
        camera: the fitted one. sigma: standard deviations of its parameters by name, those held left out.
        spread: how many times its own standard deviations the focal lengths of parts differ from the whole.
        evidence: for the report.
    """

    camera: Camera
    sigma: dict[str, float]
    spread: float
    evidence: LensEvidence

    @property
    def focal_sigma_relative(self) -> float:
        """Of the focal length; the larger, where there are two."""
        return max(
            (value / self.camera.focal for name, value in self.sigma.items() if name in ("f", "fx", "fy")),
            default=np.inf,
        )


@dataclass(frozen=True)
class _Fit:
    """Parameters after a fit, standard deviations (P,) of independent noise (0 where held), and if it came to rest."""

    params: Array
    sigma: Array
    is_at_rest: bool


def fit_lens(model: Reconstruction) -> LensFit:
    """Fit the one camera of a model (which is not changed)."""
    camera = model.cameras[0]
    fit = _with_parts(model, camera, True)
    names = PARAM_NAMES[camera.model]
    bends = [n for n, name in enumerate(names) if kind_of(name) == "distortion"]
    plain = _flat(camera).params
    clear = [abs(fit.whole.params[n] - plain[n]) > _MIN_DISTORTION_SIGMAS * fit.sigma[n] for n in bends]
    distortion = {names[n]: float(fit.whole.params[n]) for n in bends}
    if bends and not any(clear):
        free = _focal(camera, fit.whole.params)
        fit = _with_parts(model, _flat(camera), False)
        # a distortion too small to be clear may still be there: what it would change is part of the uncertainty
        is_focal = np.array([kind_of(name) == "focal" for name in names])
        fit.sigma[is_focal] = np.hypot(fit.sigma[is_focal], _focal(camera, fit.whole.params) - free)
    evidence = LensEvidence(
        distortion=distortion, is_at_rest=fit.whole.is_at_rest, spread=fit.spread, has_distortion=any(clear),
        parts=[float(_focal(camera, part.params)) for part in fit.parts],
        independent_sigma=float(fit.whole.sigma[0]),
    )  # fmt: skip
    found = replace(camera, params=fit.whole.params)
    sigma = {name: float(value) for name, value in zip(names, fit.sigma, strict=True) if value > 0}
    return LensFit(found, sigma, fit.spread, evidence)


@dataclass(frozen=True)
class _Parted:
    whole: _Fit
    parts: list[_Fit]
    sigma: Array
    spread: float


def _with_parts(model: Reconstruction, camera: Camera, refine_distortion: bool) -> _Parted:
    """The fit of everything and of parts, and standard deviations that cover what the parts differ by."""
    whole = _settle(model, camera, refine_distortion, model.obs_is_inlier)
    found = replace(camera, params=whole.params)
    registered = np.flatnonzero(model.is_registered)
    many = max(_MIN_PART, round(0.6 * len(registered)))
    parts = []
    for chosen in (registered[::2], registered[1::2], registered[:many], registered[-many:]):
        if len(chosen) >= _MIN_PART:
            # from where the reconstruction stood: a part that begins where the whole has ended stays there
            part = model.copy()
            part.cam_from_world[np.setdiff1d(registered, chosen)] = np.nan
            is_in = np.isin(model.tracks.obs_image_idx, chosen)
            part.obs_is_inlier &= is_in
            parts.append(_settle(part, found, refine_distortion, model.obs_is_inlier & is_in))
    change = np.array([_focal(camera, p.params) - _focal(camera, whole.params) for p in parts])
    own = np.array([p.sigma[0] for p in parts])
    # a point next to infinity can spoil the covariance of a part: half of the frames know half as much
    own = np.where(np.isfinite(own), own, np.sqrt(2.0) * whole.sigma[0])
    known = np.isfinite(change) & np.isfinite(own) & (own > 0)
    # two parts and more say how much more than independent noise there is; fewer say nothing at all
    spread = np.inf
    if known.sum() >= 2 and whole.sigma[0] > 0:
        apart = 1.4826 * np.median(np.abs(change[known]))  # where parts are weak, their own sigmas excuse too much
        spread = float(max(np.sqrt(np.mean((change[known] / own[known]) ** 2)), apart / whole.sigma[0]))
    sigma = np.where(whole.sigma > 0, np.maximum(whole.sigma, 1e-300) * max(1.0, spread), 0.0)
    is_focal = np.array([kind_of(name) == "focal" for name in PARAM_NAMES[camera.model]])
    sigma[is_focal] = np.hypot(sigma[is_focal], _FLOOR * _focal(camera, whole.params))
    return _Parted(whole, parts, sigma if whole.is_at_rest else sigma * 3.0, spread)


def _settle(model: Reconstruction, camera: Camera, refine_distortion: bool, candidates: Mask) -> _Fit:
    """Adjust a copy, in which candidates (N,) may agree or not, until the focal length rests."""
    model = model.copy()
    model.cameras = [replace(camera, is_fixed=False)]
    _classify(model, candidates)
    prior, is_at_rest = _prior(camera), False
    for _ in range(_ROUNDS):
        before = model.cameras[0].focal
        sigma_px = max(residual_scale_px(model), _MIN_SIGMA_PX)
        if not np.isfinite(sigma_px):
            break
        adjust_bundle(model, _options(camera, refine_distortion, sigma_px), prior_cameras=[prior])
        _classify(model, candidates)
        is_at_rest = abs(model.cameras[0].focal / before - 1) < _RESTS
        if is_at_rest:
            break
    options = replace(_options(camera, refine_distortion, 1.0), loss="trivial")
    sigma = np.full(len(camera.params), np.inf)
    if model.obs_is_inlier.any():
        found = estimate_covariances(model, options, prior_cameras=[prior])
        if found.is_determined:
            sigma = np.zeros(len(camera.params))
            sigma[found.free_params[0]] = np.sqrt(np.diag(found.intrinsics[0]))
    return _Fit(model.cameras[0].params.copy(), sigma, is_at_rest)


def _options(camera: Camera, refine_distortion: bool, sigma_px: float) -> AdjustOptions:
    """The adjustment counts a residual of one pixel as one sigma; priors are handed over in that unit."""
    return AdjustOptions(
        loss="cauchy", loss_scale_px=2 * sigma_px, max_iterations=60, relative_cost_tolerance=1e-6,
        initial_damping=1e-6, refine_distortion=refine_distortion, distortion_sigma=_DISTORTION_SIGMA / sigma_px,
        refine_principal_point=True,
        principal_point_sigma_px=_CENTER_SHARE * max(camera.width, camera.height) / sigma_px,
    )  # fmt: skip


def _prior(camera: Camera) -> Camera:
    """The middle of the picture, no distortion, any focal length."""
    flat = _flat(camera)
    names = PARAM_NAMES[camera.model]
    middle = {"cx": 0.5 * camera.width, "cy": 0.5 * camera.height}
    params = np.array([middle.get(name, value) for name, value in zip(names, flat.params, strict=True)])
    return replace(flat, params=params, focal_sigma=None)


def _flat(camera: Camera) -> Camera:
    """The same camera without distortion."""
    bends = np.array([kind_of(name) == "distortion" for name in PARAM_NAMES[camera.model]])
    plain = plain_params(camera.model, camera.width, camera.height, camera.focal)
    return replace(camera, params=np.where(bends, plain, camera.params))


def _focal(camera: Camera, params: Array) -> float:
    return replace(camera, params=params).focal


def _classify(model: Reconstruction, candidates: Mask) -> None:
    """Which of the candidates agree with the model, in place; points keep their places, to be asked again."""
    errors = model.errors_px()
    limit = max(_LIMIT_SIGMAS * residual_scale_px(model), _LIMIT_PX)
    agrees = candidates & (errors <= limit)  # NaN does not
    track = model.tracks.obs_track_idx
    count = np.bincount(track[agrees], minlength=len(model.point_xyz))
    model.obs_is_inlier[:] = agrees & (count[track] >= 2)
