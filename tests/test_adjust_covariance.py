"""The covariances are honest: normalised errors of simulated adjustments have the size that they claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nadir_block import nadir_block
from sfmapp.adjust.covariance import errors_in_gauge, estimate_covariances
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.selected_inverse import selected_covariances
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.georeference.factors import position_graph
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera

OPTIONS = AdjustOptions(relative_cost_tolerance=1e-10, max_iterations=100)


def normalized(errors, covariances):
    """e^T C^-1 e / dof of each."""
    return [float(e @ np.linalg.solve(c, e) / len(e)) for e, c in zip(errors, covariances, strict=True)]


def nees(seeds, *, layout, cameras, sigma_px=None, noise=0.7, options=OPTIONS, num_images=6, **arguments):
    """Mean NEES per degree of freedom of poses, intrinsics and points over seeds."""
    samples: tuple[list, list, list] = ([], [], [])
    for seed in seeds:
        scene = make_scene(seed, num_images, 150, cameras, sigma_px=noise, layout=layout)
        found = scene.observed.copy()
        adjust_bundle(found, options, **arguments)
        covariances = estimate_covariances(found, options, sigma_px=sigma_px, **arguments)
        assert covariances.is_determined
        poses, intrinsics, points = errors_in_gauge(found, scene.ground_truth, covariances)
        samples[0].extend(normalized(poses, covariances.poses))
        samples[1].extend(normalized(intrinsics, covariances.intrinsics))
        samples[2].extend(normalized(points, covariances.points))
    return covariances, [float(np.mean(s)) for s in samples]


@pytest.mark.parametrize("layout", ["ring", "grid", "forward"])
def test_nees_with_a_free_gauge(layout):
    covariances, (poses, intrinsics, points) = nees(range(120), layout=layout, cameras=synthetic_camera())
    assert covariances.num_gauge == 7
    assert 0.8 < poses < 1.25
    assert 0.8 < intrinsics < 1.25
    assert 0.8 < points < 1.25
    assert covariances.sigma_px == pytest.approx(0.7, rel=0.15)


def test_nees_with_a_camera_per_image_and_known_noise():
    cameras = [synthetic_camera(CameraModel.SIMPLE_RADIAL, focal=880.0 + 5 * i) for i in range(6)]
    _, (poses, intrinsics, points) = nees(range(120), layout="ring", cameras=cameras, sigma_px=0.7)
    assert 0.8 < poses < 1.25
    assert 0.8 < intrinsics < 1.25
    assert 0.8 < points < 1.25


def test_nees_with_constant_images():
    """Two constant images hold the whole gauge."""
    images = np.arange(6) >= 2
    covariances, (poses, intrinsics, points) = nees(
        range(120), layout="forward", cameras=synthetic_camera(), varying=Varying(images=images)
    )
    assert covariances.num_gauge == 0
    assert 0.8 < poses < 1.25
    assert 0.8 < intrinsics < 1.25
    assert 0.8 < points < 1.25


def test_one_constant_image_leaves_the_scale_open():
    scene = make_scene(0, 6, 200)
    found = scene.observed.copy()
    images = np.arange(6) >= 1
    adjust_bundle(found, OPTIONS, varying=Varying(images=images))
    assert estimate_covariances(found, OPTIONS, varying=Varying(images=images)).num_gauge == 1


def test_pose_prior_holds_the_gauge_and_counts_in_its_own_units():
    import gtsam
    from gtsam.symbol_shorthand import X

    from sfmapp.adjust.factors import gtsam_pose

    scene = make_scene(1, 6, 200, sigma_px=0.4)
    graph = gtsam.NonlinearFactorGraph()
    for i in (0, 3):
        graph.add(
            gtsam.PriorFactorPose3(
                X(i), gtsam_pose(scene.ground_truth.cam_from_world[i]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
            )
        )
    found = scene.observed.copy()
    adjust_bundle(found, OPTIONS, extra_factors=graph)
    covariances = estimate_covariances(found, OPTIONS, extra_factors=graph)
    assert covariances.num_gauge == 0
    # a prior far sharper than the photographs: its own variance comes back
    ratio = np.sqrt(np.diag(covariances.poses[0])) / 1e-4
    assert (ratio < 1.02).all()
    assert ratio.max() > 0.5


def test_focal_prior_bounds_the_focal():
    scene = make_scene(2, 3, 60, layout="grid")
    priors = [replace(scene.ground_truth.cameras[0], focal_sigma=1e-3)]
    found = scene.observed.copy()
    adjust_bundle(found, OPTIONS, prior_cameras=priors)
    covariances = estimate_covariances(found, OPTIONS, prior_cameras=priors)
    assert np.sqrt(covariances.intrinsics[0][0, 0]) == pytest.approx(1e-3, rel=1e-3)


def test_the_joint_prior_of_a_calibration_comes_back_where_photographs_tell_less():
    scene = make_scene(2, 3, 60, synthetic_camera(CameraModel.RADIAL), layout="grid")
    root = np.array([[1e-3, 0, 0], [4e-7, 3e-7, 0], [-2e-7, 1e-7, 2e-7]])
    covariance = np.zeros((5, 5))
    free = np.ix_([0, 3, 4], [0, 3, 4])
    covariance[free] = root @ root.T
    # as wide as the sigma has it: twice
    priors = [replace(scene.ground_truth.cameras[0], focal_sigma=2e-3, prior_covariance=covariance)]
    found = scene.observed.copy()
    adjust_bundle(found, OPTIONS, prior_cameras=priors)
    (told,) = estimate_covariances(found, OPTIONS, prior_cameras=priors).intrinsics
    scale = np.sqrt(np.diag(covariance[free]))
    np.testing.assert_allclose(told / np.outer(scale, scale), 4 * covariance[free] / np.outer(scale, scale), atol=0.02)


def test_sparse_tiles_give_the_same_covariances(monkeypatch):
    from sfmapp.adjust import solver

    scene = make_scene(3, 6, 150)
    found = perturb(scene.observed, rotation_deg=0.05)
    adjust_bundle(found, OPTIONS)
    dense = estimate_covariances(found, OPTIONS)
    monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", 0)
    monkeypatch.setattr(solver, "choose_solver", lambda *_, **__: "gtsam")
    sparse = estimate_covariances(found, OPTIONS)
    np.testing.assert_allclose(dense.poses, sparse.poses, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(dense.points, sparse.points, rtol=1e-4, atol=1e-12)


def test_undetermined_is_said():
    scene = make_scene(4, 4, 100)
    found = scene.observed.copy()
    every = np.ones(100, bool)
    # two images, no common point: their relative pose is anybody's guess
    seen = np.diff(found.tracks.track_ptr)
    found.obs_is_inlier[:] = False
    first = found.tracks.track_ptr[:-1][seen >= 2]
    found.obs_is_inlier[first] = True
    found.obs_is_inlier[first + 1] = True
    found.obs_is_inlier[found.tracks.obs_image_idx == 3] = False
    keep = np.flatnonzero(np.bincount(found.tracks.obs_track_idx[found.obs_is_inlier], minlength=100) >= 2)[:2]
    every[:] = False
    every[keep] = True
    assert not estimate_covariances(found, sigma_px=1.0, varying=Varying(points=every)).is_determined


def test_an_image_that_is_left_open_says_nothing_of_the_others_and_takes_nothing_from_them():
    """Two points do not tell a pose: the others are as sure as without that image."""
    scene = make_scene(7, 6, 120, sigma_px=0.5)
    found = scene.observed.copy()
    own = np.flatnonzero((found.tracks.obs_image_idx == 2) & found.obs_is_inlier)
    found.obs_is_inlier[own[2:]] = False
    adjust_bundle(found, OPTIONS)
    without = found.copy()
    without.obs_is_inlier[own] = False
    without.cam_from_world[2] = np.nan
    beside, alone = (estimate_covariances(model, OPTIONS, sigma_px=0.5) for model in (found, without))
    assert beside.is_determined
    assert (~beside.is_told).nonzero()[0].tolist() == [2]
    assert np.isinf(beside.of_image(2)).all()
    assert beside.image_idx[beside.is_told].tolist() == alone.image_idx.tolist()
    np.testing.assert_allclose(beside.poses[beside.is_told], alone.poses, rtol=1e-5, atol=1e-14)
    np.testing.assert_allclose(beside.intrinsics[0], alone.intrinsics[0], rtol=1e-5)
    seen_there = np.isin(beside.track_idx, found.tracks.obs_track_idx[own[:2]])
    assert np.isinf(beside.points[seen_there]).all()
    rest = beside.track_idx[~seen_there]
    expected = alone.points[np.searchsorted(alone.track_idx, rest)]
    np.testing.assert_allclose(beside.points[~seen_there], expected, rtol=1e-5, atol=1e-14)
    # and compared with the truth in the gauge of those that are told
    poses, _, _ = errors_in_gauge(found, scene.ground_truth, beside)
    assert np.mean(normalized(poses[beside.is_told], beside.poses[beside.is_told])) < 3.0


@pytest.mark.parametrize("sigma", [1.0, 20.0])
def test_places_that_are_loosely_known_hold_a_precise_model_as_loosely(sigma: float) -> None:
    """As a phone's positions hold a model of ten thousands of keypoints: far from nothing, and as a similarity says."""
    import gtsam
    from gtsam.symbol_shorthand import X

    from sfmapp.geometry import rigid3

    scene = make_scene(2, 8, 400, sigma_px=0.05)
    model, centers = scene.observed.copy(), scene.ground_truth.centers
    graph = gtsam.NonlinearFactorGraph()
    for i in range(8):
        graph.add(gtsam.GPSFactor(X(i), centers[i], gtsam.noiseModel.Isotropic.Sigma(3, sigma)))
    covariances = estimate_covariances(model, OPTIONS, sigma_px=0.05, extra_factors=graph)
    assert covariances.num_gauge == 0
    arm = centers - centers.mean(0)
    slope = np.concatenate([-rigid3.skew(arm), arm[:, :, None], np.broadcast_to(np.eye(3), (8, 3, 3))], 2)
    of_similarity = np.linalg.inv(np.einsum("nai,naj->ij", slope, slope)) * sigma**2
    turned = rigid3.rotation_matrix(model.cam_from_world)
    for i in range(8):
        found = turned[i].T @ covariances.of_image(i)[3:, 3:] @ turned[i]
        # a turn and the place of a camera go together; what the photographs tell is a thousandth of this
        expected = slope[i] @ of_similarity @ slope[i].T
        np.testing.assert_allclose(found, expected, atol=0.02 * np.trace(expected))


