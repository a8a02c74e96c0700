"""From projective to affine and metric: parallel lines, known points, the absolute conic; critical motions."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.absolute_conic import (
    NoMetricFrameError,
    kind_of_motion,
    linear_dual_quadric,
    self_calibrate,
)
from sfmapp.geometry.factorisation import factorise
from sfmapp.geometry.projective import dehomogenized, in_frame
from sfmapp.geometry.projective_adjustment import adjust_projective, sightings_of
from sfmapp.geometry.upgrade import (
    affine_frame,
    find_space_homography,
    meeting_point,
    place_covariances,
    plane_through,
)
from uncalibrated_scenes import CENTER, SIZE, K, scene

FRAME = np.random.default_rng(7).normal(size=(4, 4))


def test_parallel_lines_make_the_frame_affine() -> None:
    one = scene(2, 12)
    directions = np.array([[1.0, 0.2, 0.1], [-0.3, 1.0, 0.4], [0.2, -0.5, 1.0]])
    at_infinity = []
    for direction in directions:
        starts = np.random.default_rng(1).uniform(-1, 1, (3, 3))
        lines = np.stack([np.c_[starts, np.ones(3)], np.c_[starts + direction, np.ones(3)]], 1) @ FRAME.T
        point, left = meeting_point(lines)
        assert left < 1e-6
        at_infinity.append(point)
    plane, info = plane_through(at_infinity)
    assert info.is_inlier.all()
    g = affine_frame(plane)
    xyz = dehomogenized(one.points @ FRAME.T @ g.T)
    # an affine map, to the last digit: ratios along lines are those of the world
    design = np.c_[one.xyz, np.ones(12)]
    fit = design @ np.linalg.lstsq(design, xyz, rcond=None)[0]
    assert np.abs(fit - xyz).max() < 1e-9 * np.abs(xyz).max()
    with pytest.raises(ValueError, match="one plane"):
        plane_through([at_infinity[0], at_infinity[1], 0.4 * at_infinity[0] - at_infinity[1]])
    with pytest.raises(ValueError, match="not all one line"):
        meeting_point(np.stack([lines[0], lines[0]]))
    with pytest.raises(ValueError, match="two lines or more"):
        meeting_point(lines[:1])
    with pytest.raises(ValueError, match="finite"):
        meeting_point(lines * np.nan)


def test_five_known_points_are_enough_and_four_are_not() -> None:
    one = scene(2, 30)
    points = one.points @ FRAME.T
    frame, info = find_space_homography(points[:5], one.xyz[:5])
    assert info.num_free == 1
    assert info.covariance is None
    assert np.abs(dehomogenized(points @ frame.T) - one.xyz).max() < 1e-8
    with pytest.raises(ValueError, match="give 5 known points, got 4"):
        find_space_homography(points[:4], one.xyz[:4])
    with pytest.raises(ValueError, match="not finite, the first is 1"):
        find_space_homography(points[:5], np.where(np.arange(5)[:, None] == 1, np.nan, one.xyz[:5]))
    flat = one.points[:8] * [1, 1, 0, 1]
    assert find_space_homography(flat @ FRAME.T, flat[:, :3])[1].num_free > 1
    line = np.c_[np.outer(np.linspace(-1, 1, 8), [1.0, 2, 3]), np.ones(8)]
    assert find_space_homography(line @ FRAME.T, line[:, :3])[1].num_free > 1


def test_wrong_known_points_are_found_and_the_covariance_holds() -> None:
    one = scene(2, 40, seed=1)
    points = one.points @ FRAME.T
    z, found = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        known = one.xyz[:12] + rng.normal(0, 0.01, (12, 3))
        wrong = rng.choice(12, 3, replace=False)
        known[wrong] += rng.uniform(0.3, 0.6, (3, 3))
        frame, info = find_space_homography(points[:12], known, is_robust=True)
        found.append(not info.is_inlier[wrong].any())
        assert info.is_inlier.sum() >= 7
        good = np.setdiff1d(np.arange(12), wrong)
        frame, info = find_space_homography(points[good], known[good], sigma=0.01)
        assert info.covariance is not None
        gap = dehomogenized(points[12:] @ frame.T) - one.xyz[12:]
        covariance = place_covariances(frame, info.covariance, points[12:])
        z.append(np.einsum("ni,nij,nj->n", gap, np.linalg.inv(covariance), gap).mean() / 3.0)
    assert np.mean(found) == 1.0
    assert 0.75 < np.mean(z) < 1.3


def test_with_six_points_no_one_is_called_wrong() -> None:
    one = scene(2, 6)
    known = one.xyz.copy()
    known[3] += 0.5
    _, info = find_space_homography(one.points @ FRAME.T, known, is_robust=True)
    # one is too many, but nothing says which: all count, and what is left is in sigma
    assert info.is_inlier.all()
    assert info.sigma_px > 0.02


@pytest.mark.parametrize("unknown", ["focal", "focal and centre", "everything"])
def test_self_calibration_is_exact_for_general_motion(unknown: str) -> None:
    k = K.copy()
    if unknown != "focal":
        k[:2, 2] += [30.0, -20.0]
    if unknown == "everything":
        k[1, 1], k[0, 1] = 960.0, 12.0
    one = scene(8, k=k)
    cameras, points = in_frame(one.cameras, one.points, FRAME)
    found = self_calibrate(cameras, points, CENTER, SIZE, unknown)  # type: ignore[arg-type]
    assert np.abs(found.k - k).max() < 1e-3
    assert found.num_free == 1
    xyz = dehomogenized(points @ found.frame.T)
    to_truth = similarity.umeyama(xyz, one.xyz)
    assert np.abs(similarity.apply(to_truth, xyz) - one.xyz).max() < 1e-6


def test_the_linear_quadric_is_that_of_the_cameras_and_positive() -> None:
    one = scene(5)
    about = np.array([[1 / SIZE, 0, -CENTER[0] / SIZE], [0, 1 / SIZE, -CENTER[1] / SIZE], [0, 0, 1.0]])
    cameras, _ = in_frame(about @ one.cameras, one.points, FRAME)
    q, values = linear_dual_quadric(cameras)
    assert values[9] < 1e-9 * values[8]
    for p in cameras:
        w = p @ q @ p.T
        assert np.linalg.eigvalsh(w)[0] > 0
        assert np.allclose(w / w[2, 2], np.diag([(900 / SIZE) ** 2, (900 / SIZE) ** 2, 1.0]), atol=1e-6)


def test_self_calibration_is_as_near_as_noise_lets_it() -> None:
    errors, sigmas = [], []
    for seed in range(8):
        one = scene(8, 60, seed=seed, noise=0.5)
        model, _ = adjust_projective(factorise(one.xy)[0], sightings_of(one.xy))
        found = self_calibrate(model.cameras, model.points, CENTER, SIZE)
        errors.append(np.log(found.k[0, 0] / 900.0))
        sigmas.append(found.log_focal_sigma)
        xyz = dehomogenized(model.points @ found.frame.T)
        gap = similarity.apply(similarity.umeyama(xyz, one.xyz), xyz) - one.xyz
        assert np.sqrt((gap**2).mean()) < 0.01
        # in front of every camera
        metric = model.cameras @ np.linalg.inv(found.frame)
        metric *= np.sign(np.linalg.det(metric[:, :, :3]))[:, None, None]
        assert (np.c_[xyz, np.ones(60)] @ metric[:, 2].T > 0).all()
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert 0.3 < np.sqrt(np.mean((np.array(errors) / sigmas) ** 2)) < 3.0


def test_critical_motions_are_refused_and_named() -> None:
    table = scene(8, turntable=True, noise=0.2)
    model, _ = adjust_projective(factorise(table.xy)[0], sightings_of(table.xy))
    # square pixels and a known centre tell a turntable; without them it is critical
    known = self_calibrate(model.cameras, model.points, CENTER, SIZE)
    assert abs(known.k[0, 0] / 900.0 - 1.0) < 0.02
    with pytest.raises(NoMetricFrameError, match="one axis"):
        self_calibrate(model.cameras, model.points, CENTER, SIZE, "everything")
    still = scene(6, turn=1e-9)
    cameras, points = in_frame(still.cameras, still.points, FRAME)
    with pytest.raises(NoMetricFrameError, match="without turning"):
        self_calibrate(cameras, points, CENTER, SIZE)
    with pytest.raises(NoMetricFrameError, match="at least 3"):
        self_calibrate(cameras[:2], points, CENTER, SIZE)
    with pytest.raises(ValueError, match="finite"):
        self_calibrate(cameras * np.nan, points, CENTER, SIZE)
    with pytest.raises(ValueError, match="unknown is"):
        self_calibrate(cameras, points, CENTER, SIZE, "nothing")  # type: ignore[arg-type]
    assert "one axis" in kind_of_motion(np.eye(4), table.cameras)
    rolled = np.array([K @ np.column_stack([rigid3.exp_so3([0.3 * v, 0.1 * v * v, 0]), [0, 0, 5]]) for v in range(4)])
    assert "more than one camera" in kind_of_motion(np.eye(4), rolled)
