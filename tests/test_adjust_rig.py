"""Rigs in the adjustment: images that share a pose, against gtsam, against single images, and their covariances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sfmapp.adjust import solver
from sfmapp.adjust.covariance import errors_in_gauge, estimate_covariances
from sfmapp.adjust.factors import gtsam_pose
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying, make_problem
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig, RigImages
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera, synthetic_rig

TIGHT = AdjustOptions(relative_cost_tolerance=1e-13, max_iterations=200)
KNOWN = replace(TIGHT, refine_focal=False, refine_distortion=False)


def start_of(scene):
    return perturb(
        scene.observed, rotation_deg=0.1, translation_fraction=0.002, point_fraction=0.002, focal_fraction=0.01
    )


def three_cameras():
    """A rig of three: pinhole, fisheye and a third at right angles, at unequal distances."""
    mounts = [
        rigid3.IDENTITY,
        rigid3.from_matrix(rigid3.exp_so3([0.02, -0.05, 0.01]), [-0.5, 0.1, 0.05]),
        rigid3.from_matrix(rigid3.exp_so3([0.1, 0.2, -1.5]), [0.3, 0.4, -0.1]),
    ]
    models = (CameraModel.SIMPLE_RADIAL, CameraModel.OPENCV_FISHEYE, CameraModel.OPENCV)
    return Rig(tuple(synthetic_camera(model) for model in models), np.array(mounts))


def assert_on_rig(model):
    """Every image is where its mount says, that of sensor 0 to the bit."""
    rig = model.rig
    pose = rig.rig_from_world(model.cam_from_world)[rig.frame_idx]
    expected = rig.cam_from_world(np.arange(len(pose)), pose)
    np.testing.assert_array_equal(model.cam_from_world, expected)


# --- the scene --------------------------------------------------------------------------------------------------------


def test_scene_is_on_its_rig_and_stays_there():
    scene = make_scene(0, 12, 200, rig=three_cameras(), layout="grid")
    assert scene.ground_truth.rig is not None
    assert scene.ground_truth.rig.frame_idx.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert np.abs(scene.ground_truth.residuals_px()).max() < 1e-9
    for model in (scene.ground_truth, start_of(scene)):
        relative = rigid3.compose(model.cam_from_world[1::3], rigid3.inverse(model.cam_from_world[::3]))
        np.testing.assert_allclose(relative, np.tile(model.rig.cam_from_rig[1], (4, 1)), atol=1e-14)
    with pytest.raises(ValueError, match="multiple of 3"):
        make_scene(0, 10, 200, rig=three_cameras())


def test_poses_go_from_images_to_rig_and_back():
    rng = np.random.default_rng(0)
    mounts = three_cameras().cam_from_rig
    rig = RigImages(np.array([3, 0, 0, 3, 3, -1], np.int32), np.array([2, 1, 0, 0, 1, 0], np.int32), mounts)
    frames = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(6, 3))), rng.normal(size=(6, 3)))
    poses = rig.cam_from_world(np.arange(6), frames[rig.frame_idx])
    np.testing.assert_array_equal(poses[[2, 3, 5]], frames[[0, 3, -1]])
    found = rig.rig_from_world(poses)
    np.testing.assert_array_equal(found[[0, 3]], frames[[0, 3]])
    assert np.isnan(found[[1, 2]]).all()
    poses[[2, 3]] = np.nan  # now others must speak for their frames
    np.testing.assert_allclose(rig.rig_from_world(poses)[[0, 3]], frames[[0, 3]], atol=1e-14)


# --- the minimum ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["trivial", "huber"])
def test_same_answer_as_gtsam(loss):
    import gtsam
    from gtsam.symbol_shorthand import X

    scene = make_scene(1, 12, 250, rig=three_cameras(), layout="grid")
    graph = gtsam.NonlinearFactorGraph()
    where = gtsam_pose(scene.ground_truth.cam_from_world[3])
    graph.add(gtsam.PriorFactorPose3(X(3), where, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    options = replace(TIGHT, loss=loss, loss_scale_px=0.8)
    start = start_of(scene)
    models, reports = [], []
    for backend in ("schur", "gtsam"):
        models.append(start.copy())
        reports.append(adjust_bundle(models[-1], replace(options, backend=backend), extra_factors=graph))
        assert_on_rig(models[-1])
    assert reports[0].initial_cost == pytest.approx(reports[1].initial_cost, rel=1e-9)
    assert reports[0].final_cost == pytest.approx(reports[1].final_cost, rel=1e-6)
    np.testing.assert_allclose(models[0].cam_from_world, models[1].cam_from_world, atol=2e-5)
    np.testing.assert_allclose(models[0].point_xyz, models[1].point_xyz, atol=3e-4)
    for ours, theirs in zip(models[0].cameras, models[1].cameras, strict=True):
        np.testing.assert_allclose(ours.params, theirs.params, rtol=2e-4, atol=2e-5)


def test_noise_free_scene_is_recovered_to_scale():
    scene = make_scene(2, 12, 300, rig=synthetic_rig(0.4), sigma_px=0.0, layout="forward")
    found = start_of(scene)
    images = np.arange(12) >= 2
    found.cam_from_world[:2] = scene.ground_truth.cam_from_world[:2]
    report = adjust_bundle(found, TIGHT, varying=Varying(images=images))
    assert report.final_cost < 1e-10 * report.initial_cost
    np.testing.assert_allclose(found.cam_from_world, scene.ground_truth.cam_from_world, atol=1e-5)


def test_cost_per_degree_of_freedom_is_the_noise():
    scene = make_scene(3, 20, 900, rig=synthetic_rig(), sigma_px=0.7)
    report = adjust_bundle(start_of(scene), TIGHT)
    dof = 2 * report.num_observations - 3 * 900 - 6 * 10 - 2 * 2 + 6
    assert abs(2 * report.final_cost / dof / 0.49 - 1) < 5 * math.sqrt(2 / dof)
    assert report.num_images == 20


def test_a_rig_without_mounts_in_use_changes_no_bit():
    """Frames of one image each, all of sensor 0: the plain problem."""
    scene = make_scene(4, 8, 300)
    plain, rigged = start_of(scene), start_of(scene)
    rigged.rig = RigImages(np.arange(8, dtype=np.int32), np.zeros(8, np.int32), three_cameras().cam_from_rig)
    adjust_bundle(plain)
    adjust_bundle(rigged)
    assert plain.cam_from_world.tobytes() == rigged.cam_from_world.tobytes()
    assert plain.point_xyz.tobytes() == rigged.point_xyz.tobytes()


def test_either_camera_may_carry_the_rig():
    """The same scene with the right camera as the reference: another parameterisation, the same minimum."""
    scene = make_scene(5, 10, 250, rig=synthetic_rig(0.5), layout="forward")
    left = start_of(scene)
    right = left.copy()
    assert left.rig is not None
    mounts = np.stack([rigid3.IDENTITY, rigid3.inverse(left.rig.cam_from_rig[1])])
    right.rig = RigImages(left.rig.frame_idx, 1 - left.rig.sensor_idx, mounts)
    images = np.arange(10) >= 2
    covariances = []
    for model in (left, right):
        adjust_bundle(model, KNOWN, varying=Varying(images=images))
        covariances.append(estimate_covariances(model, KNOWN, sigma_px=0.5, varying=Varying(images=images)))
    np.testing.assert_allclose(left.cam_from_world, right.cam_from_world, atol=1e-6)
    np.testing.assert_array_equal(covariances[0].image_idx, np.arange(2, 10))
    # and the adjoint takes the covariance of one camera to that of the other
    np.testing.assert_allclose(covariances[0].poses, covariances[1].poses, rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(covariances[0].points, covariances[1].points, rtol=1e-4, atol=1e-10)


def test_sparse_equals_dense_and_threads_change_nothing(monkeypatch):
    scene = make_scene(6, 24, 600, rig=synthetic_rig())
    monkeypatch.setattr(solver, "_CHUNK_OBSERVATIONS", 500)
    results = []
    for threads in (1, 3):
        found = start_of(scene)
        adjust_bundle(found, KNOWN, threads=threads)
        results.append(found.cam_from_world.tobytes() + found.point_xyz.tobytes())
    assert results[0] == results[1]
    monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", 0)
    monkeypatch.setattr(solver, "choose_solver", lambda *_, **__: "gtsam")
    sparse = start_of(scene)
    assert adjust_bundle(sparse, KNOWN).solver == "gtsam"
    np.testing.assert_allclose(sparse.cam_from_world, found.cam_from_world, atol=1e-7)


def test_cameras_of_their_own_fit_beside_a_shared_pose():
    """A camera per image has a place in the image's block only where no other image has that pose."""
    cameras = [synthetic_camera(CameraModel.SIMPLE_RADIAL, focal=880.0 + i) for i in range(8)]
    scene = make_scene(7, 8, 300, cameras, rig=synthetic_rig(0.5))
    found = start_of(scene)
    assert found.rig is not None
    found.rig = replace(found.rig, frame_idx=np.array([0, 0, 1, 1, 2, 2, -1, -1], np.int32))
    problem = make_problem(found, refine=(True, True, False))
    assert problem.block_dim.tolist() == [6, 6, 6, 8, 8] + [2] * 6
    report = adjust_bundle(found, TIGHT)
    dof = 2 * report.num_observations - 3 * 300 - 6 * 5 - 16 + 6
    assert abs(2 * report.final_cost / dof / 0.25 - 1) < 5 * math.sqrt(2 / dof)


