"""Whether the photographs agree with parameters of their cameras that were held.

A lens that is held where it is wrong bends the model, and its observations are those that survived. One question tells:
do the held parameters, once freed and fitted to half of the tracks, explain the other half far better?
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping import structure
from sfmapp.mapping.focal_priors import (
    FocalSigmas,
    MapFrom,
    Mapped,
    as_unknown,
    contradiction_of_priors,
    focal_sigmas,
    lean_on_priors,
)
from sfmapp.mapping.mapper import STAGE
from sfmapp.mapping.report import CameraSigmas, FocalEvidence, ImageSigmas, Uncertainty
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Parameters that were held contradict the photographs if freeing them lowers the median residual of tracks that they
# were not fitted to by a fifth: more than a third of the variance had nothing to do with noise. On the shared sets this
# is a focal length that is off by 1 to 2.5 %; right ones give 0.94 to 1. It must hold in nearly every photograph, since
# a wrong lens is wrong in all of them.
CLEAR_RATIO, CLEAR_IMAGES = 0.8, 0.9
# Photographs that were cut, each otherwise, are told by freeing every principal point: on the shared sets, cut to three
# quarters, that lowers the residual to 0.24 to 0.63 and finds offsets of 5 to 14 % of the longer side; whole ones give
# 0.85 to 1 and offsets of 1 %. The trial holds all photographs to about one lens; more tracks than these tell no more.
CUT_RATIO, CUT_OFFSET, CUT_TRACKS = 0.7, 0.03, 2000
CUT_CENTER_SIGMA, CUT_FOCAL_SIGMA, CUT_DISTORTION_SIGMA = 0.15, 0.1, 0.02
# Intrinsics of their own for every photograph fill the system of so many that the trial takes longer than mapping.
_MAX_CUT_IMAGES = 200
# Fewer tracks on either side do not tell.
MIN_TRACKS = 50


@dataclass(frozen=True)
class HeldOut:
    """What freeing parameters does to observations that they were not fitted to.

    Attributes:
        ratio: median residual with the parameters free over that with them held.
        improved_share: of the images, those whose median residual falls.
        freed: the model with the parameters free, adjusted to half of the tracks.
    """

    ratio: float
    improved_share: float
    freed: Reconstruction

    @property
    def is_clear(self) -> bool:
        """The photographs contradict what was held; False for a ratio that is not a number."""
        return self.ratio <= CLEAR_RATIO and self.improved_share >= CLEAR_IMAGES


def hold_out(
    model: Reconstruction,
    held: AdjustOptions,
    freed: Reconstruction,
    free: AdjustOptions,
    every: int = 2,
    held_images: NDArray[np.bool_] | None = None,
    is_worth_judging: Callable[[Reconstruction], bool] | None = None,
) -> HeldOut:
    """Adjust with parameters held and free to a share of the tracks, and judge both by as many others.

    Args:
        model: adjusted with the parameters held; not changed.
        freed: a copy of it whose cameras may change, with priors around their values; it is adjusted.
        held, free: options of the two adjustments.
        every: the share is one in so many.
        held_images: (I,) bool, whose poses are held in the one and free in the other; None: all are free in both.
        is_worth_judging: asked of ``freed`` when it is adjusted. Where it says no, the other adjustments are left out,
            and nothing was found; None: it always is.
    """
    number = np.arange(model.tracks.num_tracks) % every
    fit, judge = model.is_triangulated & (number == 0), model.is_triangulated & (number == every // 2)
    if min(fit.sum(), judge.sum()) < MIN_TRACKS:
        return HeldOut(1.0, 0.0, model)
    nothing = np.zeros(len(model.image_names), bool)
    priors, images = list(freed.cameras), None if held_images is None else ~held_images
    adjust_bundle(freed, free, varying=Varying(points=fit), prior_cameras=priors)
    if is_worth_judging is not None and not is_worth_judging(freed):
        return HeldOut(1.0, 0.0, freed)
    trial = model.copy()
    adjust_bundle(trial, held, varying=Varying(points=fit, images=images))
    lengths = []
    for each in (trial, freed):
        cameras = np.zeros(len(each.cameras), bool)
        adjust_bundle(each, held, varying=Varying(points=judge, images=nothing, cameras=cameras))
        lengths.append(each.errors_px())
    tracks = model.tracks
    # a point that two images see follows nearly any pose
    size = np.bincount(tracks.obs_track_idx[model.obs_is_inlier], minlength=tracks.num_tracks)
    used = model.obs_is_inlier & (judge & (size >= 3))[tracks.obs_track_idx]
    used &= np.isfinite(lengths[0]) & np.isfinite(lengths[1])
    if used.sum() < MIN_TRACKS:
        return HeldOut(1.0, 0.0, model)
    ratio = float(np.median(lengths[1][used]) / max(np.median(lengths[0][used]), 1e-9))
    return HeldOut(ratio, _improved_share(tracks.obs_image_idx[used], lengths[0][used], lengths[1][used]), freed)


def _improved_share(image_idx: NDArray[np.int32], before: Array, after: Array) -> float:
    images = [i for i in np.unique(image_idx) if (image_idx == i).sum() >= 10]
    improved = [np.median(after[image_idx == i]) < np.median(before[image_idx == i]) for i in images]
    return float(np.mean(improved)) if improved else 0.0


def check_intrinsics(
    mapped: Mapped, model: Reconstruction, map_from: MapFrom, events: Events
) -> tuple[Uncertainty, list[Contradiction]]:
    """What the photographs say of parameters that were held.

    Args:
        mapped: whose model it is.
        model: finished.
        map_from: maps from other first cameras.
        events: warned of contradictions.

    Returns:
        The uncertainty as of :meth:`Mapper.uncertainty`, with what the held parameters add to it, and the
        contradictions that stand.
    """
    uncertainty, contradictions = _with_open_focals(mapped, model)
    for apart in contradictions:
        events.warned(STAGE, apart.message)
    used = np.unique(model.image_camera_idx[model.is_registered])
    fixed = np.array([c in used and camera.is_fixed for c, camera in enumerate(model.cameras)], bool)
    if fixed.any():
        found, spread, turn = _held_against_free(mapped, model, fixed, map_from)
        if found.is_clear:
            contradictions.append(_given_intrinsics(model, np.flatnonzero(fixed), found, spread, turn))
            events.warned(STAGE, contradictions[-1].message)
        uncertainty = widened_uncertainty(uncertainty, model, spread, turn)
    elif (cut := _cut_photographs(mapped, model)) is not None:
        contradictions.append(cut)
        events.warned(STAGE, cut.message)
        uncertainty = widened_uncertainty(uncertainty, model, cut.position_sigma_share, cut.rotation_sigma_deg)
    return uncertainty, contradictions


def _with_open_focals(mapped: Mapped, model: Reconstruction) -> tuple[Uncertainty, list[Contradiction]]:
    """The uncertainty of a model whose focal lengths come to lie nearer their priors where nothing else tells them, and
    what speaks against these."""
    uncertainty = mapped.mapper_of(model).uncertainty()
    sigmas, richer = focal_sigmas(mapped, model, uncertainty)
    bend = difference(model, richer) if richer is not None else (0.0, 0.0)
    before = model.copy()
    open_ = lean_on_priors(mapped, model, sigmas)
    contradictions: list[Contradiction] = []
    if open_:
        uncertainty = mapped.mapper_of(model).uncertainty()
        spread, turn = difference(model, before)
        # the change of the focal length that moved the cameras so far, against its sigma
        moved = max(abs(model.cameras[c].focal - before.cameras[c].focal) / s.posterior_px for c, s in open_.items())
        widest = max(s.widening for s in open_.values())
        share = widest * min(1.0 / max(moved, 1e-3), 10.0)
        uncertainty = widened_uncertainty(uncertainty, model, share * spread, share * turn)
        contradictions = contradiction_of_priors(model, open_, share * spread, share * turn)
    if open_:  # a scene that does not tell the focal length does not tell a lens from a bend of the whole either
        uncertainty = widened_uncertainty(uncertainty, model, *bend)
    if uncertainty.cameras is None:
        return uncertainty, contradictions
    rows = [_with_evidence(e, mapped, sigmas, open_) for e in uncertainty.cameras]
    return replace(uncertainty, cameras=rows), contradictions


def _with_evidence(
    entry: CameraSigmas, mapped: Mapped, sigmas: Mapping[int, FocalSigmas], open_: Mapping[int, FocalSigmas]
) -> CameraSigmas:
    """A camera's parameters with what the photographs tell of its focal length."""
    c, sigma = entry.camera, dict(entry.sigma)
    if c in open_:
        sigma |= {name: open_[c].widening * open_[c].posterior_px for name in sigma if name[0] == "f"}
    evidence = sigmas[c].report() if c in sigmas else FocalEvidence()
    return replace(entry, sigma=sigma, focal=replace(evidence, is_prior_left_out=c in mapped.without_prior))


