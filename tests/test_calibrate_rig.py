"""``sfmapp calibrate rig`` end to end: rendered photographs of two cameras to a rig that odometry takes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from board_views import board_poses, render_board
from schemas import check_schema
from sfmapp.calibration.boards import parse_board
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import SequenceOptions
from sfmapp.sequences.open import open_sequence

BOARD = parse_board("chessboard:7x5:0.03")
LEFT = Camera(CameraModel.PINHOLE, 480, 360, np.array([400.0, 402.0, 243.0, 177.0]))
RIGHT = Camera(CameraModel.PINHOLE, 480, 360, np.array([390.0, 391.0, 238.0, 181.0]))
PLACE = rigid3.from_matrix(rigid3.exp_so3(np.array([0.01, -0.02, 0.015])), np.array([-0.05, 0.002, 0.004]))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rig")
    poses = board_poses(np.random.default_rng(3), BOARD, 6, LEFT, 35.0)
    for name, camera, mount in (("left", LEFT, rigid3.IDENTITY), ("right", RIGHT, PLACE)):
        (folder / name).mkdir()
        for n, pose in enumerate(poses):
            # one pair was not taken together
            at = rigid3.compose(pose, np.array([0, 0, 0, 1, 0.004, 0, 0])) if (name, n) == ("right", 4) else pose
            picture = render_board(camera, BOARD, rigid3.compose(mount, at), blur_px=0.6, noise=2.0, seed=n)
            cv2.imwrite(str(folder / name / f"{n}.png"), picture)
    return folder


def test_photographs_to_a_rig_that_odometry_takes(photographs: Path, tmp_path: Path) -> None:
    output, held = tmp_path / "out", ",".join(["PINHOLE", *(str(value) for value in RIGHT.params)])
    assert main([
        "calibrate", "rig", str(photographs / "left"), str(photographs / "right"), "-o", str(output), "--board",
        BOARD.text(), "--camera-model", "pinhole", "--camera", "free", "--camera", held, "-q",
    ]) == 0  # fmt: skip
    report = json.loads((output / "report.json").read_text())
    check_schema("calibrate-rig", report)
    rig = report["rig"]
    assert "equal names" in rig["shots"]
    (pair,) = rig["result"]["pairs"]
    away = rigid3.compose(np.array(pair["second_from_first"]), rigid3.inverse(PLACE))
    error = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(away)), away[4:]])
    assert (np.abs(error) < 4.5 * np.sqrt(np.diag(np.array(pair["covariance"])))).all()
    assert pair["epipolar_rms_px"] < 0.15
    assert any("4.png (right) is not used" in warning for warning in rig["result"]["warnings"])
    assert rig["cameras"][1]["sigmas"] == [0.0] * 4
    assert "not used" in next(one for one in rig["photographs"][1]["pictures"] if one["name"] == "4.png")["problem"]
    assert all(one.get("max_px") is None or one["max_px"] < 1e-6 for one in rig["files"])
    assert "<h2>Pairs</h2>" in (output / "report.html").read_text()
    assert (output / "recording.rrd").stat().st_size > 10_000
    for name in ("rig.json", "camchain.yaml", "stereo.yaml"):
        sequence = open_sequence(photographs, SequenceOptions(camera=str(output / name)), Events())
        np.testing.assert_allclose(sequence.rig.cam_from_rig[1], pair["second_from_first"], atol=1e-12)
        np.testing.assert_allclose(sequence.rig.cameras[1].params, RIGHT.params, atol=1e-9)


def test_what_cannot_be_paired_ends_with_a_reason(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    command = ["calibrate", "rig", str(photographs / "left"), "-o", str(tmp_path / "a"), "--board", BOARD.text()]
    assert main(command) == 2
    assert "two cameras" in capsys.readouterr().err
    assert main([*command, "--board", "chess:9x6:0.025"]) == 2
