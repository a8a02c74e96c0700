"""What a gyroscope says of the keyframes of a window is as sure as it says, and holds their rotations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from inertial_flights import Flight, true_map
from odometry_sequences import keyframe_map
from sfmapp.camera.camera import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.window import Turn, swings_at, turns_between
from sfmapp.odometry.map.backend import make_job, run_job
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import make_scene, synthetic_camera

TIMES = np.arange(0, 6, 0.25)


def shaken(poses: np.ndarray, sigma_rad: float, seed: int) -> np.ndarray:
    noise = rigid3.exp_so3(sigma_rad * np.random.default_rng(seed).normal(size=(len(poses), 3)))
    return rigid3.from_matrix(noise @ rigid3.rotation_matrix(poses), poses[:, 4:])


def scores(imu: Imu, flight: Flight, sigma_rad: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the turns over their sigmas (N, 3), and the sigmas."""
    truth = true_map(flight, TIMES)
    found = turns_between(TIMES, shaken(truth, sigma_rad, seed), imu, first=7)
    rotation = rigid3.rotation_matrix(truth)
    out = []
    for turn in found:
        a, b = turn.first - 7, turn.second - 7
        out.append(rigid3.log_so3(turn.first_from_second.T @ rotation[a] @ rotation[b].T) / turn.sigma_rad)
    return np.array(out), np.array([turn.sigma_rad for turn in found])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_turns_are_as_good_as_they_say(seed: int) -> None:
    flight = Flight(seed)
    errors, sigmas = scores(flight.imu(seed, 6.0), flight, 2e-4, seed)
    assert len(errors) == len(TIMES) - 1
    assert 0.05 < np.sqrt((errors**2).mean()) < 1.0  # four times the noise that the sensor has, and the keyframes' own
    assert sigmas.max() < 1e-3


def test_what_speaks_against_a_gyroscope_makes_it_less_sure() -> None:
    flight = Flight(3)
    imu = flight.imu(3, 6.0)
    _, right = scores(imu, flight, 2e-4, 3)
    turned = rigid3.compose(rigid3.from_matrix(rigid3.exp_so3([0.012, -0.009, 0.01]), np.zeros(3)), imu.imu_from_cam)
    for other in (replace(imu, imu_from_cam=turned), replace(imu, timestamps_s=imu.timestamps_s + 0.02)):
        errors, sigmas = scores(other, flight, 2e-4, 3)
        assert sigmas.min() > 2 * right.max()
        assert np.sqrt((errors**2).mean()) < 2.0


def test_swings_are_what_frames_cannot_tell() -> None:
    times, frames, rate = np.arange(-0.1, 1.1, 0.002), np.arange(0, 1, 0.05), 2 * np.pi * 6
    gyro = np.stack([0.3 + 0.5 * np.sin(rate * times), 0.2 - times, 0 * times], 1)  # a tremble, a bias; a steady change
    turn = rigid3.exp_so3([0, 0, np.pi / 2])  # the camera's x axis is the sensor's y axis
    imu = Imu(times, gyro, 0 * gyro, rigid3.from_matrix(turn, np.zeros(3)), 1e-4, 1e-3, 1e-5, 1e-3)
    found = swings_at(frames, imu)
    expected = 0.5 * np.sin(rate * frames) * (1 - np.sin(rate * 0.05) / (rate * 0.05))
    np.testing.assert_allclose(found[1:-1, 1], -expected[1:-1], atol=1e-3)
    np.testing.assert_allclose(found[1:-1, [0, 2]], 0, atol=1e-6)
    assert np.isnan(swings_at(frames + 0.5, imu)[-1]).all()  # not measured any more


def test_one_that_is_read_wrongly_or_on_another_clock_says_nothing() -> None:
    flight = Flight(4)
    imu, poses = flight.imu(4, 6.0), true_map(flight, TIMES)
    assert turns_between(TIMES, poses, imu)
    for other in (
        replace(imu, gyro=-imu.gyro),
        replace(imu, gyro=np.degrees(imu.gyro)),
        replace(imu, gyro=imu.gyro[:, [1, 0, 2]]),
        replace(imu, timestamps_s=imu.timestamps_s + 1e9),
    ):
        assert turns_between(TIMES, poses, other) == []


def test_a_window_is_held_by_what_a_gyroscope_says() -> None:
    camera = replace(synthetic_camera(CameraModel.PINHOLE), is_fixed=True)
    with_turns, without = [], []
    for seed in range(4):
        scene = make_scene(seed, 8, 60, camera, sigma_px=1.5)
        rotation = rigid3.rotation_matrix(scene.ground_truth.cam_from_world)
        for errors, is_held in ((with_turns, True), (without, False)):
            keyframes = keyframe_map(scene, Rig.single(camera))
            job = make_job(keyframes, np.arange(8), np.arange(8) > 1)
            if is_held:
                job.turns = [Turn(k, k + 1, rotation[k] @ rotation[k + 1].T, 1e-5) for k in range(7)]
            model = run_job(job).model
            found = rigid3.rotation_matrix(model.cam_from_world)
            left = (found[:-1] @ found[1:].swapaxes(1, 2)).swapaxes(1, 2) @ (
                rotation[:-1] @ rotation[1:].swapaxes(1, 2)
            )
            errors.append(np.sqrt((rigid3.log_so3(left)[1:] ** 2).sum(1).mean()))
    assert np.median(with_turns) < 1e-4 < 0.3 * np.median(without)
