"""Cameras that are mounted together: poses, intrinsics, their sigmas, and photographs that were not taken together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig_scenes import BOARD, FISHEYE, PINHOLE, apart_rig, errors_of, overlapping_rig, pose, views_of
from sfmapp.calibration.boards import Board
from sfmapp.calibration.epipolar_errors import epipolar_errors
from sfmapp.calibration.rig import RigCalibration, calibrate_rig
from sfmapp.calibration.rig_adjustment import RigFit, RigView
from sfmapp.calibration.rig_ends import read_from_one_end, turns_of
from sfmapp.calibration.rig_file import write_rig
from sfmapp.calibration.rig_start import hand_eye
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.reading import read_calibration
from sfmapp.errors import InputError
from sfmapp.geometry import epipolar, rigid3
from sfmapp.pipelines.calibration.shots import match_shots


def calibrated(truth: RigFit, views: Sequence[RigView], *, held: bool = False) -> RigCalibration:
    """From intrinsics that are a little wrong, unless they are held."""
    cameras = [camera if held else camera.with_params(camera.params * 1.001) for camera in truth.cameras]
    return calibrate_rig([f"cam{c}" for c in range(len(cameras))], cameras, [held] * len(cameras), views)


def as_fit(found: RigCalibration) -> RigFit:
    return RigFit(found.rig.cameras, found.rig.cam_from_rig, np.zeros((0, 7)), found.world_from_board)


def views_with_idx(
    truth: RigFit, rng: np.random.Generator, noise_px: float, points: np.ndarray
) -> list[tuple[RigView, np.ndarray]]:
    """Views of a board of another shape, and which of its points each sees."""
    place = {tuple(point): n for n, point in enumerate(points[:, :2].tolist())}
    views = views_of(truth, rng, noise_px, points)
    return [(view, np.array([place[tuple(xy)] for xy in view.view.xyz[:, :2].tolist()])) for view in views]


def position(views: Sequence[RigView], camera: int, shot: int) -> int:
    return next(i for i, view in enumerate(views) if (view.camera, view.shot) == (camera, shot))


def with_motion(truth: RigFit, views: list[RigView], camera: int, shot: int, rng: np.random.Generator) -> list[RigView]:
    """One photograph made after the board had moved by 1 mm and 0.2 degrees."""
    moved = replace(truth, rig_from_world=rigid3.compose(truth.rig_from_world, pose([0.0035, 0, 0], [0.001, 0, 0])))
    late = views_of(moved, rng, 0.2)
    out = list(views)
    out[position(views, camera, shot)] = late[position(late, camera, shot)]
    return out


def test_sigmas_are_right_for_a_pinhole_beside_a_fisheye() -> None:
    nees, is_outside = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = overlapping_rig(rng, (PINHOLE, FISHEYE), 10)
        found = calibrated(truth, views_of(truth, rng, 0.3))
        assert not found.odd
        error = errors_of(as_fit(found), truth)
        nees.append(error @ np.linalg.solve(found.covariance, error) / len(error))
        is_outside.append(np.abs(error) > 3.0 * np.sqrt(np.diag(found.covariance)))
        assert found.noise_px == pytest.approx(0.3, rel=0.15)
    # 12 x 22 degrees of freedom: three sigmas of the mean are 3 sqrt(2 / 264)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.27)
    assert np.mean(is_outside) <= 0.02


def test_three_cameras_agree_with_their_pairs() -> None:
    rng = np.random.default_rng(3)
    truth = overlapping_rig(rng, (PINHOLE, FISHEYE, PINHOLE), 8)
    found = calibrated(truth, views_of(truth, rng, 0.0))
    assert np.abs(errors_of(as_fit(found), truth)).max() < 1e-6
    first, second = found.rig.cam_from_rig[1:]
    last = next(pair for pair in found.pairs if (pair.first, pair.second) == (1, 2))
    assert last.second_from_first == pytest.approx(rigid3.compose(second, rigid3.inverse(first)), abs=1e-12)
    assert last.epipolar_rms_px < 1e-6
    with_noise = calibrated(truth, views_of(truth, rng, 0.2))
    by_pair = {(pair.first, pair.second): pair for pair in with_noise.pairs}
    assert by_pair[0, 1].covariance == pytest.approx(with_noise.pose_covariance(1))
    # what both hang on is not counted twice: no worse than if their errors were independent
    parts = [np.trace(with_noise.pose_covariance(c)[3:, 3:]) for c in (1, 2)]
    assert 0.0 < np.trace(by_pair[1, 2].covariance[3:, 3:]) < 2.0 * sum(parts)


def test_cameras_without_a_view_in_common_are_joined_by_motion() -> None:
    rng = np.random.default_rng(5)
    truth = apart_rig(rng, 12)
    found = calibrated(truth, views_of(truth, rng, 0.0))
    assert np.abs(errors_of(as_fit(found), truth)).max() < 1e-6
    noisy = calibrated(truth, views_of(truth, rng, 0.2))
    z = errors_of(as_fit(noisy), truth) / np.sqrt(np.diag(noisy.covariance))
    assert np.abs(z).max() < 4.0
    assert noisy.pairs[0].by_motion
    assert np.isnan(noisy.pairs[0].epipolar_rms_px)


def test_motion_about_one_axis_is_refused() -> None:
    rng = np.random.default_rng(5)
    truth = apart_rig(rng, 12, axes=(0.0, 0.3, 0.0))
    with pytest.raises(InputError, match="cam1 sits beside cam0") as caught:
        calibrated(truth, views_of(truth, rng, 0.2), held=True)
    assert "two axes" in str(caught.value.advice)


def test_hand_eye_bears_wrong_motions() -> None:
    rng = np.random.default_rng(1)
    x, y = pose([0.3, -2.0, 0.4], [0.1, 0.2, -0.3]), pose([1.0, 0.2, -0.5], [0.5, -0.1, 0.8])
    first = np.array([pose(rng.uniform(-0.6, 0.6, 3), rng.uniform(-1, 1, 3)) for _ in range(15)])
    second = rigid3.compose(rigid3.compose(x, first), y)
    second[4] = pose([0.1, 0.5, 0.2], [1.0, 1.0, 1.0])
    found = hand_eye(first, second)
    assert found is not None
    for one, true in zip(found, (x, y), strict=True):
        away = rigid3.compose(one, rigid3.inverse(true))
        assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(away)) < 0.5
        assert np.linalg.norm(away[4:]) < 0.02


def test_photographs_that_were_not_taken_together_are_named() -> None:
    rng = np.random.default_rng(1)
    truth = overlapping_rig(rng, (PINHOLE, PINHOLE), 12)
    views = with_motion(truth, views_of(truth, rng, 0.2), 1, 9, rng)
    # the pictures of a shot swapped, and those of the second camera of two shots
    for i, j in (((0, 3), (1, 3)), ((1, 5), (1, 6))):
        a, b = position(views, *i), position(views, *j)
        views[a], views[b] = replace(views[a], view=views[b].view), replace(views[b], view=views[a].view)
    found = calibrated(truth, views)
    reasons = {(one.camera, one.shot): one.reason for one in found.odd}
    assert set(reasons) == {(1, 3), (1, 5), (1, 6), (1, 9)}
    assert "swapped" in reasons[1, 3]
    assert "of the moment of cam0/06.png" in reasons[1, 5]
    assert "of the moment of cam0/05.png" in reasons[1, 6]
    assert "it moved between the exposures" in reasons[1, 9]
    assert found.num_shots == 8
    z = errors_of(as_fit(found), truth) / np.sqrt(np.diag(found.covariance))
    assert np.abs(z).max() < 4.0


def test_of_three_cameras_the_one_that_was_late_is_named() -> None:
    rng = np.random.default_rng(2)
    truth = overlapping_rig(rng, (PINHOLE, FISHEYE, PINHOLE), 7)
    found = calibrated(truth, with_motion(truth, views_of(truth, rng, 0.2), 0, 4, rng), held=True)
    assert [(one.camera, one.shot) for one in found.odd] == [(0, 4)]
    assert found.cameras[0].sigmas == pytest.approx(0.0)
    assert found.num_shots == 7


def test_a_bent_board_is_taken_into_account() -> None:
    rng = np.random.default_rng(8)
    truth = overlapping_rig(rng, (PINHOLE, FISHEYE), 10)
    # 0.4 mm hollow across its columns
    low, high = BOARD.points.min(0), BOARD.points.max(0)
    v = 2.0 * (BOARD.points[:, 1] - low[1]) / (high[1] - low[1]) - 1.0
    hollow = np.column_stack([BOARD.points[:, :2], 0.0004 * v * v])
    views = [
        replace(view, view=replace(view.view, xyz=BOARD.points[seen]))
        for view, seen in views_with_idx(truth, rng, 0.2, hollow)
    ]
    found = calibrated(truth, views)
    assert found.bend is not None
    assert found.bend[0, 1] == pytest.approx(0.0004, abs=4.0 * np.sqrt(found.covariance[-2, -2]))
    error = errors_of(as_fit(found), truth)
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(found.covariance))[: len(error)]).all()
    assert not found.odd


def test_a_board_that_can_be_turned_is_read_from_one_end() -> None:
    assert [turns_of(board) for board in (BOARD, Board("chessboard", 8, 6, 0.03), Board("circles", 5, 5, 0.03))] == [
        1,
        2,
        4,
    ]
    rng = np.random.default_rng(4)
    truth = overlapping_rig(rng, (PINHOLE, PINHOLE), 8)
    # as if nobody knew the ends of this board
    board = Board("circles", 9, 6, 0.025)
    views = views_of(truth, rng, 0.1)
    for shot in (2, 3, 6):
        i = position(views, 1, shot)
        turned = board.points.max(0) - views[i].view.xyz
        views[i] = replace(views[i], view=replace(views[i].view, xyz=turned))
    found = calibrated(truth, read_from_one_end(views, [board], truth.cameras))
    assert not found.odd
    between = rigid3.compose(found.rig.cam_from_rig[1], rigid3.inverse(truth.cam_from_rig[1]))
    assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(between)) < 0.3


def test_epipolar_errors_are_sampsons_where_there_is_no_distortion() -> None:
    rng = np.random.default_rng(0)
    cameras = (Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 510, 320, 240])),
               Camera(CameraModel.PINHOLE, 640, 480, np.array([600.0, 590, 310, 250])))  # fmt: skip
    second = pose([0.05, -0.1, 0.02], [-0.3, 0.02, 0.05])
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (50, 3))
    xy1 = project(cameras[0], points) + 0.05 * rng.standard_normal((50, 2))
    xy2 = project(cameras[1], rigid3.apply(second, points)) + 0.05 * rng.standard_normal((50, 2))
    fundamental = epipolar.fundamental_from_essential(
        epipolar.essential_from_pose(second), cameras[0].k_matrix, cameras[1].k_matrix
    )
    expected = epipolar.sampson_errors(fundamental, xy1, xy2)
    assert epipolar_errors(cameras, second, xy1, xy2) ** 2 == pytest.approx(expected, rel=1e-4)


def test_shots_are_told_by_names_and_refused_where_nothing_tells() -> None:
    shots, told = match_shots(["a", "b"], [["x.png", "y.png", "z.png"], ["y.png", "z.png"]])
    assert shots == [{0: 1, 1: 0}, {0: 2, 1: 1}]
    assert "equal names" in told
    shots, told = match_shots(["a", "b"], [["left01.jpg", "left03.jpg"], ["right1.jpg", "right03.jpg"]])
    assert shots == [{0: 0, 1: 0}, {0: 1, 1: 1}]
    assert "last number" in told
    shots, told = match_shots(["a", "b"], [["p.jpg", "q.jpg"], ["r.jpg", "s.jpg"]])
    assert shots == [{0: 0, 1: 0}, {0: 1, 1: 1}]
    assert "order" in told
    with pytest.raises(InputError, match="3 in a, 2 in b"):
        match_shots(["a", "b"], [["p.jpg", "q.jpg", "r.jpg"], ["s.jpg", "t.jpg"]])


def test_rig_json_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = overlapping_rig(rng, (PINHOLE, FISHEYE), 6)
    found = calibrated(truth, views_of(truth, rng, 0.1), held=True)
    write_rig(tmp_path / "rig.json", found)
    read = read_calibration(tmp_path / "rig.json", [(640, 480), (800, 600)]).rig
    assert read.cam_from_rig == pytest.approx(found.rig.cam_from_rig, abs=1e-12)
    for one, two in zip(read.cameras, found.rig.cameras, strict=True):
        assert one.model == two.model
        assert one.params == pytest.approx(two.params)


def test_a_board_that_moved_between_exposures_is_named_although_it_pulled_the_rig_its_way() -> None:
    """Ten shots, one of them swapped and in one the board moved by millimetres: all look bad while these count."""
    rigs = pytest.importorskip("rigs", reason="benchmarks/ is not part of an installed package")
    found = rigs.odd_shots(3)
    assert (found["swapped"], found["moved"], found["others_named"]) == (3, 3, 0)
    assert found["worst_pose_error_sigmas"] < 4.0
