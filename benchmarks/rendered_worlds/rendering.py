"""A small ray caster: worlds of textured rectangles seen through any lens, with exact ground truth.

What a pixel shows follows from the rectangle's homography alone. With the rectangle's corner p and edges a, b in the
camera's frame, the ray d = (x, y, 1) meets the point p + u a + v b at depth z where ``[a b p] (u/z, v/z, 1/z) = d``:
three dot products with the rows of the inverse matrix give place and inverse depth, and the largest inverse depth wins.
Their quotient's derivative is the pixel's footprint on the texture, which picks the mip level (Williams, "Pyramidal
parametrics", SIGGRAPH 1983) and, where the footprint is long, several samples along it (Feline, McCormack et al.,
SIGGRAPH 1999). Pixels where rectangles meet are sampled eight times over, the others once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TILE_PX = 16
NEAR_M = 0.02  # surfaces nearer than this are cut away
MAX_PROBES = 6  # samples along the footprint; beyond this ratio of its axes the texture is blurred
MAX_LEVELS = 13
BLUR_STEP_PX = 1.5  # a moving image is sampled this densely: less than its own sharpness
BAND_ROWS = 8  # of a rolling shutter are taken at one time: a hundredth of a pixel at a pixel a millisecond
EDGE_GREY = 1.5  # surfaces that differ by less than this look like one
# eight rooks: each row and column of an 8 x 8 grid is hit once, so edges of any direction get nine levels
ROOKS = (np.array([[0, 3], [1, 6], [2, 0], [3, 5], [4, 2], [5, 7], [6, 1], [7, 4]]) + 0.5) / 8 - 0.5


@dataclass(frozen=True)
class Atlas:
    """Grey textures with their mip pyramids in one array.

    Attributes:
        pixels: (P,) uint8, all levels one after the other.
        sizes: (T, 3) int64 width, height (powers of two), number of levels.
        offsets: (T, 13) int64, where each level begins.
    """

    pixels: NDArray[np.uint8]
    sizes: Ints
    offsets: Ints

    @staticmethod
    def of(textures: Sequence[NDArray[np.uint8]]) -> Atlas:
        """Build the pyramids of (H, W) uint8 textures; ValueError unless both sides are powers of two."""
        parts: list[NDArray[np.uint8]] = []
        sizes = np.zeros((len(textures), 3), np.int64)
        offsets = np.zeros((len(textures), MAX_LEVELS), np.int64)
        used = 0
        for i, texture in enumerate(textures):
            height, width = texture.shape
            if width & (width - 1) or height & (height - 1) or max(width, height) >= 2**MAX_LEVELS:
                raise ValueError(f"sides of a texture must be powers of two below {2**MAX_LEVELS}, got {texture.shape}")
            level: NDArray[np.floating] = texture.astype(np.float32)
            count = 0
            while True:
                offsets[i, count] = used
                parts.append(np.rint(level).astype(np.uint8).ravel())
                used += level.size
                count += 1
                if min(level.shape) == 1:
                    break
                level = 0.25 * (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2])
            sizes[i] = width, height, count
        return Atlas(np.concatenate(parts), sizes, offsets)


@dataclass(frozen=True)
class World:
    """Textured rectangles, visible from one side.

    Attributes:
        atlas: the textures.
        origin: (Q, 3) corner at the texture's top left. edges: (Q, 2, 3) along the texture's rows (to the right as seen
            from the visible side) and down its columns.
        texture: (Q,) index. window: (Q, 4) texture coordinate of the corner and how far it runs along each edge, in
            periods of the texture: (0, 0, 1, 1) shows it once. Textures repeat.
        overlay: (Q,) index of a second texture that multiplies the first (128 means one), or -1.
        overlay_window: (Q, 4) is to the overlay what window is to the texture.
        shade: (Q,) factor on the grey values.
        velocity: (Q, 3) m/s; zero at rest. cycle: (Q, 2) phase and length in metres: what moves starts again after each
            length of way.
    """

    atlas: Atlas
    origin: Array
    edges: Array
    texture: Ints
    window: Array
    overlay: Ints
    overlay_window: Array
    shade: Array
    velocity: Array
    cycle: Array

    def origin_at(self, time_s: float) -> Array:
        """(Q, 3) corners at a time."""
        speed = np.linalg.norm(self.velocity, axis=1)
        moving = speed > 0
        if not moving.any():
            return self.origin
        way = (self.cycle[moving, 0] + speed[moving] * time_s) % self.cycle[moving, 1]
        origin = self.origin.copy()
        origin[moving] += self.velocity[moving] / speed[moving, None] * way[:, None]
        return origin


@dataclass(frozen=True)
class Optics:
    """What lies between the scene and the grey values."""

    noise_sigma: float = 2.0  # standard deviation of the sensor's noise in grey levels
    vignetting: float = 0.1  # share of the light that is missing in the corners; falls with the squared radius
    exposure_s: float = 0.0  # how long the shutter is open; motion blurs over this time
    sub_exposures: int = 1  # most images averaged over the exposure; fewer where less moves. 1: no blur
    edge_samples: bool = True  # eight rays a pixel where surfaces meet; False: one ray everywhere
    readout_s: float = 0.0  # from the first row to the last: a rolling shutter, which opens row by row. 0: global


@dataclass(frozen=True)
class View:
    """One exact rendering.

    Attributes:
        grey: (H, W) float32, neither rounded nor clipped.
        surface: (H, W) int32, the rectangle at the pixel's centre, -1 where the ray meets none.
        depth: (H, W) float32 along the optical axis, inf where the ray meets none.
    """

    grey: NDArray[np.float32]
    surface: NDArray[np.int32]
    depth: NDArray[np.float32]


class Renderer:
    """Renders a world through one camera; the lens is inverted once. May be used by several threads at a time."""

    def __init__(self, world: World, camera: Camera, rows: tuple[int, int] | None = None) -> None:
        """rows: the first and the one after the last that are rendered; None: all."""
        self.world = world
        self.camera = camera
        self.rows = (0, camera.height) if rows is None else rows

    @cached_property
    def _rays(self) -> tuple[Array, Array, Array, Array]:
        """(H, W, 2) normalised image points of the pixel centres, (H, W, 4) their derivative by the pixel, (R, C, 4)
        bounds x0, x1, y0, y1 of the tiles, (4, max(R, C)) bounds of the tiles' columns and rows."""
        width, (first, last) = self.camera.width, self.rows
        height = last - first
        x, y = np.meshgrid(np.arange(-1, width + 1) + 0.5, np.arange(first - 1, last + 1) + 0.5)
        rays = pixels_to_normalized(self.camera, np.stack([x.ravel(), y.ravel()], 1)).reshape(*x.shape, 2)
        if not np.isfinite(rays).all():
            raise ValueError("the lens has no inverse in a corner of the image")
        slopes = np.concatenate([rays[1:-1, 2:] - rays[1:-1, :-2], rays[2:, 1:-1] - rays[:-2, 1:-1]], -1) / 2
        rows, columns = -(-height // TILE_PX), -(-width // TILE_PX)
        bounds = np.empty((rows, columns, 4))
        for r in range(rows):
            for c in range(columns):  # one pixel more all round, for the rays beside the centres
                tile = rays[r * TILE_PX : (r + 1) * TILE_PX + 2, c * TILE_PX : (c + 1) * TILE_PX + 2].reshape(-1, 2)
                bounds[r, c, ::2], bounds[r, c, 1::2] = tile.min(0), tile.max(0)
        spans = np.zeros((4, max(rows, columns)))
        spans[0, :columns], spans[1, :columns] = bounds[..., 0].min(0), bounds[..., 1].max(0)
        spans[2, :rows], spans[3, :rows] = bounds[..., 2].min(1), bounds[..., 3].max(1)
        return np.ascontiguousarray(rays[1:-1, 1:-1]), np.ascontiguousarray(slopes), bounds, spans

    @cached_property
    def _paint(self) -> tuple[Array, Ints]:
        """What does not depend on the pose: (Q, 16) and (Q, 2) texture and overlay.

        Columns: 0-5 left for the homography to the texture; 6-9 overlay coordinates as offset and factor of the
        texture's, both in texels of their finest levels; 10, 11 extent and 14, 15 start of the window in texels;
        12 shade; 13 how many levels coarser the overlay is read.
        """
        world = self.world
        paint = np.zeros((len(world.origin), 16))
        size = world.atlas.sizes[world.texture, :2]
        other = world.atlas.sizes[np.maximum(world.overlay, 0), :2]
        paint[:, 14:16], paint[:, 10:12] = world.window[:, :2] * size, world.window[:, 2:] * size
        factor = world.overlay_window[:, 2:] * other / paint[:, 10:12]
        paint[:, 7:10:2] = factor
        paint[:, 6:9:2] = world.overlay_window[:, :2] * other - factor * paint[:, 14:16]
        paint[:, 12], paint[:, 13] = world.shade, np.log2(np.abs(factor[:, 0]))
        return paint, np.stack([world.texture, world.overlay], 1)

    def view(self, cam_from_world: ArrayLike, time_s: float = 0.0, *, edge_samples: bool = True) -> View:
        """What the camera sees from a pose (7,) at a time, without noise, vignetting or blur."""
        world = self.world
        rays, slopes, bounds, spans = self._rays
        pose = np.ascontiguousarray(cam_from_world, np.float64)
        rotation = rigid3.rotation_matrix(pose)
        num = len(world.origin)
        inverse, box, nearest = np.empty((num, 3, 3)), np.empty((num, 4)), np.empty(num)
        low, high = bounds.min((0, 1)), bounds.max((0, 1))
        frame = np.array([low[0], high[1], low[2], high[3]])
        _see_quads(world.origin_at(time_s), world.edges, rotation, pose[4:], frame, inverse, box, nearest)
        order = np.flatnonzero(nearest > 0)
        order = order[np.argsort(-nearest[order], kind="stable")]
        paint, skins = self._paint
        paint = paint[order]
        # from the place on the rectangle to the place on its texture, in texels
        paint[:, :6] = (
            paint[:, 14:16, None] * inverse[order, 2, None] + paint[:, 10:12, None] * inverse[order, :2]
        ).reshape(-1, 6)
        quads = _Quads(inverse[order], nearest[order], paint, skins[order])
        starts, entries = _fill_tiles(quads.inverse, box[order], bounds, spans)
        shape = rays.shape[:2]
        grey, found, depth = np.zeros(shape, np.float32), np.empty(shape, np.int32), np.empty(shape, np.float32)
        atlas = _Atlas(world.atlas.pixels, world.atlas.sizes, world.atlas.offsets)
        _trace_centres(rays, slopes, starts, entries, quads, atlas, grey, found, depth)
        if edge_samples:
            _trace_edges(rays, slopes, starts, entries, quads, atlas, ROOKS, found, grey)
        surface = np.where(found >= 0, order.astype(np.int32)[found] if len(order) else -1, -1).astype(np.int32)
        return View(grey, surface, depth)

    def photograph(
        self, cam_from_world: ArrayLike, optics: Optics, key: Sequence[int], *, time_s: float = 0.0, gain: float = 1.0,
        motion: ArrayLike | None = None,
    ) -> NDArray[np.uint8]:  # fmt: skip
        """An (H, W) uint8 image as a camera would deliver it.

        Args:
            cam_from_world: (7,) pose at the middle of the exposure, of a rolling shutter that of the middle row.
            optics: noise, vignetting, blur.
            key: the noise is drawn from these integers.
            gain: exposure, a factor on the grey values before the noise.
            motion: (6,) angular velocity in the camera's frame (rad/s) and velocity of its centre in the world (m/s);
                needed for motion blur and a rolling shutter.
        """
        moving = np.zeros(6) if motion is None else np.asarray(motion, np.float64)
        if optics.readout_s:
            grey = np.concatenate([
                band._exposed(moved_camera(cam_from_world, moving, late), optics, time_s + late, moving)
                for band, late in zip(self._bands, self._lateness(optics.readout_s), strict=True)
            ])  # fmt: skip
        else:
            grey = self._exposed(cam_from_world, optics, time_s, moving)
        grey *= self._vignette(optics.vignetting) * np.float32(gain)
        if optics.noise_sigma > 0:
            rng = np.random.default_rng([*key, 0x2E17DE2])
            grey += np.float32(optics.noise_sigma) * rng.standard_normal(grey.shape, np.float32)
        image: NDArray[np.uint8] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        return image

    @cached_property
    def _bands(self) -> list[Renderer]:
        """The image in rows that are taken at one time."""
        height = self.camera.height
        return [
            Renderer(self.world, self.camera, (row, min(row + BAND_ROWS, height)))
            for row in range(0, height, BAND_ROWS)
        ]

    def _lateness(self, readout_s: float) -> list[float]:
        """Seconds of the middle of each band after that of the image."""
        return [(sum(band.rows) / (2 * self.camera.height) - 0.5) * readout_s for band in self._bands]

    def _exposed(self, cam_from_world: ArrayLike, optics: Optics, time_s: float, moving: Array) -> NDArray[np.float32]:
        """Grey values with the blur of a motion (6,)."""
        view = self.view(cam_from_world, time_s, edge_samples=optics.edge_samples)
        count = min(optics.sub_exposures, self._blur_steps(view.depth, moving, optics.exposure_s))
        if count == 1:
            return view.grey
        grey = np.zeros_like(view.grey)
        for k in range(count):
            shift_s = ((k + 0.5) / count - 0.5) * optics.exposure_s
            pose = moved_camera(cam_from_world, moving, shift_s)
            grey += self.view(pose, time_s + shift_s, edge_samples=optics.edge_samples).grey / np.float32(count)
        return grey

    def _blur_steps(self, depth: NDArray[np.float32], motion: Array, exposure_s: float) -> int:
        """How many images make a blur without ghosts: all but the nearest tenth moves by less than a step between."""
        near = float(np.quantile(depth[::4, ::4], 0.1))
        angle = exposure_s * (np.linalg.norm(motion[:3]) + np.linalg.norm(motion[3:]) / near)
        return max(1, math.ceil(self.camera.focal * float(angle) / BLUR_STEP_PX))

    def _vignette(self, share: float) -> NDArray[np.float32]:
        rows, columns = self.camera.height, self.camera.width
        y, x = np.mgrid[:rows, :columns] + 0.5
        r2 = (x / columns - 0.5) ** 2 * columns**2 + (y / rows - 0.5) ** 2 * rows**2
        factor: NDArray[np.float32] = (1 - share * r2 / (columns**2 + rows**2) * 4).astype(np.float32)
        return factor


def moved_camera(cam_from_world: ArrayLike, motion: ArrayLike, dt_s: float) -> Array:
    """Pose (7,) after a time of constant motion (6,): angular velocity in the camera's frame, its centre's velocity in
    the world."""
    motion = np.asarray(motion, np.float64)
    rotation = rigid3.exp_so3(-dt_s * motion[:3]) @ rigid3.rotation_matrix(cam_from_world)
    return rigid3.from_matrix(rotation, -rotation @ (rigid3.center(cam_from_world) + dt_s * motion[3:]))


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _see_quads(
    origin: Array, edges: Array, rotation: Array, shift: Array, frame: Array, inverse: Array, box: Array, nearest: Array
) -> None:
    """For each rectangle: the inverse matrix of the module's docstring, its bounds in the normalised image, and the
    largest inverse depth on it (0 for one that is not to be seen)."""
    corners = np.empty((4, 3))
    p, a, b, n, u, v = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for q in range(origin.shape[0]):
        for i in range(3):
            p[i], a[i], b[i] = shift[i], 0.0, 0.0
            for j in range(3):
                p[i] += rotation[i, j] * origin[q, j]
                a[i] += rotation[i, j] * edges[q, 0, j]
                b[i] += rotation[i, j] * edges[q, 1, j]
        nearest[q] = 0.0
        _cross(a, b, n)
        det = n[0] * p[0] + n[1] * p[1] + n[2] * p[2]
        if det <= 1e-9 * math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]):
            continue  # seen from behind, or edge on
        for i in range(3):
            corners[0, i], corners[1, i] = p[i], p[i] + a[i]
            corners[2, i], corners[3, i] = p[i] + a[i] + b[i], p[i] + b[i]
        x0, x1, y0, y1, zmin = math.inf, -math.inf, math.inf, -math.inf, math.inf
        for i in range(4):  # the outline, cut at the near plane
            j = (i + 1) % 4
            z, z_next = corners[i, 2], corners[j, 2]
            if z >= NEAR_M:
                x, y = corners[i, 0] / z, corners[i, 1] / z
                x0, x1, y0, y1, zmin = min(x0, x), max(x1, x), min(y0, y), max(y1, y), min(zmin, z)
            if (z >= NEAR_M) != (z_next >= NEAR_M):
                s = (NEAR_M - z) / (z_next - z)
                x = (corners[i, 0] + s * (corners[j, 0] - corners[i, 0])) / NEAR_M
                y = (corners[i, 1] + s * (corners[j, 1] - corners[i, 1])) / NEAR_M
                x0, x1, y0, y1, zmin = min(x0, x), max(x1, x), min(y0, y), max(y1, y), NEAR_M
        if x0 > frame[1] or x1 < frame[0] or y0 > frame[3] or y1 < frame[2]:
            continue
        box[q, 0], box[q, 1], box[q, 2], box[q, 3] = x0, x1, y0, y1
        nearest[q] = 1.0 / zmin
        _cross(b, p, u)
        _cross(p, a, v)
        for i in range(3):
            inverse[q, 0, i], inverse[q, 1, i], inverse[q, 2, i] = u[i] / det, v[i] / det, n[i] / det


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _largest(x: float, y: float, z: float, tile: Array) -> float:
    """Largest value of x X + y Y + z over a tile's bounds."""
    return (x * tile[1] if x > 0 else x * tile[0]) + (y * tile[3] if y > 0 else y * tile[2]) + z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reaches(h: Array, q: int, tile: Array) -> bool:
    """Whether a rectangle may be seen in a tile: none of its four sides has the whole tile outside."""
    for row in range(2):
        if _largest(h[q, row, 0], h[q, row, 1], h[q, row, 2], tile) < 0:
            return False
        if _largest(h[q, 2, 0] - h[q, row, 0], h[q, 2, 1] - h[q, row, 1], h[q, 2, 2] - h[q, row, 2], tile) < 0:
            return False
    return _largest(h[q, 2, 0], h[q, 2, 1], h[q, 2, 2], tile) > 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _span(low: Array, high: Array, first: float, last: float) -> tuple[int, int]:
    """Which tiles of a row or column, with ascending bounds, overlap an interval: begin and end."""
    begin, end = 0, len(low)
    while begin < end and high[begin] < first:
        begin += 1
    while end > begin and low[end - 1] > last:
        end -= 1
    return begin, end


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_tiles(inverse: Array, box: Array, bounds: Array, spans: Array) -> tuple[Ints, NDArray[np.int32]]:
    """CSR lists of the rectangles that reach each tile, in the order given.

    Spans: (4, tiles) lowest and highest x of the columns, lowest and highest y of the rows.
    """
    rows, columns = bounds.shape[0], bounds.shape[1]
    starts = np.zeros(rows * columns + 1, np.int64)
    capacity, used = 64 * rows * columns, 0
    pairs = np.empty((capacity, 2), np.int32)
    for q in range(inverse.shape[0]):
        if used + rows * columns > capacity:
            capacity = 2 * capacity
            longer = np.empty((capacity, 2), np.int32)
            longer[:used] = pairs[:used]
            pairs = longer
        left, right = _span(spans[0, :columns], spans[1, :columns], box[q, 0], box[q, 1])
        top, bottom = _span(spans[2, :rows], spans[3, :rows], box[q, 2], box[q, 3])
        for r in range(top, bottom):
            for c in range(left, right):
                if _reaches(inverse, q, bounds[r, c]):
                    pairs[used, 0], pairs[used, 1] = r * columns + c, q
                    used += 1
                    starts[r * columns + c + 1] += 1
    for tile in range(rows * columns):
        starts[tile + 1] += starts[tile]
    place = starts[:-1].copy()
    entries = np.empty(used, np.int32)
    for k in range(used):
        entries[place[pairs[k, 0]]] = pairs[k, 1]
        place[pairs[k, 0]] += 1
    return starts, entries


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _hit(x: float, y: float, first: int, last: int, entries: Any, inverse: Array, nearest: Array) -> tuple[int, float]:
    """The nearest rectangle on a ray and its inverse depth; -1 if there is none."""
    best, found = 1e-12, -1
    for e in range(first, last):
        q = entries[e]
        if best >= nearest[q]:
            break  # sorted: nothing that follows is nearer
        w = inverse[q, 2, 0] * x + inverse[q, 2, 1] * y + inverse[q, 2, 2]
        if w <= best or w > 1.0 / NEAR_M:
            continue
        slack = 1e-9 * w  # rectangles that share an edge leave no gap
        u = inverse[q, 0, 0] * x + inverse[q, 0, 1] * y + inverse[q, 0, 2]
        if u < -slack or u > w + slack:
            continue
        v = inverse[q, 1, 0] * x + inverse[q, 1, 1] * y + inverse[q, 1, 2]
        if v < -slack or v > w + slack:
            continue
        best, found = w, q
    return found, best


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _bilinear(pixels: Any, offset: int, width: int, height: int, s: float, t: float) -> float:
    """A repeating texture at (s, t), in texels of the level that begins at the offset."""
    s -= 0.5
    t -= 0.5
    fs, ft = math.floor(s), math.floor(t)
    s -= fs
    t -= ft
    i0, j0 = int(fs) & (width - 1), int(ft) & (height - 1)
    i1, j1 = (i0 + 1) & (width - 1), (j0 + 1) & (height - 1)
    # unsigned, so that numba does not look for negative indices
    top_left, top_right = np.uint64(offset + j0 * width + i0), np.uint64(offset + j0 * width + i1)
    low_left, low_right = np.uint64(offset + j1 * width + i0), np.uint64(offset + j1 * width + i1)
    upper = pixels[top_left] + s * (float(pixels[top_right]) - pixels[top_left])
    lower = pixels[low_left] + s * (float(pixels[low_right]) - pixels[low_left])
    return upper + t * (lower - upper)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _trilinear(pixels: Any, sizes: Ints, offsets: Ints, texture: int, s: float, t: float, level: float) -> float:
    """A texture at (s, t), in texels of its finest level, between two levels of its pyramid."""
    low = min(int(level), sizes[texture, 2] - 1)
    width, height = sizes[texture, 0] >> low, sizes[texture, 1] >> low
    scale = 1.0 / (1 << low)
    value = _bilinear(pixels, offsets[texture, low], width, height, s * scale, t * scale)
    share = level - low
    if share > 0.0 and low + 1 < sizes[texture, 2]:
        scale *= 0.5
        coarse = _bilinear(pixels, offsets[texture, low + 1], width >> 1, height >> 1, s * scale, t * scale)
        value += share * (coarse - value)
    return value