def _held_against_free(
    mapped: Mapped, model: Reconstruction, fixed: Mask, map_from: MapFrom
) -> tuple[HeldOut, float, float]:
    """What freeing the cameras that are fixed does to held-out tracks, and how far it moves the poses: a share of their
    spread and degrees. Where the photographs clearly want it, the free model is mapped from the start."""
    mapper = mapped.mapper_of(model)
    options = replace(mapper.adjust_options, initial_damping=1e-7, relative_cost_tolerance=1e-7)
    freed = model.copy()
    freed.cameras = [replace(c, is_fixed=False, focal_sigma=None) for c in model.cameras]
    found = hold_out(model, options, freed, mapper.with_free_centers(options, fixed))
    if found.is_clear:
        cameras = [as_unknown(c) if f else c for c, f in zip(mapped.cameras, fixed, strict=True)]
        found = replace(found, freed=_largest_overlap(model, [found.freed, *map_from(cameras).models]))
    return found, *difference(model, found.freed)


def difference(model: Reconstruction, other: Reconstruction) -> tuple[float, float]:
    """How far two models of the same photographs are apart: rms of their centres after a similarity, as a share of the
    rms distance of the centres from their middle, and rms angle in degrees; infinite if they cannot be compared."""
    common = model.is_registered & other.is_registered
    a, b = model.cam_from_world[common], other.cam_from_world[common]
    try:
        moved = similarity.transform_poses(similarity.align_poses(b, a).b_from_a, b)
    except ValueError:
        return np.inf, 180.0
    centers = rigid3.center(a)
    spread = np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean())
    distance = np.sqrt(((rigid3.center(moved) - centers) ** 2).sum(1).mean())
    angles = np.linalg.norm(rigid3.log_so3(rigid3.rotation_matrix(rigid3.compose(moved, rigid3.inverse(a)))), axis=1)
    return float(distance / spread), float(np.degrees(np.sqrt((angles**2).mean())))


