"""Rigs of known cameras before known boards: exact points, and points with noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.boards import Board
from sfmapp.calibration.rig_adjustment import RigFit, RigView
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

BOARD = Board("chessboard", 9, 6, 0.025)
PINHOLE = Camera(CameraModel.OPENCV, 640, 480, np.array([530.0, 535, 330, 245, -0.28, 0.07, 0.001, -0.0005]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 800, 600, np.array([300.0, 302, 405, 295, 0.02, -0.01, 0.002, 0.0]))
MIDDLE = BOARD.points.mean(0)
# fewer points of a board than these are no view of it
_LEAST_POINTS = 12


def pose(turn: Sequence[float], shift: Sequence[float]) -> np.ndarray:
    """(7,) of a rotation vector in radians and a shift."""
    return rigid3.from_matrix(rigid3.exp_so3(np.array(turn, np.float64)), np.array(shift, np.float64))


def overlapping_rig(rng: np.random.Generator, cameras: Sequence[Camera], num_shots: int) -> RigFit:
    """Up to three cameras beside each other, and a board that is held before them."""
    mounts = [rigid3.IDENTITY, pose([0.02, -0.1, 0.01], [-0.12, 0.003, 0.01]), pose([0.1, 0.1, 0.3], [0.05, 0.1, 0.0])]
    shots = []
    for _ in range(num_shots):
        turn = rigid3.exp_so3(rng.uniform(-0.5, 0.5, 3) * [1.0, 1.0, 1.5])
        place = rng.uniform([-0.12, -0.08, 0.35], [0.12, 0.08, 0.7])
        shots.append(rigid3.from_matrix(turn, place - turn @ MIDDLE))
    return RigFit(tuple(cameras), np.array(mounts[: len(cameras)]), np.array(shots), rigid3.IDENTITY[None])


def apart_rig(rng: np.random.Generator, num_shots: int, axes: Sequence[float] = (0.3, 0.3, 0.45)) -> RigFit:
    """Two cameras back to back, a board before each, fixed to each other, and the rig moved. ``axes``: of turns."""
    mounts = np.array([rigid3.IDENTITY, pose([0.05, 0.9 * np.pi, 0.1], [-0.1, 0.02, 0.05])])
    first = pose([0.0, 0.0, 0.0], np.array([0.0, 0.0, 0.5]) - MIDDLE)
    second = pose([0.1, 0.05, 0.0], np.array([0.0, 0.0, 0.5]) - MIDDLE)
    boards = np.array([rigid3.IDENTITY, rigid3.compose(rigid3.inverse(rigid3.compose(mounts[1], first)), second)])
    motions = [pose(rng.uniform(-1.0, 1.0, 3) * axes, rng.uniform(-0.1, 0.1, 3)) for _ in range(num_shots)]
    shots = np.array([rigid3.compose(motion, first) for motion in motions])
    return RigFit((PINHOLE, PINHOLE), mounts, shots, boards)


def views_of(
    truth: RigFit, rng: np.random.Generator, noise_px: float, board: np.ndarray = BOARD.points
) -> list[RigView]:
    """What the cameras see of boards with points (N, 3), with Gaussian noise."""
    views = []
    for c, camera in enumerate(truth.cameras):
        for t, rig_from_world in enumerate(truth.rig_from_world):
            for b, world_from_board in enumerate(truth.world_from_board):
                rig_from_board = rigid3.compose(rig_from_world, world_from_board)
                points = rigid3.apply(rigid3.compose(truth.cam_from_rig[c], rig_from_board), board)
                if points[:, 2].min() < 0.1:
                    continue
                xy = project(camera, points)
                is_in = ((xy > 0) & (xy < [camera.width, camera.height])).all(1)
                if is_in.sum() > _LEAST_POINTS:
                    noisy = xy[is_in] + noise_px * rng.standard_normal((int(is_in.sum()), 2))
                    views.append(RigView(c, t, b, TargetView(f"cam{c}/{t:02d}.png", board[is_in], noisy)))
    return views


def errors_of(found: RigFit, truth: RigFit) -> np.ndarray:
    """(S,) errors of all that shots share, in the order of the covariance of a rig."""
    parts = [a.params - b.params for a, b in zip(found.cameras, truth.cameras, strict=True)]
    for one, other in ((found.cam_from_rig, truth.cam_from_rig), (found.world_from_board, truth.world_from_board)):
        between = rigid3.compose(one[1:], rigid3.inverse(other[1:]))
        turn = rigid3.log_so3(rigid3.rotation_matrix(between))
        parts.append(np.concatenate([turn, between[:, 4:]], 1).ravel())
    return np.concatenate(parts)
