"""``sfmapp calibrate board VIDEO``: a filmed board to a camera, with the reason for every frame."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from board_views import filmed_board
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.comparison import projection_difference
from sfmapp.calibration.file import read_calibration_file
from sfmapp.calibration.uncertainty import projection_sigma
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main

BOARD = parse_board("charuco:6x5:0.03:0.022")
# an action camera: barrel distortion
CAMERA = Camera(CameraModel.OPENCV, 400, 300, np.array([230.0, 231.0, 203.0, 148.0, -0.24, 0.045, 5e-4, -4e-4]))
NUM_FRAMES, BLURRED = 36, range(12, 17)


def test_a_filmed_board_calibrates_the_camera_that_filmed_it(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    film = tmp_path / "board.mp4"
    writer = cv2.VideoWriter(str(film), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (400, 300))
    for frame in filmed_board(CAMERA, BOARD, NUM_FRAMES, set(BLURRED), seed=2):
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    # of another program, another camera or an earlier try: it is not asked for
    (tmp_path / "calibration.json").write_text("{}")
    output = tmp_path / "out"
    assert main(["calibrate", "board", str(film), "-o", str(output), "--no-recording"]) == 0
    board = json.loads((output / "report.json").read_text())["board"]
    assert board["board"].startswith("charuco:6x5:1:")
    # every frame says why it counts or does not, and those that were moved are not among those that do
    rows = {row["name"]: row for row in board["pictures"]}
    assert len(rows) == NUM_FRAMES
    assert all((row.get("picked") is None) != (row.get("unused") is None) for row in rows.values())
    picked = [name for name, row in rows.items() if row.get("picked")]
    assert 8 <= len(picked) <= 30
    assert not {f"{n:06d}" for n in BLURRED[1:-1]} & set(picked)
    assert any("blurred" in str(row.get("unused")) or "no markers" in str(row.get("unused")) for row in rows.values())
    # a frame that shows what another shows is no fault
    page = (output / "report.html").read_text()
    for row in rows.values():
        light = (
            "grey" if row.get("like") else "red" if row.get("unused") else "amber" if row.get("problem") else "green"
        )
        assert f'<td class="t {light}">{row["name"]}</td>' in page
    assert any(row.get("like") for row in rows.values())
    made = read_calibration_file(output)
    xy, off, _ = projection_difference(CAMERA, made.camera)
    sigma = projection_sigma(made, xy)
    assert np.sqrt(np.nanmean((off**2).sum(1) / (2.0 * sigma**2))) < 1.5
    # where boards were; the corners of the picture are as uncertain as they are said to be
    assert np.nanmedian(np.hypot(*off.T)) < 0.015
    assert "sigma of a projection" in capsys.readouterr().out
