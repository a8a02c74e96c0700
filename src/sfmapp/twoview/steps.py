"""The steps of the story, each on its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.cheirality import PoseChoice, choose_pose
from sfmapp.geometry.dlt import homogeneous, normalizing
from sfmapp.geometry.essential import essential_of_cameras, pose_covariance, refine_pose
from sfmapp.geometry.fundamental import eight_point, epipolar_rows, epipoles, refine_fundamental
from sfmapp.geometry.homography import motions_from_homography, transfer_errors
from sfmapp.geometry.ransac import ransac_fundamental, trials_needed
from sfmapp.geometry.two_rays import METHODS, triangulate_pair
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.stage import MatchedPair
from sfmapp.scene.features import Features
from sfmapp.twoview.report import (
    ChoiceStep,
    EightPointStep,
    EpipolesStep,
    EssentialStep,
    HomographyStep,
    Improvement,
    KeypointsStep,
    PlaneMotion,
    PoseStep,
    RansacStep,
    StoryReport,
    TriangulationStep,
)
from sfmapp.twoview.view import View

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# One more than an F of eight points: with the ninth there is something left that tells the noise.
LEAST = 9
# Keypoints are no better than this, however few of them agree by chance.
LEAST_SIGMA_PX = 0.1
# The plain loop stops here: a second of work. A share of 20 per cent inliers would ask for two million.
_MAX_TRIALS = 20_000
_ANGLE_BINS = 24


@dataclass(frozen=True)
class Lesson:
    """What the steps share: the matches (M, 2) of the lesson in pixels, the cameras, and the inlier threshold."""

    xy1: Array
    xy2: Array
    camera1: Camera
    camera2: Camera
    threshold_px: float
    options: MatchingOptions
    seed: int


@dataclass(frozen=True)
class Inliers:
    """(M,) which matches of the lesson F of plain RANSAC explains, and F of the main path."""

    is_own: Mask
    is_main: Mask


def keypoints(name: str, camera: Camera, features: Features) -> KeypointsStep:
    """How many there are, and how large."""
    scale = float(np.median(features.keypoints[:, 2])) if len(features) else 0.0
    return KeypointsStep(
        name=name, width=camera.width, height=camera.height, num_keypoints=len(features), median_scale_px=scale
    )


def search(lesson: Lesson, pair: MatchedPair) -> tuple[RansacStep | None, Inliers]:
    """F by RANSAC as it was written down, beside that of the main path on the same matches."""
    nothing = np.zeros(len(lesson.xy1), np.bool_)
    is_main, main = nothing, pair.geometry.fundamental
    if np.isfinite(main).all() and len(lesson.xy1):
        is_main = epipolar.sampson_errors(main, lesson.xy1, lesson.xy2) < lesson.threshold_px**2
    if len(lesson.xy1) < 8:
        return None, Inliers(nothing, is_main)
    own, info, history = ransac_fundamental(
        lesson.xy1, lesson.xy2, lesson.threshold_px, seed=lesson.seed, max_trials=_MAX_TRIALS
    )
    both = info.is_inlier & is_main

    def rms(f: Array) -> float:
        if not both.any() or not np.isfinite(f).all():
            return math.nan
        return math.sqrt(float(epipolar.sampson_errors(f, lesson.xy1[both], lesson.xy2[both]).mean()))

    step = RansacStep(
        threshold_px=lesson.threshold_px, num_matches=len(lesson.xy1), num_inliers=int(info.is_inlier.sum()),
        num_trials=info.num_iterations, needed=trials_needed(float(info.is_inlier.mean())),
        improvements=[Improvement(trial=i.trial, num_inliers=i.num_inliers, needed=i.needed) for i in history],
        num_main_inliers=int(is_main.sum()), num_common=int(both.sum()), rms_px=rms(own), rms_main_px=rms(main),
    )  # fmt: skip
    return step, Inliers(info.is_inlier, is_main)


def why_few(told: StoryReport) -> str:
    """At which step the matches went, in words."""
    fewest = min(told.keypoints, key=lambda one: one.num_keypoints)
    if fewest.num_keypoints < LEAST:
        return f"{fewest.name} has {fewest.num_keypoints} keypoints (one colour, too dark or out of focus?)"
    if told.neighbors is not None and told.neighbors.num_mutual < LEAST:
        return (
            f"of {told.neighbors.num_nearest} nearest neighbours {told.neighbors.num_mutual} pass the ratio test from "
            "both sides: the photographs show nothing in common, or show it too differently"
        )
    return "no geometry explains more of them than it would of matches at random: the photographs do not overlap"


def eight_points(xy1: Array, xy2: Array) -> tuple[EightPointStep, Array]:
    """The eight-point algorithm on verified matches, and F (3, 3) refined from it."""
    f, info = eight_point(xy1, xy2)
    raw, ill = eight_point(xy1, xy2, is_normalized=False)
    refined, refined_info = refine_fundamental(f, xy1, xy2)
    # the matrix before rank two: its last singular value in normalised pixels, which is what enforcing it costs
    loss = float(np.linalg.svd(_before_rank_two(xy1, xy2), compute_uv=False)[2])
    lines, other = (homogeneous(xy1) @ each.T for each in (refined, raw))
    step = EightPointStep(
        num_points=len(xy1), fundamental=f.tolist(), condition=info.condition, condition_raw=ill.condition,
        singular_values=info.singular_values.tolist(), smallest_share=loss, rms_px=_rms(f, xy1, xy2),
        rms_raw_px=_rms(raw, xy1, xy2), rms_refined_px=_rms(refined, xy1, xy2),
        median_line_gap_px=float(np.median(_gap(lines, other, xy2))),
        sigma_px=refined_info.sigma_px, num_free=info.num_free,
    )  # fmt: skip
    return step, refined


def _before_rank_two(xy1: Array, xy2: Array) -> Array:
    t1, t2 = normalizing(xy1), normalizing(xy2)
    rows = epipolar_rows(xy1 * t1[0, 0] + t1[:2, 2], xy2 * t2[0, 0] + t2[:2, 2])
    full: Array = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    scaled: Array = full / float(np.linalg.svd(full, compute_uv=False)[0])
    return scaled


def _rms(f: Array, xy1: Array, xy2: Array) -> float:
    return math.sqrt(float(epipolar.sampson_errors(f, xy1, xy2).mean()))


def _gap(lines: Array, other: Array, xy: Array) -> Array:
    """(N,) pixels between two lines each (N, 3), where they pass the points (N, 2)."""
    at = [(homogeneous(xy) * each).sum(1) / np.linalg.norm(each[:, :2], axis=1) for each in (lines, other)]
    # the same line may be written with the other sign
    turn = np.sign((lines[:, :2] * other[:, :2]).sum(1))
    gap: Array = np.abs(at[0] - turn * at[1])
    return gap


def epipoles_of(fundamental: Array, camera1: Camera, camera2: Camera) -> EpipolesStep:
    """Where each camera sees the other."""
    found: list[list[float] | None] = []
    inside = []
    for e, camera in zip(epipoles(fundamental), (camera1, camera2), strict=True):
        far = abs(e[2]) < 1e-9 * np.linalg.norm(e[:2])
        xy = None if far else (e[:2] / e[2]).tolist()
        found.append(xy)
        inside.append(xy is not None and 0 <= xy[0] <= camera.width and 0 <= xy[1] <= camera.height)
    return EpipolesStep(first=found[0], second=found[1], is_inside=inside)


def mean_focal(views: tuple[View, View]) -> float:
    """Of both cameras, in pixels."""
    return 0.5 * (views[0].camera.focal + views[1].camera.focal)


def poses(
    views: tuple[View, View], fundamental: Array, xn: tuple[Array, Array], noise_px: float, pair: MatchedPair
) -> tuple[EssentialStep, PoseChoice]:
    """E from F and the calibration, refined on the matches, and the choice among its four poses.

    Where the main path has found a pose, that is where the refinement begins: a plane leaves F open, and E with it.
    """
    k1, k2 = (view.camera.k_matrix for view in views)
    essential, info = essential_of_cameras(fundamental, k1, k2)
    focal = mean_focal(views)
    noise = noise_px / focal
    start = pair.geometry.cam2_from_cam1
    # a turn on the spot has no baseline, and no pose at all is NaN
    if not np.linalg.norm(start[4:]) > 0.0:
        start = epipolar.choose_in_front(epipolar.decompose_essential(essential), *xn)[0]
    pose, cost, _ = refine_pose(start, *xn, noise)
    refined = epipolar.essential_from_pose(pose)
    step = EssentialStep(
        k1=k1.tolist(), k2=k2.tolist(), focal_sources=[view.camera.focal_source for view in views],
        focal_sigmas_px=[view.camera.focal_sigma for view in views],
        singular_values=info.singular_values.tolist(), essential=essential.tolist(), refined=refined.tolist(),
        rms_px=focal * math.sqrt(cost / max(len(xn[0]), 1)),
    )  # fmt: skip
    return step, choose_pose(refined, *xn, noise)


def choice_step(choice: PoseChoice, xn1: Array, xn2: Array, noise: float, views: tuple[View, View]) -> ChoiceStep:
    """The four poses and the vote between them, in numbers."""
    rotations = rigid3.rotation_matrix(choice.poses)
    angles = np.degrees(choice.angles[choice.in_front])
    top = max(float(np.percentile(angles, 99)), 1e-3) if len(angles) else 1.0
    edges = np.linspace(0.0, top, _ANGLE_BINS + 1)
    covariance = pose_covariance(choice.pose, xn1, xn2, noise) if noise else None
    rotation_sigma = translation_sigma = None
    if covariance is not None:
        rotation_sigma = math.degrees(math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1])))
        translation_sigma = math.degrees(math.sqrt(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])))
    return ChoiceStep(
        poses=[
            PoseStep(
                rotation=rotation.tolist(), angle_deg=float(rigid3.rotation_angle_deg(rotation)),
                translation=pose[4:].tolist(), num_in_front=int(count), votes=int(votes),
            )
            for rotation, pose, count, votes in zip(
                rotations, choice.poses, choice.num_in_front, choice.votes, strict=True
            )
        ],
        best=choice.best, reason=choice.reason, num_points=len(xn1),
        median_parallax_deg=float(np.median(angles)) if len(angles) else 0.0,
        parallax_edges_deg=edges.tolist(), parallax_counts=np.histogram(angles, edges)[0].tolist(),
        rotation_sigma_deg=rotation_sigma, translation_sigma_deg=translation_sigma,
        is_focal_a_guess=any(view.camera.focal_source == "default" for view in views),
    )  # fmt: skip


def four_clouds(poses: Array, xn1: Array, xn2: Array) -> tuple[Array, Mask]:
    """(4, N, 3) points under each of the poses, in the frame of camera 1, and which are in front of both cameras."""
    first = np.eye(3, 4)
    clouds, in_front = [], []
    for pose in poses:
        second = rigid3.to_matrix(pose)
        xyz, info = triangulate_pair(first, second, xn1, xn2, "homogeneous")
        clouds.append(xyz)
        in_front.append(info.is_inlier)
    return np.array(clouds), np.array(in_front)


def ways(pose: Array, xn: tuple[Array, Array], noise: float, views: tuple[View, View]) -> Sequence[TriangulationStep]:
    """Every way to triangulate, on the chosen pose."""
    first, second = np.eye(3, 4), rigid3.to_matrix(pose)
    best, info = triangulate_pair(first, second, *xn, "nonlinear", noise)
    assert info.covariance is not None
    sigma = np.sqrt(np.trace(info.covariance, axis1=1, axis2=2))
    out = []
    for method in METHODS:
        xyz, found = triangulate_pair(first, second, *xn, method)
        seen = found.is_inlier & info.is_inlier & np.isfinite(sigma)
        left = [_reprojection(p, xyz[seen], each[seen]) for p, each in ((first, xn[0]), (second, xn[1]))]
        rms = math.sqrt(float(np.concatenate(left).mean())) * mean_focal(views) if seen.any() else math.nan
        gap = np.linalg.norm(xyz[seen] - best[seen], axis=1) / sigma[seen]
        out.append(TriangulationStep(
            method=method, num_in_front=int(found.is_inlier.sum()), rms_px=rms,
            median_gap_sigmas=float(np.median(gap)) if seen.any() else math.nan,
        ))  # fmt: skip
    return out


def _reprojection(p: Array, xyz: Array, xn: Array) -> Array:
    """(N,) squared distances."""
    mapped = xyz @ p[:, :3].T + p[:, 3]
    squared: Array = ((mapped[:, :2] / mapped[:, 2:] - xn) ** 2).sum(1)
    return squared


def homography(views: tuple[View, View], pair: MatchedPair, lesson: Lesson) -> HomographyStep | None:
    """H of the main path beside F, and the motions that it allows; None where there is none."""
    h, geometry = pair.geometry.homography, pair.geometry
    if not np.isfinite(h).all() or len(pair.matches) < LEAST:
        return None
    xy1, xy2 = (np.ascontiguousarray(view.xy[pair.matches[:, side]]) for side, view in enumerate(views))
    squared = transfer_errors(h, xy1, xy2)
    inlier = squared < lesson.threshold_px**2
    k1, k2 = (view.camera.k_matrix for view in views)
    every = motions_from_homography(h, k1, k2)
    xn1 = (homogeneous(xy1[inlier]) @ np.linalg.inv(k1).T)[:, :2]
    possible = every.possible(xn1).poses if inlier.any() and len(every.poses) else every.poses
    motions = [
        PlaneMotion(
            angle_deg=float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose))), translation=pose[4:].tolist(),
            normal=normal.tolist(), is_possible=bool((np.abs(possible - pose).sum(1) == 0.0).any()),
        )
        for pose, normal in zip(every.poses, every.normals, strict=True)
    ]  # fmt: skip
    shown = math.sqrt(float(squared[inlier].mean())) if inlier.any() else math.nan
    gric_f, gric_h = gric(geometry.fundamental, h, xy1, xy2)
    return HomographyStep(
        homography=(h / h[2, 2] if h[2, 2] else h).tolist(), num_matches=len(xy1), num_inliers=int(inlier.sum()),
        share=float(inlier.mean()), max_share=lesson.options.max_h_ratio, rms_px=shown, motions=motions, gric_f=gric_f,
        gric_h=gric_h,
    )  # fmt: skip


def gric(fundamental: Array, h: Array, xy1: Array, xy2: Array) -> tuple[float, float]:
    """Torr's criterion of F and of H on the same matches (Torr, "Geometric motion segmentation and model selection",
    Phil. Trans. R. Soc. A 1998): residuals, truncated, plus log 4 for each coordinate of the structure and log 4n for
    each parameter of the model. The noise is that which F leaves, which favours neither where both fit."""
    n = len(xy1)
    if not np.isfinite(fundamental).all():
        return math.nan, math.nan
    of_f = epipolar.sampson_errors(fundamental, xy1, xy2)
    variance = max(float(np.median(of_f)) / 0.455, LEAST_SIGMA_PX**2)  # the median of chi-square of one
    # half the larger of both transfer errors is, for a map without much zoom, the distance in four dimensions
    of_h = 0.5 * transfer_errors(h, xy1, xy2)

    def total(squared: Array, dimension: int, parameters: int) -> float:
        loss = np.minimum(squared / variance, 2.0 * (4 - dimension)).sum()
        return float(loss + math.log(4.0) * dimension * n + math.log(4.0 * n) * parameters)

    return total(of_f, 3, 7), total(of_h, 2, 8)
