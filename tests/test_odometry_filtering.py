"""The filter that predicts with a sensor, or without, on flights known exactly: consistent, and honest in gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.signal import lfilter
from scipy.stats import chi2

from inertial_flights import ACCEL_BIAS, GRAVITY, GYRO_BIAS, IMU_FROM_CAM, Flight
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.imu_stream import KEPT_S, ImuStream
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial import filtered_rows, filtering
from sfmapp.odometry.inertial.filter_state import INDEPENDENT, InertialSensor, Shared
from sfmapp.odometry.inertial.filtering import (
    FilteredPose,
    FilteredTrajectory,
    InertialFilter,
    autocovariance,
    consistency,
    correlation_time,
    filter_trajectory,
)
from sfmapp.odometry.inertial.integration import ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA
from sfmapp.odometry.inertial.live_start import SHORTEST_S
from sfmapp.odometry.inertial.scale import scale_covariance
from sfmapp.odometry.inertial.smoothing import read_measured, unknown_rates
from sfmapp.odometry.report import FilterReport
from sfmapp.odometry.residual_memory import Correlation, ResidualMemory
from sfmapp.odometry.result import FrameState
from sfmapp.odometry.snapshot import FrameSnapshot
from sfmapp.pipelines.odometry.filtering import COLUMNS, LiveFilter, SharedErrors, write_filtered_csv
from sfmapp.report.model import FramesReport
from sfmapp.report.odometry_document import FrameTable, make_checks
from test_odometry_smoothing import perturbed, tangent

RATE_HZ, FPS, DURATION_S = 100.0, 20.0, 12.0
DOWN = np.array([0.0, 0.0, -GRAVITY])
SIGMA = np.r_[np.full(3, np.radians(0.1)), np.full(3, 0.01)]
TILT_SIGMA = np.radians(0.5)
LATE_S = 0.03


class Case:
    """Frames of a flight with noisy poses, and what a sensor measured beside them."""

    def __init__(self, seed: int, flight: Flight | None = None) -> None:
        rng = np.random.default_rng([seed, 31])
        self.flight = flight or Flight(seed)
        self.times = np.arange(int(DURATION_S * FPS)) / FPS + 0.0021  # between the samples
        self.truth = self.flight.cam_from_world(self.times)
        root = np.exp(0.3 * rng.normal(size=(len(self.times), 1, 1))) * np.diag(SIGMA)
        root = root @ (np.eye(6) + 0.2 * rng.normal(size=(len(self.times), 6, 6)))
        self.covariance = root @ root.swapaxes(1, 2)
        self.poses = perturbed(self.truth, np.einsum("nij,nj->ni", root, rng.normal(size=(len(self.times), 6))))
        imu = self.flight.imu(seed, DURATION_S, rate_hz=RATE_HZ)
        # what is known of gravity and biases is as uncertain as the filter is told
        gravity = rigid3.exp_so3(TILT_SIGMA * np.r_[rng.normal(size=2), 0.0]) @ DOWN
        gyro_bias = GYRO_BIAS + GYRO_BIAS_SIGMA * rng.normal(size=3)
        accel_bias = ACCEL_BIAS + ACCEL_BIAS_SIGMA * rng.normal(size=3)
        self.sensor = InertialSensor(imu, gravity, TILT_SIGMA, gyro_bias, accel_bias)

    def filtered(self, sensor: InertialSensor | None) -> FilteredTrajectory:
        return filter_trajectory(self.times, self.poses, self.covariance, sensor)

    def nees(self, found: FilteredTrajectory, rows: np.ndarray) -> np.ndarray:
        """Of the poses in some rows, 6 in the mean."""
        error = tangent(found.cam_from_world[rows], self.flight.cam_from_world(found.timestamps_s[rows]))
        return (error * np.linalg.solve(found.covariance[rows], error[..., None])[..., 0]).sum(1)


CASES = [Case(seed) for seed in range(8)]


def test_with_a_sensor_innovations_and_errors_are_as_stated() -> None:
    found = [case.filtered(case.sensor) for case in CASES]
    # of the first velocity less is said than is known
    told = consistency(np.concatenate([f.nis[3:] for f in found]), np.concatenate([f.innovation[3:] for f in found]))
    assert told is not None
    assert told.num_innovations == len(CASES) * (len(CASES[0].times) - 3)
    # independent from frame to frame: within the 95 % band, two-sided
    assert told.mean_low < told.mean < told.mean_high
    assert told.correlation is not None
    assert abs(told.correlation) < told.max_correlation
    assert told.num_independent > 0.8 * told.num_innovations
    assert told.share_inside == pytest.approx(0.95, abs=1.96 * np.sqrt(0.95 * 0.05 / told.num_innovations))
    # errors of neighbours are alike: poses two seconds apart count as draws
    errors = []
    for case, f in zip(CASES, found, strict=True):
        assert not f.is_rejected.any()
        rows = np.searchsorted(f.timestamps_s, np.arange(1.0, DURATION_S - 0.5, 2.0))
        errors.append(case.nees(f, rows))
    total = np.concatenate(errors)
    low, high = chi2.ppf([0.025, 0.975], 6 * len(total)) / (6 * len(total))
    assert low < total.mean() / 6 < high


def test_a_clock_that_is_off_is_found_out() -> None:
    """By milliseconds that nobody knows of, a draw of what is expected, innovations and errors are as stated; where the
    clocks are taken for one they are not."""
    sigma_s, offsets, nis, naive, errors = 0.004, [], [], [], []
    for seed, case in enumerate(CASES):
        offset_s = sigma_s * np.random.default_rng([seed, 12]).normal()
        late = replace(case.sensor.imu, timestamps_s=case.sensor.imu.timestamps_s + offset_s)
        found = case.filtered(replace(case.sensor, imu=late, clock_sigma_s=sigma_s))
        later_s, stated_s = found.clock_s
        assert stated_s < 0.1 * sigma_s
        offsets.append((later_s - offset_s) / stated_s)
        nis.append(found.nis[3:])
        naive.append(case.filtered(replace(case.sensor, imu=late)).nis[3:])
        errors.append(case.nees(found, found.frame_row[40::40]))
    told, total = consistency(np.concatenate(nis)), np.concatenate(errors)
    assert told is not None
    assert told.mean_low < told.mean < told.mean_high
    low, high = chi2.ppf([0.025, 0.975], 6 * len(total)) / (6 * len(total))
    assert low < total.mean() / 6 < high
    low, high = chi2.ppf([0.025, 0.975], len(offsets)) / len(offsets)
    assert low < np.mean(np.square(offsets)) < high
    assert np.nanmean(np.concatenate(naive)) / 6 > 1.2


def test_poses_come_at_the_rate_of_the_sensor_and_are_better_than_measured() -> None:
    gains, raw_errors = [], []
    for case in CASES[:4]:
        f = case.filtered(case.sensor)
        assert (np.diff(f.timestamps_s) > 0).all()
        assert np.array_equal(f.timestamps_s[f.frame_row], case.times)
        assert len(f.timestamps_s) == pytest.approx((RATE_HZ + FPS) * DURATION_S, rel=0.02)
        later = f.frame_row[40:]
        errors = tangent(f.cam_from_world, case.flight.cam_from_world(f.timestamps_s))
        raw = np.sqrt((tangent(case.poses, case.truth)[40:] ** 2).mean(0))
        gains.append(np.sqrt((errors[later] ** 2).mean(0)) / raw)
        raw_errors.append(np.sqrt((errors[later[0] :] ** 2).mean(0)) / raw)  # between frames no worse than at them
        bias = (case.sensor.imu.gyro - case.flight.gyro(case.sensor.imu.timestamps_s)).mean(0)
        assert np.abs(f.gyro_bias - bias).max() < 0.005
    assert np.mean(gains) < 0.6
    assert np.mean(raw_errors) < 0.65


@pytest.mark.parametrize("gap_s", [0.5, 1.0, 2.0, 3.0])
def test_gaps_are_bridged_within_three_sigma(gap_s: float) -> None:
    """With the sensor: the error at the end of a gap, in its own covariance, is a draw of chi-squared."""
    ends, ratios = [], []
    for case in CASES:
        first = 100
        gap = slice(first, first + round(gap_s * FPS))
        poses = case.poses.copy()
        poses[gap] = np.nan
        f = filter_trajectory(case.times, poses, case.covariance, case.sensor)
        row, before = int(f.frame_row[gap.stop - 1]), int(f.frame_row[first - 1])
        assert f.is_bridged[before + 1 : row + 1].sum() >= row - before - RATE_HZ / FPS - 1
        assert not f.is_bridged[f.frame_row[gap.stop]]
        assert f.since_pose_s[row] == pytest.approx(gap_s)
        assert (np.diff(f.position_sigma[before : row + 1]) > 0).all()
        inside = np.arange(before, row + 1)
        error = tangent(f.cam_from_world[inside], case.flight.cam_from_world(f.timestamps_s[inside]))
        ratios.append(np.abs(error) / np.sqrt(np.diagonal(f.covariance[inside], axis1=1, axis2=2)))
        ends.append(case.nees(f, np.array([row]))[0])
        assert f.nis[gap.stop] < 38.3
    assert np.mean(np.concatenate(ratios) < 3.0) > 0.99
    low, high = chi2.ppf([0.005, 0.995], 6 * len(ends)) / (6 * len(ends))
    assert low < np.mean(ends) / 6 < high


def test_wrong_poses_are_left_out_and_jumps_are_the_maps() -> None:
    case, wrong = CASES[1], np.array([40, 41, 90, 150, 200])
    rng = np.random.default_rng(8)
    poses = case.poses.copy()
    poses[wrong] = perturbed(poses[wrong], rng.choice([-1, 1], (5, 6)) * [0.03, 0.03, 0.03, 0.2, 0.2, 0.2])
    f = filter_trajectory(case.times, poses, case.covariance, case.sensor)
    assert f.is_rejected.nonzero()[0].tolist() == wrong.tolist()
    assert f.is_bridged[f.frame_row[wrong]].all()
    clean = case.filtered(case.sensor)
    shift = rigid3.center(f.cam_from_world) - rigid3.center(clean.cam_from_world)
    assert np.linalg.norm(shift, axis=1).max() < 0.03
    jumped = case.poses.copy()
    moved = rigid3.IDENTITY + np.array([0.0, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0])
    jumped[150:] = rigid3.compose(jumped[150:], moved)
    f = filter_trajectory(case.times, jumped, case.covariance, case.sensor)
    assert f.is_rejected.nonzero()[0].tolist() == [150, 151, 152]
    # no camera goes 10 m between two frames without its sensor feeling it: from there poses are believed, and the
    # camera stays where it is in the world
    rows = f.frame_row[150:]
    error = tangent(f.cam_from_world[rows], case.truth[150:])
    sigma = np.sqrt(np.diagonal(f.covariance[rows], axis1=1, axis2=2))
    assert np.abs(error[:, 3:]).max() < 0.03
    assert (np.abs(error) < 4.0 * sigma).all()
    low, high = chi2.ppf([0.001, 0.999], 6 * len(f.nis[160:]))
    assert low < f.nis[160:].sum() < high


def test_silence_of_the_sensor_and_long_gaps_begin_anew() -> None:
    case = CASES[2]
    imu = case.sensor.imu
    keep = (imu.timestamps_s < 4.0) | (imu.timestamps_s > 5.0)
    silent = replace(imu, timestamps_s=imu.timestamps_s[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])
    f = case.filtered(replace(case.sensor, imu=silent))
    assert (f.frame_row >= 0).all()
    inside = (f.timestamps_s > 4.1) & (f.timestamps_s < 4.9)
    assert np.array_equal(f.timestamps_s[inside], case.times[(case.times > 4.1) & (case.times < 4.9)])
    rows = f.frame_row[(case.times > 6.0)]
    assert np.mean(case.nees(f, rows)) / 6 == pytest.approx(1.0, abs=0.6)
    poses = case.poses.copy()
    poses[:3] = np.nan
    poses[60:170] = np.nan  # 5.5 s
    f = filter_trajectory(case.times, poses, case.covariance, case.sensor)
    assert (f.frame_row < 0).nonzero()[0].tolist() == [0, 1, 2, *range(160, 170)]  # bridged until it is too long
    nothing = filter_trajectory(case.times, np.full_like(poses, np.nan), case.covariance, case.sensor)
    assert len(nothing.timestamps_s) == 0
    assert consistency(nothing.nis) is None
    with pytest.raises(ValueError, match="ascend"):
        filter_trajectory(np.zeros(len(poses)), poses, case.covariance, case.sensor)


def test_a_sensor_that_was_taken_for_another_is_found_out() -> None:
    """Poses that turn for three seconds while the camera does not look like a bias of the gyroscope, of which the
    filter is sure by then."""
    for case in CASES[1:3]:
        turn = np.outer(np.minimum(case.times, 3.0), [0.0, 0.0, 0.03])
        wrong = rigid3.compose(case.poses, rigid3.from_matrix(rigid3.exp_so3(turn), np.zeros((len(turn), 3))))
        f = filter_trajectory(case.times, wrong, case.covariance, case.sensor)
        assert f.is_rejected.sum() > 5
        assert not f.is_rejected[140:].any()
        told = consistency(f.nis[140:])
        assert told is not None
        assert told.mean_low < told.mean < told.mean_high
        bias = (case.sensor.imu.gyro - case.flight.gyro(case.sensor.imu.timestamps_s)).mean(0)
        assert np.abs(f.gyro_bias - bias).max() < 0.003


def test_hours_of_rows_are_in_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES[0]
    kept = case.filtered(case.sensor)
    monkeypatch.setattr(filtered_rows, "_WAITING", 1000)
    found = case.filtered(case.sensor)
    assert isinstance(found.covariance.base, np.memmap)
    for name in ("timestamps_s", "cam_from_world", "covariance", "since_pose_s", "is_bridged", "frame_row", "nis"):
        np.testing.assert_array_equal(getattr(found, name), getattr(kept, name))
    monkeypatch.setattr(filtering, "_AT_ONCE", 100)
    np.testing.assert_allclose(found.position_sigma, kept.position_sigma, rtol=1e-12)


def test_a_stream_keeps_the_last_minute() -> None:
    imu = CASES[0].sensor.imu
    stream = ImuStream(replace(imu, timestamps_s=np.zeros(0), gyro=np.zeros((0, 3)), accel=np.zeros((0, 3))))
    for k in range(2000):
        stream.push(0.1 * k, np.zeros(3), np.full(3, k))
    kept = stream.recorded()
    assert kept.timestamps_s[0] == pytest.approx(199.9 - KEPT_S)
    assert len(kept.timestamps_s) == 10 * KEPT_S + 1
    assert [sample[4] for sample in stream.after(199.65)] == [1997.0, 1998.0, 1999.0]
    assert stream.after(199.9) == []


def test_how_long_a_series_lasts() -> None:
    """Steps of an autoregression that keeps 0.6 of its last value are worth a quarter of independent ones."""
    rng = np.random.default_rng(2)
    values = lfilter([1.0], [1.0, -0.6], rng.normal(size=20_000))
    assert correlation_time(autocovariance(values)) == pytest.approx(1.6 / 0.4, rel=0.1)
    assert correlation_time(autocovariance(rng.normal(size=20_000))) == pytest.approx(1.0, abs=0.1)
    assert correlation_time(autocovariance(np.ones(5))) == 1.0
    np.testing.assert_allclose(autocovariance(np.array([1.0, 2.0, 3.0, 6.0]))[:2], [3.5, 0.5])


def noisier_sensor(case: Case) -> Imu:
    """Thirty times as noisy as it says."""
    noisy, said = case.flight.imu(3, DURATION_S, noise=30.0, rate_hz=RATE_HZ), case.sensor.imu
    return replace(
        noisy, gyro_noise=said.gyro_noise, accel_noise=said.accel_noise, gyro_walk=said.gyro_walk,
        accel_walk=said.accel_walk,
    )  # fmt: skip


def test_a_sensor_noisier_than_stated_shows_in_the_innovations_and_widens_sigmas() -> None:
    case = CASES[3]
    found, good = case.filtered(replace(case.sensor, imu=noisier_sensor(case))), case.filtered(case.sensor)
    told = consistency(found.nis)
    assert told is not None
    assert told.mean > told.mean_high
    # by what innovations of the last two seconds are beyond what they should be, and no sooner than that is certain
    assert (found.widening[: found.frame_row[19]] == 1.0).all()
    wide = found.widening > 1.0
    assert wide.mean() > 0.5
    assert np.median(found.widening[wide]) == pytest.approx(told.mean, rel=0.5)
    assert (good.widening == 1.0).mean() > 0.95


# ---- without a sensor


@pytest.mark.parametrize("gap_s", [0.5, 1.0, 2.0, 3.0])
def test_without_a_sensor_gaps_of_lasting_accelerations_are_honest(gap_s: float) -> None:
    """Motion of sines is far from constant velocity, and its acceleration lasts for many frames: what is white over a
    frame would promise too much over a gap. Nor may the sigma be beyond all use."""
    ratios = []
    for case in CASES:
        for first in (60, 110, 160):
            gap = slice(first, first + round(gap_s * FPS))
            poses = case.poses.copy()
            poses[gap] = np.nan
            f = filter_trajectory(case.times, poses, case.covariance)
            assert f.is_bridged.nonzero()[0].tolist() == list(range(gap.start, gap.stop))
            assert f.since_pose_s[gap.stop - 1] == pytest.approx(gap_s)
            last = np.array([gap.stop - 1])
            error = tangent(f.cam_from_world[last], case.flight.cam_from_world(f.timestamps_s[last]))[0]
            ratios.append(error / np.sqrt(np.diagonal(f.covariance[last[0]])))
    ratio = np.array(ratios)
    assert np.mean(np.abs(ratio) < 3.0) > 0.99
    assert 0.2 < np.sqrt((ratio**2).mean()) < 1.3


def test_without_a_sensor_innovations_are_near_what_is_stated() -> None:
    told = consistency(np.concatenate([case.filtered(None).nis[5:] for case in CASES]))
    assert told is not None
    # accelerations that last are not white, and the filter says no more of them than their level
    assert told.mean == pytest.approx(1.0, abs=0.25)
    assert told.share_inside > 0.88


def test_the_mounting_counts() -> None:
    """A camera away from the sensor on a turning head is another place."""
    case = CASES[4]
    wrong = rigid3.from_matrix(rigid3.rotation_matrix(IMU_FROM_CAM), IMU_FROM_CAM[4:] + np.array([0.3, 0, 0]))
    sensor = replace(case.sensor, imu=replace(case.sensor.imu, imu_from_cam=wrong))
    told = consistency(case.filtered(sensor).nis)
    assert told is not None
    assert told.mean > told.mean_high


# ---- errors that neighbouring frames share


def drifting(
    case: Case, seed: int, shared: Shared, adjusted: Sequence[int] = ()
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Poses whose errors are partly new in each frame, and partly walk on with the map: a place that was seen with an
    error stays where it was put. What walks has a rate that lasts for 2 / walk frames, and goes by half of what a pose
    is less sure than the one before it as well.

    Before the frames that are named an adjustment takes all of it back: a place x of the map was at moved[frame](x).
    """
    rng = np.random.default_rng([seed, 77])
    measured, kept = read_measured(case.times, case.truth, case.covariance), 1.0 - 0.5 * shared.walk
    poses, turn, shift, rate, last = [], np.eye(3), np.zeros(3), np.zeros(6), np.zeros((6, 6))
    moved = {}
    for k, (center, rotation, noise) in enumerate(
        zip(measured.position, measured.rotation, measured.noise, strict=True)
    ):
        to_map = np.eye(6)
        to_map[3:, 3:] = turn @ rotation
        now = to_map @ noise @ to_map.T
        new_rate, walk = (np.linalg.cholesky(now) @ rng.normal(size=6) for _ in range(2))
        if k:
            size, axes = eigh(now - last, now)
            grown = now @ axes @ (np.sqrt(np.maximum(size, 0.0)) * rng.normal(size=6))
            step = rate + np.sqrt(shared.walk) * walk + np.sqrt(0.5 * (1.0 - shared.white)) * grown
            seen = turn @ center
            turned = rigid3.exp_so3(step[3:])
            turn, shift = turned @ turn, shift + seen + step[:3] - turned @ seen
            rate = kept * rate + np.sqrt(1.0 - kept**2) * shared.walk * new_rate
        else:
            rate = shared.walk * new_rate
        last = now
        if k in adjusted:
            moved[k], turn, shift = similarity.from_parts(turn, shift, 1.0), np.eye(3), np.zeros(3)
        poses.append(rigid3.inverse(rigid3.from_matrix(turn @ rotation, turn @ center + shift)))
    white = np.sqrt(shared.white) * np.linalg.cholesky(case.covariance)
    return perturbed(np.array(poses), np.einsum("nij,nj->ni", white, rng.normal(size=(len(poses), 6)))), moved


