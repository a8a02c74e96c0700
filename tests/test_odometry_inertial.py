"""Maps and inertial measurements of an analytic motion: gtsam's conventions, scale, gravity, biases, their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.faults import align_or_explain
from sfmapp.odometry.inertial.gyroscope import GyroTrust, imu_rotation, imu_steps
from sfmapp.odometry.inertial.scale import ScaleRefusal
from sfmapp.odometry.inertial.visual_inertial import (
    GRAVITY,
    InertialAlignment,
    _integrate,
    _MapPose,
    _midway,
    _preintegration,
    align_imu,
)

IMU_FROM_CAM = rigid3.from_matrix(rigid3.exp_so3([1.2, -1.1, 1.3]), [0.05, -0.03, 0.08])
GYRO_BIAS, ACCEL_BIAS = np.array([-0.002, 0.02, 0.07]), np.array([-0.05, 0.12, 0.06])


class Flight:
    """A sensor on sums of sines, z up: positions with exact derivatives, rotations with differences."""

    def __init__(self, seed: int, acceleration: float = 1.5, turning: float = 0.6) -> None:
        rng = np.random.default_rng([seed, 21])
        self._rates = rng.uniform(0.5, 5.0, (4, 3))
        self._phases = rng.uniform(0, 6.28, (2, 4, 3))
        self._sizes = acceleration / self._rates**2 * rng.uniform(0.3, 1.0, (4, 3))
        self._angles = turning / self._rates * rng.uniform(0.3, 1.0, (4, 3))
        self._drift = np.array([0.4, -0.2, 0.1])

    def _sum(self, t: np.ndarray, sizes: np.ndarray, phases: np.ndarray, order: int) -> np.ndarray:
        wave = self._rates * t[:, None, None] + phases + 0.5 * np.pi * order
        return (sizes * self._rates**order * np.sin(wave)).sum(1)

    def position(self, t: np.ndarray) -> np.ndarray:
        return self._sum(t, self._sizes, self._phases[0], 0) + t[:, None] * self._drift

    def velocity(self, t: np.ndarray) -> np.ndarray:
        return self._sum(t, self._sizes, self._phases[0], 1) + self._drift

    def rotation(self, t: np.ndarray) -> np.ndarray:
        return rigid3.exp_so3(self._sum(t, self._angles, self._phases[1], 0))

    def gyro(self, t: np.ndarray) -> np.ndarray:
        h = 1e-5
        return rigid3.log_so3(self.rotation(t - h).swapaxes(1, 2) @ self.rotation(t + h)) / (2 * h)

    def accel(self, t: np.ndarray) -> np.ndarray:
        force = self._sum(t, self._sizes, self._phases[0], 2) + np.array([0.0, 0.0, GRAVITY])
        return np.einsum("nji,nj->ni", self.rotation(t), force)

    def cam_from_world(self, t: np.ndarray) -> np.ndarray:
        imu_from_world = rigid3.inverse(rigid3.from_matrix(self.rotation(t), self.position(t)))
        return rigid3.compose(rigid3.inverse(IMU_FROM_CAM), imu_from_world)

    def imu(self, seed: int, stop_s: float, noise: float = 1.0, rate_hz: float = 200.0) -> Imu:
        """Measurements with the noise of a small sensor times a factor, and walking biases."""
        rng = np.random.default_rng([seed, 22])
        t = np.arange(-0.02, stop_s + 0.02, 1 / rate_hz)
        densities = noise * np.array([1.7e-4, 2e-3, 1.9e-5, 3e-3])
        white = rng.normal(size=(2, len(t), 3)) * densities[:2, None, None] * np.sqrt(rate_hz)
        walk = np.cumsum(rng.normal(size=(2, len(t), 3)) * densities[2:, None, None] / np.sqrt(rate_hz), 1)
        has_bias = float(noise > 0)
        gyro = self.gyro(t) + white[0] + walk[0] + has_bias * GYRO_BIAS
        accel = self.accel(t) + white[1] + walk[1] + has_bias * ACCEL_BIAS
        return Imu(t, gyro, accel, IMU_FROM_CAM, *densities)


# the map's world: another origin, heading, tilt and unit
MAP_FROM_WORLD = similarity.from_parts(rigid3.exp_so3([0.9, -0.5, 2.0]), [3.0, -1.0, 0.5], 1 / 2.7)


def a_map(
    flight: Flight, times: np.ndarray, seed: int, sigma_deg: float, sigma_m: float, scale: float = 2.7
) -> np.ndarray:
    """Noisy cam_from_map: sigma_m is in metres."""
    rng = np.random.default_rng([seed, 23])
    map_from_world = np.r_[MAP_FROM_WORLD[:7], 1 / scale]
    poses = similarity.transform_poses(map_from_world, flight.cam_from_world(times))
    size = np.r_[np.full(3, np.radians(sigma_deg)), np.full(3, sigma_m / scale)]
    change = rng.normal(size=(len(times), 6)) * size
    return rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(change[:, :3]), change[:, 3:]), poses)


def true_gravity() -> np.ndarray:
    return rigid3.rotation_matrix(MAP_FROM_WORLD) @ [0.0, 0.0, -GRAVITY]


# ---- gtsam's conventions and our integration


def test_gtsam_and_our_integration_follow_the_true_motion() -> None:
    """Gravity's sign, the order of biases, and slopes by the biases."""
    import gtsam

    flight = Flight(1)
    imu = flight.imu(1, 3.0, noise=0.0, rate_hz=1000.0)
    steps = imu_steps(imu, 0.3137, 0.9)
    assert steps is not None
    assert steps[:, 0].sum() == pytest.approx(0.9 - 0.3137)
    ends = np.array([0.3137, 0.9])
    r, p, v = flight.rotation(ends), flight.position(ends), flight.velocity(ends)
    dt, down = ends[1] - ends[0], np.array([0.0, 0.0, -GRAVITY])
    delta = np.empty(60)
    _integrate(steps, np.zeros(3), delta)
    assert np.allclose(delta[:9].reshape(3, 3), r[0].T @ r[1], atol=1e-6)
    assert np.allclose(delta[9:12], r[0].T @ (v[1] - v[0] - down * dt), atol=2e-5)
    assert np.allclose(delta[12:15], r[0].T @ (p[1] - p[0] - v[0] * dt - 0.5 * down * dt**2), atol=1e-5)
    # gtsam on the manifold does the same sums
    same = gtsam.PreintegratedCombinedMeasurementsManifold(_preintegration(imu), gtsam.imuBias.ConstantBias())
    for step in _midway(steps, np.zeros(3)):
        same.integrateMeasurement(step[4:], step[1:4], step[0])
    assert np.allclose(same.deltaRij().matrix().ravel(), delta[:9], atol=1e-13)
    assert np.allclose(same.deltaVij(), delta[9:12], atol=1e-12)
    assert np.allclose(same.deltaPij(), delta[12:15], atol=1e-12)
    # a sensor with biases, told of them at the end: gtsam's accelerometer comes first
    gyro_bias, accel_bias = 1e-3 * GYRO_BIAS, 1e-2 * ACCEL_BIAS
    biased = steps + np.r_[0.0, gyro_bias, accel_bias]
    sums = gtsam.PreintegratedCombinedMeasurements(_preintegration(imu), gtsam.imuBias.ConstantBias())
    for step in _midway(biased, np.zeros(3)):
        sums.integrateMeasurement(step[4:], step[1:4], step[0])
    state = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(r[0]), p[0]), v[0])
    bias = gtsam.imuBias.ConstantBias(accel_bias, gyro_bias)
    assert np.allclose(bias.vector(), np.r_[accel_bias, gyro_bias])
    after = sums.predict(state, bias)  # gtsam's default sums in the tangent space, to the first order in a step
    assert np.allclose(after.pose().rotation().matrix(), r[1], atol=2e-5)
    assert np.allclose(after.pose().translation(), p[1], atol=2e-5)
    assert np.allclose(after.velocity(), v[1], atol=5e-5)
    _integrate(biased, np.zeros(3), delta)
    slopes = delta[15:].reshape(5, 3, 3)
    turn = delta[:9].reshape(3, 3) @ rigid3.exp_so3(slopes[0] @ gyro_bias)
    assert np.allclose(turn, r[0].T @ r[1], atol=2e-6)
    gained = delta[9:12] + slopes[1] @ gyro_bias + slopes[2] @ accel_bias
    assert np.allclose(gained, r[0].T @ (v[1] - v[0] - down * dt), atol=5e-5)
    moved = delta[12:15] + slopes[3] @ gyro_bias + slopes[4] @ accel_bias
    assert np.allclose(moved, r[0].T @ (p[1] - p[0] - v[0] * dt - 0.5 * down * dt**2), atol=2e-5)


