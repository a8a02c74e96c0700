"""Points from two views in every way, homographies with their covariance, and the choice among four poses."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import epipolar, homography, rigid3
from sfmapp.geometry.cheirality import choose_pose
from sfmapp.geometry.fundamental import eight_point
from sfmapp.geometry.relative_pose import refine_relative_pose
from sfmapp.geometry.two_rays import METHODS, fundamental_of, move_to_meet, triangulate_pair

Array = np.ndarray
K = np.array([[900.0, 0, 512], [0, 905.0, 380], [0, 0, 1]])
POSE = rigid3.from_matrix(rigid3.exp_so3([0.05, -0.2, 0.05]), np.array([1.0, 0.1, 0.15]))
P1 = K @ np.eye(3, 4)
P2 = K @ np.column_stack([rigid3.rotation_matrix(POSE), POSE[4:]])


def project(p: Array, xyz: Array) -> Array:
    mapped = xyz @ p[:, :3].T + p[:, 3]
    return mapped[:, :2] / mapped[:, 2:]


def cloud(num: int, seed: int = 0) -> tuple[Array, Array, Array]:
    xyz = np.random.default_rng(seed).uniform([-2, -1.5, 4], [2, 1.5, 9], (num, 3))
    return xyz, project(P1, xyz), project(P2, xyz)


@pytest.mark.parametrize("method", METHODS)
def test_exact_pixels_give_exact_points(method: str) -> None:
    xyz, xy1, xy2 = cloud(30)
    found, info = triangulate_pair(P1, P2, xy1, xy2, method)
    np.testing.assert_allclose(found, xyz, rtol=1e-8)
    assert info.is_inlier.all()
    behind, info = triangulate_pair(
        P1, K @ np.column_stack([rigid3.rotation_matrix(POSE), -POSE[4:]]), xy1, xy2, method
    )
    np.testing.assert_allclose(behind, -xyz, rtol=1e-8)
    assert not info.is_inlier.any()


def test_opencv_solves_the_same_homogeneous_system() -> None:
    import cv2

    rng = np.random.default_rng(1)
    _, xy1, xy2 = cloud(20)
    a, b = xy1 + rng.normal(0, 1, xy1.shape), xy2 + rng.normal(0, 1, xy2.shape)
    theirs = cv2.triangulatePoints(P1, P2, a.T, b.T)
    ours = triangulate_pair(P1, P2, a, b, "homogeneous")[0]
    # rows of ours have unit length, which weighs both pictures alike: the same to a share of the noise
    sigma = np.sqrt(np.trace(triangulate_pair(P1, P2, a, b, noise_px=1.0)[1].covariance, axis1=1, axis2=2))
    assert (np.linalg.norm(ours - (theirs[:3] / theirs[3]).T, axis=1) < 0.5 * sigma).all()
    moved = cv2.correctMatches(fundamental_of(P1, P2), a[None], b[None])
    ours1, ours2 = move_to_meet(fundamental_of(P1, P2), a, b)
    np.testing.assert_allclose(ours1, moved[0][0], atol=1e-6)
    np.testing.assert_allclose(ours2, moved[1][0], atol=1e-6)


def test_the_optimal_and_the_nonlinear_way_reach_one_minimum_that_no_other_is_below() -> None:
    rng = np.random.default_rng(2)
    _, xy1, xy2 = cloud(100)
    a, b = xy1 + rng.normal(0, 1, xy1.shape), xy2 + rng.normal(0, 1, xy2.shape)
    cost = {}
    for method in METHODS:
        found, _ = triangulate_pair(P1, P2, a, b, method)
        cost[method] = ((project(P1, found) - a) ** 2).sum(1) + ((project(P2, found) - b) ** 2).sum(1)
    np.testing.assert_allclose(cost["optimal"], cost["nonlinear"], rtol=1e-6)
    for method in ("homogeneous", "inhomogeneous", "midpoint"):
        assert (cost[method] >= cost["nonlinear"] * (1.0 - 1e-9)).all()
    # one degree of freedom is left of four coordinates
    assert 0.7 < cost["nonlinear"].mean() < 1.35


def test_points_are_as_sure_as_they_say() -> None:
    rng = np.random.default_rng(3)
    xyz, xy1, xy2 = (np.repeat(each, 500, 0) for each in cloud(4))
    noisy = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
    found, info = triangulate_pair(P1, P2, *noisy, noise_px=0.5)
    assert info.covariance is not None
    error = found - xyz
    scaled = np.einsum("ni,nij,nj->n", error, np.linalg.inv(info.covariance), error)
    assert 2.85 < scaled.mean() < 3.15


def test_depth_from_disparity_of_the_literature() -> None:
    """Focal length 20 mm, 30 px/mm, a point at 2 m, 2 px off: the literature rounds the disparity and prints 2142.93 to
    1875.11, and 2027.04 to 1973.71. Its disparity x' - x is positive: the second camera stands on the left, t = +B."""
    p1 = np.diag([600.0, 600.0, 1.0]) @ np.eye(3, 4)
    for baseline, exact, printed in (
        (100.0, (2142.857, 1875.0), (2142.93, 1875.11)),
        (500.0, (2027.027, 1973.684), (2027.04, 1973.71)),
    ):
        p2 = p1 + np.diag([600.0, 600.0, 1.0]) @ np.column_stack([np.zeros((3, 3)), [baseline, 0.0, 0.0]])
        disparity = 600.0 * baseline / 2000.0 + np.array([-2.0, 2.0])
        for method in METHODS:
            depth = triangulate_pair(p1, p2, np.zeros((2, 2)), np.column_stack([disparity, [0, 0]]), method)[0][:, 2]
            np.testing.assert_allclose(depth, exact, atol=6e-4)
            # four digits of the disparity in millimetres
            np.testing.assert_allclose(depth, printed, atol=0.12)


