"""The synthetic scenes are what they claim to be."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.camera.camera import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera, true_correspondences


@pytest.mark.parametrize("layout", ["ring", "grid", "forward"])
@pytest.mark.parametrize("model", list(CameraModel))
def test_ground_truth_is_exact_and_noise_is_as_asked(layout, model):
    scene = make_scene(3, 9, 400, synthetic_camera(model), sigma_px=0.5, layout=layout)
    assert np.abs(scene.ground_truth.residuals_px()).max() < 1e-9
    noise = scene.observed.residuals_px()
    # the standard deviation of n samples is known to 1 / sqrt(2 n): five sigma
    assert abs(noise.std() / 0.5 - 1) < 5 / np.sqrt(2 * noise.size)
    assert np.diff(scene.observed.tracks.track_ptr).min() >= 2
    assert scene.observed.is_registered.all()
    assert scene.observed.is_triangulated.all()


def test_seed_decides_everything():
    a, b, c = (make_scene(s, outlier_ratio=0.1) for s in (5, 5, 6))
    assert a.observed.tracks.obs_xy.tobytes() == b.observed.tracks.obs_xy.tobytes()
    assert a.ground_truth.point_xyz.tobytes() == b.ground_truth.point_xyz.tobytes()
    assert a.ground_truth.point_xyz.tobytes() != c.ground_truth.point_xyz.tobytes()


def test_outliers_are_those_marked():
    scene = make_scene(1, 8, 600, outlier_ratio=0.2)
    assert abs(scene.obs_is_outlier.mean() - 0.2) < 0.05
    errors = np.linalg.norm(scene.observed.residuals_px(), axis=1)
    assert np.median(errors[scene.obs_is_outlier]) > 50
    assert errors[~scene.obs_is_outlier].max() < 4


def test_cameras_are_dealt_out_in_turn():
    cameras = [synthetic_camera(m) for m in (CameraModel.PINHOLE, CameraModel.OPENCV_FISHEYE)]
    scene = make_scene(0, 5, 100, cameras)
    assert scene.ground_truth.image_camera_idx.tolist() == [0, 1, 0, 1, 0]
    with pytest.raises(ValueError, match="layout"):
        make_scene(layout="spiral")  # type: ignore[arg-type]


def test_perturb_moves_what_it_says():
    scene = make_scene(2, 60, 300)
    size = np.sqrt(((scene.ground_truth.centers - scene.ground_truth.centers.mean(0)) ** 2).sum(1).mean())
    moved = perturb(scene.observed, rotation_deg=1.0, seed=1)
    assert np.abs(moved.centers - scene.ground_truth.centers).max() < 1e-12
    relative = rigid3.rotation_matrix(
        rigid3.compose(moved.cam_from_world, rigid3.inverse(scene.ground_truth.cam_from_world))
    )
    assert 0.8 < np.degrees(rigid3.log_so3(relative).std()) < 1.2
    moved = perturb(scene.observed, translation_fraction=0.01, point_fraction=0.02, focal_fraction=0.1, seed=1)
    assert 0.8 < (moved.centers - scene.ground_truth.centers).std() / (0.01 * size) < 1.2
    assert 0.8 < (moved.point_xyz - scene.ground_truth.point_xyz).std() / (0.02 * size) < 1.2
    assert moved.cameras[0].focal != scene.ground_truth.cameras[0].focal
    assert (moved.cameras[0].params[1:] == scene.ground_truth.cameras[0].params[1:]).all()


def test_true_correspondences_obey_their_geometry():
    scene = make_scene(
        4, 6, 500, synthetic_camera(CameraModel.PINHOLE), sigma_px=0.0, layout="grid", outlier_ratio=0.05
    )
    found = true_correspondences(scene)
    assert found.num_pairs == 15
    assert (found.num_inliers[found.config == 0] == 0).all()
    p = int(np.argmax(found.num_inliers))
    i, j = found.pair_image_idx[p]
    ends = [scene.keypoints(a)[found.matches_of_pair(p)[:, k]] for k, a in enumerate((i, j))]
    x_i, x_j = (np.column_stack([xy, np.ones(len(xy))]) for xy in ends)
    line = x_i @ found.fundamental[p].T
    assert np.abs((x_j * line).sum(1) / np.linalg.norm(line[:, :2], axis=1)).max() < 1e-8
    assert 1 < found.median_angle_deg[p] < 90
