"""Points of boards in rendered pictures, whose places are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from board_views import render_board
from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.bent_edges import edge_course, edge_courses, measured_along_edges
from sfmapp.calibration.boards import Board, parse_board
from sfmapp.calibration.circle_centers import DiskMarks, disk_images, recentered
from sfmapp.calibration.circles import disk_bias
from sfmapp.calibration.detection import detect_board, window_of
from sfmapp.calibration.solve import solve_views
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

CAMERA = Camera(CameraModel.OPENCV, 600, 450, np.array([480.0, 480.0, 300.0, 225.0, -0.2, 0.05, 1e-3, -5e-4]))
CHESS = parse_board("chessboard:9x6:0.025")


def pose_of(board: Board, tilt_deg: float, depth: float, shift: float = 0.0) -> np.ndarray:
    rotation = rigid3.exp_so3(np.radians([0.15 * tilt_deg, tilt_deg, 8.0]))
    middle = board.points.mean(0)
    return rigid3.from_matrix(rotation, np.array([shift, 0.0, depth]) - rotation @ middle)


def errors(board: Board, pose: np.ndarray, **picture: float) -> tuple[np.ndarray, np.ndarray]:
    found = detect_board(render_board(CAMERA, board, pose, **picture), board)  # type: ignore[arg-type]
    assert found.problem is None, found.problem
    assert len(np.unique(found.idx)) == len(found.idx)
    truth = project(CAMERA, rigid3.apply(pose, board.points))
    return found.idx, found.xy - truth[found.idx]


@pytest.mark.parametrize(("tilt", "blur", "rms"), [(20.0, 0.7, 0.03), (60.0, 0.7, 0.06), (20.0, 3.0, 0.06)])
def test_corners_of_a_chessboard(tilt: float, blur: float, rms: float) -> None:
    idx, error = errors(CHESS, pose_of(CHESS, tilt, 0.3), blur_px=blur, noise=2.0)
    assert len(idx) == 54
    assert np.sqrt((error**2).sum(1).mean()) < rms


def test_half_a_chessboard_is_a_part_of_one() -> None:
    pose = pose_of(CHESS, 25.0, 0.24, 0.12)
    found = detect_board(render_board(CAMERA, CHESS, pose, blur_px=0.7, noise=2.0), CHESS)
    truth = project(CAMERA, rigid3.apply(pose, CHESS.points))
    inside = ((truth > 12) & (truth < [588, 438])).all(1)
    assert 12 <= inside.sum() < 45
    assert len(found.idx) >= inside.sum() - 3
    # numbered from anywhere, but by steps of the board: what is apart by a step in the picture is so on the board
    nearest = np.linalg.norm(truth[None] - found.xy[:, None], axis=2).argmin(1)
    assert np.linalg.norm(truth[nearest] - found.xy, axis=1).max() < 0.3
    one, other = CHESS.points[nearest], CHESS.points[found.idx]
    apart = [np.linalg.norm(points[:, None] - points[None], axis=2) for points in (one, other)]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-12)


@pytest.mark.parametrize("text", ["charuco:7x5:0.035:0.026", "aprilgrid:4x3:0.04:0.3"])
def test_points_beside_markers_are_numbered(text: str) -> None:
    board = parse_board(text)
    idx, error = errors(board, pose_of(board, 30.0, 0.3), blur_px=0.7, noise=2.0)
    assert len(idx) >= 0.9 * len(board.points)
    assert np.sqrt((error**2).sum(1).mean()) < 0.05
    # half out of the picture
    idx, error = errors(board, pose_of(board, 20.0, 0.26, 0.17), blur_px=0.7, noise=2.0)
    assert 8 <= len(idx) < 0.85 * len(board.points)
    assert np.sqrt((error**2).sum(1).mean()) < 0.05


@pytest.mark.parametrize("text", ["circles:8x6:0.025", "acircles:4x9:0.02"])
def test_centres_of_circles(text: str) -> None:
    board = parse_board(text)
    idx, error = errors(board, pose_of(board, 0.0, 0.32), blur_px=0.7, noise=2.0)
    assert len(idx) >= 0.9 * len(board.points)
    assert np.sqrt((error**2).sum(1).mean()) < 0.05
    # half out of the picture: numbered from anywhere, but by steps of the board
    pose = pose_of(board, 20.0, 0.3, 0.17)
    found = detect_board(render_board(CAMERA, board, pose, blur_px=0.7, noise=2.0), board)
    truth = project(CAMERA, rigid3.apply(pose, board.points))
    inside = ((truth > 16) & (truth < [584, 434])).all(1)
    assert 12 <= inside.sum() < 0.9 * len(board.points)
    assert len(found.idx) >= 0.85 * inside.sum()
    nearest = np.linalg.norm(truth[None] - found.xy[:, None], axis=2).argmin(1)
    assert np.linalg.norm(truth[nearest] - found.xy, axis=1).max() < 0.2
    apart = [np.linalg.norm(board.points[i][:, None] - board.points[i][None], axis=2) for i in (nearest, found.idx)]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-12)


def test_the_bias_of_tilted_circles_is_that_of_their_exact_images() -> None:
    """Against the centre of mass of each disk's image by quadrature, with perspective and distortion."""
    board, radius = parse_board("circles:8x6:0.025"), 0.25
    pose = pose_of(board, 55.0, 0.24)
    r, angle = np.sqrt((np.arange(30) + 0.5) / 30) * radius * board.spacing, np.arange(48) * 2.0 * np.pi / 48
    disk = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.zeros((30, 48))], -1).reshape(-1, 3)

    def image(points: np.ndarray) -> np.ndarray:
        return project(CAMERA, rigid3.apply(pose, points.reshape(-1, 3))).reshape(*points.shape[:-1], 2)

    points = board.points[:, None] + disk
    by = [(image(points + step) - image(points - step)) / 2e-6 for step in np.eye(3)[:2] * 1e-6]
    weight = np.abs(by[0][..., 0] * by[1][..., 1] - by[0][..., 1] * by[1][..., 0])
    center = (image(points) * weight[..., None]).sum(1) / weight.sum(1)[:, None]
    bias = center - image(board.points)
    left = bias - disk_bias(board.points[:, :2] / board.spacing, center, radius)
    assert np.abs(bias).max() > 0.2
    assert np.sqrt((left**2).mean()) < 0.1 * np.sqrt((bias**2).mean())
    # and with the camera, whose outlines are exact: quadrature is good to a thousandth of the bias
    exact, area = disk_images(CAMERA, pose, board.points, radius * board.spacing)
    np.testing.assert_allclose(exact, center, atol=2e-3 * np.abs(bias).max())
    np.testing.assert_allclose(area, weight.sum(1) * np.pi * (radius * board.spacing) ** 2 / weight[0].size, rtol=1e-3)


