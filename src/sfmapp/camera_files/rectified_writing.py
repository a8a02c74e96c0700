"""A rectified pair in the files that other programs read: OpenCV, ROS, Middlebury.

All of these put pixel centres at whole numbers: half a pixel is taken from principal points here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.writing import camera_info, opencv_matrix, terms_of
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.middlebury_calibration import MiddleburyCalibration, write_middlebury
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

_SIDES = ("left", "right")
CAMERA_FILES = ("calib.txt", "rectification.yaml", "left.yaml", "right.yaml")
"""What is written of a rectified pair."""


@dataclass(frozen=True)
class RectifiedCameras:
    """Two cameras before rectification and after it.

    Attributes:
        rig: before, the left one first.
        rotations: (2, 3, 3) rectified from camera.
        focal, cx, cy, doffs: after, pixels, the centre of the first pixel at (0.5, 0.5); doffs is the principal
            point of the right one minus that of the left, along x.
        baseline: distance of the centres, in the unit of the rig.
        size: width and height of the rectified pictures.
        is_metric: that unit is the metre.
    """

    rig: Rig
    rotations: Array
    focal: float
    cx: float
    cy: float
    doffs: float
    baseline: float
    size: tuple[int, int]
    is_metric: bool = True

    def projection(self, side: int) -> Array:
        """(3, 4) of the left (0) or right (1) camera, OpenCV's P1 or P2: of points in the left rectified frame."""
        matrix = np.zeros((3, 4))
        matrix[:, :3] = np.diag([self.focal, self.focal, 1.0])
        matrix[:2, 2] = self.cx + side * self.doffs - 0.5, self.cy - 0.5
        matrix[0, 3] = -side * self.focal * self.baseline
        return matrix

    @property
    def q_matrix(self) -> Array:
        """(4, 4) Q of OpenCV: (x, y, disparity, 1) to homogeneous points of the left rectified frame."""
        q = np.zeros((4, 4))
        q[0, 0] = q[1, 1] = 1.0
        q[:3, 3] = 0.5 - self.cx, 0.5 - self.cy, self.focal
        q[3, 2:] = 1.0 / self.baseline, self.doffs / self.baseline
        return q


def write_rectified_files(folder: Path, cameras: RectifiedCameras) -> Iterator[Path]:
    """Write a rectified pair in every form that can hold it; gives the path of each file.

    ``calib.txt`` is Middlebury's, ``left.yaml`` and ``right.yaml`` are ROS's camera_info (which hold a camera
    before and after), ``rectification.yaml`` has OpenCV's M1, D1, M2, D2, R, T, R1, R2, P1, P2 and Q. The first three
    have lengths in millimetres and metres: of a rig without a unit the last one alone is written.

    Raises:
        InputError: the folder cannot be written.
    """
    texts = [("rectification.yaml", _opencv(cameras))]
    if cameras.is_metric:
        width, height = cameras.size
        path = folder / "calib.txt"
        write_middlebury(path, MiddleburyCalibration(
            float(cameras.focal), float(cameras.cx) - 0.5, float(cameras.cy) - 0.5, float(cameras.doffs),
            float(cameras.baseline), width, height,
        ))  # fmt: skip
        yield path
    else:
        texts.append(("calib.txt", None))
    for side, name in enumerate(_SIDES):
        info = None
        if cameras.is_metric:
            info = camera_info(cameras.rig.cameras[side], name, cameras.rotations[side], cameras.projection(side))
        texts.append((f"{name}.yaml", info))
    for name, text in texts:
        path = folder / name
        if text is None:
            path.unlink(missing_ok=True)  # of an earlier run with another lens, or with metres
            continue
        with replaced_file(path) as beside:
            beside.write_text(text, encoding="utf-8")
        yield path


def _opencv(cameras: RectifiedCameras) -> str | None:
    """None for lenses that OpenCV has no words for."""
    terms = [terms_of(camera) for camera in cameras.rig.cameras]
    width, height = cameras.size
    text = "%YAML:1.0\n---\n"
    for n, (one, camera) in enumerate(zip(terms, cameras.rig.cameras, strict=True), 1):
        if one is None:
            return None
        text += f"image_width_{n}: {camera.width}\nimage_height_{n}: {camera.height}\n"
        text += f"camera_model_{n}: {'fisheye' if one.is_fisheye else 'pinhole'}\n"
        text += (
            f"M{n}: {opencv_matrix(3, 3, one.matrix)}D{n}: {opencv_matrix(1, len(one.coefficients), one.coefficients)}"
        )
    pose = cameras.rig.cam_from_rig[1]
    matrices: list[tuple[str, Array]] = [("R", rigid3.rotation_matrix(pose)), ("T", pose[4:, None])]
    matrices += [(f"R{side + 1}", cameras.rotations[side]) for side in (0, 1)]
    matrices += [(f"P{side + 1}", cameras.projection(side)) for side in (0, 1)]
    for name, matrix in (*matrices, ("Q", cameras.q_matrix)):
        text += f"{name}: {opencv_matrix(len(matrix), matrix.shape[1], matrix.ravel().tolist())}"
    return text + f"rectified_width: {width}\nrectified_height: {height}\n"
