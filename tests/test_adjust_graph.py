"""The factor graph against plain gtsam: the same minimum, the same covariances, with any factors beside."""

from __future__ import annotations

import sys
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, C, D, L, P, X

from sfmapp.adjust import solver
from sfmapp.adjust.covariance import estimate_covariances
from sfmapp.adjust.factors import gtsam_pose
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.camera.camera import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera, synthetic_rig

OPTIONS = AdjustOptions(relative_cost_tolerance=1e-13, max_iterations=200)
SIGMA = gtsam.noiseModel.Isotropic.Sigma
HUBER = gtsam.noiseModel.mEstimator.Huber.Create(1.345)


def start_of(scene):
    return perturb(
        scene.observed, rotation_deg=0.1, translation_fraction=0.002, point_fraction=0.002, focal_fraction=0.01
    )


def survey(scene, start, seed=0):
    """A graph with positions of the cameras, one of them far off, control points, and a distance between two points."""
    rng = np.random.default_rng(seed)
    graph = FactorGraph(start, replace(OPTIONS, loss="cauchy", loss_scale_px=1.5), noise_px=0.5)
    truth = scene.ground_truth
    noise = gtsam.noiseModel.Robust.Create(HUBER, SIGMA(3, 0.05))
    for i, center in enumerate(truth.centers):
        graph.add(gtsam.GPSFactor(X(i), center + 0.05 * rng.normal(size=3) + (5.0 if i == 4 else 0.0), noise))
    for t in (3, 40, 77):
        graph.add(gtsam.PriorFactorPoint3(L(t), truth.point_xyz[t] + 0.01 * rng.normal(size=3), SIGMA(3, 0.01)))
    length = np.linalg.norm(truth.point_xyz[5] - truth.point_xyz[3])
    graph.add(gtsam.RangeFactor3(L(5), L(3), float(length), SIGMA(1, 0.005)))
    return graph


def optimized_by_gtsam(graph):
    """The plain graph at its minimum, by gtsam alone."""
    plain, values = graph.to_gtsam()
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(1e-14)
    result = gtsam.LevenbergMarquardtOptimizer(plain, values, parameters).optimize()
    return plain, result


@pytest.mark.parametrize("kind", ["gtsam", "lapack"])
def test_same_minimum_and_covariances_as_plain_gtsam(monkeypatch, kind):
    monkeypatch.setattr(solver, "choose_solver", lambda *_, **__: kind)
    scene = make_scene(1, 8, 150, synthetic_camera(CameraModel.RADIAL), sigma_px=0.5)
    ours, theirs = survey(scene, start_of(scene)), survey(scene, start_of(scene))
    plain, values = optimized_by_gtsam(theirs)
    before, start_values = theirs.to_gtsam()
    report = ours.optimize()
    assert report.solver == kind
    assert report.initial_cost == pytest.approx(before.error(start_values), rel=1e-9)
    assert report.final_cost == pytest.approx(plain.error(values), rel=1e-6)
    assert report.final_cost == pytest.approx(sum(f.cost for f in report.factors), rel=1e-9)
    theirs.from_gtsam(values)
    a, b = ours.reconstruction, theirs.reconstruction
    turned = rigid3.compose(a.cam_from_world, rigid3.inverse(b.cam_from_world))
    assert np.abs(rigid3.log_so3(rigid3.rotation_matrix(turned))).max() < 1e-6
    np.testing.assert_allclose(a.centers, b.centers, atol=1e-5)
    np.testing.assert_allclose(a.point_xyz, b.point_xyz, atol=1e-4)

    found = ours.marginal_covariance(images=[2, 0], cameras=[0], points=[5, 100])
    assert found.is_determined
    assert found.num_gauge == 0
    marginals = gtsam.Marginals(*ours.to_gtsam())
    close = {"rtol": 1e-6, "atol": 0}
    for name, block, key in (
        ("image", found.of_image(2), X(2)), ("image", found.of_image(0), X(0)), ("point", found.of_point(100), L(100)),
        ("point", found.of_point(5), L(5)), ("camera", found.of_camera(0), C(0)),
    ):  # fmt: skip
        expected = marginals.marginalCovariance(key)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(block / scale, expected / scale, atol=1e-6, rtol=0, err_msg=name)
    rotation = rigid3.rotation_matrix(a.cam_from_world[2])
    np.testing.assert_allclose(found.of_center(2), rotation.T @ found.of_image(2)[3:, 3:] @ rotation, **close)
    joint = marginals.jointMarginalCovariance([X(0), L(5)])
    cross = found.matrix[6:12, -6:-3]
    np.testing.assert_allclose(cross, -joint.at(X(0), L(5)), atol=1e-6 * np.abs(cross).max())


