"""Kernels of the adjustment: linearise, eliminate the points, substitute back.

Layout. An unknown block is a row of up to eight numbers: the six of a pose (rotation, then translation, of
``x_cam <- exp(w) x_cam + v``), followed by at most two intrinsics where a camera takes part through one image only; or
the free intrinsics of a camera that several images share; those beyond the eighth are a second block right behind it.
Blocks meet in 8 x 8 tiles. Points are eliminated one by one (Triggs et al., "Bundle Adjustment: A Modern Synthesis",
1999, section 6.1) from the factor ``L L^T`` of their damped 3 x 3 normal matrix: with Z = W L^-T the reduced system
loses Z_a Z_b^T per pair of blocks. Those that other factors mention are blocks of three instead, behind all others.

A pose may be that of a rig which several images share: each has its own row of what the rig's pose and the constant
mounting of its camera make together, and the derivatives are taken to the rig's frame.

Points come in batches whose Z have room, and a batch in chunks whose number depends on the problem alone; each chunk
has its own sums over blocks, which are added in order. The products Z_a Z_b^T are then taken row by row of tiles, each
row by one thread, over its points in order (:mod:`sfmapp.adjust.elimination`). So the result does not depend on the
number of threads, and no thread needs tiles of its own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import brown, radial_fisheye
from sfmapp.camera.lens import (
    FAMILY,
    LAST_ON_PLANE,
    RADIAL_FISHEYE,
    ROW,
    across_seam,
    distort,
    project,
    project_jacobian,
)
from sfmapp.simd.f64x8 import add2, assign3, spread, store8, subtract3
from sfmapp.simd.pointers import Pointer, offset, pointer

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]

# The numbers by which kernels know the losses.
LOSS_IDS: dict[str, int] = {"trivial": 0, "huber": 1, "cauchy": 2}

# Offsets in the scratch row of one observation: two rows each of pose (and merged intrinsics); canonical intrinsics,
# interleaved; free intrinsics, those of the first block and of the second; and point, with the residual in the fourth
# place.
POSE, CANON, INTR, POINT, SCRATCH = 0, 16, 48, 80, 96
_SECOND = INTR + 16
# What one chunk needs besides, in doubles: the scratch row, the point's normal equations and its eliminator.
_NORMAL, _SMALL, _ZEROS, _FIXED = 96, 120, 144, 160
# Smallest depth that counts as in front of the camera, relative to the distance.
_MIN_COS = 1e-6


class RobustLoss(NamedTuple):
    """A loss on squared residuals: its number among LOSS_IDS, and the squared residual at which it begins to bend."""

    kind: int
    scale2: float


class PointArrays(NamedTuple):
    """Points (P) and their observations (O), those of point p at ``ptr[p] : ptr[p + 1]``.

    Attributes:
        ptr: (P + 1,) int64. image: (O,) int32 positions among the images. xy: (O, 2) pixels.
        xyz: (P, 3). is_constant: (P,) bool, points that do not move.
        block: (P,) int32 the block of a point that is not eliminated, -1 for all others.
    """

    ptr: Ints
    image: Int32s
    xy: Array
    xyz: Array
    is_constant: NDArray[np.bool_]
    block: Int32s


class ImageArrays(NamedTuple):
    """Images (I).

    Attributes:
        rows: (I, 12) rotation row by row and translation of cam_from_world.
        mount: (I,) int32 row in mounts (M, 12), cam_from_rig; -1 where the image's pose is that of its block.
        mounts: (M, 12). camera: (I,) int32. block: (I,) int32 block of its pose, -1 where that is constant.
    """

    rows: Array
    mount: Int32s
    mounts: Array
    camera: Int32s
    block: Int32s


class LensArrays(NamedTuple):
    """Cameras (C).

    Attributes:
        canonical: (C, ROW), see ``Camera.canonical``. penalty: (C,) squared residual of what is behind.
        block: (C,) int32 block that holds the free intrinsics, -1 where constant. second: (C,) int32 the one with those
            beyond the eighth, right behind it, -1 where there are none.
        free_ptr, free_slot, free_column: for camera c in ``free_ptr[c] : free_ptr[c + 1]`` canonical slot and column
            in the block, from 8 on that of the second one.
    """

    canonical: Array
    penalty: Array
    block: Int32s
    second: Int32s
    free_ptr: Ints
    free_slot: Ints
    free_column: Ints


class Sums(NamedTuple):
    """What the points of a chunk add up to, beside what eliminating them takes off the tiles.

    Attributes:
        own: (B * 64,) J^T J of each block with itself, not eliminated.
        cross: (I * 64,) J_pose^T J_intrinsics of images whose camera has a block of its own. Where a camera has a
            second one ((2 I + C) * 64,): behind it the same of that, and J_first^T J_second of each camera.
        gradient: (2 * B * 8,) J^T r before elimination, and what elimination adds to it.
    """

    own: Array
    cross: Array
    gradient: Array


class State(NamedTuple):
    """What may change: rows (I, 12) of the images, canonical rows (C, ROW) of the cameras, and points (P, 3)."""

    rows: Array
    canonical: Array
    xyz: Array


class Meetings(NamedTuple):
    """Which blocks (B) meet in each point: entries (E), those of point p at ``ptr[p] : ptr[p + 1]``, ascending.

    Attributes:
        dim: (B,) int64 rows in use of each block. ptr: (P + 1,) int64. block: (E,) int32.
        partners: (E, 2) int32 first and last of the entries of the same point with which this one makes a product.
    """

    dim: Ints
    ptr: Ints
    block: Int32s
    partners: Int32s


class Scratch(NamedTuple):
    """Room of :func:`scratch_size`, of any content."""

    doubles: Array
    integers: Ints


@numba.njit(cache=True, nogil=True, error_model="numpy")
def robust_weight(loss: RobustLoss, s: float) -> float:
    """rho'(s), the weight of a squared residual s (Holland and Welsch 1977).

    Triggs's second-order term is left out, as in Ceres for these losses: measured, it costs more steps than it saves.
    """
    kind, scale2 = loss
    if kind == 0:
        return 1.0
    if kind == 1:
        return 1.0 if s <= scale2 else math.sqrt(scale2 / s)
    return scale2 / (scale2 + s)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_loss(loss: RobustLoss, s: float, total: float, product: float) -> tuple[float, float]:
    """Add rho(s) to a sum that starts as (0, 1); returns the new (total, product), see :func:`total_loss`.

    A sum of logarithms is the logarithm of a product: Cauchy's loss costs a multiplication.
    """
    kind, scale2 = loss
    if kind == 0:
        return total + s, product
    if kind == 1:
        return total + (s if s <= scale2 else 2.0 * math.sqrt(s * scale2) - scale2), product
    product *= 1.0 + s / scale2
    if product > 1e200:
        return total + scale2 * math.log(product), 1.0
    return total, product


@numba.njit(cache=True, nogil=True, error_model="numpy")
def total_loss(loss: RobustLoss, total: float, product: float) -> float:
    """The cost, half of the sum of rho, of a sum by :func:`add_loss`."""
    return 0.5 * (total + loss.scale2 * math.log(product))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _linearize_ray(
    c: Pointer, ray: tuple[float, float, float], pixel: tuple[float, float], loss: RobustLoss, penalty: float,
    J: Pointer,
) -> tuple[bool, float, float, float, float, float, float, float, float, float]:  # fmt: skip
    """What the lens says in :func:`linearize`, for any family and in every direction: whether it looks there, the
    squared residual, the weighted residual and the weighted derivatives of u and of v by the point in the camera."""
    # the row of the lens is laid out so that its derivatives by the parameters come to lie where ours do
    row = offset(J, CANON - 8)
    project_jacobian(c, ray[0], ray[1], ray[2], row)
    if math.isnan(row[0]):
        return False, penalty, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    e0, e1 = across_seam(c, row[0] - pixel[0]), row[1] - pixel[1]
    s2 = e0 * e0 + e1 * e1
    w = math.sqrt(robust_weight(loss, s2))
    for n in range(2 * FAMILY):
        J[CANON + n] *= w
    return True, s2, w * e0, w * e1, w * row[2], w * row[3], w * row[4], w * row[5], w * row[6], w * row[7]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def linearize(
    pose: Pointer, mounted: bool | np.bool_, mount: Pointer, c: Pointer, point: tuple[float, float, float],
    pixel: tuple[float, float], loss: RobustLoss, penalty: float, intrinsics: bool | np.bool_, J: Pointer,
) -> float:  # fmt: skip
    """Weighted Jacobians and residual of one observation into the scratch row J; returns the squared residual.

    pose, mount, c and J are pointers: to 12 numbers, R row by row and t, of cam_from_world and, if ``mounted``, of
    cam_from_rig, the derivatives then being those by the rig's pose; to the camera's canonical row, whose
    derivatives are wanted if ``intrinsics``; and to the scratch row. Behind the camera the Jacobians are zero and the
    squared residual is ``penalty``, so that a point gains nothing by slipping there. Callers hand over constants as
    ``np.bool_(True)``: for literals numba compiles it anew.
    """
    x0, x1, x2 = point
    xo, yo = pixel
    px = pose[0] * x0 + pose[1] * x1 + pose[2] * x2 + pose[9]
    py = pose[3] * x0 + pose[4] * x1 + pose[5] * x2 + pose[10]
    pz = pose[6] * x0 + pose[7] * x1 + pose[8] * x2 + pose[11]
    s2 = penalty
    family = c[FAMILY]
    seen = pz > _MIN_COS * (abs(px) + abs(py))
    if family > LAST_ON_PLANE or (family == RADIAL_FISHEYE and not seen):
        seen, s2, e0, e1, g00, g01, g02, g10, g11, g12 = _linearize_ray(c, (px, py, pz), pixel, loss, penalty, J)
    elif seen:
        iz = 1.0 / pz
        u = px * iz
        v = py * iz
        fx, fy = c[0], c[1]
        if family == RADIAL_FISHEYE:
            ud, vd, a, b, d, k0u, k0v, k1u, k1v, k2u, k2v, k3u, k3v = radial_fisheye.jacobian(c, u, v)
        else:
            ud, vd, a, b, d, k0u, k0v, k1u, k1v, k2u, k2v, k3u, k3v = brown.jacobian(c, u, v)
        e0 = fx * ud + c[2] - xo
        e1 = fy * vd + c[3] - yo
        s2 = e0 * e0 + e1 * e1
        w = math.sqrt(robust_weight(loss, s2))
        fx *= w
        fy *= w
        g00, g01, g10, g11 = fx * a * iz, fx * b * iz, fy * b * iz, fy * d * iz
        g02 = -(g00 * u + g01 * v)
        g12 = -(g10 * u + g11 * v)
        e0 *= w
        e1 *= w
        if intrinsics:  # fx, fy, cx, cy, d0..d3, for each the change of u and v
            J[CANON], J[CANON + 1], J[CANON + 2], J[CANON + 3] = w * ud, 0.0, 0.0, w * vd
            J[CANON + 4], J[CANON + 5], J[CANON + 6], J[CANON + 7] = w, 0.0, 0.0, w
            J[CANON + 8], J[CANON + 9] = fx * k0u, fy * k0v
            J[CANON + 10], J[CANON + 11] = fx * k1u, fy * k1v
            J[CANON + 12], J[CANON + 13] = fx * k2u, fy * k2v
            J[CANON + 14], J[CANON + 15] = fx * k3u, fy * k3v
    if seen:
        p00 = g00 * pose[0] + g01 * pose[3] + g02 * pose[6]
        p01 = g00 * pose[1] + g01 * pose[4] + g02 * pose[7]
        p02 = g00 * pose[2] + g01 * pose[5] + g02 * pose[8]
        p10 = g10 * pose[0] + g11 * pose[3] + g12 * pose[6]
        p11 = g10 * pose[1] + g11 * pose[4] + g12 * pose[7]
        p12 = g10 * pose[2] + g11 * pose[5] + g12 * pose[8]
        store8(J, POINT, p00, p01, p02, e0, 0.0, 0.0, 0.0, 0.0)
        store8(J, POINT + 8, p10, p11, p12, e1, 0.0, 0.0, 0.0, 0.0)
        if mounted:  # the point and the derivatives as the rig has them
            px, py, pz = px - mount[9], py - mount[10], pz - mount[11]
            px, py, pz = (
                mount[0] * px + mount[3] * py + mount[6] * pz,
                mount[1] * px + mount[4] * py + mount[7] * pz,
                mount[2] * px + mount[5] * py + mount[8] * pz,
            )
            g00, g01, g02 = (
                g00 * mount[0] + g01 * mount[3] + g02 * mount[6],
                g00 * mount[1] + g01 * mount[4] + g02 * mount[7],
                g00 * mount[2] + g01 * mount[5] + g02 * mount[8],
            )
            g10, g11, g12 = (
                g10 * mount[0] + g11 * mount[3] + g12 * mount[6],
                g10 * mount[1] + g11 * mount[4] + g12 * mount[7],
                g10 * mount[2] + g11 * mount[5] + g12 * mount[8],
            )
        store8(J, POSE, py * g02 - pz * g01, pz * g00 - px * g02, px * g01 - py * g00, g00, g01, g02, 0.0, 0.0)
        store8(J, POSE + 8, py * g12 - pz * g11, pz * g10 - px * g12, px * g11 - py * g10, g10, g11, g12, 0.0, 0.0)
    else:
        for n in range(SCRATCH):
            J[n] = 0.0
    return s2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def squared_residual(
    pose: Pointer, c: Pointer, point: tuple[float, float, float], pixel: tuple[float, float], penalty: float
) -> float:
    """The squared residual of one observation, ``penalty`` behind the camera; arguments as in :func:`linearize`."""
    x0, x1, x2 = point
    xo, yo = pixel
    px = pose[0] * x0 + pose[1] * x1 + pose[2] * x2 + pose[9]
    py = pose[3] * x0 + pose[4] * x1 + pose[5] * x2 + pose[10]
    pz = pose[6] * x0 + pose[7] * x1 + pose[8] * x2 + pose[11]
    s2 = penalty
    seen = pz > _MIN_COS * (abs(px) + abs(py))
    if c[FAMILY] > LAST_ON_PLANE or (c[FAMILY] == RADIAL_FISHEYE and not seen):
        ud, vd = project(c, px, py, pz)
        if not math.isnan(ud):
            e0, e1 = across_seam(c, ud - xo), vd - yo
            s2 = e0 * e0 + e1 * e1
    elif seen:
        iz = 1.0 / pz
        u = px * iz
        v = py * iz
        ud, vd = distort(c, u, v)
        e0 = ud - xo
        e1 = vd - yo
        s2 = e0 * e0 + e1 * e1
    return s2


def scratch_size(num_blocks: int, num_free: int) -> tuple[int, int]:
    """(doubles, integers) of scratch."""
    return _FIXED + 8 * num_free, num_blocks


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _begin_point(Z: Pointer, where: Pointer, blocks: Int32s, first: int, last: int) -> None:
    """Zero the three rows of each block first..last that meets a point, and tell where they are among them."""
    for n in range(last - first):
        where[blocks[first + n]] = n
        for row in range(3):
            store8(Z, n * 24 + 8 * row, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _split(free_column: Ints, first: int, last: int) -> int:
    """Where the derivatives first..last of a camera pass from its block to the second one."""
    while last > first and free_column[last - 1] >= 8:
        last -= 1
    return last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _factor_point(normal: Pointer, damping: float, factor: Pointer, small: Pointer) -> bool:
    """Factor the damped normal equations (3, 8), gradient in the fourth column, of a point.

    Fills its row of ``point_factor`` and the eliminator: L^-T, with L^-1 g in the fourth column. False without depth.
    """
    v00, v11, v22 = normal[0], normal[9], normal[18]
    # a direction without any information keeps a unit diagonal, so that its step is zero
    d0 = damping * (v00 if v00 > 0.0 else 1.0)
    d1 = damping * (v11 if v11 > 0.0 else 1.0)
    d2 = damping * (v22 if v22 > 0.0 else 1.0)
    v00 += d0
    v11 += d1
    v22 += d2
    i0 = 1.0 / math.sqrt(v00)
    l10, l20 = normal[1] * i0, normal[2] * i0
    pivot1 = v11 - l10 * l10
    i1 = 1.0 / math.sqrt(pivot1)
    l21 = (normal[10] - l10 * l20) * i1
    pivot2 = v22 - l20 * l20 - l21 * l21
    # rounding leaves about 1e-16 of the diagonal in a pivot that should be zero
    if not (v00 > 0.0 and pivot1 > 1e-15 * v11 and pivot2 > 1e-15 * v22):
        for k in range(12):
            factor[k] = 0.0
        return False
    i2 = 1.0 / math.sqrt(pivot2)
    m10 = -l10 * i0 * i1
    m21 = -l21 * i1 * i2
    m20 = -(l20 * i0 + l21 * m10) * i2
    g0, g1, g2 = normal[3], normal[11], normal[19]
    factor[0], factor[1], factor[2], factor[3], factor[4], factor[5] = i0, m10, i1, m20, m21, i2
    factor[6], factor[7], factor[8], factor[9], factor[10], factor[11] = g0, g1, g2, d0, d1, d2
    small[0], small[1], small[2], small[3] = i0, m10, m20, i0 * g0
    small[8], small[9], small[10], small[11] = 0.0, i1, m21, m10 * g0 + i1 * g1
    small[16], small[17], small[18], small[19] = 0.0, 0.0, i2, m20 * g0 + m21 * g1 + i2 * g2
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _keep_point(block: int, normal: Pointer, Z: Pointer, count: int, sums: Sums) -> None:
    """Add the normal equations of a point that is a block of its own, the last of the count that meet in it.

    Its rows become minus the unit matrix: what ``Z_a Z_b^T`` takes off a tile is then what W adds to it.
    """
    for j in range(3):
        sums.gradient[block * 8 + j] += normal[8 * j + 3]
        Z[(count - 1) * 24 + 9 * j] = -1.0
        for k in range(3):
            sums.own[block * 64 + 8 * j + k] += normal[8 * min(j, k) + max(j, k)]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def reduce_points(
    part: tuple[int, int], points: PointArrays, images: ImageArrays, lenses: LensArrays, meetings: Meetings,
    loss: RobustLoss, damping: float, sums: Sums, point_factor: Array, rows: Array, scratch: Scratch,
) -> float:  # fmt: skip
    """Linearise points ``part[0]`` to ``part[1]`` and eliminate them; returns the cost of their observations.

    What that takes off the tiles is left to :func:`sfmapp.adjust.elimination.subtract_products`.

    Args:
        sums: added to.
        point_factor: (P, 12) out: L^-1 (l00 l10 l11 l20 l21 l22), gradient, damped diagonal increment; all zero for a
            point that has no depth at all, or is a block.
        rows: out: 3 x 8 of ``Z = W L^-T`` for each block that meets each of the points.
    """
    point_ptr, obs_image, obs_xy, xyz, is_constant, point_block = points
    poses, image_mount, mounts, image_camera, image_block = images
    intrinsics, penalty, camera_block, _, free_ptr, free_slot, free_column = lenses
    block_dim, ptr, met = meetings.dim, meetings.ptr, meetings.block
    own, cross, gradient = sums
    doubles, integers = scratch
    num_blocks = block_dim.shape[0]
    doubles[:] = 0.0
    pose, lens, J = pointer(poses), pointer(intrinsics), pointer(doubles)
    mount, where = pointer(mounts), pointer(integers)
    normal, small, zeros, units = offset(J, _NORMAL), offset(J, _SMALL), offset(J, _ZEROS), offset(J, _FIXED)
    for n in range(free_slot.shape[0]):
        units[n * 8 + free_column[n] % 8] = 1.0
    cost, product = 0.0, 1.0
    for p in range(part[0], part[1]):
        x0, x1, x2 = xyz[p, 0], xyz[p, 1], xyz[p, 2]
        moves = not is_constant[p]
        count = ptr[p + 1] - ptr[p]
        Z = offset(pointer(rows), 24 * (ptr[p] - ptr[part[0]]))
        _begin_point(Z, where, met, ptr[p], ptr[p + 1])
        for row in range(3):
            store8(normal, 8 * row, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            c = image_camera[i]
            block, other = image_block[i], camera_block[c]
            s2 = linearize(
                offset(pose, 12 * i), image_mount[i] >= 0, offset(mount, 12 * image_mount[i]),
                offset(lens, ROW * c), (x0, x1, x2), (obs_xy[o, 0], obs_xy[o, 1]), loss, penalty[c], other >= 0, J,
            )  # fmt: skip
            cost, product = add_loss(loss, s2, cost, product)
            if moves:
                add2(normal, 0, J, POINT, J, POINT, 3)
            if block >= 0:
                if other == block:
                    spread(J, POSE, J, J, CANON, free_slot, units, free_ptr[c], free_ptr[c + 1])
                add2(own, block * 64, J, POSE, J, POSE, block_dim[block])
                add2(gradient, block * 8, J, POINT + 3, J, POSE, 1)
                if moves:
                    add2(Z, where[block] * 24, J, POINT, J, POSE, 3)
            if other >= 0 and other != block:
                split = _split(free_column, free_ptr[c], free_ptr[c + 1])
                spread(J, INTR, zeros, J, CANON, free_slot, units, free_ptr[c], split)
                add2(own, other * 64, J, INTR, J, INTR, block_dim[other])
                add2(gradient, other * 8, J, POINT + 3, J, INTR, 1)
                if block >= 0:
                    add2(cross, i * 64, J, POSE, J, INTR, 6)
                if moves:
                    add2(Z, where[other] * 24, J, POINT, J, INTR, 3)
                if split < free_ptr[c + 1]:
                    second, num_images = other + 1, image_block.shape[0]
                    spread(J, _SECOND, zeros, J, CANON, free_slot, units, split, free_ptr[c + 1])
                    add2(own, second * 64, J, _SECOND, J, _SECOND, block_dim[second])
                    add2(gradient, second * 8, J, POINT + 3, J, _SECOND, 1)
                    add2(cross, (2 * num_images + c) * 64, J, INTR, J, _SECOND, 8)
                    if block >= 0:
                        add2(cross, (num_images + i) * 64, J, POSE, J, _SECOND, 6)
                    if moves:
                        add2(Z, where[second] * 24, J, POINT, J, _SECOND, 3)
        if point_block[p] >= 0:
            _keep_point(point_block[p], normal, Z, count, sums)
            continue
        if not moves:
            continue
        if not _factor_point(normal, damping, offset(pointer(point_factor), 12 * p), small):
            _begin_point(Z, where, met, ptr[p], ptr[p + 1])
            continue
        for n in range(count):
            # Z = W L^-T in place
            assign3(Z, n * 24, small, 0, Z, n * 24, 3)
            subtract3(gradient, (num_blocks + met[ptr[p] + n]) * 8, small, 3, Z, n * 24, 1)
    return total_loss(loss, cost, product)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def substitute_points(
    part: tuple[int, int], points: PointArrays, images: ImageArrays, lenses: LensArrays, loss: RobustLoss,
    point_factor: Array, step: Array, new: State, outcome: Array, scratch: Array,
) -> None:  # fmt: skip
    """Steps of points ``part[0]`` to ``part[1]`` after those of the blocks, and the cost of the state that results.

    Args (beyond those of :func:`reduce_points`):
        step: (B * 8,) solution of the reduced system.
        new: the state after it; its points are filled.
        outcome: (2,) out: cost, and the points' share of the predicted decrease.
        scratch: (SCRATCH,) at least.
    """
    point_ptr, obs_image, obs_xy, xyz, is_constant, point_block = points
    poses, image_mount, mounts, image_camera, image_block = images
    intrinsics, penalty, camera_block, _, free_ptr, free_slot, free_column = lenses
    new_poses, new_intrinsics, new_xyz = new
    J, pose, mount, lens = pointer(scratch), pointer(poses), pointer(mounts), pointer(intrinsics)
    new_pose, new_lens = pointer(new_poses), pointer(new_intrinsics)
    cost, product = 0.0, 1.0
    decrease = 0.0
    for p in range(part[0], part[1]):
        x0, x1, x2 = xyz[p, 0], xyz[p, 1], xyz[p, 2]
        if not is_constant[p] and point_factor[p, 0] > 0.0:
            h0, h1, h2 = point_factor[p, 6], point_factor[p, 7], point_factor[p, 8]
            for o in range(point_ptr[p], point_ptr[p + 1]):
                i = obs_image[o]
                c = image_camera[i]
                block = image_block[i]
                other = camera_block[c]
                if block < 0 and other < 0:
                    continue
                linearize(
                    offset(pose, 12 * i), image_mount[i] >= 0, offset(mount, 12 * image_mount[i]),
                    offset(lens, ROW * c), (x0, x1, x2), (obs_xy[o, 0], obs_xy[o, 1]), loss, penalty[c],
                    other >= 0, J,
                )  # fmt: skip
                e0 = e1 = 0.0
                if block >= 0:
                    for k in range(6):
                        d = step[block * 8 + k]
                        e0 += J[POSE + k] * d
                        e1 += J[POSE + 8 + k] * d
                if other >= 0:
                    for n in range(free_ptr[c], free_ptr[c + 1]):
                        d, slot = step[other * 8 + free_column[n]], CANON + 2 * free_slot[n]
                        e0 += J[slot] * d
                        e1 += J[slot + 1] * d
                h0 += J[POINT] * e0 + J[POINT + 8] * e1
                h1 += J[POINT + 1] * e0 + J[POINT + 9] * e1
                h2 += J[POINT + 2] * e0 + J[POINT + 10] * e1
            y0 = point_factor[p, 0] * h0
            y1 = point_factor[p, 1] * h0 + point_factor[p, 2] * h1
            y2 = point_factor[p, 3] * h0 + point_factor[p, 4] * h1 + point_factor[p, 5] * h2
            s0 = -(point_factor[p, 0] * y0 + point_factor[p, 1] * y1 + point_factor[p, 3] * y2)
            s1 = -(point_factor[p, 2] * y1 + point_factor[p, 4] * y2)
            s2 = -point_factor[p, 5] * y2
            # half of step . (damping step - gradient): what the quadratic model loses, without a second pass
            decrease += s0 * (point_factor[p, 9] * s0 - point_factor[p, 6])
            decrease += s1 * (point_factor[p, 10] * s1 - point_factor[p, 7])
            decrease += s2 * (point_factor[p, 11] * s2 - point_factor[p, 8])
            x0 += s0
            x1 += s1
            x2 += s2
        elif point_block[p] >= 0:
            first = point_block[p] * 8
            x0 += step[first]
            x1 += step[first + 1]
            x2 += step[first + 2]
        new_xyz[p, 0], new_xyz[p, 1], new_xyz[p, 2] = x0, x1, x2
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            c = image_camera[i]
            s2 = squared_residual(
                offset(new_pose, 12 * i), offset(new_lens, ROW * c), (x0, x1, x2), (obs_xy[o, 0], obs_xy[o, 1]),
                penalty[c],
            )  # fmt: skip
            cost, product = add_loss(loss, s2, cost, product)
    outcome[0], outcome[1] = total_loss(loss, cost, product), 0.5 * decrease


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weigh_observations(
    points: PointArrays, images: ImageArrays, lenses: LensArrays, loss: RobustLoss, least: float
) -> tuple[float, int, float]:
    """Of all observations the sum of rho'(s) s where the weight rho'(s) is not below the least, how many it is below,
    and the cost.
    """
    point_ptr, obs_image, obs_xy, xyz, _, _ = points
    poses, image_mount, mounts, image_camera, _ = images
    penalty, J = lenses.penalty, np.zeros(SCRATCH)
    scratch, pose, mount, lens = pointer(J), pointer(poses), pointer(mounts), pointer(lenses.canonical)
    total, below, cost, product = 0.0, 0, 0.0, 1.0
    for p in range(xyz.shape[0]):
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            c = image_camera[i]
            s = linearize(
                offset(pose, 12 * i), image_mount[i] >= 0, offset(mount, 12 * image_mount[i]), offset(lens, ROW * c),
                (xyz[p, 0], xyz[p, 1], xyz[p, 2]), (obs_xy[o, 0], obs_xy[o, 1]), loss, penalty[c],
                np.bool_(False), scratch,
            )  # fmt: skip
            weight = robust_weight(loss, s)
            if weight < least:
                below += 1
            else:
                total += weight * s
            cost, product = add_loss(loss, s, cost, product)
    return total, below, total_loss(loss, cost, product)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_rows(poses: Array, image_pose: Int32s, image_mount: Int32s, mounts: Array, rows: Array) -> None:
    """Fill rows (I, 12), rotation row by row and translation of every image, from poses (Q, 7) and mounts (M, 12)."""
    for i in range(rows.shape[0]):
        x, y, z, w = poses[image_pose[i], 0], poses[image_pose[i], 1], poses[image_pose[i], 2], poses[image_pose[i], 3]
        row = rows[i]
        row[0] = 1 - 2 * (y * y + z * z)
        row[1] = 2 * (x * y - z * w)
        row[2] = 2 * (x * z + y * w)
        row[3] = 2 * (x * y + z * w)
        row[4] = 1 - 2 * (x * x + z * z)
        row[5] = 2 * (y * z - x * w)
        row[6] = 2 * (x * z - y * w)
        row[7] = 2 * (y * z + x * w)
        row[8] = 1 - 2 * (x * x + y * y)
        for k in range(3):
            row[9 + k] = poses[image_pose[i], 4 + k]
        if image_mount[i] >= 0:
            mount = mounts[image_mount[i]]
            for k in range(4):
                # columns of R, then t
                first, step = (k, 3) if k < 3 else (9, 1)
                a, b, c = row[first], row[first + step], row[first + 2 * step]
                for j in range(3):
                    row[first + step * j] = mount[3 * j] * a + mount[3 * j + 1] * b + mount[3 * j + 2] * c
            for j in range(3):
                row[9 + j] += mount[9 + j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def retract(
    poses: Array, pose_block: Int32s, image_pose: Int32s, images: ImageArrays, lenses: LensArrays, step: Array,
    new_poses: Array, new: State,
) -> None:  # fmt: skip
    """Apply a step of the blocks: ``x_cam <- exp(w) x_cam + v`` on poses (Q, 7), sums on canonical rows (C, 17).

    Constant poses and cameras keep their bits. Fills new_poses (Q, 7), and of the new state all but the points.
    """
    for i in range(poses.shape[0]):
        block = pose_block[i]
        x, y, z, w = poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3]
        t0, t1, t2 = poses[i, 4], poses[i, 5], poses[i, 6]
        if block >= 0:
            a, b, c = step[block * 8], step[block * 8 + 1], step[block * 8 + 2]
            angle2 = a * a + b * b + c * c
            # quaternion of the rotation vector, by series where the quotient would lose its digits
            if angle2 < 1e-12:
                s, e = 0.5 - angle2 / 48.0, 1.0 - angle2 / 8.0
            else:
                angle = math.sqrt(angle2)
                s, e = math.sin(0.5 * angle) / angle, math.cos(0.5 * angle)
            a, b, c = s * a, s * b, s * c
            x, y, z, w = (
                e * x + a * w + b * z - c * y,
                e * y - a * z + b * w + c * x,
                e * z + a * y - b * x + c * w,
                e * w - a * x - b * y - c * z,
            )
            norm = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
            x, y, z, w = x * norm, y * norm, z * norm, w * norm
            # t <- exp(w) t + v: rotate t by the quaternion (a, b, c, e)
            c0, c1, c2 = 2.0 * (b * t2 - c * t1), 2.0 * (c * t0 - a * t2), 2.0 * (a * t1 - b * t0)
            v0, v1, v2 = step[block * 8 + 3], step[block * 8 + 4], step[block * 8 + 5]
            t0, t1, t2 = (
                t0 + e * c0 + b * c2 - c * c1 + v0,
                t1 + e * c1 + c * c0 - a * c2 + v1,
                t2 + e * c2 + a * c1 - b * c0 + v2,
            )
        new_poses[i, 0], new_poses[i, 1], new_poses[i, 2], new_poses[i, 3] = x, y, z, w
        new_poses[i, 4], new_poses[i, 5], new_poses[i, 6] = t0, t1, t2
    fill_rows(new_poses, image_pose, images.mount, images.mounts, new.rows)
    canonical, _, camera_block, _, free_ptr, free_slot, free_column = lenses
    for k in range(canonical.shape[0]):
        for n in range(canonical.shape[1]):
            new.canonical[k, n] = canonical[k, n]
        for n in range(free_ptr[k], free_ptr[k + 1]):
            new.canonical[k, free_slot[n]] += step[camera_block[k] * 8 + free_column[n]]