def test_gtsam_s_covariance_is_that_of_drawn_noise() -> None:
    import gtsam

    flight = Flight(2)
    clean = flight.imu(2, 1.0, noise=0.0)
    noise = Imu(clean.timestamps_s, clean.gyro, clean.accel, IMU_FROM_CAM, 0.01, 0.1, 1e-8, 1e-8)
    steps = imu_steps(clean, 0.0, 0.5)
    assert steps is not None
    sums = gtsam.PreintegratedCombinedMeasurements(_preintegration(noise), gtsam.imuBias.ConstantBias())
    for step in _midway(steps, np.zeros(3)):
        sums.integrateMeasurement(step[4:], step[1:4], step[0])
    rng = np.random.default_rng(5)
    exact, drawn, delta = np.empty(60), np.empty((1500, 9)), np.empty(60)
    _integrate(steps, np.zeros(3), exact)
    for n in range(len(drawn)):
        sigma = np.repeat([0.01, 0.1], 3) / np.sqrt(steps[:, :1])
        _integrate(np.c_[steps[:, :1], steps[:, 1:] + sigma * rng.normal(size=(len(steps), 6))], np.zeros(3), delta)
        drawn[n, :3] = rigid3.log_so3(exact[:9].reshape(3, 3).T @ delta[:9].reshape(3, 3))
        drawn[n, 3:6], drawn[n, 6:] = delta[12:15] - exact[12:15], delta[9:12] - exact[9:12]
    ours = np.std(drawn, 0)
    theirs = np.sqrt(np.diag(sums.preintMeasCov()))[:9]
    assert np.allclose(ours, theirs, rtol=0.12)


