"""The engine against a plain gtsam graph: same cost at the same state, same answer at the end."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import K, X

from sfmapp.adjust.factors import gtsam_pose
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


def test_what_the_reference_cannot_do_is_said():
    options = replace(OPTIONS, refine_principal_point=True, backend="gtsam")
    with pytest.raises(UsageError, match="principal point"):
        adjust_bundle(make_scene(0, 3, 50).observed.copy(), options)
    for model in (CameraModel.FULL_OPENCV, CameraModel.RADIAL_FISHEYE):
        scene = make_scene(0, 3, 50, synthetic_camera(model))
        with pytest.raises(UsageError, match=model.name):
            adjust_bundle(scene.observed.copy(), replace(OPTIONS, backend="gtsam"))


def test_free_gauge_reaches_the_same_cost():
    both(make_scene(5, 6, 300))
