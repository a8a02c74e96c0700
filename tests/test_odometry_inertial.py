"""Maps and inertial measurements of an analytic motion: gtsam's conventions, scale, gravity, biases, their errors."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, B, L, M, V, X

from inertial_flights import (
    ACCEL_BIAS,
    GYRO_BIAS,
    IMU_FROM_CAM,
    MAP_FROM_WORLD,
    SCALE,
    Flight,
    seen_map,
    true_gravity,
    true_map,
)
from odometry_sequences import gauge_errors
from sfmapp.adjust.factors import gtsam_pose
from sfmapp.adjust.gauge import similarity_basis
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial import graph as inertial_graph
from sfmapp.odometry.inertial.faults import align_or_explain
from sfmapp.odometry.inertial.graph import InertialLink, Placement, midway, preintegration
from sfmapp.odometry.inertial.gyroscope import GyroTrust, imu_rotation, imu_steps
from sfmapp.odometry.inertial.integration import GRAVITY, integrate
from sfmapp.odometry.inertial.scale import ScaleRefusal
from sfmapp.odometry.inertial.seen_map import SeenMap
from sfmapp.odometry.inertial.visual_inertial import InertialAlignment, align_imu
from sfmapp.odometry.refinement import inertial_adjustment


def aligned(seen: SeenMap, imu: Imu) -> InertialAlignment:
    found = align_imu(seen, imu)
    assert isinstance(found, InertialAlignment), found
    return found


def scale_error(found: InertialAlignment, truth: np.ndarray) -> float:
    """Of the spread of the map in metres, relative, in its standard deviations."""
    spread = found.scale * rigid3.spread(found.model.cam_from_world)
    return float(np.log(spread / (SCALE * rigid3.spread(truth))) / found.sigma_relative)


def tilt(found: InertialAlignment) -> float:
    """Of the vertical, radians."""
    return float(np.linalg.norm(np.cross(found.gravity_in_map, true_gravity())) / GRAVITY**2)


# ---- gtsam's conventions and our integration


def test_gtsam_and_our_integration_follow_the_true_motion() -> None:
    """Gravity's sign, the order of biases, and slopes by the biases."""
    flight = Flight(1)
    imu = flight.imu(1, 3.0, noise=0.0, rate_hz=1000.0)
    steps = imu_steps(imu, 0.3137, 0.9)
    assert steps is not None
    assert steps[:, 0].sum() == pytest.approx(0.9 - 0.3137)
    ends = np.array([0.3137, 0.9])
    r, p, v = flight.rotation(ends), flight.position(ends), flight.velocity(ends)
    dt, down = ends[1] - ends[0], np.array([0.0, 0.0, -GRAVITY])
    delta = np.empty(60)
    integrate(steps, np.zeros(3), delta)
    assert np.allclose(delta[:9].reshape(3, 3), r[0].T @ r[1], atol=1e-6)
    assert np.allclose(delta[9:12], r[0].T @ (v[1] - v[0] - down * dt), atol=2e-5)
    assert np.allclose(delta[12:15], r[0].T @ (p[1] - p[0] - v[0] * dt - 0.5 * down * dt**2), atol=1e-5)
    # gtsam on the manifold does the same sums
    same = gtsam.PreintegratedCombinedMeasurementsManifold(preintegration(imu), gtsam.imuBias.ConstantBias())
    for step in midway(steps, np.zeros(3)):
        same.integrateMeasurement(step[4:], step[1:4], step[0])
    assert np.allclose(same.deltaRij().matrix().ravel(), delta[:9], atol=1e-13)
    assert np.allclose(same.deltaVij(), delta[9:12], atol=1e-12)
    assert np.allclose(same.deltaPij(), delta[12:15], atol=1e-12)
    # a sensor with biases, told of them at the end: gtsam's accelerometer comes first
    gyro_bias, accel_bias = 1e-3 * GYRO_BIAS, 1e-2 * ACCEL_BIAS
    biased = steps + np.r_[0.0, gyro_bias, accel_bias]
    sums = gtsam.PreintegratedCombinedMeasurements(preintegration(imu), gtsam.imuBias.ConstantBias())
    for step in midway(biased, np.zeros(3)):
        sums.integrateMeasurement(step[4:], step[1:4], step[0])
    state = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(r[0]), p[0]), v[0])
    bias = gtsam.imuBias.ConstantBias(accel_bias, gyro_bias)
    assert np.allclose(bias.vector(), np.r_[accel_bias, gyro_bias])
    after = sums.predict(state, bias)  # gtsam's default sums in the tangent space, to the first order in a step
    assert np.allclose(after.pose().rotation().matrix(), r[1], atol=2e-5)
    assert np.allclose(after.pose().translation(), p[1], atol=2e-5)
    assert np.allclose(after.velocity(), v[1], atol=5e-5)
    integrate(biased, np.zeros(3), delta)
    slopes = delta[15:].reshape(5, 3, 3)
    turn = delta[:9].reshape(3, 3) @ rigid3.exp_so3(slopes[0] @ gyro_bias)
    assert np.allclose(turn, r[0].T @ r[1], atol=2e-6)
    gained = delta[9:12] + slopes[1] @ gyro_bias + slopes[2] @ accel_bias
    assert np.allclose(gained, r[0].T @ (v[1] - v[0] - down * dt), atol=5e-5)
    moved = delta[12:15] + slopes[3] @ gyro_bias + slopes[4] @ accel_bias
    assert np.allclose(moved, r[0].T @ (p[1] - p[0] - v[0] * dt - 0.5 * down * dt**2), atol=2e-5)