def test_slopes_of_the_link_between_map_and_sensor() -> None:
    import gtsam

    rng = np.random.default_rng(3)
    turn = rigid3.exp_so3(rng.normal(size=3))
    imu = Flight(0).imu(0, 0.1)
    pose = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    rate, velocity = rng.normal(size=3), rng.normal(size=3)
    link, alignment = _MapPose(pose, imu, turn, rate), np.array([0.7, 0.0, 0.0, 0.0])
    map_from_cam = rigid3.inverse(pose)
    world_from_cam = rigid3.from_matrix(
        turn @ rigid3.rotation_matrix(map_from_cam), np.exp(0.7) * turn @ map_from_cam[4:]
    )
    exact = rigid3.compose(world_from_cam, rigid3.inverse(IMU_FROM_CAM))
    sensor = gtsam.Pose3(gtsam.Rot3(rigid3.rotation_matrix(exact)), exact[4:])
    assert np.allclose(link.residual(sensor, alignment, velocity), 0, atol=1e-12)
    # the picture was taken later: the sensor was not there yet
    back = rigid3.from_matrix(rigid3.rotation_matrix(exact) @ rigid3.exp_so3(-0.01 * rate), exact[4:] - 0.01 * velocity)
    early = gtsam.Pose3(gtsam.Rot3(rigid3.rotation_matrix(back)), back[4:])
    assert np.allclose(link.residual(early, np.r_[alignment[:3], 0.01], velocity), 0, atol=1e-12)
    sensor, alignment = sensor.retract(1e-2 * rng.normal(size=6)), np.array([0.72, 0.01, -0.02, 0.01])
    by_pose, by_alignment, by_velocity = link.slopes(sensor, alignment, velocity)
    for d, column in zip(1e-6 * np.eye(6), by_pose.T, strict=True):
        change = link.residual(sensor.retract(d), alignment, velocity)
        change -= link.residual(sensor.retract(-d), alignment, velocity)
        assert np.allclose(change / 2e-6, column, atol=2e-4)
    for d, column in zip(1e-6 * np.eye(4), by_alignment.T, strict=True):
        change = link.residual(sensor, alignment + d, velocity) - link.residual(sensor, alignment - d, velocity)
        assert np.allclose(change / 2e-6, column, atol=2e-3)
    for d, column in zip(1e-6 * np.eye(3), by_velocity.T, strict=True):
        change = link.residual(sensor, alignment, velocity + d) - link.residual(sensor, alignment, velocity - d)
        assert np.allclose(change / 2e-6, column, atol=1e-6)


# ---- the whole


def test_exact_measurements_give_the_exact_alignment() -> None:
    flight, times = Flight(3), np.arange(0, 10, 0.25)
    imu = flight.imu(3, 10.0, noise=1e-6, rate_hz=1000.0)
    found = align_imu(times, a_map(flight, times, 3, 0.0, 0.0), imu, is_metric=False)
    assert isinstance(found, InertialAlignment), found
    assert found.scale == pytest.approx(2.7, rel=1e-3)
    assert np.allclose(found.gravity_in_map, true_gravity(), atol=1e-2)
    assert np.allclose(found.gyro_bias, GYRO_BIAS, atol=1e-4)
    assert np.allclose(found.accel_bias, ACCEL_BIAS, atol=2e-3)
    up = rigid3.rotation_matrix(found.world_from_map) @ -true_gravity()
    assert np.allclose(up / GRAVITY, [0, 0, 1], atol=1e-3)
    turn = rigid3.rotation_matrix(found.world_from_map) @ rigid3.rotation_matrix(MAP_FROM_WORLD)
    assert np.allclose(found.velocity, flight.velocity(times[found.pose_idx]) @ turn.T, atol=5e-3)
    assert found.world_from_map[7] == found.scale


