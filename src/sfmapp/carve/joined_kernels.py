"""Kernels of :mod:`sfmapp.carve.joined`: what lines of sight say of nodes of a lattice, and the least energy on it.

All of them do a range of nodes and read nothing that another range writes, so that bytes are the same on any number of
threads.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.views import project_point

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
# Votes of a node by how far inside it is: the first is for free space, the last for what lies well behind a patch,
# those between are for distances from -1 to 1 of the band.
BINS = 10
# A patch seen at a slant is trusted as a plane this far along the ray, in widths of the band: beyond, a place in front
# of it is free however near it is to the plane, and one behind it is unknown.
_ALONG = 6.0
# what is beside a node: one that is there, or space that is empty or full for certain
EMPTY, FULL = -1, -2


@numba.njit(cache=True, nogil=True)
def vote(
    xyz: Array, outer: Array, k: Array, depth: Floats, normal: Floats, band: float, back: float,
    votes: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Add what one sight says of places (N, 3) to their votes (N, BINS).

    ``outer`` (3, 4) is from the world into the camera, ``k`` (4,) its pinhole, ``band`` in units of the world. Behind a
    patch it is full for ``back`` widths of the band, and beyond nobody knows.
    """
    height, width = depth.shape
    for i in range(xyz.shape[0]):
        x = outer[0, 0] * xyz[i, 0] + outer[0, 1] * xyz[i, 1] + outer[0, 2] * xyz[i, 2] + outer[0, 3]
        y = outer[1, 0] * xyz[i, 0] + outer[1, 1] * xyz[i, 1] + outer[1, 2] * xyz[i, 2] + outer[1, 3]
        z = outer[2, 0] * xyz[i, 0] + outer[2, 1] * xyz[i, 1] + outer[2, 2] * xyz[i, 2] + outer[2, 3]
        if not z > 0.0:
            continue
        px, py = x / z * k[0] + k[2], y / z * k[1] + k[3]
        if not (0.0 <= px < width and 0.0 <= py < height):
            continue
        u, v = int(px), int(py)
        surface = float(depth[v, u])
        if not surface > 0.0 or z - surface > _ALONG * band:
            continue
        rx, ry = (u + 0.5 - k[2]) / k[0], (v + 0.5 - k[3]) / k[1]
        ahead = normal[v, u, 0] * (x - surface * rx) + normal[v, u, 1] * (y - surface * ry)
        ahead += normal[v, u, 2] * (z - surface)
        share = -ahead / band
        if surface - z > _ALONG * band or share <= -1.0:
            at = 0
        elif share < 1.0:
            at = 1 + int(0.5 * (share + 1.0) * (BINS - 2))
        elif share < back:
            at = BINS - 1
        else:
            continue
        if votes[i, at] < 255:
            votes[i, at] += 1


@numba.njit(cache=True, nogil=True)
def find_flow(
    first: int, last: int, value: Floats, before: Floats, after: NDArray[np.int32], step: float, flow: Floats
) -> None:
    """Dual step of total variation: follow the slope of 2 value - before towards the neighbours ``after`` (N, 3)."""
    for i in range(first, last):
        own, norm = np.float32(2.0) * value[i] - before[i], np.float32(0.0)
        for axis in range(3):
            j = after[i, axis]
            other = np.float32(1.0 if j == FULL else -1.0) if j < 0 else np.float32(2.0) * value[j] - before[j]
            flow[i, axis] += np.float32(step) * (other - own)
            norm += flow[i, axis] * flow[i, axis]
        if norm > np.float32(1.0):
            shrink = np.float32(1.0) / np.float32(math.sqrt(norm))
            for axis in range(3):
                flow[i, axis] *= shrink


@numba.njit(cache=True, nogil=True)
def find_value(
    first: int, last: int, flow: Floats, prior: NDArray[np.int32], votes: NDArray[np.uint8], extra: Floats,
    is_fixed: NDArray[np.bool_], weight: float, step: float, value: Floats, before: Floats,
) -> None:  # fmt: skip
    """Primal step: against the divergence of the flow, then to the weighted median of the votes.

    ``prior`` (N, 3) are the neighbours before each node; ``extra`` (N,) votes for full. The sum of |value - vote| over
    the votes and half a square over steps is least at a median of 2 BINS + 1 numbers (Li and Osher, 2009); a walk over
    the bins finds it.
    """
    pull = weight * step
    for i in range(first, last):
        old = value[i]
        before[i] = old
        if is_fixed[i]:
            continue
        aim = float(old)
        total = float(extra[i])
        for axis in range(3):
            aim += step * flow[i, axis]
            if prior[i, axis] >= 0:
                aim -= step * flow[prior[i, axis], axis]
        for b in range(BINS):
            total += votes[i, b]
        slope, found = -total, math.nan
        for b in range(BINS):
            center = _bin_center(b)
            if aim - pull * slope <= center:
                found = aim - pull * slope
                break
            slope += 2.0 * (votes[i, b] + (extra[i] if b == BINS - 1 else 0.0))
            if aim - pull * slope <= center:
                found = center
                break
        if math.isnan(found):
            found = aim - pull * slope
        value[i] = np.float32(min(1.0, max(-1.0, found)))


@numba.njit(cache=True, nogil=True)
def _bin_center(b: int) -> float:
    if b == 0:
        return -1.0
    if b == BINS - 1:
        return 1.0
    return -1.0 + (2.0 * b - 1.0) / (BINS - 2)


@numba.njit(cache=True, nogil=True)
def paint(row: Array, xyz: Array, reach: float, covered: NDArray[np.bool_]) -> None:
    """Cover the pixels (H, W) of a view (29,) in which balls of a radius about places (N, 3) lie."""
    height, width = covered.shape
    for i in range(xyz.shape[0]):
        x, y, depth = project_point(row, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        if not (depth > 0.0 and -width < x < 2 * width and -height < y < 2 * height):
            continue
        radius = 0.5
        for axis in range(3):
            side = reach if axis == 0 else 0.0, reach if axis == 1 else 0.0, reach if axis == 2 else 0.0
            px, py, _ = project_point(row, xyz[i, 0] + side[0], xyz[i, 1] + side[1], xyz[i, 2] + side[2])
            radius = max(radius, math.hypot(px - x, py - y))
        for v in range(max(0, int(y - radius)), min(height, int(y + radius) + 1)):
            for u in range(max(0, int(x - radius)), min(width, int(x + radius) + 1)):
                covered[v, u] = True


@numba.njit(cache=True, nogil=True)
def mark_behind(row: Array, xyz: Array, missing: NDArray[np.bool_], marked: NDArray[np.bool_]) -> None:
    """Mark the places (N, 3) that lie on rays through pixels (H, W) of a view (29,)."""
    height, width = missing.shape
    for i in range(xyz.shape[0]):
        x, y, depth = project_point(row, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        if depth > 0.0 and 0.0 <= x < width and 0.0 <= y < height and missing[int(y), int(x)]:
            marked[i] = True