def test_marginals_with_variables_of_its_own_are_those_of_plain_gtsam():
    """An offset that all positions share, and one for each camera that only its neighbours know: the latter eliminated,
    or asked for."""
    scene = make_scene(4, 8, 150, sigma_px=0.5)
    fixed = replace(OPTIONS, refine_focal=False, refine_distortion=False)
    graph = FactorGraph(start_of(scene), fixed, noise_px=0.5)
    rng = np.random.default_rng(3)

    def with_offset(measured):
        def error(factor, values, slopes):
            pose, common, own = (values.atPose3(factor.keys()[0]), *(values.atVector(k) for k in factor.keys()[1:]))
            if slopes is not None:
                slopes[0] = np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
                slopes[1] = slopes[2] = np.eye(3)
            return pose.translation() + common + own - measured

        return error

    graph.insert(A(0), np.zeros(3))
    for i, center in enumerate(scene.ground_truth.centers):
        graph.insert(D(i), np.zeros(3))
        measured = with_offset(center + 0.05 * rng.normal(size=3))
        graph.add(gtsam.CustomFactor(SIGMA(3, 0.05), [X(i), A(0), D(i)], measured), "position")
        if i:
            graph.add(gtsam.BetweenFactorVector(D(i - 1), D(i), np.zeros(3), SIGMA(3, 0.02)))
    graph.add(gtsam.PriorFactorVector(A(0), np.zeros(3), SIGMA(3, 0.1)))
    graph.add(gtsam.PriorFactorVector(D(0), np.zeros(3), SIGMA(3, 0.1)))
    report = graph.optimize()
    assert {f.kind for f in report.factors} >= {"reprojection", "position"}
    marginals = gtsam.Marginals(*graph.to_gtsam())
    for variables in ([A(0)], [A(0), D(5)]):
        found = graph.marginal_covariance(images=[2], variables=variables)
        for block, key in ((found.of_image(2), X(2)), *((found.of_variable(v), v) for v in variables)):
            expected = marginals.marginalCovariance(key)
            scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            np.testing.assert_allclose(block / scale, expected / scale, atol=1e-6)
        cross = marginals.jointMarginalCovariance([X(2), A(0)]).at(X(2), A(0))
        np.testing.assert_allclose(found.matrix[:6, 6:9], -cross, atol=1e-6 * np.abs(cross).max())
    with pytest.raises(InputError, match="asked for"):
        found.of_variable(D(1))


