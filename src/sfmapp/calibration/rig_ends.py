"""Boards that look the same when they are turned: which way round each photograph has read them.

A grid of circles, or a chessboard whose two ends are alike, is numbered from either end. For one camera that is all the
same; cameras that are mounted together have to read a board from the same end, and boards that are fixed to each other
from the same end in every shot. The rig is rigid, so of all ways round those are right in which shots agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.boards import Board
from sfmapp.calibration.rig_adjustment import RigView
from sfmapp.calibration.rig_start import robust_pose
from sfmapp.calibration.start import posed
from sfmapp.camera.camera import Camera
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


def turns_of(board: Board) -> int:
    """In how many ways a board can be laid over itself by turning it: 1, 2, or 4."""
    is_alike = board.kind == "circles" or (board.kind == "chessboard" and (board.columns + board.rows) % 2 == 0)
    if board.kind == "acircles":
        is_alike = board.rows % 2 == 1
    return 1 if not is_alike else 4 if board.columns == board.rows and board.kind != "acircles" else 2


def read_from_one_end(views: Sequence[RigView], boards: Sequence[Board], cameras: Sequence[Camera]) -> list[RigView]:
    """The views, those of boards that can be turned read the same way round by all cameras of a shot.

    Of two cameras the way is right that most shots agree on about where the second sits beside the first.
    """
    out = list(views)
    for b, board in enumerate(boards):
        num = turns_of(board)
        if num == 1:
            continue
        mine = [i for i, view in enumerate(out) if view.board == b]
        poses = {i: posed(cameras[out[i].camera], [out[i].view]).cam_from_target[0] for i in mine}
        turns = [_turn(board, k * (4 // num)) for k in range(num)]
        first = {view.shot: i for i, view in reversed(list(enumerate(out))) if view.board == b}
        for camera in range(1, len(cameras)):
            pairs = [(first[out[i].shot], i) for i in mine if out[i].camera == camera and first[out[i].shot] != i]
            pairs = [(i, j) for i, j in pairs if out[i].camera < camera]
            for before in sorted({out[i].camera for i, _ in pairs}):
                both = [(i, j) for i, j in pairs if out[i].camera == before]
                tried = np.array([
                    [rigid3.compose(poses[j], rigid3.compose(turn, rigid3.inverse(poses[i]))) for turn in turns]
                    for i, j in both
                ])  # fmt: skip
                agreed = robust_pose(tried.reshape(-1, 7))
                for (_, j), ways in zip(both, tried, strict=True):
                    k = int(np.argmin([_apart(way, agreed) for way in ways]))
                    turned = rigid3.apply(rigid3.inverse(turns[k]), out[j].view.xyz)
                    poses[j] = rigid3.compose(poses[j], turns[k])
                    out[j] = replace(out[j], view=replace(out[j].view, xyz=turned))
    return out


def _turn(board: Board, quarters: int) -> Array:
    """(7,) the turn of a board about its middle."""
    middle = 0.5 * (board.points.min(0) + board.points.max(0))
    rotation = rigid3.exp_so3(np.array([0.0, 0.0, 0.5 * np.pi * quarters]))
    return rigid3.from_matrix(rotation, middle - rotation @ middle)


def _apart(one: Array, other: Array) -> float:
    between = rigid3.compose(one, rigid3.inverse(other))
    length = max(float(np.linalg.norm(other[4:])), 1e-12)
    turn = float(np.radians(rigid3.rotation_angle_deg(rigid3.rotation_matrix(between))))
    return turn + float(np.linalg.norm(between[4:])) / length
