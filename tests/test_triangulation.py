"""Triangulation: exact rays, robust tracks, and the thresholds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sfmapp.camera.camera import project
from sfmapp.geometry import rigid3, triangulation
from sfmapp.geometry.triangulation import Observed
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene


def run(kernel, model: Reconstruction, max_error_px: float = 4.0, min_angle_deg: float = 1.5) -> int:
    tracks = model.tracks
    return kernel(
        np.arange(tracks.num_tracks), Observed(tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy), model.views(),
        max_error_px, math.radians(min_angle_deg), model.point_xyz, model.obs_is_inlier,
    )  # fmt: skip


def blank(model: Reconstruction) -> Reconstruction:
    model = model.copy()
    model.point_xyz[:] = np.nan
    model.obs_is_inlier[:] = False
    return model


@pytest.mark.parametrize("layout", ["ring", "grid", "forward"])
def test_exact_observations_give_exact_points(layout):
    ground_truth = make_scene(0, 8, 300, layout=layout).ground_truth
    model = blank(ground_truth)
    num = run(triangulation.triangulate_tracks, model, max_error_px=1e-3, min_angle_deg=0.5)
    done = model.is_triangulated
    assert num == done.sum() > 0.9 * len(done)
    np.testing.assert_allclose(model.point_xyz[done], ground_truth.point_xyz[done], atol=1e-6)
    assert model.obs_is_inlier[done[model.tracks.obs_track_idx]].all()


def test_outliers_are_left_out_and_noise_is_averaged():
    scene = make_scene(1, 12, 800, sigma_px=0.5, outlier_ratio=0.15)
    model = blank(scene.observed)
    run(triangulation.triangulate_tracks, model)
    used = model.obs_is_inlier
    # a random pixel lies within 4 of the true one with probability 50 / 750000
    assert (used & scene.obs_is_outlier).sum() <= 0.03 * scene.obs_is_outlier.sum()
    long_enough = np.bincount(model.tracks.obs_track_idx[~scene.obs_is_outlier], minlength=800) >= 3
    assert model.is_triangulated[long_enough].mean() > 0.97
    error = np.linalg.norm(model.residuals_px()[used & ~scene.obs_is_outlier], axis=1)
    # the residuals of L observations shrink by the three degrees of freedom of their point
    assert 0.25 < np.sqrt((error**2).mean() / 2) < 0.55


def test_small_angles_and_single_observations_are_refused():
    scene = make_scene(2, 6, 200)
    model = blank(scene.ground_truth)
    assert run(triangulation.triangulate_tracks, model, min_angle_deg=179.0) == 0
    assert not model.is_triangulated.any()
    model.cam_from_world[1:] = np.nan
    assert run(triangulation.triangulate_tracks, model) == 0


@pytest.mark.parametrize(("share", "is_kept"), [(1e-8, False), (5e-4, False), (2e-3, True)])
def test_no_point_is_a_thousand_times_nearer_to_one_camera(share: float, is_kept: bool):
    """A wrong match whose one ray passes the other camera has a point in its centre, which agrees with any pixel."""
    model = make_scene(5, 2, 60, layout="forward").ground_truth
    tracks = model.tracks
    track = int(np.flatnonzero(np.diff(tracks.track_ptr) == 2)[0])
    far, near = range(tracks.track_ptr[track], tracks.track_ptr[track + 1])
    if rigid3.apply(model.cam_from_world[tracks.obs_image_idx[far]], model.centers[tracks.obs_image_idx[near]])[2] < 0:
        far, near = near, far  # the one in front, which the other sees
    image, other = tracks.obs_image_idx[near], tracks.obs_image_idx[far]
    away = share * np.linalg.norm(model.centers[other] - model.centers[image])
    ray = rigid3.rotation_matrix(model.cam_from_world[image]).T @ [0.3, 0.0, 1.0]
    model.point_xyz[track] = model.centers[image] + away * ray / np.linalg.norm(ray)
    for o in (near, far):
        rotation = rigid3.rotation_matrix(model.cam_from_world[tracks.obs_image_idx[o]])
        seen = rotation @ (model.point_xyz[track] - model.centers[tracks.obs_image_idx[o]])
        camera = model.cameras[model.image_camera_idx[tracks.obs_image_idx[o]]]
        tracks.obs_xy[o] = project(camera, seen[None])[0]
    for kernel in (triangulation.classify_observations, triangulation.triangulate_tracks):
        tried = model.copy()
        run(kernel, tried, max_error_px=1e-3)
        assert tried.is_triangulated[track] == is_kept
        assert tried.obs_is_inlier[[near, far]].tolist() == [is_kept, is_kept]


def test_classification_drops_and_restores():
    scene = make_scene(3, 8, 300, sigma_px=0.3)
    model = scene.observed.copy()
    assert run(triangulation.classify_observations, model) == 0
    assert model.obs_is_inlier.mean() > 0.99
    gone = model.copy()
    gone.point_xyz[:50] += 10.0
    run(triangulation.classify_observations, gone)
    assert np.isnan(gone.point_xyz[:50]).mean() > 0.9
    assert not gone.obs_is_inlier[~gone.is_triangulated[gone.tracks.obs_track_idx]].any()
    assert gone.is_triangulated[50:].all()
    # an image that is not registered supports nothing; back again, it does
    away = model.copy()
    away.cam_from_world[0] = np.nan
    run(triangulation.classify_observations, away)
    assert not away.obs_is_inlier[away.tracks.obs_image_idx == 0].any()
    kept = away.is_triangulated
    away.cam_from_world[0] = model.cam_from_world[0]
    run(triangulation.classify_observations, away)
    np.testing.assert_array_equal(
        away.obs_is_inlier[kept[away.tracks.obs_track_idx]], model.obs_is_inlier[kept[model.tracks.obs_track_idx]]
    )
