"""The report of a run as one JSON-able document: what came out, how good it is, and why each image is where it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sfmapp.camera.camera import PARAM_NAMES, Camera

if TYPE_CHECKING:
    from sfmapp.images.folder import ImageSet
    from sfmapp.mapping.options import MappingOptions
    from sfmapp.scene.correspondences import Correspondences
    from sfmapp.scene.features import Features
    from sfmapp.scene.reconstruction import Reconstruction

FORMAT = "sfmapp report 1"
FUNNEL_STEPS = (
    "features",
    "candidate_pairs",
    "verified_pairs",
    "putative_matches",
    "verified_matches",
    "correspondences_2d3d",
    "pose_inliers",
    "observations",
)
# fewer keypoints than this leave too few matches for any pair, whatever the other image holds
FEW_FEATURES = 100


def funnel_of_images(
    names: Sequence[str],
    features: Sequence[Features],
    correspondences: Correspondences,
    mapping_images: Sequence[Mapping[str, Any]],
    options: MappingOptions,
) -> list[dict[str, Any]]:
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
        entry = dict(mapping_images[i]) if mapping_images else {}
        funnel = {
            "features": len(features[i]),
            "candidate_pairs": candidates[i],
            "verified_pairs": verified[i],
            "putative_matches": putative[i],
            "verified_matches": agreeing[i],
            "correspondences_2d3d": entry.get("num_correspondences"),
            "pose_inliers": entry.get("num_pose_inliers"),
            "observations": entry.get("num_observations", 0),
        }
        is_registered = entry.get("model") is not None
        row = {"name": name, "is_registered": is_registered, "model": entry.get("model"), "funnel": funnel}
        if not is_registered:
            row |= explain_failure(funnel, entry.get("reason") or "", options)
        rows.append(row)
    return rows


def funnel_without_matches(names: Sequence[str], reason: str) -> list[dict[str, Any]]:
    """The rows of a run that ended before any image was matched."""
    nothing = dict.fromkeys(FUNNEL_STEPS)
    row = {"is_registered": False, "model": None, "funnel": nothing}
    failure = {"failed_at": "images", "reason": reason, "remedy": "Add photographs of the same thing."}
    return [{"name": name, **row, **failure} for name in names]


def explain_failure(funnel: Mapping[str, Any], reason: str, options: MappingOptions) -> dict[str, str]:
    """Where an image fell out of the funnel: ``failed_at``, the ``reason`` with its threshold, and a ``remedy``."""
    if funnel["features"] < FEW_FEATURES:
        return {
            "failed_at": "features",
            "reason": f"{funnel['features']} features, at least {FEW_FEATURES} are needed",
            "remedy": "It is blurred, dark, plain or masked: take it again, or lower features.contrast_threshold.",
        }
    if not funnel["candidate_pairs"]:
        return {
            "failed_at": "pairs",
            "reason": "no other image looked like it, so it was matched with none",
            "remedy": "Match all pairs: --set pairs.method=exhaustive.",
        }
    if not funnel["verified_pairs"]:
        return {
            "failed_at": "matching",
            "reason": f"none of {funnel['candidate_pairs']} pairs was verified"
            f" ({funnel['putative_matches']} matches looked right, no pair of them agrees with a camera motion)",
            "remedy": "It overlaps too little with the others: add photographs between, more than half of each shared.",
        }
    needed = options.min_pose_inliers
    if (funnel["correspondences_2d3d"] or 0) < needed:
        return {
            "failed_at": "visibility",
            "reason": reason or f"it sees fewer than {needed} points of the map",
            "remedy": "Its matches lie where the model has no points: add photographs between it and the others"
            " that move sideways.",
        }
    return {
        "failed_at": "pose",
        "reason": reason or f"fewer than {needed} points agree with one pose",
        "remedy": "Repeated structure, moving things or a wrong focal length: mask what moves, or give the focal.",
    }


def camera_rows(
    image_set: ImageSet, model: Reconstruction | None, uncertainty: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Each camera with the parameters that it began with and, if a model holds it, those it ended with, and sigmas."""
    entries = {entry["camera"]: entry for entry in uncertainty.get("cameras", ())}
    num_images = np.bincount([record.camera_idx for record in image_set.images], minlength=len(image_set.cameras))
    rows = []
    for idx, camera in enumerate(image_set.cameras):
        row = {
            "idx": idx,
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "num_images": int(num_images[idx]),
            "focal_source": camera.focal_source,
            "focal_sigma_px": camera.focal_sigma,
            "is_fixed": camera.is_fixed,
            "initial": _named_params(camera),
            "refined": None,
            "sigma": entries.get(idx, {}).get("sigma", {}),
            "focal_evidence": entries.get(idx, {}).get("focal", {}),
        }
        if model is not None and model.is_registered[model.image_camera_idx == idx].any():
            row["refined"] = _named_params(model.cameras[idx])
        rows.append(row)
    return rows