def test_the_report_tells_factors_by_kind_and_what_was_rejected():
    scene = make_scene(2, 8, 150, sigma_px=0.5)
    graph = survey(scene, start_of(scene))
    graph.add(gtsam.GPSFactor(X(99), np.zeros(3), SIGMA(3, 1.0)))  # an image that does not exist
    report = graph.optimize()
    kinds = {f.kind: f for f in report.factors}
    assert list(kinds) == ["reprojection", "GPSFactor", "PriorFactorPoint3", "RangeFactor3"]
    assert kinds["GPSFactor"].num_factors == 8
    assert kinds["GPSFactor"].num_rejected == 1
    assert kinds["PriorFactorPoint3"].num_rows == 9
    assert report.num_left_out == 1
    # what is left of the noise after as many unknowns, a little less for the weights of Cauchy's loss
    left = 1.0 - (3 * report.num_points + 6 * 8 + 2 - 3 * 8 - 10) / kinds["reprojection"].num_rows
    assert 0.75 < kinds["reprojection"].normalized_residual / np.sqrt(left) < 1.1
    assert kinds["reprojection"].num_rejected < 0.02 * kinds["reprojection"].num_factors
    assert kinds["GPSFactor"].normalized_residual < 2.0
    # the far one has not bent the others
    np.testing.assert_allclose(graph.reconstruction.centers, scene.ground_truth.centers, atol=0.1)


def test_variables_of_its_own():
    """An offset that all positions share is found, together with its covariance."""
    scene = make_scene(3, 8, 150, sigma_px=0.5)
    start = start_of(scene)
    graph = FactorGraph(start, OPTIONS, noise_px=0.5)
    graph.insert(P(0), np.zeros(3))
    with pytest.raises(InputError, match="p0"):
        graph.insert(P(0), np.zeros(3))
    offset, sigma = np.array([1.0, -2.0, 0.5]), 0.01

    def error(measured, factor, values, jacobians):
        pose, shift = values.atPose3(X(factor.keys()[0] & 0xFFFFFF)), values.atVector(P(0))
        if jacobians is not None:
            jacobians[0] = np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
            jacobians[1] = np.eye(3)
        return pose.translation() + shift - measured

    for i, center in enumerate(scene.ground_truth.centers):
        measured = center + offset
        graph.add(gtsam.CustomFactor(SIGMA(3, sigma), [X(i), P(0)], lambda f, v, j, m=measured: error(m, f, v, j)))
    for i in (0, 5):
        graph.add(gtsam.GPSFactor(X(i), scene.ground_truth.centers[i], SIGMA(3, sigma)))
    report = graph.optimize()
    assert report.termination == "converged"
    np.testing.assert_allclose(graph.values.atVector(P(0)), offset, atol=4 * sigma)


def test_covariances_in_a_free_network_are_those_of_the_whole():
    scene = make_scene(4, 6, 120, sigma_px=0.5)
    graph = FactorGraph(start_of(scene), OPTIONS, noise_px=0.5)
    report = graph.optimize()
    assert report.num_left_out == 0
    whole = estimate_covariances(graph.reconstruction, OPTIONS, sigma_px=0.5)
    found = graph.marginal_covariance(images=[1], cameras=[0], points=[7])
    assert found.num_gauge == whole.num_gauge == 7
    np.testing.assert_allclose(found.of_image(1), whole.of_image(1), rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(found.of_camera(0), whole.of_camera(0), rtol=1e-5)
    np.testing.assert_allclose(found.of_point(7), whole.of_point(7), rtol=1e-5, atol=1e-12)


def test_a_rig_and_constant_images():
    scene = make_scene(6, 12, 200, rig=synthetic_rig(), sigma_px=0.5)
    known = replace(OPTIONS, refine_focal=False, refine_distortion=False)
    images = np.ones(len(scene.observed.image_names), bool)
    images[scene.observed.rig.frame_idx == 0] = False
    graph = FactorGraph(start_of(scene), known, varying=Varying(images=images), noise_px=0.5)
    graph.reconstruction.move_images(np.flatnonzero(~images), scene.ground_truth.cam_from_world[~images])
    graph.optimize()
    whole = estimate_covariances(graph.reconstruction, known, sigma_px=0.5, varying=Varying(images=images))
    mounted = int(np.flatnonzero(scene.observed.rig.is_mounted & images)[0])
    found = graph.marginal_covariance(images=[mounted])
    np.testing.assert_allclose(found.of_image(mounted), whole.of_image(mounted), rtol=1e-5, atol=1e-12)
    with pytest.raises(InputError, match="is constant"):
        graph.marginal_covariance(images=[int(np.flatnonzero(~images)[0])])


@pytest.mark.parametrize(("num_images", "num_points"), [(4, 400), (6, 200), (12, 200)])
def test_noise_is_taken_from_what_an_adjustment_leaves(num_images, num_points):
    scene = make_scene(5, num_images, num_points, sigma_px=0.5)
    start = start_of(scene)
    FactorGraph(start, OPTIONS, noise_px=0.5).optimize()
    # four standard deviations of the root of the mean of a thousand squares
    assert FactorGraph(start).noise_px == pytest.approx(0.5, rel=0.06)
    # poses and points that did not follow the noise leave more of it: never too sure
    assert FactorGraph(scene.observed.copy()).noise_px > 0.5
    with pytest.raises(InputError, match="positive"):
        FactorGraph(start, noise_px=0.0)


def test_what_cannot_be_is_refused():
    scene = make_scene(5, 4, 60)
    graph = FactorGraph(scene.observed.copy(), OPTIONS)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam_pose(rigid3.IDENTITY), gtsam.noiseModel.Constrained.All(6)))
    with pytest.raises(ValueError, match="hard constraint"):
        graph.optimize()
    graph = FactorGraph(scene.observed.copy(), OPTIONS)
    graph.add(gtsam.PriorFactorVector(P(1), np.zeros(3), SIGMA(3, 1.0)))
    with pytest.raises(ValueError, match="p1"):
        graph.optimize()
    with pytest.raises(InputError, match="image 'none'"):
        graph.marginal_covariance(images=["none"])
    with pytest.raises(InputError, match="not the values"):
        FactorGraph(scene.observed.copy(), OPTIONS).from_gtsam(gtsam.Values())


