"""The inner loops of SIFT's descriptor (Lowe, IJCV 2004): orientations of keypoints and what lies around them.

Pixels are those of an octave, with the centre of the top-left one at (0, 0), as in :mod:`scale_space`.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.features.scale_space import NUM_LAYERS, SIGMA

# distance of the gradients that orientations and descriptors sample: the levels are so smooth that every second one
# gives the same matches for a quarter of the time
STRIDE = 2
_NUM_ORIENTATION_BINS = 36
# a second orientation must reach this share of the strongest
_PEAK_RATIO = 0.8
# width of a cell of the descriptor in sigmas of the keypoint
_CELL_SIGMAS = 3.0
# squared distances are looked up in a table of the Gaussian, up to where its value is 4e-6
_EXP_MAX = 12.5
_EXP_SIZE = 2048
_EXP_TABLE = np.exp(-np.arange(_EXP_SIZE + 1) * (_EXP_MAX / _EXP_SIZE)).astype(np.float32)
# gradients of one descriptor at most: the turned square of 5 x 5 cells at the largest scale of an octave
MAX_SAMPLES = int((5.0 * _CELL_SIGMAS * SIGMA * 2.0 ** (4.0 / 3.0) / STRIDE + 2.0) ** 2 * 1.2)

Floats = NDArray[np.float32]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _polar(gx: Floats, gy: Floats, num: int) -> None:
    """Replace gradients by their lengths and directions in [0, 2 pi], to 1e-5 (Abramowitz and Stegun 4.4.49).

    Written so that it becomes vector instructions; the check of Python's division would prevent that.
    """
    half_pi, pi, two_pi = np.float32(0.5 * math.pi), np.float32(math.pi), np.float32(2.0 * math.pi)
    zero, tiny = np.float32(0.0), np.float32(1e-30)
    c1, c3, c5 = np.float32(0.9998660), np.float32(-0.3302995), np.float32(0.1801410)
    c7, c9 = np.float32(-0.0851330), np.float32(0.0208351)
    for n in range(num):
        x, y = gx[n], gy[n]
        ax, ay = abs(x), abs(y)
        is_steep = ay > ax
        less, more = ax if is_steep else ay, ay if is_steep else ax
        a = less / (more + tiny)
        s = a * a
        t = a * (c1 + s * (c3 + s * (c5 + s * (c7 + s * c9))))
        t = half_pi - t if is_steep else t
        t = pi - t if x < zero else t
        t = two_pi - t if y < zero else t
        gx[n] = np.sqrt(x * x + y * y)
        gy[n] = t


@numba.njit(cache=True, nogil=True)
def _find_peaks(hist: NDArray[np.float64], max_num: int, out: NDArray[np.float64]) -> int:
    """Smooth the histogram in the first row and fill out with the angles of its highest peaks; returns how many."""
    num = _NUM_ORIENTATION_BINS
    for turn in range(6):
        source, target = hist[turn % 2], hist[(turn + 1) % 2]
        for b in range(num):
            target[b] = (source[b - 1] + source[b] + source[b + 1 if b + 1 < num else 0]) / 3.0
    smooth = hist[0]
    most = smooth[0]
    for b in range(1, num):
        most = max(most, smooth[b])
    limit = _PEAK_RATIO * most
    found = 0
    for _ in range(max_num):
        best, best_b = 0.0, -1
        for b in range(num):
            v = smooth[b]
            if v > best and v >= limit and v > smooth[b - 1] and v > smooth[b + 1 if b + 1 < num else 0]:
                taken = False
                for f in range(found):
                    taken |= hist[1, f] == b
                if not taken:
                    best, best_b = v, b
        if best_b < 0:
            break
        before, after = smooth[best_b - 1], smooth[best_b + 1 if best_b + 1 < num else 0]
        peak = best_b + 0.5 * (before - after) / (before + after - 2.0 * best)
        hist[1, found] = best_b
        out[found] = (peak * (2.0 * math.pi / num)) % (2.0 * math.pi)
        found += 1
    return found


@numba.njit(cache=True, nogil=True)
def find_orientations(
    level: Floats, x: float, y: float, sigma: float, max_num: int, samples: Floats, hist: NDArray[np.float64],
    out: NDArray[np.float64],
) -> int:  # fmt: skip
    """Peaks of the histogram of gradient directions around a keypoint, strongest first.

    Args:
        level: (H, W) float32, the level of the scale space that the keypoint was found in.
        x, y, sigma: of the keypoint, pixels.
        samples: (4, MAX_SAMPLES) float32 and hist: (2, 36) float64, working memory.
        out: (max_num,) float64, filled with angles in radians in [0, 2 pi), from x towards y.

    Returns:
        Number of angles, at most max_num.
    """
    height, width = level.shape
    num = _NUM_ORIENTATION_BINS
    window = 1.5 * sigma
    radius = int(3.0 * window)
    scale = np.float32(_EXP_SIZE / (_EXP_MAX * 2.0 * window * window))
    xi, yi = round(x), round(y)
    num_samples: Any = np.int64(0)  # a literal would have _polar compiled twice
    for r in range(max(1, yi - radius), min(height - 1, yi + radius + 1), STRIDE):
        dy = np.float32(r - y)
        before, row, after = level[r - 1], level[r], level[r + 1]
        for c in range(max(1, xi - radius), min(width - 1, xi + radius + 1), STRIDE):
            dx = np.float32(c - x)
            k = int((dx * dx + dy * dy) * scale)
            if k < _EXP_SIZE:
                samples[2, num_samples] = _EXP_TABLE[k] * (row[c + 1] - row[c - 1])
                samples[3, num_samples] = _EXP_TABLE[k] * (after[c] - before[c])
                num_samples += 1
    _polar(samples[2], samples[3], num_samples)
    hist[:] = 0.0
    for n in range(num_samples):
        position = samples[3, n] * (num / (2.0 * math.pi))
        b = int(position)
        part = samples[2, n] * (position - b)
        hist[0, b if b < num else b - num] += samples[2, n] - part
        hist[0, b + 1 if b + 1 < num else 0] += part
    return _find_peaks(hist, max_num, out)


@numba.njit(cache=True, nogil=True)
def _sample_cells(level: Floats, x: float, y: float, sigma: float, angle: float, samples: Floats) -> int:
    """Fill samples (4, N) with the place in cells from the corner of the 6 x 6 (u, v) and the gradient (x, y), weighted
    by a Gaussian with a sigma of two cells; returns how many."""
    height, width = level.shape
    cell = _CELL_SIGMAS * sigma
    cos, sin = np.float32(math.cos(angle) / cell), np.float32(math.sin(angle) / cell)
    reach = int(2.5 * cell * (abs(math.cos(angle)) + abs(math.sin(angle)))) + 1
    xi, yi = round(x), round(y)
    scale = np.float32(_EXP_SIZE / (_EXP_MAX * 8.0))
    half = np.float32(2.5)
    num = 0
    for r in range(max(1, yi - reach), min(height - 1, yi + reach + 1), STRIDE):
        dy = np.float32(r - y)
        before, row, after = level[r - 1], level[r], level[r + 1]
        for c in range(max(1, xi - reach), min(width - 1, xi + reach + 1), STRIDE):
            dx = np.float32(c - x)
            u = cos * dx + sin * dy
            v = cos * dy - sin * dx
            if abs(u) < half and abs(v) < half:
                weight = _EXP_TABLE[int((u * u + v * v) * scale)]
                samples[0, num], samples[1, num] = u + half, v + half
                samples[2, num] = weight * (row[c + 1] - row[c - 1])
                samples[3, num] = weight * (after[c] - before[c])
                num += 1
    return num


@numba.njit(cache=True, nogil=True)
def describe(
    level: Floats, x: float, y: float, sigma: float, angle: float, samples: Floats, hist: Floats,
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """RootSIFT descriptor: 4 x 4 cells of 8 directions, in the order of COLMAP's.

    Args:
        level: (H, W) float32, the level of the scale space that the keypoint was found in.
        x, y, sigma: of the keypoint, pixels; angle: radians, from x towards y.
        samples: (4, MAX_SAMPLES) and hist: (36, 8) float32, working memory.
        out: (128,) uint8, filled.
    """
    num = _sample_cells(level, x, y, sigma, angle, samples)
    _polar(samples[2], samples[3], num)
    to_eighths, start = np.float32(8.0 / (2.0 * math.pi)), np.float32(angle * 8.0 / (2.0 * math.pi) + 8.0)
    hist[:] = 0.0
    for n in range(num):
        u, v, weight = samples[0, n], samples[1, n], samples[2, n]
        turn = start - samples[3, n] * to_eighths
        iu, iv, it = int(u), int(v), int(turn)
        fu, fv, ft = u - iu, v - iv, turn - it
        t0, t1 = it & 7, (it + 1) & 7
        w1 = weight * fv
        w0 = weight - w1
        w01 = w0 * fu
        w00 = w0 - w01
        w11 = w1 * fu
        w10 = w1 - w11
        k = iv * 6 + iu
        a, b = w00 * ft, w01 * ft
        hist[k, t0] += w00 - a
        hist[k, t1] += a
        hist[k + 1, t0] += w01 - b
        hist[k + 1, t1] += b
        a, b = w10 * ft, w11 * ft
        hist[k + 6, t0] += w10 - a
        hist[k + 6, t1] += a
        hist[k + 7, t0] += w11 - b
        hist[k + 7, t1] += b
    square = 0.0
    for i in range(1, 5):
        for j in range(1, 5):
            for k in range(8):
                square += hist[i * 6 + j, k] * hist[i * 6 + j, k]
    # no single gradient may dominate (Lowe, section 6.1)
    limit = 0.2 * math.sqrt(square)
    total = 1e-30
    for i in range(1, 5):
        for j in range(1, 5):
            for k in range(8):
                hist[i * 6 + j, k] = min(hist[i * 6 + j, k], limit)
                total += hist[i * 6 + j, k]
    for i in range(4):
        for j in range(4):
            for k in range(8):
                root = 512.0 * math.sqrt(hist[i * 6 + j + 7, k] / total)
                out[(i * 4 + j) * 8 + k] = min(255, int(root + 0.5))


@numba.njit(cache=True, nogil=True)
def orient_all(
    levels: tuple[Floats, ...], top: int, found: NDArray[np.float64], max_num: int, angles: NDArray[np.float64]
) -> None:
    """Orientations of the keypoints of an octave.

    Args:
        levels: levels 1 to 3 of the octave.
        top: row of the octave that they begin with; even, so that halves are rounded as in the whole octave.
        found: (N, >= 3) float64 column, row, layer.
        angles: (N, max_num) float64, filled, strongest first; NaN where there are fewer.
    """
    hist = np.empty((2, _NUM_ORIENTATION_BINS))
    samples = np.empty((4, MAX_SAMPLES), np.float32)
    angles[:] = np.nan
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        x, y = found[n, 0], found[n, 1] - top
        find_orientations(levels[layer - 1], x, y, sigma, max_num, samples, hist, angles[n])


@numba.njit(cache=True, nogil=True)
def describe_all(
    levels: tuple[Floats, ...], top: int, found: NDArray[np.float64], angle: NDArray[np.float64],
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Descriptors of the keypoints of an octave.

    Args:
        levels, top: as in :func:`orient_all`.
        found: (N, >= 3) float64 column, row, layer; angle: (N,) radians.
        out: (N, 128) uint8, filled.
    """
    hist = np.empty((36, 8), np.float32)
    samples = np.empty((4, MAX_SAMPLES), np.float32)
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        describe(levels[layer - 1], found[n, 0], found[n, 1] - top, sigma, angle[n], samples, hist, out[n])
