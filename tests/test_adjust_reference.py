"""The engine against a plain gtsam graph: same cost at the same state, same answer at the end."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import K, X

from sfmapp.adjust.factors import gtsam_pose
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import CameraModel
from sfmapp.errors import UsageError
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera

OPTIONS = AdjustOptions(relative_cost_tolerance=1e-13, max_iterations=200)


def both(scene, options=OPTIONS, **arguments):
    start = perturb(
        scene.observed, rotation_deg=0.1, translation_fraction=0.002, point_fraction=0.002, focal_fraction=0.01
    )
    found = {}
    for backend in ("schur", "gtsam"):
        model = start.copy()
        found[backend] = (adjust_bundle(model, replace(options, backend=backend), **arguments), model)
    (ours, our_model), (theirs, their_model) = found["schur"], found["gtsam"]
    assert theirs.solver == "none"
    assert ours.num_observations == theirs.num_observations
    assert ours.initial_cost == pytest.approx(theirs.initial_cost, rel=1e-9)
    assert ours.final_cost == pytest.approx(theirs.final_cost, rel=1e-6)
    return start, our_model, their_model


def hold_gauge(scene, images=(0, 1)):
    """Tight priors on two poses: then the minimum is one state and can be compared."""
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    for i in images:
        graph.add(gtsam.PriorFactorPose3(X(i), gtsam_pose(scene.ground_truth.cam_from_world[i]), noise))
    return graph


@pytest.mark.parametrize("model", list(CameraModel)[:6])
def test_same_answer_for_every_model(model):
    scene = make_scene(1, 5, 120, synthetic_camera(model))
    _, ours, theirs = both(scene, extra_factors=hold_gauge(scene))
    np.testing.assert_allclose(ours.cam_from_world, theirs.cam_from_world, atol=2e-5)
    np.testing.assert_allclose(ours.cameras[0].params, theirs.cameras[0].params, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ours.point_xyz, theirs.point_xyz, atol=2e-4)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_same_robust_answer(loss):
    scene = make_scene(2, 5, 150, sigma_px=1.0)
    options = replace(OPTIONS, loss=loss, loss_scale_px=1.2)
    _, ours, theirs = both(scene, options, extra_factors=hold_gauge(scene))
    np.testing.assert_allclose(ours.cam_from_world, theirs.cam_from_world, atol=1e-4)


def test_same_with_many_cameras_and_principal_point():
    cameras = [synthetic_camera(m) for m in (CameraModel.PINHOLE, CameraModel.OPENCV_FISHEYE, CameraModel.OPENCV)]
    scene = make_scene(3, 6, 300, cameras)
    options = replace(OPTIONS, refine_principal_point=True, principal_point_sigma_px=3.0, distortion_sigma=0.05)
    priors = [replace(camera, focal_sigma=10.0) for camera in cameras]
    both(scene, options, extra_factors=hold_gauge(scene), prior_cameras=priors)


def test_same_with_the_joint_prior_of_a_calibration():
    """Of all parameters together, as wide as the sigma of the focal length has it; k1 was held, and is free here."""
    scene = make_scene(8, 6, 200, synthetic_camera(CameraModel.RADIAL))
    rng = np.random.default_rng(4)
    root = np.diag([8.0, 3.0, 3.0, 0.0, 0.004]) @ np.tril(rng.normal(size=(5, 5)) * 0.4 + np.eye(5))
    prior = replace(scene.ground_truth.cameras[0], focal_sigma=2.0, prior_covariance=root @ root.T)
    prior = prior.with_params(prior.params + np.array([4.0, 1.0, -1.0, 0.0, 0.001]))
    options = replace(OPTIONS, refine_principal_point=True)
    _, ours, theirs = both(scene, options, extra_factors=hold_gauge(scene), prior_cameras=[prior])
    np.testing.assert_allclose(ours.cameras[0].params, theirs.cameras[0].params, rtol=1e-5, atol=1e-6)


def test_same_with_constants_and_factors_on_intrinsics():
    scene = make_scene(4, 6, 200)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorVector(K(0), np.array([903.0, -0.07]), gtsam.noiseModel.Isotropic.Sigma(2, 0.2)))
    where = [gtsam_pose(pose) for pose in scene.ground_truth.cam_from_world]
    graph.add(
        gtsam.BetweenFactorPose3(X(2), X(4), where[2].between(where[4]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-2))
    )
    images, points = np.array([False, False, True, True, True, True]), np.arange(200) < 20
    start, ours, theirs = both(scene, varying=Varying(images=images, constant_points=points), extra_factors=graph)
    for model in (ours, theirs):
        np.testing.assert_array_equal(model.cam_from_world[:2], start.cam_from_world[:2])
        np.testing.assert_array_equal(model.point_xyz[:20], start.point_xyz[:20])
    np.testing.assert_allclose(ours.cam_from_world, theirs.cam_from_world, atol=1e-5)


@pytest.mark.parametrize("model", [CameraModel.SIMPLE_PINHOLE, CameraModel.SIMPLE_RADIAL, CameraModel.RADIAL])
@pytest.mark.parametrize("sigma_px", [None, 3.0])
def test_same_with_one_focal_length_and_a_free_principal_point(model, sigma_px):
    """gtsam has no such calibration: one with two focal lengths, which are tied."""
    scene = make_scene(6, 6, 200, synthetic_camera(model))
    options = replace(OPTIONS, refine_principal_point=True, principal_point_sigma_px=sigma_px)
    priors = [replace(camera, focal_sigma=20.0) for camera in scene.ground_truth.cameras]
    _, ours, theirs = both(scene, options, extra_factors=hold_gauge(scene), prior_cameras=priors)
    np.testing.assert_allclose(ours.cam_from_world, theirs.cam_from_world, atol=1e-6)
    np.testing.assert_allclose(ours.cameras[0].params, theirs.cameras[0].params, rtol=1e-5, atol=1e-6)
    # it has been somewhere else, and the noise of half a pixel leaves it some pixels off
    assert 0.01 < np.abs(theirs.cameras[0].k_matrix[:2, 2] - scene.ground_truth.cameras[0].k_matrix[:2, 2]).max() < 30.0


def test_covariances_with_a_free_principal_point_are_those_of_gtsam():
    scene = make_scene(7, 5, 150)
    options = replace(OPTIONS, refine_principal_point=True)
    graph = FactorGraph(scene.observed.copy(), options, noise_px=0.5)
    graph.add(hold_gauge(scene))
    graph.optimize()
    plain, values = graph.to_gtsam()
    graph.from_gtsam(values)
    ours = graph.marginal_covariance(images=[2], cameras=[0])
    # gtsam.Marginals factorises by Cholesky, which takes what a tie leaves for open: here by QR
    jacobian, _ = plain.linearize(values).jacobian()
    inverse = np.linalg.inv(np.linalg.qr(jacobian, mode="r"))
    covariance = inverse @ inverse.T
    # columns by key: C(0), landmarks, poses; of C(0) fx, fy, s, u0, v0, k1, k2, p1, p2
    pose = len(covariance) - 6 * 3 + np.arange(6)
    for found, rows in ((ours.of_image(2), pose), (ours.of_camera(0), [0, 3, 4, 5])):
        theirs = covariance[np.ix_(rows, rows)]
        scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
        np.testing.assert_allclose(found / scale, theirs / scale, atol=1e-6)


def test_what_the_reference_cannot_do_is_said():
    scene = make_scene(0, 3, 50, synthetic_camera(CameraModel.FULL_OPENCV))
    with pytest.raises(UsageError, match="FULL_OPENCV"):
        adjust_bundle(scene.observed.copy(), replace(OPTIONS, backend="gtsam"))


def test_free_gauge_reaches_the_same_cost():
    both(make_scene(5, 6, 300))