def test_gtsam_s_covariance_is_that_of_drawn_noise() -> None:
    flight = Flight(2)
    clean = flight.imu(2, 1.0, noise=0.0)
    noise = Imu(clean.timestamps_s, clean.gyro, clean.accel, IMU_FROM_CAM, 0.01, 0.1, 1e-8, 1e-8)
    steps = imu_steps(clean, 0.0, 0.5)
    assert steps is not None
    sums = gtsam.PreintegratedCombinedMeasurements(preintegration(noise), gtsam.imuBias.ConstantBias())
    for step in midway(steps, np.zeros(3)):
        sums.integrateMeasurement(step[4:], step[1:4], step[0])
    rng = np.random.default_rng(5)
    exact, drawn, delta = np.empty(60), np.empty((1500, 9)), np.empty(60)
    integrate(steps, np.zeros(3), exact)
    for n in range(len(drawn)):
        sigma = np.repeat([0.01, 0.1], 3) / np.sqrt(steps[:, :1])
        integrate(np.c_[steps[:, :1], steps[:, 1:] + sigma * rng.normal(size=(len(steps), 6))], np.zeros(3), delta)
        drawn[n, :3] = rigid3.log_so3(exact[:9].reshape(3, 3).T @ delta[:9].reshape(3, 3))
        drawn[n, 3:6], drawn[n, 6:] = delta[12:15] - exact[12:15], delta[9:12] - exact[9:12]
    ours = np.std(drawn, 0)
    theirs = np.sqrt(np.diag(sums.preintMeasCov()))[:9]
    assert np.allclose(ours, theirs, rtol=0.12)


