"""Motion-only refinement: recovers the ground truth, knows its own uncertainty, ignores outliers."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.adjust.pose import refine_pose
from sfmapp.camera.camera import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera


def view(scene, image=2):
    tracks = scene.observed.tracks
    obs = tracks.observations_of_image(image)
    return (
        scene.ground_truth.cam_from_world[image],
        scene.ground_truth.point_xyz[tracks.obs_track_idx[obs]],
        tracks.obs_xy[obs],
    )


def tangent(estimate, ground_truth):
    """(6,) rotation and translation that lead from the ground truth to the estimate, on the left."""
    delta = rigid3.compose(estimate, rigid3.inverse(ground_truth))
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(delta)), delta[4:]])


@pytest.mark.parametrize("model", [m for m in CameraModel if m != CameraModel.EQUIRECTANGULAR])
@pytest.mark.parametrize("refine_focal", [False, True])
def test_noise_free_pose_is_recovered(model, refine_focal):
    camera = synthetic_camera(model)
    scene = make_scene(1, 5, 300, camera, sigma_px=0.0)
    ground_truth, xyz, xy = view(scene)
    start = perturb(scene.ground_truth, rotation_deg=2, translation_fraction=0.05).cam_from_world[2]
    canonical = camera.canonical
    if refine_focal:
        canonical[:2] += 20.0
    found = refine_pose(
        canonical, start, xyz, xy, focal_sigma_px=np.inf if refine_focal else 0.0, relative_cost_tolerance=1e-14
    )  # fmt: skip
    assert np.abs(tangent(found.cam_from_world, ground_truth)).max() < 1e-6
    np.testing.assert_allclose(found.canonical, camera.canonical, atol=1e-3)
    assert found.is_inlier.all()


def test_covariance_is_honest():
    normalized = []
    for seed in range(60):
        scene = make_scene(seed, 3, 120, sigma_px=0.7)
        ground_truth, xyz, xy = view(scene, 1)
        camera = scene.ground_truth.cameras[0]
        found = refine_pose(
            camera.canonical, ground_truth, xyz, xy, scale_px=None, inlier_px=10.0, focal_sigma_px=np.inf,
            relative_cost_tolerance=1e-12,
        )  # fmt: skip
        error = np.append(tangent(found.cam_from_world, ground_truth), found.canonical[0] - camera.focal)
        normalized.append(error @ np.linalg.solve(found.covariance, error) / 7)
    # mean of 60 chi-squares of 7 degrees: standard deviation 0.07
    assert 0.75 < np.mean(normalized) < 1.25


def test_outliers_are_found_and_do_not_pull():
    scene = make_scene(3, 5, 600, outlier_ratio=0.3, sigma_px=0.5)
    ground_truth, xyz, xy = view(scene)
    start = perturb(scene.ground_truth, rotation_deg=0.5, translation_fraction=0.01).cam_from_world[2]
    found = refine_pose(scene.ground_truth.cameras[0].canonical, start, xyz, xy)
    tracks = scene.observed.tracks
    outlier = scene.obs_is_outlier[tracks.observations_of_image(2)]
    assert (found.is_inlier == ~outlier).mean() > 0.99
    assert np.abs(tangent(found.cam_from_world, ground_truth)).max() < 5e-3


def test_focal_prior_holds_and_degenerate_input_survives():
    scene = make_scene(4, 5, 300)
    ground_truth, xyz, xy = view(scene)
    canonical = scene.ground_truth.cameras[0].canonical
    free = refine_pose(canonical, ground_truth, xyz, xy, focal_sigma_px=np.inf)
    held = refine_pose(canonical, ground_truth, xyz, xy, focal_sigma_px=1e-3)
    assert abs(held.canonical[0] - canonical[0]) < 0.05 * abs(free.canonical[0] - canonical[0])
    empty = refine_pose(canonical, ground_truth, np.zeros((0, 3)), np.zeros((0, 2)))
    np.testing.assert_allclose(empty.cam_from_world, ground_truth, atol=1e-15)
    assert np.isinf(empty.covariance).all()
    behind = refine_pose(canonical, ground_truth, -xyz * 100, xy)
    assert np.isfinite(behind.cam_from_world).all()
    one = refine_pose(canonical, ground_truth, xyz[:1], xy[:1])
    assert np.isfinite(one.cam_from_world).all()
