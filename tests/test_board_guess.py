"""Which board photographs show, told from rendered ones."""

from __future__ import annotations

import numpy as np
import pytest

from board_views import board_poses, render_board
from sfmapp.calibration.board_guess import PictureSigns, guess_board, signs_of
from sfmapp.calibration.boards import parse_board
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError

BARREL = Camera(CameraModel.OPENCV, 900, 675, np.array([620.0, 620.0, 450.0, 337.0, -0.3, 0.08, 1e-3, -5e-4]))


def signs(text: str, num: int = 3) -> list[PictureSigns]:
    board = parse_board(text)
    poses = board_poses(np.random.default_rng(0), board, num, BARREL, 30.0)
    return [signs_of(render_board(BARREL, board, pose, blur_px=0.7, noise=2.0, seed=n)) for n, pose in enumerate(poses)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("chessboard:8x5:0.03", "chessboard:8x5:1"),
        ("charuco:9x7:0.028:0.021", "charuco:9x7:1:"),
        ("charuco:8x6:0.03:0.021:DICT_5X5_100", "charuco:8x6:1:"),
        ("aprilgrid:6x4:0.03:0.3", "aprilgrid:6x4:1:0.3:DICT_APRILTAG_36H11"),
        ("circles:8x6:0.028", "circles:8x6:1"),
        ("acircles:4x9:0.012", "acircles:4x9:1"),
    ],
)
def test_kind_and_size(text: str, expected: str) -> None:
    guess = guess_board(signs(text), "photos")
    assert guess.board.text().startswith(expected)
    assert guess.board.unit == "squares"
    assert guess.num_agree >= 2
    assert guess.num_other == 0
    if guess.board.kind == "charuco":
        wanted = parse_board(text)
        assert guess.board.dictionary.startswith(wanted.dictionary[:8])
        assert guess.board.marker == pytest.approx(wanted.marker / wanted.spacing, abs=0.03)


def test_photographs_that_disagree_are_refused_with_the_reason() -> None:
    mixed = signs("chessboard:8x5:0.03", 6) + signs("chessboard:6x9:0.02", 4)
    with pytest.raises(InputError, match=r"one board, found chessboard:9x6:1.*show chessboard 8x5"):
        guess_board(mixed, "photos")
    nothing = np.random.default_rng(0).integers(0, 255, (300, 400)).astype(np.uint8)
    with pytest.raises(InputError, match="no markers, no chessboard, no grid of circles"):
        guess_board([signs_of(nothing)], "photos")
