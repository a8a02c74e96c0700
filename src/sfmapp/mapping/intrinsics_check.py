"""Whether the photographs agree with what was said of their cameras, and what becomes of the models if they do not.

Bundle adjustment finds the nearest minimum, and mapping registers what fits the cameras as they were given. A focal
length that is wrong by a factor, or held where it is wrong, therefore ends in a model that is bent and does not know:
its observations are those that survived. Two questions tell, both asked of the verified matches, not of the model: does
mapping that begins without the doubtful value explain more of them, and do parameters that were held, once freed and
fitted to half of the tracks, explain the other half far better?
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.solver import AdjustOptions, adjust_bundle
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.exif import DEFAULT_FOCAL, DEFAULT_FOCAL_SIGMA
from sfmapp.mapping import structure
from sfmapp.mapping.mapper import STAGE, Mapper
from sfmapp.mapping.register import Registration
from sfmapp.scene.camera import PARAM_NAMES, Camera
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A prior is doubted where the refined focal length has left it by so many of its standard deviations: at five it was
# wrong or its sigma was. At two it is doubted where photographs were left out besides, which a wrong one causes.
DOUBT_SIGMAS, DOUBT_SIGMAS_IF_INCOMPLETE = 5.0, 2.0
# A second map takes the place of the first if it explains as much, to the share of observations that come and go at the
# threshold between two equally good models (under 1 % over the shared sets).
SAME_SUPPORT = 0.98
# Residuals below so many robust standard deviations agree with a model.
AGREE_SIGMAS = 3.0
# Parameters that were held contradict the photographs if freeing them lowers the median residual of tracks that they
# were not fitted to by a fifth: more than a third of the variance had nothing to do with noise. On the shared sets this
# is a focal length that is off by 1 to 2.5 %; right ones give 0.94 to 1. It must hold in nearly every photograph, since
# a wrong lens is wrong in all of them.
CLEAR_RATIO, CLEAR_IMAGES = 0.8, 0.9
# Fewer tracks on either side do not tell.
MIN_TRACKS = 50


@dataclass(frozen=True)
class Mapped:
    """What mapping made of the cameras that it began with: its models, the largest first, and how they came about."""

    cameras: list[Camera]
    models: list[Reconstruction]
    initial_reports: list[dict[str, Any]]
    focal_report: dict[str, Any]
    attempts: dict[int, Registration]
    mapper_of: Callable[..., Mapper]


MapFrom = Callable[[list[Camera]], Mapped]


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


def as_unknown(camera: Camera) -> Camera:
    """The camera as if nothing were known of its focal length: free, with the prior of photographs without EXIF."""
    focal = DEFAULT_FOCAL * max(camera.width, camera.height)
    sigma = DEFAULT_FOCAL_SIGMA * focal
    return replace(camera.with_focal(focal), focal_sigma=sigma, focal_source="default", is_fixed=False)


# ------------------------------------------------------------------------------------------------- doubtful priors


def settle_focal_lengths(mapped: Mapped, map_from: MapFrom, events: Events) -> tuple[Mapped, dict[str, Any]]:
    """Map again without the focal lengths that a map has left far behind, and keep what explains more matches.

    Args:
        mapped: made of the given cameras.
        map_from: maps from other first cameras; those that are unknown get theirs from the pairs.
        events: warned of every prior that is not believed any more.

    Returns:
        The better of both, and the decision for the report.
    """
    doubted = _doubted_cameras(mapped)
    if not doubted.any():
        return mapped, {}
    events.decided(STAGE, f"the focal lengths of {int(doubted.sum())} camera(s) are doubtful: mapping without them")
    again = map_from([as_unknown(c) if d else c for c, d in zip(mapped.cameras, doubted, strict=True)])
    support = _support((mapped.models, again.models))
    better = again if support[1] >= SAME_SUPPORT * support[0] and support[1] > 0 else mapped
    report = {
        "doubted_cameras": np.flatnonzero(doubted).tolist(),
        "agreeing_observations": {"as_given": support[0], "as_unknown": support[1]},
        "kept": "as_unknown" if better is again else "as_given",
    }
    for line in _refuted(mapped.cameras, better.models, doubted):
        events.warned(STAGE, line)
    return better, report


def _deviations(cameras: Sequence[Camera], models: Sequence[Reconstruction]) -> Array:
    """(C,) how far the focal lengths of the models have left those of the cameras, in sigmas of these; 0 if unused."""
    out = np.zeros(len(cameras))
    for model in models:
        for c in np.unique(model.image_camera_idx[model.is_registered]):
            sigma = cameras[c].focal_sigma
            if sigma:
                out[c] = max(out[c], abs(model.cameras[c].focal - cameras[c].focal) / sigma)
    return out


def _doubted_cameras(mapped: Mapped) -> Mask:
    """(C,) bool: cameras whose focal length was known and has to be asked for anew."""
    known = np.array([c.focal_source != "default" and not c.is_fixed for c in mapped.cameras], bool)
    if not mapped.models:
        return known
    is_complete = len(mapped.models) == 1 and bool(mapped.models[0].is_registered.all())
    limit = DOUBT_SIGMAS if is_complete else DOUBT_SIGMAS_IF_INCOMPLETE
    return known & (_deviations(mapped.cameras, mapped.models) > limit)


def _support(results: Sequence[list[Reconstruction]]) -> list[int]:
    """Observations that agree with each of several results, by the tolerance of the most precise one."""
    scales = [structure.residual_scale_px(models[0]) for models in results if models]
    finite = [scale for scale in scales if np.isfinite(scale)]
    limit = AGREE_SIGMAS * min(finite, default=0.0)
    counts = []
    for models in results:
        agrees = np.zeros(models[0].tracks.num_observations if models else 0, bool)
        for model in models:
            agrees |= model.obs_is_inlier & (np.linalg.norm(model.residuals_px(), axis=1) <= limit)
        counts.append(int(agrees.sum()))
    return counts


def _refuted(cameras: Sequence[Camera], models: Sequence[Reconstruction], doubted: Mask) -> list[str]:
    """A line for each doubted camera that the photographs still contradict."""
    off = _deviations(cameras, models)
    lines = []
    for c in np.flatnonzero(doubted & (off > DOUBT_SIGMAS)):
        found = next(m.cameras[c].focal for m in models if (m.image_camera_idx[m.is_registered] == c).any())
        source = {"user": "given", "file": "given"}.get(cameras[c].focal_source, "from EXIF")
        lines.append(
            f"camera {c}: the focal length {source}, {cameras[c].focal:.0f} px, is wrong by the photographs, which say "
            f"{found:.0f} px; it was left out of account"
        )
    return lines


# ------------------------------------------------------------------------------------------------- held parameters


def hold_out(model: Reconstruction, held: AdjustOptions, free: AdjustOptions, cameras: Sequence[Camera]) -> HeldOut:
    """Adjust with parameters held and free to every second track, and judge both by the others.

    Args:
        model: adjusted with the parameters held; not changed.
        held, free: options of the two adjustments.
        cameras: as they are adjusted where the parameters are free; where these have priors, around their values.
    """
    fit = model.is_triangulated & (np.arange(model.tracks.num_tracks) % 2 == 0)
    judge = model.is_triangulated & ~fit
    if min(fit.sum(), judge.sum()) < MIN_TRACKS:
        return HeldOut(1.0, 0.0, model)
    as_held, as_free = model.copy(), model.copy()
    as_free.cameras = list(cameras)
    lengths = []
    for trial, options, priors in ((as_held, held, None), (as_free, free, cameras)):
        adjust_bundle(trial, options, points=fit, prior_cameras=priors)
        nothing = np.zeros(len(trial.image_names), bool), np.zeros(len(trial.cameras), bool)
        adjust_bundle(trial, held, points=judge, variable_images=nothing[0], variable_cameras=nothing[1])
        lengths.append(np.linalg.norm(trial.residuals_px(), axis=1))
    tracks = model.tracks
    # a point that two images see follows nearly any pose
    size = np.bincount(tracks.obs_track_idx[model.obs_is_inlier], minlength=tracks.num_tracks)
    used = model.obs_is_inlier & (judge & (size >= 3))[tracks.obs_track_idx]
    used &= np.isfinite(lengths[0]) & np.isfinite(lengths[1])
    if used.sum() < MIN_TRACKS:
        return HeldOut(1.0, 0.0, model)
    ratio = float(np.median(lengths[1][used]) / max(np.median(lengths[0][used]), 1e-9))
    return HeldOut(ratio, _improved_share(tracks.obs_image_idx[used], lengths[0][used], lengths[1][used]), as_free)


def _improved_share(image_idx: NDArray[np.int32], before: Array, after: Array) -> float:
    images = [i for i in np.unique(image_idx) if (image_idx == i).sum() >= 10]
    improved = [np.median(after[image_idx == i]) < np.median(before[image_idx == i]) for i in images]
    return float(np.mean(improved)) if improved else 0.0


def check_intrinsics(mapped: Mapped, model: Reconstruction, map_from: MapFrom, events: Events) -> dict[str, Any]:
    """What the photographs say of parameters that were held, as entries of the model's report.

    Args:
        mapped: whose model it is.
        model: finished.
        map_from: maps from other first cameras.
        events: warned of contradictions.

    Returns:
        ``uncertainty`` as of :meth:`Mapper.uncertainty`, with what the held parameters add to it, and the
        ``contradictions`` that stand.
    """
    mapper = mapped.mapper_of(model)
    uncertainty = mapper.uncertainty()
    used = np.unique(model.image_camera_idx[model.is_registered])
    fixed = np.array([c in used and camera.is_fixed for c, camera in enumerate(model.cameras)], bool)
    contradictions: list[Contradiction] = []
    if fixed.any():
        options = replace(mapper.adjust_options, initial_damping=1e-7, relative_cost_tolerance=1e-7)
        freed = [replace(c, is_fixed=False, focal_sigma=None) for c in model.cameras]
        found = hold_out(model, options, mapper.with_free_centers(options, fixed), freed)
        other = found.freed
        if found.is_clear:
            cameras = [as_unknown(c) if f else c for c, f in zip(mapped.cameras, fixed, strict=True)]
            other = _largest_overlap(model, [found.freed, *map_from(cameras).models])
        spread, turn = difference(model, other)
        if found.is_clear:
            contradictions.append(_given_intrinsics(model, other, np.flatnonzero(fixed), found, spread, turn))
            events.warned(STAGE, contradictions[-1].message)
        uncertainty = widened_uncertainty(uncertainty, model, spread, turn)
    return {"uncertainty": uncertainty, "contradictions": [c.describe() for c in contradictions]}


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


def _largest_overlap(model: Reconstruction, others: Sequence[Reconstruction]) -> Reconstruction:
    """Of several models the one that shares most images with a given one; of equals the last, which was mapped."""
    return max(reversed(others), key=lambda other: int((other.is_registered & model.is_registered).sum()))


def _given_intrinsics(
    model: Reconstruction,
    other: Reconstruction,
    camera_idx: NDArray[np.int64],
    found: HeldOut,
    spread: float,
    turn: float,
) -> Contradiction:
    held, freed = (_values(m.cameras[camera_idx[0]]) for m in (model, other))
    more = f" (and {len(camera_idx) - 1} more cameras)" if len(camera_idx) > 1 else ""
    return Contradiction(
        "given intrinsics",
        f"camera {camera_idx[0]}{more} was held at {held}; the photographs say {freed}, with which points that were "
        f"not fitted to them agree {1.0 / max(found.ratio, 1e-9):.1f} times better, and which moves the cameras by "
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
        f"{name} {value:.4g}" if name[0] in "kp" else f"{name} {value:.1f}"
        for name, value in zip(PARAM_NAMES[camera.model], camera.params, strict=True)
    )


def widened_uncertainty(
    uncertainty: dict[str, Any], model: Reconstruction, spread: float, turn: float
) -> dict[str, Any]:
    """The uncertainty with an independent error of all poses: a share of the rms spread of the centres, and degrees."""
    if not uncertainty:
        return {"median_center_sigma_share": spread, "worst_center_sigma_share": spread}
    centers = model.centers[model.is_registered]
    distances = np.linalg.norm(centers - centers.mean(0), axis=1)
    share = spread * float(np.sqrt((distances**2).mean()) / distances.max())  # of the uncertainty's size
    out = dict(uncertainty)
    for name in ("median_center_sigma_share", "worst_center_sigma_share"):
        out[name] = float(np.hypot(out[name], share))
    out["median_rotation_sigma_deg"] = float(np.hypot(out["median_rotation_sigma_deg"], turn))
    out["images"] = {
        name: {
            "center_sigma_share": float(np.hypot(entry["center_sigma_share"], share)),
            "rotation_sigma_deg": float(np.hypot(entry["rotation_sigma_deg"], turn)),
        }
        for name, entry in uncertainty["images"].items()
    }
    return out