def _cut_photographs(mapped: Mapped, model: Reconstruction) -> Contradiction | None:
    """What speaks against principal points in the middle, or in one place: photographs that were cut in many ways."""
    registered = model.registered_idx
    if not 4 <= len(registered) <= _MAX_CUT_IMAGES or mapped.mapper_of(model).adjust_options.backend != "schur":
        return None
    noise = max(structure.residual_scale_px(model), 0.1)  # the adjustment counts it as one pixel
    robust = AdjustOptions(loss="cauchy", loss_scale_px=2.0 * noise, max_iterations=30)
    freed = _one_lens_cut_differently(model, noise)
    size = max(max(camera.width, camera.height) for camera in freed.cameras)
    free = replace(
        robust, refine_principal_point=True, principal_point_sigma_px=CUT_CENTER_SIGMA * size / noise,
        distortion_sigma=CUT_DISTORTION_SIGMA / noise,
    )  # fmt: skip
    every = max(2, int(model.is_triangulated.sum()) // max(CUT_TRACKS, CUT_TRACKS // 20 * len(registered)))
    found = hold_out(
        model, robust, freed, free, every, is_worth_judging=lambda fitted: _center_offset(fitted) >= CUT_OFFSET
    )
    offset = _center_offset(freed)
    if not (found.ratio <= CUT_RATIO and found.improved_share >= CLEAR_IMAGES and offset >= CUT_OFFSET):
        return None
    spread, turn = difference(model, freed)
    # focal lengths of one lens that scatter tell of a model that is bent beyond what the trial can straighten
    scatter = float(np.std(np.log([model.cameras[model.image_camera_idx[i]].focal for i in registered])))
    return Contradiction(
        "cropped photographs",
        f"the photographs seem to have been cropped, each differently: with principal points {100 * offset:.0f} % of "
        f"the longer side off centre, held-out points agree {1.0 / max(found.ratio, 1e-9):.1f} times better",
        "give the photographs as the camera wrote them",
        {
            "held_out_residual_ratio": found.ratio,
            "limit": CUT_RATIO,
            "improved_images_share": found.improved_share,
            "center_offset_share": offset,
        },
        rotation_sigma_deg=turn,
        position_sigma_share=max(spread, min(scatter, 0.5)),
    )


def _one_lens_cut_differently(model: Reconstruction, noise: float) -> Reconstruction:
    """The model with a camera for each image: about one focal length, no distortion yet, centres in the middle."""
    freed = model.copy()
    freed.image_camera_idx = np.arange(len(model.image_names), dtype=np.int32)
    of_image = [model.cameras[c] for c in model.image_camera_idx]
    focal = float(np.median([of_image[i].focal for i in model.registered_idx]))
    freed.cameras = [
        replace(
            simple_camera(camera.model, camera.width, camera.height, focal, CUT_FOCAL_SIGMA * focal / noise),
            focal_source=camera.focal_source,
        )
        for camera in of_image
    ]
    return freed


def _center_offset(model: Reconstruction) -> float:
    """Median distance of the principal points of the registered images from the middle, as a share of the longer side;
    each image has a camera of its own."""
    cameras = [model.cameras[i] for i in model.registered_idx]
    off = [camera.k_matrix[:2, 2] - [camera.width / 2, camera.height / 2] for camera in cameras]
    return float(np.median([np.linalg.norm(d) / max(c.width, c.height) for d, c in zip(off, cameras, strict=True)]))


def _largest_overlap(model: Reconstruction, others: Sequence[Reconstruction]) -> Reconstruction:
    """Of several models the one that shares most images with a given one; of equals the last, which was mapped."""
    return max(reversed(others), key=lambda other: int((other.is_registered & model.is_registered).sum()))


def _given_intrinsics(
    model: Reconstruction, camera_idx: NDArray[np.int64], found: HeldOut, spread: float, turn: float
) -> Contradiction:
    held, freed = (_values(m.cameras[camera_idx[0]]) for m in (model, found.freed))
    more = f" (and {len(camera_idx) - 1} more cameras)" if len(camera_idx) > 1 else ""
    return Contradiction(
        "given intrinsics",
        f"camera {camera_idx[0]}{more} was fixed at {held}; the photographs indicate {freed}, with which held-out "
        f"points agree {1.0 / max(found.ratio, 1e-9):.1f} times better, and which moves the cameras by "
        f"{100 * spread:.2g} % of their spread",
        "leave out images.fix_intrinsics, or give the right values for pictures of this size",
        {
            "held_out_residual_ratio": found.ratio,
            "limit": CLEAR_RATIO,
            "improved_images_share": found.improved_share,
            "held": held,
            "freed": freed,
        },
        rotation_sigma_deg=turn,
        position_sigma_share=spread,
    )


def _values(camera: Camera) -> str:
    """The parameters of a camera in words, pixels to a tenth."""
    return ", ".join(
        f"{name} {value:.4g}" if kind_of(name) == "distortion" else f"{name} {value:.1f}"
        for name, value in zip(PARAM_NAMES[camera.model], camera.params, strict=True)
    )


def widened_uncertainty(uncertainty: Uncertainty, model: Reconstruction, spread: float, turn: float) -> Uncertainty:
    """The uncertainty with an independent error of all poses: a share of the rms spread of the centres, and degrees.

    Where nothing else is known of the poses these alone are told; an error of zero tells nothing.
    """
    if uncertainty.median_center_sigma_share is None or uncertainty.worst_center_sigma_share is None:
        return replace(
            uncertainty, median_center_sigma_share=spread or None, worst_center_sigma_share=spread or None,
            median_rotation_sigma_deg=turn or None,
        )  # fmt: skip
    centers = model.centers[model.is_registered]
    distances = np.linalg.norm(centers - centers.mean(0), axis=1)
    share = spread * float(np.sqrt((distances**2).mean()) / distances.max())  # of the uncertainty's size
    return replace(
        uncertainty,
        median_center_sigma_share=float(np.hypot(uncertainty.median_center_sigma_share, share)),
        worst_center_sigma_share=float(np.hypot(uncertainty.worst_center_sigma_share, share)),
        median_rotation_sigma_deg=float(np.hypot(uncertainty.median_rotation_sigma_deg or 0.0, turn)),
        images=None
        if uncertainty.images is None
        else {
            name: ImageSigmas(
                center_sigma_share=float(np.hypot(entry.center_sigma_share, share)),
                rotation_sigma_deg=float(np.hypot(entry.rotation_sigma_deg, turn)),
            )
            for name, entry in uncertainty.images.items()
        },
    )