def test_slopes_of_a_factor_between_two_images() -> None:
    """Where the sensor is, exactly, and every slope against differences."""
    flight, times = Flight(3), np.array([1.0, 1.3])
    imu = flight.imu(3, 2.0, noise=0.0, rate_hz=1000.0)
    map_from_world = rigid3.rotation_matrix(MAP_FROM_WORLD)
    place, rates = Placement(IMU_FROM_CAM, map_from_world.T), flight.gyro(times)
    poses = [gtsam_pose(pose) for pose in true_map(flight, times)]
    # the map's origin is not the world's
    shift = -map_from_world.T @ MAP_FROM_WORLD[4:7] * SCALE
    exact = np.array([np.log(SCALE), 0.0, 0.0, 0.0])
    for n in range(2):
        sensor = place.sensor(poses[n], flight.velocity(times)[n], exact, np.zeros(6), rates[n])
        assert np.allclose(sensor.rotation().matrix(), flight.rotation(times)[n], atol=1e-12)
        assert np.allclose(sensor.translation() + shift, flight.position(times)[n], atol=1e-12)
    # an image that was taken later: the sensor was not there yet
    later = [gtsam_pose(pose) for pose in true_map(flight, times + 1e-3)]
    sensor = place.sensor(later[0], flight.velocity(times)[0], np.r_[exact[:3], 1e-3], np.zeros(6), rates[0])
    assert np.allclose(sensor.rotation().matrix(), flight.rotation(times)[0], atol=1e-5)
    assert np.allclose(sensor.translation() + shift, flight.position(times)[0], atol=1e-5)

    steps = imu_steps(imu, *times)
    assert steps is not None
    sums = gtsam.PreintegratedCombinedMeasurements(preintegration(flight.imu(3, 2.0)), gtsam.imuBias.ConstantBias())
    for step in midway(steps, np.zeros(3)):
        sums.integrateMeasurement(step[4:], step[1:4], step[0])
    link, values, rng = InertialLink(sums, place, rates, 0.5), gtsam.Values(), np.random.default_rng(4)
    keys = [X(0), V(0), B(0), X(1), V(1), B(1), A(0), M(0)]
    for n in range(2):
        values.insert(X(n), poses[n].retract(1e-3 * rng.normal(size=6)))
        values.insert(V(n), flight.velocity(times)[n] + 0.01 * rng.normal(size=3))
        values.insert(B(n), gtsam.imuBias.ConstantBias(0.01 * rng.normal(size=3), 1e-3 * rng.normal(size=3)))
    values.insert(A(0), exact + np.array([0.01, 0.2, -0.1, 0.004]))
    values.insert(M(0), np.array([0.1, -0.2, 0.3, 0.05, -0.1, 0.02]))
    factor = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(15), keys, link.error)
    matrix, right = factor.linearize(values).jacobian()
    for n, (key, dim) in enumerate(zip(keys, (6, 3, 6, 6, 3, 6, 4, 6), strict=True)):
        first = [0, 6, 9, 15, 21, 24, 30, 34][n]
        for d in range(dim):
            sides, h = [], 1e-6
            for sign in (1.0, -1.0):
                step = gtsam.VectorValues()
                for other, size in zip(keys, (6, 3, 6, 6, 3, 6, 4, 6), strict=True):
                    step.insert(other, np.zeros(size) if other != key else sign * h * np.eye(size)[d])
                sides.append(factor.unwhitenedError(values.retract(step)))
            slope = (sides[0] - sides[1]) / (2 * h)
            assert np.allclose(matrix[:, first + d], slope, atol=2e-4 * (1 + np.abs(slope).max())), (n, d)
    assert np.allclose(-right, factor.unwhitenedError(values))


# ---- the whole


def test_exact_measurements_give_the_exact_alignment() -> None:
    flight, times = Flight(3), np.arange(0, 10, 0.25)
    truth = true_map(flight, times)
    found = aligned(seen_map(flight, times, 3, 0.0), flight.imu(3, 10.0, noise=1e-2, rate_hz=1000.0))
    assert found.scale == pytest.approx(SCALE, rel=1e-4)
    assert np.allclose(found.gravity_in_map, true_gravity(), atol=2e-3)
    assert np.allclose(found.gyro_bias, GYRO_BIAS, atol=1e-4)
    assert np.allclose(found.accel_bias, ACCEL_BIAS, atol=2e-3)
    assert np.abs(gauge_errors(found.model.cam_from_world, truth, 7)).max() < 1e-4
    up = rigid3.rotation_matrix(found.world_from_map) @ -true_gravity()
    assert np.allclose(up / GRAVITY, [0, 0, 1], atol=2e-4)
    turn = rigid3.rotation_matrix(found.world_from_map) @ rigid3.rotation_matrix(MAP_FROM_WORLD)
    assert np.allclose(found.velocity, flight.velocity(times[found.pose_idx]) @ turn.T, atol=2e-3)
    assert found.world_from_map[7] == found.scale


def test_errors_are_as_large_as_their_sigmas() -> None:
    """Half a pixel, a small sensor: errors of scale, vertical, clock and poses over their sigmas, in bounds on both
    sides; and the poses are better than those of the images alone."""
    scores, squares, residuals, gains = [], [], [], []
    times = np.arange(0, 8, 0.25)
    for seed in range(12):
        flight = Flight(seed)
        seen, truth = seen_map(flight, times, seed, 0.5, num_points=300), true_map(flight, times)
        found = aligned(seen, flight.imu(seed, 8.0))
        clock = found.clock_offset_s / found.clock_sigma_s
        scores.append([scale_error(found, truth), tilt(found) / found.gravity_sigma_rad, clock])
        ours, theirs = (gauge_errors(m.cam_from_world, truth, 7) for m in (found.model, seen.model))
        pairs = zip(ours, found.pose_covariance, strict=True)
        squares.append(np.mean([e @ np.linalg.solve(c, e) / 6 for e, c in pairs]))
        gains.append(np.sqrt((ours[:, 3:] ** 2).sum() / (theirs[:, 3:] ** 2).sum()))
        residuals.append(found.residual)
        assert np.abs(found.gyro_bias - GYRO_BIAS).max() < 2e-3
        assert np.abs(found.accel_bias - ACCEL_BIAS).max() < 0.1
    rms = np.sqrt(np.mean(np.square(scores), 0))
    assert (rms > 0.6).all()  # 12 draws: 20 % at one sigma
    assert (rms < 1.6).all()
    assert 0.85 < np.mean(squares) < 1.2  # 1.0 to 1.1 over sets of 10 to 20
    assert 0.85 < np.mean(residuals) < 1.1
    assert np.median(gains) < 0.7  # 0.46 over 20


