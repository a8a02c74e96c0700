"""Kernels of the adjustment: linearise, eliminate the points, substitute back.

Layout. An unknown block is a row of up to eight numbers: the six of a pose (rotation, then translation, of
``x_cam <- exp(w) x_cam + v``), followed by at most two intrinsics where a camera takes part through one image only; or
the free intrinsics of a camera that several images share. Blocks meet in 8 x 8 tiles. Points are never blocks: they are
eliminated one by one (Triggs et al., "Bundle Adjustment: A Modern Synthesis", 1999, section 6.1) from the factor
``L L^T`` of their damped 3 x 3 normal matrix: with Z = W L^-T the reduced system loses Z_a Z_b^T per pair of blocks.

Nothing is kept per observation. Points come in chunks whose number depends on the problem alone; each chunk has its own
sums, which are added in order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sfmapp.adjust.lanes import add2, assign3, subtract3
from sfmapp.scene.camera import distort

# The numbers by which kernels know the losses.
LOSS_IDS: dict[str, int] = {"trivial": 0, "huber": 1, "cauchy": 2}

# Offsets in the scratch row of one observation: two rows each of pose (and merged intrinsics), canonical or free
# intrinsics and point, and the residual.
_POSE, _CANON, _INTR, _POINT, _RES, _SCRATCH = 0, 16, 32, 48, 64, 80
# Smallest depth that counts as in front of the camera, relative to the distance.
_MIN_COS = 1e-6


@numba.njit(cache=True, nogil=True)
def robust_weight(loss: int, scale2: float, s: float) -> float:
    """rho'(s), the weight of a squared residual s (Holland and Welsch 1977).

    Triggs's second-order term is left out, as in Ceres for these losses: measured, it costs more steps than it saves.
    """
    if loss == 0:
        return 1.0
    if loss == 1:
        return 1.0 if s <= scale2 else math.sqrt(scale2 / s)
    return scale2 / (scale2 + s)


@numba.njit(cache=True, nogil=True)
def add_loss(loss, scale2, s, total, product):  # type: ignore[no-untyped-def]
    """Add rho(s) to a sum that starts as (0, 1); returns the new (total, product), see :func:`total_loss`.

    A sum of logarithms is the logarithm of a product: Cauchy's loss costs a multiplication.
    """
    if loss == 0:
        return total + s, product
    if loss == 1:
        return total + (s if s <= scale2 else 2.0 * math.sqrt(s * scale2) - scale2), product
    product *= 1.0 + s / scale2
    if product > 1e200:
        return total + scale2 * math.log(product), 1.0
    return total, product


@numba.njit(cache=True, nogil=True)
def total_loss(scale2: float, total: float, product: float) -> float:
    """The cost, half of the sum of rho, of a sum by :func:`add_loss`."""
    return 0.5 * (total + scale2 * math.log(product))


@numba.njit(cache=True, nogil=True)
def linearize(pose, c, fisheye, x0, x1, x2, xo, yo, loss, scale2, penalty, intrinsics, J):  # type: ignore[no-untyped-def]
    """Weighted Jacobians and residual of one observation into the scratch row J; returns the squared residual.

    pose: 12 numbers, R row by row and t. c: canonical intrinsics, whose derivatives are wanted if ``intrinsics``.
    Behind the camera the Jacobians are zero and the squared residual is ``penalty``, so that a point gains nothing by
    slipping there.
    """
    px = pose[0] * x0 + pose[1] * x1 + pose[2] * x2 + pose[9]
    py = pose[3] * x0 + pose[4] * x1 + pose[5] * x2 + pose[10]
    pz = pose[6] * x0 + pose[7] * x1 + pose[8] * x2 + pose[11]
    if not pz > _MIN_COS * (abs(px) + abs(py)):
        for i in range(_SCRATCH):
            J[i] = 0.0
        return penalty
    iz = 1.0 / pz
    u = px * iz
    v = py * iz
    r2 = u * u + v * v
    fx, fy = c[0], c[1]
    if fisheye:
        r = math.sqrt(r2)
        if r < 1e-8:
            s, slope, q = 1.0, 2.0 * (c[4] - 1.0 / 3.0), 0.0
            t2 = r2
        else:
            theta = math.atan(r)
            t2 = theta * theta
            q = theta * t2 / r
            s = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) / r
            rate = 1.0 + t2 * (3.0 * c[4] + t2 * (5.0 * c[5] + t2 * (7.0 * c[6] + t2 * 9.0 * c[7])))
            slope = (rate / (1.0 + r2) - s) / r2
        ud, vd = s * u, s * v
        a = s + u * u * slope
        b = u * v * slope
        d = s + v * v * slope
        k0u, k0v = q * u, q * v
        k1u, k1v = t2 * k0u, t2 * k0v
        k2u, k2v = t2 * k1u, t2 * k1v
        k3u, k3v = t2 * k2u, t2 * k2v
    else:
        radial = 1.0 + r2 * (c[4] + r2 * c[5])
        slope = 2.0 * (c[4] + 2.0 * r2 * c[5])
        k0u, k0v = r2 * u, r2 * v
        k1u, k1v = r2 * k0u, r2 * k0v
        k2u, k2v = 2.0 * u * v, r2 + 2.0 * v * v
        k3u, k3v = r2 + 2.0 * u * u, k2u
        ud = u * radial + c[6] * k2u + c[7] * k3u
        vd = v * radial + c[6] * k2v + c[7] * k3v
        a = radial + u * u * slope + 2.0 * c[6] * v + 6.0 * c[7] * u
        b = u * v * slope + 2.0 * c[6] * u + 2.0 * c[7] * v
        d = radial + v * v * slope + 2.0 * c[7] * u + 6.0 * c[6] * v
    e0 = fx * ud + c[2] - xo
    e1 = fy * vd + c[3] - yo
    s2 = e0 * e0 + e1 * e1
    w = math.sqrt(robust_weight(loss, scale2, s2))
    J[_RES] = w * e0
    J[_RES + 8] = w * e1
    fx *= w
    fy *= w
    g00, g01, g10, g11 = fx * a * iz, fx * b * iz, fy * b * iz, fy * d * iz
    g02 = -(g00 * u + g01 * v)
    g12 = -(g10 * u + g11 * v)
    J[0] = py * g02 - pz * g01
    J[1] = pz * g00 - px * g02
    J[2] = px * g01 - py * g00
    J[3] = g00
    J[4] = g01
    J[5] = g02
    J[8] = py * g12 - pz * g11
    J[9] = pz * g10 - px * g12
    J[10] = px * g11 - py * g10
    J[11] = g10
    J[12] = g11
    J[13] = g12
    J[_POINT] = g00 * pose[0] + g01 * pose[3] + g02 * pose[6]
    J[_POINT + 1] = g00 * pose[1] + g01 * pose[4] + g02 * pose[7]
    J[_POINT + 2] = g00 * pose[2] + g01 * pose[5] + g02 * pose[8]
    J[_POINT + 8] = g10 * pose[0] + g11 * pose[3] + g12 * pose[6]
    J[_POINT + 9] = g10 * pose[1] + g11 * pose[4] + g12 * pose[7]
    J[_POINT + 10] = g10 * pose[2] + g11 * pose[5] + g12 * pose[8]
    if intrinsics:  # fx, fy, cx, cy, d0..d3
        J[_CANON], J[_CANON + 9] = w * ud, w * vd
        J[_CANON + 2] = J[_CANON + 11] = w
        J[_CANON + 1] = J[_CANON + 3] = J[_CANON + 8] = J[_CANON + 10] = 0.0
        J[_CANON + 4], J[_CANON + 12] = fx * k0u, fy * k0v
        J[_CANON + 5], J[_CANON + 13] = fx * k1u, fy * k1v
        J[_CANON + 6], J[_CANON + 14] = fx * k2u, fy * k2v
        J[_CANON + 7], J[_CANON + 15] = fx * k3u, fy * k3v
    return s2


@numba.njit(cache=True, nogil=True)
def _gather_intrinsics(J, start, count, slots, columns, offset):  # type: ignore[no-untyped-def]
    """Add the canonical columns that are free to the two rows at ``offset`` of the scratch row."""
    for n in range(start, start + count):
        to, source = offset + columns[n], _CANON + slots[n]
        J[to] += J[source]
        J[to + 8] += J[source + 8]


@numba.njit(cache=True, nogil=True)
def find_slot(keys, values, key):  # type: ignore[no-untyped-def]
    """Value of a key in an open hash table of power-of-two size with -1 for empty; -1 where absent."""
    mask = keys.shape[0] - 1
    h = ((key * 0x9E3779B97F4A7C) >> 20) & mask
    while keys[h] != key:
        if keys[h] < 0:
            return -1
        h = (h + 1) & mask
    return values[h]


@numba.njit(cache=True, nogil=True)
def reduce_points(  # type: ignore[no-untyped-def]
    first, last, point_ptr, obs_image, obs_xy, xyz, is_constant, poses, image_camera, image_block, intrinsics, fisheye,
    penalty, camera_block, free_ptr, free_slot, free_column, block_dim, loss, scale2, damping, hash_keys, hash_values,
    tiles, own, cross, gradient, point_factor,
):  # fmt: skip
    """Linearise points first..last and eliminate them; returns the cost of their observations.

    Args:
        point_ptr, obs_image, obs_xy, xyz: observations sorted by point; images are positions in ``poses``.
        is_constant: (P,) points that do not move.
        poses: (I, 12); image_camera: (I,); image_block: (I,) block of a pose, -1 where it is constant.
        intrinsics: (C, 8) canonical; penalty: (C,) squared residual of what is behind.
        camera_block: (C,) block that holds the free intrinsics, -1 where constant; free_ptr, free_slot, free_column:
            for camera c, canonical slot and column in the block.
        block_dim: (B,) rows in use of each block.
        hash_keys, hash_values: tile of block pair a <= b under key a B + b; empty if that number is the tile's as well.
        tiles: (N * 64,) out: sum of -Z_a Z_b^T. own: (B * 64,) out: J^T J of each block with itself, not eliminated.
        cross: (I * 64,) out: J_pose^T J_intrinsics of images whose camera has a block of its own.
        gradient: (2, B * 8) out: J^T r before elimination, and what elimination adds to it.
        point_factor: (P, 12) out: L^-1 (l00 l10 l11 l20 l21 l22), gradient, damped diagonal increment; all zero for a
            point that has no depth at all.
    """
    num_blocks = block_dim.shape[0]
    dense = hash_keys.shape[0] == 0
    tiles[:] = 0.0
    own[:] = 0.0
    cross[:] = 0.0
    gradient[:] = 0.0
    plain, eliminated = gradient[0], gradient[1]
    J = np.zeros(_SCRATCH)
    small = np.zeros(24)
    mark = np.full(num_blocks, -1, np.int64)
    where = np.zeros(num_blocks, np.int64)
    longest = 1
    for p in range(first, last):
        longest = max(longest, point_ptr[p + 1] - point_ptr[p])
    W = np.zeros(min(2 * longest, num_blocks + 1) * 24)
    blocks = np.zeros(min(2 * longest, num_blocks + 1), np.int64)
    cost, product = 0.0, 1.0
    for p in range(first, last):
        x0, x1, x2 = xyz[p, 0], xyz[p, 1], xyz[p, 2]
        moves = not is_constant[p]
        v00 = v01 = v02 = v11 = v12 = v22 = g0 = g1 = g2 = 0.0
        count = 0
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            c = image_camera[i]
            other = camera_block[c]
            s2 = linearize(
                poses[i],
                intrinsics[c],
                fisheye[c],
                x0,
                x1,
                x2,
                obs_xy[o, 0],
                obs_xy[o, 1],
                loss,
                scale2,
                penalty[c],
                other >= 0,
                J,
            )
            cost, product = add_loss(loss, scale2, s2, cost, product)
            if moves:
                a0, a1, a2 = J[_POINT], J[_POINT + 1], J[_POINT + 2]
                b0, b1, b2 = J[_POINT + 8], J[_POINT + 9], J[_POINT + 10]
                r0, r1 = J[_RES], J[_RES + 8]
                v00 += a0 * a0 + b0 * b0
                v01 += a0 * a1 + b0 * b1
                v02 += a0 * a2 + b0 * b2
                v11 += a1 * a1 + b1 * b1
                v12 += a1 * a2 + b1 * b2
                v22 += a2 * a2 + b2 * b2
                g0 += a0 * r0 + b0 * r1
                g1 += a1 * r0 + b1 * r1
                g2 += a2 * r0 + b2 * r1
            block = image_block[i]
            if block >= 0:
                if other == block:
                    J[6] = J[7] = J[14] = J[15] = 0.0
                    _gather_intrinsics(J, free_ptr[c], free_ptr[c + 1] - free_ptr[c], free_slot, free_column, _POSE)
                    add2(own, block * 64, J, _POSE, J, _POSE, 8)
                else:
                    J[6] = J[7] = J[14] = J[15] = 0.0
                    add2(own, block * 64, J, _POSE, J, _POSE, 6)
                add2(plain, block * 8, J, _RES, J, _POSE, 1)
                if moves:
                    if mark[block] != p:
                        mark[block] = p
                        where[block] = count
                        blocks[count] = block
                        W[count * 24 : count * 24 + 24] = 0.0
                        count += 1
                    add2(W, where[block] * 24, J, _POINT, J, _POSE, 3)
            if other >= 0 and other != block:
                J[_INTR : _INTR + 16] = 0.0
                _gather_intrinsics(J, free_ptr[c], free_ptr[c + 1] - free_ptr[c], free_slot, free_column, _INTR)
                add2(own, other * 64, J, _INTR, J, _INTR, block_dim[other])
                add2(plain, other * 8, J, _RES, J, _INTR, 1)
                if block >= 0:
                    add2(cross, i * 64, J, _POSE, J, _INTR, 6)
                if moves:
                    if mark[other] != p:
                        mark[other] = p
                        where[other] = count
                        blocks[count] = other
                        W[count * 24 : count * 24 + 24] = 0.0
                        count += 1
                    add2(W, where[other] * 24, J, _POINT, J, _INTR, 3)
        if not moves:
            continue
        # a direction without any information keeps a unit diagonal, so that its step is zero
        d0 = damping * (v00 if v00 > 0.0 else 1.0)
        d1 = damping * (v11 if v11 > 0.0 else 1.0)
        d2 = damping * (v22 if v22 > 0.0 else 1.0)
        v00 += d0
        v11 += d1
        v22 += d2
        factor = point_factor[p]
        pivot1 = v11 - v01 * v01 / v00
        c12 = v12 - v01 * v02 / v00
        pivot2 = v22 - v02 * v02 / v00 - c12 * c12 / pivot1
        # rounding leaves about 1e-16 of the diagonal in a pivot that should be zero
        if not (pivot1 > 1e-15 * v11 and pivot2 > 1e-15 * v22):
            factor[:] = 0.0
            continue
        i0 = 1.0 / math.sqrt(v00)
        i1 = 1.0 / math.sqrt(pivot1)
        i2 = 1.0 / math.sqrt(pivot2)
        l10 = v01 * i0
        l20 = v02 * i0
        l21 = c12 * i1
        m10 = -l10 * i0 * i1
        m21 = -l21 * i1 * i2
        m20 = -(l20 * i0 + l21 * m10) * i2
        factor[0], factor[1], factor[2], factor[3], factor[4], factor[5] = i0, m10, i1, m20, m21, i2
        factor[6], factor[7], factor[8] = g0, g1, g2
        factor[9], factor[10], factor[11] = d0, d1, d2
        # Z = W L^-T in place; its row of three for the gradient rides along
        small[0], small[1], small[2] = i0, m10, m20
        small[9], small[10], small[18] = i1, m21, i2
        small[4] = i0 * g0
        small[12] = m10 * g0 + i1 * g1
        small[20] = m20 * g0 + m21 * g1 + i2 * g2
        for n in range(count):
            assign3(W, n * 24, small, 0, W, n * 24, 3)
            subtract3(eliminated, blocks[n] * 8, small, 4, W, n * 24, 1)
        for n in range(count):
            a = blocks[n]
            for m in range(n, count):
                b = blocks[m]
                # tiles are kept for a <= b only
                if a <= b:
                    tile = a * num_blocks + b
                    if not dense:
                        tile = find_slot(hash_keys, hash_values, tile)
                    subtract3(tiles, tile * 64, W, n * 24, W, m * 24, block_dim[a])
                else:
                    tile = b * num_blocks + a
                    if not dense:
                        tile = find_slot(hash_keys, hash_values, tile)
                    subtract3(tiles, tile * 64, W, m * 24, W, n * 24, block_dim[b])
    return total_loss(scale2, cost, product)


@numba.njit(cache=True, nogil=True)
def substitute_points(  # type: ignore[no-untyped-def]
    first, last, point_ptr, obs_image, obs_xy, xyz, is_constant, poses, image_camera, image_block, intrinsics, fisheye,
    penalty, camera_block, free_ptr, free_slot, free_column, block_dim, loss, scale2, point_factor, step, new_poses,
    new_intrinsics, new_xyz, sums,
):  # fmt: skip
    """Steps of points first..last after those of the blocks, and the cost of the state that results.

    Args (beyond those of :func:`reduce_points`):
        step: (B * 8,) solution of the reduced system. new_poses, new_intrinsics: the state after it.
        new_xyz: (P, 3) out.
        sums: (2,) out: cost, and the points' share of the predicted decrease.
    """
    J = np.zeros(_SCRATCH)
    cost, product = 0.0, 1.0
    decrease = 0.0
    for p in range(first, last):
        x0, x1, x2 = xyz[p, 0], xyz[p, 1], xyz[p, 2]
        factor = point_factor[p]
        if not is_constant[p] and factor[0] > 0.0:
            h0, h1, h2 = factor[6], factor[7], factor[8]
            for o in range(point_ptr[p], point_ptr[p + 1]):
                i = obs_image[o]
                c = image_camera[i]
                block = image_block[i]
                other = camera_block[c]
                if block < 0 and other < 0:
                    continue
                linearize(
                    poses[i], intrinsics[c], fisheye[c], x0, x1, x2, obs_xy[o, 0], obs_xy[o, 1], loss, scale2,
                    penalty[c], other >= 0, J,
                )  # fmt: skip
                e0 = e1 = 0.0
                if block >= 0:
                    for k in range(6):
                        d = step[block * 8 + k]
                        e0 += J[_POSE + k] * d
                        e1 += J[_POSE + 8 + k] * d
                if other >= 0:
                    for n in range(free_ptr[c], free_ptr[c + 1]):
                        d = step[other * 8 + free_column[n]]
                        e0 += J[_CANON + free_slot[n]] * d
                        e1 += J[_CANON + 8 + free_slot[n]] * d
                h0 += J[_POINT] * e0 + J[_POINT + 8] * e1
                h1 += J[_POINT + 1] * e0 + J[_POINT + 9] * e1
                h2 += J[_POINT + 2] * e0 + J[_POINT + 10] * e1
            y0 = factor[0] * h0
            y1 = factor[1] * h0 + factor[2] * h1
            y2 = factor[3] * h0 + factor[4] * h1 + factor[5] * h2
            s0 = -(factor[0] * y0 + factor[1] * y1 + factor[3] * y2)
            s1 = -(factor[2] * y1 + factor[4] * y2)
            s2 = -factor[5] * y2
            # half of step . (damping step - gradient): what the quadratic model loses, without a second pass
            decrease += s0 * (factor[9] * s0 - factor[6])
            decrease += s1 * (factor[10] * s1 - factor[7])
            decrease += s2 * (factor[11] * s2 - factor[8])
            x0 += s0
            x1 += s1
            x2 += s2
        new_xyz[p, 0], new_xyz[p, 1], new_xyz[p, 2] = x0, x1, x2
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            c = image_camera[i]
            pose = new_poses[i]
            pz = pose[6] * x0 + pose[7] * x1 + pose[8] * x2 + pose[11]
            px = pose[0] * x0 + pose[1] * x1 + pose[2] * x2 + pose[9]
            py = pose[3] * x0 + pose[4] * x1 + pose[5] * x2 + pose[10]
            if pz > _MIN_COS * (abs(px) + abs(py)):
                iz = 1.0 / pz
                u, v = distort(fisheye[c], new_intrinsics[c], px * iz, py * iz)
                u -= obs_xy[o, 0]
                v -= obs_xy[o, 1]
                s2 = u * u + v * v
            else:
                s2 = penalty[c]
            cost, product = add_loss(loss, scale2, s2, cost, product)
    sums[0], sums[1] = total_loss(scale2, cost, product), 0.5 * decrease


@numba.njit(cache=True, nogil=True)
def retract(  # type: ignore[no-untyped-def]
    poses, image_block, canonical, camera_block, free_ptr, free_slot, free_column, step, new_poses, new_rows,
    new_canonical,
):  # fmt: skip
    """Apply a step of the blocks: ``x_cam <- exp(w) x_cam + v`` on poses (I, 7), sums on canonical rows (C, 8).

    Constant poses and cameras keep their bits. Also fills new_rows (I, 12).
    """
    for i in range(poses.shape[0]):
        block = image_block[i]
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
        row = new_rows[i]
        row[0] = 1 - 2 * (y * y + z * z)
        row[1] = 2 * (x * y - z * w)
        row[2] = 2 * (x * z + y * w)
        row[3] = 2 * (x * y + z * w)
        row[4] = 1 - 2 * (x * x + z * z)
        row[5] = 2 * (y * z - x * w)
        row[6] = 2 * (x * z - y * w)
        row[7] = 2 * (y * z + x * w)
        row[8] = 1 - 2 * (x * x + y * y)
        row[9], row[10], row[11] = t0, t1, t2
    new_canonical[:] = canonical
    for k in range(canonical.shape[0]):
        for n in range(free_ptr[k], free_ptr[k + 1]):
            new_canonical[k, free_slot[n]] += step[camera_block[k] * 8 + free_column[n]]
