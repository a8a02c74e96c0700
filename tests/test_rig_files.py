"""Rigs in the files of other programs, read by these, or as odometry reads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.reading import read_calibration
from sfmapp.camera_files.rig_writing import write_rig_files
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig

LEFT = Camera(CameraModel.OPENCV, 640, 480, np.array([530.0, 535, 330, 245, -0.28, 0.07, 0.001, -0.0005]))
RIGHT = replace(LEFT, params=LEFT.params * 1.01)
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 800, 600, np.array([300.0, 302, 405, 295, 0.02, -0.01, 0.002, 0.0]))
PLACE = rigid3.from_matrix(rigid3.exp_so3(np.array([0.02, -0.1, 0.01])), np.array([-0.12, 0.003, 0.01]))


def test_a_pair_is_written_for_others_and_read_back(tmp_path: Path) -> None:
    rig = Rig((LEFT, RIGHT), np.array([rigid3.IDENTITY, PLACE]))
    written = {one.name: one for one in write_rig_files(tmp_path, rig, ["left", "right"])}
    for name in ("camchain.yaml", "stereo.yaml"):
        assert written[name].max_px is not None
        assert written[name].max_px < 1e-9
        read = read_calibration(tmp_path / name, [(640, 480), (640, 480)]).rig
        assert read.cam_from_rig[1] == pytest.approx(PLACE, abs=1e-12)
    stored = cv2.FileStorage(str(tmp_path / "stereo.yaml"), cv2.FILE_STORAGE_READ)
    assert stored.getNode("T").mat().ravel() == pytest.approx(PLACE[4:])
    assert stored.getNode("M2").mat()[0, 2] == pytest.approx(RIGHT.params[2] - 0.5)


def test_what_a_program_has_no_words_for_is_not_written(tmp_path: Path) -> None:
    write_rig_files(tmp_path, Rig((LEFT, RIGHT), np.array([rigid3.IDENTITY, PLACE])), ["left", "right"])
    written = write_rig_files(tmp_path, Rig((LEFT, FISHEYE), np.array([rigid3.IDENTITY, PLACE])), ["left", "right"])
    assert not (tmp_path / "stereo.yaml").exists()
    assert [one.reason is None for one in written] == [True, False, True]


def test_colmap_reads_the_rig(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_rig_files(tmp_path, Rig((LEFT, FISHEYE), np.array([rigid3.IDENTITY, PLACE])), ["left", "right"])
    (config,) = pycolmap.read_rig_config(tmp_path / "rig_config.json")
    first, second = config.cameras
    assert first.ref_sensor
    assert second.image_prefix == "right/"
    assert second.cam_from_rig.rotation.quat == pytest.approx(PLACE[:4])
    assert second.cam_from_rig.translation == pytest.approx(PLACE[4:])
    assert second.camera.params == pytest.approx(FISHEYE.params)