# --- what varies and what does not ------------------------------------------------------------------------------------


def test_frames_vary_as_a_whole():
    scene = make_scene(8, 10, 200, rig=synthetic_rig())
    start = start_of(scene)
    images = np.arange(10) >= 4
    found = start.copy()
    adjust_bundle(found, KNOWN, varying=Varying(images=images))
    np.testing.assert_array_equal(found.cam_from_world[:4], start.cam_from_world[:4])
    assert (found.cam_from_world[4:] != start.cam_from_world[4:]).any(1).all()
    images[5] = False
    with pytest.raises(ValueError, match="both in one frame"):
        adjust_bundle(found, KNOWN, varying=Varying(images=images))
    # an image that takes no part has no say, but moves with its frame
    found = start.copy()
    found.obs_is_inlier[found.tracks.observations_of_image(5)] = False
    adjust_bundle(found, KNOWN, varying=Varying(images=images))
    assert (found.cam_from_world[5] != start.cam_from_world[5]).any()
    assert_on_rig(found)


def test_frames_with_one_registered_image():
    scene = make_scene(9, 12, 400, rig=synthetic_rig(0.4), sigma_px=0.0, layout="forward")
    found = start_of(scene)
    found.cam_from_world[:4] = scene.ground_truth.cam_from_world[:4]
    gone = [5, 8]  # a right image, and a left one: the right one then carries its frame
    found.cam_from_world[gone] = np.nan
    found.obs_is_inlier[np.isin(found.tracks.obs_image_idx, gone)] = False
    adjust_bundle(found, TIGHT, varying=Varying(images=np.arange(12) >= 4))
    assert np.isnan(found.cam_from_world[gone]).all()
    rest = np.setdiff1d(np.arange(12), gone)
    np.testing.assert_allclose(found.cam_from_world[rest], scene.ground_truth.cam_from_world[rest], atol=1e-5)