def with_shared(
    case: Case, poses: np.ndarray, shared: Shared, moved: dict[int, np.ndarray] | None = None
) -> tuple[FilteredTrajectory, np.ndarray]:
    """The filter told how errors are shared, and errors beyond those at its first row, 6 in the mean each."""
    moved = moved or {}
    measured = read_measured(case.times, poses, case.covariance)
    found, imu, n = InertialFilter(case.sensor, 10.0), case.sensor.imu, 0
    for f, frame_s in enumerate(case.times):
        while imu.timestamps_s[n] <= frame_s:
            found.add_sample(float(imu.timestamps_s[n]), imu.gyro[n], imu.accel[n])
            n += 1
        found.add_frame(float(frame_s), measured.pose(f), shared, moved.get(f, similarity.IDENTITY))
    result = found.result()
    return result, case.nees(result, result.frame_row[40::40])


def test_errors_that_walk_with_the_map_are_told_from_noise() -> None:
    shared = Shared(0.1, 0.2)
    told, nees, naive = [], [], []
    for seed, case in enumerate(CASES):
        poses, _ = drifting(case, seed, shared)
        found, errors = with_shared(case, poses, shared)
        told.append(found.nis[3:])
        nees.append(errors)
        naive.append(with_shared(case, poses, INDEPENDENT)[1])
    right, total = consistency(np.concatenate(told)), np.concatenate(nees)
    assert right is not None
    assert right.mean_low < right.mean < right.mean_high
    low, high = chi2.ppf([0.025, 0.975], 6 * len(total)) / (6 * len(total))
    assert low < total.mean() / 6 < high
    # taken for noise that is new in every frame, they promise far too much
    assert np.mean(naive) / 6 > 5.0