def test_solvers_agree_and_threads_change_nothing(monkeypatch):
    from threadpoolctl import threadpool_limits

    scene = make_scene(7, 30, 900, sigma_px=0.5)
    monkeypatch.setattr(solver, "_CHUNK_OBSERVATIONS", 1000)
    states = {}
    for kind in ("gtsam", "lapack"):
        monkeypatch.setattr(solver, "choose_solver", lambda *_, kind=kind, **__: kind)
        for threads in (1, 2):
            with threadpool_limits(threads, "blas"):
                graph = FactorGraph(start_of(scene), OPTIONS, noise_px=0.5, threads=threads)
                assert graph.optimize().solver == kind
            model = graph.reconstruction
            states[kind, threads] = model.cam_from_world.tobytes() + model.point_xyz.tobytes()
        assert states[kind, 1] == states[kind, 2]


def test_a_small_graph_without_factors_needs_no_gtsam(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)  # an import raises
    monkeypatch.delitem(sys.modules, "sfmapp.adjust.factors")
    scene = make_scene(3, 20, 300, sigma_px=0.5)
    assert FactorGraph(start_of(scene), OPTIONS).optimize().solver == "lapack"


def test_weak_directions_are_solved_as_exactly_as_the_others():
    """In a free network gtsam refuses pivots that only the damping holds; what it says then is completed."""
    scene = make_scene(8, 10, 300, sigma_px=0.3)
    options = replace(OPTIONS, initial_damping=1e-8, relative_cost_tolerance=1e-10, refine_principal_point=True)
    found = {}
    for kind in ("tiles", "gtsam"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(solver, "choose_solver", lambda *_, kind=kind, **__: kind)
            graph = FactorGraph(start_of(scene), options, noise_px=0.3)
            found[kind] = graph.optimize(), graph.reconstruction
    (ours, a), (theirs, b) = found["tiles"], found["gtsam"]
    assert theirs.num_rejected == ours.num_rejected
    assert theirs.num_iterations == ours.num_iterations
    assert theirs.final_cost == pytest.approx(ours.final_cost, rel=1e-12)
    np.testing.assert_allclose(b.cam_from_world, a.cam_from_world, atol=1e-8)