def test_factors_are_over_the_rigs_pose():
    import gtsam
    from gtsam.symbol_shorthand import X

    scene = make_scene(10, 6, 200, rig=synthetic_rig())
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    away = gtsam_pose(scene.ground_truth.cam_from_world[2]).retract(np.full(6, 0.1))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(X(2), away, noise))
    found = scene.observed.copy()
    adjust_bundle(found, KNOWN, extra_factors=graph)
    assert gtsam_pose(found.cam_from_world[2]).equals(away, 1e-4)
    assert_on_rig(found)
    wrong = gtsam.NonlinearFactorGraph()
    wrong.add(gtsam.PriorFactorPose3(X(3), away, noise))
    with pytest.raises(ValueError, match=r"sensor 0, found X\(3\)"):
        adjust_bundle(found, KNOWN, extra_factors=wrong)


# --- covariances ------------------------------------------------------------------------------------------------------


def normalized(errors, covariances):
    return [float(e @ np.linalg.solve(c, e) / len(e)) for e, c in zip(errors, covariances, strict=True)]


@pytest.mark.parametrize(("held", "num_gauge"), [(0, 6), (2, 0)])
def test_nees(held, num_gauge):
    """Free, and relative to the first frame: with a baseline nothing but the frame of reference is open."""
    poses, points = [], []
    images = np.arange(10) >= held
    for seed in range(200):
        scene = make_scene(seed, 10, 100, rig=synthetic_rig(0.5), sigma_px=0.3, layout="forward")
        found = scene.observed.copy()
        adjust_bundle(found, KNOWN, varying=Varying(images=images))
        covariances = estimate_covariances(found, KNOWN, sigma_px=0.3, varying=Varying(images=images))
        assert covariances.is_determined
        assert covariances.num_gauge == num_gauge
        error, _, point_error = errors_in_gauge(found, scene.ground_truth, covariances)
        poses.extend(normalized(error, covariances.poses))
        points.extend(normalized(point_error, covariances.points))
    assert 0.9 < np.mean(poses) < 1.1
    assert 0.9 < np.mean(points) < 1.1


