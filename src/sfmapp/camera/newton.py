"""One step of Newton's method for a lens that bends a plane: towards the point whose image is given."""

from __future__ import annotations

import math

import numba


@numba.njit(cache=True, nogil=True, inline="always")
def step(
    x: float, y: float, e0: float, e1: float, xx: float, xy: float, yx: float, yy: float
) -> tuple[float, float, float]:
    """The next point and the squared length of the step to it.

    Beyond the fold of the lens, where it is not one to one, it goes halfway to the middle, and the length is infinite.

    Args:
        x, y: the point. e0, e1: its image less the one that is wanted.
        xx, xy, yx, yy: derivatives of the image's x by x and y, and of its y.
    """
    det = xx * yy - xy * yx
    if not (det > 1e-9 and xx + yy > 0.0):
        return 0.5 * x, 0.5 * y, math.inf
    dx, dy = (yy * e0 - xy * e1) / det, (xx * e1 - yx * e0) / det
    return x - dx, y - dy, dx * dx + dy * dy
