"""The error-state filter on motion drawn from its own model: consistent, better than raw, and honest in gaps."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.smoothing import SmoothingOptions, smooth_trajectory

Q_POSITION, Q_ROTATION = 0.5, 0.3


def simulate(
    seed: int, num: int = 400, dt: float = 1 / 30, sigma_deg: float = 0.1, sigma: float = 0.01
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, true poses, measured poses, covariances (of different size and correlated) from the filter's model."""
    rng = np.random.default_rng([seed, 11])
    steps = 8
    p, v, w, rotation = np.zeros(3), rng.normal(size=3), 0.3 * rng.normal(size=3), np.eye(3)
    ground_truth, h = np.empty((num, 7)), dt / steps
    for f in range(num):
        ground_truth[f] = rigid3.inverse(rigid3.from_matrix(rotation, p))
        for _ in range(steps):
            p, rotation = p + v * h, rotation @ rigid3.exp_so3(w * h)
            v = v + Q_POSITION * np.sqrt(h) * rng.normal(size=3)
            w = w + Q_ROTATION * np.sqrt(h) * rng.normal(size=3)
    size = np.r_[np.full(3, np.radians(sigma_deg)), np.full(3, sigma)]
    mix = np.eye(6) + 0.2 * rng.normal(size=(num, 6, 6))
    root = np.exp(0.3 * rng.normal(size=num))[:, None, None] * size[:, None] * mix
    measured = perturbed(ground_truth, np.einsum("nij,nj->ni", root, rng.normal(size=(num, 6))))
    return dt * np.arange(num), ground_truth, measured, root @ root.swapaxes(1, 2)


def perturbed(poses: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """x_cam <- exp(w) x_cam + v."""
    return rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(tangent[:, :3]), tangent[:, 3:]), poses)


def tangent(poses: np.ndarray, ground_truth: np.ndarray) -> np.ndarray:
    """(N, 6) errors of poses, the inverse of ``perturbed``."""
    change = rigid3.compose(poses, rigid3.inverse(ground_truth))
    return np.column_stack([rigid3.log_so3(rigid3.rotation_matrix(change)), change[:, 4:]])