@pytest.mark.parametrize("has_covariance", [False, True])
def test_errors_are_as_large_as_their_sigmas(has_covariance: bool) -> None:
    """Poses of 0.2 degrees and 2 cm, a small sensor: errors of scale and gravity over their sigmas of rms about 1."""
    scores, residuals, sigmas = [], [], []
    times = np.arange(0, 20, 0.25)
    for seed in range(6 if has_covariance else 10):
        flight = Flight(seed)
        poses = a_map(flight, times, seed, 0.2, 0.02)
        size = np.r_[np.full(3, np.radians(0.2)), np.full(3, 0.02 / 2.7)]
        covariance = np.tile(np.diag(size**2), (len(times), 1, 1)) if has_covariance else None
        found = align_imu(times, poses, flight.imu(seed, 20.0), is_metric=False, covariance=covariance)
        assert isinstance(found, InertialAlignment), found
        tilt = np.linalg.norm(np.cross(found.gravity_in_map, true_gravity())) / GRAVITY**2
        scores.append([np.log(found.scale / 2.7) / found.sigma_relative, tilt / found.gravity_sigma_rad])
        residuals.append(found.residual)
        sigmas.append(found.sigma_relative)
        assert np.abs(found.gyro_bias - GYRO_BIAS).max() < 2e-3
        assert np.abs(found.accel_bias - ACCEL_BIAS).max() < 0.1
    rms = np.sqrt(np.mean(np.square(scores), 0))  # 1.1 and 1.05 over 40 draws
    assert 0.5 < rms[0] < 1.6  # 6 and 10 draws: 30 and 22 % at one sigma
    assert 0.5 < rms[1] < 1.6
    assert 0.85 < np.mean(residuals) < (1.15 if has_covariance else 1.5)
    assert 0.001 < np.median(sigmas) < 0.02


def test_a_metric_map_keeps_its_scale() -> None:
    times = np.arange(0, 12, 0.1)
    flight = Flight(4)
    found = align_imu(times, a_map(flight, times, 4, 0.1, 0.01, scale=1.0), flight.imu(4, 12.0), is_metric=True)
    assert isinstance(found, InertialAlignment), found
    assert found.scale == 1.0
    assert found.sigma_relative == 0.0
    assert np.linalg.norm(found.gravity_in_map - true_gravity()) < 5 * GRAVITY * found.gravity_sigma_rad
    assert found.gravity_sigma_rad < np.radians(0.5)
    assert np.diff(times[found.pose_idx]).min() >= 0.2 - 1e-9


def test_gaps_wrong_poses_and_a_slow_sensor_are_borne() -> None:
    flight, times = Flight(5), np.arange(0, 20, 0.25)
    poses = a_map(flight, times, 5, 0.1, 0.01)
    poses[[10, 11, 12, 30]] = np.nan
    poses[50, 4:] += 0.2
    imu = flight.imu(5, 20.0)
    hole = (imu.timestamps_s < 8.0) | (imu.timestamps_s > 8.7)
    holed = Imu(imu.timestamps_s[hole], imu.gyro[hole], imu.accel[hole], IMU_FROM_CAM, 1.7e-4, 2e-3, 1.9e-5, 3e-3)
    found = align_imu(times, poses, holed, is_metric=False)
    assert isinstance(found, InertialAlignment), found
    assert abs(np.log(found.scale / 2.7)) < 4 * found.sigma_relative
    assert found.evidence["num_intervals"] < 75
    # a pose that is exact by definition, one of which nothing is known
    covariance = np.tile(np.diag(np.r_[np.full(3, np.radians(0.1)), np.full(3, 0.01 / 2.7)] ** 2), (len(times), 1, 1))
    covariance[0], covariance[20] = 0.0, np.nan
    exact = a_map(flight, times, 5, 0.0, 0.0)
    poses[0], poses[50] = exact[0], exact[50]
    found = align_imu(times, poses, imu, is_metric=False, covariance=covariance)
    assert isinstance(found, InertialAlignment), found
    assert 20 not in found.pose_idx
    assert abs(np.log(found.scale / 2.7)) < 4 * found.sigma_relative