def test_the_minimum_and_its_sigmas_are_those_of_a_plain_gtsam_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sensor poses and landmarks in a world in metres, one factor an observation: no map beside it."""
    monkeypatch.setattr(inertial_graph, "_CLOCK_SIGMA_S", 1e-7)  # gtsam's factor knows no offset
    monkeypatch.setattr(inertial_graph, "_CALIBRATED", (1e-7, 1e-7))  # and no other mounting
    monkeypatch.setattr(inertial_graph, "_MAX_PULL", np.inf)
    monkeypatch.setattr(inertial_graph, "_ENOUGH", 1e-7)
    sums: list[object] = []
    integrated = inertial_graph.InertialLink.__init__

    def noted(self: InertialLink, measured: object, *rest: object) -> None:
        sums.append(measured)
        integrated(self, measured, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(inertial_graph.InertialLink, "__init__", noted)
    times, sigma = np.arange(0, 3, 0.25), 0.5
    flight = Flight(2)
    seen = seen_map(flight, times, 2, sigma, num_points=60)
    found = aligned(seen, flight.imu(2, 3.0))
    count, model = len(times) - 1, found.model

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    world_from_map = rigid3.rotation_matrix(found.world_from_map)
    place = Placement(IMU_FROM_CAM, world_from_map)
    still = np.array([np.log(found.scale), 0.0, 0.0, 0.0])
    body_from_cam = gtsam_pose(rigid3.inverse(IMU_FROM_CAM))
    calibration = gtsam.Cal3_S2(320.0, 320.0, 0.0, 320.0, 240.0)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    for k in range(count + 1):
        start.insert(
            X(k), place.sensor(gtsam_pose(model.cam_from_world[k]), np.zeros(3), still, np.zeros(6), np.zeros(3))
        )
        start.insert(V(k), found.velocity[k])
        start.insert(B(k), gtsam.imuBias.ConstantBias(found.accel_bias, found.gyro_bias))
    seen_by = np.bincount(model.tracks.obs_track_idx, minlength=60)
    for t in np.flatnonzero(seen_by > 1).tolist():
        start.insert(L(t), found.scale * world_from_map @ model.point_xyz[t])
        for o in range(model.tracks.track_ptr[t], model.tracks.track_ptr[t + 1]):
            at, xy = int(model.tracks.obs_image_idx[o]), model.tracks.obs_xy[o]
            graph.push_back(
                gtsam.GenericProjectionFactorCal3_S2(xy, pixel, X(at), L(t), calibration, body_from_cam)
            )  # fmt: skip
    for k, measured in enumerate(sums[-count:]):
        graph.push_back(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measured))
    bias = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.3, 0.1], 3))
    hat = gtsam.imuBias.ConstantBias(np.zeros(3), sums[-1].biasHat().gyroscope())  # type: ignore[attr-defined]
    graph.push_back(gtsam.PriorFactorConstantBias(B(0), hat, bias))
    # the gauge: place and heading, of which nothing is known; a radian is nothing to speak of for the tilt
    graph.push_back(gtsam.PriorFactorPose3(X(0), start.atPose3(X(0)), gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setMaxIterations(100)
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    best = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    kinds = {f.kind: f.cost for f in found.adjustment.factors}
    assert sum(kinds.values()) == pytest.approx(graph.error(best), rel=1e-6)
    mount = rigid3.inverse(IMU_FROM_CAM)
    theirs = np.array([rigid3.from_matrix(p.rotation().matrix(), p.translation()) for p in
                       (best.atPose3(X(k)) for k in range(count + 1))])  # fmt: skip
    cam_from_world = rigid3.compose(mount, rigid3.inverse(theirs))
    spread = rigid3.spread(cam_from_world)
    assert np.log(found.scale * rigid3.spread(model.cam_from_world) / spread) == pytest.approx(
        0.0, abs=0.02 * found.sigma_relative
    )
    errors = gauge_errors(model.cam_from_world, cam_from_world, 7)
    sigmas = np.sqrt(np.diagonal(found.pose_covariance, axis1=1, axis2=2))
    assert np.abs(errors / sigmas).max() < 0.05
    # marginals of all poses, brought to the gauge of the map's covariance
    order, poses_first = gtsam.Ordering(), {X(k) for k in range(count + 1)}
    for key in [*sorted(poses_first), *(key for key in best.keys() if key not in poses_first)]:  # noqa: SIM118
        order.push_back(key)
    root = np.linalg.inv(np.linalg.qr(graph.linearize(best).jacobian(order)[0], mode="r"))
    joint = (root @ root.T)[: 6 * (count + 1), : 6 * (count + 1)]
    adjoint = gtsam_pose(IMU_FROM_CAM).AdjointMap()  # the camera's tangent by the sensor's; ours is the negative
    into = np.kron(np.eye(count + 1), adjoint)
    joint = into @ joint @ into.T
    basis, constraint = similarity_basis(cam_from_world)
    grown = np.linalg.solve(constraint @ basis.T, constraint)
    assert np.sqrt(grown[6] @ joint @ grown[6]) == pytest.approx(found.sigma_relative, rel=1e-3)
    kept = np.eye(len(joint)) - basis.T @ grown
    expected = (kept @ joint @ kept.T).reshape(count + 1, 6, count + 1, 6)
    unit = np.r_[np.ones(3), np.full(3, rigid3.spread(model.cam_from_world) / spread)]
    for k in range(count + 1):
        theirs_k = expected[k, :, k] * np.outer(unit, unit)
        scale = np.sqrt(np.outer(np.diag(theirs_k), np.diag(theirs_k)))
        np.testing.assert_allclose(found.pose_covariance[k] / scale, theirs_k / scale, atol=2e-3)


def test_a_pair_of_cameras_keeps_its_metre() -> None:
    times, squares = np.arange(0, 6, 0.25), []
    for seed in range(4, 10):
        flight = Flight(seed)
        seen = seen_map(flight, times, seed, 0.5, baseline_m=0.15, num_points=200)
        found = aligned(seen, flight.imu(seed, 6.0))
        assert abs(np.log(found.scale)) < 4 * found.sigma_relative
        assert found.sigma_relative < 0.003  # of the baseline alone
        assert tilt(found) < 4 * found.gravity_sigma_rad < np.radians(1.0)
        errors = gauge_errors(found.model.cam_from_world[::2], true_map(flight, times, 1.0), 6)
        squares.append(
            np.mean([e @ np.linalg.solve(c, e) / 6 for e, c in zip(errors, found.pose_covariance, strict=True)])
        )
        assert found.model.rig is not None
        mounts = rigid3.compose(found.model.cam_from_world[1::2], rigid3.inverse(found.model.cam_from_world[::2]))
        assert np.allclose(mounts, seen.model.rig.cam_from_rig[1], atol=1e-9)  # type: ignore[union-attr]
    # poses of a flight err together: 0.89 over twelve flights, which differ by 0.35
    assert 0.6 < np.mean(squares) < 1.3


def test_gaps_and_a_noisier_sensor_than_stated_are_borne() -> None:
    flight, times = Flight(5), np.arange(0, 12, 0.25)
    seen, truth = seen_map(flight, times, 5, 0.3, num_points=300), true_map(flight, times)
    imu = flight.imu(5, 12.0)
    hole = (imu.timestamps_s < 5.0) | (imu.timestamps_s > 5.7)
    holed = replace(imu, timestamps_s=imu.timestamps_s[hole], gyro=imu.gyro[hole], accel=imu.accel[hole])
    found = aligned(seen, holed)
    assert abs(scale_error(found, truth)) < 4
    assert found.evidence["num_intervals"] < 46
    rough = replace(flight.imu(5, 12.0, noise=4.0), **{
        name: getattr(imu, name) for name in ("gyro_noise", "accel_noise", "gyro_walk", "accel_walk")
    })  # fmt: skip
    wide, narrow = aligned(seen, rough), aligned(seen, imu)
    assert wide.residual > 1.5
    assert wide.sigma_relative > 1.5 * narrow.sigma_relative
    assert abs(scale_error(wide, truth)) < 4


def test_a_mounting_that_is_slightly_wrong_is_found_and_costs_nothing() -> None:
    """Turned by a degree, centimetres away: scale, turn and place are wrong by as much as their sigmas say."""
    times, scores = np.arange(0, 8, 0.25), []
    for seed in range(8):
        flight, rng = Flight(seed), np.random.default_rng(seed)
        turn, shift = 0.02 * rng.normal(size=3), 0.03 * rng.normal(size=3)
        given = rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(turn), np.zeros(3)), IMU_FROM_CAM)
        cam_from_imu = rigid3.inverse(given)
        cam_from_imu[4:] = rigid3.inverse(IMU_FROM_CAM)[4:] - shift
        seen, truth = seen_map(flight, times, seed, 0.5, num_points=200), true_map(flight, times)
        found = aligned(seen, replace(flight.imu(seed, 8.0), imu_from_cam=rigid3.inverse(cam_from_imu)))
        evidence = found.evidence
        turned = np.radians(evidence["mounting_turn_deg"]) - rigid3.log_so3(rigid3.exp_so3(turn))
        moved = np.array(evidence["mounting_shift_m"]) - shift
        sigmas = np.r_[np.radians(evidence["mounting_turn_sigma_deg"]), evidence["mounting_shift_sigma_m"]]
        assert (sigmas < np.repeat([0.005, 0.015], 3)).all()  # far less than what is held beforehand
        scores.append(np.r_[scale_error(found, truth), np.r_[turned, moved] / sigmas])
        assert found.residual < 1.3
    rms = np.sqrt(np.mean(np.square(scores)))
    assert 0.7 < rms < 1.3, np.round(scores, 1)  # 56 numbers: 10 % at one sigma


def test_points_of_uncertain_depth_do_not_leap() -> None:
    """Flights on which a step that is hardly damped takes a point behind a camera."""
    times = np.arange(0, 8, 0.25)
    for seed in (7, 16):
        flight = Flight(seed, acceleration=0.5, turning=0.3)
        found = aligned(seen_map(flight, times, seed, 2.0), flight.imu(seed, 8.0))
        assert found.residual < 1.5
        assert abs(scale_error(found, true_map(flight, times))) < 3


def test_weak_motion_has_a_large_but_honest_sigma_and_none_is_refused() -> None:
    times = np.arange(0, 12, 0.25)
    weak = Flight(1, acceleration=0.1, turning=0.05)
    found = aligned(seen_map(weak, times, 1, 1.0, num_points=300), weak.imu(1, 12.0))
    assert 0.004 < found.sigma_relative < 0.1
    assert abs(scale_error(found, true_map(weak, times))) < 3
    slow = Flight(6, acceleration=0.004, turning=0.002)
    refusal = align_imu(seen_map(slow, times, 6, 2.0, num_points=300), slow.imu(6, 12.0))
    assert isinstance(refusal, ScaleRefusal), refusal
    assert "scale" in refusal.reason
    assert refusal.contradiction is None


def test_too_few_measurements_and_clocks_of_other_days_are_refused() -> None:
    flight, times = Flight(7), np.arange(0, 4, 0.25)
    seen, imu = seen_map(flight, times, 7, 0.3, num_points=200), flight.imu(7, 4.0)
    short = imu.timestamps_s < 1.6
    few = replace(imu, timestamps_s=imu.timestamps_s[short], gyro=imu.gyro[short], accel=imu.accel[short])
    refusal = align_imu(seen, few)
    assert isinstance(refusal, ScaleRefusal)
    assert "intervals" in refusal.reason
    refusal = align_imu(seen, replace(imu, timestamps_s=imu.timestamps_s + 1e6))
    assert isinstance(refusal, ScaleRefusal)
    assert "clocks" in refusal.reason


# ---- measurements that are not what they are taken for


def test_clocks_apart_are_found_and_taken_into_account() -> None:
    """The scale is what it would be without, and both errors are inside three of their sigmas."""
    times = np.arange(0, 8, 0.25)
    for seed, late_s in ((11, 0.02), (12, -0.05), (13, 0.2), (14, -0.75)):
        flight = Flight(seed)
        seen, imu = seen_map(flight, times, seed, 0.3, num_points=300), flight.imu(seed, 8.0)
        late = replace(imu, timestamps_s=imu.timestamps_s + late_s)
        found = align_or_explain(seen, late)
        assert isinstance(found, InertialAlignment), found
        assert abs(scale_error(found, true_map(flight, times))) < 3.5
        assert abs(found.clock_offset_s - late_s) < 3.5 * found.clock_sigma_s < 0.01
        assert found.evidence["clock_offset_s"] == found.clock_offset_s


def faulty(imu: Imu, flight: Flight, fault: str) -> Imu:
    """What wrong drivers, phones and users make of measurements."""
    up = np.einsum("nji,j->ni", flight.rotation(imu.timestamps_s), [0.0, 0.0, GRAVITY])
    order = [1, 2, 0]
    changes: dict[str, dict[str, np.ndarray]] = {
        "no gravity, late": {"accel": imu.accel - up, "timestamps_s": imu.timestamps_s + 0.05},
        "accel order": {"accel": imu.accel[:, order]},
        "accel sign": {"accel": -imu.accel},
        "gyro sign, both orders": {"accel": imu.accel[:, order], "gyro": -imu.gyro[:, order]},
        "both units": {"accel": imu.accel / 9.81, "gyro": np.degrees(imu.gyro)},
        "mounting inverted": {"imu_from_cam": rigid3.inverse(IMU_FROM_CAM)},
        "mounting unknown": {"imu_from_cam": rigid3.IDENTITY},
    }
    return replace(imu, **changes[fault])


@pytest.mark.parametrize(
    ("fault", "cause", "remedy"),
    [
        ("no gravity, late", "gravity is already subtracted", "with gravity"),
        ("accel order", "the accelerometer has other axes", "(z, x, y) of accelerometer"),
        ("accel sign", "the accelerometer is negated", "sign of accelerometer"),
        ("gyro sign, both orders", "the gyroscope has other axes", "(-z, -x, -y) of gyroscope"),
        ("both units", "degrees per second and the accelerometer is in g", "9.81"),
        ("mounting inverted", "the wrong way round", "invert"),
        ("mounting unknown", "against the mounting", "calibrate the rotation"),
    ],
)
def test_what_contradicts_the_map_is_named_with_its_remedy(fault: str, cause: str, remedy: str) -> None:
    flight, times = Flight(16), np.arange(0, 6, 0.25)
    imu = flight.imu(16, 6.0)
    found = align_or_explain(seen_map(flight, times, 16, 0.5, num_points=150), faulty(imu, flight, fault))
    assert isinstance(found, ScaleRefusal), found
    assert found.contradiction is not None
    rows = found.contradiction.evidence["explained_by"]
    assert [cause in row["fault"] for row in rows] == [True]
    assert cause in found.contradiction.message
    assert remedy in found.contradiction.advice
    assert rows[0]["residual"] < 5


def test_a_fault_that_nothing_explains_is_no_less_refused() -> None:
    flight, times = Flight(17), np.arange(0, 6, 0.25)
    imu = flight.imu(17, 6.0)
    wrong = replace(imu, accel=Flight(18).imu(18, 6.0).accel)
    found = align_or_explain(seen_map(flight, times, 17, 0.5, num_points=150), wrong)
    assert isinstance(found, ScaleRefusal), found
    assert found.contradiction is not None
    assert "explained_by" not in found.contradiction.evidence
    assert "check the sensor" in found.contradiction.advice


@pytest.mark.parametrize(("solver_name", "baseline_m"), [("gtsam", None), ("lapack", 0.11)])
def test_a_large_map_has_the_same_sigmas_without_those_of_its_keyframes(
    monkeypatch: pytest.MonkeyPatch, solver_name: str, baseline_m: float | None
) -> None:
    flight, times = Flight(4), np.arange(0, 6, 0.25)
    seen, imu = seen_map(flight, times, 4, 0.5, num_points=250, baseline_m=baseline_m), flight.imu(4, 6.0)
    whole = aligned(seen, imu)
    monkeypatch.setattr("sfmapp.odometry.inertial.graph.MAX_COVARIANCE_KEYFRAMES", 20)
    monkeypatch.setattr("sfmapp.adjust.solver.choose_solver", lambda *_, **__: solver_name)
    found = aligned(seen, imu)
    assert whole.pose_covariance is not None
    assert found.pose_covariance is None
    assert found.sigma_relative == pytest.approx(whole.sigma_relative, rel=1e-5)
    assert found.gravity_sigma_rad == pytest.approx(whole.gravity_sigma_rad, rel=1e-5)
    assert found.clock_sigma_s == pytest.approx(whole.clock_sigma_s, rel=1e-5)
    np.testing.assert_allclose(found.gyro_bias_sigma, whole.gyro_bias_sigma, rtol=1e-5)
    np.testing.assert_allclose(found.accel_bias_sigma, whole.accel_bias_sigma, rtol=1e-5)
    for name in ("mounting_turn_sigma_deg", "mounting_shift_sigma_m"):
        np.testing.assert_allclose(found.evidence[name], whole.evidence[name], rtol=1e-5)


@pytest.mark.parametrize(("num", "reach", "first"), [(300, 300, 0), (1200, 1200, 201), (3000, 150, 0)])
def test_a_thousand_keyframes_of_one_room_are_adjusted_together(
    monkeypatch: pytest.MonkeyPatch, num: int, reach: int, first: int
) -> None:
    apart = np.abs(np.subtract.outer(np.arange(num), np.arange(num)))
    monkeypatch.setattr(inertial_adjustment, "count_shared", lambda _: (apart < reach).astype(np.int64))
    keyframes = SimpleNamespace(keyframes=range(num))
    assert inertial_adjustment._first_of_part(keyframes) == first  # type: ignore[arg-type]


def test_same_input_same_bytes() -> None:
    flight, times = Flight(8), np.arange(0, 5, 0.25)
    seen, imu = seen_map(flight, times, 8, 0.5, num_points=200), flight.imu(8, 5.0)
    first, second = (aligned(seen, imu) for _ in range(2))
    assert first.model.cam_from_world.tobytes() == second.model.cam_from_world.tobytes()
    assert first.pose_covariance.tobytes() == second.pose_covariance.tobytes()
    assert first.world_from_map.tobytes() == second.world_from_map.tobytes()
    assert first.scale_estimate == second.scale_estimate


# ---- the gyroscope alone


def test_the_gyroscope_predicts_the_camera_s_rotation() -> None:
    flight = Flight(9, turning=3.0)
    imu = flight.imu(9, 5.0)
    for start, stop in ((1.0, 1.05), (2.0037, 2.6), (0.0, 4.9)):
        ends = rigid3.rotation_matrix(flight.cam_from_world(np.array([start, stop])))
        found = imu_rotation(imu, start, stop, GYRO_BIAS)
        assert found is not None
        error = rigid3.rotation_angle_deg(found @ (ends[1] @ ends[0].T).T)
        # 1.7e-4 rad/s/sqrt(Hz) over the time, four sigma of three axes, and what 200 Hz leave
        assert error < np.degrees(4 * 1.7e-4 * np.sqrt(3 * (stop - start))) + 0.02
    assert imu_rotation(imu, 4.0, 5.5) is None
    assert imu_rotation(imu, -1.0, 0.5) is None
    assert imu_rotation(imu, 2.0, 2.0) is None


def test_a_gyroscope_is_believed_while_it_foretells_better_than_a_steady_motion() -> None:
    flight, times = Flight(10, turning=3.0), np.arange(0.1, 4.0, 0.05)
    imu = flight.imu(10, 5.0)
    turns = rigid3.rotation_matrix(flight.cam_from_world(times))
    steps = turns[1:] @ turns[:-1].swapaxes(1, 2)
    wrong = {
        "right": imu,
        "negated": replace(imu, gyro=-imu.gyro),
        "permuted": replace(imu, gyro=imu.gyro[:, [1, 2, 0]]),
        "degrees": replace(imu, gyro=np.degrees(imu.gyro)),
        "late": replace(imu, timestamps_s=imu.timestamps_s + 0.15),
    }
    for name, sensor in wrong.items():
        trust, believed = GyroTrust(), []
        for k in range(1, len(steps)):
            foretold = imu_rotation(sensor, times[k], times[k + 1])
            if foretold is None:
                continue
            believed.append(trust.is_better)
            trust.learn(foretold, steps[k - 1], steps[k])
        assert len(believed) > 60
        assert not any(believed[:5])  # nothing is known yet
        assert np.mean(believed[10:]) == (1.0 if name == "right" else 0.0), name
