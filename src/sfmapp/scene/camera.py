"""Cameras: models, parameters, projection and its inverse.

Models and the order of their parameters are COLMAP's. Inside kernels a camera is a row of eight numbers,
``fx, fy, cx, cy, d0, d1, d2, d3``, and a flag: perspective models use d = k1, k2, p1, p2 (Brown 1966 as in OpenCV),
the fisheye model d = k1..k4 (Kannala and Brandt, PAMI 2006). Pixels follow the house rule: the centre of the top-left
pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

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
        focal_source: where the focal prior comes from: ``user``, ``exif_35mm``, ``exif_sensor``, ``default`` or ``file``.
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
        """(8,) float64 ``fx, fy, cx, cy, d0..d3``: the form that the kernels take."""
        return canonical_from_params(self.model) @ self.params

    @property
    def is_fisheye(self) -> bool:
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
    """(8, P) matrix of zeros and ones that spreads a model's parameters over the canonical eight."""
    names = PARAM_NAMES[model]
    matrix = np.zeros((8, len(names)))
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


@numba.njit(cache=True, nogil=True, inline="always")
def distort(fisheye: bool, c: Array, x: float, y: float) -> tuple[float, float]:
    """Pixel of the normalised image point (x, y) = (X/Z, Y/Z); c is a canonical row."""
    if fisheye:
        r = math.sqrt(x * x + y * y)
        if r < 1e-8:
            s = 1.0
        else:
            theta = math.atan(r)
            t2 = theta * theta
            s = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) / r
        return c[0] * s * x + c[2], c[1] * s * y + c[3]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c[4] + r2 * c[5])
    u = x * radial + 2.0 * c[6] * x * y + c[7] * (r2 + 2.0 * x * x)
    v = y * radial + 2.0 * c[7] * x * y + c[6] * (r2 + 2.0 * y * y)
    return c[0] * u + c[2], c[1] * v + c[3]


@numba.njit(cache=True, nogil=True)
def undistort(fisheye: bool, c: Array, u: float, v: float) -> tuple[float, float]:
    """Normalised image point of a pixel, NaN where the lens polynomial has no inverse there."""
    xd = (u - c[2]) / c[0]
    yd = (v - c[3]) / c[1]
    if c[4] == 0.0 and c[5] == 0.0 and c[6] == 0.0 and c[7] == 0.0 and not fisheye:
        return xd, yd
    if fisheye:
        rd = math.sqrt(xd * xd + yd * yd)
        if rd < 1e-8:
            return xd, yd
        theta = min(rd, 1.5)
        for _ in range(20):
            t2 = theta * theta
            value = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) - rd
            slope = 1.0 + t2 * (3.0 * c[4] + t2 * (5.0 * c[5] + t2 * (7.0 * c[6] + t2 * 9.0 * c[7])))
            if slope <= 1e-6:
                return math.nan, math.nan
            step = value / slope
            theta -= step
            if abs(step) < 1e-13:
                break
        # beyond 88 degrees the normalised plane is no useful chart
        if theta <= 0.0 or theta > 1.536:
            return math.nan, math.nan
        scale = math.tan(theta) / rd
        return xd * scale, yd * scale
    x, y = xd, yd
    for _ in range(50):  # Newton on the two equations of the Brown model
        r2 = x * x + y * y
        radial = 1.0 + r2 * (c[4] + r2 * c[5])
        slope = 2.0 * (c[4] + 2.0 * r2 * c[5])
        e0 = x * radial + 2.0 * c[6] * x * y + c[7] * (r2 + 2.0 * x * x) - xd
        e1 = y * radial + 2.0 * c[7] * x * y + c[6] * (r2 + 2.0 * y * y) - yd
        a = radial + x * x * slope + 2.0 * c[6] * y + 6.0 * c[7] * x
        b = x * y * slope + 2.0 * c[6] * x + 2.0 * c[7] * y
        d = radial + y * y * slope + 2.0 * c[7] * x + 6.0 * c[6] * y
        det = a * d - b * b
        # past the fold of the polynomial the map is not one to one
        if det <= 1e-9:
            return math.nan, math.nan
        dx = (d * e0 - b * e1) / det
        dy = (a * e1 - b * e0) / det
        x -= dx
        y -= dy
        if dx * dx + dy * dy < 1e-26:
            return x, y
    return math.nan, math.nan


@numba.njit(cache=True, nogil=True)
def _undistort_all(fisheye: bool, c: Array, xy: Array, out: Array) -> None:
    for i in range(xy.shape[0]):
        out[i, 0], out[i, 1] = undistort(fisheye, c, xy[i, 0], xy[i, 1])


@numba.njit(cache=True, nogil=True)
def _project_all(fisheye: bool, c: Array, xyz: Array, out: Array) -> None:
    for i in range(xyz.shape[0]):
        z = xyz[i, 2]
        if z > 1e-12:
            out[i, 0], out[i, 1] = distort(fisheye, c, xyz[i, 0] / z, xyz[i, 1] / z)
        else:
            out[i, 0] = out[i, 1] = math.nan


def pixels_to_normalized(camera: Camera, xy: ArrayLike) -> Array:
    """Normalised image points (N, 2) float64, ``(X/Z, Y/Z)``, of pixels (N, 2); NaN where the lens has no inverse."""
    xy = np.ascontiguousarray(xy, np.float64)
    out = np.empty_like(xy)
    _undistort_all(camera.is_fisheye, camera.canonical, xy, out)
    return out


def project(camera: Camera, xyz_cam: ArrayLike) -> Array:
    """Pixels (N, 2) float64 of points (N, 3) in the camera's frame; NaN behind the camera."""
    xyz = np.ascontiguousarray(xyz_cam, np.float64)
    out = np.empty((len(xyz), 2))
    _project_all(camera.is_fisheye, camera.canonical, xyz, out)
    return out
