"""Any lens as scalar kernels: from rays, or from the normalised image plane, to pixels and back, with Jacobians.

A camera is its row of :data:`ROW` numbers: ``fx, fy, cx, cy``, twelve of distortion, and the number of the family that
says what they mean. A family is a module beside this one. It knows the image (x', y') of a ray in units of the focal
lengths, so that the pixel is (fx x' + cx, fy y' + cy), in three kernels:

    project(c, x, y, z) -> (x', y'), NaN where the lens does not look
    unproject(c, x', y') -> unit ray, NaN where there is none
    ray_jacobian(c, x, y, z, J): J[0:2] x' and y', J[2:5] the derivatives of x' by the ray, J[5:8] those of y', then for
        each of the twelve numbers of distortion those of x' and y'. Entries that stay zero are not written.

The two families of ordinary photographs also have kernels on the normalised plane (x, y) = (X/Z, Y/Z), which the
adjustment and the triangulation spend their time in; the others are reached through one call, and compiled once for
all kernels: copies in every kernel that may meet them made a fourth of the machine code of a reconstruction.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import (
    brown,
    division,
    equirectangular,
    eucm,
    fov,
    radial_fisheye,
    rational,
    skew,
    thin_prism_fisheye,
)
from sfmapp.simd.pointers import Pointer
from sfmapp.simd.shared import shared_filler, shared_function

Array = NDArray[np.float64]

# The row of a camera, and the place of the family in it.
ROW, FAMILY = 17, 16
# The families; the first two have kernels on the normalised plane.
BROWN, RADIAL_FISHEYE = 0, 1
RATIONAL, THIN_PRISM_FISHEYE, RAD_TAN_THIN_PRISM_FISHEYE, FOV, DIVISION, EUCM, EQUIRECTANGULAR, SKEW = range(2, 10)
LAST_ON_PLANE = RADIAL_FISHEYE
# Numbers in the row of a Jacobian: the pixel, six derivatives by the ray, two for each of the sixteen parameters.
JACOBIAN = 40

# Cosine of the angle from the axis beyond which the normalised plane is no useful chart: 88 degrees.
NARROW = math.cos(1.536)
# Smallest depth in front of a lens that sees no further.
_NEAREST = 1e-12


# --------------------------------------------------- families but the first two: one compiled copy for all kernels


def _image_by_others(row: Pointer, given: Pointer, out: Pointer) -> None:
    """(x', y') of a ray (x, y, z)."""
    c, x, y, z = numba.carray(row, (ROW,)), given[0], given[1], given[2]
    family = c[FAMILY]
    if family == RATIONAL:
        image = rational.project(c, x, y, z)
    elif family in (THIN_PRISM_FISHEYE, RAD_TAN_THIN_PRISM_FISHEYE):
        image = thin_prism_fisheye.project(c, family == THIN_PRISM_FISHEYE, x, y, z)
    elif family == FOV:
        image = fov.project(c, x, y, z)
    elif family == DIVISION:
        image = division.project(c, x, y, z)
    elif family == EUCM:
        image = eucm.project(c, x, y, z)
    elif family == EQUIRECTANGULAR:
        image = equirectangular.project(x, y, z)
    elif family == SKEW:
        image = skew.project(c, x, y, z)
    else:
        image = math.nan, math.nan
    out[0], out[1] = image


def _ray_by_others(row: Pointer, given: Pointer, out: Pointer) -> None:
    """The unit ray of an image point (x', y')."""
    c, xd, yd = numba.carray(row, (ROW,)), given[0], given[1]
    family = c[FAMILY]
    if family == RATIONAL:
        ray = rational.unproject(c, xd, yd)
    elif family in (THIN_PRISM_FISHEYE, RAD_TAN_THIN_PRISM_FISHEYE):
        ray = thin_prism_fisheye.unproject(c, family == THIN_PRISM_FISHEYE, xd, yd)
    elif family == FOV:
        ray = fov.unproject(c, xd, yd)
    elif family == DIVISION:
        ray = division.unproject(c, xd, yd)
    elif family == EUCM:
        ray = eucm.unproject(c, xd, yd)
    elif family == EQUIRECTANGULAR:
        ray = equirectangular.unproject(xd, yd)
    elif family == SKEW:
        ray = skew.unproject(c, xd, yd)
    else:
        ray = math.nan, math.nan, math.nan
    out[0], out[1], out[2] = ray


def _jacobian_by_others(row: Pointer, given: Pointer, out: Pointer) -> None:
    """The ``ray_jacobian`` of a ray (x, y, z) that has an image; of the rational family any."""
    c, J, x, y, z = numba.carray(row, (ROW,)), numba.carray(out, (JACOBIAN,)), given[0], given[1], given[2]
    family = c[FAMILY]
    if family == RATIONAL:
        rational.ray_jacobian(c, x, y, z, J)
    elif family in (THIN_PRISM_FISHEYE, RAD_TAN_THIN_PRISM_FISHEYE):
        thin_prism_fisheye.ray_jacobian(c, family == THIN_PRISM_FISHEYE, x, y, z, J)
    elif family == FOV:
        fov.ray_jacobian(c, x, y, z, J)
    elif family == DIVISION:
        division.ray_jacobian(c, x, y, z, J)
    elif family == EUCM:
        eucm.ray_jacobian(c, x, y, z, J)
    elif family == EQUIRECTANGULAR:
        equirectangular.ray_jacobian(x, y, z, J)
    elif family == SKEW:
        skew.ray_jacobian(c, x, y, z, J)


_image_elsewhere = shared_function("sfmapp_lens_image", _image_by_others)
_ray_elsewhere = shared_function("sfmapp_lens_ray", _ray_by_others)
_jacobian_elsewhere = shared_filler("sfmapp_lens_jacobian", _jacobian_by_others)

# ------------------------------------------------------------------------------------------------ any of the families


@numba.njit(cache=True, nogil=True)
def _image_of_ray(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """The image (x', y') of a ray by any of the families but the perspective one."""
    if c[FAMILY] == RADIAL_FISHEYE:
        return radial_fisheye.project(c, x, y, z)
    if c[FAMILY] == BROWN:
        return math.nan, math.nan
    xd, yd, _ = _image_elsewhere(c, x, y, z)
    return xd, yd


@numba.njit(cache=True, nogil=True)
def _ray_of_image(c: Array, xd: float, yd: float) -> tuple[float, float, float]:
    """The unit ray of an image point (x', y') by any of the families."""
    if c[FAMILY] == RADIAL_FISHEYE:
        return radial_fisheye.unproject(c, xd, yd)
    if c[FAMILY] != BROWN:
        x, y, z = _ray_elsewhere(c, xd, yd, 0.0)
        return x, y, z
    x, y = brown.undistort(c, xd, yd)
    norm = 1.0 / math.sqrt(x * x + y * y + 1.0)
    return x * norm, y * norm, norm


@numba.njit(cache=True, nogil=True)
def _pixel_of_ray(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    xd, yd = _image_of_ray(c, x, y, z)
    return c[0] * xd + c[2], c[1] * yd + c[3]


@numba.njit(cache=True, nogil=True, inline="always")
def distort(c: Array, x: float, y: float) -> tuple[float, float]:
    """Pixel of the normalised image point (x, y) = (X/Z, Y/Z); c is the row of a camera."""
    if c[FAMILY] > LAST_ON_PLANE:
        u, v = _pixel_of_ray(c, x, y, 1.0)
    elif c[FAMILY] == RADIAL_FISHEYE:
        s = radial_fisheye.stretch(c, math.sqrt(x * x + y * y))
        u, v = c[0] * s * x + c[2], c[1] * s * y + c[3]
    else:
        xd, yd = brown.distort(c, x, y)
        u, v = c[0] * xd + c[2], c[1] * yd + c[3]
    return u, v


@numba.njit(cache=True, nogil=True)
def undistort(c: Array, u: float, v: float) -> tuple[float, float]:
    """Normalised image point of a pixel; NaN where the lens has no inverse, and beyond 88 degrees from its axis."""
    xd = (u - c[2]) / c[0]
    yd = (v - c[3]) / c[1]
    if c[FAMILY] == BROWN:
        return brown.undistort(c, xd, yd)
    if c[FAMILY] == RADIAL_FISHEYE:
        return radial_fisheye.undistort(c, xd, yd)
    x, y, z = _ray_of_image(c, xd, yd)
    if not z > NARROW:
        return math.nan, math.nan
    return x / z, y / z


@numba.njit(cache=True, nogil=True)
def project(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel of a ray, or point in the camera's frame; NaN where the lens does not look."""
    if z > _NEAREST and c[FAMILY] <= LAST_ON_PLANE:
        return distort(c, x / z, y / z)
    return _pixel_of_ray(c, x, y, z)


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, u: float, v: float) -> tuple[float, float, float]:
    """Unit ray of a pixel; NaN where the lens has no inverse."""
    return _ray_of_image(c, (u - c[2]) / c[0], (v - c[3]) / c[1])