def test_centres_of_circles_by_the_camera_are_those_of_the_truth_from_seventy_degrees() -> None:
    """What neighbours tell of the bias moves a focal length by five sigmas and more; with the camera it is inside."""
    board, radius, rng = parse_board("circles:8x6:0.025"), 0.25, np.random.default_rng(3)
    poses = [
        rigid3.from_matrix(turn, np.array([0.0, 0.0, 0.33]) - turn @ board.points.mean(0))
        for k in range(12)
        for turn in [rigid3.exp_so3(np.radians(25.0 if k % 3 == 0 else 70.0) * np.array([np.cos(k), np.sin(k), 0.0]))]
    ]
    views, marks = [], []
    for pose in poses:
        mass, area = disk_images(CAMERA, pose, board.points, radius * board.spacing)
        mass = mass + 0.005 * rng.normal(size=mass.shape)
        bias = disk_bias(board.points[:, :2] / board.spacing, mass, radius)
        views.append(TargetView(f"{len(views)}", board.points, mass - bias))
        marks.append(DiskMarks(mass, area))
    first = solve_views(views, (CAMERA.width, CAMERA.height), CAMERA.model, bends=False).calibration
    off = (first.camera.params - CAMERA.params) / first.sigmas
    assert np.abs(off[:2]).max() > 5.0
    centers = recentered(views, marks, first.camera)
    truth = [project(CAMERA, rigid3.apply(pose, board.points)) for pose in poses]
    left = np.concatenate(centers) - np.concatenate(truth)
    assert 0.004 < np.sqrt((left**2).mean()) < 0.0056
    again = [replace(view, xy=xy) for view, xy in zip(views, centers, strict=True)]
    made = solve_views(again, (CAMERA.width, CAMERA.height), CAMERA.model, bends=False).calibration
    assert np.abs((made.camera.params - CAMERA.params) / made.sigmas).max() < 3.5


