"""How far estimated cameras are from reference ones.

Two families of numbers. *After alignment*: a similarity carries the estimate into the reference's world, then centres
and orientations are compared image by image. *Alignment-free*: relative poses of all pairs of reference images are
compared, which needs no common world and lets no good image pay for a bad one; from them comes the AUC.

Definitions:

- centre error: distance of the camera centres in the reference's unit; its share is that of the scene size.
- scene size: the largest distance between two camera centres of the whole reference.
- rotation error: angle of ``R_reference^T R_estimated`` in degrees, after alignment.
- error of a pair (i, j): the larger of the angle between the relative rotations and the angle between the directions
  of the relative translations ``j_from_i`` (0 to 180 degrees; the sign counts). It needs no scale. A pair in which an
  image is unregistered fails (its error is infinite). Where the reference has no baseline (below 1e-6 of its scene
  size) there is no direction and the rotation alone counts; where only the estimate has none, the pair fails.
- AUC at t: the area under the cumulative distribution of the pair errors from 0 to t, divided by t (Sarlin et al.,
  SuperGlue, 2020; Jin et al., IJCV 2021). The distribution is a staircase and is integrated exactly:
  ``mean(max(0, 1 - error / t))``. The trapezium through the points (error_k, k / n) that some scripts use
  is larger, by at most 1 / (2 n).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.evaluation.report import PoseErrorSummary, PoseStatistics
from sfmapp.geometry import rigid3, similarity
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

AUC_THRESHOLDS_DEG = (0.5, 1.0, 3.0, 5.0)
"""Thresholds of the AUC that reports give, in degrees."""

# A baseline below this share of the scene size is rounding, not a translation.
_NO_BASELINE = 1e-6


@dataclass(frozen=True)
class PoseErrors:
    """Estimated against reference cameras; see the module for the definitions.

    Attributes:
        names: the N reference images in their order.
        is_common: (N,) bool: the estimate has a pose for them.
        center_error: (N,) in the reference's unit, NaN where unregistered or without alignment.
        rotation_error_deg: (N,) likewise, degrees.
        pair_error_deg: (N (N - 1) / 2,) degrees, inf for failures; pairs i < j in the order of ``np.triu_indices``.
        reference_from_estimate: (8,) similarity; None if fewer than two common images or all in one place.
        is_inlier: (N,) bool: the images that the similarity was fitted to.
        scene_size: in the reference's unit.
    """

    names: tuple[str, ...]
    is_common: NDArray[np.bool_]
    center_error: Array
    rotation_error_deg: Array
    pair_error_deg: Array
    reference_from_estimate: Array | None
    is_inlier: NDArray[np.bool_]
    scene_size: float

    def summary(self) -> PoseErrorSummary:
        """The errors in numbers."""
        share = self.center_error / self.scene_size if self.scene_size > 0 else np.full_like(self.center_error, np.nan)
        return PoseErrorSummary(
            num_reference_images=len(self.names),
            num_common=int(self.is_common.sum()),
            num_outliers=int((np.isfinite(self.center_error) & ~self.is_inlier).sum()),
            scene_size=self.scene_size,
            center_error=_statistics(self.center_error),
            center_error_share=_statistics(share),
            rotation_error_deg=_statistics(self.rotation_error_deg),
            auc={f"{t:g}": v for t, v in zip(AUC_THRESHOLDS_DEG, auc(self.pair_error_deg), strict=True)},
        )


def evaluate_poses(
    names: Sequence[str],
    cam_from_world: ArrayLike,
    reference_names: Sequence[str],
    reference_cam_from_world: ArrayLike,
    *,
    is_robust: bool = False,
) -> PoseErrors:
    """Compare estimated cameras with reference ones.

    Args:
        names, cam_from_world: the estimate, (M,) names and (M, 7) poses with NaN where unregistered. Images that the
            reference does not know are left out.
        reference_names, reference_cam_from_world: the reference, (N,) and (N, 7). Images without a pose are left out.
        is_robust: align with :func:`similarity.align_poses_robust`, so that a few wrong cameras do not spoil the
            numbers of the others; else plain least squares over all common images, the custom in the literature.
    """
    poses, reference = _as_poses(cam_from_world), _as_poses(reference_cam_from_world)
    has_reference = _has_pose(reference)
    reference = reference[has_reference]
    kept_names = tuple(np.array(reference_names, object)[has_reference])
    index = match_names(names, kept_names)
    estimate = np.full_like(reference, np.nan)
    estimate[index >= 0] = poses[index[index >= 0]]
    is_common = _has_pose(estimate)
    estimate[~is_common] = np.nan

    center_error, rotation_error = np.full(len(reference), np.nan), np.full(len(reference), np.nan)
    is_inlier = np.zeros(len(reference), bool)
    transform = None
    try:
        align = similarity.align_poses_robust if is_robust else similarity.align_poses
        alignment = align(estimate[is_common], reference[is_common])
    except ValueError:  # fewer than two images, or all in one place
        pass
    else:
        transform = alignment.b_from_a
        moved = similarity.transform_poses(transform, estimate[is_common])
        center_error[is_common] = np.linalg.norm(rigid3.center(moved) - rigid3.center(reference[is_common]), axis=1)
        rotation_error[is_common] = _angle_between_deg(
            rigid3.rotation_matrix(moved), rigid3.rotation_matrix(reference[is_common])
        )
        is_inlier[is_common] = alignment.is_inlier
    return PoseErrors(
        kept_names,
        is_common,
        center_error,
        rotation_error,
        pair_errors_deg(estimate, reference),
        transform,
        is_inlier,
        scene_size(reference),
    )


def compare_reconstructions(ours: Reconstruction, other: Reconstruction) -> PoseErrors:
    """Pose agreement of two reconstructions of the same photographs, matched by name, after a robust similarity fit.

    The second one is the reference: its registered images are the ones compared, and its unit is the unit.
    """
    return evaluate_poses(
        ours.image_names, ours.cam_from_world, other.image_names, other.cam_from_world, is_robust=True
    )


def pair_errors_deg(cam_from_world: ArrayLike, reference_cam_from_world: ArrayLike) -> Array:
    """Errors in degrees of the relative poses of all pairs i < j; inf for failures (see the module).

    Args:
        cam_from_world: (N, 7) estimate with NaN where unregistered.
        reference_cam_from_world: (N, 7) reference, same images, without NaN.

    Returns:
        (N (N - 1) / 2,) in the order of ``np.triu_indices(N, 1)``.
    """
    poses, reference = _as_poses(cam_from_world), _as_poses(reference_cam_from_world)
    if len(poses) != len(reference):
        raise ValueError(f"{len(poses)} estimated poses, {len(reference)} reference poses")
    rotation, ground_truth_rotation = rigid3.rotation_matrix(poses), rigid3.rotation_matrix(reference)
    center, ground_truth_center = rigid3.center(poses), rigid3.center(reference)
    no_baseline = _NO_BASELINE * scene_size(reference)
    registered = _has_pose(poses)
    estimate_size = scene_size(poses[registered])
    rows = [np.zeros(0)]
    for i in range(len(poses) - 1):  # row by row: N^2 matrices at once would be gigabytes for thousands of images
        j = slice(i + 1, None)
        relative, ground_truth_relative = (
            rotation[j] @ rotation[i].T,
            ground_truth_rotation[j] @ ground_truth_rotation[i].T,
        )
        # j_from_i translation = R_j (c_i - c_j)
        step = np.einsum("nij,nj->ni", rotation[j], center[i] - center[j])
        ground_truth_step = np.einsum(
            "nij,nj->ni", ground_truth_rotation[j], ground_truth_center[i] - ground_truth_center[j]
        )
        direction = np.degrees(
            np.arctan2(np.linalg.norm(np.cross(step, ground_truth_step), axis=1), np.sum(step * ground_truth_step, 1))
        )
        has_ground_truth = np.linalg.norm(ground_truth_step, axis=1) > no_baseline
        has_step = np.linalg.norm(step, axis=1) > _NO_BASELINE * estimate_size
        direction = np.where(has_ground_truth, np.where(has_step, direction, np.inf), 0.0)
        error = np.maximum(_angle_between_deg(relative, ground_truth_relative), direction)
        rows.append(np.where(registered[i] & registered[j], error, np.inf))
    return np.concatenate(rows)


def auc(errors: ArrayLike, thresholds: Sequence[float] = AUC_THRESHOLDS_DEG) -> list[float]:
    """Areas under the cumulative distribution of errors from 0 to each threshold, divided by it; NaN without errors.

    Args:
        errors: (P,) not negative, same unit as the thresholds; inf (and NaN) for failures.
    """
    errors = np.asarray(errors, np.float64)
    errors = np.where(np.isnan(errors), np.inf, errors)
    return [float(np.maximum(0.0, 1.0 - errors / t).mean()) if len(errors) else float("nan") for t in thresholds]


def scene_size(cam_from_world: ArrayLike) -> float:
    """Largest distance between two camera centres of poses (N, 7) without NaN; 0 for fewer than two."""
    centers = rigid3.center(_as_poses(cam_from_world))
    return max((float(np.linalg.norm(centers - center, axis=1).max()) for center in centers), default=0.0)


def match_names(names: Sequence[str], reference_names: Sequence[str]) -> NDArray[np.int64]:
    """Position in ``names`` of each reference name, -1 where there is none.

    The full name decides; images that it leaves over are matched by the end of the path where one name with folders
    ends in the other, then by their file name, then by their file name without the suffix, where that is unique on both
    sides: references often know another folder or file type, or leave the file type out.
    """
    index = np.full(len(reference_names), -1, np.int64)

    def file_name(name: str) -> str:
        return PurePosixPath(name).name

    def stem(name: str) -> str:
        return PurePosixPath(name).stem

    by_end = _by_end(names)
    for key, their_key in ((str, str), (str, by_end), (file_name, file_name), (stem, file_name), (stem, stem)):
        free = set(range(len(names))) - set(index.tolist())
        ours = _unique({i: key(names[i]) for i in sorted(free)})
        theirs = _unique({k: their_key(reference_names[k]) for k in np.flatnonzero(index < 0).tolist()})
        for name in ours.keys() & theirs.keys():
            index[theirs[name]] = ours[name]
    return index


def _by_end(names: Sequence[str]) -> Callable[[str], str]:
    """What turns a reference name into the one of ours that ends in it or that it ends in, itself if there is none.

    File names alone are no ends of this kind: they are compared later, where they are unique.
    """

    def ends(name: str) -> list[str]:
        parts = name.split("/")
        return ["/".join(parts[k:]) for k in range(1, len(parts) - 1)]

    ours_of_end: dict[str, set[str]] = {}
    for name in names:
        for end in ends(name):
            ours_of_end.setdefault(end, set()).add(name)
    known = {name for name in names if "/" in name}

    def ours(name: str) -> str:
        longer = ours_of_end.get(name, set())
        return next((end for end in ends(name) if end in known), next(iter(longer)) if len(longer) == 1 else name)

    return ours


def _unique(key_of: dict[int, str]) -> dict[str, int]:
    """Position of each key that occurs once."""
    positions: dict[str, list[int]] = {}
    for position, key in key_of.items():
        positions.setdefault(key, []).append(position)
    return {key: found[0] for key, found in positions.items() if len(found) == 1}


def _as_poses(poses: ArrayLike) -> Array:
    return np.asarray(poses, np.float64).reshape(-1, 7)


def _has_pose(poses: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(poses).all(1), np.bool_)


def _angle_between_deg(a: Array, b: Array) -> Array:
    """Angles (N,) in degrees between rotation matrices (N, 3, 3), to full precision at small angles.

    ``|A - B|_F = 2 sqrt(2) sin(angle / 2)``; beyond 90 degrees the trace, which is flat at zero, is the better one.
    """
    half_sine = np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8.0)
    cosine = (np.einsum("...ij,...ij->...", a, b) - 1.0) / 2.0
    half = np.degrees(2.0 * np.arcsin(np.minimum(half_sine, 1.0)))
    angle: Array = np.where(half < 90.0, half, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return angle


def _statistics(values: Array) -> PoseStatistics | None:
    """Mean, median, rms and maximum of the finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    return PoseStatistics(
        mean=float(finite.mean()),
        median=float(np.median(finite)),
        rmse=float(np.sqrt((finite**2).mean())),
        max=float(finite.max()),
    )