def make_checks(
    models: Sequence[Mapping[str, Any]],
    images: Sequence[Mapping[str, Any]],
    cameras: Sequence[Mapping[str, Any]],
) -> list[dict[str, str]]:
    """Traffic lights over the largest model and the contradictions of all, each with its thresholds in words."""
    summary, num_models = models[0], len(models)
    share = 100 * summary["num_registered"] / max(1, summary["num_images"])
    features = float(np.median([image["funnel"]["features"] for image in images])) if images else 0.0
    checks = [
        check("registered images", share, f"{share:.0f} %", 95, 65, "%"),
        check("features per image (median)", features, f"{features:.0f}", 1000, 300),
        check(
            "observations per image (mean)", summary["mean_observations_per_image"],
            f"{summary['mean_observations_per_image']:.0f}", 500, 100,
        ),
        check("track length (mean)", summary["mean_track_length"], f"{summary['mean_track_length']:.2f}", 3, 2.3),
        check(
            "reprojection error (mean)", -summary["mean_reprojection_error_px"],
            f"{summary['mean_reprojection_error_px']:.2f} px", -1, -2, "px",
        ),
        check("separate models", -num_models, "; ".join([str(num_models), *_apart(models)]), -1, -2),
    ]  # fmt: skip
    for camera in cameras:
        if camera["refined"] and camera["focal_sigma_px"]:
            checks.append(_check_focal(camera))
    return checks + check_contradictions(found for model in models for found in model["contradictions"])


def _apart(models: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why models after the first are none with it."""
    return [f"model {m} is {model['apart']}" for m, model in enumerate(models) if m and model.get("apart")]


def _check_focal(camera: Mapping[str, Any]) -> dict[str, str]:
    """The refined focal length of a camera against its prior. Amber where the photographs do not tell it, as agreement
    means nothing then, and where they refute a prior that was left out: the result is right, the input is not."""
    change = abs(_focal(camera["refined"]) - _focal(camera["initial"])) / camera["focal_sigma_px"]
    found = check(
        f"focal length of camera {camera['idx']} against its prior", -change, f"{change:.1f} sigma", -2, -4, "sigma"
    )
    evidence = camera["focal_evidence"]
    if evidence.get("is_prior_left_out") and found["light"] != "green":
        found |= {"light": "amber", "value": f"{found['value']}; the photographs refute it, it was left out"}
    elif evidence.get("is_determined") is False and camera["focal_source"] != "default":
        own = evidence["data_sigma_px"]
        told = f"within {own:.0f} px by themselves" if own is not None else "not at all"
        value = (
            f"{found['value']}; not determined by these photographs, which tell it {told}, the prior within "
            f"{evidence['prior_sigma_px']:.0f} px"
        )
        found |= {"light": "amber" if found["light"] == "green" else found["light"], "value": value}
    return found


def check(name: str, value: float, text: str, green: float, amber: float, unit: str = "") -> dict[str, str]:
    """Green from one bound on, amber from the other; negative bounds are upper bounds."""
    light = "green" if value >= green else "amber" if value >= amber else "red"
    word = "at most" if green < 0 else "at least"
    thresholds = f"green: {word} {abs(green):g}, amber: {word} {abs(amber):g} {unit}".strip()
    return {"name": name, "value": text, "light": light, "thresholds": thresholds}


def check_contradictions(found: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """A red light for each contradiction as ``Contradiction.describe`` gives it, or one green light for none."""
    rows = [
        {"name": f"contradiction: {row['subject']}", "value": row["message"], "light": "red",
         "thresholds": row["advice"]}
        for row in found
    ]  # fmt: skip
    thresholds = "green: no evidence in hand contradicts the result"
    return rows or [{"name": "contradictions", "value": "none found", "light": "green", "thresholds": thresholds}]


def _named_params(camera: Camera) -> dict[str, float]:
    return dict(zip(PARAM_NAMES[camera.model], map(float, camera.params), strict=True))


def _focal(params: Mapping[str, float]) -> float:
    return params["f"] if "f" in params else (params["fx"] + params["fy"]) / 2
