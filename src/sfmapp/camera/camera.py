"""Cameras: models, parameters, projection and its inverse.

Models and the order of their parameters are COLMAP's. Inside kernels a camera is the canonical row of
:mod:`sfmapp.camera.lens`. Pixels follow COLMAP's convention: the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera.lens import BROWN, FAMILY, RADIAL_FISHEYE, ROW, distort, undistort

Array = NDArray[np.float64]


class CameraModel(IntEnum):
    """COLMAP's camera models, with COLMAP's ids."""

    SIMPLE_PINHOLE = 0
    PINHOLE = 1
    SIMPLE_RADIAL = 2
    RADIAL = 3
    OPENCV = 4
    OPENCV_FISHEYE = 5


PARAM_NAMES: dict[CameraModel, tuple[str, ...]] = {
    CameraModel.SIMPLE_PINHOLE: ("f", "cx", "cy"),
    CameraModel.PINHOLE: ("fx", "fy", "cx", "cy"),
    CameraModel.SIMPLE_RADIAL: ("f", "cx", "cy", "k1"),
    CameraModel.RADIAL: ("f", "cx", "cy", "k1", "k2"),
    CameraModel.OPENCV: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    CameraModel.OPENCV_FISHEYE: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}

_CANONICAL_SLOT = {
    "f": (0, 1), "fx": (0,), "fy": (1,), "cx": (2,), "cy": (3,),
    "k1": (4,), "k2": (5,), "p1": (6,), "p2": (7,), "k3": (6,), "k4": (7,),
}  # fmt: skip


@dataclass(frozen=True)
class Camera:
    """Intrinsics shared by one or more images.

    Attributes:
        model: one of :class:`CameraModel`.
        width, height: image size in pixels.
        params: (P,) float64, in the order of ``PARAM_NAMES[model]``; focal lengths and centres in pixels.
        focal_sigma: standard deviation of the focal prior in pixels; None if the focal is not known a priori at all.
        focal_source: where the focal prior comes from: ``user``, ``exif_35mm``, ``exif_sensor``, ``default``, ``file``.
        is_fixed: the user has said that the parameters may not change.
    """

    model: CameraModel
    width: int
    height: int
    params: Array
    focal_sigma: float | None = None
    focal_source: str = "default"
    is_fixed: bool = False

    def __post_init__(self) -> None:
        params = np.array(self.params, np.float64)
        if params.shape != (len(PARAM_NAMES[self.model]),):
            raise ValueError(f"{self.model.name} has {len(PARAM_NAMES[self.model])} parameters, got {params.shape}")
        params.setflags(write=False)
        object.__setattr__(self, "params", params)

    @property
    def focal(self) -> float:
        """Mean focal length in pixels."""
        return float(self.canonical[:2].mean())

    @property
    def canonical(self) -> Array:
        """(17,) float64 ``fx, fy, cx, cy``, twelve of distortion and the family: the row that the kernels take."""
        row = np.zeros(ROW)
        row[:FAMILY] = canonical_from_params(self.model) @ self.params
        row[FAMILY] = RADIAL_FISHEYE if self.is_fisheye else BROWN
        return row

    @property
    def is_fisheye(self) -> bool:
        """Its coefficients are of the angle from the axis."""
        return self.model == CameraModel.OPENCV_FISHEYE

    @property
    def k_matrix(self) -> Array:
        """(3, 3) calibration matrix, without the distortion."""
        fx, fy, cx, cy = self.canonical[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def with_params(self, params: ArrayLike) -> Camera:
        """The same camera with other parameters."""
        return replace(self, params=np.asarray(params, np.float64))

    def with_focal(self, focal: float) -> Camera:
        """The same camera with another mean focal length in pixels; the aspect ratio stays."""
        is_focal = np.array([name in ("f", "fx", "fy") for name in PARAM_NAMES[self.model]])
        return replace(self, params=np.where(is_focal, self.params * focal / self.focal, self.params))


def canonical_from_params(model: CameraModel) -> Array:
    """(16, P) matrix of zeros and ones that spreads a model's parameters over the canonical sixteen."""
    names = PARAM_NAMES[model]
    matrix = np.zeros((FAMILY, len(names)))
    for column, name in enumerate(names):
        for row in _CANONICAL_SLOT[name]:
            matrix[row, column] = 1.0
    return matrix


def simple_camera(
    model: CameraModel, width: int, height: int, focal: float, focal_sigma: float | None = None, source: str = "default"
) -> Camera:
    """A camera of any model with one focal length in pixels, a centred principal point and no distortion."""
    values = {"f": focal, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
    params = np.array([values.get(name, 0.0) for name in PARAM_NAMES[model]])
    return Camera(model, width, height, params, focal_sigma, source)


@numba.njit(cache=True, nogil=True)
def _undistort_all(c: Array, xy: Array, out: Array) -> None:
    for i in range(xy.shape[0]):
        out[i, 0], out[i, 1] = undistort(c, xy[i, 0], xy[i, 1])


@numba.njit(cache=True, nogil=True)
def _project_all(c: Array, xyz: Array, out: Array) -> None:
    for i in range(xyz.shape[0]):
        z = xyz[i, 2]
        if z > 1e-12:
            out[i, 0], out[i, 1] = distort(c, xyz[i, 0] / z, xyz[i, 1] / z)
        else:
            out[i, 0] = out[i, 1] = math.nan


def pixels_to_normalized(camera: Camera, xy: ArrayLike) -> Array:
    """Normalised image points (N, 2) float64, ``(X/Z, Y/Z)``, of pixels (N, 2); NaN where the lens has no inverse."""
    xy = np.ascontiguousarray(xy, np.float64)
    out = np.empty_like(xy)
    _undistort_all(camera.canonical, xy, out)
    return out


def project(camera: Camera, xyz_cam: ArrayLike) -> Array:
    """Pixels (N, 2) float64 of points (N, 3) in the camera's frame; NaN behind the camera."""
    xyz = np.ascontiguousarray(xyz_cam, np.float64)
    out = np.empty((len(xyz), 2))
    _project_all(camera.canonical, xyz, out)
    return out