def test_what_adjustments_take_back_of_the_drift_is_taken_back_in_the_world() -> None:
    """Where the map is put right every half second the camera is where the map says; what is stated of it allows for
    adjustments that leave most of the drift. Poses that nothing is taken back of go astray."""
    shared, adjusted = Shared(0.1, 0.2), range(10, 240, 10)
    right, astray, errors = [], [], []
    for seed, case in enumerate(CASES):
        for frames, away in (((), astray), (adjusted, right)):
            poses, moved = drifting(case, seed, shared, frames)
            found, nees = with_shared(case, poses, shared, moved)
            rows = found.frame_row[120:]
            away.append((tangent(found.cam_from_world[rows], case.truth[120:]) ** 2).mean(0))
        errors.append(nees)
    assert (np.sqrt(np.mean(right, 0) / np.mean(astray, 0)) < 0.7).all()
    assert 0.2 < np.mean(np.concatenate(errors)) / 6 < 1.0


def test_what_adjustments_take_back_in_a_gap_is_not_taken_for_drift_of_before() -> None:
    """A map that goes on without the filter drifts, and is put right, as if there were no gap; at its end the camera is
    where the sensor alone says."""
    shared, adjusted, gap = Shared(0.1, 0.2), range(10, 240, 10), range(100, 160)
    for seed, case in enumerate(CASES[:4]):
        poses, moved = drifting(case, seed, shared, adjusted)
        poses[gap] = np.nan
        found, _ = with_shared(case, poses, shared, moved)
        alone, _ = with_shared(case, poses, shared, {frame: moved[frame] for frame in adjusted if frame not in gap})
        rows = found.frame_row[gap]
        apart = tangent(found.cam_from_world[rows], alone.cam_from_world[rows])
        np.testing.assert_allclose(apart, 0.0, atol=1e-9)
        np.testing.assert_allclose(found.covariance[rows], alone.covariance[rows], rtol=1e-6)


