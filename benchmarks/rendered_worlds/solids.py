"""Solids of exact shape under lamps: photographs by sphere tracing, with the shadows that the solid throws on itself.

A solid is a list of simple shapes that are added, and taken away from what stands before them. Each gives a signed
distance that is never more than the true one, so that a ray may step by it without passing through (Hart, "Sphere
tracing", The Visual Computer 12, 1996). Surfaces are matt (Lambert) unless they are made glossy, lamps are points whose
light falls with the square of the distance, and there is no light from all sides but what ``ambient`` says.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

BALL, BOX, CYLINDER, RING = 0, 1, 2, 3
# kind, 1 if taken away, middle, sizes, rounding, rows of the rotation, albedo, share of light mirrored
ROW = 20
_KIND, _TAKEN, _AT, _SIZE, _ROUND, _TURN, _ALBEDO, _GLOSS = 0, 1, 2, 5, 8, 9, 18, 19
# of a mirrored lamp's image: the higher, the smaller
_SHARPNESS = 60.0
SAMPLES = 2  # a side of a pixel


def shape(
    kind: int, at: ArrayLike, sizes: ArrayLike, *, taken: bool = False, rounding: float = 0.02,
    turn: ArrayLike = (0.0, 0.0, 0.0), albedo: float = 0.6, gloss: float = 0.0,
) -> Array:  # fmt: skip
    """A row (20,) of a solid.

    Args:
        kind: ``BALL`` of a radius; ``BOX`` of three half sides; ``CYLINDER`` of radius and half length along its z;
            ``RING`` about its z of radius and thickness.
        at: middle. sizes: up to three numbers.
        taken: away from what stands before it in the list, rather than added.
        rounding: radius of the edges of boxes and cylinders, which lies within the sizes.
        turn: rotation vector, radians. albedo: share of the light that is sent back. gloss: share of that mirrored.
    """
    row = np.zeros(ROW)
    row[_KIND], row[_TAKEN], row[_ROUND], row[_ALBEDO], row[_GLOSS] = kind, float(taken), rounding, albedo, gloss
    row[_AT : _AT + 3] = at
    sizes = np.atleast_1d(np.asarray(sizes, np.float64))
    row[_SIZE : _SIZE + len(sizes)] = sizes
    # from the world into the shape's own axes
    row[_TURN : _TURN + 9] = rigid3.exp_so3(np.asarray(turn, np.float64)).T.ravel()
    return row


@dataclass(frozen=True)
class Solid:
    """Shapes (N, 20), and a ball about the origin of radius ``reach`` that holds them."""

    shapes: Array
    reach: float

    def distance(self, xyz: Array) -> Array:
        """Signed distances (N,) of points (N, 3), positive outside, in absolute value never more than the true ones."""
        out = np.empty(len(xyz))
        _distances(self.shapes, np.ascontiguousarray(xyz, np.float64), out)
        return out

    def volume(self, cells: int = 256) -> float:
        """By cells of a cube about the origin; those that the surface passes through count by their distance."""
        side = 2.0 * self.reach / cells
        axis = (np.arange(cells) + 0.5) * side - self.reach
        total = 0.0
        for x in axis:
            y, z = np.meshgrid(axis, axis)
            d = self.distance(np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1))
            total += float(np.clip(0.5 - d / side, 0.0, 1.0).sum())
        return total * side**3


@dataclass(frozen=True)
class Lamps:
    """Lamps that shine one at a time.

    Attributes:
        places: (L, 3) world.
        power: (L,) brightness of a white surface straight below a lamp at distance 1.
    """

    places: Array
    power: Array


@dataclass(frozen=True)
class Rendering:
    """Attributes:
    cover: (H, W) float32 share of each pixel that shows the solid.
    depth: (H, W) float32 distance along the ray of the pixel's centre, inf where it meets nothing.
    light: (L, H, W) float32 brightness under each lamp, linear, 1 is white.
    """

    cover: NDArray[np.float32]
    depth: NDArray[np.float32]
    light: NDArray[np.float32]


def render(solid: Solid, camera: Camera, cam_from_world: ArrayLike, lamps: Lamps) -> Rendering:
    """What a camera with a pose (7,) sees under each lamp alone, before black."""
    pose = np.asarray(cam_from_world, np.float64)
    steps = [(np.arange(side * SAMPLES) + 0.5) / SAMPLES for side in (camera.width, camera.height)]
    x, y = np.meshgrid(*steps)
    rays = pixels_to_rays(camera, np.stack([x.ravel(), y.ravel()], axis=1)) @ rigid3.rotation_matrix(pose)
    size, count = (camera.height, camera.width), len(lamps.places)
    cover, depth = np.zeros(size, np.float32), np.full(size, np.inf, np.float32)
    light = np.zeros((count, *size), np.float32)
    rays = np.ascontiguousarray(rays.reshape(*x.shape, 3))
    _render(solid.shapes, solid.reach, rigid3.center(pose), rays, lamps.places, lamps.power, cover, depth, light)
    return Rendering(cover, depth, light)


def photograph(light: NDArray[np.float32], noise_sigma: float, key: Sequence[int]) -> NDArray[np.uint8]:
    """(H, W) uint8 as a camera makes it of linear brightness: the curve of sRGB, noise in grey levels, rounded."""
    linear = np.clip(light, 0.0, 1.0)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055)
    noise = noise_sigma * np.random.default_rng(key).standard_normal(light.shape)
    return np.asarray(np.clip(np.rint(255.0 * coded + noise), 0, 255), np.uint8)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distance(shapes: Array, x: float, y: float, z: float) -> tuple[float, int]:
    """Signed distance, and which shape makes the surface there."""
    best, found = 1e9, 0
    for n in range(shapes.shape[0]):
        s = shapes[n]
        dx, dy, dz = x - s[2], y - s[3], z - s[4]
        a = s[9] * dx + s[10] * dy + s[11] * dz
        b = s[12] * dx + s[13] * dy + s[14] * dz
        c = s[15] * dx + s[16] * dy + s[17] * dz
        kind = int(s[0])
        if kind == 0:
            d = math.sqrt(a * a + b * b + c * c) - s[5]
        elif kind == 1:
            a, b, c = abs(a) - s[5] + s[8], abs(b) - s[6] + s[8], abs(c) - s[7] + s[8]
            d = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
            d += min(max(a, max(b, c)), 0.0) - s[8]
        elif kind == 2:
            a, c = math.hypot(a, b) - s[5] + s[8], abs(c) - s[6] + s[8]
            d = math.hypot(max(a, 0.0), max(c, 0.0)) + min(max(a, c), 0.0) - s[8]
        else:
            d = math.hypot(math.hypot(a, b) - s[5], c) - s[6]
        if s[1] != 0.0:
            if -d > best:
                best, found = -d, n
        elif d < best:
            best, found = d, n
    return best, found


@numba.njit(cache=True, nogil=True)
def _distances(shapes: Array, xyz: Array, out: Array) -> None:
    for i in range(xyz.shape[0]):
        out[i] = _distance(shapes, xyz[i, 0], xyz[i, 1], xyz[i, 2])[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _trace(
    shapes: Array, reach: float, x: float, y: float, z: float, dx: float, dy: float, dz: float, start: float, end: float
) -> float:
    """Distance along a ray to the solid, from ``start`` on; inf where there is none before ``end``."""
    along = x * dx + y * dy + z * dz
    inside = along * along - (x * x + y * y + z * z - reach * reach)
    if inside < 0.0:
        return math.inf
    root = math.sqrt(inside)
    t, end = max(start, -along - root), min(end, -along + root)
    while t < end:
        d = _distance(shapes, x + t * dx, y + t * dy, z + t * dz)[0]
        if d < 1e-4 * reach:
            return t
        t += d
    return math.inf


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _render(
    shapes: Array, reach: float, center: Array, rays: Array, places: Array, power: Array, cover: NDArray[np.float32],
    depth: NDArray[np.float32], light: NDArray[np.float32],
) -> None:  # fmt: skip
    height, width = cover.shape
    share = 1.0 / (SAMPLES * SAMPLES)
    for i in range(height * SAMPLES):
        for j in range(width * SAMPLES):
            r = rays[i, j]
            t = _trace(shapes, reach, center[0], center[1], center[2], r[0], r[1], r[2], 0.0, 1e9)
            if t == math.inf:
                continue
            u, v = i // SAMPLES, j // SAMPLES
            cover[u, v] += share
            depth[u, v] = min(depth[u, v], t)
            x, y, z = center[0] + t * r[0], center[1] + t * r[1], center[2] + t * r[2]
            _d, n = _distance(shapes, x, y, z)
            e = 1e-5 * reach
            nx = _distance(shapes, x + e, y, z)[0] - _distance(shapes, x - e, y, z)[0]
            ny = _distance(shapes, x, y + e, z)[0] - _distance(shapes, x, y - e, z)[0]
            nz = _distance(shapes, x, y, z + e)[0] - _distance(shapes, x, y, z - e)[0]
            norm = math.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx / norm, ny / norm, nz / norm
            # away from the surface, so that a lamp's ray does not end where it begins
            e = 4e-4 * reach
            x, y, z = x + e * nx, y + e * ny, z + e * nz
            for k in range(places.shape[0]):
                lx, ly, lz = places[k, 0] - x, places[k, 1] - y, places[k, 2] - z
                away = math.sqrt(lx * lx + ly * ly + lz * lz)
                lx, ly, lz = lx / away, ly / away, lz / away
                lean = nx * lx + ny * ly + nz * lz
                if lean <= 0.0 or _trace(shapes, reach, x, y, z, lx, ly, lz, 0.0, away) < math.inf:
                    continue
                hx, hy, hz = lx - r[0], ly - r[1], lz - r[2]
                mirror = max((nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz), 0.0)
                gloss = shapes[n, 19]
                sent = shapes[n, 18] * ((1.0 - gloss) * lean + 4.0 * gloss * mirror**_SHARPNESS)
                light[k, u, v] += share * power[k] * sent / (away * away)