def test_parallel_rays_and_bad_input_are_said() -> None:
    p2 = P1 + K @ np.column_stack([np.zeros((3, 3)), [1.0, 0, 0]])
    _, info = triangulate_pair(P1, p2, [[500.0, 300.0]], [[500.0, 300.0]], noise_px=1.0)
    assert not info.is_inlier.any()
    assert info.covariance is not None
    assert np.isinf(info.covariance).all()
    with pytest.raises(ValueError, match="unknown method 'best'"):
        triangulate_pair(P1, P2, [[1.0, 2.0]], [[1.0, 2.0]], "best")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 1"):
        triangulate_pair(P1, P2, np.zeros((0, 2)), np.zeros((0, 2)))


# ---- homographies


def test_a_homography_of_four_corners_both_ways() -> None:
    """A picture into a photograph, as the exercise has it: corners (0, 0), (w, h), (w, 0), (0, h), and H / H[8]."""
    corners = np.array([[0.0, 0], [320, 200], [320, 0], [0, 200]])
    seen = np.array([[101.0, 57], [401, 322], [430, 33], [88, 260]])
    rows = np.concatenate([
        [[x, y, 1, 0, 0, 0, -x * u, -y * u, -u], [0, 0, 0, x, y, 1, -x * v, -y * v, -v]]
        for (x, y), (u, v) in zip(corners, seen, strict=True)
    ])  # fmt: skip
    by_hand = np.linalg.svd(rows)[2][8].reshape(3, 3)
    for is_inhomogeneous in (False, True):
        h, info = homography.fit_homography(corners, seen, is_inhomogeneous=is_inhomogeneous)
        np.testing.assert_allclose(h, by_hand / by_hand[2, 2], rtol=1e-7, atol=1e-10)
        assert info.num_free == 1
        assert homography.transfer_errors(h, corners, seen).max() < 1e-18
    corners[3] = [160, 0]  # on the line of the first and the third
    seen[3] = 0.5 * (seen[0] + seen[2])
    assert homography.fit_homography(corners, seen)[1].num_free > 1


def test_the_refined_homography_is_as_sure_as_it_says_and_better_than_the_linear_one() -> None:
    rng = np.random.default_rng(4)
    truth = np.array([[0.9, 0.1, 30], [-0.08, 1.2, 10], [4e-4, 3e-4, 1]])
    xy1 = rng.uniform([0, 0], [800, 600], (12, 2))
    xy2 = project(np.column_stack([truth, np.zeros(3)]), np.column_stack([xy1, np.ones(12)]))
    unit = truth / np.linalg.norm(truth)
    _, exact = homography.refine_homography(truth, xy1, xy2, noise_px=0.5)
    assert exact.covariance is not None
    scaled, sigmas, errors = [], [], []
    for _ in range(200):
        a, b = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
        linear, _ = homography.fit_homography(a, b)
        h, info = homography.refine_homography(linear, a, b)
        deviation = (h * np.sign((h * unit).sum()) - unit).ravel()
        scaled.append(deviation @ np.linalg.pinv(exact.covariance, rcond=1e-16, hermitian=True) @ deviation)
        sigmas.append(info.sigma_px)
        errors.append([homography.transfer_errors(each, xy1, xy2).mean() for each in (h, linear)])
    assert 7.0 < np.mean(scaled) < 9.1
    assert 0.46 < np.sqrt(np.mean(np.square(sigmas))) < 0.54
    refined, linear = np.mean(errors, 0)
    assert refined < 1.01 * linear


def test_guided_refinement_drops_what_does_not_fit() -> None:
    import cv2

    rng = np.random.default_rng(5)
    truth = np.array([[0.9, 0.1, 30], [-0.08, 1.2, 10], [4e-4, 3e-4, 1]])
    xy1 = rng.uniform([0, 0], [800, 600], (60, 2))
    xy2 = project(np.column_stack([truth, np.zeros(3)]), np.column_stack([xy1, np.ones(60)]))
    a, b = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
    b[:15] += rng.uniform(20, 80, (15, 2))
    start = truth + np.array([[0, 0, 3.0], [0, 0, -2.0], [0, 0, 0]])
    h, info = homography.guided_homography(start, a, b, 6.0)
    assert not info.is_inlier[:15].any()
    assert info.is_inlier[15:].all()
    robust, told = homography.refine_homography(truth, a, b, is_robust=True)
    assert homography.transfer_errors(robust, xy1, xy2).max() < 1.0
    assert 0.4 < told.sigma_px < 0.8
    theirs = cv2.findHomography(a[15:], b[15:], 0)[0]
    errors = [np.sqrt(homography.transfer_errors(each, xy1, xy2).mean()) for each in (h, theirs)]
    assert errors[0] < 1.1 * errors[1]


