"""Fundamental matrices and plain RANSAC: exact cases, known noise, OpenCV and PoseLib."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.fundamental import eight_point, epipoles, rank_two, refine_fundamental, seven_point
from sfmapp.geometry.ransac import ransac_fundamental, trials_needed

K = np.array([[900.0, 0, 512], [0, 905.0, 380], [0, 0, 1]])
POSE = rigid3.from_matrix(rigid3.exp_so3([0.1, -0.3, 0.05]), np.array([1.0, 0.2, -0.3]) / np.sqrt(1.13))
F = epipolar.fundamental_from_essential(epipolar.essential_from_pose(POSE), K, K)


def cloud(num: int, seed: int = 0, pose: np.ndarray = POSE) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of both views of points in front of both cameras."""
    xyz = np.random.default_rng(seed).uniform([-2, -1.5, 4], [2, 1.5, 9], (num, 3))
    return pixels(xyz), pixels(rigid3.apply(pose, xyz))


def pixels(xyz: np.ndarray) -> np.ndarray:
    return (xyz @ K.T)[:, :2] / xyz[:, 2:]


def distance(f: np.ndarray, g: np.ndarray) -> float:
    """Between matrices of unit norm, whichever their sign."""
    f, g = f / np.linalg.norm(f), g / np.linalg.norm(g)
    return float(min(np.linalg.norm(f - g), np.linalg.norm(f + g)))


def test_both_algorithms_are_exact_and_agree_with_opencv() -> None:
    import cv2

    xy1, xy2 = cloud(30)
    for is_normalized, tolerance in ((True, 1e-10), (False, 1e-5)):
        f, info = eight_point(xy1, xy2, is_normalized=is_normalized)
        assert distance(f, F) < tolerance
        assert abs(np.linalg.det(f)) < 1e-15
        assert info.num_free == 1
        assert info.is_inlier.all()
    found, info = seven_point(xy1[:7], xy2[:7])
    assert len(found) in (1, 3)
    assert info.num_free == 2
    assert min(distance(f, F) for f in found) < 1e-9
    theirs = cv2.findFundamentalMat(xy1[:7], xy2[:7], cv2.FM_7POINT)[0].reshape(-1, 3, 3)
    assert len(theirs) == len(found)
    for f in theirs:
        assert min(distance(f, g) for g in found) < 1e-7
    rng = np.random.default_rng(1)
    noisy = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
    # theirs is normalised by the mean distance, ours by the mean square: not the same, but within the noise
    eight = cv2.findFundamentalMat(*noisy, cv2.FM_8POINT)[0]
    ours = np.sqrt(epipolar.sampson_errors(eight_point(*noisy)[0], xy1, xy2).mean())
    assert 0.9 < ours / np.sqrt(epipolar.sampson_errors(eight, xy1, xy2).mean()) < 1.1


def test_normalisation_buys_condition_and_accuracy() -> None:
    rng = np.random.default_rng(2)
    errors = []
    for seed in range(20):
        xy1, xy2 = cloud(40, seed)
        noisy = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
        (good, well), (bad, ill) = eight_point(*noisy), eight_point(*noisy, is_normalized=False)
        assert ill.condition > 1e3 * well.condition
        errors.append([np.sqrt(epipolar.sampson_errors(f, xy1, xy2).mean()) for f in (good, bad)])
    with_it, without = np.mean(errors, 0)
    # 40 points bear on seven numbers
    assert 0.6 * 0.5 * np.sqrt(7 / 40) < with_it < 2.0 * 0.5 * np.sqrt(7 / 40)
    assert without > 1.5 * with_it


