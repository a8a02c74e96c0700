"""Two-view geometry against exact scenes, known noise and OpenCV."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.geometry import epipolar, fundamental, rigid3
from sfmapp.geometry.relative_pose import refine_on_inliers, refine_relative_pose

K1 = np.array([[900.0, 0, 512], [0, 905.0, 380], [0, 0, 1]])
K2 = np.array([[1100.0, 0, 500], [0, 1090.0, 400], [0, 0, 1]])
POSE = np.concatenate([rigid3.quaternion(rigid3.exp_so3([0.1, -0.3, 0.05])), np.array([1.0, 0.2, -0.3])])
POSE[4:] /= np.linalg.norm(POSE[4:])


def make_points(num: int, pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Normalised points of both views of a cloud in front of both cameras."""
    xyz = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (num, 3))
    moved = rigid3.apply(pose, xyz)
    assert (moved[:, 2] > 0).all()
    return xyz[:, :2] / xyz[:, 2:], moved[:, :2] / moved[:, 2:]


def to_pixels(k: np.ndarray, xn: np.ndarray) -> np.ndarray:
    return xn @ k[:2, :2].T + k[:2, 2]


def aligned(matrix: np.ndarray, reference: np.ndarray) -> np.ndarray:
    matrix = matrix / np.linalg.norm(matrix)
    return matrix * np.sign((matrix * reference).sum())


def rotation_error_deg(pose: np.ndarray, ground_truth: np.ndarray) -> float:
    return float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(ground_truth).T))


def translation_error_deg(pose: np.ndarray, ground_truth: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(pose[4:] @ ground_truth[4:], -1, 1))))


def test_exact_points_give_the_exact_fundamental_matrix() -> None:
    xn1, xn2 = make_points(40, POSE, np.random.default_rng(0))
    xy1, xy2 = to_pixels(K1, xn1), to_pixels(K2, xn2)
    ground_truth = epipolar.fundamental_from_essential(epipolar.essential_from_pose(POSE), K1, K2)
    f = fundamental.fundamental_from_points(xy1, xy2)
    np.testing.assert_allclose(aligned(f, ground_truth), ground_truth, atol=1e-7)
    assert abs(np.linalg.det(f / np.linalg.norm(f))) < 1e-15
    assert epipolar.sampson_errors(f, xy1, xy2).max() < 1e-12
    e = epipolar.essential_from_fundamental(f, K1, K2)
    np.testing.assert_allclose(
        aligned(e, epipolar.essential_from_pose(POSE)), epipolar.essential_from_pose(POSE), atol=1e-6
    )


def test_too_few_points_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 8"):
        fundamental.fundamental_from_points(np.zeros((7, 2)), np.zeros((7, 2)))


def test_sampson_error_matches_opencv_and_the_definition() -> None:
    import cv2

    rng = np.random.default_rng(1)
    f = epipolar.fundamental_from_essential(epipolar.essential_from_pose(POSE), K1, K2)
    xy1, xy2 = rng.uniform(0, 1000, (2, 20, 2))
    ours = epipolar.sampson_errors(f, xy1, xy2)
    theirs = [
        cv2.sampsonDistance(np.append(a, 1.0)[:, None], np.append(b, 1.0)[:, None], f)
        for a, b in zip(xy1, xy2, strict=True)
    ]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)


