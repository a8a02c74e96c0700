"""The report of a reconstruction: what came out, how good it is, and why each image is where it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.contradictions import Contradiction
from sfmapp.features.report import FEW_FEATURES
from sfmapp.georeference.control.report import ControlReport
from sfmapp.georeference.poses.report import PosesReport
from sfmapp.mapping.report import FocalEvidence, MappedImage, ModelEntry, Uncertainty
from sfmapp.report.model import CameraReport, Check, Failure, Funnel, ImageReport, Light

if TYPE_CHECKING:
    from sfmapp.images.folder import ImageSet
    from sfmapp.mapping.options import MappingOptions
    from sfmapp.scene.correspondences import Correspondences
    from sfmapp.scene.features import Features
    from sfmapp.scene.reconstruction import Reconstruction

FORMAT = "sfmapp report 2"
# Share of a focal length to which photographs that tell it speak for or against what is surer still.
_TOLD_SHARE = 0.01
_NOTHING = Funnel(**dict.fromkeys(Funnel.__dataclass_fields__))


def funnel_of_images(
    names: Sequence[str],
    features: Sequence[Features],
    correspondences: Correspondences,
    mapping_images: Sequence[MappedImage],
    options: MappingOptions,
) -> list[ImageReport]:
    """What became of every image, from its keypoints to its pose, and what the user can do where it failed.

    Args:
        names: of the images.
        features, correspondences: what the stages found.
        mapping_images: the entries of the mapping report, in the order of the images; empty if mapping did not begin.
        options: the thresholds of mapping.
    """
    pairs, num_images = correspondences.pair_image_idx, len(names)
    inliers = correspondences.num_inliers

    def total(values: Any) -> list[int]:
        sums = np.zeros(num_images, np.int64)
        for side in (0, 1):
            np.add.at(sums, pairs[:, side], values)
        return sums.tolist()

    candidates, verified = total(np.ones(len(pairs), np.int64)), total((inliers > 0).astype(np.int64))
    putative, agreeing = total(correspondences.num_putative), total(inliers)
    rows = []
    for i, name in enumerate(names):
        entry = mapping_images[i] if mapping_images else None
        funnel = Funnel(
            features=len(features[i]),
            candidate_pairs=candidates[i],
            verified_pairs=verified[i],
            putative_matches=putative[i],
            verified_matches=agreeing[i],
            correspondences_2d3d=entry.num_correspondences if entry else None,
            pose_inliers=entry.num_pose_inliers if entry else None,
            observations=entry.num_observations if entry else 0,
        )
        model = entry.model if entry else None
        row = ImageReport(name=name, is_registered=model is not None, model=model, funnel=funnel)
        reason = entry.reason if entry else ""
        rows.append(row if row.is_registered else replace(row, **explain_failure(funnel, reason, options)))
    return rows


def funnel_without_matches(names: Sequence[str], reason: str) -> list[ImageReport]:
    """The rows of a run that ended before any image was matched."""
    failure = Failure(failed_at="images", reason=reason, remedy="Add photographs of the same thing.")
    return [ImageReport(name=name, is_registered=False, model=None, funnel=_NOTHING, **failure) for name in names]


def explain_failure(funnel: Funnel, reason: str, options: MappingOptions) -> Failure:
    """Where an image fell out of the funnel, the reason with its threshold, and a remedy.

    Args:
        reason: of mapping; may be empty.
    """
    if (funnel.features or 0) < FEW_FEATURES:
        return Failure(
            failed_at="features",
            reason=f"{funnel.features} features, at least {FEW_FEATURES} are needed",
            remedy="It is blurred, dark, plain or masked: take it again, or lower features.contrast_threshold.",
        )
    if not funnel.candidate_pairs:
        return Failure(
            failed_at="pairs",
            reason="no other image looked like it, so it was matched with none",
            remedy="Match all pairs: --set pairs.method=exhaustive.",
        )
    if not funnel.verified_pairs:
        return Failure(
            failed_at="matching",
            reason=f"none of {funnel.candidate_pairs} pairs was verified"
            f" ({funnel.putative_matches} matches looked right, no pair of them agrees with a camera motion)",
            remedy="It overlaps too little with the others: add photographs between, more than half of each shared.",
        )
    needed = options.min_pose_inliers
    if (funnel.correspondences_2d3d or 0) < needed:
        return Failure(
            failed_at="visibility",
            reason=reason or f"it sees fewer than {needed} points of the map",
            remedy="Its matches lie where the model has no points: add photographs between it and the others"
            " that move sideways.",
        )
    return Failure(
        failed_at="pose",
        reason=reason or f"fewer than {needed} points agree with one pose",
        remedy="Repeated structure, moving things or a wrong focal length: mask what moves, or give the focal.",
    )


def camera_rows(image_set: ImageSet, model: Reconstruction | None, uncertainty: Uncertainty) -> list[CameraReport]:
    """Each camera with the parameters that it began with and, if a model holds it, those it ended with, and sigmas."""
    entries = {entry.camera: entry for entry in uncertainty.cameras or ()}
    num_images = np.bincount([record.camera_idx for record in image_set.images], minlength=len(image_set.cameras))
    rows = []
    for idx, camera in enumerate(image_set.cameras):
        refined = None
        if model is not None and model.is_registered[model.image_camera_idx == idx].any():
            refined = named_params(model.cameras[idx])
        entry = entries.get(idx)
        rows.append(
            CameraReport(
                idx=idx,
                model=camera.model.name,
                width=camera.width,
                height=camera.height,
                num_images=int(num_images[idx]),
                focal_source=camera.focal_source,
                focal_sigma_px=camera.focal_sigma,
                is_fixed=camera.is_fixed,
                initial=named_params(camera),
                refined=refined,
                sigma=entry.sigma if entry else {},
                focal_evidence=(entry.focal if entry else None) or FocalEvidence(),
            )
        )
    return rows


def make_checks(
    models: Sequence[ModelEntry],
    images: Sequence[ImageReport],
    cameras: Sequence[CameraReport],
    also: Sequence[Contradiction] = (),
) -> list[Check]:
    """Traffic lights over the largest model and the contradictions of all, and those found ``also``, each with its
    thresholds in words."""
    summary, num_models = models[0], len(models)
    share = 100 * summary.num_registered / max(1, summary.num_images)
    features = float(np.median([image.funnel.features or 0 for image in images])) if images else 0.0
    checks = [
        check("registered images", share, f"{share:.0f} %", 95, 65, "%"),
        check("features per image (median)", features, f"{features:.0f}", 1000, 300),
        check(
            "observations per image (mean)", summary.mean_observations_per_image,
            f"{summary.mean_observations_per_image:.0f}", 500, 100,
        ),
        check("track length (mean)", summary.mean_track_length, f"{summary.mean_track_length:.2f}", 3, 2.3),
        check(
            "reprojection error (mean)", -summary.mean_reprojection_error_px,
            f"{summary.mean_reprojection_error_px:.2f} px", -1, -2, "px",
        ),
        check("separate models", -num_models, "; ".join([str(num_models), *_apart(models)]), -1, -2),
    ]  # fmt: skip
    for camera in cameras:
        if camera.refined and camera.focal_sigma_px:
            checks.append(_check_focal(camera, camera.refined, camera.focal_sigma_px))
    return checks + check_contradictions([*(found for model in models for found in model.contradictions), *also])


def check_control(control: ControlReport | None) -> list[Check]:
    """A light over ground control: amber where something is wrong with points, red where no model could be moved."""
    if control is None:
        return []
    largest = control.models[0]
    value = largest.reason or "no point could be left out: the others do not hold the model"
    if largest.summary is not None:
        one = largest.summary
        value = (
            f"left out in turn, {one.horizontal_rms_m:.3f} m horizontally and {one.vertical_rms_m:.3f} m in height; "
            f"expected {one.expected_horizontal_m:.3f} and {one.expected_vertical_m:.3f}"
        )
    wrong = largest.findings or largest.summary is None
    light: Light = "red" if largest.reason else "amber" if wrong else "green"
    thresholds = "green: every point agrees with what the others expect of it; amber: see Ground control"
    return [Check(name="ground control", value=value, light=light, thresholds=thresholds)]


def check_open_images(models: Sequence[Uncertainty]) -> list[Check]:
    """An amber light that names images whose own observations leave their poses open, of all models; none without."""
    names = [name for found in models for name in found.images_left_open]
    if not names:
        return []
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    thresholds = "green: every pose is determined; the standard deviations of the other images do not hang on these"
    return [Check(name="poses left open", value=shown, light="amber", thresholds=thresholds)]


def check_poses(poses: PosesReport | None) -> list[Check]:
    """A light over known poses: amber where one is refuted, red where the largest model does not lie in their frame."""
    if poses is None or not poses.models:
        return []
    refuted = sum(not image.is_used and image.model is not None for image in poses.images)
    largest = poses.models[0]
    light: Light = "red" if largest.reason or poses.contradictions else "amber" if refuted else "green"
    how = "held" if poses.is_fixed else "agree with the photographs"
    value = largest.reason or f"{largest.num_used} of {largest.num_known} {how}"
    thresholds = "green: photographs refute none; amber: see Known poses"
    return [Check(name="known poses", value=value, light=light, thresholds=thresholds)]


def _apart(models: Sequence[ModelEntry]) -> list[str]:
    """Why models after the first are none with it."""
    return [f"model {m} is {model.apart}" for m, model in enumerate(models) if m and model.apart]


def _check_focal(camera: CameraReport, refined: Mapping[str, float], sigma_px: float) -> Check:
    """The refined focal length of a camera against its prior. Amber where the photographs do not tell it, as agreement
    means nothing then, and where they refute a prior that was left out: the result is right, the input is not."""
    change = abs(_focal(refined) - _focal(camera.initial)) / sigma_px
    found = check(
        f"focal length of camera {camera.idx} against its prior", -change, f"{change:.1f} sigma", -2, -4, "sigma"
    )
    evidence = camera.focal_evidence
    if evidence.is_prior_left_out and found.light != "green":
        return replace(found, light="amber", value=f"{found.value}; the photographs refute it, it was left out")
    if evidence.is_determined is False and camera.focal_source != "default":
        own, focal = evidence.data_sigma_px, _focal(refined)
        told = f"only to {100 * own / focal:.2g} % by themselves" if own is not None else "not at all"
        value = (
            f"{found.value}; not determined by these photographs, which tell it {told}, the prior to "
            f"{100 * (evidence.prior_sigma_px or 0.0) / focal:.2g} %"
        )
        # photographs that tell it well would have spoken against a prior that is surer still
        has_spoken = own is not None and evidence.tension is not None and own <= _TOLD_SHARE * focal
        light = found.light if found.light != "green" or has_spoken else "amber"
        return replace(found, light=light, value=value)
    return found


def check(name: str, value: float, text: str, green: float, amber: float, unit: str = "") -> Check:
    """Green from one bound on, amber from the other; negative bounds are upper bounds."""
    light: Light = "green" if value >= green else "amber" if value >= amber else "red"
    word = "at most" if green < 0 else "at least"
    thresholds = f"green: {word} {abs(green):g}, amber: {word} {abs(amber):g} {unit}".strip()
    return Check(name=name, value=text, light=light, thresholds=thresholds)


def check_contradictions(found: Iterable[Contradiction]) -> list[Check]:
    """A red light for each contradiction, or one green light for none."""
    rows = [
        Check(name=f"contradiction: {each.subject}", value=each.message, light="red", thresholds=each.advice)
        for each in found
    ]
    thresholds = "green: no evidence in hand contradicts the result"
    return rows or [Check(name="contradictions", value="none found", light="green", thresholds=thresholds)]


def named_params(camera: Camera) -> dict[str, float]:
    """The parameters of a camera by name."""
    return dict(zip(PARAM_NAMES[camera.model], map(float, camera.params), strict=True))


def _focal(params: Mapping[str, float]) -> float:
    return params["f"] if "f" in params else (params["fx"] + params["fy"]) / 2