@numba.njit(cache=True, nogil=True)
def project_jacobian(c: Array, x: float, y: float, z: float, J: Array) -> None:
    """Fill J (40,): the pixel of a ray, the derivatives of u by the ray and those of v, and for each of the sixteen
    numbers ``fx, fy, cx, cy`` and distortion those of u and v. NaN where :func:`project` is."""
    for k in range(JACOBIAN):
        J[k] = 0.0
    family = c[FAMILY]
    if family == BROWN:
        if not z > _NEAREST:
            J[0] = J[1] = math.nan
            return
        iz = 1.0 / z
        p, q = x * iz, y * iz
        J[0], J[1], a, b, d, J[8], J[9], J[10], J[11], J[12], J[13], J[14], J[15] = brown.jacobian(c, p, q)
        J[2], J[3], J[4] = a * iz, b * iz, -(a * p + b * q) * iz
        J[5], J[6], J[7] = b * iz, d * iz, -(b * p + d * q) * iz
    else:
        if family != RATIONAL:  # whose derivatives know where it has an image
            J[0], J[1] = _image_of_ray(c, x, y, z)
        if math.isnan(J[0]):
            return
        if family == RADIAL_FISHEYE:
            radial_fisheye.ray_jacobian(c, x, y, z, J)
        else:
            _jacobian_elsewhere(c, x, y, z, J)
            if math.isnan(J[0]):
                return
    xd, yd, fx, fy = J[0], J[1], c[0], c[1]
    for k in range(15, 3, -1):  # from behind, for the four first make room
        J[8 + 2 * k], J[9 + 2 * k] = fx * J[2 * k], fy * J[2 * k + 1]
    # a skew in pixels counts in what the focal length multiplies
    J[8], J[9], J[10], J[11] = (xd - c[4] / fx * yd if family == SKEW else xd), 0.0, 0.0, yd
    J[12], J[13], J[14], J[15] = 1.0, 0.0, 0.0, 1.0
    for k in range(3):
        J[2 + k] *= fx
        J[5 + k] *= fy
    J[0], J[1] = fx * xd + c[2], fy * yd + c[3]


