"""One patch: its plane in different frames, its refinement on a few images, and the verdict of all of them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32 as f32

from sfmapp.dense.arrays import ImagePointers, Limits, StorePointers
from sfmapp.dense.window import (
    HALF,
    KEPT,
    NUM_EFFECTIVE,
    NUM_SUMS,
    SUMS,
    TRIAL,
    correlate,
    correlate_with_terms,
    solve3,
    warp,
)
from sfmapp.simd.pointers import Index, Pointer, offset

# how far two patches may lie off each other's planes to be of one surface, in cells
NEAR = 1.5
# and how far they have to lie off them to be two surfaces, one behind the other
APART = 8.0
MAX_STEPS = 4
# of the mean NCC; less is not worth another step
LEAST_GAIN = f32(0.001)
LONGEST_STEP_PX, SHORTEST_STEP_PX = f32(1.5), f32(0.02)
DAMPING = f32(0.01)
# how far from the centre of the window what tells its depth may lie on average, about the radius that the weights give
# it: beyond, depth is guessed, as it is beside the edge of an object before a blank background
LARGEST_LEAN_PX = 1.4
# pull of the slopes towards where they began, in units of the information on the depth
SLOPE_PRIOR = f32(0.3)
# cosine between normal and line of sight below which a patch is too oblique to be judged in a window of this size
LEAST_COSINE = 0.25
# of the widest angle between the lines of sight; below about 2.5 degrees depth is noise
LARGEST_COSINE_OF_ANGLE = math.cos(math.radians(2.5))


@numba.njit(cache=True, nogil=True)
def plane_in_view(images: ImagePointers, m: Index, xyz: Pointer, normal: Pointer) -> tuple[float, float, float]:
    """Plane through a place with a normal, seen by view m: inverse depth ``wu u + wv v + w`` as (wu, wv, w)."""
    r, t, k = offset(images.rotation, 9 * m), offset(images.translation, 3 * m), offset(images.k, 4 * m)
    n0 = r[0] * normal[0] + r[1] * normal[1] + r[2] * normal[2]
    n1 = r[3] * normal[0] + r[4] * normal[1] + r[5] * normal[2]
    n2 = r[6] * normal[0] + r[7] * normal[1] + r[8] * normal[2]
    x = r[0] * xyz[0] + r[1] * xyz[1] + r[2] * xyz[2] + t[0]
    y = r[3] * xyz[0] + r[4] * xyz[1] + r[5] * xyz[2] + t[1]
    z = r[6] * xyz[0] + r[7] * xyz[1] + r[8] * xyz[2] + t[2]
    distance = n0 * x + n1 * y + n2 * z
    if abs(distance) < 1e-12:
        return 0.0, 0.0, -1.0
    wu, wv = n0 / (distance * k[0]), n1 / (distance * k[1])
    return wu, wv, n2 / distance - wu * k[2] - wv * k[3]


@numba.njit(cache=True, nogil=True)
def project(images: ImagePointers, m: Index, xyz: Pointer) -> tuple[float, float, float]:
    """Pixel and depth (u, v, z) of a place in view m; z <= 0 behind it."""
    r, t, k = offset(images.rotation, 9 * m), offset(images.translation, 3 * m), offset(images.k, 4 * m)
    z = r[6] * xyz[0] + r[7] * xyz[1] + r[8] * xyz[2] + t[2]
    if z <= 1e-9:
        return 0.0, 0.0, 0.0
    x = r[0] * xyz[0] + r[1] * xyz[1] + r[2] * xyz[2] + t[0]
    y = r[3] * xyz[0] + r[4] * xyz[1] + r[5] * xyz[2] + t[1]
    return k[0] * x / z + k[2], k[1] * y / z + k[3], z


@numba.njit(cache=True, nogil=True)
def unproject(images: ImagePointers, m: Index, u: float, v: float, z: float, xyz: Pointer) -> float:
    """The place at depth z that view m sees at pixel (u, v), to ``xyz``; the length of the ray to depth one."""
    k, r, t = offset(images.k, 4 * m), offset(images.rotation, 9 * m), offset(images.translation, 3 * m)
    rx, ry = (u - k[2]) / k[0], (v - k[3]) / k[1]
    x0, x1, x2 = rx * z - t[0], ry * z - t[1], z - t[2]
    for j in range(3):
        xyz[j] = r[j] * x0 + r[3 + j] * x1 + r[6 + j] * x2
    return math.sqrt(rx * rx + ry * ry + 1.0)


@numba.njit(cache=True, nogil=True)
def normal_of_plane(
    images: ImagePointers, m: Index, u: float, v: float, w: float, wu: float, wv: float, normal: Pointer
) -> float:
    """Unit normal of a plane of view m, inverse depth w at pixel (u, v) with slopes wu, wv, to ``normal``; returns one
    over the distance of the plane from the camera."""
    k, r = offset(images.k, 4 * m), offset(images.rotation, 9 * m)
    # the inverse depth along a ray is the normal over the distance of the plane, times the ray: away from the camera
    n0, n1 = wu * k[0], wv * k[1]
    n2 = w - n0 * ((u - k[2]) / k[0]) - n1 * ((v - k[3]) / k[1])
    steep = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    for j in range(3):
        normal[j] = -(r[j] * n0 + r[3 + j] * n1 + r[6 + j] * n2) / steep
    return steep


@numba.njit(cache=True, nogil=True)
def cell_of(images: ImagePointers, m: Index, u: float, v: float) -> int:
    """Cell of a pixel in view m; -1 outside of the grid."""
    side = images.cell_px
    x, y = math.floor((u + 0.5) / side), math.floor((v + 0.5) / side)
    if x < 0 or y < 0 or x >= images.columns[m] or y >= images.rows[m]:
        return -1
    return images.cell_start[m] + np.int64(y) * images.columns[m] + np.int64(x)


@numba.njit(cache=True, nogil=True)
def off_planes(store: StorePointers, p: int, other: StorePointers, q: Index) -> float:
    """How far patch p of one store and q of another lie off each other's planes, in all (Furukawa and Ponce, eq. 6)."""
    x, n = offset(store.xyz, 3 * p), offset(store.normal, 3 * p)
    y, o = offset(other.xyz, 3 * q), offset(other.normal, 3 * q)
    d0, d1, d2 = y[0] - x[0], y[1] - x[1], y[2] - x[2]
    return abs(d0 * n[0] + d1 * n[1] + d2 * n[2]) + abs(d0 * o[0] + d1 * o[1] + d2 * o[2])


