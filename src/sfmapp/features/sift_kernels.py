"""The inner loops of SIFT (Lowe, IJCV 2004): extrema of the scale space, their refinement, orientation, descriptors.

Pixels here are those of an octave, with the centre of the top-left one at (0, 0). ``gauss`` holds the levels
0..5 of an octave, (H, W) float32 each; level l has a blur of ``SIGMA * 2 ** (l / 3)`` pixels of the octave.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

NUM_LAYERS = 3
NUM_LEVELS = NUM_LAYERS + 3
SIGMA = 1.6
# pixels at the edge of an octave where nothing is detected: the blurs have mirrored the image there
BORDER = 5

# distance of the gradients that orientations and descriptors sample: the levels are so smooth that every second one
# gives the same matches for a quarter of the time
STRIDE = 2
# columns that are scanned together, so that the rows at work stay in the first cache
TILE = 512
_NUM_ORIENTATION_BINS = 36
# a second orientation must reach this share of the strongest
_PEAK_RATIO = 0.8
# width of a cell of the descriptor in sigmas of the keypoint
_CELL_SIGMAS = 3.0
# squared distances are looked up in a table of the Gaussian, up to where its value is 4e-6
_EXP_MAX = 12.5
_EXP_SIZE = 2048
_EXP_TABLE = np.exp(-np.arange(_EXP_SIZE + 1) * (_EXP_MAX / _EXP_SIZE)).astype(np.float32)

FloatImages = NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def _is_extremum(lower: FloatImages, upper: FloatImages, row: int, col: int, value: float) -> bool:
    """Whether a difference is not exceeded, on its own side of zero, by the nine of the layer upper - lower."""
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            other = upper[r, c] - lower[r, c]
            if (value > 0.0 and other > value) or (value < 0.0 and other < value):
                return False
    return True


@numba.njit(cache=True, nogil=True)
def find_extrema(
    gauss: tuple[FloatImages, ...], threshold: float, rows: FloatImages, flags: NDArray[np.uint8],
    place: NDArray[np.int32], value: FloatImages,
) -> int:  # fmt: skip
    """Pixels whose difference of Gaussians is the largest or smallest of its 26 neighbours and exceeds the threshold.

    Row by row in vector instructions within a layer; the few that pass are held against the layers beside it.

    Args:
        gauss: the six levels of an octave, (H, W) float32 each.
        threshold: grey levels.
        rows: (9, 514) float32 and flags: (512,) uint8, working memory.
        place: (C, 3) int32 and value: (C,) float32, filled with layer, row, column and absolute difference.

    Returns:
        How many there are; those beyond C are counted only.
    """
    height, width = gauss[0].shape
    low = np.float32(threshold)
    count = 0
    for layer in range(1, NUM_LAYERS + 1):
        lower, upper = gauss[layer], gauss[layer + 1]
        for left in range(BORDER, width - BORDER, TILE):
            n = min(TILE, width - BORDER - left)
            for r in range(BORDER - 1, height - BORDER + 1):
                slot = r % 3
                dog, most, least = rows[slot], rows[3 + slot], rows[6 + slot]
                a, b = upper[r, left - 1 : left + n + 1], lower[r, left - 1 : left + n + 1]
                for c in range(n + 2):
                    dog[c] = a[c] - b[c]
                for c in range(n):
                    d0, d1, d2 = dog[c], dog[c + 1], dog[c + 2]
                    big = d0 if d0 > d1 else d1
                    small = d0 if d0 < d1 else d1
                    most[c] = big if big > d2 else d2
                    least[c] = small if small < d2 else d2
                if r < BORDER + 1:
                    continue
                mid, old = (r - 1) % 3, (r + 1) % 3
                dog, most_mid, most_old = rows[mid], rows[3 + mid], rows[3 + old]
                least_mid, least_old = rows[6 + mid], rows[6 + old]
                for c in range(n):
                    v = dog[c + 1]
                    is_most = (v > low) & (v >= most[c]) & (v >= most_mid[c]) & (v >= most_old[c])
                    is_least = (v < -low) & (v <= least[c]) & (v <= least_mid[c]) & (v <= least_old[c])
                    flags[c] = is_most | is_least
                for c in range(n):
                    if flags[c]:
                        v = dog[c + 1]
                        if not _is_extremum(gauss[layer - 1], gauss[layer], r - 1, left + c, v):
                            continue
                        if not _is_extremum(gauss[layer + 1], gauss[layer + 2], r - 1, left + c, v):
                            continue
                        if count < place.shape[0]:
                            place[count, 0], place[count, 1], place[count, 2] = layer, r - 1, left + c
                            value[count] = abs(v)
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _locate(d: NDArray[np.float64], ds: float, edge_threshold: float, out: NDArray[np.float64]) -> bool:
    """Place and height of the summit at a given scale.

    The fit over place and scale at once takes the curvature in the plane to be the same at all scales, though it falls
    with the scale: that alone moves the summit by up to a tenth of a pixel. So the differences are first interpolated
    to the scale, and the place is found among those nine.

    Args:
        d: (3, 3, 3) differences by layer, row, column; ds: scale in layers from the middle one.
        out: filled with column and row from the middle one, and at 3 with the absolute height.

    Returns:
        Whether it is a summit, within a pixel, and not on an edge.
    """
    p = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            slope = 0.5 * (d[2, i, j] - d[0, i, j])
            p[i, j] = d[1, i, j] + ds * (slope + 0.5 * ds * (d[2, i, j] + d[0, i, j] - 2.0 * d[1, i, j]))
    gx, gy = 0.5 * (p[1, 2] - p[1, 0]), 0.5 * (p[2, 1] - p[0, 1])
    xx, yy = p[1, 2] + p[1, 0] - 2.0 * p[1, 1], p[2, 1] + p[0, 1] - 2.0 * p[1, 1]
    xy = 0.25 * (p[2, 2] - p[2, 0] - p[0, 2] + p[0, 0])
    trace, det = xx + yy, xx * yy - xy * xy
    if det <= 0.0 or trace * trace * edge_threshold >= (edge_threshold + 1.0) ** 2 * det:
        return False
    dx, dy = (xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det
    out[0], out[1], out[3] = dx, dy, abs(p[1, 1] + 0.5 * (gx * dx + gy * dy))
    return abs(dx) < 1.0 and abs(dy) < 1.0


@numba.njit(cache=True, nogil=True)
def refine_extremum(
    gauss: tuple[FloatImages, ...], layer: int, row: int, col: int, edge_threshold: float, out: NDArray[np.float64]
) -> bool:
    """Fit a parabola to the 27 differences around a pixel (Brown and Lowe, BMVC 2002), moving on while it lies outside.

    Args:
        out: (4,) float64, filled with column, row, layer (all with fractions) and absolute difference there.

    Returns:
        Whether the fit settled and the place does not lie on an edge.
    """
    height, width = gauss[0].shape
    d = np.empty((3, 3, 3))
    for _ in range(5):
        for k in range(3):
            for i in range(3):
                for j in range(3):
                    r, c = row + i - 1, col + j - 1
                    d[k, i, j] = gauss[layer + k][r, c] - gauss[layer + k - 1][r, c]
        v = d[1, 1, 1]
        gx = 0.5 * (d[1, 1, 2] - d[1, 1, 0])
        gy = 0.5 * (d[1, 2, 1] - d[1, 0, 1])
        gs = 0.5 * (d[2, 1, 1] - d[0, 1, 1])
        xx = d[1, 1, 2] + d[1, 1, 0] - 2.0 * v
        yy = d[1, 2, 1] + d[1, 0, 1] - 2.0 * v
        ss = d[2, 1, 1] + d[0, 1, 1] - 2.0 * v
        xy = 0.25 * (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0])
        xs = 0.25 * (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0])
        ys = 0.25 * (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1])
        # Cramer's rule for the symmetric system
        c0 = yy * ss - ys * ys
        c1 = xs * ys - xy * ss
        c2 = xy * ys - xs * yy
        det = xx * c0 + xy * c1 + xs * c2
        if det == 0.0:
            return False
        dx = -(gx * c0 + gy * c1 + gs * c2) / det
        dy = -(gx * c1 + gy * (xx * ss - xs * xs) + gs * (xy * xs - xx * ys)) / det
        ds = -(gx * c2 + gy * (xy * xs - xx * ys) + gs * (xx * yy - xy * xy)) / det
        if abs(dx) < 0.6 and abs(dy) < 0.6 and abs(ds) < 0.6:
            if not _locate(d, ds, edge_threshold, out):
                return False
            out[0] += col
            out[1] += row
            out[2] = layer + ds
            return True
        if not (abs(dx) < 1e3 and abs(dy) < 1e3 and abs(ds) < 1e3):
            return False
        col += round(dx)
        row += round(dy)
        layer += round(ds)
        if layer < 1 or layer > NUM_LAYERS or not (BORDER <= col < width - BORDER and BORDER <= row < height - BORDER):
            return False
    return False


@numba.njit(cache=True, nogil=True)
def refine_all(
    gauss: tuple[FloatImages, ...], place: NDArray[np.int32], edge_threshold: float, out: NDArray[np.float64]
) -> None:
    """:func:`refine_extremum` of every place (N, 3); rows of out (N, 4) that fail become NaN."""
    for n in range(place.shape[0]):
        if not refine_extremum(gauss, place[n, 0], place[n, 1], place[n, 2], edge_threshold, out[n]):
            out[n, :] = np.nan


@numba.njit(cache=True, nogil=True, inline="always")
def _angle(y: float, x: float) -> float:
    """atan2 in [0, 2 pi) to 1e-5 (Abramowitz and Stegun 4.4.49)."""
    ax, ay = abs(x), abs(y)
    a = min(ax, ay) / (max(ax, ay) + 1e-30)
    s = a * a
    t = a * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))))
    if ay > ax:
        t = 0.5 * math.pi - t
    if x < 0.0:
        t = math.pi - t
    if y < 0.0:
        t = 2.0 * math.pi - t
    return t


@numba.njit(cache=True, nogil=True)
def find_orientations(
    level: FloatImages, x: float, y: float, sigma: float, max_num: int, hist: NDArray[np.float64],
    out: NDArray[np.float64],
) -> int:  # fmt: skip
    """Peaks of the histogram of gradient directions around a keypoint, strongest first.

    Args:
        level: (H, W) float32, the level of the scale space that the keypoint was found in.
        x, y, sigma: of the keypoint, pixels.
        hist: (2, 36) float64, working memory.
        out: (max_num,) float64, filled with angles in radians in [0, 2 pi), from x towards y.

    Returns:
        Number of angles, at most max_num.
    """
    height, width = level.shape
    num = _NUM_ORIENTATION_BINS
    window = 1.5 * sigma
    radius = int(3.0 * window)
    scale = _EXP_SIZE / (_EXP_MAX * 2.0 * window * window)
    xi, yi = round(x), round(y)
    hist[:] = 0.0
    for r in range(max(1, yi - radius), min(height - 1, yi + radius + 1), STRIDE):
        dy = r - y
        for c in range(max(1, xi - radius), min(width - 1, xi + radius + 1), STRIDE):
            dx = c - x
            k = int((dx * dx + dy * dy) * scale)
            if k >= _EXP_SIZE:
                continue
            gx = float(level[r, c + 1]) - float(level[r, c - 1])
            gy = float(level[r + 1, c]) - float(level[r - 1, c])
            weight = math.sqrt(gx * gx + gy * gy) * _EXP_TABLE[k]
            position = _angle(gy, gx) * (num / (2.0 * math.pi))
            b = int(position)
            part = position - b
            b0 = b if b < num else b - num
            b1 = b0 + 1 if b0 + 1 < num else 0
            hist[0, b0] += weight * (1.0 - part)
            hist[0, b1] += weight * part
    for turn in range(6):
        source, target = hist[turn % 2], hist[(turn + 1) % 2]
        for b in range(num):
            target[b] = (source[b - 1] + source[b] + source[b + 1 if b + 1 < num else 0]) / 3.0
    smooth = hist[0]
    limit = _PEAK_RATIO * smooth.max()
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
def describe(
    level: FloatImages, x: float, y: float, sigma: float, angle: float, hist: NDArray[np.float64],
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """RootSIFT descriptor: 4 x 4 cells of 8 directions, in the order of COLMAP's.

    Args:
        level: (H, W) float32, the level of the scale space that the keypoint was found in.
        x, y, sigma: of the keypoint, pixels; angle: radians, from x towards y.
        hist: (6, 6, 8) float64, working memory.
        out: (128,) uint8, filled.
    """
    height, width = level.shape
    cell = _CELL_SIGMAS * sigma
    cos, sin = math.cos(angle) / cell, math.sin(angle) / cell
    reach = int(2.5 * cell * (abs(math.cos(angle)) + abs(math.sin(angle)))) + 1
    xi, yi = round(x), round(y)
    # Gaussian window with a sigma of two cells
    scale = _EXP_SIZE / (_EXP_MAX * 8.0)
    hist[:] = 0.0
    for r in range(max(1, yi - reach), min(height - 1, yi + reach + 1), STRIDE):
        dy = r - y
        for c in range(max(1, xi - reach), min(width - 1, xi + reach + 1), STRIDE):
            dx = c - x
            u = cos * dx + sin * dy
            v = cos * dy - sin * dx
            if not (-2.5 < u < 2.5 and -2.5 < v < 2.5):
                continue
            gx = float(level[r, c + 1]) - float(level[r, c - 1])
            gy = float(level[r + 1, c]) - float(level[r - 1, c])
            weight = math.sqrt(gx * gx + gy * gy) * _EXP_TABLE[int((u * u + v * v) * scale)]
            turn = (angle - _angle(gy, gx)) * (8.0 / (2.0 * math.pi)) + 8.0
            u += 2.5
            v += 2.5
            iu, iv, it = int(u), int(v), int(turn)
            fu, fv, ft = u - iu, v - iv, turn - it
            t0, t1 = it & 7, (it + 1) & 7
            w1 = weight * fv
            w0 = weight - w1
            w01 = w0 * fu
            w00 = w0 - w01
            w11 = w1 * fu
            w10 = w1 - w11
            hist[iv, iu, t0] += w00 * (1.0 - ft)
            hist[iv, iu, t1] += w00 * ft
            hist[iv, iu + 1, t0] += w01 * (1.0 - ft)
            hist[iv, iu + 1, t1] += w01 * ft
            hist[iv + 1, iu, t0] += w10 * (1.0 - ft)
            hist[iv + 1, iu, t1] += w10 * ft
            hist[iv + 1, iu + 1, t0] += w11 * (1.0 - ft)
            hist[iv + 1, iu + 1, t1] += w11 * ft
    square = 0.0
    for i in range(1, 5):
        for j in range(1, 5):
            for k in range(8):
                square += hist[i, j, k] * hist[i, j, k]
    # no single gradient may dominate (Lowe, section 6.1)
    limit = 0.2 * math.sqrt(square)
    total = 1e-30
    for i in range(1, 5):
        for j in range(1, 5):
            for k in range(8):
                hist[i, j, k] = min(hist[i, j, k], limit)
                total += hist[i, j, k]
    for i in range(4):
        for j in range(4):
            for k in range(8):
                root = 512.0 * math.sqrt(hist[i + 1, j + 1, k] / total)
                out[(i * 4 + j) * 8 + k] = min(255, int(root + 0.5))


@numba.njit(cache=True, nogil=True)
def orient_all(
    levels: tuple[FloatImages, ...], found: NDArray[np.float64], max_num: int, angles: NDArray[np.float64]
) -> None:
    """Orientations of the keypoints of an octave.

    Args:
        levels: levels 1 to 3 of the octave.
        found: (N, >= 3) float64 column, row, layer.
        angles: (N, max_num) float64, filled, strongest first; NaN where there are fewer.
    """
    hist = np.empty((2, _NUM_ORIENTATION_BINS))
    angles[:] = np.nan
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        find_orientations(levels[layer - 1], found[n, 0], found[n, 1], sigma, max_num, hist, angles[n])


@numba.njit(cache=True, nogil=True)
def describe_all(
    levels: tuple[FloatImages, ...], found: NDArray[np.float64], angle: NDArray[np.float64], out: NDArray[np.uint8]
) -> None:
    """Descriptors of the keypoints of an octave.

    Args:
        levels: levels 1 to 3 of the octave.
        found: (N, >= 3) float64 column, row, layer; angle: (N,) radians.
        out: (N, 128) uint8, filled.
    """
    hist = np.empty((6, 6, 8))
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        describe(levels[layer - 1], found[n, 0], found[n, 1], sigma, angle[n], hist, out[n])