def test_a_map_that_is_adjusted_is_no_motion() -> None:
    """Nor is a loop that closes, which gives the map another unit as well."""
    case = CASES[1]
    still = case.filtered(case.sensor)
    moved = similarity.from_parts(rigid3.exp_so3(np.array([0.02, -0.05, 0.03])), np.array([0.3, -0.1, 0.2]), 0.95)
    poses, covariance = case.poses.copy(), case.covariance.copy()
    poses[120:] = similarity.transform_poses(similarity.inverse(moved), poses[120:])
    covariance[120:] = scale_covariance(covariance[120:], 1.0 / 0.95)
    measured, imu, n = read_measured(case.times, poses, covariance), case.sensor.imu, 0
    found = InertialFilter(case.sensor, unknown_rates(read_measured(case.times, case.poses, case.covariance))[0])
    for f, frame_s in enumerate(case.times):
        while imu.timestamps_s[n] <= frame_s:
            found.add_sample(float(imu.timestamps_s[n]), imu.gyro[n], imu.accel[n])
            n += 1
        found.add_frame(float(frame_s), measured.pose(f), INDEPENDENT, moved if f == 120 else similarity.IDENTITY)
    np.testing.assert_allclose(found.result().nis, still.nis, rtol=1e-5)
    np.testing.assert_allclose(found.result().cam_from_world, still.cam_from_world, atol=1e-7)
    np.testing.assert_allclose(found.result().covariance, still.covariance, rtol=1e-4, atol=1e-10)