@numba.njit(cache=True, nogil=True)
def cell_size(images: ImagePointers, store: StorePointers, p: int) -> float:
    """What a cell measures at a patch."""
    return store.size[p] * f32(images.cell_px)


@numba.njit(cache=True, nogil=True)
def holds_window(images: ImagePointers, m: int, u: Index | float, v: Index | float) -> bool:
    """Whether the window about pixel (u, v) lies in view m, with the pixel beyond that bilinear samples need."""
    return bool(u >= HALF and v >= HALF and u < images.width[m] - HALF - 1 and v < images.height[m] - HALF - 1)


@numba.njit(cache=True, nogil=True)
def measure(
    images: ImagePointers, m: int, slot: Index, u: float, v: float, w0: float, wx: float, wy: float, work: Pointer
) -> float:
    """NCC of the reference in the scratch, of view m about (u, v), with the neighbour in a slot; -1 where unseen."""
    pair = np.int64(m) * images.num_slots + slot
    s = images.neighbors[pair]
    a, b = offset(images.a, 9 * pair), offset(images.b, 3 * pair)
    inside, x, y, xu, yu, xv, yv, _, _ = warp(a, b, u, v, w0, wx, wy, images.width[s], images.height[s])
    if not inside:
        return f32(-1.0)
    quads = offset(images.quads, images.start[s])
    return correlate(quads, images.width[s], x, y, xu, yu, xv, yv, work)


@numba.njit(cache=True, nogil=True)
def _terms(
    images: ImagePointers, m: int, slot: int, u: float, v: float, w0: float, wx: float, wy: float, work: Pointer
) -> tuple[float, float]:
    """As :func:`measure`, adding to the sums of the scratch; also the pixels that the image moves per inverse depth."""
    pair = np.int64(m) * images.num_slots + slot
    s = images.neighbors[pair]
    a, b = offset(images.a, 9 * pair), offset(images.b, 3 * pair)
    inside, x, y, xu, yu, xv, yv, ex, ey = warp(a, b, u, v, w0, wx, wy, images.width[s], images.height[s])
    if not inside:
        return f32(-1.0), f32(0.0)
    quads = offset(images.quads, images.start[s])
    rho = correlate_with_terms(quads, images.width[s], x, y, xu, yu, xv, yv, ex, ey, work)
    return rho, f32(math.sqrt(ex * ex + ey * ey))