def test_a_picture_without_a_board_says_so() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 400)).astype(np.uint8)
    for text in ("chessboard:9x6:0.025", "charuco:7x5:0.035:0.026", "aprilgrid:4x3:0.04:0.3", "circles:8x6:0.02"):
        found = detect_board(noise, parse_board(text))
        assert found.problem is not None
        assert len(found.idx) == 0


def test_crossings_are_measured_along_edges_that_a_camera_bends() -> None:
    """A barrel lens near the corners of the picture: crossings are found to the inside of the bend of their edges, and
    at a third of that distance in windows that follow the edges."""
    board = parse_board("charuco:6x5:0.03:0.022")
    camera = Camera(CameraModel.OPENCV, 400, 300, np.array([230.0, 231.0, 203.0, 148.0, -0.24, 0.045, 5e-4, -4e-4]))
    window = window_of(board)
    assert window is not None
    before, after = [], []
    for x, y, z in ((-0.2, -0.15, 0.15), (0.02, -0.15, 0.15), (-0.18, -0.13, 0.13), (0.01, 0.0, 0.13)):
        pose = rigid3.from_matrix(rigid3.exp_so3(np.array([0.1, -0.15, 0.02])), np.array([x, y, z]))
        picture = render_board(camera, board, pose, blur_px=0.6)
        found = detect_board(picture, board)
        view = TargetView("", board.points[found.idx], found.xy)
        truth = project(camera, rigid3.apply(pose, view.xyz))
        # by the pose that fits crossings that are off: it is near enough
        course = edge_courses([view], camera, window)[0]
        assert course.largest_bend_px(window) > 0.2
        before.append(view.xy - truth)
        after.append(measured_along_edges(picture, view.xy, course, window) - truth)
    error, left = np.concatenate(before), np.concatenate(after)
    assert len(error) > 60
    assert 0.05 < np.sqrt((error**2).sum(1).mean()) < 0.08
    assert np.sqrt((left**2).sum(1).mean()) < 0.02
    # straight edges, however oblique, do not bend, and a crossing that the lens does not see stays where it was
    pinhole = Camera(CameraModel.PINHOLE, 400, 300, camera.params[:4])
    oblique = edge_course(pinhole, pose, view.xyz, window)
    across = np.stack([-oblique.axes[..., 1], oblique.axes[..., 0]], -1)
    np.testing.assert_allclose((oblique.curves[:, ::2] * across).sum(2), 0.0, atol=1e-9)
    behind = edge_course(pinhole, rigid3.from_matrix(np.eye(3), np.array([0.0, 0.0, -0.1])), view.xyz, window)
    np.testing.assert_array_equal(measured_along_edges(picture, view.xy, behind, window), view.xy)


def test_a_board_of_odd_columns_and_even_rows_is_read_from_its_own_first_square() -> None:
    """Read as a board of OpenCV before 4.6, or the other way round, all its markers but one in every other row are a
    column aside: as flat a board, and in a rig another one in each photograph."""
    board = parse_board("charuco:7x6:0.03:0.022")
    for seed, (tilt_deg, shift) in enumerate(((10.0, 0.0), (30.0, 0.0), (-40.0, 0.0), (20.0, 0.17), (20.0, -0.17))):
        pose = pose_of(board, tilt_deg, 0.32, shift)
        picture = render_board(CAMERA, board, pose, blur_px=0.6, noise=2.0, seed=seed)
        truth = project(CAMERA, rigid3.apply(pose, board.points))
        found = detect_board(picture, board)
        assert len(found.idx) == len(board.points) if shift == 0.0 else 6 <= len(found.idx) < len(board.points)
        assert np.abs(found.xy - truth[found.idx]).max() < 0.3
