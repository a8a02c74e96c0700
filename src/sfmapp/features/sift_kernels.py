"""The inner loops of SIFT (Lowe, IJCV 2004): the scale space, its extrema, their refinement, orientation, descriptors.

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
# columns that are scanned together, so that the rows at work stay in the cache
TILE = 1024
_NUM_ORIENTATION_BINS = 36
# a second orientation must reach this share of the strongest
_PEAK_RATIO = 0.8
# width of a cell of the descriptor in sigmas of the keypoint
_CELL_SIGMAS = 3.0
# squared distances are looked up in a table of the Gaussian, up to where its value is 4e-6
_EXP_MAX = 12.5
_EXP_SIZE = 2048
# gradients of one descriptor at most: the turned square of 5 x 5 cells at the largest scale of an octave
MAX_SAMPLES = int((5.0 * _CELL_SIGMAS * SIGMA * 2.0 ** (4.0 / 3.0) / STRIDE + 2.0) ** 2 * 1.2)
_EXP_TABLE = np.exp(-np.arange(_EXP_SIZE + 1) * (_EXP_MAX / _EXP_SIZE)).astype(np.float32)

Floats = NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def _taps_0_to_4(
    out: Floats, k: Floats, m: Floats, a1: Floats, b1: Floats, a2: Floats, b2: Floats, a3: Floats,
    b3: Floats, a4: Floats, b4: Floats, num: int,
) -> None:  # fmt: skip
    k0, k1, k2, k3, k4 = k[0], k[1], k[2], k[3], k[4]
    for c in range(num):
        near = k0 * m[c] + k1 * (a1[c] + b1[c]) + k2 * (a2[c] + b2[c])
        out[c] = near + (k3 * (a3[c] + b3[c]) + k4 * (a4[c] + b4[c]))


@numba.njit(cache=True, nogil=True)
def _two_taps(out: Floats, k: Floats, a1: Floats, b1: Floats, a2: Floats, b2: Floats, num: int) -> None:
    k1, k2 = k[0], k[1]
    for c in range(num):
        out[c] += k1 * (a1[c] + b1[c]) + k2 * (a2[c] + b2[c])


@numba.njit(cache=True, nogil=True)
def blur(source: Floats, k: Floats, line: Floats, target: Floats) -> None:
    """Convolve columns, then rows, with a symmetric kernel; the image is mirrored at the centres of its outer pixels.

    A quarter to a half faster than OpenCV's, and the same to the last bit on any processor, as no multiplication is
    fused with an addition.

    Args:
        source: (H, W) float32, H and W at least N.
        k: (N,) float32, the kernel from its middle outwards; N is odd and at least 5.
        line: (W + 2 N,) float32, working memory.
        target: (H, W) float32, filled; not the source.
    """
    h, w = source.shape
    n = k.shape[0] - 1
    s = source
    for r in range(h):
        column = line[n : n + w]
        up, down = r, 2 * h - 2 - r
        _taps_0_to_4(
            column, k, s[r], s[abs(up - 1)], s[min(r + 1, down - 1)], s[abs(up - 2)], s[min(r + 2, down - 2)],
            s[abs(up - 3)], s[min(r + 3, down - 3)], s[abs(up - 4)], s[min(r + 4, down - 4)], w,
        )  # fmt: skip
        for i in range(5, n, 2):
            _two_taps(
                column, k[i:], s[abs(up - i)], s[min(r + i, down - i)],
                s[abs(up - i - 1)], s[min(r + i + 1, down - i - 1)], w,
            )  # fmt: skip
        for i in range(1, n + 1):
            line[n - i] = line[n + i]
            line[n + w - 1 + i] = line[n + w - 1 - i]
        _taps_0_to_4(
            target[r], k, column, line[n - 1 :], line[n + 1 :], line[n - 2 :], line[n + 2 :],
            line[n - 3 :], line[n + 3 :], line[n - 4 :], line[n + 4 :], w,
        )  # fmt: skip
        for i in range(5, n, 2):
            _two_taps(target[r], k[i:], line[n - i :], line[n + i :], line[n - i - 1 :], line[n + i + 1 :], w)


@numba.njit(cache=True, nogil=True)
def _subtract(upper: Floats, lower: Floats, out: Floats, num: int) -> None:
    for c in range(num):
        out[c] = upper[c] - lower[c]


@numba.njit(cache=True, nogil=True)
def _extremes_of_three(row: Floats, most: Floats, least: Floats, num: int) -> None:
    """Largest and smallest of ``row[c : c + 3]``."""
    for c in range(num):
        v0, v1, v2 = row[c], row[c + 1], row[c + 2]
        big = v0 if v0 > v1 else v1
        small = v0 if v0 < v1 else v1
        most[c] = big if big > v2 else v2
        least[c] = small if small < v2 else v2


@numba.njit(cache=True, nogil=True)
def _flag_extremes(
    row: Floats, most: Floats, least: Floats, threshold: float, flags: NDArray[np.uint8], num: int
) -> None:
    """Flag the values of a row that are the extremes of their 3 x 3 pixels and far enough from zero."""
    for c in range(num):
        v = row[c + 1]
        big = most[0, c] if most[0, c] > most[1, c] else most[1, c]
        big = big if big > most[2, c] else most[2, c]
        small = least[0, c] if least[0, c] < least[1, c] else least[1, c]
        small = small if small < least[2, c] else least[2, c]
        flags[c] = ((v >= big) & (v > threshold)) | ((v <= small) & (v < -threshold))


@numba.njit(cache=True, nogil=True)
def _exceeds(value: float, rows: Floats, col: int) -> bool:
    """Whether none of the 3 x 3 values of another layer is beyond a value, on its own side of zero."""
    for i in range(3):
        for c in range(col, col + 3):
            if (rows[i, c] > value) if value > 0.0 else (rows[i, c] < value):
                return False
    return True


@numba.njit(cache=True, nogil=True)
def find_extrema(
    gauss: tuple[Floats, ...], threshold: float, rows: Floats, flags: NDArray[np.uint8],
    place: NDArray[np.int32], value: Floats,
) -> int:  # fmt: skip
    """Pixels whose difference of Gaussians is the largest or smallest of its 26 neighbours and exceeds the threshold.

    Row by row in vector instructions within a layer; the few that pass are held against the layers beside it.

    Args:
        gauss: the six levels of an octave, (H, W) float32 each.
        threshold: grey levels.
        rows: (11, 3, TILE + 2) float32 and flags: (TILE,) uint8, working memory: the last three rows of the five
            differences, then of the largest and of the smallest of three neighbours in each of the middle ones.
        place: (C, 3) int32 and value: (C,) float32, filled with layer, row, column and absolute difference.

    Returns:
        How many there are; those beyond C are counted only.
    """
    height, width = gauss[0].shape
    g0, g1, g2, g3, g4, g5 = gauss
    low = np.float32(threshold)
    eights = flags.view(np.uint64)
    count = 0
    for left in range(BORDER, width - BORDER, TILE):
        n = min(TILE, width - BORDER - left)
        a, b = left - 1, left + n + 1
        for r in range(BORDER - 1, height - BORDER + 1):
            slot, middle = r % 3, (r - 1) % 3
            _subtract(g1[r, a:b], g0[r, a:b], rows[0, slot], n + 2)
            _subtract(g2[r, a:b], g1[r, a:b], rows[1, slot], n + 2)
            _subtract(g3[r, a:b], g2[r, a:b], rows[2, slot], n + 2)
            _subtract(g4[r, a:b], g3[r, a:b], rows[3, slot], n + 2)
            _subtract(g5[r, a:b], g4[r, a:b], rows[4, slot], n + 2)
            for layer in range(1, NUM_LAYERS + 1):
                most, least = rows[4 + layer], rows[7 + layer]
                _extremes_of_three(rows[layer, slot], most[slot], least[slot], n)
                if r < BORDER + 1:
                    continue
                dog = rows[layer, middle]
                _flag_extremes(dog, most, least, low, flags, n)
                for e in range((n + 7) // 8):
                    if eights[e] == 0:
                        continue
                    for c in range(8 * e, min(8 * e + 8, n)):
                        v = dog[c + 1]
                        if flags[c] and _exceeds(v, rows[layer - 1], c) and _exceeds(v, rows[layer + 1], c):
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
    gauss: tuple[Floats, ...], layer: int, row: int, col: int, edge_threshold: float, out: NDArray[np.float64]
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
    gauss: tuple[Floats, ...], place: NDArray[np.int32], edge_threshold: float, out: NDArray[np.float64]
) -> None:
    """:func:`refine_extremum` of every place (N, 3); rows of out (N, 4) that fail become NaN."""
    for n in range(place.shape[0]):
        if not refine_extremum(gauss, place[n, 0], place[n, 1], place[n, 2], edge_threshold, out[n]):
            out[n, :] = np.nan


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
    num_samples = 0
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
    levels: tuple[Floats, ...], found: NDArray[np.float64], max_num: int, angles: NDArray[np.float64]
) -> None:
    """Orientations of the keypoints of an octave.

    Args:
        levels: levels 1 to 3 of the octave.
        found: (N, >= 3) float64 column, row, layer.
        angles: (N, max_num) float64, filled, strongest first; NaN where there are fewer.
    """
    hist = np.empty((2, _NUM_ORIENTATION_BINS))
    samples = np.empty((4, MAX_SAMPLES), np.float32)
    angles[:] = np.nan
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        find_orientations(levels[layer - 1], found[n, 0], found[n, 1], sigma, max_num, samples, hist, angles[n])


@numba.njit(cache=True, nogil=True)
def describe_all(
    levels: tuple[Floats, ...], found: NDArray[np.float64], angle: NDArray[np.float64], out: NDArray[np.uint8]
) -> None:
    """Descriptors of the keypoints of an octave.

    Args:
        levels: levels 1 to 3 of the octave.
        found: (N, >= 3) float64 column, row, layer; angle: (N,) radians.
        out: (N, 128) uint8, filled.
    """
    hist = np.empty((36, 8), np.float32)
    samples = np.empty((4, MAX_SAMPLES), np.float32)
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        describe(levels[layer - 1], found[n, 0], found[n, 1], sigma, angle[n], samples, hist, out[n])
