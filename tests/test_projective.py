"""Without a calibration: cameras of F, frames, resection, parallax, adjustment and factorisation."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3
from sfmapp.geometry.factorisation import depths_of_chain, factorise
from sfmapp.geometry.fundamental import eight_point, epipoles
from sfmapp.geometry.projective import (
    canonical_cameras,
    dehomogenized,
    in_frame,
    plane_parallax,
    project,
    resect_projective,
    steps_to_contact,
    triangulate_views,
)
from sfmapp.geometry.projective_adjustment import ProjectiveModel, Sightings, adjust_projective, sightings_of
from sfmapp.geometry.two_rays import fundamental_of
from sfmapp.geometry.upgrade import find_space_homography
from uncalibrated_scenes import K, distance, scene

AWAY = np.array([0.0, 0.0, 5.0])


def test_every_camera_pair_of_the_family_has_the_fundamental_matrix_it_was_made_of() -> None:
    one = scene(2)
    f = fundamental_of(*one.cameras)
    rng = np.random.default_rng(0)
    for plane, baseline in (((0.0, 0.0, 0.0), 1.0), (rng.normal(size=3), -2.5), (1e-3 * rng.normal(size=3), 40.0)):
        p1, p2 = canonical_cameras(f, plane, baseline)
        assert np.array_equal(p1, np.eye(3, 4))
        assert distance(fundamental_of(p1, p2), f) < 1e-9
        # the pixels fit exactly, and a map of space, one for all points, leads to the truth
        points, info = triangulate_views(np.stack([p1, p2]), one.xy)
        assert info.is_inlier.all()
        assert np.abs(project(np.stack([p1, p2]), points) - one.xy).max() < 1e-6
        frame, fit = find_space_homography(points, one.xyz)
        assert fit.num_free == 1
        assert np.abs(dehomogenized(points @ frame.T) - one.xyz).max() < 1e-6


def test_homogeneous_points_are_those_of_opencv() -> None:
    import cv2

    for noise in (0.0, 0.5):
        one = scene(2, noise=noise)
        pair = np.stack(canonical_cameras(eight_point(one.xy[:, 0], one.xy[:, 1])[0]))
        theirs = project(pair, cv2.triangulatePoints(pair[0], pair[1], one.xy[:, 0].T, one.xy[:, 1].T).T)
        ours = project(pair, triangulate_views(pair, one.xy)[0])
        # both algebraic, weighed differently
        rms = [np.sqrt(((xy - one.xy) ** 2).mean()) for xy in (ours, theirs)]
        assert rms[0] <= 1.02 * rms[1] + 1e-6
        assert np.abs(ours - theirs).max() < 2.0 * noise + 1e-5


def test_the_same_pixels_come_from_a_reconstruction_and_from_its_image_under_any_map() -> None:
    one = scene(4)
    for seed in range(3):
        frame = np.random.default_rng(seed).normal(size=(4, 4))
        cameras, points = in_frame(one.cameras, one.points, frame)
        assert np.abs(project(cameras, points) - one.xy).max() < 1e-7
        # and yet nothing metric is left: lengths have changed their ratios
        moved = dehomogenized(points)
        was, now = (np.linalg.norm(x[1:4] - x[0], axis=1) for x in (one.xyz, moved))
        assert np.ptp(now / was) > 0.1 * np.mean(now / was)


def test_no_cameras_of_what_is_no_fundamental_matrix() -> None:
    for bad, words in (
        (np.eye(3), "rank two"), (np.full((3, 3), np.nan), "finite"), (np.outer([1.0, 2, 3], [1.0, 1, 1]), "rank two"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            canonical_cameras(bad)
    with pytest.raises(ValueError, match="baseline"):
        canonical_cameras(fundamental_of(*scene(2).cameras), baseline=0.0)


def test_resection_is_exact_in_any_frame_finds_wrong_points_and_tells_planes() -> None:
    one = scene(3)
    frame = np.random.default_rng(1).normal(size=(4, 4))
    _, points = in_frame(one.cameras, one.points, frame)
    camera, info = resect_projective(points, one.xy[:, 2])
    assert info.num_free == 1
    assert np.abs(project(camera[None], points)[:, 0] - one.xy[:, 2]).max() < 1e-8
    xy = one.xy[:, 2].copy()
    xy[:20] += np.random.default_rng(2).uniform(20, 90, (20, 2))
    camera, info = resect_projective(points, xy, threshold_px=1.0)
    assert np.array_equal(info.is_inlier, np.arange(60) >= 20)
    assert np.abs(project(camera[None], points)[20:, 0] - xy[20:]).max() < 1e-7
    flat = one.points.copy()
    flat[:, 2] = 0.3
    assert resect_projective(flat @ frame.T, project(one.cameras, flat)[:, 1])[1].num_free > 1
    with pytest.raises(ValueError, match="at least 6"):
        resect_projective(points[:5], xy[:5])
    xy[0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        resect_projective(points, xy)


def test_parallax_is_distance_from_the_plane_over_depth_and_tells_the_side() -> None:
    one = scene(2, seed=3)
    r = rigid3.exp_so3([0.05, -0.1, 0.02])
    t = np.array([0.3, 0.1, -0.8])
    xyz = one.xyz + AWAY
    normal, d = np.array([0.1, -0.2, 1.0]) / np.sqrt(1.05), 4.9
    k2 = np.diag([700.0, 720.0, 1.0])
    xy1 = dehomogenized(xyz @ K.T)
    xy2 = dehomogenized((xyz @ r.T + t) @ k2.T)
    h = k2 @ (r + np.outer(t, normal) / d) @ np.linalg.inv(K)
    told = plane_parallax(h, k2 @ t, xy1, xy2, noise_px=0.2)
    truth = (d - xyz @ normal) / (d * xyz[:, 2])
    ratio = told.parallax / truth
    assert np.ptp(ratio) < 1e-9 * abs(ratio.mean())
    assert ratio.mean() > 0
    assert told.left_px.max() < 1e-9
    sides = told.sides()
    is_clear = sides != 0
    assert is_clear.mean() > 0.5
    assert np.array_equal(sides[is_clear], np.sign(d - xyz @ normal)[is_clear].astype(int))
    # of two points at one depth, the parallax has the ratio of their distances from the plane, from F and H alone
    f = fundamental_of(K @ np.eye(3, 4), k2 @ np.column_stack([r, t]))
    alone = plane_parallax(3.0 * h, epipoles(f)[1], xy1, xy2).parallax
    assert np.allclose(alone / alone[0], truth / truth[0], rtol=1e-8)


def test_sigmas_of_parallax_hold_what_noise_does() -> None:
    rng = np.random.default_rng(0)
    one = scene(2, num_points=200, seed=4)
    xyz = one.xyz + AWAY
    t, normal, d = np.array([0.5, 0.0, -0.3]), np.array([0.0, 0.0, 1.0]), 5.0
    h = K @ (np.eye(3) + np.outer(t, normal) / d) @ np.linalg.inv(K)
    xy = [dehomogenized(x @ K.T) for x in (xyz, xyz + t)]
    noisy = [x + rng.normal(0, 0.3, x.shape) for x in xy]
    exact, told = plane_parallax(h, K @ t, *xy), plane_parallax(h, K @ t, *noisy, noise_px=0.3)
    z = (told.parallax - exact.parallax) / told.sigmas
    assert 0.85 < z.std() < 1.15
    assert abs(np.median(told.left_px / 0.3) - 0.6745 * np.sqrt(2)) < 0.3


def test_time_to_contact_needs_no_calibration() -> None:
    xyz = scene(2, seed=5).xyz + AWAY
    step = np.array([0.1, -0.05, -0.5])
    xy1, xy2 = dehomogenized(xyz @ K.T), dehomogenized((xyz + step) @ K.T)
    focus = dehomogenized(K @ step)
    steps, sigma = steps_to_contact(xy1, xy2, focus, 0.1)
    assert np.allclose(steps, (xyz[:, 2] - 0.5) / 0.5)
    assert (sigma > 0).all()
    # going back, what was two steps before is where the camera stood: nothing is hit
    assert (steps_to_contact(xy2, xy1, focus, 0.1)[0] < 0).all()


def test_adjustment_reaches_the_minimum_of_scipy_and_the_noise_that_was_put_in() -> None:
    from scipy.optimize import least_squares

    one = scene(3, 20, noise=0.5)
    start = ProjectiveModel(one.cameras, triangulate_views(one.cameras, one.xy)[0])
    seen = sightings_of(one.xy)
    found, info = adjust_projective(start, seen)

    def left(x: np.ndarray) -> np.ndarray:
        return (project(x[:36].reshape(3, 3, 4), x[36:].reshape(-1, 4)) - one.xy).ravel()

    x0 = np.r_[
        (start.cameras / np.linalg.norm(start.cameras, axis=(1, 2))[:, None, None]).ravel(), start.points.ravel()
    ]
    theirs = least_squares(left, x0, x_scale="jac", method="trf", max_nfev=300)
    assert (found.left(seen) ** 2).sum() == pytest.approx(2.0 * theirs.cost, rel=1e-5)
    # 120 numbers, 33 + 60 - 15 unknowns
    assert 0.5 * np.sqrt(1 - 2.5 / np.sqrt(84)) < info.sigma_px < 0.5 * np.sqrt(1 + 2.5 / np.sqrt(84))
    with pytest.raises(ValueError, match="finite"):
        adjust_projective(start, Sightings(seen.view_idx, seen.point_idx, seen.xy * np.nan))


def test_adjustment_finds_wrong_pixels() -> None:
    one = scene(6, 60, noise=0.3)
    xy = one.xy.copy()
    rng = np.random.default_rng(0)
    wrong = rng.random(xy.shape[:2]) < 0.05
    xy[wrong] += rng.uniform(10, 30, (wrong.sum(), 2))
    seen = sightings_of(xy)
    start = ProjectiveModel(one.cameras, triangulate_views(one.cameras, xy)[0])
    _, info = adjust_projective(start, seen, is_robust=True)
    assert not info.is_inlier[wrong[seen.point_idx, seen.view_idx]].any()
    assert info.is_inlier[~wrong[seen.point_idx, seen.view_idx]].mean() > 0.97
    assert 0.25 < info.sigma_px < 0.36


def test_factorisation_is_exact_and_settles_from_depths_of_one() -> None:
    one = scene(5, 40)
    chain = np.array([fundamental_of(*one.cameras[v : v + 2]) for v in range(4)])
    told, info = factorise(one.xy, depths=depths_of_chain(one.xy, chain))
    assert info.num_free == 1
    assert info.singular_values[4] < 1e-9 * info.singular_values[3]
    assert info.num_iterations < 10
    assert np.abs(project(told.cameras, told.points) - one.xy).max() < 1e-6
    plain, info = factorise(one.xy, max_iterations=400)
    assert np.abs(project(plain.cameras, plain.points) - one.xy).max() < 1e-3
    frame, _ = find_space_homography(told.points, one.xyz)
    assert np.abs(dehomogenized(told.points @ frame.T) - one.xyz).max() < 1e-6


def test_factorisation_comes_near_the_least_reprojection_error() -> None:
    one = scene(6, 60, noise=0.5)
    found, info = factorise(one.xy)
    seen = sightings_of(one.xy)
    best, adjusted = adjust_projective(found, seen)
    rms = [np.sqrt((m.left(seen) ** 2).mean()) for m in (found, best)]
    # an algebraic minimum is above the other, and not by much
    assert rms[1] < rms[0] < 1.1 * rms[1]
    assert 0.45 < adjusted.sigma_px < 0.55
    assert info.num_free == 1


def test_factorisation_says_what_is_missing() -> None:
    one = scene(4, 20)
    with pytest.raises(ValueError, match="at least 8 points"):
        factorise(one.xy[:7])
    holes = one.xy.copy()
    holes[3, 1] = np.nan
    with pytest.raises(ValueError, match="1 of 80 are missing"):
        factorise(holes)
    flat = one.points.copy()
    flat[:, 2] = 0.0
    assert factorise(project(one.cameras, flat))[1].num_free > 1
    # one picture four times: no depth in it
    assert factorise(np.repeat(one.xy[:, :1], 4, axis=1))[1].num_free > 1
