"""The adjustment engine against derivatives by differences, scipy, closed forms and itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.adjust import kernels, solver
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying, pose_rows
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import PARAM_NAMES, Camera, CameraModel, project
from sfmapp.camera.lens import ROW, distort
from sfmapp.camera.models import canonical_from_params
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, perturb, synthetic_camera
from sfmapp.scene.tracks import make_tracks
from sfmapp.simd.pointers import pointer

AWAY = np.array([0.0, 0.0, 6.0])
TIGHT = AdjustOptions(relative_cost_tolerance=1e-14, max_iterations=100)


def start_of(scene, seed=0, **amounts):
    amounts = {
        "rotation_deg": 0.2,
        "translation_fraction": 0.004,
        "point_fraction": 0.004,
        "focal_fraction": 0.02,
    } | amounts
    return perturb(scene.observed, seed=seed, **amounts)


def state_bytes(model):
    return (
        model.cam_from_world.tobytes() + model.point_xyz.tobytes() + b"".join(c.params.tobytes() for c in model.cameras)
    )


def squares(model):
    residuals = model.residuals_px()[model.obs_is_inlier]
    return 0.5 * float(np.nansum(residuals**2))


# --- derivatives and losses -------------------------------------------------------------------------------------------


@numba.njit
def observe(pose, mounted, mount, canonical, point, pixel, loss, scratch):
    """Linearise, and check the squared residual by the kernel that computes nothing else."""
    p, m, c, J = pointer(pose), pointer(mount), pointer(canonical), pointer(scratch)
    s = kernels.linearize(p, mounted, m, c, point, pixel, loss, 0.0, True, J)
    if abs(s - kernels.squared_residual(p, c, point, pixel, 0.0)) > 1e-9 * s:
        return np.nan
    return s


@settings(max_examples=60, deadline=None)
@given(
    model=st.sampled_from(list(CameraModel)),
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
    point=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.5, 8.0)),
    translation=st.tuples(*[st.floats(-2, 2)] * 3),
    mounting=st.none() | st.tuples(*[st.floats(-2, 2)] * 6),
)
def test_jacobians_equal_central_differences(model, rotation, point, translation, mounting):
    camera = synthetic_camera(model)
    turn = rigid3.exp_so3(np.array(rotation))
    in_cam = np.array([point[0] * point[2], point[1] * point[2], point[2]])
    t = np.array(translation)
    mount = rigid3.IDENTITY
    if mounting is not None:
        mount = rigid3.from_matrix(rigid3.exp_so3(np.array(mounting[:3])), np.array(mounting[3:]))
    world = turn.T @ (rigid3.apply(rigid3.inverse(mount), in_cam) - t)
    spread = np.eye(ROW, 16)

    def pixel(delta):
        moved = rigid3.exp_so3(delta[:3]) @ (turn @ (world + delta[6:9]) + t) + delta[3:6]
        moved = rigid3.apply(mount, moved)
        return np.array(distort(camera.canonical + spread @ delta[9:], *(moved[:2] / moved[2])))

    pose, mounts = np.zeros((1, 12)), pose_rows(mount[None])
    of_image = np.array([0 if mounting is not None else -1], np.int32)
    kernels.fill_rows(rigid3.from_matrix(turn, t)[None], np.zeros(1, np.int32), of_image, mounts, pose)
    scratch = np.zeros(kernels.SCRATCH)
    observed = pixel(np.zeros(25)) - [3.0, -4.0]
    args = (pose[0], mounting is not None, mounts[0], camera.canonical, tuple(world), tuple(observed))
    s = observe(*args, kernels.RobustLoss(0, 1.0), scratch)
    assert s == pytest.approx(25.0, rel=1e-9)
    rows = scratch.reshape(-1, 2, 8)
    ours = np.hstack([rows[0][:, :6], rows[5][:, :3], scratch[16:48].reshape(16, 2).T])
    steps = np.array([1e-6] * 9 + [1e-3] * 4 + [1e-6] * 12)
    used = np.append(np.ones(9, bool), canonical_from_params(model).any(axis=1))
    ours[:, ~used] = 0.0
    numeric = np.stack([(pixel(h) - pixel(-h)) / (2 * h.max()) for h in np.diag(steps)], 1) * used
    np.testing.assert_allclose(ours, numeric, atol=2e-5 * np.abs(numeric).max())
    np.testing.assert_allclose(rows[5][:, 3], [3.0, -4.0], atol=1e-9)
    # a robust weight scales residual and Jacobians by the root of rho'
    weighted = np.zeros(kernels.SCRATCH)
    observe(*args, kernels.RobustLoss(2, 4.0), weighted)
    np.testing.assert_allclose(weighted, scratch * math.sqrt(4.0 / 29.0), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("loss", [0, 1, 2])
def test_losses_are_the_textbook_ones(loss):
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.uniform(0, 9, 50), 10.0 ** rng.uniform(-8, 8, 200)])
    scale2 = 2.25

    def rho(s):
        if loss == 0:
            return s
        if loss == 1:
            return np.where(s <= scale2, s, 2 * np.sqrt(s * scale2) - scale2)
        return scale2 * np.log1p(s / scale2)

    robust, state = kernels.RobustLoss(loss, scale2), (0.0, 1.0)
    for s in values:
        state = kernels.add_loss(robust, s, *state)
        h = 1e-6 * s
        slope = (rho(s + h) - rho(s - h)) / (2 * h)
        assert kernels.robust_weight(robust, s) == pytest.approx(slope, rel=1e-4)
    assert kernels.total_loss(robust, *state) == pytest.approx(0.5 * rho(values).sum(), rel=1e-12)


# --- the minimum ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["trivial", "huber", "cauchy"])
def test_same_minimum_as_scipy(loss):
    from scipy.optimize import least_squares

    scene = make_scene(1, 3, 20, sigma_px=1.0, layout="forward")
    # a small disturbance: robust losses have more than one valley
    start = start_of(scene, rotation_deg=0.02, translation_fraction=0.001, point_fraction=0.001, focal_fraction=0.003)
    model = start.copy()
    options = replace(TIGHT, loss=loss, loss_scale_px=0.8, max_iterations=500)
    report = adjust_bundle(model, options)
    canonical, tracks = start.cameras[0].canonical, start.tracks

    def errors(x):
        c = canonical.copy()
        c[:2] += x[0]
        c[4] += x[1]
        poses = x[2:20].reshape(3, 6)
        turn = rigid3.exp_so3(poses[:, :3]) @ rigid3.rotation_matrix(start.cam_from_world)
        t = start.cam_from_world[:, 4:] + poses[:, 3:]
        points = start.point_xyz + x[20:].reshape(-1, 3)
        i = tracks.obs_image_idx
        y = np.einsum("nij,nj->ni", turn[i], points[tracks.obs_track_idx]) + t[i]
        xy = y[:, :2] / y[:, 2:]
        radial = 1 + c[4] * (xy**2).sum(1, keepdims=True)
        e = c[:2] * radial * xy + c[2:4] - tracks.obs_xy
        # scipy's loss is per coordinate: hand it residuals whose squares sum to rho of the whole length
        a, length = 0.8, np.linalg.norm(e, axis=1, keepdims=True)
        if loss == "huber":
            e *= np.where(length <= a, 1.0, np.sqrt(np.maximum(2 * a * length - a * a, 0)) / length)
        elif loss == "cauchy":
            e *= a * np.sqrt(np.log1p((length / a) ** 2)) / length
        return e.ravel()

    found = least_squares(errors, np.zeros(80), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=2000)
    assert report.initial_cost == pytest.approx(0.5 * (errors(np.zeros(80)) ** 2).sum(), rel=1e-10)
    assert report.final_cost == pytest.approx(found.cost, rel=1e-6)


@pytest.mark.parametrize("model", list(CameraModel))
@pytest.mark.parametrize("per_image", [False, True])
def test_noise_free_scene_is_recovered(model, per_image):
    cameras = [synthetic_camera(model, focal=900.0 + 5 * i) for i in range(8)] if per_image else synthetic_camera(model)
    scene = make_scene(2, 8, 400, cameras, sigma_px=0.0)
    found = start_of(scene)
    report = adjust_bundle(found, TIGHT)
    assert report.final_cost < 1e-8 * report.initial_cost
    for camera, ground_truth in zip(found.cameras, scene.ground_truth.cameras, strict=True):
        np.testing.assert_allclose(camera.params, ground_truth.params, atol=1e-3 * ground_truth.focal)


def test_cost_per_degree_of_freedom_is_the_noise():
    scene = make_scene(3, 12, 1500, sigma_px=0.7)
    found = start_of(scene)
    report = adjust_bundle(found)
    dof = 2 * report.num_observations - 3 * 1500 - 6 * 12 - 2 + 7
    # sigma^2 chi^2 / dof has relative deviation sqrt(2 / dof): five sigma
    assert abs(2 * report.final_cost / dof / 0.7**2 - 1) < 5 * math.sqrt(2 / dof)
    assert report.final_cost == pytest.approx(squares(found), rel=1e-9)
    assert report.termination == "converged"


def test_robust_loss_shrugs_off_outliers():
    scene = make_scene(4, 10, 800, sigma_px=0.5, outlier_ratio=0.05)
    errors = {}
    for loss in ("trivial", "cauchy"):
        found = start_of(scene)
        adjust_bundle(found, AdjustOptions(loss=loss, max_iterations=60))
        good = ~scene.obs_is_outlier
        errors[loss] = np.sqrt((found.residuals_px()[good] ** 2).mean())
    assert errors["cauchy"] < 0.1 * errors["trivial"]
    assert errors["cauchy"] < 1.0


# --- what must not change ---------------------------------------------------------------------------------------------


def test_any_number_of_threads_gives_the_same_bytes(monkeypatch):
    monkeypatch.setattr(solver, "_CHUNK_OBSERVATIONS", 1000)
    scene = make_scene(5, 12, 3000)
    results = []
    for threads in (1, 2, 5):
        found = start_of(scene)
        adjust_bundle(found, AdjustOptions(loss="huber"), threads=threads)
        results.append(state_bytes(found))
    assert results[0] == results[1] == results[2]


def test_constant_things_keep_their_bits():
    cameras = [synthetic_camera(), synthetic_camera(CameraModel.OPENCV)]
    scene = make_scene(6, 10, 600, cameras)
    start = start_of(scene)
    found = start.copy()
    rng = np.random.default_rng(0)
    images, points = rng.random(10) < 0.5, rng.random(600) < 0.3
    report = adjust_bundle(
        found, varying=Varying(images=images, cameras=np.array([True, False]), constant_points=points)
    )
    assert report.final_cost < report.initial_cost
    np.testing.assert_array_equal(found.cam_from_world[~images], start.cam_from_world[~images])
    np.testing.assert_array_equal(found.point_xyz[points], start.point_xyz[points])
    assert found.cameras[1] is start.cameras[1]
    assert (found.cam_from_world[images] != start.cam_from_world[images]).any(1).all()
    assert (found.cameras[0].params[[1, 2]] == start.cameras[0].params[[1, 2]]).all()
    assert (found.cameras[0].params[[0, 3]] != start.cameras[0].params[[0, 3]]).all()


def test_only_chosen_points_and_inliers_take_part():
    scene = make_scene(7, 6, 300)
    start = start_of(scene)
    start.obs_is_inlier[scene.observed.tracks.track_ptr[0] : scene.observed.tracks.track_ptr[1] - 1] = False
    chosen = np.zeros(300, bool)
    chosen[:100] = True
    found = start.copy()
    report = adjust_bundle(found, varying=Varying(points=chosen))
    assert report.num_points == 99  # the first point is left with one observation
    np.testing.assert_array_equal(found.point_xyz[100:], start.point_xyz[100:])
    np.testing.assert_array_equal(found.point_xyz[0], start.point_xyz[0])


def test_user_fixed_camera_and_refine_flags():
    scene = make_scene(8, 6, 300, synthetic_camera(CameraModel.OPENCV))
    start = start_of(scene)
    found = start.copy()
    adjust_bundle(found, AdjustOptions(refine_focal=False, refine_distortion=False, refine_principal_point=True))
    changed = found.cameras[0].params != start.cameras[0].params
    assert [n for n, c in zip(PARAM_NAMES[CameraModel.OPENCV], changed, strict=True) if c] == ["cx", "cy"]
    start.cameras[0] = replace(start.cameras[0], is_fixed=True)
    found = start.copy()
    adjust_bundle(found)
    assert (found.cameras[0].params == start.cameras[0].params).all()


def test_long_tracks_and_cameras_per_image():
    cameras = [synthetic_camera(CameraModel.RADIAL, focal=880 + i) for i in range(40)]
    scene = make_scene(9, 40, 300, cameras, layout="ring", detection=1.0)
    assert np.diff(scene.observed.tracks.track_ptr).max() > 15
    found = start_of(scene)
    report = adjust_bundle(found)
    dof = 2 * report.num_observations - 3 * 300 - 9 * 40 + 7
    assert abs(2 * report.final_cost / dof / 0.25 - 1) < 5 * math.sqrt(2 / dof)


def test_two_features_of_one_image_in_a_track():
    scene = make_scene(10, 5, 200)
    old = scene.observed.tracks
    doubled = [np.concatenate([a, a[:50]]) for a in (old.obs_track_idx, old.obs_image_idx)]
    features = np.concatenate([old.obs_feature_idx, old.obs_feature_idx[:50] + 10000])
    xy = np.concatenate([old.obs_xy, old.obs_xy[:50] + 0.3])
    start = start_of(scene)
    start.tracks = make_tracks(5, 200, *doubled, features, xy)
    start.obs_is_inlier = np.ones(len(xy), bool)
    report = adjust_bundle(start, TIGHT)
    # Gauss-Newton converges fast only if the reduced system counts both
    assert report.num_iterations <= 12
    assert report.termination == "converged"


# --- priors and gtsam factors -----------------------------------------------------------------------------------------


def focal_only(sigma):
    """A scene in which the focal length is the only unknown, and the closed form of its posterior."""
    scene = make_scene(11, 3, 100, synthetic_camera(CameraModel.SIMPLE_PINHOLE))
    model = scene.observed.copy()
    prior = replace(model.cameras[0].with_params([950.0, 504.0, 372.0]), focal_sigma=sigma)
    tracks = model.tracks
    rays = rigid3.apply(model.cam_from_world[tracks.obs_image_idx], model.point_xyz[tracks.obs_track_idx])
    xy = tracks.obs_xy
    design = (rays[:, :2] / rays[:, 2:]).ravel()
    weight = 1 / sigma**2
    expected = (design @ (xy - [504.0, 372.0]).ravel() + weight * 950.0) / (design @ design + weight)
    every = np.ones(100, bool)
    return model, prior, expected, {"varying": Varying(images=np.zeros(3, bool), points=every, constant_points=every)}


@pytest.mark.parametrize("sigma", [1e-3, 0.1, 1.0, 100.0])
def test_focal_prior_gives_the_gaussian_posterior(sigma):
    model, prior, expected, masks = focal_only(sigma)
    adjust_bundle(model, TIGHT, prior_cameras=[prior], **masks)
    assert model.cameras[0].focal == pytest.approx(expected, rel=1e-9)


def test_own_prior_equals_gtsams():
    import gtsam
    from gtsam.symbol_shorthand import K

    model, prior, expected, masks = focal_only(0.1)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorVector(K(0), np.array([950.0]), gtsam.noiseModel.Isotropic.Sigma(1, 0.1)))
    twin = model.copy()
    one = adjust_bundle(model, TIGHT, prior_cameras=[prior], **masks)
    two = adjust_bundle(twin, TIGHT, extra_factors=graph, **masks)
    assert one.final_cost == pytest.approx(two.final_cost, rel=1e-12)
    assert twin.cameras[0].focal == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("per_image", [False, True])
def test_sparse_system_equals_dense_with_any_factors(monkeypatch, per_image):
    import gtsam
    from gtsam.symbol_shorthand import K, X

    from sfmapp.adjust.factors import gtsam_pose

    scene = make_scene(12, 8, 300, [synthetic_camera()] * (8 if per_image else 1))
    where = [gtsam_pose(pose) for pose in scene.ground_truth.cam_from_world]
    noise = gtsam.noiseModel.Isotropic
    graph = gtsam.NonlinearFactorGraph()
    for i in (0, 3):
        graph.add(gtsam.PriorFactorPose3(X(i), where[i].retract(np.full(6, 0.01)), noise.Sigma(6, 1e-3)))
    graph.add(gtsam.BetweenFactorPose3(X(2), X(7), where[2].between(where[7]), noise.Sigma(6, 1e-2)))
    graph.add(gtsam.PriorFactorVector(K(0), np.array([905.0, -0.07]), noise.Sigma(2, 0.5)))
    graph.add(gtsam.PriorFactorPose3(X(99), where[0], noise.Sigma(6, 1e-3)))  # an image that does not exist
    reports, states = [], []
    for kind, limit in (("tiles", 160), *((kind, n) for kind in ("gtsam", "lapack", "envelope") for n in (160, 0))):
        monkeypatch.setattr(solver, "choose_solver", lambda *_, kind=kind, **__: kind)
        monkeypatch.setattr(solver, "_MAX_DENSE_BLOCKS", limit)
        found = start_of(scene)
        reports.append(adjust_bundle(found, TIGHT, extra_factors=graph))
        states.append(found)
        assert reports[-1].solver == kind
        assert reports[-1].num_left_out == 1
        assert reports[0].final_cost == pytest.approx(reports[-1].final_cost, rel=1e-9)
        np.testing.assert_allclose(states[0].cam_from_world, states[-1].cam_from_world, atol=1e-6)
    # quadratic convergence shows that gradient and curvature of the factors are right
    assert reports[0].num_iterations <= 12
    poses = [gtsam_pose(pose) for pose in states[0].cam_from_world]
    expected = squares(states[0]) + sum(
        graph.at(n).error(values) for n in range(4) if (values := _values(graph.at(n), poses, states[0].cameras))
    )
    assert reports[0].final_cost == pytest.approx(expected, rel=1e-9)


def _values(factor, poses, cameras):
    import gtsam

    values = gtsam.Values()
    for key in factor.keys():  # noqa: SIM118
        symbol = gtsam.Symbol(key)
        if chr(symbol.chr()) == "x":
            values.insert(key, poses[symbol.index()])
        else:
            values.insert(key, cameras[symbol.index()].params[[0, 3]])
    return values


def test_foreign_keys_are_refused():
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPoint3(gtsam.symbol("v", 0), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    with pytest.raises(ValueError, match="found v0"):
        adjust_bundle(make_scene(0, 3, 50).observed.copy(), extra_factors=graph)


# --- degenerate input -------------------------------------------------------------------------------------------------


def one_camera_model(num_images, xyz, poses, xy_offset=0.0):
    camera = Camera(CameraModel.SIMPLE_PINHOLE, 100, 100, np.array([100.0, 50.0, 50.0]))
    images, points = np.meshgrid(np.arange(num_images), np.arange(len(xyz)), indexing="ij")
    images, points = images.ravel(), points.ravel()
    xy = np.concatenate([project(camera, rigid3.apply(p, xyz)) for p in poses]) if len(xyz) else np.zeros((0, 2))
    tracks = make_tracks(num_images, len(xyz), points, images, points, np.nan_to_num(xy) + xy_offset)
    model = Reconstruction.empty([camera], [str(i) for i in range(num_images)], np.zeros(num_images, np.int32), tracks)
    model.cam_from_world[:] = poses
    model.point_xyz[:] = xyz
    model.obs_is_inlier[:] = True
    return model


def shifted_poses(count):
    poses = np.tile(rigid3.IDENTITY, (count, 1))
    poses[:, 4] = np.arange(count) * 0.3
    return poses


def test_nothing_to_do():
    model = one_camera_model(2, np.zeros((0, 3)), shifted_poses(2))
    assert adjust_bundle(model).termination == "nothing"
    model = one_camera_model(1, np.random.default_rng(0).normal(size=(20, 3)) + AWAY, shifted_poses(1))
    before = state_bytes(model)
    assert adjust_bundle(model).termination == "nothing"
    assert state_bytes(model) == before
    unregistered = one_camera_model(2, np.ones((5, 3)), np.full((2, 7), np.nan))
    assert adjust_bundle(unregistered).termination == "nothing"


def test_two_images_without_parallax_do_no_harm():
    rng = np.random.default_rng(1)
    poses = np.tile(rigid3.IDENTITY, (2, 1))
    model = one_camera_model(2, rng.normal(size=(30, 3)) + AWAY, poses, rng.normal(0, 0.5, (60, 2)))
    before = squares(model)
    report = adjust_bundle(model)
    assert np.isfinite(model.cam_from_world).all()
    assert np.isfinite(model.point_xyz).all()
    assert squares(model) <= before
    assert report.final_cost <= report.initial_cost


def test_point_behind_and_on_the_camera():
    rng = np.random.default_rng(2)
    xyz = rng.normal(size=(40, 3)) + AWAY
    model = one_camera_model(3, xyz, shifted_poses(3), rng.normal(0, 0.3, (120, 2)))
    model.point_xyz[0] = [0.0, 0.0, -4.0]
    model.point_xyz[1] = [0.0, 0.0, 0.0]
    report = adjust_bundle(model)
    assert np.isfinite(model.point_xyz).all()
    assert np.isfinite(report.final_cost)
    assert report.final_cost < report.initial_cost
    good = ~np.isin(model.tracks.obs_track_idx, (0, 1))
    assert np.abs(model.residuals_px()[good]).max() < 3


def test_nans_stay_out():
    scene = make_scene(13, 5, 200)
    model = start_of(scene)
    model.point_xyz[3] = np.nan
    model.cam_from_world[4] = np.nan
    xy = model.tracks.obs_xy.copy()
    xy[10] = np.nan
    model.tracks = replace(model.tracks, obs_xy=xy)
    report = adjust_bundle(model)
    assert report.termination == "converged"
    assert np.isnan(model.point_xyz[3]).all()
    assert np.isnan(model.cam_from_world[4]).all()
    assert np.isfinite(np.delete(model.point_xyz, 3, 0)).all()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.0, 0.6))
def test_never_worse_however_bad_the_start(seed, size):
    scene = make_scene(14, 4, 60)
    start = perturb(
        scene.observed, seed=seed, rotation_deg=60 * size, translation_fraction=size, point_fraction=size,
        focal_fraction=0.5 * size,
    )  # fmt: skip
    found = start.copy()
    report = adjust_bundle(found, AdjustOptions(max_iterations=15))
    again = adjust_bundle(found.copy(), AdjustOptions(max_iterations=1))
    assert report.final_cost <= report.initial_cost
    assert again.initial_cost == pytest.approx(report.final_cost, rel=1e-9)
    assert np.isfinite(found.cam_from_world).all()


def test_cancellation_leaves_the_best_state():
    scene = make_scene(15, 6, 300)
    start = start_of(scene)
    events = Events()
    events.cancel()
    found = start.copy()
    with pytest.raises(InterruptedRunError):
        adjust_bundle(found, events=events)
    assert squares(found) <= squares(start)
