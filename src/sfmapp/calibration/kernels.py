"""The normal equations of a calibration: one camera, many views of known points, each view with a pose of its own."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.geometry.damped import solve_damped, turn_columns
from sfmapp.simd.f64x8 import WIDTH, add8
from sfmapp.simd.pointers import Pointer, offset, pointer

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Observations(NamedTuple):
    """N points of V views.

    Attributes:
        ptr: (V + 1) int64, the points of view v are ``ptr[v]:ptr[v + 1]``.
        xyz: (N, 3) in the frame of the target.
        bends: (N, B) by how much each number of the target's shape moves a point along its z; B is 0 for a flat one.
        xy: (N, 2) pixels.
        weight: (N,) of the squared residuals.
    """

    ptr: Ints
    xyz: Array
    bends: Array
    xy: Array
    weight: Array


class State(NamedTuple):
    """The unknowns.

    Attributes:
        row: (17,) canonical row of the camera.
        rotation, translation: (V, 3, 3) and (V, 3), cam_from_target.
        bend: (B,) shape of the target.
    """

    row: Array
    rotation: Array
    translation: Array
    bend: Array


class Normal(NamedTuple):
    """Normal equations; S unknowns that all views share (parameters, then the shape), six of each view (turn, shift, in
    the camera's frame).

    Attributes:
        shared: (S, S). cross: (V, S, 6). own: (V, 6, 6). right: (S,). own_right: (V, 6).
    """

    shared: Array
    cross: Array
    own: Array
    right: Array
    own_right: Array


@numba.njit(cache=True, nogil=True)
def residuals(state: State, obs: Observations, out: Array) -> None:
    """Fill out (N, 2) with measured minus projected pixels; NaN where the lens does not look."""
    num_bends = obs.bends.shape[1]
    for v in range(len(obs.ptr) - 1):
        R, t = state.rotation[v], state.translation[v]
        for i in range(obs.ptr[v], obs.ptr[v + 1]):
            X, Y, Z = obs.xyz[i, 0], obs.xyz[i, 1], obs.xyz[i, 2]
            for b in range(num_bends):
                Z += obs.bends[i, b] * state.bend[b]
            x = R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]
            y = R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]
            z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
            u, w = lens.project(state.row, x, y, z)
            out[i, 0], out[i, 1] = obs.xy[i, 0] - u, obs.xy[i, 1] - w


@numba.njit(cache=True, nogil=True)
def normal_equations(state: State, obs: Observations, param_of_slot: Ints, normal: Normal) -> float:
    """Fill the normal equations and give the cost, half the weighted squares; infinite where the lens does not look.

    Every view adds A^T A, where A has two rows for a point: its derivatives, with the residual as their last column.
    One product fills all blocks.

    Args:
        param_of_slot: (16,) which parameter a number of the canonical row is; -1 for one that is not refined.
    """
    num_shared, largest = len(normal.right), 0
    for v in range(len(obs.ptr) - 1):
        largest = max(largest, obs.ptr[v + 1] - obs.ptr[v])
    first, last = num_shared, num_shared + 6
    num_strips = last // WIDTH + 1
    # columns of A in strips of eight, rows end to end; blocks of eight rows are multiplied
    stride = WIDTH * WIDTH * ((2 * largest + WIDTH - 1) // WIDTH)
    A = np.zeros(stride * num_strips)
    H = np.empty(WIDTH * WIDTH * (num_strips * (num_strips + 1) // 2))
    for a in range(num_shared):
        normal.right[a] = 0.0
        for b in range(num_shared):
            normal.shared[a, b] = 0.0
    cost = 0.0
    for v in range(len(obs.ptr) - 1):
        num_rows = _rows_of_view(state, obs, v, param_of_slot, num_shared, stride, pointer(A))
        if num_rows < 0:
            return math.inf
        H[:] = 0.0
        for row in range(0, num_rows, WIDTH):
            tile = 0
            for s in range(num_strips):
                left, columns = s * stride + WIDTH * row, min(WIDTH, last + 1 - WIDTH * s)
                for r in range(s + 1):
                    add8(H, tile, A, left, A, r * stride + WIDTH * row, columns)
                    tile += WIDTH * WIDTH
        cost += 0.5 * H[_place(last, last)]
        for a in range(num_shared):
            normal.right[a] += H[_place(last, a)]
            for b in range(a + 1):
                normal.shared[a, b] += H[_place(a, b)]
            for b in range(6):
                normal.cross[v, a, b] = H[_place(first + b, a)]
        for a in range(6):
            normal.own_right[v, a] = H[_place(last, first + a)]
            for b in range(a + 1):
                normal.own[v, a, b] = normal.own[v, b, a] = H[_place(first + a, first + b)]
    for a in range(num_shared):
        for b in range(a):
            normal.shared[b, a] = normal.shared[a, b]
    return cost


@numba.njit(cache=True, nogil=True)
def _rows_of_view(
    state: State, obs: Observations, v: int, param_of_slot: Ints, num_shared: int, stride: int, A: Pointer
) -> int:
    """Fill the rows of A of a view's points, each times the root of its weight, up to whole blocks of eight; how many
    these are, -1 where the lens does not look."""
    R, t, row, num_bends = state.rotation[v], state.translation[v], 0, len(state.bend)
    num_params = num_shared - num_bends
    derivatives, places = np.empty(lens.JACOBIAN), np.empty(num_shared + 7 + 2 * 16, np.int64)
    J, columns, slots, num_slots = pointer(derivatives), pointer(places), offset(pointer(places), num_shared + 7), 0
    for n in range(num_shared + 7):
        columns[n] = stride * (n // WIDTH) + n % WIDTH
    for k in range(16):
        if param_of_slot[k] >= 0:
            slots[2 * num_slots], slots[2 * num_slots + 1] = 8 + 2 * k, columns[param_of_slot[k]]
            num_slots += 1
    for i in range(obs.ptr[v], obs.ptr[v + 1]):
        if obs.weight[i] == 0.0:
            continue
        X, Y, Z = obs.xyz[i, 0], obs.xyz[i, 1], obs.xyz[i, 2]
        for b in range(num_bends):
            Z += obs.bends[i, b] * state.bend[b]
        x = R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]
        y = R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        lens.project_jacobian(state.row, x, y, z, derivatives)
        root = math.sqrt(obs.weight[i])
        ru, rv = root * (obs.xy[i, 0] - J[0]), root * (obs.xy[i, 1] - J[1])
        if not math.isfinite(ru + rv):
            return -1
        for a in range(2):
            at, d = WIDTH * row, 2 + 3 * a
            for n in range(num_params):
                A[at + columns[n]] = 0.0
            for k in range(num_slots):
                A[at + slots[2 * k + 1]] += root * J[slots[2 * k] + a]
            du, dv, dw = root * J[d], root * J[d + 1], root * J[d + 2]
            along, n = du * R[0, 2] + dv * R[1, 2] + dw * R[2, 2], num_params
            for b in range(num_bends):
                A[at + columns[n + b]] = obs.bends[i, b] * along
            n += num_bends
            # a small turn w moves the point by w x p
            A[at + columns[n]], A[at + columns[n + 1]] = dw * y - dv * z, du * z - dw * x
            A[at + columns[n + 2]], A[at + columns[n + 3]] = dv * x - du * y, du
            A[at + columns[n + 4]], A[at + columns[n + 5]] = dv, dw
            A[at + columns[n + 6]] = ru if a == 0 else rv
            row += 1
    while row % WIDTH:
        for n in range(num_shared + 7):
            A[WIDTH * row + columns[n]] = 0.0
        row += 1
    # numba counts arrays, not pointers: these are needed until here
    return row if len(derivatives) and len(places) else -1


@numba.njit(cache=True, nogil=True)
def _place(row: int, column: int) -> int:
    """Where an entry of the lower triangle is among tiles of 8 x 8."""
    s, t = row // WIDTH, column // WIDTH
    return int(WIDTH * (WIDTH * (s * (s + 1) // 2 + t) + row % WIDTH) + column % WIDTH)


@numba.njit(cache=True, nogil=True)
def damped_step(normal: Normal, damping: float, hold_poses: bool, shared_step: Array, own_step: Array) -> float:
    """Fill the damped step of the shared unknowns (S,) and of the views (V, 6), whose unknowns are eliminated by
    Cholesky's method, and give the decrease of the cost that it promises; NaN where there is no step.

    Unknowns that nothing measures, held parameters and empty views, stay.
    """
    num_shared, num_views = len(normal.right), len(normal.own)
    reduced, scale = np.empty((num_shared, num_shared)), np.empty(num_shared)
    right = np.empty(num_shared)
    for a in range(num_shared):
        # numbers that nothing measures get an equation of their own
        is_free = normal.shared[a, a] > 0.0
        scale[a] = 1.0 / math.sqrt(normal.shared[a, a]) if is_free else 0.0
        right[a] = -normal.right[a]
        for b in range(a + 1):
            reduced[a, b] = normal.shared[a, b]
    # L^-1 [cross^T, own_right] of every view, L L^T = its own block
    halves, factor = np.zeros((num_views, 6, num_shared + 1)), np.zeros((num_views, 6, 6))
    if not hold_poses:
        for v in range(num_views):
            if not normal.own[v, 0, 0] > 0.0:
                continue
            if not _eliminated(normal, v, damping, factor[v], halves[v]):
                return math.nan
            half = halves[v]
            for a in range(num_shared):
                for k in range(6):
                    right[a] += half[k, a] * half[k, num_shared]
                    for b in range(a + 1):
                        reduced[a, b] -= half[k, a] * half[k, b]
    for a in range(num_shared):
        right[a] *= scale[a]
        reduced[a, a] += damping * normal.shared[a, a]
        for b in range(a + 1):
            reduced[a, b] *= scale[a] * scale[b]
        if scale[a] == 0.0:
            reduced[a, a] = 1.0
    if not solve_damped(reduced, right, 0.0, np.empty((num_shared, num_shared)), shared_step):
        return math.nan
    # half of step . (right + damping diagonal step)
    twice = 0.0
    for a in range(num_shared):
        shared_step[a] *= scale[a]
        twice += shared_step[a] * (normal.right[a] + damping * normal.shared[a, a] * shared_step[a])
    for v in range(num_views):
        for k in range(5, -1, -1):
            value = 0.0
            if factor[v, k, k] > 0.0:
                value = halves[v, k, num_shared]
                for a in range(num_shared):
                    value -= halves[v, k, a] * shared_step[a]
                for m in range(k + 1, 6):
                    value -= factor[v, m, k] * own_step[v, m]
                value /= factor[v, k, k]
            own_step[v, k] = value
            twice += value * (normal.own_right[v, k] + damping * normal.own[v, k, k] * value)
    return 0.5 * twice


@numba.njit(cache=True, nogil=True)
def _eliminated(normal: Normal, v: int, damping: float, factor: Array, half: Array) -> bool:
    """Fill the Cholesky factor (6, 6) of a view's damped block and (6, S + 1) its quotient with the view's other
    blocks; False where the block is singular."""
    num_shared = len(normal.right)
    for i in range(6):
        for j in range(i + 1):
            value = normal.own[v, i, j] * (1.0 + damping) if i == j else normal.own[v, i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i != j:
                factor[i, j] = value / factor[j, j]
            elif value > 1e-15 * normal.own[v, i, i]:
                factor[i, i] = math.sqrt(value)
            else:
                return False
        for a in range(num_shared + 1):
            value = normal.cross[v, a, i] if a < num_shared else normal.own_right[v, i]
            for k in range(i):
                value -= factor[i, k] * half[k, a]
            half[i, a] = value / factor[i, i]
    return True


@numba.njit(cache=True, nogil=True)
def moved_poses(state: State, own_step: Array, rotation: Array, translation: Array) -> None:
    """Fill rotations (V, 3, 3) and translations (V, 3) of the views after a step (V, 6), turns and shifts."""
    before, after = np.empty((3, 4)), np.empty((3, 4))
    for v in range(len(own_step)):
        for i in range(3):
            before[i, 3] = state.translation[v, i]
            for j in range(3):
                before[i, j] = state.rotation[v, i, j]
        turn_columns(own_step[v], before, after)
        for i in range(3):
            translation[v, i] = after[i, 3] + own_step[v, 3 + i]
            for j in range(3):
                rotation[v, i, j] = after[i, j]
