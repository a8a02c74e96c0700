"""Essential matrices from F and by five points: exact cases, known noise, OpenCV, PoseLib and the literature."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.essential import essential_of_cameras, find_essential, moved_pose, pose_covariance, refine_pose
from sfmapp.geometry.five_point import essentials_of_samples
from sfmapp.geometry.two_rays import fundamental_of
from sfmapp.matching.search import Ransac, find_relative_pose

K = np.array([[900.0, 0, 512], [0, 905.0, 380], [0, 0, 1]])
POSE = rigid3.from_matrix(rigid3.exp_so3([0.1, -0.3, 0.05]), np.array([1.0, 0.2, -0.3]) / np.sqrt(1.13))
E = epipolar.essential_from_pose(POSE)


def cloud(num: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Normalised points of both views."""
    xyz = np.random.default_rng(seed).uniform([-2, -1.5, 4], [2, 1.5, 9], (num, 3))
    moved = rigid3.apply(POSE, xyz)
    return xyz[:, :2] / xyz[:, 2:], moved[:, :2] / moved[:, 2:]


def distance(e: np.ndarray, f: np.ndarray) -> float:
    e, f = e / np.linalg.norm(e), f / np.linalg.norm(f)
    return float(min(np.linalg.norm(e - f), np.linalg.norm(e + f)))


def test_from_f_and_back_in_both_conventions() -> None:
    f = epipolar.fundamental_from_essential(E, K, K)
    e, info = essential_of_cameras(f, K, K)
    assert distance(e, E) < 1e-12
    np.testing.assert_allclose(info.singular_values, [1.0, 1.0, 0.0], atol=1e-12)
    # the literature's other convention, x1^T F x2 = 0 with E = K1^T F K2, is all of it transposed
    np.testing.assert_allclose(K.T @ f.T @ K, (K.T @ f @ K).T, atol=1e-9)
    # a focal length half as long does not fit F: the singular values say so
    wrong = np.diag([0.5, 0.5, 1.0]) @ K
    assert essential_of_cameras(f, wrong, K)[1].condition > 1.05
    p1, p2 = K @ np.eye(3, 4), K @ np.column_stack([rigid3.rotation_matrix(POSE), POSE[4:]])
    assert distance(fundamental_of(p1, p2), f) < 1e-9


def test_the_decompositions_of_the_literature_give_the_same_four() -> None:
    """W has opposite signs in two lectures: the pair {U W V^T, U W^T V^T} and the translations +-u3 are the same."""
    u, _, vt = np.linalg.svd(E)
    u, vt = u * np.linalg.det(u), vt * np.linalg.det(vt)
    ours = epipolar.decompose_essential(E)
    for sign in (1.0, -1.0):
        w = np.array([[0, sign, 0], [-sign, 0, 0], [0, 0, 1.0]])
        theirs = [(rotation, t) for rotation in (u @ w @ vt, u @ w.T @ vt) for t in (u[:, 2], -u[:, 2])]
        for rotation, t in theirs:
            gaps = [np.abs(rigid3.rotation_matrix(pose) - rotation).max() + np.abs(pose[4:] - t).max() for pose in ours]
            assert min(gaps) < 1e-9
    # R^T is meant in the epipole e1 = -K1 R^T t of one of them
    e1 = -K @ rigid3.rotation_matrix(POSE).T @ POSE[4:]
    f = epipolar.fundamental_from_essential(E, K, K)
    np.testing.assert_allclose(f @ e1 / np.linalg.norm(e1), 0.0, atol=1e-12)
    np.testing.assert_allclose(f.T @ (K @ POSE[4:]), 0.0, atol=1e-9)


