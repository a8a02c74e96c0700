"""Cameras: models, parameters, projection and its inverse.

Models and the order of their parameters are COLMAP's. Inside kernels a camera is the canonical row of
:mod:`sfmapp.camera.lens`. Pixels follow COLMAP's convention: the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera import lens
from sfmapp.camera.lens import FAMILY, ROW
from sfmapp.camera.models import PARAM_NAMES, canonical_from_params, family_of, kind_of, plain_params
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]

# Places along each side of a picture where it is asked how far a lens sees.
_WIDE_STEPS = 17


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
        prior_covariance: (P, P) of the prior of all parameters, up to a factor: it is as wide as ``focal_sigma`` has
            it. None: the prior is of the focal length alone. Rows of parameters that were held are 0.
    """

    model: CameraModel
    width: int
    height: int
    params: Array
    focal_sigma: float | None = None
    focal_source: str = "default"
    is_fixed: bool = False
    prior_covariance: Array | None = None

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
    def focal_variance(self) -> float:
        """Of the mean focal length by ``prior_covariance``, in square pixels; 0 without one."""
        if self.prior_covariance is None:
            return 0.0
        share = np.array([kind_of(name) == "focal" for name in PARAM_NAMES[self.model]], np.float64)
        share /= max(share.sum(), 1.0)
        return float(share @ self.prior_covariance @ share)

    @property
    def canonical(self) -> Array:
        """(17,) float64 ``fx, fy, cx, cy``, twelve of distortion and the family: the row that the kernels take."""
        return self._canonical.copy()

    @cached_property
    def _canonical(self) -> Array:
        row = np.zeros(ROW)
        row[:FAMILY] = canonical_from_params(self.model) @ self.params
        row[FAMILY] = family_of(self.model)
        return row

    @property
    def k_matrix(self) -> Array:
        """(3, 3) calibration matrix, without the distortion."""
        fx, fy, cx, cy = self.canonical[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def with_params(self, params: ArrayLike) -> Camera:
        """The same camera with other parameters."""
        return replace(self, params=np.asarray(params, np.float64))

    def with_focal(self, focal: float) -> Camera:
        """The same camera with another mean focal length in pixels; the aspect ratio stays. A panorama has none."""
        is_focal = np.array([kind_of(name) == "focal" for name in PARAM_NAMES[self.model]])
        return replace(self, params=np.where(is_focal, self.params * focal / self.focal, self.params))

    def with_canonical(self, row: Array) -> Camera:
        """The same camera with the parameters that its model has among those of a canonical row (17,)."""
        first = canonical_from_params(self.model).argmax(axis=0)
        return self.with_params(self.params if self.model == CameraModel.EQUIRECTANGULAR else row[first])

    @property
    def family(self) -> int:
        """Number of the family of lenses in :mod:`sfmapp.camera.lens`."""
        return family_of(self.model)

    @cached_property
    def is_wide(self) -> bool:
        """Whether the picture shows what lies more than 88 degrees off the axis, where there is no normalised plane."""
        if self.family in (lens.BROWN, lens.RATIONAL, lens.SKEW):
            return False
        steps = np.linspace(0.0, 1.0, _WIDE_STEPS)
        xy = np.stack(np.meshgrid(steps * self.width, steps * self.height), axis=-1).reshape(-1, 2)
        # False for NaN, in the corners that a circular picture leaves black
        return bool((pixels_to_rays(self, xy)[:, 2] <= lens.NARROW).any())

    @property
    def is_pinhole(self) -> bool:
        """Whether pixels are those of a pinhole with square corners, whatever the model."""
        is_perspective = self.family in (lens.BROWN, lens.RATIONAL, lens.DIVISION, lens.SKEW)
        return is_perspective and not self.canonical[4:FAMILY].any()


def simple_camera(
    model: CameraModel, width: int, height: int, focal: float, focal_sigma: float | None = None, source: str = "default"
) -> Camera:
    """A camera of any model with one focal length in pixels, a centred principal point and no distortion."""
    return Camera(model, width, height, plain_params(model, width, height, focal), focal_sigma, source)


@numba.njit(cache=True, nogil=True)
def _undistort_all(c: Array, xy: Array, out: Array) -> None:
    for i in range(xy.shape[0]):
        out[i, 0], out[i, 1] = lens.undistort(c, xy[i, 0], xy[i, 1])


@numba.njit(cache=True, nogil=True)
def _project_all(c: Array, xyz: Array, out: Array) -> None:
    for i in range(xyz.shape[0]):
        out[i, 0], out[i, 1] = lens.project(c, xyz[i, 0], xyz[i, 1], xyz[i, 2])


@numba.njit(cache=True, nogil=True)
def _unproject_all(c: Array, xy: Array, out: Array) -> None:
    for i in range(xy.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = lens.unproject(c, xy[i, 0], xy[i, 1])


@numba.njit(cache=True, nogil=True)
def _project_jacobians(c: Array, xyz: Array, out: Array) -> None:
    for i in range(xyz.shape[0]):
        lens.project_jacobian(c, xyz[i, 0], xyz[i, 1], xyz[i, 2], out[i])


def pixels_to_normalized(camera: Camera, xy: ArrayLike) -> Array:
    """Normalised image points (N, 2) float64, ``(X/Z, Y/Z)``, of pixels (N, 2).

    NaN where the lens has no inverse, and more than 88 degrees off its axis: :func:`pixels_to_rays` has no such limit.
    """
    xy = np.ascontiguousarray(xy, np.float64)
    out = np.empty_like(xy)
    _undistort_all(camera.canonical, xy, out)
    return out


def pixels_to_rays(camera: Camera, xy: ArrayLike) -> Array:
    """Unit rays (N, 3) float64 in the camera's frame of pixels (N, 2); NaN where the lens has no inverse."""
    xy = np.ascontiguousarray(xy, np.float64)
    out = np.empty((len(xy), 3))
    _unproject_all(camera.canonical, xy, out)
    return out


def bearings(cameras: Sequence[Camera], pixels: Sequence[ArrayLike]) -> list[Array]:
    """What poses are estimated from, of pixels (N, 2) each: normalised image points (N, 2), or unit rays (N, 3) of all
    where one of the cameras is wide. NaN where the lens has no inverse."""
    find = pixels_to_rays if any(camera.is_wide for camera in cameras) else pixels_to_normalized
    return [find(camera, xy) for camera, xy in zip(cameras, pixels, strict=True)]


def project(camera: Camera, xyz_cam: ArrayLike) -> Array:
    """Pixels (N, 2) float64 of points (N, 3) in the camera's frame; NaN where the lens does not look."""
    xyz = np.ascontiguousarray(xyz_cam, np.float64)
    out = np.empty((len(xyz), 2))
    _project_all(camera.canonical, xyz, out)
    return out


def project_jacobian(camera: Camera, xyz_cam: ArrayLike) -> tuple[Array, Array, Array]:
    """Pixels (N, 2) of points (N, 3) in the camera's frame, their derivatives by the points (N, 2, 3), and by the
    parameters of the camera (N, 2, P); NaN where the lens does not look."""
    xyz = np.ascontiguousarray(xyz_cam, np.float64)
    out = np.empty((len(xyz), lens.JACOBIAN))
    _project_jacobians(camera.canonical, xyz, out)
    by_slots = out[:, 8:].reshape(len(xyz), FAMILY, 2).swapaxes(1, 2)
    return out[:, :2], out[:, 2:8].reshape(-1, 2, 3), by_slots @ canonical_from_params(camera.model)