@numba.njit(cache=True, nogil=True)
def _step(work: Pointer, shift1: float, shift2: float) -> tuple[float, float, float, bool]:
    """Step of Gauss-Newton from the sums; the shifts are how far the slopes lie from where they began."""
    pull = SLOPE_PRIOR * work[SUMS]
    more = f32(1.0) + DAMPING
    n = (
        work[SUMS] * more, work[SUMS + 1], work[SUMS + 2],
        work[SUMS + 3] * more + pull, work[SUMS + 4], work[SUMS + 5] * more + pull,
    )  # fmt: skip
    return solve3(n, work[SUMS + 6], work[SUMS + 7] + pull * shift1, work[SUMS + 8] + pull * shift2)


class Trial(NamedTuple):
    """Pointers to what is known of the patch that is being tried at a pixel.

    Attributes:
        plane: (3,) float32 w0, wx, wy.
        slots: (MOST_SLOTS,) int64 neighbours of the view. rhos: float32 their NCC.
        work: the scratch, which holds the window.
    """

    plane: Any
    slots: Any
    rhos: Any
    work: Any


@numba.njit(cache=True, nogil=True)
def refine(
    images: ImagePointers, m: int, u: float, v: float, trial: Trial, n: int, limits: Limits
) -> tuple[int, float]:
    """Gauss-Newton on the mean NCC over neighbours ``slots[:n]``, which are sifted by what they see at the start.

    The plane changes in place. Returns the number of slots left, with their NCC in ``rhos``, and the standard deviation
    of w0; 0 if that came to nothing, and their number below zero if fewer than ``limits.min_views - 1`` are promising.
    """
    plane, slots, rhos, work = trial
    s0, s1, s2 = plane[0], plane[1], plane[2]
    step0, step1, step2 = f32(0.0), f32(0.0), f32(0.0)
    first1, first2 = plane[1], plane[2]
    best, reach, sigma, lean = f32(-2.0), f32(0.0), f32(0.0), 0.0
    for it in range(MAX_STEPS + 1):
        for j in range(NUM_SUMS):
            work[SUMS + j] = f32(0.0)
        total, left = f32(0.0), 0
        for j in range(n):
            for i in range(NUM_SUMS):
                work[KEPT + i] = work[SUMS + i]
            rho, moves = _terms(images, m, slots[j], u, v, s0, s1, s2, work)
            if it == 0 and rho < f32(limits.promising):
                for i in range(NUM_SUMS):
                    work[SUMS + i] = work[KEPT + i]
                continue
            reach = max(reach, moves)
            slots[left], work[TRIAL + left] = slots[j], rho
            total += rho
            left += 1
        if it == 0:
            n = left
            if n < limits.min_views - 1:
                return -n, sigma
        mean = total / f32(n)
        if mean > best:
            gain, best = mean - best, mean
            plane[0], plane[1], plane[2] = s0, s1, s2
            for j in range(n):
                rhos[j] = work[TRIAL + j]
            step0, step1, step2, is_regular = _step(work, first1 - s1, first2 - s2)
            if not is_regular:
                return 0, sigma
            sigma = _sigma(work, best, n)
            lean = math.sqrt(work[SUMS + 1] ** 2 + work[SUMS + 2] ** 2) / max(work[SUMS], f32(1e-30))
            if it == MAX_STEPS or (it > 0 and gain < LEAST_GAIN):
                break
            length = abs(step0) * reach
            if length > LONGEST_STEP_PX:
                shorter = LONGEST_STEP_PX / length
                step0, step1, step2 = step0 * shorter, step1 * shorter, step2 * shorter
        else:
            step0, step1, step2 = step0 * f32(0.35), step1 * f32(0.35), step2 * f32(0.35)
            if abs(step0) * reach < SHORTEST_STEP_PX:
                break
        s0, s1, s2 = plane[0] + step0, plane[1] + step1, plane[2] + step2
        if not s0 > f32(0.0):
            break
    if lean > LARGEST_LEAN_PX:
        return 0, sigma
    return n, sigma


