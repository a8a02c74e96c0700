"""Two calibrations side by side, and what to photograph next."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from board_views import board_poses, board_views
from sfmapp.calibration.adjustment import Fit, normal_at, observations_of, refine, residuals_of
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.comparison import compare
from sfmapp.calibration.file import write_calibration
from sfmapp.calibration.planning import mean_sigma, next_views
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.uncertainty import frame_covariance
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3

BOARD = parse_board("charuco:9x7:0.025:0.018")
CAMERA = Camera(CameraModel.OPENCV, 1280, 960, np.array([1000.0, 1010.0, 630.0, 490.0, -0.2, 0.05, 1e-3, -5e-4]))


def calibrated(camera: Camera, poses: np.ndarray, seed: int, noise_px: float = 0.2) -> tuple[CameraCalibration, Fit]:
    """A least-squares fit to views with noise, from the truth."""
    views = board_views(camera, BOARD, poses, noise_px, np.random.default_rng(seed))
    obs = observations_of(views)
    fit = refine(Fit(camera, poses, np.zeros(0), np.inf), obs)
    num, dof = len(camera.params), 2 * len(obs.xy) - len(camera.params) - 6 * len(poses)
    noise = float(np.sqrt((residuals_of(fit, obs) ** 2).sum() / dof))
    joint = frame_covariance(normal_at(fit, obs), num, noise**2)
    assert joint is not None
    made = CameraCalibration(fit.camera, joint[:num, :num], "board", noise, dof, frame_covariance=joint)
    return made, fit


def poses_of(seed: int, num: int = 8) -> np.ndarray:
    return board_poses(np.random.default_rng(seed), BOARD, num, CAMERA, 30.0)


def test_the_same_camera_differs_by_chance_alone() -> None:
    chances = []
    for seed in range(10):
        a, _ = calibrated(CAMERA, poses_of(1), 100 + seed)
        b, _ = calibrated(CAMERA, poses_of(2), 200 + seed)
        found = compare(a, b)
        assert found.degrees_of_freedom <= 16
        chances.append(found.chance)
    # uniform between 0 and 1: the mean of 10 is 0.5 +- 0.09
    assert 0.23 < np.mean(chances) < 0.77
    assert min(chances) > 1e-3


def test_a_turned_camera_is_the_same_and_another_focal_length_is_not() -> None:
    a, _ = calibrated(CAMERA, poses_of(1), 5)
    assert compare(a, a).is_same
    # a shift of the principal point is a turn, to first order
    plain = Camera(CameraModel.PINHOLE, 1280, 960, np.array([4000.0, 4000.0, 630.0, 490.0]))
    shifted = plain.with_params([4000.0, 4000.0, 634.0, 487.0])
    one, two = (CameraCalibration(camera, np.eye(4), "board", 0.2, 500) for camera in (plain, shifted))
    found = compare(one, two)
    assert found.is_same
    assert found.turn_deg == pytest.approx(np.degrees(5.0 / 4000.0), rel=0.02)
    # what is left is of second order in the angle from the axis
    assert np.nanmax(found.length) < 5.0 * (806.0 / 4000.0) ** 2
    other, _ = calibrated(CAMERA.with_params(CAMERA.params * [1.01, 1.01, 1, 1, 1, 1, 1, 1]), poses_of(2), 6)
    found = compare(a, other)
    assert not found.is_same
    assert np.nanmax(found.length) > 2.0
    small = Camera(CameraModel.PINHOLE, 640, 480, np.array([300.0, 300.0, 320.0, 240.0]))
    foreign = CameraCalibration(small, np.eye(4), "board", 0.2, 500)
    with pytest.raises(InputError, match="pictures of one size"):
        compare(a, foreign)


def test_compare_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("a", 5), ("b", 8)):
        (tmp_path / name).mkdir()
        write_calibration(tmp_path / name / "calibration.json", calibrated(CAMERA, poses_of(seed), seed)[0])
    command = ["calibrate", "compare", str(tmp_path / "a"), str(tmp_path / "b" / "calibration.json")]
    assert main([*command, "--picture", str(tmp_path / "d.svg")]) == 0
    assert "the same camera" in capsys.readouterr().out
    assert (tmp_path / "d.svg").read_text().startswith("<svg xmlns")
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["is_same"]
    assert main(["calibrate", "compare", str(tmp_path), str(tmp_path)]) == 3


def test_the_views_to_take_next_are_worth_twice_what_others_are() -> None:
    gains = []
    for seed in range(3):
        poses = poses_of(20 + seed, 5)
        made, fit = calibrated(CAMERA, poses, seed)
        made = replace(made, distances=(0.3, 0.4, 0.6))
        views = board_views(CAMERA, BOARD, poses, 0.2, np.random.default_rng(seed))
        wanted = next_views(made, fit, views, BOARD)
        assert len(wanted) == 3
        before = mean_sigma(made, 0.4)
        sigmas = [view.mean_sigma_px for view in wanted]
        assert before > sigmas[0] > sigmas[1] > sigmas[2]
        for view in wanted:
            assert (view.xy > 0).all()
            assert (view.xy < [1280, 960]).all()
        after = mean_sigma(retaken(poses, np.array([view.cam_from_target for view in wanted]), seed), 0.4)
        # the promise is kept
        assert after == pytest.approx(sigmas[2], rel=0.15)
        rest = mean_sigma(retaken(poses, poses_of(40 + seed, 3), seed), 0.4)
        gains.append(np.log(before / after) / np.log(before / rest))
    assert np.mean(gains) > 2.0


def retaken(poses: np.ndarray, more: np.ndarray, seed: int) -> CameraCalibration:
    """The calibration with further views, of which the points in the picture count."""
    every = np.concatenate([poses, more])
    rng = np.random.default_rng(seed)
    views = board_views(CAMERA, BOARD, every, 0.2, rng)
    obs = observations_of(views)
    truth = project(CAMERA, np.concatenate([rigid3.apply(pose, BOARD.points) for pose in every]))
    inside = np.isfinite(truth).all(1) & (truth > 0).all(1) & (truth < [1280, 960]).all(1)
    obs = obs._replace(weight=inside.astype(np.float64), xy=np.nan_to_num(obs.xy))
    fit = refine(Fit(CAMERA, every, np.zeros(0), np.inf), obs)
    joint = frame_covariance(normal_at(fit, obs), 8, 0.2**2)
    assert joint is not None
    assert np.isfinite(pixels_to_rays(fit.camera, truth[inside])).all()
    return CameraCalibration(
        fit.camera, joint[:8, :8], "board", 0.2, 1, frame_covariance=joint, distances=(0.3, 0.4, 0.6)
    )
