"""Two-view and absolute poses from unit rays in every direction: exact cases, noise, OpenCV on what lies in front."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, bearings, project, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import epipolar, five_point, p3p, resection, rigid3
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.two_view import Ransac, verify_pair
from sfmapp.scene.correspondences import TwoViewConfig

Array = NDArray[np.float64]

PANORAMA = Camera(CameraModel.EQUIRECTANGULAR, 2000, 1000, np.array([2000.0, 1000.0]), focal_source="user")
NARROW = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 800, 700.0, 20.0, "user")


def unit(xyz: Array) -> Array:
    return xyz / np.linalg.norm(xyz, axis=1, keepdims=True)


def all_round(seed: int, num: int) -> tuple[np.random.Generator, Array, Array, Array]:
    """A pose, points on all sides of two cameras, and in the frame of the second."""
    rng = np.random.default_rng(seed)
    shift = rng.normal(size=3)
    pose = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), shift / np.linalg.norm(shift))
    xyz = rng.uniform(3.0, 6.0, (num, 1)) * unit(rng.normal(size=(num, 3)))
    return rng, pose, xyz, rigid3.apply(pose, xyz)


def disturbed(rays: Array, sigma: float, rng: np.random.Generator) -> Array:
    return unit(rays + rng.normal(0.0, sigma, rays.shape))


def apart_deg(pose: Array, other: Array) -> tuple[float, float]:
    turn = rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(other).T
    cosine = pose[4:] @ other[4:] / np.linalg.norm(pose[4:]) / np.linalg.norm(other[4:])
    return float(rigid3.rotation_angle_deg(turn)), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


# ---------------------------------------------------------------------------------------------------------- two views


def test_the_error_on_the_sphere_has_the_noise_of_the_rays() -> None:
    """One residual of unit variance a pair, in every direction; on the plane the same in the middle of the picture."""
    rng, pose, xyz, seen = all_round(0, 20_000)
    sigma = 1e-3
    a, b = disturbed(unit(xyz), sigma, rng), disturbed(unit(seen), sigma, rng)
    essential = epipolar.essential_from_pose(pose)
    assert epipolar.sampson_errors(essential, unit(xyz), unit(seen)).max() < 1e-25
    squared = epipolar.sampson_errors(essential, a, b) / sigma**2
    assert 0.96 < squared.mean() < 1.04
    ahead = (a[:, 2] > 0.995) & (b[:, 2] > 0.9)
    flat = epipolar.sampson_errors(essential, a[ahead, :2] / a[ahead, 2:], b[ahead, :2] / b[ahead, 2:]) / sigma**2
    assert ahead.sum() > 10
    assert np.abs(np.sqrt(flat / squared[ahead]) - 1.0).max() < 0.15


def test_depths_along_rays_are_distances_and_negative_behind() -> None:
    _, pose, xyz, seen = all_round(1, 300)
    depths, angles = epipolar.ray_depths(pose, unit(xyz), unit(seen))
    distances = np.stack([np.linalg.norm(xyz, axis=1), np.linalg.norm(seen, axis=1)], 1)
    wide = angles > 0.02
    np.testing.assert_allclose(depths[wide], distances[wide], rtol=1e-9)
    assert (xyz[wide, 2] < 0).mean() > 0.4
    back = np.concatenate([pose[:4], -pose[4:]])
    assert (epipolar.ray_depths(back, unit(xyz), unit(seen))[0][wide] < 0).all()


@pytest.mark.parametrize("seed", range(20))
def test_five_rays_allow_the_true_essential_matrix(seed: int) -> None:
    _, pose, xyz, seen = all_round(seed, 5)
    true = epipolar.essential_from_pose(pose)
    found = five_point.essentials_of_samples(unit(xyz), unit(seen), np.arange(5)[None])
    assert min(min(np.abs(e - true).max(), np.abs(e + true).max()) for e in found) < 1e-7
    for e in found:  # each of them is an essential matrix that the five agree with
        assert epipolar.sampson_errors(e, unit(xyz), unit(seen)).max() < 1e-15
        np.testing.assert_allclose(np.linalg.svd(e)[1], [np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_in_front_the_solutions_are_those_of_opencv(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-2, -2, 3], [2, 2, 8], (5, 3))
    seen = rigid3.apply(np.concatenate([rigid3.quaternion(rigid3.exp_so3([0.1, 0.2, 0.0])), [1.0, 0.2, 0.1]]), xyz)
    flat = [points[:, :2] / points[:, 2:] for points in (xyz, seen)]
    theirs = cv2.findEssentialMat(*flat, np.eye(3), cv2.RANSAC, 0.999, 1e-9)[0].reshape(-1, 3, 3)
    ours = five_point.essentials_of_samples(unit(xyz), unit(seen), np.arange(5)[None])
    for e in theirs:
        e = e / np.linalg.norm(e)
        assert min(min(np.abs(e - other).max(), np.abs(e + other).max()) for other in ours) < 1e-6


def test_a_pair_of_panoramas_is_told_from_wrong_matches_as_well_as_its_noise_allows() -> None:
    rng, pose, xyz, seen = all_round(4, 400)
    xy1, xy2 = (project(PANORAMA, points) + rng.normal(0.0, 0.5, (400, 2)) for points in (xyz, seen))
    wrong = rng.random(400) < 0.4
    xy2[wrong] = rng.uniform(0.0, 1.0, (wrong.sum(), 2)) * [2000.0, 1000.0]
    found = verify_pair(xy1, xy2, PANORAMA, PANORAMA, MatchingOptions(), Ransac(5000, 7))
    assert found.config == TwoViewConfig.CALIBRATED
    assert found.is_inlier[~wrong].mean() > 0.98
    assert found.is_inlier[wrong].mean() < 0.03  # a band of 4 px on both sides, cut by what lies in front of both
    turn, shift = apart_deg(found.cam2_from_cam1, pose)
    # 0.5 px are 0.09 degrees; 240 pairs under angles of 13 degrees
    assert 1e-4 < turn < 0.05
    assert 1e-4 < shift < 0.2
    again = verify_pair(xy1, xy2, PANORAMA, PANORAMA, MatchingOptions(), Ransac(5000, 7))
    np.testing.assert_array_equal(found.cam2_from_cam1, again.cam2_from_cam1)
    other = verify_pair(xy1, xy2, PANORAMA, PANORAMA, MatchingOptions(), Ransac(5000, 8))
    assert apart_deg(other.cam2_from_cam1, found.cam2_from_cam1)[1] < 0.02


def test_a_panorama_and_an_ordinary_photograph_make_a_pair() -> None:
    rng, pose, xyz, seen = all_round(5, 4000)
    xy2 = project(NARROW, seen)
    inside = (seen[:, 2] > 0) & (xy2 > 0).all(1) & (xy2 < [1000, 800]).all(1)
    xy1, xy2 = project(PANORAMA, xyz[inside]), xy2[inside] + rng.normal(0.0, 0.5, (inside.sum(), 2))
    found = verify_pair(xy1, xy2, PANORAMA, NARROW, MatchingOptions(), Ransac(5000, 7))
    assert found.config == TwoViewConfig.CALIBRATED
    assert found.is_inlier.mean() > 0.98
    assert max(apart_deg(found.cam2_from_cam1, pose)) < 1.0
    assert [points.shape[1] for points in bearings([PANORAMA, NARROW], [xy1, xy2])] == [3, 3]
    assert [points.shape[1] for points in bearings([NARROW, NARROW], [xy2, xy2])] == [2, 2]


def test_panoramas_from_one_place_differ_by_a_rotation_and_chance_is_no_pair() -> None:
    rng, pose, xyz, _ = all_round(6, 300)
    turned = xyz @ rigid3.rotation_matrix(pose).T
    xy1, xy2 = (project(PANORAMA, points) + rng.normal(0.0, 0.5, (300, 2)) for points in (xyz, turned))
    found = verify_pair(xy1, xy2, PANORAMA, PANORAMA, MatchingOptions(), Ransac(5000, 7))
    assert found.config == TwoViewConfig.PANORAMIC
    assert found.is_inlier.mean() > 0.95
    turn = rigid3.rotation_matrix(found.cam2_from_cam1) @ rigid3.rotation_matrix(pose).T
    assert rigid3.rotation_angle_deg(turn) < 0.05
    assert not found.cam2_from_cam1[4:].any()
    chance = rng.uniform(0.0, 1.0, (2, 150, 2)) * [2000.0, 1000.0]
    found = verify_pair(*chance, PANORAMA, PANORAMA, MatchingOptions(), Ransac(5000, 7))
    assert found.config == TwoViewConfig.DEGENERATE
    assert not found.is_inlier.any()


# ---------------------------------------------------------------------------------------------------------- one view


@pytest.mark.parametrize("seed", range(20))
def test_three_rays_allow_the_true_pose(seed: int) -> None:
    _, pose, xyz, seen = all_round(seed, 3)
    rotations, translations = np.empty((4, 3, 3)), np.empty((4, 3))
    count = p3p.poses_of_three(xyz, unit(seen), rotations, translations)
    true = rigid3.rotation_matrix(pose)
    assert min(np.abs(r - true).max() for r in rotations[:count]) < 1e-6
    for r, t in zip(rotations[:count], translations[:count], strict=True):
        np.testing.assert_allclose(unit(xyz @ r.T + t), unit(seen), atol=1e-8)
        assert np.linalg.det(r) == pytest.approx(1.0)


@pytest.mark.parametrize("same", [(0, 1), (0, 2), (1, 2)])
def test_two_points_may_be_seen_along_one_ray(same: tuple[int, int]) -> None:
    # a keypoint that matches two points: a division by zero ended the run in one of four such samples
    rotations, translations = np.empty((4, 3, 3)), np.empty((4, 3))
    for seed in range(40):
        rng = np.random.default_rng(seed)
        xyz, rays = rng.normal(size=(3, 3)), unit(rng.normal((0.0, 0.0, 3.0), 1.0, (3, 3)))
        rays[same[1]] = rays[same[0]]
        count = p3p.poses_of_three(xyz, rays, rotations, translations)
        for r, t in zip(rotations[:count], translations[:count], strict=True):
            np.testing.assert_allclose(unit(xyz @ r.T + t), rays, atol=1e-5)


@pytest.mark.parametrize("seed", range(10))
def test_in_front_the_poses_are_those_of_opencv(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = rng.uniform([-2, -2, 3], [2, 2, 8], (3, 3))
    pose = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    xyz = rigid3.apply(rigid3.inverse(pose), seen)
    count, turns, shifts = cv2.solveP3P(xyz, seen[:, :2] / seen[:, 2:], np.eye(3), None, cv2.SOLVEPNP_P3P)
    rotations, translations = np.empty((4, 3, 3)), np.empty((4, 3))
    found = p3p.poses_of_three(xyz, unit(seen), rotations, translations)
    assert found >= count
    for k in range(count):
        theirs = rigid3.exp_so3(turns[k].ravel())
        assert min(np.abs(r - theirs).max() for r in rotations[:found]) < 1e-5
        assert min(np.abs(t - shifts[k].ravel()).max() for t in translations[:found]) < 1e-4


def test_a_view_all_round_is_placed_among_wrong_points() -> None:
    rng, pose, xyz, seen = all_round(8, 300)
    sigma = 1e-3
    rays = disturbed(unit(seen), sigma, rng)
    wrong = rng.random(300) < 0.6
    rays[wrong] = unit(rng.normal(size=(wrong.sum(), 3)))
    rays[0] = np.nan
    found = resection.estimate_pose(xyz, rays, 4.0 * sigma)
    assert found is not None
    assert found.is_inlier[~wrong][1:].mean() > 0.97
    assert not found.is_inlier[wrong].any()
    assert not found.is_inlier[0]
    # of three points 3 to 6 away; the adjustment that follows takes all
    assert np.linalg.norm(rigid3.center(found.cam_from_world) - rigid3.center(pose)) < 0.03
    again = resection.estimate_pose(xyz, rays, 4.0 * sigma)
    np.testing.assert_array_equal(found.cam_from_world, again.cam_from_world)


def test_points_on_a_line_or_too_few_have_no_pose() -> None:
    rng = np.random.default_rng(9)
    line = np.outer(np.arange(1.0, 20.0), [0.3, 0.2, 1.0])
    assert resection.estimate_pose(line, unit(line + np.array([0.1, 0.0, 0.2])), 1e-3) is None
    assert resection.estimate_pose(rng.normal(size=(3, 3)), unit(rng.normal(size=(3, 3))), 1e-3) is None
    assert five_point.find_essential(unit(rng.normal(size=(7, 3))), unit(rng.normal(size=(7, 3))), 1e-3, 10, 0) is None


@pytest.mark.parametrize(
    ("camera", "is_wide"),
    [
        (PANORAMA, True),
        (NARROW, False),
        (Camera(CameraModel.OPENCV_FISHEYE, 640, 480, np.array([300.0, 300, 320, 240, 0, 0, 0, 0])), False),
        (Camera(CameraModel.OPENCV_FISHEYE, 640, 480, np.array([220.0, 220, 320, 240, 0, 0, 0, 0])), True),
        (Camera(CameraModel.EUCM, 640, 640, np.array([150.0, 150, 320, 320, 0.62, 1.0])), True),
        (Camera(CameraModel.DIVISION, 640, 480, np.array([430.0, 430, 320, 240, -0.15])), False),
    ],
)
def test_wide_is_what_shows_more_than_88_degrees_off_its_axis(camera: Camera, is_wide: bool) -> None:
    """640x480 at 300 px a radian ends at 76 degrees, at 220 px a radian at 104."""
    assert camera.is_wide is is_wide
