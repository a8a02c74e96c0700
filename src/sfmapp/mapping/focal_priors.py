"""Whether the photographs believe the focal lengths that they came with, and whether they can tell.

Bundle adjustment finds the nearest minimum, and mapping registers what fits the cameras as they were given. A focal
length that is wrong by a factor therefore can end in a model that is bent and does not know: its observations are those
that survived. So where a map has left a prior far behind, mapping begins anew without it, and the verified matches tell
which of the two models is right. A flat scene looked at from above, on the other hand, leaves the focal length open:
there it is the adjusted value that is not believed, and the prior has the say that it is due.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.images.exif import DEFAULT_FOCAL, DEFAULT_FOCAL_SIGMA
from sfmapp.mapping import structure
from sfmapp.mapping.mapper import STAGE, Mapper
from sfmapp.mapping.register import Registration
from sfmapp.mapping.report import (
    AgreeingObservations,
    FocalEvidence,
    FocalReport,
    PartsReport,
    StartReport,
    Uncertainty,
)
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A prior is refuted where the refined focal length has left it by so many standard deviations of both: at five it was
# wrong or its sigma was. It is doubted at two where photographs were left out, where a good part of them was, and where
# the map does not tell the focal length, all of which a wrong one causes.
REFUTED_SIGMAS, DOUBTFUL_SIGMAS, GOOD_PART = 5.0, 2.0, 0.9
# In place of a map with a refuted prior comes one that explains as much, to the share of observations that come and go
# at the threshold between two equally good models (under 1 % over the shared sets); in place of another map one that
# explains clearly more.
SAME_SUPPORT, MORE_SUPPORT = 0.98, 1.05
# Residuals below so many robust standard deviations agree with a model.
AGREE_SIGMAS = 3.0
# Focal lengths miss the ground truth by more than independent errors of keypoints explain: by 0 to 7 times that on the
# shared sets, by up to 10 on rendered flat blocks with a lens that the model does not hold. What a lens with more terms
# makes of them comes on top. The photographs determine a focal length if their sigma by this reckoning is half of the
# prior's: the prior then has a fifth of the say.
FOCAL_INFLATION, DETERMINED_SHARE = 5.0, 0.5
# Below this relative sigma from independent errors no lens term was seen to move a focal length by a per cent, and the
# fit of such a lens is saved.
SURE_FOCAL = 1e-3


@dataclass(frozen=True)
class Mapped:
    """What mapping made of the cameras that it began with: its models, the largest first, and how they came about."""

    cameras: list[Camera]
    models: list[Reconstruction]
    initial_reports: list[StartReport]
    focal_report: FocalReport
    attempts: dict[int, Registration]
    mapper_of: Callable[..., Mapper]
    apart: list[str]
    """Of each model why it is not one with another."""
    enough: float
    """Share of the matches that has to agree with a model of these pairs, so that no other start is tried."""
    parts: PartsReport = field(default_factory=PartsReport)
    """Those that it was mapped in, if any."""
    without_prior: tuple[int, ...] = ()
    """Cameras that it began with as unknown although a focal length was given."""


MapFrom = Callable[[list[Camera]], Mapped]


def as_unknown(camera: Camera) -> Camera:
    """The camera as if nothing were known of its focal length: free, with the prior of photographs without EXIF."""
    focal = DEFAULT_FOCAL * max(camera.width, camera.height)
    sigma = DEFAULT_FOCAL_SIGMA * focal
    return replace(
        camera.with_focal(focal), focal_sigma=sigma, focal_source="default", is_fixed=False, prior_covariance=None
    )


def settle_focal_lengths(mapped: Mapped, map_from: MapFrom, events: Events) -> Mapped:
    """Map again without the focal lengths that a map has left far behind, and keep what explains more matches.

    Args:
        mapped: made of the given cameras.
        map_from: maps from other first cameras; those that are unknown get theirs from the pairs.
        events: warned of every prior that is not believed any more.

    Returns:
        The better of both, with the decision in its report.
    """
    doubted = _doubted_cameras(mapped)
    if not doubted.any():
        return mapped
    events.decided(STAGE, f"the focal lengths of {int(doubted.sum())} camera(s) are doubtful: mapping without them")
    again = map_from([as_unknown(c) if d else c for c, d in zip(mapped.cameras, doubted, strict=True)])
    again = replace(again, without_prior=tuple(np.flatnonzero(doubted).tolist()))
    support = _support((mapped.models, again.models))
    wanted = SAME_SUPPORT if (_judge_priors(mapped)[0] > REFUTED_SIGMAS).any() else MORE_SUPPORT
    better = again if support[1] >= wanted * support[0] and support[1] > 0 else mapped
    report = replace(
        better.focal_report,
        doubted_cameras=list(again.without_prior),
        agreeing_observations=AgreeingObservations(as_given=support[0], as_unknown=support[1]),
        kept="as_unknown" if better is again else "as_given",
    )
    refuted = doubted & (_judge_priors(replace(better, cameras=mapped.cameras))[0] > REFUTED_SIGMAS)
    if refuted.any():
        events.warned(STAGE, _refutation(mapped.cameras, better, np.flatnonzero(refuted)))
    return replace(better, focal_report=report)


def _doubted_cameras(mapped: Mapped) -> Mask:
    """(C,) bool: cameras whose focal length was known and has to be asked for anew.

    Where that is most of those whose focal length came from one source, it is all of them: photographs that a wrong one
    kept out of the map cannot tell.
    """
    known = np.array([c.focal_source != "default" and not c.is_fixed for c in mapped.cameras], bool)
    if not mapped.models or not known.any():
        return known
    largest = mapped.models[0].is_registered
    off, is_open = _judge_priors(mapped)
    doubted = off > (REFUTED_SIGMAS if len(mapped.models) == 1 and largest.all() else DOUBTFUL_SIGMAS)
    doubted |= is_open | (largest.mean() < GOOD_PART)
    doubted &= known
    for source in {c.focal_source for c, d in zip(mapped.cameras, doubted, strict=True) if d}:
        alike = known & np.array([c.focal_source == source for c in mapped.cameras], bool)
        if 2 * (alike & doubted).sum() > (alike & (off > 0)).sum():
            doubted |= alike
    return doubted


def _judge_priors(mapped: Mapped) -> tuple[Array, Mask]:
    """(C,) how far focal lengths of models have left those of the cameras, in sigmas of the difference, 0 if unused;
    (C,) bool whether the photographs leave them open.

    The photographs' own sigma counts too: what a flat scene leaves open goes anywhere and refutes nothing.
    """
    cameras = mapped.cameras
    off, is_open = np.zeros(len(cameras)), np.zeros(len(cameras), bool)
    for model in mapped.models:
        sigmas, _ = focal_sigmas(mapped, model, mapped.mapper_of(model).uncertainty())
        for c in np.unique(model.image_camera_idx[model.is_registered]):
            prior, found = cameras[c].focal_sigma, sigmas.get(int(c))
            if prior:
                own = found.data_px if found is not None else 0.0
                off[c] = max(off[c], abs(model.cameras[c].focal - cameras[c].focal) / np.hypot(prior, own))
                is_open[c] |= found is not None and not found.is_determined
    return off, is_open


def _support(results: Sequence[list[Reconstruction]]) -> list[int]:
    """Observations that agree with each of several results, by the tolerance of the most precise one."""
    scales = [structure.residual_scale_px(models[0]) for models in results if models]
    finite = [scale for scale in scales if np.isfinite(scale)]
    limit = AGREE_SIGMAS * min(finite, default=0.0)
    counts = []
    for models in results:
        agrees = np.zeros(models[0].tracks.num_observations if models else 0, bool)
        for model in models:
            agrees |= model.obs_is_inlier & (model.errors_px() <= limit)
        counts.append(int(agrees.sum()))
    return counts


def _refutation(cameras: Sequence[Camera], mapped: Mapped, refuted: NDArray[np.int64]) -> str:
    """What the photographs say against the focal lengths of cameras, in the words of the first of them."""
    first = cameras[refuted[0]]
    found = next(
        m.cameras[refuted[0]].focal for m in mapped.models if refuted[0] in m.image_camera_idx[m.is_registered]
    )
    of = f"camera {refuted[0]}" + (f" and {len(refuted) - 1} more" if len(refuted) > 1 else "")
    source = "from EXIF" if first.focal_source.startswith("exif") else "that was given"
    return (
        f"the focal length {source} of {of}, {first.focal:.0f} px, is wrong by the photographs, which say "
        f"{found:.0f} px" + ("; it was left out of account" if mapped.without_prior else "")
    )


@dataclass(frozen=True)
class FocalSigmas:
    """How well the photographs alone tell a focal length, in pixels.

    Attributes:
        independent_px: from independent errors of the keypoints.
        data_px: with what correlated errors and an unmodelled lens may add.
        prior_px: of the prior.
        alone_px: the focal length without the prior, asked for where there was doubt.
        known_px: the prior.
    """

    independent_px: float
    data_px: float
    prior_px: float
    alone_px: float | None = None
    known_px: float = 0.0

    @property
    def is_determined(self) -> bool:
        """The photographs tell more than was known before; False for what is not a number."""
        return self.data_px <= DETERMINED_SHARE * self.prior_px

    @property
    def posterior_px(self) -> float:
        """Of both together."""
        return float((self.data_px**-2 + self.prior_px**-2) ** -0.5)

    @property
    def tension(self) -> float:
        """Between photographs and prior, in standard deviations of both; 0 where it was not asked for."""
        if self.alone_px is None or not np.isfinite(self.data_px):
            return 0.0
        return float(abs(self.alone_px - self.known_px) / np.hypot(self.data_px, self.prior_px))

    @property
    def widening(self) -> float:
        """By which standard deviations grow where two values of one thing do not agree (the ratio of Birge, Phys. Rev.
        40, 1932: residuals come out as they should)."""
        return max(1.0, self.tension)

    def report(self) -> FocalEvidence:
        """For the report; an infinite sigma is None."""
        own = self.data_px if np.isfinite(self.data_px) else None
        return FocalEvidence(
            data_sigma_px=own, prior_sigma_px=self.prior_px, is_determined=self.is_determined,
            photographs_px=self.alone_px, tension=self.tension if self.alone_px is not None else None,
        )  # fmt: skip


def focal_sigmas(
    mapped: Mapped, model: Reconstruction, uncertainty: Uncertainty
) -> tuple[dict[int, FocalSigmas], Reconstruction | None]:
    """By camera, for free focal lengths with a prior; empty where the uncertainty is not known. Where there was doubt,
    also the model with a lens of more terms.

    A prior adds its information to the marginal one of the data (Schur complement), from which it is taken off again.
    """
    sigmas = {}
    for entry in uncertainty.cameras or ():
        c, prior = entry.camera, mapped.cameras[entry.camera].focal_sigma
        found = [sigma for name, sigma in entry.sigma.items() if name[0] == "f"]
        if not found or not prior:
            continue
        information = 1.0 / np.mean(np.square(found)) - 1.0 / prior**2
        independent = information**-0.5 if information > 1e-6 / prior**2 else np.inf
        sigmas[c] = FocalSigmas(float(independent), float(FOCAL_INFLATION * independent), float(prior))
    is_sure = all(s.independent_px <= SURE_FOCAL * model.cameras[c].focal for c, s in sigmas.items())
    known = [c for c, s in sigmas.items() if mapped.cameras[c].focal_source != "default"]
    # a prior that is surer than the photographs, as a calibration's, hides what these say
    if is_sure and all(sigmas[c].is_determined for c in known):
        return sigmas, None
    richer = None if is_sure else _with_richer_lens(mapped.mapper_of(model))
    alone = _without_priors(mapped.mapper_of(model), known) if known else model
    for c, s in sigmas.items():
        if richer is not None:
            # what more terms of the lens do, not how far a prior has pulled the focal length meanwhile
            off = min(abs(richer.cameras[c].focal - plain.cameras[c].focal) for plain in (model, alone))
            sigmas[c] = replace(s, data_px=float(np.hypot(s.data_px, off)))
        if c in known:
            sigmas[c] = replace(sigmas[c], alone_px=alone.cameras[c].focal, known_px=mapped.cameras[c].focal)
    return sigmas, richer


def _without_priors(mapper: Mapper, cameras: Sequence[int]) -> Reconstruction:
    """The model adjusted without what was known of the focal lengths of some cameras."""
    trial, priors = mapper.reconstruction.copy(), list(mapper.prior_cameras)
    for c in cameras:
        priors[c] = replace(priors[c], focal_sigma=None)
    options = replace(mapper.robust(mapper.adjust_options), initial_damping=1e-7, relative_cost_tolerance=1e-7)
    adjust_bundle(trial, options, prior_cameras=priors)
    return trial


def contradiction_of_priors(
    model: Reconstruction, open_: Mapping[int, FocalSigmas], spread: float, turn: float
) -> list[Contradiction]:
    """Focal lengths that photographs and what was known before put apart, where neither overrules the other: nothing,
    or one contradiction of the worst.

    Args:
        open_: as of :func:`lean_on_priors`.
        spread, turn: standard deviations that their disagreement adds to poses, as a share of their spread, in degrees.
    """
    apart = {c: s for c, s in open_.items() if s.tension > DOUBTFUL_SIGMAS}
    if not apart:
        return []
    c, worst = max(apart.items(), key=lambda item: item[1].tension)
    source = "EXIF has" if model.cameras[c].focal_source.startswith("exif") else "what was given is"
    more = f" (and of {len(apart) - 1} more)" if len(apart) > 1 else ""
    return [
        Contradiction(
            "focal length",
            f"the photographs put the focal length of camera {c}{more} at {worst.alone_px:.0f} +- {worst.data_px:.0f} "
            f"px, {source} {worst.known_px:.0f} +- {worst.prior_px:.0f} px: {worst.tension:.1f} sigmas apart",
            "calibrate the camera, or add photographs from nearer by and to other sides of things",
            {
                "photographs_px": worst.alone_px or 0.0, "photographs_sigma_px": worst.data_px,
                "known_px": worst.known_px, "known_sigma_px": worst.prior_px, "tension": worst.tension,
                "limit": DOUBTFUL_SIGMAS,
            },
            rotation_sigma_deg=turn, position_sigma_share=spread,
        )
    ]  # fmt: skip


def _with_richer_lens(mapper: Mapper) -> Reconstruction:
    """The model adjusted with a second radial term, where it has at most one, and free principal points."""
    trial, given = mapper.reconstruction.copy(), mapper.reconstruction.cameras
    trial.cameras = [_radial(camera) for camera in given]
    is_free = np.array([not camera.is_fixed for camera in given], bool)
    options = replace(mapper.adjust_options, initial_damping=1e-7, relative_cost_tolerance=1e-7)
    # priors hold the principal points, not the focal lengths
    priors = [replace(camera, focal_sigma=None) for camera in trial.cameras]
    adjust_bundle(
        trial, mapper.with_free_centers(options, is_free), varying=Varying(cameras=is_free), prior_cameras=priors
    )
    return trial


def _radial(camera: Camera) -> Camera:
    if camera.model not in (CameraModel.SIMPLE_PINHOLE, CameraModel.SIMPLE_RADIAL):
        return camera
    params = np.append(camera.params, np.zeros(5 - len(camera.params)))
    return replace(camera, model=CameraModel.RADIAL, params=params)


def lean_on_priors(mapped: Mapped, model: Reconstruction, sigmas: dict[int, FocalSigmas]) -> dict[int, FocalSigmas]:
    """Adjust a model in place with the say that focal priors are due, where the photographs do not tell; for which."""
    open_ = {c: s for c, s in sigmas.items() if not s.is_determined and mapped.cameras[c].focal_source != "default"}
    if not open_:
        return open_
    mapper = mapped.mapper_of(model)
    noise = structure.residual_scale_px(model, 0.1)  # the adjustment counts it as one pixel
    priors = list(mapped.cameras)
    for c, s in open_.items():
        # where the data's information is as good as none, any weight that counts is enough
        over = s.data_px / s.independent_px if np.isfinite(s.independent_px) else FOCAL_INFLATION
        priors[c] = replace(priors[c], focal_sigma=s.prior_px / (noise * over))
    options = replace(mapper.adjust_options.robust(noise), initial_damping=1e-7, relative_cost_tolerance=1e-7)
    adjust_bundle(model, options, prior_cameras=priors)
    return open_
