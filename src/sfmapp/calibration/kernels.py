"""The normal equations of a calibration: one camera, many views of known points, each view with a pose of its own."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens

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

    Args:
        param_of_slot: (16,) which parameter a number of the canonical row is; -1 for one that is not refined.
    """
    num_bends, num_shared = obs.bends.shape[1], len(normal.right)
    num_params = num_shared - num_bends
    normal.shared[:], normal.right[:] = 0.0, 0.0
    normal.cross[:], normal.own[:], normal.own_right[:] = 0.0, 0.0, 0.0
    J = np.empty(lens.JACOBIAN)
    A = np.empty((2, num_shared + 6))
    H = np.empty((num_shared + 6, num_shared + 6))
    g = np.empty(num_shared + 6)
    cost = 0.0
    for v in range(len(obs.ptr) - 1):
        R, t = state.rotation[v], state.translation[v]
        H[:], g[:] = 0.0, 0.0
        for i in range(obs.ptr[v], obs.ptr[v + 1]):
            weight = obs.weight[i]
            if weight == 0.0:
                continue
            X, Y, Z = obs.xyz[i, 0], obs.xyz[i, 1], obs.xyz[i, 2]
            for b in range(num_bends):
                Z += obs.bends[i, b] * state.bend[b]
            x = R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]
            y = R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]
            z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
            lens.project_jacobian(state.row, x, y, z, J)
            ru, rv = obs.xy[i, 0] - J[0], obs.xy[i, 1] - J[1]
            if not math.isfinite(ru + rv):
                return math.inf
            A[:] = 0.0
            for k in range(16):
                p = param_of_slot[k]
                if p >= 0:
                    A[0, p] += J[8 + 2 * k]
                    A[1, p] += J[9 + 2 * k]
            for b in range(num_bends):
                bend = obs.bends[i, b]
                A[0, num_params + b] = bend * (J[2] * R[0, 2] + J[3] * R[1, 2] + J[4] * R[2, 2])
                A[1, num_params + b] = bend * (J[5] * R[0, 2] + J[6] * R[1, 2] + J[7] * R[2, 2])
            for a in range(2):
                du, dv, dw = J[2 + 3 * a], J[3 + 3 * a], J[4 + 3 * a]
                # a small turn w moves the point by w x p
                A[a, num_shared] = dw * y - dv * z
                A[a, num_shared + 1] = du * z - dw * x
                A[a, num_shared + 2] = dv * x - du * y
                A[a, num_shared + 3], A[a, num_shared + 4], A[a, num_shared + 5] = du, dv, dw
            cost += 0.5 * weight * (ru * ru + rv * rv)
            for a in range(num_shared + 6):
                p, q = weight * A[0, a], weight * A[1, a]
                g[a] += p * ru + q * rv
                for b in range(a + 1):
                    H[a, b] += p * A[0, b] + q * A[1, b]
        for a in range(num_shared):
            normal.right[a] += g[a]
            for b in range(a + 1):
                normal.shared[a, b] += H[a, b]
            for b in range(6):
                normal.cross[v, a, b] = H[num_shared + b, a]
        for a in range(6):
            normal.own_right[v, a] = g[num_shared + a]
            for b in range(a + 1):
                normal.own[v, a, b] = normal.own[v, b, a] = H[num_shared + a, num_shared + b]
    for a in range(num_shared):
        for b in range(a):
            normal.shared[b, a] = normal.shared[a, b]
    return cost