def test_truncated_sums_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(4)
    matrices, limit = rng.normal(size=(3, 3, 3)), 0.05
    for width in (2, 3):
        a, b = rng.normal(size=(2, 40, width))
        a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) if width == 3 else x for x in (a, b))
        sums = [np.minimum(epipolar.sampson_errors(m, a, b), limit).sum() for m in matrices]
        np.testing.assert_allclose(epipolar.truncated_sums(matrices, a, b, limit), sums, rtol=1e-12)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(-0.6, 0.6), min_size=3, max_size=3),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda t: np.linalg.norm(t) > 0.2),
)
def test_an_essential_matrix_has_four_poses_and_depth_finds_the_one(w: list[float], t: list[float]) -> None:
    ground_truth = np.concatenate([rigid3.quaternion(rigid3.exp_so3(w)), np.array(t) / np.linalg.norm(t)])
    essential = epipolar.essential_from_pose(ground_truth)
    poses = epipolar.decompose_essential(essential)
    for pose in poses:
        np.testing.assert_allclose(aligned(epipolar.essential_from_pose(pose), essential), essential, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(pose[4:]), 1.0)
    distinct = {tuple(np.round(np.r_[rigid3.rotation_matrix(p).ravel(), p[4:]], 6)) for p in poses}
    assert len(distinct) == 4
    rng = np.random.default_rng(3)
    depth = rng.uniform(3, 30, 50)
    xn1 = rng.uniform(-0.6, 0.6, (50, 2))
    xyz = np.concatenate([xn1, np.ones((50, 1))], 1) * depth[:, None]
    # each of the four is the right one for some scene: the points go wherever its cameras look
    for pose in poses:
        moved = rigid3.apply(pose, xyz)
        visible = moved[:, 2] > 0.1
        if visible.sum() < 10:
            continue
        a, b = xn1[visible], moved[visible, :2] / moved[visible, 2:]
        chosen, in_front, _ = epipolar.choose_in_front(poses, a, b)
        assert in_front.all()
        np.testing.assert_allclose(rigid3.rotation_matrix(chosen), rigid3.rotation_matrix(pose), atol=1e-6)
        np.testing.assert_allclose(chosen[4:], pose[4:], atol=1e-6)


def test_depths_and_angles_are_those_of_the_scene() -> None:
    rng = np.random.default_rng(4)
    xyz = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (30, 3))
    moved = rigid3.apply(POSE, xyz)
    xn1, xn2 = xyz[:, :2] / xyz[:, 2:], moved[:, :2] / moved[:, 2:]
    depths, angles = epipolar.ray_depths(POSE, xn1, xn2)
    np.testing.assert_allclose(depths, np.stack([xyz[:, 2], moved[:, 2]], 1), rtol=1e-9)
    to_first, to_second = xyz, xyz - rigid3.center(POSE)
    cosine = (to_first * to_second).sum(1) / np.linalg.norm(to_first, axis=1) / np.linalg.norm(to_second, axis=1)
    np.testing.assert_allclose(angles, np.arccos(cosine), atol=1e-9)
    parallel, angle = epipolar.ray_depths([0, 0, 0, 1, 1, 0, 0], np.array([[0.1, 0.2]]), np.array([[0.1, 0.2]]))
    assert np.isnan(parallel).all()
    assert angle[0] == 0.0


def test_refinement_reaches_the_exact_pose_from_nearby() -> None:
    xn1, xn2 = make_points(50, POSE, np.random.default_rng(5))
    start = POSE.copy()
    start[:4] = rigid3.quaternion(rigid3.exp_so3([0.03, -0.02, 0.04]) @ rigid3.rotation_matrix(POSE))
    start[4:] += [0.05, -0.1, 0.08]
    refined = refine_relative_pose(start, xn1, xn2, 0.01, max_iterations=50)
    assert rotation_error_deg(refined, POSE) < 1e-5
    assert translation_error_deg(refined, POSE) < 1e-4