def test_five_points_are_enough_and_others_find_the_same() -> None:
    xn1, xn2 = cloud(5)
    rays = [np.column_stack([x, np.ones(5)]) for x in (xn1, xn2)]
    rays = [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]
    ours = essentials_of_samples(*rays, np.arange(5)[None])
    assert min(distance(e, E) for e in ours) < 1e-9
    import cv2

    theirs = cv2.findEssentialMat(xn1, xn2, np.eye(3), method=0)[0]
    if theirs is not None:
        for e in theirs.reshape(-1, 3, 3):
            assert min(distance(e, mine) for mine in ours) < 1e-5
    poselib = pytest.importorskip("poselib")
    found = poselib.essential_matrix_5pt(list(rays[0]), list(rays[1]))
    assert len(found) == len(ours)
    for e in found:
        assert min(distance(e, mine) for mine in ours) < 1e-6


def test_the_search_is_refined_and_as_sure_as_it_says() -> None:
    rng = np.random.default_rng(1)
    noise, scaled, of_e = 5e-4, [], []
    for seed in range(60):
        xn1, xn2 = cloud(80, seed)
        a, b = xn1 + rng.normal(0, noise, xn1.shape), xn2 + rng.normal(0, noise, xn2.shape)
        pose, _, covariance = refine_pose(POSE, a, b, noise)
        assert covariance is not None
        step = _step_between(pose, POSE)
        scaled.append(step @ np.linalg.solve(covariance, step))
        if seed < 20:
            b[:20] = rng.uniform(-0.5, 0.5, (20, 2))
            e, info = find_essential(a, b, 3.0 * noise, seed=seed)
            assert info.is_inlier[20:].mean() > 0.95
            assert info.covariance is not None
            deviation = (e * np.sign((e * E).sum()) - E).ravel()
            of_e.append(deviation @ np.linalg.pinv(info.covariance, rcond=1e-9, hermitian=True) @ deviation)
    # chi-square of five
    assert 4.0 < np.mean(scaled) < 6.2
    assert 3.0 < np.mean(of_e) < 9.0


def test_the_quick_search_finds_the_pose_among_as_many_wrong_matches() -> None:
    rng = np.random.default_rng(2)
    noise, errors = 7e-4, []
    for seed in range(8):
        xn1, xn2 = cloud(300, seed)
        a, b = xn1 + rng.normal(0, noise, xn1.shape), xn2 + rng.normal(0, noise, xn2.shape)
        b[:150] = rng.uniform(-0.5, 0.5, (150, 2))
        pose = find_relative_pose(a, b, 3.0 * noise, Ransac(5000, seed))
        assert pose is not None
        # what nobody has who does not know which of them are right
        best, _, _ = refine_pose(POSE, a[150:], b[150:], noise)
        errors.append([np.linalg.norm(_step_between(each, POSE)) for each in (pose, best)])
    found, known = np.median(errors, 0)
    assert found < 1.6 * known
    assert known > 0.0
    assert find_relative_pose(np.zeros((20, 2)), np.zeros((20, 2)), 1e-3, Ransac(50, 0)) is None


def _step_between(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The step that moves the pose to the other one, by a Newton step each."""
    step = np.zeros(5)
    for _ in range(3):

        def gap(s: np.ndarray) -> np.ndarray:
            moved = moved_pose(pose, s)
            turn = rigid3.rotation_matrix(other) @ rigid3.rotation_matrix(moved).T
            return np.concatenate([rigid3.log_so3(turn), other[4:] - moved[4:]])

        slopes = np.stack([(gap(step + 1e-6 * axis) - gap(step)) / 1e-6 for axis in np.eye(5)], 1)
        step = step - np.linalg.lstsq(slopes, gap(step), rcond=None)[0]
    return step


def test_an_open_pose_has_no_covariance() -> None:
    xyz = np.column_stack([np.linspace(-2, 2, 30), np.linspace(0, 1, 30), np.linspace(5, 8, 30)])
    moved = rigid3.apply(POSE, xyz)
    assert pose_covariance(POSE, xyz[:, :2] / xyz[:, 2:], moved[:, :2] / moved[:, 2:], 1e-3) is None
    assert pose_covariance(POSE, *cloud(30), 1e-3) is not None
    with pytest.raises(ValueError, match="at least 8 points, got 5"):
        find_essential(np.zeros((5, 2)), np.zeros((5, 2)), 1e-3)
