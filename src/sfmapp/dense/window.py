"""The photometric kernels: a window of the reference image, its warp into a source image, and how well the two agree.

A patch is a plane whose inverse depth is linear in the pixels (u, v) of its reference image,
``w = w0 + wx (u - u0) + wy (v - v0)``. With A = Ks R Kr^-1 and b = Ks t of the relative pose it is seen in a source
image at ``q = A (u, v, 1) + b w``, ``x = q[:2] / q[2]``, linearised at the centre of the window. All that the plane can
change is w, and ``dx/dw`` is one direction, that of the epipolar line; so Gauss-Newton on the zero-mean normalised
cross-correlation (NCC) needs only the slope of the source image along it, and costs little more than the correlation
itself.

The window is the 29 pixels of a disc, weighted: a pixel counts less the further it lies from the centre and the more it
differs from it, so that a window across the edge of an object follows what its centre shows (as in Yoon and Kweon, PAMI
2006). One so small is at home in front of edges and on thin things; what it lacks in certainty comes back where
neighbours settle on a common course, and depth to start from comes from coarser levels. Sums are over two rows of 16;
the last three lanes weigh nothing.

``work`` is a scratch of SCRATCH floats: the offsets of the pixels, the weights, weights times the normalised reference,
the sums of Gauss-Newton, a copy of them, the NCC of up to 16 images twice, a plane, and how weights fall off with
distance. Coordinates here are index coordinates: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numba import float32 as f32
from numpy.typing import NDArray

from sfmapp.simd.bilinear import quad_pixels, sample_quads, sample_quads_with_slopes
from sfmapp.simd.f32x16 import add, divide, fma, load, multiply, splat, store, subtract, total
from sfmapp.simd.pointers import Index, Pointer, offset

HALF = 3
SIZE = 32
# where in the scratch the parts begin
DX, DY, WEIGHT, REFERENCE, SUMS = 0, SIZE, 2 * SIZE, 3 * SIZE, 4 * SIZE
NUM_SUMS = 9
KEPT, TRIAL, RHOS, BEST = SUMS + 16, SUMS + 32, SUMS + 48, SUMS + 64
# pixels of even weight that say as much as those of the window
NUM_EFFECTIVE = SUMS + 67
# grey value of the centre, from which all others are counted: float32 keeps the variance of windows with little of it
CENTER = SUMS + 68
FALL_OFF = SUMS + 72
SCRATCH = FALL_OFF + SIZE
# deviation of the weights about the centre. Rendered scenes, 1.2 to 2: on noisy photographs 1.5 is best by a tenth of a
# point of F, on clean ones and thin bars 1.2
SPREAD_PX = 1.3
# neighbours that a view can have
MOST_SLOTS = 16

_OFFSETS = [(x, y) for y in range(-HALF, HALF + 1) for x in range(-HALF, HALF + 1) if x * x + y * y <= HALF * HALF]
NUM_PIXELS = len(_OFFSETS)

# a source window may be this much smaller or larger in area than the reference window
SMALLEST_AREA, LARGEST_AREA = f32(0.15), f32(6.0)
# variance of a window below which it shows nothing but the rounding of its grey values
FLAT_VARIANCE = f32(0.5)


def make_scratch() -> NDArray[np.float32]:
    """(SCRATCH,) float32 with the offsets of the window in their place."""
    work = np.zeros(SCRATCH, np.float32)
    work[DX : DX + NUM_PIXELS] = [x for x, _ in _OFFSETS]
    work[DY : DY + NUM_PIXELS] = [y for _, y in _OFFSETS]
    work[FALL_OFF : FALL_OFF + NUM_PIXELS] = [
        math.exp(-(x * x + y * y) / (2.0 * SPREAD_PX * SPREAD_PX)) for x, y in _OFFSETS
    ]
    return work


@numba.njit(cache=True, nogil=True)
def read_reference(quads: Pointer, width: int, u: Index, v: Index, contrast: float, work: Pointer) -> float:
    """Fill weights and reference of the scratch from the window about pixel (u, v); its standard deviation in grey.

    ``contrast``: the difference in grey at which a pixel's weight has fallen to one quarter. Zero if it is flat.
    """
    base = offset(quads, np.int64(v) * width + u)
    work[CENTER] = f32(np.int32(base[0] & np.uint32(255)))
    center = splat(work[CENTER])
    scale, one = splat(f32(1.0) / contrast), splat(f32(1.0))
    weights = mean = square = splat(f32(0.0))
    for k in range(0, SIZE, 16):
        value = subtract(quad_pixels(base, width, load(work, DX + k), load(work, DY + k)), center)
        difference = multiply(value, scale)
        weight = divide(one, fma(difference, difference, one))
        weight = multiply(multiply(weight, weight), load(work, FALL_OFF + k))
        store(work, WEIGHT + k, weight)
        store(work, REFERENCE + k, value)
    for k in range(0, SIZE, 16):
        weight, value = load(work, WEIGHT + k), load(work, REFERENCE + k)
        weights, mean = add(weights, weight), fma(weight, value, mean)
        square = fma(multiply(weight, value), value, square)
    scale_of_weights = f32(1.0) / total(weights)
    m = total(mean) * scale_of_weights
    variance = total(square) * scale_of_weights - m * m
    if variance < FLAT_VARIANCE:
        return f32(0.0)
    deviation = f32(math.sqrt(variance))
    crowd = splat(f32(0.0))
    unit, middle, over = splat(scale_of_weights), splat(m), splat(f32(1.0) / deviation)
    for k in range(0, SIZE, 16):
        weight = multiply(load(work, WEIGHT + k), unit)
        crowd = fma(weight, weight, crowd)
        store(work, WEIGHT + k, weight)
        store(work, REFERENCE + k, multiply(weight, multiply(subtract(load(work, REFERENCE + k), middle), over)))
    work[NUM_EFFECTIVE] = f32(1.0) / total(crowd)
    return deviation


@numba.njit(cache=True, nogil=True)
def warp(
    a: Pointer, b: Pointer, u: float, v: float, w0: float, wx: float, wy: float, width: int, height: int
) -> tuple[bool, float, float, float, float, float, float, float, float]:
    """Where the window of a plane lies in a source image: (is inside, x, y, dx/du, dy/du, dx/dv, dy/dv, dx/dw, dy/dw).

    ``a``, ``b``: pointers to the nine and three numbers of the pair. Not inside: partly out of the image, behind the
    camera, seen from behind, or shrunk or stretched too much.
    """
    scale = a[6] * u + a[7] * v + a[8] + b[2] * w0
    if not scale > f32(1e-6):
        return False, f32(0), f32(0), f32(0), f32(0), f32(0), f32(0), f32(0), f32(0)
    over = f32(1.0) / scale
    x = (a[0] * u + a[1] * v + a[2] + b[0] * w0) * over
    y = (a[3] * u + a[4] * v + a[5] + b[1] * w0) * over
    ex, ey = (b[0] - x * b[2]) * over, (b[1] - y * b[2]) * over
    xu, yu = (a[0] - x * a[6]) * over + ex * wx, (a[3] - y * a[6]) * over + ey * wx
    xv, yv = (a[1] - x * a[7]) * over + ex * wy, (a[4] - y * a[7]) * over + ey * wy
    reach_x, reach_y = f32(HALF) * (abs(xu) + abs(xv)), f32(HALF) * (abs(yu) + abs(yv))
    area = xu * yv - xv * yu
    inside = (
        x - reach_x >= f32(0.0) and y - reach_y >= f32(0.0)
        and x + reach_x < f32(width - 1) and y + reach_y < f32(height - 1)
        and area > SMALLEST_AREA and area < LARGEST_AREA
    )  # fmt: skip
    return inside, x, y, xu, yu, xv, yv, ex, ey


@numba.njit(cache=True, nogil=True)
def correlate(
    quads: Pointer, width: int, x: float, y: float, xu: float, yu: float, xv: float, yv: float, work: Pointer
) -> float:
    """Weighted NCC, -1 to 1, of the reference in the scratch with the source window; 0 if that is flat."""
    x0, y0, xu_, yu_, xv_, yv_ = splat(x), splat(y), splat(xu), splat(yu), splat(xv), splat(yv)
    mean = square = product = splat(f32(0.0))
    center = splat(work[CENTER])
    for k in range(0, SIZE, 16):
        du, dv = load(work, DX + k), load(work, DY + k)
        value = sample_quads(quads, width, fma(dv, xv_, fma(du, xu_, x0)), fma(dv, yv_, fma(du, yu_, y0)))
        value = subtract(value, center)
        weighted = multiply(load(work, WEIGHT + k), value)
        mean, square = add(mean, weighted), fma(weighted, value, square)
        product = fma(load(work, REFERENCE + k), value, product)
    m = total(mean)
    variance = total(square) - m * m
    if variance < FLAT_VARIANCE:
        return f32(0.0)
    return total(product) / f32(math.sqrt(variance))


@numba.njit(cache=True, nogil=True)
def correlate_with_terms(
    quads: Pointer, width: int, x: float, y: float, xu: float, yu: float, xv: float, yv: float, ex: float, ey: float,
    work: Pointer,
) -> float:  # fmt: skip
    """As :func:`correlate`; adds the terms of Gauss-Newton on (w0, wx, wy) to the sums of the scratch.

    The residual is the normalised reference minus the normalised source window. Its normal matrix (00 01 02 11 12 22)
    and right-hand side (0 1 2) are sums over the window with weights that add up to one.
    """
    x0, y0, xu_, yu_, xv_, yv_ = splat(x), splat(y), splat(xu), splat(yu), splat(xv), splat(yv)
    ex_, ey_, center = splat(ex), splat(ey), splat(work[CENTER])
    zero = splat(f32(0.0))
    mean = square = product = zero
    d0 = d1 = d2 = v0 = v1 = v2 = r0 = r1 = r2 = zero
    n00 = n01 = n02 = n11 = n12 = n22 = zero
    for k in range(0, SIZE, 16):
        du, dv = load(work, DX + k), load(work, DY + k)
        value, gx, gy = sample_quads_with_slopes(
            quads, width, fma(dv, xv_, fma(du, xu_, x0)), fma(dv, yv_, fma(du, yu_, y0))
        )
        value, slope = subtract(value, center), fma(gx, ex_, multiply(gy, ey_))
        weight, reference = load(work, WEIGHT + k), load(work, REFERENCE + k)
        weighted = multiply(weight, value)
        mean, square, product = add(mean, weighted), fma(weighted, value, square), fma(reference, value, product)
        ws = multiply(weight, slope)
        wsu, wsv = multiply(ws, du), multiply(ws, dv)
        d0, d1, d2 = add(d0, ws), add(d1, wsu), add(d2, wsv)
        v0, v1, v2 = fma(ws, value, v0), fma(wsu, value, v1), fma(wsv, value, v2)
        rs = multiply(reference, slope)
        r0, r1, r2 = add(r0, rs), fma(rs, du, r1), fma(rs, dv, r2)
        su, sv = multiply(slope, du), multiply(slope, dv)
        n00, n01, n02 = fma(ws, slope, n00), fma(wsu, slope, n01), fma(wsv, slope, n02)
        n11, n12, n22 = fma(wsu, su, n11), fma(wsu, sv, n12), fma(wsv, sv, n22)
    m = total(mean)
    variance = total(square) - m * m
    if variance < FLAT_VARIANCE:
        return f32(0.0)
    over = f32(1.0) / f32(math.sqrt(variance))
    rho, over2 = total(product) * over, over * over
    s0, s1, s2 = total(d0), total(d1), total(d2)
    a0, a1, a2 = (total(v0) - s0 * m) * over, (total(v1) - s1 * m) * over, (total(v2) - s2 * m) * over
    work[SUMS + 0] += (total(n00) - s0 * s0 - a0 * a0) * over2
    work[SUMS + 1] += (total(n01) - s0 * s1 - a0 * a1) * over2
    work[SUMS + 2] += (total(n02) - s0 * s2 - a0 * a2) * over2
    work[SUMS + 3] += (total(n11) - s1 * s1 - a1 * a1) * over2
    work[SUMS + 4] += (total(n12) - s1 * s2 - a1 * a2) * over2
    work[SUMS + 5] += (total(n22) - s2 * s2 - a2 * a2) * over2
    work[SUMS + 6] += (total(r0) - a0 * rho) * over
    work[SUMS + 7] += (total(r1) - a1 * rho) * over
    work[SUMS + 8] += (total(r2) - a2 * rho) * over
    return rho


@numba.njit(cache=True, nogil=True)
def solve3(
    n: tuple[float, float, float, float, float, float], g0: float, g1: float, g2: float
) -> tuple[float, float, float, bool]:
    """x of the symmetric system N x = g, N as (00, 01, 02, 11, 12, 22); zeros and False where it is singular."""
    n00, n01, n02, n11, n12, n22 = n
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    determinant = n00 * c00 + n01 * c01 + n02 * c02
    if not determinant > f32(1e-6) * n00 * n11 * n22:
        return f32(0.0), f32(0.0), f32(0.0), False
    over = f32(1.0) / determinant
    c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
    x0 = (c00 * g0 + c01 * g1 + c02 * g2) * over
    x1 = (c01 * g0 + c11 * g1 + c12 * g2) * over
    x2 = (c02 * g0 + c12 * g1 + c22 * g2) * over
    return x0, x1, x2, True
