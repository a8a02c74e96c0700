"""The reduced system, once the points are gone: dense tiles here, sparse in gtsam."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.kernels import BlockArrays, ImageArrays, LensArrays, PointArrays, Sums, find_slot
from sfmapp.simd.f64x8 import assign8, subtract8

Array = NDArray[np.float64]


def aligned_zeros(*shape: int) -> Array:
    """Zeros whose rows of eight start on cache lines: half the loads of tiles would straddle two otherwise."""
    size = int(np.prod(shape))
    raw = np.zeros(size + 8)
    start = (-raw.ctypes.data % 64) // 8
    return raw[start : start + size].reshape(shape)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assemble(
    sums: Sums, images: ImageArrays, lenses: LensArrays, blocks: BlockArrays, extra_own: Array, extra_gradient: Array,
    diagonal: Array,
) -> None:  # fmt: skip
    """Add up the sums of all chunks (K, ...), in order, in the first.

    Adds extra_own (B * 64,) and extra_gradient (B * 8,), what priors say about single blocks; fills diagonal (B * 8,)
    with the diagonal before elimination, on which the damping is based, and puts ``own`` and ``cross`` into the tiles.
    """
    tiles, own, cross, gradient = sums
    block_dim, hash_keys, hash_values = blocks
    image_block, image_camera = images.block, images.camera
    camera_block, second_block = lenses.block, lenses.second
    num_blocks = block_dim.shape[0]
    for k in range(1, tiles.shape[0]):
        tiles[0] += tiles[k]
        own[0] += own[k]
        cross[0] += cross[k]
        gradient[0] += gradient[k]
    own[0] += extra_own
    gradient[0, : num_blocks * 8] += extra_gradient
    for a in range(num_blocks):
        tile = a * num_blocks + a
        if hash_keys.shape[0] > 0:
            tile = find_slot(hash_keys, hash_values, tile)
        for n in range(64):
            tiles[0, tile * 64 + n] += own[0, a * 64 + n]
        for x in range(8):
            d = own[0, a * 64 + 9 * x]
            diagonal[a * 8 + x] = d if d > 0.0 and x < block_dim[a] else 1.0
            if x >= block_dim[a]:
                tiles[0, tile * 64 + 9 * x] = 1.0
    num_images = image_block.shape[0]
    for i in range(num_images):
        a, b, second = image_block[i], camera_block[image_camera[i]], second_block[image_camera[i]]
        if a >= 0 and b >= 0 and a != b:
            _add_tile(sums, i, a * num_blocks + b, blocks)
            if second >= 0:
                _add_tile(sums, num_images + i, a * num_blocks + second, blocks)
    for c in range(camera_block.shape[0]):
        if second_block[c] >= 0:
            _add_tile(sums, 2 * num_images + c, camera_block[c] * num_blocks + second_block[c], blocks)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_tile(sums: Sums, source: int, tile: int, blocks: BlockArrays) -> None:
    """Add a tile of ``cross`` to that of a pair of blocks, a B + b, if there is one."""
    if blocks.hash_keys.shape[0] > 0:
        tile = find_slot(blocks.hash_keys, blocks.hash_values, tile)
    if tile >= 0:
        for n in range(64):
            sums.tiles[0, tile * 64 + n] += sums.cross[0, source * 64 + n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def factorize_tiles(tiles: Array, num_blocks: int, inverse: Array) -> bool:
    """Cholesky factor U^T U of the upper tiles (B * B * 64,), in place; inverse (B * 64,) gets the U_kk^-1.

    Returns False, with the tiles spoilt, where a pivot is not clearly positive. Tiles of zeros are skipped, so that a
    sequence costs what its band costs.
    """
    used = np.zeros(num_blocks * num_blocks, np.bool_)
    for a in range(num_blocks):
        for b in range(a, num_blocks):
            tile = (a * num_blocks + b) * 64
            for n in range(64):
                if tiles[tile + n] != 0.0:
                    used[a * num_blocks + b] = True
                    break
    first_diagonal = np.empty(num_blocks * 8)
    for a in range(num_blocks):
        for x in range(8):
            first_diagonal[a * 8 + x] = tiles[(a * num_blocks + a) * 64 + 9 * x]
    row = np.empty(num_blocks, np.int64)
    for k in range(num_blocks):
        d = (k * num_blocks + k) * 64
        for x in range(8):
            for m in range(x):
                for y in range(x, 8):
                    tiles[d + 8 * x + y] -= tiles[d + 8 * m + x] * tiles[d + 8 * m + y]
            pivot = tiles[d + 9 * x]
            # what rounding leaves of a zero pivot
            if not pivot > 1e-14 * first_diagonal[k * 8 + x]:
                return False
            root = 1.0 / np.sqrt(pivot)
            for y in range(x, 8):
                tiles[d + 8 * x + y] *= root
        # U^-1, upper: column by column by back substitution
        q = k * 64
        for y in range(8):
            for x in range(7, -1, -1):
                if x > y:
                    inverse[q + 8 * x + y] = 0.0
                    continue
                total = 1.0 if x == y else 0.0
                for m in range(x + 1, y + 1):
                    total -= tiles[d + 8 * x + m] * inverse[q + 8 * m + y]
                inverse[q + 8 * x + y] = total / tiles[d + 9 * x]
        count = 0
        for j in range(k + 1, num_blocks):
            if used[k * num_blocks + j]:
                t = (k * num_blocks + j) * 64
                assign8(tiles, t, inverse, q, tiles, t, 8)
                row[count] = j
                count += 1
        for n in range(count):
            i = row[n]
            for m in range(n, count):
                j = row[m]
                used[i * num_blocks + j] = True
                subtract8(
                    tiles, (i * num_blocks + j) * 64, tiles, (k * num_blocks + i) * 64, tiles,
                    (k * num_blocks + j) * 64, 8,
                )  # fmt: skip
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_tiles(tiles: Array, num_blocks: int, inverse: Array, x: Array) -> None:
    """Solve U^T U x = x in place (B * 8,) with the factor of :func:`factorize_tiles`."""
    y = np.empty(8)
    for k in range(num_blocks):
        for a in range(8):
            total = 0.0
            for b in range(a + 1):
                total += inverse[k * 64 + 8 * b + a] * x[8 * k + b]
            y[a] = total
        for a in range(8):
            x[8 * k + a] = y[a]
        for j in range(k + 1, num_blocks):
            t = (k * num_blocks + j) * 64
            for a in range(8):
                for b in range(8):
                    x[8 * j + b] -= tiles[t + 8 * a + b] * y[a]
    for k in range(num_blocks - 1, -1, -1):
        for j in range(k + 1, num_blocks):
            t = (k * num_blocks + j) * 64
            for a in range(8):
                total = 0.0
                for b in range(8):
                    total += tiles[t + 8 * a + b] * x[8 * j + b]
                x[8 * k + a] -= total
        for a in range(8):
            total = 0.0
            for b in range(a, 8):
                total += inverse[k * 64 + 8 * a + b] * x[8 * k + b]
            y[a] = total
        for a in range(8):
            x[8 * k + a] = y[a]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_pairs(points: PointArrays, images: ImageArrays, lenses: LensArrays, pairs: NDArray[np.bool_]) -> None:
    """Set pairs[a, b], (B, B) bool, for all blocks a <= b that meet in a point."""
    point_ptr, obs_image = points.ptr, points.image
    image_camera, image_block, camera_block, second_block = images.camera, images.block, lenses.block, lenses.second
    longest = 1
    for p in range(point_ptr.shape[0] - 1):
        longest = max(longest, point_ptr[p + 1] - point_ptr[p])
    blocks = np.zeros(3 * longest, np.int64)
    for p in range(point_ptr.shape[0] - 1):
        found = 0
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            block, other, second = image_block[i], camera_block[image_camera[i]], second_block[image_camera[i]]
            if block >= 0:
                blocks[found] = block
                found += 1
            # neighbours in a track often share the camera
            if other >= 0 and other != block and (found == 0 or blocks[found - 1] not in (other, second)):
                blocks[found] = other
                found += 1
                if second >= 0:
                    blocks[found] = second
                    found += 1
        for n in range(found):
            for m in range(n, found):
                pairs[min(blocks[n], blocks[m]), max(blocks[n], blocks[m])] = True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def number_keys(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """An open hash table, half full at most, that gives each of the different keys (N,) its position."""
    size = 16
    while size < 2 * keys.shape[0] + 1:
        size *= 2
    table, values = np.full(size, -1, np.int64), np.zeros(size, np.int64)
    for n in range(keys.shape[0]):
        h = ((keys[n] * 0x9E3779B97F4A7C) >> 20) & (size - 1)
        while table[h] >= 0:
            h = (h + 1) & (size - 1)
        table[h] = keys[n]
        values[h] = n
    return table, values