def test_the_unit_of_length_is_learnt_no_sooner_than_the_sensor_tells_it() -> None:
    """Of one camera, whose map has another unit than was said: the first poses tell the velocity in that unit, and must
    not be taken to tell the unit by that."""
    total = []
    for seed, case in enumerate(CASES):
        zoom = float(np.exp(0.05 * np.random.default_rng([seed, 5]).normal()))
        poses = case.poses.copy()
        poses[:, 4:] *= zoom
        found = filter_trajectory(
            case.times, poses, scale_covariance(case.covariance, zoom), replace(case.sensor, scale_sigma=0.05)
        )
        # the world has the first pose where the map has it
        first = rigid3.center(case.truth[:1])
        shift = np.r_[np.zeros(3), 1.0, ((zoom - 1.0) * first)[0]]
        truth = rigid3.compose(case.truth, rigid3.inverse(shift))
        rows = found.frame_row[[4, 9, 19, 60, 100, 140, 180, 220]]
        frames = np.searchsorted(case.times, found.timestamps_s[rows])
        error = tangent(found.cam_from_world[rows], truth[frames])
        total.append((error * np.linalg.solve(found.covariance[rows], error[..., None])[..., 0]).sum(1))
    # soon after the beginning, and later on
    for nees in (np.array(total)[:, :3], np.array(total)[:, 3:]):
        # the first three err together
        num = 6 * (len(total) if nees.shape[1] == 3 else nees.size)
        low, high = chi2.ppf([0.025, 0.975], num) / num
        assert low < nees.mean() / 6 < high