def test_a_plane_leaves_two_motions() -> None:
    rotation, t = rigid3.exp_so3([0.05, 0.2, -0.05]), np.array([0.8, 0.1, 0.3])
    normal, distance = np.array([0.2, -0.1, 0.97]) / np.linalg.norm([0.2, -0.1, 0.97]), 5.0
    h = K @ (rotation + np.outer(t, normal) / distance) @ np.linalg.inv(K)
    every = homography.motions_from_homography(h, K, K)
    assert len(every.poses) == 4
    possible = every.possible(np.random.default_rng(6).uniform(-0.3, 0.3, (50, 2)))
    assert len(possible.poses) == 2
    errors = [np.abs(rigid3.rotation_matrix(pose) - rotation).max() + np.abs(n - normal).max()
              for pose, n in zip(possible.poses, possible.normals, strict=True)]  # fmt: skip
    right = int(np.argmin(errors))
    assert errors[right] < 1e-6
    np.testing.assert_allclose(possible.distances[right], distance / np.linalg.norm(t), rtol=1e-6)


# ---- which of the four poses


def random_pair(rng: np.random.Generator, field_deg: float, noise_px: float) -> tuple[Array, Array, Array, float]:
    """Normalised points of 100 points of two cameras that look at one thing from anywhere, their pose, their noise."""
    half = np.tan(np.radians(field_deg) / 2)
    while True:
        depth = rng.uniform(4, 12, 100)
        xyz = np.column_stack([rng.uniform(-1, 1, (100, 2)) * half * [1, 0.75], np.ones(100)]) * depth[:, None]
        direction = rng.normal(size=3)
        center = direction / np.linalg.norm(direction) * rng.uniform(0.3, 2.0)
        z = np.array([0, 0, 8.0]) - center
        z /= np.linalg.norm(z)
        x = np.cross([0, 1.0, 0], z) / np.linalg.norm(np.cross([0, 1.0, 0], z))
        rotation = rigid3.exp_so3(rng.normal(size=3) * [0.01, 0.01, 0.2]) @ np.stack([x, np.cross(z, x), z])
        moved = (xyz - center) @ rotation.T
        if (moved[:, 2] > 0.5).all():
            break
    noise = noise_px * half / 500.0
    xn1, xn2 = xyz[:, :2] / xyz[:, 2:], moved[:, :2] / moved[:, 2:]
    t = -rotation @ center
    pose = rigid3.from_matrix(rotation, t / np.linalg.norm(t))
    return xn1 + rng.normal(0, noise, xn1.shape), xn2 + rng.normal(0, noise, xn2.shape), pose, noise


def is_right(pose: Array, truth: Array) -> bool:
    turn = rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(truth).T)
    return bool(turn < 90 and pose[4:] @ truth[4:] > 0)


def estimate(xn1: Array, xn2: Array, noise: float) -> Array:
    essential = epipolar.nearest_essential(eight_point(xn1, xn2)[0])
    if not noise:
        return essential
    start = epipolar.choose_in_front(epipolar.decompose_essential(essential), xn1, xn2)[0]
    return epipolar.essential_from_pose(refine_relative_pose(start, xn1, xn2, 3 * noise))


def test_the_pose_is_chosen_rightly_or_called_undecidable() -> None:
    """A thousand random pairs; of a hundred with a pixel of noise in five degrees of field some cannot be told."""
    rng = np.random.default_rng(7)
    for _ in range(900):
        xn1, xn2, pose, _ = random_pair(rng, rng.uniform(20, 70), 0.0)
        choice = choose_pose(estimate(xn1, xn2, 0.0), xn1, xn2)
        assert choice.is_decided
        assert is_right(choice.pose, pose)
        assert choice.num_in_front.tolist().count(0) == 3
    num_decided = 0
    for _ in range(100):
        xn1, xn2, pose, noise = random_pair(rng, 5.0, 1.0)
        choice = choose_pose(estimate(xn1, xn2, noise), xn1, xn2, noise)
        num_decided += choice.is_decided
        assert not choice.is_decided or is_right(choice.pose, pose)
    assert num_decided >= 95


def test_a_turn_on_the_spot_and_two_copies_are_undecidable() -> None:
    rng = np.random.default_rng(8)
    for _ in range(20):
        rotation = rigid3.exp_so3(rng.normal(size=3) * 0.1)
        xn1 = rng.uniform(-0.4, 0.4, (100, 2))
        turned = np.column_stack([xn1, np.ones(100)]) @ rotation.T
        xn2 = turned[:, :2] / turned[:, 2:] + rng.normal(0, 5e-4, xn1.shape)
        assert choose_pose(estimate(xn1, xn2, 5e-4), xn1, xn2, 5e-4).reason
    same = choose_pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]), xn1, xn1, 5e-4)
    assert "0 of 100 points have a parallax" in same.reason