def test_an_image_that_takes_no_part_has_the_covariance_of_its_frame():
    model = make_scene(14, 10, 200, rig=synthetic_rig()).observed.copy()
    model.obs_is_inlier[np.isin(model.tracks.obs_image_idx, [4, 7])] = False
    model.cam_from_world[9] = np.nan
    model.obs_is_inlier[model.tracks.obs_image_idx == 9] = False
    adjust_bundle(model, KNOWN)
    covariances = estimate_covariances(model, KNOWN, sigma_px=0.5, varying=Varying(images=np.arange(10) >= 2))
    assert covariances.image_idx.tolist() == [2, 3, 4, 5, 6, 7, 8]
    assert model.rig is not None
    mount = model.rig.cam_from_rig[1]
    adjoint = np.kron(np.eye(2), rigid3.rotation_matrix(mount))
    adjoint[3:, :3] = rigid3.skew(mount[4:]) @ adjoint[:3, :3]
    for left, right in ((0, 1), (2, 3), (4, 5)):
        expected = adjoint @ covariances.poses[left] @ adjoint.T
        np.testing.assert_allclose(covariances.poses[right], expected, rtol=1e-9, atol=1e-18)
    errors_in_gauge(model, model, covariances)


def test_noise_is_estimated_with_six_open_freedoms():
    found = make_scene(11, 12, 500, rig=synthetic_rig(), sigma_px=0.4).observed.copy()
    report = adjust_bundle(found, KNOWN)
    covariances = estimate_covariances(found, KNOWN)
    dof = 2 * report.num_observations - 3 * 500 - 6 * 6 + 6
    assert covariances.sigma_px == pytest.approx(math.sqrt(2 * report.final_cost / dof), rel=1e-9)
    assert covariances.sigma_px == pytest.approx(0.4, rel=5 / math.sqrt(2 * dof))


def test_scale_is_measured_however_short_the_baseline():
    """Its share of the information falls with the square of baseline to way, below what counts as nothing."""
    spread = {}
    for baseline in (1e-3, 1e-5):
        scene = make_scene(12, 20, 300, rig=synthetic_rig(baseline), layout="forward")
        covariances = estimate_covariances(scene.observed, KNOWN, sigma_px=1e-3)
        assert covariances.num_gauge == 6
        assert covariances.is_determined
        spread[baseline] = np.sqrt(np.einsum("nii->ni", covariances.poses)[::2, 5].max())
    assert spread[1e-5] == pytest.approx(100 * spread[1e-3], rel=0.05)


def test_cameras_at_one_place_measure_no_length():
    rig = synthetic_rig()
    turned = rigid3.from_matrix(rigid3.exp_so3([0.0, 0.3, 0.0]), np.zeros(3))
    scene = make_scene(13, 12, 300, rig=Rig(rig.cameras, np.stack([rigid3.IDENTITY, turned])), layout="grid")
    model = scene.observed
    # only points that are seen from several frames have a depth
    frame = np.split(model.tracks.obs_image_idx // 2, model.tracks.track_ptr[1:-1])
    several = np.array([len(np.unique(f)) > 1 for f in frame])
    covariances = estimate_covariances(model, KNOWN, sigma_px=0.5, varying=Varying(points=several))
    assert covariances.is_determined
    assert covariances.num_gauge == 7