def expected_rotation_deg(xn1: np.ndarray, xn2: np.ndarray, sigma: float) -> float:
    """Root mean square rotation error that the noise allows: the inverse of the information, by finite differences."""
    step = 1e-6

    def residual(delta: np.ndarray) -> np.ndarray:
        rotation = rigid3.exp_so3(delta[:3]) @ rigid3.rotation_matrix(POSE)
        e = rigid3.skew(POSE[4:] + delta[3:]) @ rotation
        a, b = (np.concatenate([x, np.ones((len(x), 1))], 1) for x in (xn1, xn2))
        line2, line1 = a @ e.T, b @ e
        return (b * line2).sum(1) / np.sqrt((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1))

    tangent = np.linalg.svd(POSE[None, 4:])[2][1:]
    directions = np.concatenate([np.eye(6)[:3], np.concatenate([np.zeros((2, 3)), tangent], 1)])
    jacobian = np.stack([(residual(step * d) - residual(-step * d)) / (2 * step) for d in directions], 1)
    covariance = sigma**2 * np.linalg.inv(jacobian.T @ jacobian)
    return float(np.degrees(np.sqrt(np.trace(covariance[:3, :3]))))


def test_refinement_bears_noise_and_outliers_and_is_as_good_as_the_noise_allows() -> None:
    rng, sigma = np.random.default_rng(6), 1e-3
    errors, bounds = [], []
    for _ in range(30):
        xn1, xn2 = make_points(300, POSE, rng)
        bounds.append(expected_rotation_deg(xn1[60:], xn2[60:], sigma))
        xn1, xn2 = xn1 + rng.normal(0, sigma, xn1.shape), xn2 + rng.normal(0, sigma, xn2.shape)
        xn2[:60] = rng.uniform(-0.5, 0.5, (60, 2))
        start = POSE.copy()
        start[4:] += [0.05, -0.05, 0.05]
        refined = refine_relative_pose(start, xn1, xn2, 2 * sigma)
        errors.append(rotation_error_deg(refined, POSE))
    rms, bound = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(bounds)))
    # the robust weight and outliers that happen to fit cost a little
    assert 0.7 * bound < rms < 1.6 * bound


def test_inliers_are_looked_for_anew_and_lie_in_front() -> None:
    """Half wrong, some of them near their epipolar line behind a camera; a scene half of which is far away."""
    rng = np.random.default_rng(6)
    threshold = 3e-3
    xn1, xn2 = make_points(200, POSE, rng)
    far = rng.uniform(-0.5, 0.5, (100, 2))
    rays = np.column_stack([far, np.ones(100)]) @ rigid3.rotation_matrix(POSE).T
    a = np.concatenate([xn1, far]) + rng.normal(0, 1e-3, (300, 2))
    b = np.concatenate([xn2, rays[:, :2] / rays[:, 2:]]) + rng.normal(0, 1e-3, (300, 2))
    b[:100] = rng.uniform(-0.5, 0.5, (100, 2))
    start = POSE + np.array([0.0, 0.0, 0.0, 0.0, 0.02, -0.02, 0.01])
    pose, squared = refine_on_inliers(start, a, b, threshold, first_gate=2.0 * threshold, rounds=8)
    assert np.linalg.norm(rigid3.rotation_matrix(pose) - rigid3.rotation_matrix(POSE)) < 2e-3
    depths, angles = epipolar.ray_depths(pose, a, b)
    taken = (depths > 0).all(1) | (angles <= threshold)
    np.testing.assert_array_equal(np.isfinite(squared), taken)
    errors = epipolar.sampson_errors(epipolar.essential_from_pose(pose), a, b)
    np.testing.assert_allclose(squared[taken], errors[taken], rtol=1e-9)
    assert (squared[100:] < threshold**2).mean() > 0.98
    assert (depths[200:] < 0).any(1).mean() > 0.3
    # refined on what it explains, it stays
    again, _ = refine_on_inliers(pose, a, b, threshold, first_gate=threshold, rounds=1)
    np.testing.assert_allclose(again, pose, atol=1e-5)


def test_refinement_survives_nothing_to_refine() -> None:
    empty = np.empty((0, 2))
    np.testing.assert_allclose(refine_relative_pose(POSE, empty, empty, 1.0), POSE, atol=1e-12)
    same = np.tile([[0.1, 0.2]], (20, 1))
    assert np.isfinite(refine_relative_pose(POSE, same, same, 1.0)).all()
