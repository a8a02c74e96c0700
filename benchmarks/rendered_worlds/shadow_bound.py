"""What shadows could take away of a solid's hull at best, whatever finds and carves them."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from rendered_worlds.lit_solids import Rig
from rendered_worlds.solids import Solid, _distance, _trace
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


def shares_shown(solid: Solid, rig: Rig, air: Array) -> tuple[float, float]:
    """Of places beside a solid, air (N, 3): the share that some camera sees, with what lies behind in shadow under a
    light that reaches the place; and the share of those for which the shadow is thrown by something else.

    Nothing else can be carved by shadows, at any number of cells and pixels: in front of a lit surface light and camera
    vouch for nothing, and a place that one of them does not reach may hold anything.
    """
    cameras = np.array([rigid3.center(pose) for pose in rig.poses])
    shown = np.zeros((len(air), 2), np.bool_)
    _find_shown(solid.shapes, solid.reach, cameras, np.array(rig.lamps), np.ascontiguousarray(air), shown)
    return float(shown.any(axis=1).mean()), float(shown[:, 1].mean())


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_shown(
    shapes: Array, reach: float, cameras: Array, lamps: Array, air: Array, shown: NDArray[np.bool_]
) -> None:
    """Marks in (N, 2): with the surface behind turned away from the light, and towards it."""
    for n in range(air.shape[0]):
        x = air[n]
        for v in range(cameras.shape[0]):
            c = cameras[v] - x
            range_c = math.sqrt(c @ c)
            c /= range_c
            if _trace(shapes, reach, x[0], x[1], x[2], c[0], c[1], c[2], 0.0, range_c) < math.inf:
                continue
            t = _trace(shapes, reach, x[0], x[1], x[2], -c[0], -c[1], -c[2], 0.0, 1e9)
            if t == math.inf:
                continue
            p = x - t * c
            normal = np.empty(3)
            for a in range(3):
                e = np.zeros(3)
                e[a] = 1e-5 * reach
                normal[a] = (
                    _distance(shapes, p[0] + e[0], p[1] + e[1], p[2] + e[2])[0]
                    - _distance(shapes, p[0] - e[0], p[1] - e[1], p[2] - e[2])[0]
                )
            normal /= math.sqrt(normal @ normal)
            p = p + 4e-4 * reach * normal
            for k in range(lamps.shape[1]):
                to = lamps[v, k] - x
                away = math.sqrt(to @ to)
                to /= away
                if _trace(shapes, reach, x[0], x[1], x[2], to[0], to[1], to[2], 0.0, away) < math.inf:
                    continue
                to = lamps[v, k] - p
                away = math.sqrt(to @ to)
                to /= away
                if normal @ to <= 0.0:
                    shown[n, 0] = True
                elif _trace(shapes, reach, p[0], p[1], p[2], to[0], to[1], to[2], 0.0, away) < math.inf:
                    shown[n, 1] = True
            if shown[n, 1]:
                break