@numba.njit(cache=True, nogil=True)
def unproject_jacobian(c: Array, u: float, v: float, J: Array, by_pixel: Array, by_params: Array) -> None:
    """Derivatives of the unit ray of a pixel by the pixel, (3, 2), and by the sixteen parameters, (3, 16).

    They are those of the projection turned round on the tangent plane of the ray; J (40,) is scratch.
    """
    x, y, z = unproject(c, u, v)
    project_jacobian(c, x, y, z, J)
    # the projection does not see the length of the ray: with rows p and q of its derivative, which are at right angles
    # to the ray, the inverse on the tangent plane has the columns q x ray and ray x p over p x q . ray
    px, py, pz, qx, qy, qz = J[2], J[3], J[4], J[5], J[6], J[7]
    det = (py * qz - pz * qy) * x + (pz * qx - px * qz) * y + (px * qy - py * qx) * z
    by_pixel[0, 0], by_pixel[1, 0], by_pixel[2, 0] = (
        (qy * z - qz * y) / det, (qz * x - qx * z) / det, (qx * y - qy * x) / det,
    )  # fmt: skip
    by_pixel[0, 1], by_pixel[1, 1], by_pixel[2, 1] = (
        (y * pz - z * py) / det, (z * px - x * pz) / det, (x * py - y * px) / det,
    )  # fmt: skip
    for k in range(16):
        for a in range(3):
            by_params[a, k] = -by_pixel[a, 0] * J[8 + 2 * k] - by_pixel[a, 1] * J[9 + 2 * k]


@numba.njit(cache=True, nogil=True, inline="always")
def across_seam(c: Array, du: float) -> float:
    """A difference of two pixels' u the short way round: a panorama's left and right borders are one line."""
    if c[FAMILY] == EQUIRECTANGULAR:
        width = 2.0 * math.pi * c[0]
        du -= width * math.floor(du / width + 0.5)
    return du