@numba.njit(cache=True, nogil=True)
def _sigma(work: Pointer, mean: float, num: int) -> float:
    """Standard deviation of w0 from the sums over so many images.

    A residual, the difference of two normalised windows, has the mean square 2 (1 - NCC), half of it from each. The
    half of the reference is the same for all images and does not average out among them.
    """
    pull = SLOPE_PRIOR * work[SUMS]
    n = (
        work[SUMS], work[SUMS + 1], work[SUMS + 2],
        work[SUMS + 3] + pull, work[SUMS + 4], work[SUMS + 5] + pull,
    )  # fmt: skip
    variance, _, _, is_regular = solve3(n, f32(1.0), f32(0.0), f32(0.0))
    if not is_regular or not variance > f32(0.0):
        return f32(0.0)
    square = f32(num + 1) * max(f32(1.0) - mean, f32(1e-4))
    return f32(math.sqrt(variance * square / work[NUM_EFFECTIVE]))


@numba.njit(cache=True, nogil=True)
def judge(
    images: ImagePointers, m: int, u: float, v: float, trial: Trial, n: int, sigma: float, limits: Limits,
    found: StorePointers, i: int,
) -> bool:  # fmt: skip
    """Ask the images that took no part, and enter the patch at ``found[i]`` if enough trust it; says whether it was.

    ``slots[:n]`` are those that did take part, with their ``rhos``.
    """
    plane, slots, rhos, work = trial
    found.num_views[i] = 0
    num_asked = n
    for slot in range(images.num_slots):
        if images.neighbors[m * images.num_slots + slot] < 0:
            break
        was_asked = False
        for j in range(n):
            was_asked = was_asked or slots[j] == slot
        if not was_asked:
            slots[num_asked] = slot
            rhos[num_asked] = measure(images, m, slot, u, v, plane[0], plane[1], plane[2], work)
            num_asked += 1
    # insertion sort, best first: few
    for j in range(1, num_asked):
        slot, rho = slots[j], rhos[j]
        k = j - 1
        while k >= 0 and rhos[k] < rho:
            slots[k + 1], rhos[k + 1] = slots[k], rhos[k]
            k -= 1
        slots[k + 1], rhos[k + 1] = slot, rho
    if num_asked < limits.min_views - 1 or not rhos[limits.min_views - 2] >= f32(limits.trusted):
        return False
    return _enter(images, m, u, v, trial, num_asked, sigma, limits, found, i)


@numba.njit(cache=True, nogil=True)
def _enter(
    images: ImagePointers, m: int, u: float, v: float, trial: Trial, num_asked: int, sigma: float, limits: Limits,
    found: StorePointers, i: int,
) -> bool:  # fmt: skip
    """Check the geometry of a patch that enough images trust, and write it down."""
    plane, slots, rhos, _ = trial
    k, center = offset(images.k, 4 * m), offset(images.center, 3 * m)
    w0 = np.float64(plane[0])
    z = 1.0 / w0
    xyz, normal = offset(found.xyz, 3 * i), offset(found.normal, 3 * i)
    ray = unproject(images, m, u, v, z, xyz)
    steep = normal_of_plane(images, m, u, v, w0, plane[1], plane[2], normal)
    if w0 / (steep * ray) < LEAST_COSINE:
        return False
    d0, d1, d2 = center[0] - xyz[0], center[1] - xyz[1], center[2] - xyz[2]
    distance = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    views = offset(found.views, i * found.row)
    num, total, widest = 1, f32(0.0), 1.0
    for j in range(num_asked):
        if not rhos[j] >= f32(limits.trusted):
            break
        s = np.int64(images.neighbors[m * images.num_slots + slots[j]])
        su, sv, _ = project(images, s, xyz)
        cell = cell_of(images, s, su, sv)
        if cell >= 0 and images.closed[cell] != 0:
            continue
        eye = offset(images.center, 3 * s)
        e0, e1, e2 = eye[0] - xyz[0], eye[1] - xyz[1], eye[2] - xyz[2]
        length = math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        if e0 * normal[0] + e1 * normal[1] + e2 * normal[2] < 0.5 * LEAST_COSINE * length:
            continue
        widest = min(widest, (d0 * e0 + d1 * e1 + d2 * e2) / (distance * length))
        views[num] = s
        total += rhos[j]
        num += 1
    if num < limits.min_views or widest > LARGEST_COSINE_OF_ANGLE:
        return False
    views[0] = m
    for j in range(num, found.row):
        views[j] = -1
    found.score[i] = total / f32(num - 1)
    found.size[i] = z / (0.5 * (k[0] + k[1]))
    found.sigma[i] = sigma * z * z * ray
    found.num_views[i] = num
    return True
