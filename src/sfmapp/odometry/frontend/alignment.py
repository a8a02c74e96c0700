"""Sub-pixel alignment of image patches, coarse to fine, with the exposure free.

Inverse compositional Lucas-Kanade (Baker and Matthews, IJCV 2004): the reference patch T is sampled once per level, and
its gradients, taken there, serve all iterations. With gain and bias unknown, ``I(x + p) = a T(x) + b``, the least
squares solution needs nothing of T but its gradients less what T itself and a constant explain of them, g~: the sums of
``w g~ I`` over the patch vanish where the patch is aligned. An iteration is one pass over the target with three sums.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.frontend.pyramid import PAD, Bytes, Pyramid, build_pyramid
from sfmapp.simd import f32x16 as lanes
from sfmapp.simd.bilinear import sample_bytes
from sfmapp.simd.pointers import offset, pointer

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_MAX_HALF_WIDTH = 7  # a row of a patch is one vector
# float32 a point needs: 17 sampled rows of 32; 15 rows of T, gradient x, y, weight; 15 rows of w g~x, w g~y, w T~
_SAMPLES, _GRADED, _SUMS = 0, 17 * 32, 17 * 32 + 15 * 64
SCRATCH = _SUMS + 15 * 48
# last step, in pixels of the level: a tenth of the noise of a good track at the finest, and what the next level makes
# good at the others
_FINE_STEP_PX, _COARSE_STEP_PX = 0.01, 0.1
_MAX_ITERATIONS = 15  # on each level
# standard deviation that noise of one grey level in both images would give the position; where it is more, what the
# sensor really adds moves the patch by its own gradients
_MAX_SIGMA_PX = 0.25
# a gain taken for larger or smaller only makes the steps shorter or longer
_MIN_GAIN, _MAX_GAIN = 0.6, 1.6


class Alignment(NamedTuple):
    """Where patches of one image lie in another.

    Attributes:
        xy: (N, 2) float64 pixels in the target; where not converged, the best there is.
        zncc: (N,) float32 correlation of the patches at the finest level, of mean 0 and norm 1; 0 where not computed.
        is_converged: (N,) bool; inside both images, enough texture, and a last step that is small.
    """

    xy: Doubles
    zncc: Floats
    is_converged: NDArray[np.bool_]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sample_shifted(
    data: Bytes, start: int, step: int, fx: float, fy: float, rows: int, scratch: Floats, shift: float
) -> None:
    """Bilinear samples of ``rows`` rows of 32 pixels from the pixel at start on, less a shift."""
    image, out = pointer(data), pointer(scratch)
    a00, a01 = lanes.splat(np.float32((1 - fx) * (1 - fy))), lanes.splat(np.float32(fx * (1 - fy)))
    a10, a11 = lanes.splat(np.float32((1 - fx) * fy)), lanes.splat(np.float32(fx * fy))
    less = lanes.splat(np.float32(-shift))
    for half in range(2):
        place = start + 16 * half
        up0, up1 = lanes.load_bytes(image, place), lanes.load_bytes(image, place + 1)
        for r in range(rows):
            place += step
            down0, down1 = lanes.load_bytes(image, place), lanes.load_bytes(image, place + 1)
            value = lanes.fma(a00, up0, lanes.fma(a01, up1, lanes.fma(a10, down0, lanes.fma(a11, down1, less))))
            lanes.store(out, 32 * r + 16 * half, value)
            up0, up1 = down0, down1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_within_pad(layout: NDArray[np.int64], x: float, y: float, warp: Doubles, half: float) -> bool:
    """Whether a warped square about (x, y) of a level stays on what the level and its border hold; False with NaN."""
    reach_x, reach_y = half * (abs(warp[0, 0]) + abs(warp[0, 1])), half * (abs(warp[1, 0]) + abs(warp[1, 1]))
    room = PAD - 1.0
    return (
        x - reach_x >= -room and x + reach_x <= layout[3] + room
        and y - reach_y >= -room and y + reach_y <= layout[2] + room
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sample_warped(
    data: Bytes, layout: NDArray[np.int64], x: float, y: float, warp: Doubles, grow: float, size: int, scratch: Floats,
    shift: float,
) -> None:  # fmt: skip
    """Bilinear samples of a level at ``(x, y) + grow warp offset`` less a shift, size rows of 32 in ``scratch``.

    Columns beyond the patch repeat its last.
    """
    c, r = int(np.floor(x)), int(np.floor(y))
    image = offset(pointer(data), layout[0] + r * layout[1] + c)
    out = pointer(scratch)
    a, b = lanes.splat(np.float32(grow * warp[0, 0])), lanes.splat(np.float32(grow * warp[1, 0]))
    last = np.float32(0.5 * (size - 1))
    less = lanes.splat(np.float32(shift))
    for part in range((size + 15) // 16):
        dx = lanes.ramp(np.float32(16 * part) - last, last)
        for row in range(size):
            dy = grow * (row - 0.5 * (size - 1))
            u = lanes.fma(a, dx, lanes.splat(np.float32(x - 0.5 - c + warp[0, 1] * dy)))
            v = lanes.fma(b, dx, lanes.splat(np.float32(y - 0.5 - r + warp[1, 1] * dy)))
            value = lanes.subtract(sample_bytes(image, layout[1], u, v), less)
            lanes.store(out, _SAMPLES + 32 * row + 16 * part, value)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _differentiate(scratch: Floats, window: Floats, rows: int) -> None:
    """Rows of T, its central differences and the weights from the samples, which are one wider on each side."""
    p, w = pointer(scratch), pointer(window)
    half = lanes.splat(np.float32(0.5))
    for r in range(rows):
        at, to = _SAMPLES + 32 * (r + 1) + 1, _GRADED + 64 * r
        lanes.store(p, to, lanes.load(p, at))
        lanes.store(p, to + 16, lanes.multiply(half, lanes.subtract(lanes.load(p, at + 1), lanes.load(p, at - 1))))
        lanes.store(p, to + 32, lanes.multiply(half, lanes.subtract(lanes.load(p, at + 32), lanes.load(p, at - 32))))
        lanes.store(p, to + 48, lanes.load(w, 16 * r))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(scratch: Floats, rows: int, hessian: Doubles) -> bool:
    """Rows of ``w g~`` and ``w T~`` and what they sum to: [h00, h01, h11, variance of T] in sums over the patch."""
    p = pointer(scratch)
    zero = lanes.splat(np.float32(0))
    sw, st, sx, sy = zero, zero, zero, zero
    for r in range(rows):
        at = _GRADED + 64 * r
        w = lanes.load(p, at + 48)
        sw = lanes.add(sw, w)
        st = lanes.fma(w, lanes.load(p, at), st)
        sx = lanes.fma(w, lanes.load(p, at + 16), sx)
        sy = lanes.fma(w, lanes.load(p, at + 32), sy)
    weight = lanes.total(sw)
    mt, mx, my = lanes.total(st) / weight, lanes.total(sx) / weight, lanes.total(sy) / weight
    at_, ax, ay = lanes.splat(mt), lanes.splat(mx), lanes.splat(my)
    stt, sxt, syt = zero, zero, zero
    for r in range(rows):
        at = _GRADED + 64 * r
        w = lanes.load(p, at + 48)
        wt = lanes.multiply(w, lanes.subtract(lanes.load(p, at), at_))
        lanes.store(p, _SUMS + 48 * r + 32, wt)
        stt = lanes.fma(wt, lanes.subtract(lanes.load(p, at), at_), stt)
        sxt = lanes.fma(wt, lanes.subtract(lanes.load(p, at + 16), ax), sxt)
        syt = lanes.fma(wt, lanes.subtract(lanes.load(p, at + 32), ay), syt)
    variance = lanes.total(stt)
    if not variance > 0:
        return False
    cx, cy = lanes.splat(-lanes.total(sxt) / variance), lanes.splat(-lanes.total(syt) / variance)
    sxx, sxy, syy = zero, zero, zero
    for r in range(rows):
        at = _GRADED + 64 * r
        w, t = lanes.load(p, at + 48), lanes.subtract(lanes.load(p, at), at_)
        gx = lanes.fma(cx, t, lanes.subtract(lanes.load(p, at + 16), ax))
        gy = lanes.fma(cy, t, lanes.subtract(lanes.load(p, at + 32), ay))
        wx, wy = lanes.multiply(w, gx), lanes.multiply(w, gy)
        lanes.store(p, _SUMS + 48 * r, wx)
        lanes.store(p, _SUMS + 48 * r + 16, wy)
        sxx, sxy, syy = lanes.fma(wx, gx, sxx), lanes.fma(wx, gy, sxy), lanes.fma(wy, gy, syy)
    hessian[0], hessian[1], hessian[2] = lanes.total(sxx), lanes.total(sxy), lanes.total(syy)
    hessian[3] = variance
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sums(
    data: Bytes, start: int, step: int, fx: float, fy: float, rows: int, scratch: Floats, shift: float
) -> tuple[float, float, float]:
    """Sums of ``w g~x I``, ``w g~y I`` and ``w T~ I`` with the target sampled from the pixel at start on."""
    image, p = pointer(data), pointer(scratch)
    a00, a01 = lanes.splat(np.float32((1 - fx) * (1 - fy))), lanes.splat(np.float32(fx * (1 - fy)))
    a10, a11 = lanes.splat(np.float32((1 - fx) * fy)), lanes.splat(np.float32(fx * fy))
    less = lanes.splat(np.float32(-shift))
    zero = lanes.splat(np.float32(0))
    sx, sy, st = zero, zero, zero
    up0, up1 = lanes.load_bytes(image, start), lanes.load_bytes(image, start + 1)
    for r in range(rows):
        start += step
        down0, down1 = lanes.load_bytes(image, start), lanes.load_bytes(image, start + 1)
        value = lanes.fma(a00, up0, lanes.fma(a01, up1, lanes.fma(a10, down0, lanes.fma(a11, down1, less))))
        at = _SUMS + 48 * r
        sx = lanes.fma(lanes.load(p, at), value, sx)
        sy = lanes.fma(lanes.load(p, at + 16), value, sy)
        st = lanes.fma(lanes.load(p, at + 32), value, st)
        up0, up1 = down0, down1
    return lanes.total(sx), lanes.total(sy), lanes.total(st)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def correlate(
    data: Bytes, start: int, step: int, fx: float, fy: float, rows: int, scratch: Floats, shift: float, variance: float
) -> float:
    """Weighted correlation of T with the target sampled from the pixel at start on; 0 for a blank target."""
    image, p = pointer(data), pointer(scratch)
    a00, a01 = lanes.splat(np.float32((1 - fx) * (1 - fy))), lanes.splat(np.float32(fx * (1 - fy)))
    a10, a11 = lanes.splat(np.float32((1 - fx) * fy)), lanes.splat(np.float32(fx * fy))
    less = lanes.splat(np.float32(-shift))
    zero = lanes.splat(np.float32(0))
    sw, si, sii, st = zero, zero, zero, zero
    up0, up1 = lanes.load_bytes(image, start), lanes.load_bytes(image, start + 1)
    for r in range(rows):
        start += step
        down0, down1 = lanes.load_bytes(image, start), lanes.load_bytes(image, start + 1)
        value = lanes.fma(a00, up0, lanes.fma(a01, up1, lanes.fma(a10, down0, lanes.fma(a11, down1, less))))
        w = lanes.load(p, _GRADED + 64 * r + 48)
        weighted = lanes.multiply(w, value)
        sw, si, sii = lanes.add(sw, w), lanes.add(si, weighted), lanes.fma(weighted, value, sii)
        st = lanes.fma(lanes.load(p, _SUMS + 48 * r + 32), value, st)
        up0, up1 = down0, down1
    weight, first = float(lanes.total(sw)), float(lanes.total(si))
    spread = float(lanes.total(sii)) - first * first / weight
    # a step of one grey level in one pixel is the least that there can be
    return lanes.total(st) / np.sqrt(spread * variance) if spread > 0.5 * variance / (variance + 1e6) else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def prepare_patch(
    data: Bytes, layouts: NDArray[np.int64], level: int, x: float, y: float, warp: Doubles, is_warped: bool, half: int,
    window: Floats, scratch: Floats, hessian: Doubles,
) -> float:  # fmt: skip
    """Sample the reference for a level of the target; the grey level taken from it, or -1 where it is too plain.

    Args:
        warp: (2, 2) from pixels of the target to those of the reference, used where is_warped.
        hessian: (4,) filled.
    """
    source = level
    hessian[3] = 0.0
    if is_warped:  # the level on which a step of the target is about a pixel
        size = np.sqrt(abs(warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]))
        if not 1e-3 < size < 1e3:  # or not a number
            return -1.0
        source = min(max(level + int(np.rint(np.log2(size))), 0), layouts.shape[0] - 1)
    scale = 0.5**source
    u, v = x * scale, y * scale
    start, step = layouts[source, 0], layouts[source, 1]
    shift = float(data[start + int(np.floor(v)) * step + int(np.floor(u))])
    if is_warped:
        grow = 2.0 ** (level - source)
        if not _is_within_pad(layouts[source], u, v, warp, (half + 1) * grow):
            return -1.0
        _sample_warped(data, layouts[source], u, v, warp, grow, 2 * half + 3, scratch, shift)
    else:
        left, top = u - 0.5 - (half + 1), v - 0.5 - (half + 1)
        c, r = int(np.floor(left)), int(np.floor(top))
        _sample_shifted(data, start + r * step + c, step, left - c, top - r, 2 * half + 3, scratch, shift)
    _differentiate(scratch, window, 2 * half + 1)
    if not _project(scratch, 2 * half + 1, hessian):
        return -1.0
    h00, h01, h11 = hessian[0], hessian[1], hessian[2]
    weakest = 0.5 * (h00 + h11) - np.sqrt(0.25 * (h00 - h11) ** 2 + h01 * h01)
    return shift if weakest * _MAX_SIGMA_PX**2 > 2.0 else -1.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _iterate(
    data: Bytes, layout: NDArray[np.int64], position: Doubles, half: int, scratch: Floats, hessian: Doubles,
    shift: float, small: float,
) -> bool:  # fmt: skip
    """Move a position, in pixels of the level, to where the patch fits; False, and unmoved, where it does not."""
    start, step, height, width = layout
    h00, h01, h11, variance = hessian
    determinant = h00 * h11 - h01 * h01
    x, y = position[0], position[1]
    last_x, last_y = 0.0, 0.0
    for _ in range(_MAX_ITERATIONS):
        if not (0.0 <= x <= width and 0.0 <= y <= height) or abs(x - position[0]) + abs(y - position[1]) > 2.0 * half:
            return False
        left, top = x - 0.5 - half, y - 0.5 - half
        c, r = int(np.floor(left)), int(np.floor(top))
        sx, sy, st = _sums(data, start + r * step + c, step, left - c, top - r, 2 * half + 1, scratch, shift)
        gain = min(max(st / variance, _MIN_GAIN), _MAX_GAIN)
        dx, dy = (h11 * sx - h01 * sy) / (gain * determinant), (h00 * sy - h01 * sx) / (gain * determinant)
        if dx * last_x + dy * last_y < 0.0 and abs(dx + last_x) + abs(dy + last_y) < small:
            dx, dy = 0.5 * dx, 0.5 * dy  # to and fro: the middle
            x, y = x - dx, y - dy
            last_x, last_y = 0.0, 0.0
            break
        x, y = x - dx, y - dy
        last_x, last_y = dx, dy
        if dx * dx + dy * dy < small * small:
            break
    if not (0.0 <= x <= width and 0.0 <= y <= height and last_x * last_x + last_y * last_y < 100 * small * small):
        return False
    position[0], position[1] = x, y
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_inside(layout: NDArray[np.int64], x: float, y: float, margin: float) -> bool:
    return margin <= x <= layout[3] - margin and margin <= y <= layout[2] - margin


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _align(
    reference: Pyramid, xy: Doubles, target: Pyramid, found: Alignment, warps: Doubles, coarsest: int, half: int,
    window: Floats,
) -> None:  # fmt: skip
    """Move the positions of ``found``, which are guesses at first, and fill the rest of it."""
    scratch, hessian, position = np.zeros(SCRATCH, np.float32), np.empty(4), np.empty(2)
    data1, layout1, data2, layout2 = reference.data, reference.layout, target.data, target.layout
    rows, margin, is_warped = 2 * half + 1, half + 0.5, warps.shape[0] > 0
    for i in range(xy.shape[0]):
        x, y = xy[i]
        found.zncc[i], found.is_converged[i] = 0.0, False
        warp = warps[i if is_warped else 0]
        if not _is_inside(layout1[0], x, y, 0.0):
            continue
        for level in range(coarsest, -1, -1):
            scale = 0.5**level
            position[0], position[1] = found.xy[i, 0] * scale, found.xy[i, 1] * scale
            shift = prepare_patch(data1, layout1, level, x, y, warp, is_warped, half, window, scratch, hessian)
            if shift < 0.0:
                continue
            small = _FINE_STEP_PX if level == 0 else _COARSE_STEP_PX
            if not _iterate(data2, layout2[level], position, half, scratch, hessian, shift, small):
                continue
            found.xy[i, 0], found.xy[i, 1] = position[0] / scale, position[1] / scale
            if level == 0:
                left, top = position[0] - 0.5 - half, position[1] - 0.5 - half
                c, r = int(np.floor(left)), int(np.floor(top))
                start, step = layout2[0, 0] + r * layout2[0, 1] + c, layout2[0, 1]
                found.zncc[i] = correlate(data2, start, step, left - c, top - r, rows, scratch, shift, hessian[3])
                is_inside = _is_inside(layout2[0], position[0], position[1], margin)
                found.is_converged[i] = is_inside and _is_inside(layout1[0], x, y, margin)


@lru_cache
def patch_window(half_width: int) -> Floats:
    """Weights of the pixels of a patch, (rows, 16) with nothing in the lanes beyond it; the same array each time.

    A bell of a standard deviation of half the half width: on real pairs of images its errors are a tenth smaller than
    those of equal weights, and more patches survive at the edges of things.
    """
    size = 2 * half_width + 1
    bell = np.exp(-0.5 * (np.arange(-half_width, half_width + 1) / (0.5 * half_width)) ** 2)
    window = np.zeros((size, 16), np.float32)
    window[:, :size] = np.outer(bell, bell)
    return window


def align_patches(
    reference: Pyramid, reference_xy: Doubles, target: Pyramid, target_xy: Doubles, *,
    affine: Doubles | None = None, coarsest_level: int = 4, half_width: int = 7,
) -> Alignment:  # fmt: skip
    """Find patches of one image in another, from guesses, to sub-pixel accuracy.

    Args:
        reference, target: pyramids of the two images.
        reference_xy: (N, 2) float64 pixels, centres of the patches.
        target_xy: (N, 2) float64 pixels, where they are expected.
        affine: (N, 2, 2) float64, takes an offset in the target to that in the reference; None: identity.
        coarsest_level: where to begin; about half_width * 2**level pixels are reached from there.
        half_width: pixels of a level from the centre of a patch to its outermost pixels, at most 7.
    """
    if not 1 <= half_width <= _MAX_HALF_WIDTH:
        raise ValueError(f"half_width {half_width} is not within 1..{_MAX_HALF_WIDTH}")
    xy = np.ascontiguousarray(reference_xy, np.float64).reshape(-1, 2)
    guess = np.array(target_xy, np.float64, order="C").reshape(-1, 2)
    warps = np.empty((0, 2, 2)) if affine is None else np.ascontiguousarray(affine, np.float64).reshape(-1, 2, 2)
    found = Alignment(guess, np.zeros(len(xy), np.float32), np.zeros(len(xy), np.bool_))
    coarsest = min(max(coarsest_level, 0), reference.num_levels - 1, target.num_levels - 1)
    _align(reference, xy, target, found, warps, coarsest, half_width, patch_window(half_width))
    return found


def compile_kernels() -> None:
    """Compile, or load from the cache, what this module and the pyramid run."""
    pyramid, xy = build_pyramid(np.zeros((40, 40), np.uint8)), np.full((1, 2), 20.0)
    align_patches(pyramid, xy, pyramid, xy)