def test_what_residuals_have_in_common() -> None:
    rng = np.random.default_rng(5)
    walk, memory, shares = rng.normal(size=(400, 2)), ResidualMemory(), SharedErrors()
    step, white = 0.2, 0.3
    for k in range(200):
        walk = np.sqrt(1 - step) * walk + np.sqrt(step) * rng.normal(size=walk.shape)
        residual = np.sqrt(1 - white) * walk + np.sqrt(white) * rng.normal(size=walk.shape)
        shared = shares.add(snapshot(0.1 * k, rigid3.IDENTITY, np.eye(6), memory.look(np.arange(400), residual)))
    # over one and two frames r = (1 - white) (1 - step)^(n / 2), by noise, walk and rate
    for n in (1, 2):
        way = shared.walk * n
        assert 1 - shared.white - 0.5 * (way + way**2) == pytest.approx((1 - white) * (1 - step) ** (0.5 * n), abs=0.05)
    assert shared.renewed == 0.0
    # of points that only one of two frames sees, nothing is in common
    half = ResidualMemory()
    half.look(np.arange(400), walk)
    assert half.look(np.arange(200, 600), np.roll(walk, -200, 0)).with_last == pytest.approx(0.5, abs=0.1)
    half.forget()
    assert np.isnan(half.look(np.arange(400), walk)).all()