def test_the_refined_matrix_is_as_sure_as_it_says_and_at_the_bound() -> None:
    rng = np.random.default_rng(3)
    xy1, xy2 = cloud(60)
    _, exact = refine_fundamental(F, xy1, xy2, noise_px=0.5)
    assert exact.covariance is not None
    assert np.linalg.matrix_rank(exact.covariance, tol=1e-9 * np.trace(exact.covariance)) <= 7
    deviations, scaled, sigmas = [], [], []
    unit = F / np.linalg.norm(F)
    values, vectors = np.linalg.eigh(exact.covariance)
    for _ in range(150):
        noisy = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
        f, info = refine_fundamental(eight_point(*noisy)[0], *noisy)
        f = f * np.sign((f * unit).sum())
        deviations.append(epipolar.sampson_errors(f, xy1, xy2).mean())
        scaled.append((((f - unit).ravel() @ vectors[:, 2:]) ** 2 / values[2:]).sum())
        sigmas.append(info.sigma_px)
    # chi-square of seven, and the error at the true points that no unbiased estimate can be below
    assert 6.0 < np.mean(scaled) < 8.2
    assert 0.9 < np.sqrt(np.mean(deviations)) / (0.5 * np.sqrt(7 / 60)) < 1.1
    assert 0.47 < np.mean(sigmas) < 0.53


def test_wrong_matches_pull_less_where_they_are_expected() -> None:
    """A tenth of the matches off by 5 to 30 px: the covariance still holds, where least squares is lost."""
    rng = np.random.default_rng(8)
    xy1, xy2 = cloud(100)
    unit = F / np.linalg.norm(F)
    scaled, errors, sigmas = [], [], []
    for _ in range(60):
        a, b = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
        b[:10] += rng.uniform(5, 30, (10, 1)) * rng.choice([-1, 1], (10, 2))
        robust, info = refine_fundamental(F, a, b, is_robust=True)
        assert info.covariance is not None
        deviation = (robust * np.sign((robust * unit).sum()) - unit).ravel()
        scaled.append(deviation @ np.linalg.pinv(info.covariance, rcond=1e-12, hermitian=True) @ deviation)
        sigmas.append(info.sigma_px)
        plain, _ = refine_fundamental(F, a, b)
        errors.append([np.sqrt(epipolar.sampson_errors(f, xy1, xy2).mean()) for f in (robust, plain)])
    robust_error, plain_error = np.median(errors, 0)
    assert robust_error < 0.25
    assert plain_error > 3.0 * robust_error
    assert 0.45 < np.mean(sigmas) < 0.68
    assert 4.0 < np.median(scaled) < 12.0


def flat(num: int) -> tuple[np.ndarray, np.ndarray]:
    xyz = np.random.default_rng(4).uniform([-2, -1.5, 5], [2, 1.5, 5], (num, 3))
    xyz[:, 2] += 0.2 * xyz[:, 0]
    return pixels(xyz), pixels(rigid3.apply(POSE, xyz))


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_what_leaves_the_matrix_open_is_said(noise: float) -> None:
    rng = np.random.default_rng(5)
    xy1, _ = cloud(50)
    turned = rigid3.from_matrix(rigid3.rotation_matrix(POSE), np.zeros(3))
    line = np.linspace([100.0, 100.0], [900.0, 500.0], 50)
    cases = {"plane": (flat(50), 3), "rotation": (cloud(50, pose=turned), 3), "identical": ((xy1, xy1), 3),
             "line": ((line, line + np.array([5.0, 3.0])), 6), "scene": (cloud(50), 1)}  # fmt: skip
    for name, ((a, b), num_free) in cases.items():
        noisy = a + rng.normal(0, noise, a.shape), b + rng.normal(0, noise, b.shape)
        _, info = eight_point(*noisy, noise_px=noise)
        if name == "line":
            assert info.num_free >= num_free
        else:
            assert info.num_free == num_free, name
    one_place = np.full((9, 2), 7.0)
    assert eight_point(one_place, one_place)[1].num_free == 8