def test_poses_from_the_sparse_factor_are_those_of_the_whole_inverse():
    scene = nadir_block(0, simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, 850.0), relief=2.0, tilt_deg=2.0)
    model, centers = scene.observed, scene.ground_truth.centers
    for sigma in (0.02, 3.0):  # RTK, and a phone, which holds the whole 1e10 times as loosely as points hold its shape
        graph = position_graph(np.arange(len(centers)), centers, np.full((len(centers), 3), sigma), None)
        found = selected_covariances(model, AdjustOptions(), extra_factors=graph)
        assert_same_blocks(found, estimate_covariances(model, AdjustOptions(), extra_factors=graph))


def assert_same_blocks(found, whole):
    assert found.num_gauge == whole.num_gauge
    assert found.sigma_px == pytest.approx(whole.sigma_px)
    np.testing.assert_array_equal(found.image_idx, whole.image_idx)
    np.testing.assert_array_equal(found.camera_idx, whole.camera_idx)
    for ours, theirs in zip([*found.poses, *found.intrinsics], [*whole.poses, *whole.intrinsics], strict=True):
        scale = np.sqrt(np.diag(theirs))
        np.testing.assert_allclose(ours / np.outer(scale, scale), theirs / np.outer(scale, scale), atol=1e-8)


@pytest.mark.parametrize("model", [CameraModel.SIMPLE_RADIAL, CameraModel.THIN_PRISM_FISHEYE])
def test_blocks_of_a_free_network_from_the_sparse_factor_are_those_of_the_whole_inverse(model):
    """In the gauge of inner constraints, where two images hold the whole at first; twelve parameters take two blocks of
    a camera."""
    scene = nadir_block(0, simple_camera(model, 1000, 750, 850.0), relief=2.0, tilt_deg=2.0)
    options = AdjustOptions(refine_principal_point=True, distortion_sigma=0.01)
    whole = estimate_covariances(scene.observed, options)
    assert whole.num_gauge == 7
    assert len(whole.intrinsics[0]) == (4 if model == CameraModel.SIMPLE_RADIAL else 12)
    assert_same_blocks(selected_covariances(scene.observed, options), whole)


def test_what_is_open_has_no_covariance_by_the_sparse_factor():
    scene = nadir_block(1, simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, 850.0), relief=2.0, tilt_deg=2.0)
    model = scene.observed.copy()
    # a photograph that sees one point only may turn about it
    seen = np.flatnonzero(model.tracks.obs_image_idx == 0)
    model.obs_is_inlier[seen[1:]] = False
    assert selected_covariances(model, AdjustOptions()) is None