def nees(poses: np.ndarray, covariance: np.ndarray, ground_truth: np.ndarray) -> float:
    error = tangent(poses, ground_truth)
    return float((error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(1).mean() / 6)


@pytest.mark.parametrize("is_causal", [False, True])
def test_consistent_and_better_than_the_measurements(is_causal: bool) -> None:
    scores, innovations, gains = [], [], []
    for seed in range(12):
        times, ground_truth, measured, covariance = simulate(seed)
        options = SmoothingOptions(Q_POSITION, Q_ROTATION, is_causal=is_causal)
        found = smooth_trajectory(times, measured, covariance, options)
        scores.append(nees(found.cam_from_world, found.covariance, ground_truth))
        innovations.append(np.nanmean(found.nis[5:]) / 6)
        raw, smooth = tangent(measured, ground_truth), tangent(found.cam_from_world, ground_truth)
        gains.append(np.sqrt((smooth**2).mean(0) / (raw**2).mean(0)))
        assert not found.is_predicted.any()
        assert found.is_rejected.sum() <= 1
    assert 0.9 < np.mean(scores) < 1.1
    assert 0.95 < np.mean(innovations) < 1.05
    assert np.max(gains) < 1.0
    # the smoother sees both sides; neither can be better than averaging all frames that the motion lets agree
    assert (0.15 if is_causal else 0.1) < np.mean(gains) < (0.75 if is_causal else 0.5)


def test_noise_densities_are_found_in_the_data() -> None:
    found = [smooth_trajectory(*(simulate(seed)[i] for i in (0, 2, 3))) for seed in range(8)]
    assert np.median([f.acceleration_noise for f in found]) == pytest.approx(Q_POSITION, rel=0.25)
    assert np.median([f.turn_noise for f in found]) == pytest.approx(Q_ROTATION, rel=0.25)
    scores = [nees(f.cam_from_world, f.covariance, simulate(seed)[1]) for seed, f in enumerate(found)]
    assert 0.8 < np.mean(scores) < 1.25


def test_densities_do_not_depend_on_the_unit_of_length() -> None:
    times, _, measured, covariance = simulate(1)
    big, factor = measured.copy(), np.r_[np.ones(3), np.full(3, 1000.0)]
    big[:, 4:] *= 1000
    one = smooth_trajectory(times, measured, covariance)
    other = smooth_trajectory(times, big, covariance * factor[:, None] * factor)
    assert other.acceleration_noise == pytest.approx(1000 * one.acceleration_noise, rel=1e-6)
    assert other.turn_noise == pytest.approx(one.turn_noise, rel=1e-6)
    assert np.allclose(other.cam_from_world[:, 4:], 1000 * one.cam_from_world[:, 4:], rtol=1e-6, atol=1e-6)


def test_gaps_are_bridged_with_growing_covariance() -> None:
    scores = []
    for seed in range(20):
        times, ground_truth, measured, covariance = simulate(seed, 200)
        gap = slice(100, 120)
        measured[gap] = np.nan
        for is_causal in (False, True):
            options = SmoothingOptions(Q_POSITION, Q_ROTATION, is_causal=is_causal)
            found = smooth_trajectory(times, measured, covariance, options)
            assert found.is_predicted.nonzero()[0].tolist() == list(range(100, 120))
            sigma = np.sqrt(np.trace(found.covariance[:, 3:, 3:], axis1=1, axis2=2))
            grows = np.diff(sigma[99:119] if is_causal else sigma[99:109])
            assert (grows > 0).all()
            assert np.isnan(found.nis[gap]).all()
            if is_causal:
                assert sigma[119] > 3 * sigma[99]
            scores.append(nees(found.cam_from_world[gap], found.covariance[gap], ground_truth[gap]))
    # a gap is one draw of the motion, so 20 draws of some 6 numbers each: 0.75 to 1.3 at two sigma
    assert 0.7 < np.mean(scores[::2]) < 1.35
    assert 0.7 < np.mean(scores[1::2]) < 1.35


def test_long_gaps_and_ends_stay_open() -> None:
    times, _, measured, covariance = simulate(4, 200)
    measured[:5] = np.nan
    measured[50:100] = np.nan  # 1.7 s
    measured[190:] = np.nan  # 0.3 s
    found = smooth_trajectory(times, measured, covariance)
    has_pose = np.isfinite(found.cam_from_world).all(1)
    assert has_pose.nonzero()[0].tolist() == [*range(5, 50), *range(100, 200)]
    assert np.isfinite(found.covariance).all((1, 2)).tolist() == has_pose.tolist()
    assert found.is_predicted.nonzero()[0].tolist() == list(range(190, 200))
    nothing = smooth_trajectory(times, np.full((200, 7), np.nan), covariance)
    assert np.isnan(nothing.cam_from_world).all()
    covariance[120] = np.inf
    covariance[121] = 0.0
    assert smooth_trajectory(times, measured, covariance).is_predicted[[120, 121]].all()
    with pytest.raises(ValueError, match="ascend"):
        smooth_trajectory(np.zeros(200), measured, covariance)


def test_wrong_poses_are_rejected_and_jumps_are_followed() -> None:
    rng = np.random.default_rng(8)
    times, ground_truth, measured, covariance = simulate(5, 300)
    wrong = np.array([40, 41, 90, 150, 200])
    measured[wrong] = perturbed(measured[wrong], rng.choice([-1, 1], (5, 6)) * [0.3, 0.3, 0.3, 1, 1, 1])
    found = smooth_trajectory(times, measured, covariance)
    assert found.is_rejected.nonzero()[0].tolist() == wrong.tolist()
    assert found.is_predicted[wrong].all()
    error = np.abs(tangent(found.cam_from_world, ground_truth))
    assert error[wrong, :3].max() < np.radians(0.5)
    assert error[wrong, 3:].max() < 0.05
    # the world itself moves by ten metres: three frames are doubted, the rest is followed
    jumped = measured.copy()
    moved = rigid3.IDENTITY + np.array([0.0, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0])
    jumped[250:] = rigid3.compose(measured[250:], moved)
    found = smooth_trajectory(times, jumped, covariance)
    assert found.is_rejected[250:].nonzero()[0].tolist() == [0, 1, 2]
    after = np.abs(tangent(found.cam_from_world[254:], rigid3.compose(ground_truth[254:], moved)))
    assert after[:, 3:].max() < 0.05
    before = np.abs(tangent(found.cam_from_world[210:250], ground_truth[210:250]))
    assert before[:, 3:].max() < 0.05


def test_half_turns_do_not_confuse_it() -> None:
    """A camera that spins at two turns a second, measured at 30 Hz."""
    times = np.arange(120) / 30
    rotation = rigid3.exp_so3(np.outer(times, [0.0, 4 * np.pi, 0.0]))
    ground_truth = rigid3.inverse(rigid3.from_matrix(rotation, np.outer(times, [1.0, 0.0, 0.0])))
    covariance = np.tile(np.diag([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2]) ** 2, (120, 1, 1))
    found = smooth_trajectory(times, ground_truth, covariance)
    assert np.abs(tangent(found.cam_from_world, ground_truth)).max() < 2e-3
    assert np.allclose(found.turn_rate[10:-10], [0.0, 4 * np.pi, 0.0], atol=0.05)
    assert np.allclose(found.velocity[10:-10], [1.0, 0.0, 0.0], atol=0.05)


def test_same_bytes() -> None:
    times, _, measured, covariance = simulate(2, 1000)
    first = smooth_trajectory(times, measured, covariance)
    second = smooth_trajectory(times, measured, covariance)
    assert first.cam_from_world.tobytes() == second.cam_from_world.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()
