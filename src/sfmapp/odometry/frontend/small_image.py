"""The rotation between two frames from the images as a whole, before anything is known of points.

After Klein and Murray, "Improving the agility of keyframe-based SLAM" (ECCV 2008): small blurred images are aligned by
efficient second-order minimisation (Benhimane and Malis, IROS 2004), here over the rotation itself. All shifts are
tried on an even smaller level before, so the rotation may be a third of the field of view. Both images are freed of
what varies slowly across them, which exposure and sky rule.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.rigid3 import exp_so3
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Shorts = NDArray[np.int16]

# side, in pixels, of a square as large as the level that is aligned, and as that on which all shifts are tried
_SIDE, _SEARCH_SIDE = 64, 32
_MAX_SHIFT = 0.4  # of the width and of the height
_ITERATIONS, _SMALL_STEP_PX = 12, 0.05
# the images share at least this part and correlate at least so there; unrelated streets reach 0.5
_MIN_OVERLAP, _MIN_ZNCC = 0.4, 0.6
# grey levels that are left of the image when what varies slowly is gone
_MIN_CONTRAST = 0.5
_STEPS = np.float32(8.0)  # of a grey level in whole numbers, whose sums are vectors


def _blur(image: Floats, rounds: int) -> Floats:
    """Repeated (1, 2, 1) / 4 in both directions, a variance of half a pixel each time."""
    for _ in range(rounds):
        wide = np.concatenate([image[:, :1], image, image[:, -1:]], axis=1)
        image = np.float32(0.25) * (wide[:, :-2] + wide[:, 2:]) + np.float32(0.5) * image
        tall = np.concatenate([image[:1], image, image[-1:]])
        image = np.float32(0.25) * (tall[:-2] + tall[2:]) + np.float32(0.5) * image
    return image


@numba.njit(cache=True, nogil=True)
def _less_surroundings(image: Floats, radius: int, integral: Doubles, out: Floats) -> None:
    """The image less its mean over a square about each pixel."""
    height, width = image.shape
    for r in range(height):
        line = 0.0
        for c in range(width):
            line += image[r, c]
            integral[r + 1, c + 1] = integral[r, c + 1] + line
    for r in range(height):
        r0, r1 = max(r - radius, 0), min(r + radius + 1, height)
        for c in range(width):
            c0, c1 = max(c - radius, 0), min(c + radius + 1, width)
            total = integral[r1, c1] - integral[r0, c1] - integral[r1, c0] + integral[r0, c0]
            out[r, c] = image[r, c] - np.float32(total / ((r1 - r0) * (c1 - c0)))


def _small(pyramid: Pyramid, side: int) -> tuple[Floats, int]:
    """The level next to a size, blurred and without what varies slowly; which one it is."""
    sides = np.sqrt(pyramid.layout[:, 2] * pyramid.layout[:, 3])
    level = int(np.argmin(np.abs(np.log2(sides / side))))
    image = _blur(pyramid.level(level).astype(np.float32), 2)
    height, width = image.shape
    out = np.empty_like(image)
    _less_surroundings(image, max(int(sides[level]) // 8, 4), np.zeros((height + 1, width + 1)), out)
    return out, level


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _products(first: Shorts, second: Shorts, num: int) -> tuple[np.int32, np.int32, np.int32, np.int32, np.int32]:
    s1, s2, s11, s22, s12 = np.int32(0), np.int32(0), np.int32(0), np.int32(0), np.int32(0)
    for c in range(num):
        a, b = np.int32(first[c]), np.int32(second[c])
        s1 += a
        s2 += b
        s11 += a * a
        s22 += b * b
        s12 += a * b
    return s1, s2, s11, s22, s12


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _best_shift(reference: Shorts, target: Shorts, reach_x: int, reach_y: int, out: Doubles) -> None:
    """Whole shift of highest correlation over the pixels that both have: out (3,) gets x, y and the correlation."""
    height, width = reference.shape
    out[:] = 0.0
    for dy in range(-reach_y, reach_y + 1):
        for dx in range(-reach_x, reach_x + 1):
            s1, s2, s11, s22, s12 = 0.0, 0.0, 0.0, 0.0, 0.0
            left, num = max(0, -dx), width - abs(dx)
            for r in range(max(0, -dy), min(height, height - dy)):
                sums = _products(reference[r, left:], target[r + dy, left + dx :], num)
                s1 += sums[0]
                s2 += sums[1]
                s11 += sums[2]
                s22 += sums[3]
                s12 += sums[4]
            n = num * (height - abs(dy))
            variance = (s11 - s1 * s1 / n) * (s22 - s2 * s2 / n)
            if n < _MIN_OVERLAP * height * width or not variance > 0.0:
                continue
            score = (s12 - s1 * s2 / n) / np.sqrt(variance)
            if score > out[2]:
                out[0], out[1], out[2] = dx, dy, score


@numba.njit(cache=True, nogil=True)
def _gradients(image: Floats, out: Floats) -> None:
    """The image and its central differences, (H, W, 3), nothing at the border."""
    height, width = image.shape
    half = np.float32(0.5)
    for r in range(height):
        for c in range(width):
            out[r, c, 0] = image[r, c]
            out[r, c, 1] = out[r, c, 2] = np.float32(0)
            if 0 < r < height - 1 and 0 < c < width - 1:
                out[r, c, 1] = half * (image[r, c + 1] - image[r, c - 1])
                out[r, c, 2] = half * (image[r + 1, c] - image[r - 1, c])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(
    first: Floats, second: Floats, gain: float, rotation: Doubles, focal: float, normal: Doubles, right: Doubles
) -> tuple[float, float]:
    """Normal equations of a turn of the target, correlation, and the share of pixels that both images have.

    Args:
        first, second: (H, W, 3) image and gradients.
        gain: takes the target to the reference.
        rotation: (3, 3) target_from_reference; the turn is from the left.
        focal: pixels of the level.
        normal, right: (3, 3) and (3,), filled.
    """
    height, width = first.shape[0], first.shape[1]
    mx, my, unit = 0.5 * (width - 1), 0.5 * (height - 1), 1.0 / focal
    roll = np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    cos, sin = 0.5 * focal * np.cos(roll), 0.5 * focal * np.sin(roll)
    strength = 0.5 * focal * gain
    h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    b0, b1, b2, s11, s22, s12 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n = 0
    for r in range(1, height - 1):
        dy = (r - my) * unit
        for c in range(1 + r % 2, width - 1, 2):  # blurred as they are, half of the pixels tell all
            dx = (c - mx) * unit
            depth = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2]
            if not depth > 0.1:
                continue
            near = 1.0 / depth
            x = (rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2]) * near
            y = (rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2]) * near
            u, v = mx + focal * x, my + focal * y
            if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
                continue
            c0, r0 = int(u), int(v)
            fx, fy = u - c0, v - r0
            a00, a01, a10, a11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
            p, q = second[r0], second[r0 + 1]
            value = gain * (a00 * p[c0, 0] + a01 * p[c0 + 1, 0] + a10 * q[c0, 0] + a11 * q[c0 + 1, 0])
            gx = a00 * p[c0, 1] + a01 * p[c0 + 1, 1] + a10 * q[c0, 1] + a11 * q[c0 + 1, 1]
            gy = a00 * p[c0, 2] + a01 * p[c0 + 1, 2] + a10 * q[c0, 2] + a11 * q[c0 + 1, 2]
            # the reference's gradient in the axes of the target; the mean of both makes the step second order
            t, hx, hy = first[r, c, 0], first[r, c, 1], first[r, c, 2]
            gx, gy = strength * gx + cos * hx - sin * hy, strength * gy + sin * hx + cos * hy
            along = gx * x + gy * y
            j0, j1, j2 = -gy - along * y, gx + along * x, gy * x - gx * y
            e = value - t
            h00, h01, h02 = h00 + j0 * j0, h01 + j0 * j1, h02 + j0 * j2
            h11, h12, h22 = h11 + j1 * j1, h12 + j1 * j2, h22 + j2 * j2
            b0, b1, b2 = b0 + j0 * e, b1 + j1 * e, b2 + j2 * e
            s11, s22, s12 = s11 + t * t, s22 + value * value, s12 + t * value
            n += 1
    normal[0, 0], normal[0, 1], normal[0, 2], normal[1, 1], normal[1, 2], normal[2, 2] = h00, h01, h02, h11, h12, h22
    normal[1, 0], normal[2, 0], normal[2, 1] = h01, h02, h12
    right[0], right[1], right[2] = b0, b1, b2
    correlation = s12 / np.sqrt(s11 * s22) if s11 * s22 > 0.0 else 0.0
    return correlation, 2.0 * n / ((height - 2) * (width - 2))


def _refine(first: Floats, second: Floats, gain: float, rotation: Doubles, focal: float) -> Doubles | None:
    """Align by rotation from a start; None where the images do not agree at the end."""
    normal, right = np.empty((3, 3)), np.empty(3)
    for _ in range(_ITERATIONS):
        correlation, overlap = _accumulate(first, second, gain, rotation, focal, normal, right)
        if not (overlap >= _MIN_OVERLAP and correlation >= 0.0 and np.linalg.cond(normal) <= 1e6):
            return None
        turn = np.linalg.solve(normal, right)
        if focal * np.abs(turn).max() < _SMALL_STEP_PX:
            break
        rotation = exp_so3(-turn) @ rotation
    return rotation if correlation > _MIN_ZNCC else None


def align_small_images(reference: Pyramid, target: Pyramid, camera_focal_px: float) -> Doubles | None:
    """Rotation between two frames of one camera whose centre hardly moved, from the images as a whole.

    Args:
        reference, target: pyramids of images of the same size.
        camera_focal_px: focal length in pixels of the image; the principal point is taken to be in its middle and the
            lens to be without distortion.

    Returns:
        (3, 3) target_from_reference, or None where the images do not correlate.
    """
    fine, level = _small(reference, _SIDE)
    fine2, _ = _small(target, _SIDE)
    if min(fine.std(), fine2.std()) < _MIN_CONTRAST or min(fine.shape) < 8:
        return None
    small, search_level = _small(reference, _SEARCH_SIDE)
    small2, _ = _small(target, _SEARCH_SIDE)
    height, width = small.shape
    found = np.zeros(3)
    steps, steps2 = (np.rint(_STEPS * image).astype(np.int16) for image in (small, small2))
    _best_shift(steps, steps2, int(_MAX_SHIFT * width), int(_MAX_SHIFT * height), found)
    first, second = (np.empty((*image.shape, 3), np.float32) for image in (fine, fine2))
    _gradients(fine, first)
    _gradients(fine2, second)
    shift = found[:2] * (2.0**search_level / camera_focal_px)
    angle = np.arctan(np.hypot(*shift))
    start = exp_so3(angle / max(float(np.hypot(*shift)), 1e-12) * np.array([-shift[1], shift[0], 0.0]))
    return _refine(first, second, float(fine.std() / fine2.std()), start, camera_focal_px * 0.5**level)


def compile_kernels() -> None:
    """Compile, or load from the cache, what this module runs."""
    y, x = np.mgrid[:64, :64]
    pyramid = build_pyramid(((x // 16 + y // 16) % 2 * 200).astype(np.uint8), 2)
    align_small_images(pyramid, pyramid, 64.0)