# ---- as a run has it


def snapshot(
    time_s: float, pose: np.ndarray, covariance: np.ndarray, correlation: Correlation, map_idx: int = 0
) -> FrameSnapshot:
    return FrameSnapshot(
        round(time_s * FPS), f"{time_s:.2f}", time_s, FrameState.TRACKED, np.zeros((1, 1), np.uint8),
        np.zeros((0, 2), np.float32), np.zeros(0, bool), pose, covariance, correlation, similarity.IDENTITY,
        map_idx, 0.0,
    )  # fmt: skip


def lived(case: Case, imu: Imu | None, *, unit_m: float | None = None) -> tuple[FilteredTrajectory, FilterReport]:
    """The frames of a case as a run gives them out, in a unit of their own if one is given."""
    beside = LiveFilter(imu, is_metric=unit_m is None)
    covariance = case.covariance.copy()
    poses = case.poses.copy()
    if unit_m is not None:
        poses[:, 4:] /= unit_m
        covariance = scale_covariance(covariance, 1.0 / unit_m)
    for row in zip(case.times.tolist(), poses, covariance, strict=True):
        beside.add(snapshot(*row, Correlation(0.0, 0.0)))
    found = beside.finish(Events())
    assert found is not None
    return found


def test_samples_that_are_pushed_become_poses_at_once() -> None:
    """Frames are tracked 70 ms after they were taken, and samples that came meanwhile go on from each."""
    case, late_s, told = CASES[2], 0.07, list[tuple[float, FilteredPose]]()
    imu, newest_s = case.sensor.imu, [0.0]
    stream = ImuStream(replace(imu, timestamps_s=np.zeros(0), gyro=np.zeros((0, 3)), accel=np.zeros((0, 3))))
    beside = LiveFilter(stream, is_metric=True, on_pose=lambda pose: told.append((newest_s[0], pose)))
    frame = 0
    for row in zip(imu.timestamps_s, imu.gyro, imu.accel, strict=True):
        newest_s[0] = row[0]
        stream.push(*row)
        while frame < len(case.times) and case.times[frame] + late_s <= row[0]:
            beside.add(snapshot(
                case.times[frame], case.poses[frame], case.covariance[frame], Correlation(0.0, 0.0)
            ))  # fmt: skip
            frame += 1
    poses = [pose for _, pose in told]
    times = np.array([pose.timestamp_s for pose in poses])
    # one for each sample, in order, at once; but for those between the frame that told the start and its sample
    assert (np.diff(times) > 0).all()
    assert np.mean(np.diff(times)) == pytest.approx(1 / RATE_HZ, rel=1e-3)
    assert [pose.timestamp_s for now, pose in told if now > pose.timestamp_s + 1e-6][-1] < times[0] + 2 * late_s
    assert poses[-1].since_pose_s == pytest.approx(late_s, abs=0.06)
    later = times > times[0] + 1.0
    assert later.sum() > 500
    error = tangent(np.array([pose.cam_from_world for pose in poses])[later], case.flight.cam_from_world(times[later]))
    sigma = np.sqrt(np.diagonal(np.array([pose.covariance for pose in poses])[later], axis1=1, axis2=2))
    assert np.mean(np.abs(error) < 3.0 * sigma) > 0.99
    # the same in the end as of measurements that were recorded
    found, report = beside.finish(Events()) or (None, None)
    recorded, _ = lived(case, imu)
    assert report is not None
    assert report.prediction == "imu"
    assert found is not None
    shared = np.isin(recorded.timestamps_s, found.timestamps_s)
    np.testing.assert_allclose(
        rigid3.center(recorded.cam_from_world[shared])[-50:],
        rigid3.center(found.cam_from_world[np.isin(found.timestamps_s, recorded.timestamps_s)])[-50:], atol=5e-3,
    )  # fmt: skip