def test_bad_points_are_refused_in_words() -> None:
    xy1, xy2 = cloud(20)
    with pytest.raises(ValueError, match="at least 8 points, got 7"):
        eight_point(xy1[:7], xy2[:7])
    with pytest.raises(ValueError, match="7 points, got 8"):
        seven_point(xy1[:8], xy2[:8])
    xy1[3, 0] = np.nan
    with pytest.raises(ValueError, match="1 of 20 points are not finite, the first is 3"):
        eight_point(xy1, xy2)
    with pytest.raises(ValueError, match="two arrays"):
        ransac_fundamental(xy1, xy2[:5], 1.0)


def test_the_epipolar_line_of_the_literature_which_transposes() -> None:
    """A worked example with ``x_left^T F x_right = 0``: its F is the transpose of ours, pixels whole numbers."""
    theirs = np.array([[-0.003, -0.028, 13.19], [-0.003, -0.008, -29.2], [2.97, 56.38, -9999.0]])
    line = theirs.T @ [343.0, 221.0, 1.0]  # ours: F x1 with F = theirs^T
    np.testing.assert_allclose(line, [1.278, 45.008, -11928.03], atol=1e-9)
    unit = line / np.linalg.norm(line[:2])
    np.testing.assert_allclose(unit, [0.0284, 0.9996, -264.91], atol=5e-3)
    # printed 0.03 u + 0.99 v - 265 = 0: cut off after two digits
    np.testing.assert_allclose(unit[:2], [0.03, 0.99], atol=0.01)
    assert round(unit[2]) == -265
    # printed with few digits, it has not quite rank two; the nearest that has it has epipoles
    e1, e2 = epipoles(rank_two(theirs.T))
    np.testing.assert_allclose([rank_two(theirs.T) @ e1, rank_two(theirs.T).T @ e2], 0.0, atol=1e-12)


def test_ransac_finds_the_inliers_and_stops_when_it_may() -> None:
    np.testing.assert_allclose(trials_needed(0.5), np.log(0.01) / np.log(1 - 0.5**8))
    assert trials_needed(1.0) == 1.0
    assert trials_needed(0.0) == np.inf
    rng = np.random.default_rng(6)
    xy1, xy2 = cloud(200)
    noisy1, noisy2 = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
    noisy2[:80] = rng.uniform([0, 0], [1024, 760], (80, 2))
    for seed in range(3):
        f, info, history = ransac_fundamental(noisy1, noisy2, 2.0, seed=seed)
        assert info.is_inlier[80:].mean() > 0.9
        assert info.is_inlier[:80].mean() < 0.1
        assert np.sqrt(epipolar.sampson_errors(f, xy1[80:], xy2[80:]).mean()) < 0.5
        assert info.num_iterations == int(np.ceil(history[-1].needed)) or history[-1].trial == info.num_iterations
        counts = [one.num_inliers for one in history]
        assert counts == sorted(set(counts))
    few, info, history = ransac_fundamental(rng.uniform(0, 1000, (40, 2)), rng.uniform(0, 1000, (40, 2)), 0.5,
                                            max_trials=200)  # fmt: skip
    assert info.num_iterations == 200
    assert not history or trials_needed(info.is_inlier.mean()) > 200
    assert np.isnan(few).all() or info.is_inlier.sum() >= 8


def test_poselib_finds_the_same() -> None:
    poselib = pytest.importorskip("poselib")
    rng = np.random.default_rng(7)
    xy1, xy2 = cloud(200)
    noisy1, noisy2 = xy1 + rng.normal(0, 0.5, xy1.shape), xy2 + rng.normal(0, 0.5, xy2.shape)
    theirs, _ = poselib.estimate_fundamental(noisy1, noisy2, {"max_epipolar_error": 2.0}, {})
    ours, _ = refine_fundamental(eight_point(noisy1, noisy2)[0], noisy1, noisy2)
    errors = [np.sqrt(epipolar.sampson_errors(f, xy1, xy2).mean()) for f in (ours, theirs)]
    assert errors[0] < 1.05 * errors[1]
    assert max(errors) < 0.2
