"""``sfmapp calibrate board`` end to end: rendered photographs to a camera that other commands take."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from board_views import board_poses, render_board
from schemas import check_schema
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.detection import Detection
from sfmapp.calibration.file import read_calibration_file
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.events import Events
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.sequence import SequenceOptions
from sfmapp.pipelines.calibration.pictures import BoardPicture, choose_frames
from sfmapp.sequences.open import open_sequence

BOARD = parse_board("chessboard:9x6:0.025")
CAMERA = Camera(CameraModel.OPENCV, 560, 420, np.array([450.0, 452.0, 283.0, 207.0, -0.2, 0.05, 1e-3, -5e-4]))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    for n, pose in enumerate(board_poses(np.random.default_rng(1), BOARD, 8, CAMERA, 40.0)):
        cv2.imwrite(str(folder / f"{n}.png"), render_board(CAMERA, BOARD, pose, blur_px=0.6, noise=2.0, seed=n))
    cv2.imwrite(str(folder / "small.png"), np.full((100, 200), 128, np.uint8))
    cv2.imwrite(str(folder / "wall.png"), np.full((420, 560), 128, np.uint8))
    return folder


def test_photographs_to_a_camera_that_commands_take(photographs: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    assert main([
        "calibrate", "board", str(photographs), "-o", str(output), "--board", BOARD.text(),
        "--camera-model", "opencv", "-q",
    ]) == 0  # fmt: skip
    made = read_calibration_file(output)
    assert (np.abs(made.camera.params - CAMERA.params) < 4.5 * made.sigmas).all()
    assert np.abs(made.camera.params - CAMERA.params)[:4].max() < 1.5
    report = json.loads((output / "report.json").read_text())
    check_schema("calibrate-board", report)
    check_schema("calibration", json.loads((output / "calibration.json").read_text()))
    rows = {row["name"]: row for row in report["board"]["pictures"]}
    assert "200x100" in rows["small.png"]["unused"]
    assert "no corners" in rows["wall.png"]["unused"]
    assert all(one.get("max_px") is None or one["max_px"] < 1e-6 for one in report["board"]["files"])
    # the others read it
    options = ImageOptions(camera=str(output / "calibration.json"))
    images, _ = load_images(str(photographs / "[0-9].png"), options, Events())
    np.testing.assert_array_equal(images.cameras[0].params, made.camera.params)
    for name in ("calibration.json", "cameras.txt", "opencv.yaml", "camchain.yaml", "camera_info.yaml"):
        sequence = open_sequence(str(photographs / "[0-9].png"), SequenceOptions(camera=str(output / name)), Events())
        np.testing.assert_allclose(sequence.rig.cameras[0].params, made.camera.params, atol=1e-9)


def test_what_is_no_board_ends_with_a_reason(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    command = ["calibrate", "board", str(photographs / "wal*.png"), "-o", str(tmp_path / "a"), "--board"]
    assert main([*command, BOARD.text()]) == 3
    assert "found none in 1" in capsys.readouterr().err
    assert main([*command, "chess:9x6:0.025"]) == 2


def test_frames_are_picked_that_differ_and_are_sharp() -> None:
    points = BOARD.points[:, :2] * 1000.0

    def picture(n: int, shift: float, width: float = 2.0) -> BoardPicture:
        return BoardPicture(f"{n:06d}", Detection(np.arange(54), points + np.array([100.0 + shift, 100.0]), width))

    chosen = choose_frames(
        [picture(0, 0.0), picture(1, 2.0), picture(2, 200.0), picture(3, 300.0, 9.0)], (640, 480), BOARD
    )
    assert [one.unused is None for one in chosen] == [True, False, True, False]
    assert "like frame 000000" in str(chosen[1].unused)
    assert [one.like for one in chosen] == [None, "000000", None, None]
    assert "blurred" in str(chosen[3].unused)


def test_a_board_that_nobody_named_is_told_from_the_photographs(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    output = tmp_path / "out"
    command = ["calibrate", "board", str(photographs), "-o", str(output), "--camera-model", "opencv", "--no-recording"]
    assert main(command) == 0
    report = json.loads((output / "report.json").read_text())
    check_schema("calibrate-board", report)
    board = report["board"]
    assert (board["board"], board["unit"]) == ("chessboard:9x6:1", "squares")
    assert board["guess"]["is_sure"]
    assert board["guess"]["num_agree"] >= 3
    assert board["guess"]["num_other"] == 0
    made = read_calibration_file(output)
    assert (np.abs(made.camera.params - CAMERA.params) < 4.5 * made.sigmas).all()
    assert "lengths in squares" in capsys.readouterr().out
    assert main(["calibrate", "board", str(photographs / "wal*.png"), "-o", str(tmp_path / "wall")]) == 3
    assert "no markers, no chessboard, no grid of circles" in capsys.readouterr().err