@pytest.mark.parametrize("unit_m", [None, 2.0])
def test_a_run_finds_gravity_scale_and_clock_by_itself(unit_m: float | None, tmp_path: Path) -> None:
    for case in CASES[:3]:
        late = replace(case.sensor.imu, timestamps_s=case.sensor.imu.timestamps_s + LATE_S)
        found, report = lived(case, late, unit_m=unit_m)
        assert (report.prediction, report.reason, report.rejected) == ("imu", None, [])
        assert found.timestamps_s[0] == pytest.approx(SHORTEST_S, abs=2.0)
        assert report.rate_hz == pytest.approx(RATE_HZ, rel=0.01)
        assert report.white_share == 1.0
        assert report.consistency is not None
        assert 0.8 < report.consistency.mean < report.consistency.mean_high + 0.1
        assert not report.contradictions
        ways = [np.linalg.norm(np.diff(rigid3.center(poses), axis=0), axis=1).sum() for poses in (
            found.cam_from_world[found.frame_row[-100:]], case.truth[-100:])]  # fmt: skip
        assert ways[0] == pytest.approx(ways[1], rel=0.02)
        write_filtered_csv(tmp_path / "filtered.csv", found)
        lines = (tmp_path / "filtered.csv").read_text().splitlines()
        assert lines[0] == ",".join(COLUMNS)
        assert len(lines) == len(found.timestamps_s) + 1


def test_what_a_run_begins_with_is_as_sure_as_it_says() -> None:
    """Poses of one camera, after the few seconds in which down, unit and biases were found out."""
    ends = []
    for case in CASES:
        found, _ = lived(case, case.sensor.imu, unit_m=2.0)
        rows = found.frame_row[[10, 40, 80]]
        at = np.searchsorted(case.times, found.timestamps_s[found.frame_row[0]] - 1e-9)
        # the world is that of the first row
        world = rigid3.compose(rigid3.inverse(case.truth[at]), found.cam_from_world[found.frame_row[0]])
        error = tangent(found.cam_from_world[rows], rigid3.compose(case.truth[at + np.array([10, 40, 80])], world))
        # which errs itself, by what no row knows
        covariance = found.covariance[rows] + found.covariance[found.frame_row[0]]
        ends.append((error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(1))
    total = np.array(ends)
    # the three err together, and are at most as far off as independent ones
    low, high = chi2.ppf([0.025, 0.975], 6 * len(total)) / (6 * len(total))
    assert low < total.mean() / 6 < high


def test_sigmas_that_had_to_be_widened_are_a_contradiction() -> None:
    case = CASES[3]
    _, report = lived(case, noisier_sensor(case))
    assert [row.subject for row in report.contradictions] == ["filtered live poses"]
    told = report.contradictions[0]
    assert "from where the IMU expects them" in told.message
    assert told.evidence["share_widened"] > 0.5
    # red in the report, in which its numbers are
    frames = FramesReport(
        num_frames=9, num_unreadable=0, num_with_pose=9, num_in_largest_map=9, waiting=0, tracked=9, relocalized=0,
        lost=0, repeated=0, gaps=[],
    )  # fmt: skip
    facts = FrameTable(np.full(1, np.nan), np.full(1, np.nan), np.full(1, np.nan), np.full(1, -1))
    lights = {row.name: row.light for row in make_checks(frames, [], None, facts, filtered=report)}
    assert lights["contradiction: filtered live poses"] == "red"


def test_a_sensor_that_tells_nothing_does_not_predict() -> None:
    case = Case(6)
    case.poses[100:120] = np.nan
    case.poses[150:151] = perturbed(case.poses[150:151], np.array([[0, 0, 0, 3.0, 0, 0]]))
    still = replace(case.sensor.imu, gyro=np.roll(case.sensor.imu.gyro, 1, 1))
    for imu, reason in ((still, "the gyroscope contradicts the rotations"), (None, None)):
        found, report = lived(case, imu)
        assert report.prediction == found.prediction == "constant velocity"
        assert (report.reason or "").startswith(reason or "")
        assert (report.reason is None) == (reason is None)
        assert [row.name for row in report.rejected] == [f"{case.times[150]:.2f}"]
        assert [(gap.first_s, gap.last_s) for gap in report.gaps] == [
            (pytest.approx(case.times[99]), pytest.approx(case.times[119])),
            (pytest.approx(case.times[149]), pytest.approx(case.times[150])),
        ]
        assert report.gaps[0].position_sigma > 3 * report.gaps[1].position_sigma
    assert LiveFilter(None, is_metric=True).finish(Events()) is None