class _Quads(NamedTuple):
    """Rectangles (Q) in sight, the nearest first: what leads from a ray to a place on them, their depth, how they are
    painted, and their two textures."""

    inverse: Array
    nearest: Array
    paint: Array
    skins: Ints


class _Atlas(NamedTuple):
    """All textures with their pyramids in one row of pixels; sizes and offsets of their levels."""

    pixels: Any
    sizes: Ints
    offsets: Ints


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _colour(
    ray: tuple[float, float, float], slope: tuple[float, float, float, float], scale: float, probes: int, q: int,
    inverse: Array, paint: Array, skins: Ints, pixels: Any, sizes: Ints, offsets: Ints,
) -> float:  # fmt: skip
    """Grey value that rectangle q shows at inverse depth w on the ray (x, y, 1), ``ray`` being (x, y, w), over a
    footprint of ``scale`` pixels; ``slope``: how x and y change along a row and down a column of pixels."""
    x, y, w = ray
    z = 1.0 / w
    s = (paint[q, 0] * x + paint[q, 1] * y + paint[q, 2]) * z
    t = (paint[q, 3] * x + paint[q, 4] * y + paint[q, 5]) * z
    # derivative of (s, t) by the ray, then by the pixel
    z *= scale
    wx, wy = inverse[q, 2, 0], inverse[q, 2, 1]
    sx, sy = (paint[q, 0] - s * wx) * z, (paint[q, 1] - s * wy) * z
    tx, ty = (paint[q, 3] - t * wx) * z, (paint[q, 4] - t * wy) * z
    x0, y0, x1, y1 = slope
    j00, j01 = sx * x0 + sy * y0, sx * x1 + sy * y1
    j10, j11 = tx * x0 + ty * y0, tx * x1 + ty * y1
    # axes of the ellipse that a unit circle of the image becomes: eigenvalues of J J^T
    e, f, g = j00 * j00 + j01 * j01, j00 * j10 + j01 * j11, j10 * j10 + j11 * j11
    root = math.sqrt(0.25 * (e - g) * (e - g) + f * f)
    long2, short2 = 0.5 * (e + g) + root, 0.5 * (e + g) - root
    count, blur2 = 1, long2
    if long2 > 1.0 and long2 > 1.5 * short2:
        count = min(probes, int(math.sqrt(long2 / max(short2, 1.0))) + 1)
        blur2 = max(short2, long2 / (count * count))
    level = 0.5 * math.log2(blur2) if blur2 > 1.0 else 0.0
    texture, overlay = skins[q, 0], skins[q, 1]
    if count == 1:
        value = _trilinear(pixels, sizes, offsets, texture, s, t, level)
    else:
        ax, ay = (f, long2 - e) if e < g else (long2 - g, f)  # the long axis
        norm = math.sqrt(long2 / (ax * ax + ay * ay)) / count
        s0, t0 = s - ax * norm * 0.5 * (count - 1), t - ay * norm * 0.5 * (count - 1)
        value = 0.0
        for k in range(count):
            value += _trilinear(pixels, sizes, offsets, texture, s0 + k * ax * norm, t0 + k * ay * norm, level)
        value /= count
    if overlay >= 0:  # faint and coarse: no blending between levels
        near = min(int(max(level + paint[q, 13] + 0.5, 0.0)), sizes[overlay, 2] - 1)
        s = paint[q, 6] + paint[q, 7] * s
        t = paint[q, 8] + paint[q, 9] * t
        shrink = 1.0 / (1 << near)
        width, height = sizes[overlay, 0] >> near, sizes[overlay, 1] >> near
        value *= _bilinear(pixels, offsets[overlay, near], width, height, s * shrink, t * shrink) / 128.0
    return value * paint[q, 12]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _trace_centres(
    rays: Array, slopes: Array, starts: Ints, entries: Any, quads: _Quads, atlas: _Atlas, grey: Any, found: Any,
    depth: Any,
) -> None:  # fmt: skip
    """One ray through every pixel's centre."""
    inverse, nearest, paint, skins = quads
    pixels, sizes, offsets = atlas
    columns = -(-rays.shape[1] // TILE_PX)
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            tile = (i // TILE_PX) * columns + j // TILE_PX
            x, y = rays[i, j, 0], rays[i, j, 1]
            q, w = _hit(x, y, starts[tile], starts[tile + 1], entries, inverse, nearest)
            found[i, j] = q
            depth[i, j] = np.inf
            if q >= 0:
                depth[i, j] = 1.0 / w
                slope = (slopes[i, j, 0], slopes[i, j, 1], slopes[i, j, 2], slopes[i, j, 3])
                grey[i, j] = _colour(
                    (x, y, w), slope, 1.0, MAX_PROBES, q, inverse, paint, skins, pixels, sizes, offsets
                )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _trace_edges(
    rays: Array, slopes: Array, starts: Ints, entries: Any, quads: _Quads, atlas: _Atlas, samples: Array, found: Any,
    grey: Any,
) -> None:  # fmt: skip
    """Several rays through every pixel whose neighbour shows another rectangle in another grey."""
    inverse, nearest, paint, skins = quads
    pixels, sizes, offsets = atlas
    height, width = found.shape
    columns = -(-width // TILE_PX)
    for i in range(height):
        for j in range(width):
            is_edge = False
            for k in range(4):
                r, c = i + (k == 0) - (k == 1), j + (k == 2) - (k == 3)
                if 0 <= r < height and 0 <= c < width and found[r, c] != found[i, j]:
                    is_edge |= abs(grey[r, c] - grey[i, j]) > EDGE_GREY
            if not is_edge:
                continue
            tile = (i // TILE_PX) * columns + j // TILE_PX
            total = 0.0
            slope = (slopes[i, j, 0], slopes[i, j, 1], slopes[i, j, 2], slopes[i, j, 3])
            for k in range(samples.shape[0]):
                dx, dy = samples[k, 0], samples[k, 1]
                x = rays[i, j, 0] + slope[0] * dx + slope[2] * dy
                y = rays[i, j, 1] + slope[1] * dx + slope[3] * dy
                hit, w = _hit(x, y, starts[tile], starts[tile + 1], entries, inverse, nearest)
                if hit >= 0:
                    total += _colour((x, y, w), slope, 0.5, 2, hit, inverse, paint, skins, pixels, sizes, offsets)
            grey[i, j] = total / samples.shape[0]