def test_weak_motion_has_a_large_but_honest_sigma() -> None:
    times = np.arange(0, 25, 0.25)
    weak = Flight(1, acceleration=0.1, turning=0.05)
    found = align_imu(times, a_map(weak, times, 1, 0.2, 0.02), weak.imu(1, 25.0), is_metric=False)
    assert isinstance(found, InertialAlignment), found
    assert 0.015 < found.sigma_relative < 0.1
    assert abs(np.log(found.scale / 2.7)) < 3 * found.sigma_relative


def test_motion_that_says_nothing_is_refused() -> None:
    times = np.arange(0, 15, 0.25)
    slow = Flight(6, acceleration=0.004, turning=0.002)
    refusal = align_imu(times, a_map(slow, times, 6, 0.1, 0.02), slow.imu(6, 15.0), is_metric=False)
    assert isinstance(refusal, ScaleRefusal), refusal
    assert "scale" in refusal.reason
    assert refusal.contradiction is None
    flight = Flight(7)
    poses, imu = a_map(flight, times, 7, 0.1, 0.02), flight.imu(7, 15.0)
    few = align_imu(times[:5], poses[:5], imu, is_metric=False)
    assert isinstance(few, ScaleRefusal)
    assert "intervals" in few.reason
    # clocks that have nothing to do with each other
    other = replace(imu, timestamps_s=imu.timestamps_s + 1e6)
    refusal = align_imu(times, poses, other, is_metric=False)
    assert isinstance(refusal, ScaleRefusal)
    assert "clocks" in refusal.reason


# ---- measurements that are not what they are taken for


@pytest.mark.parametrize("has_covariance", [False, True])
def test_clocks_apart_are_found_and_taken_into_account(has_covariance: bool) -> None:
    """The scale is what it would be without, and both errors are inside three of their sigmas."""
    times = np.arange(0, 15, 0.25)
    covariance = noise(times) if has_covariance else None
    for seed, late_s in ((11, 0.02), (12, -0.05), (13, 0.2), (14, -0.75)):
        flight = Flight(seed)
        poses, imu = a_map(flight, times, seed, 0.1, 0.01), flight.imu(seed, 15.0)
        late = replace(imu, timestamps_s=imu.timestamps_s + late_s)
        found = align_or_explain(times, poses, late, is_metric=False, covariance=covariance)
        assert isinstance(found, InertialAlignment), found
        assert abs(np.log(found.scale / 2.7)) < 3 * found.sigma_relative < 0.06
        assert abs(found.clock_offset_s - late_s) < 3.5 * found.clock_sigma_s < 0.01
        assert found.evidence["clock_offset_s"] == found.clock_offset_s


def noise(times: np.ndarray) -> np.ndarray:
    """Covariances of poses of 0.1 degrees and 1 cm."""
    return np.tile(np.diag(np.r_[np.full(3, np.radians(0.1)), np.full(3, 0.01 / 2.7)] ** 2), (len(times), 1, 1))


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
    flight, times = Flight(16), np.arange(0, 12, 0.25)
    poses, imu = a_map(flight, times, 16, 0.1, 0.01), flight.imu(16, 12.0)
    found = align_or_explain(times, poses, faulty(imu, flight, fault), is_metric=False, covariance=noise(times))
    assert isinstance(found, ScaleRefusal), found
    assert found.contradiction is not None
    rows = found.contradiction.evidence["explained_by"]
    assert [cause in row["fault"] for row in rows] == [True]
    assert cause in found.contradiction.message
    assert remedy in found.contradiction.advice
    assert rows[0]["residual"] < 5


def test_a_fault_that_nothing_explains_is_no_less_refused() -> None:
    flight, times = Flight(17), np.arange(0, 12, 0.25)
    poses, imu = a_map(flight, times, 17, 0.1, 0.01), flight.imu(17, 12.0)
    other = Flight(18).imu(18, 12.0)
    wrong = replace(imu, accel=other.accel)
    found = align_or_explain(times, poses, wrong, is_metric=False, covariance=noise(times))
    assert isinstance(found, ScaleRefusal), found
    assert found.contradiction is not None
    assert "explained_by" not in found.contradiction.evidence
    assert "check the sensor" in found.contradiction.advice


def test_same_input_same_bytes() -> None:
    flight, times = Flight(8), np.arange(0, 8, 0.25)
    poses, imu = a_map(flight, times, 8, 0.1, 0.01), flight.imu(8, 8.0)
    first, second = (align_imu(times, poses, imu, is_metric=False) for _ in range(2))
    assert isinstance(first, InertialAlignment)
    assert isinstance(second, InertialAlignment)
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
