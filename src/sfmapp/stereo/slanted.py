"""Disparities between whole pixels: a slanted plane through each pixel, by Gauss-Newton on the zero-mean NCC.

The terms are those of the dense patches, ``dense/window.py``: on a rectified pair a plane of disparity
``d + a du + b dv`` maps the window about (u, v) to ``(u - d + (1 - a) du - b dv, v + dv)``, and moves it along the row.
What semi-global matching found is the prior of the plane: where the pictures say little it stays.

With an equal noise in both pictures the NCC of the right plane is the share rho of the signal in the variance. What
slopes of noise add to the normal matrix is no information, so it counts by rho^2, over the variance 2 (1 - rho) of the
normalised residuals.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numba import float32 as f32
from numpy.typing import NDArray

from sfmapp.dense.window import (
    HALF,
    NUM_EFFECTIVE,
    NUM_SUMS,
    SUMS,
    correlate_with_terms,
    make_scratch,
    read_reference,
    solve3,
)
from sfmapp.simd.bilinear import pack_quads
from sfmapp.simd.pointers import Index, Pointer, offset, pointer

Floats = NDArray[np.float32]
Quads = NDArray[np.uint32]

STEPS = 2
# of the prior: 1 / variance of a disparity (0.18 px) and of a slope (0.04 px per px). Twice as firm, photographs lose
# what noisy rendered pairs do not gain
DISPARITY_PRIOR, SLOPE_PRIOR = f32(30.0), f32(700.0)
# 1 - NCC that noise leaves at best
LEAST_MISMATCH = f32(0.01)
# how much better the NCC has to become for a step to count
LEAST_GAIN = f32(1e-4)
# planes that leave their disparity by more have lost it, pixels
MOST_WAY_PX = f32(1.0)
# pixels on both sides that tell the slope
REACH = 3


@numba.njit(cache=True, nogil=True)
def slope_along(values: Pointer, step: Index) -> float:
    """Pixels per pixel along a step, from pairs on opposite sides whose mean is the value in the middle."""
    total, weights = f32(0.0), f32(0.0)
    for n in range(1, REACH + 1):
        before, behind = values[-n * step], values[n * step]
        off = f32(0.5) * (before + behind) - values[0]
        weight = f32(1.0) - off * off
        if weight > f32(0.0) and abs(behind - before) < f32(2.0 * n):
            total += weight * f32(n) * (behind - before)
            weights += weight * f32(2 * n * n)
    # one pair alone would make a slope of its noise
    return total / (weights + f32(4.0))


@numba.njit(cache=True, nogil=True)
def refine_rows(
    left: Quads, right: Quads, disparity: Floats, contrast: float, rows: tuple[int, int], scratch: Floats, out: Floats
) -> None:
    """Refine (H, W) disparities of a range of rows.

    Args:
        left, right: (H, W) packed pictures, see :func:`sfmapp.simd.bilinear.pack_quads`.
        contrast: of :func:`sfmapp.dense.window.read_reference`.
        scratch: of :func:`sfmapp.dense.window.make_scratch`.
    """
    height, width = disparity.shape
    values, source, target, work = pointer(disparity), pointer(left), pointer(right), pointer(scratch)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            first = disparity[y, x]
            out[y, x] = first
            inside = x > HALF and y > HALF and x < width - HALF - 2 and y < height - HALF - 2
            if not inside or not np.isfinite(first):
                continue
            here = offset(values, y * width + x)
            start_a, start_b = slope_along(here, 1), slope_along(here, width)
            if read_reference(source, width, x, y, f32(contrast), work) <= f32(0.0):
                continue
            d, a, b = first, start_a, start_b
            best, found = f32(-1.0), first
            for n in range(STEPS + 1):
                reach = f32(HALF) * (abs(f32(1.0) - a) + abs(b))
                if not (x - d - reach >= f32(0.0) and x - d + reach < f32(width - 2)):
                    break
                for k in range(NUM_SUMS):
                    work[SUMS + k] = f32(0.0)
                rho = correlate_with_terms(
                    target, width, f32(x) - d, f32(y), f32(1.0) - a, f32(0.0), -b, f32(1.0), f32(-1.0), f32(0.0), work
                )
                if rho <= best + LEAST_GAIN:
                    break
                best, found = rho, d
                if n == STEPS:
                    break
                share = max(rho, f32(0.0))
                scale = work[NUM_EFFECTIVE] * share * share / (f32(2.0) * max(f32(1.0) - rho, LEAST_MISMATCH))
                normal = (
                    scale * work[SUMS] + DISPARITY_PRIOR, scale * work[SUMS + 1], scale * work[SUMS + 2],
                    scale * work[SUMS + 3] + SLOPE_PRIOR, scale * work[SUMS + 4], scale * work[SUMS + 5] + SLOPE_PRIOR,
                )  # fmt: skip
                step_d, step_a, step_b, solved = solve3(
                    normal,
                    scale * work[SUMS + 6] - DISPARITY_PRIOR * (d - first),
                    scale * work[SUMS + 7] - SLOPE_PRIOR * (a - start_a),
                    scale * work[SUMS + 8] - SLOPE_PRIOR * (b - start_b),
                )
                d, a, b = d + step_d, a + step_a, b + step_b
                if not solved or abs(d - first) > MOST_WAY_PX:
                    break
            out[y, x] = found


def refine_slanted(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparity: Floats, contrast: float, threads: int = 1
) -> Floats:
    """Disparities (H, W) of a slanted plane through each pixel; NaN stays NaN.

    Args:
        left, right: (H, W) grey values.
        disparity: to within a pixel.
        contrast: difference in grey at which a pixel counts a quarter of the one in the middle of its window.
        threads: 1 or 2; what is found does not depend on it.
    """
    quads = pack_quads(left), pack_quads(right)
    start, out = np.ascontiguousarray(disparity, np.float32), np.empty(disparity.shape, np.float32)
    middle = len(start) // 2

    def refine(rows: tuple[int, int]) -> None:
        refine_rows(*quads, start, contrast, rows, make_scratch(), out)

    parts = [(0, middle), (middle, len(start))]
    if threads == 1:
        for rows in parts:
            refine(rows)
    else:
        with ThreadPoolExecutor(len(parts)) as pool:
            list(pool.map(refine, parts))
    return out
