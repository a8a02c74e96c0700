"""The reduced system, once the points are gone: its tiles, and their Cholesky factor."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.elimination import TileRows, find_tile
from sfmapp.adjust.kernels import ImageArrays, LensArrays, Sums
from sfmapp.packages import BLAS_THREADS
from sfmapp.simd.f64x8 import assign8, subtract8

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SolverName = Literal["tiles", "gtsam", "lapack", "envelope", "fronts", "iterative"]

# Measured by benchmarks/reduced_systems.py; fill is the share of pairs of blocks that meet. Up to 400 unknowns, some
# 65 poses, LAPACK is as quick as gtsam at any fill, for so few poses fill much of their system when they are eliminated
# whatever it held before. Beyond that gtsam is as quick up to about a quarter, and falls behind by up to six times.
_SMALL, _SPARSE_FILL = 400, 0.25
# Up to so many blocks nothing beats the tiles of the quick rounds by much; beyond that the envelope is quickest at any
# fill, by up to five times.
_FEW_BLOCKS = 160
# Seconds of a multiplication and addition of the envelope, of a product of two blocks that meet in a point, and of a
# block of a point in a round of conjugate gradients; and rounds of a step. Inexact steps are more: rounds must be
# quicker by so many times.
_FLOP_S, _PRODUCT_S, _ENTRY_S, _ROUNDS, _CLEARLY = 1 / 45e9, 12e-9, 12e-9, 40, 2.0
# An envelope that costs so much is held against fronts, whose order takes a tenth of a second for 1,000 blocks; their
# products are smaller, and less of them is: they must save this factor.
_DEAR_FLOPS, _FRONTS_SAVE = 1e10, 1.5
# Poses that gtsam eliminates together.
_GROUP = 6
# What rounding leaves of a zero pivot, against the diagonal before.
_NO_PIVOT = 1e-14


def may_suit_gtsam(num_blocks: int, num_unknowns: int) -> bool:
    """Whether gtsam solves a closing system of that size best, if it is sparse."""
    return num_unknowns > _SMALL and num_blocks <= _FEW_BLOCKS


def is_sparse(fill: float) -> bool:
    """Whether a factor has few enough entries for sparse algebra to be quicker."""
    return fill <= _SPARSE_FILL


def choose_solver(num_blocks: int, num_unknowns: int, fill: float, *, is_closing: bool) -> SolverName:
    """What solves a reduced system best."""
    if num_blocks > _FEW_BLOCKS:
        return "envelope"
    if is_closing:
        return "gtsam" if may_suit_gtsam(num_blocks, num_unknowns) and is_sparse(fill) else "lapack"
    return "tiles"


def may_suit_fronts(fill: float, flops: float) -> bool:
    """Whether fronts may be quicker than an envelope whose factor costs so much."""
    return is_sparse(fill) and flops > _DEAR_FLOPS


def prefers_fronts(flops_of_fronts: float, flops_of_envelope: float) -> bool:
    """Whether fronts are quicker."""
    return _FRONTS_SAVE * flops_of_fronts < flops_of_envelope


def prefers_rounds(num_entries: int, num_products: int, flops: float) -> bool:
    """Whether conjugate gradients are clearly quicker than making the reduced system and factoring it; arguments as of
    :func:`rounds_worth`."""
    return rounds_worth(num_entries, num_products, flops) > _CLEARLY * _ROUNDS


def rounds_worth(num_entries: int, num_products: int, flops: float) -> float:
    """How many rounds of conjugate gradients take as long as making the reduced system and factoring it.

    Args:
        num_entries: blocks that meet a point, over all points. num_products: pairs of them. flops: of the factor.
    """
    return (_PRODUCT_S * num_products + _FLOP_S * flops) / (_ENTRY_S * max(1, num_entries))


def group_blocks(near: NDArray[np.bool_], num_poses: int) -> list[Ints]:
    """Blocks, ascending, in groups of poses that meet much the same blocks, others alone; near (B, B): which meet."""
    out, is_free = [], np.ones(len(near), bool)
    is_free[num_poses:] = False
    for seed in range(num_poses):
        if not is_free[seed]:
            continue
        is_free[seed] = False
        others = np.flatnonzero(near[seed] & is_free)
        shared = (near[others] & near[seed]).sum(1) / np.maximum(1, (near[others] | near[seed]).sum(1))
        best = others[np.argsort(-shared, kind="stable")[: _GROUP - 1]]
        is_free[best] = False
        out.append(np.sort(np.append(best, seed)))
    return [*out, *(np.array([b]) for b in range(num_poses, len(near)))]


def aligned_zeros(*shape: int) -> Array:
    """Zeros whose rows of eight start on cache lines: half the loads of tiles would straddle two otherwise."""
    return _aligned(np.zeros(int(np.prod(shape)) + 8)).reshape(shape)


def aligned_empty(size: int) -> Array:
    """The same of any content."""
    return _aligned(np.empty(size + 8))


def _aligned(raw: Array) -> Array:
    start = (-raw.ctypes.data % 64) // 8
    return raw[start : start + len(raw) - 8]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assemble(
    tiles: Array, sums: Sums, images: ImageArrays, lenses: LensArrays, block_dim: Ints, tile_rows: TileRows,
    extra: tuple[Array, Array], diagonal: Array,
) -> None:  # fmt: skip
    """Add up the sums of all chunks (K, ...), in order, in the first, and put ``own`` and ``cross`` into the tiles.

    Adds extra, (B * 64,) and (B * 8,), what priors say about single blocks and their gradient; fills diagonal (B * 8,)
    with the diagonal before elimination, on which the damping is based.
    """
    own, cross, gradient = sums
    image_block, image_camera = images.block, images.camera
    camera_block, second_block = lenses.block, lenses.second
    num_blocks = block_dim.shape[0]
    for k in range(1, own.shape[0]):
        _add_into(own[0], own[k])
        _add_into(cross[0], cross[k])
        _add_into(gradient[0], gradient[k])
    _add_into(own[0], extra[0])
    _add_into(gradient[0], extra[1])
    for a in range(num_blocks):
        tile = find_tile(tile_rows, a, a)
        for n in range(64):
            tiles[tile * 64 + n] += own[0, a * 64 + n]
        for x in range(8):
            d = own[0, a * 64 + 9 * x]
            diagonal[a * 8 + x] = d if d > 0.0 and x < block_dim[a] else 1.0
            if x >= block_dim[a]:
                tiles[tile * 64 + 9 * x] = 1.0
    num_images = image_block.shape[0]
    for i in range(num_images):
        a, b, second = image_block[i], camera_block[image_camera[i]], second_block[image_camera[i]]
        if a >= 0 and b >= 0 and a != b:
            _add_tile(tiles, cross, i, find_tile(tile_rows, a, b))
            if second >= 0:
                _add_tile(tiles, cross, num_images + i, find_tile(tile_rows, a, second))
    for c in range(camera_block.shape[0]):
        if second_block[c] >= 0:
            _add_tile(tiles, cross, 2 * num_images + c, find_tile(tile_rows, camera_block[c], second_block[c]))


# not by ``+=``, which brings code that broadcasts, and that writes the message of its failure
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_into(out: Array, values: Array) -> None:
    for n in range(values.shape[0]):
        out[n] += values[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_tile(tiles: Array, cross: Array, source: int, tile: int) -> None:
    """Add a tile of ``cross`` to that of a pair of blocks, if there is one."""
    if tile >= 0:
        for n in range(64):
            tiles[tile * 64 + n] += cross[0, source * 64 + n]


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
            if not pivot > _NO_PIVOT * first_diagonal[k * 8 + x]:
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


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold the linear algebra of numpy and scipy to one thread: our workers use the cores, and the order of sums, to
    the last bit of results, must not depend on how many they are.

    What is loaded later is not held, so scipy's own BLAS is loaded before, which takes 0.1 s and 25 MB, unless the
    environment holds it, as that of commands does.
    """
    from threadpoolctl import threadpool_limits

    if any(os.environ.get(name) != "1" for name in BLAS_THREADS):
        import scipy.linalg  # noqa: F401
    with threadpool_limits(1, "blas"):
        yield


class ReducedSystem(Protocol):
    """What solves the reduced system."""

    def solve(self, tiles: Array, rhs: Array, run: Callable[..., Any] = map) -> Array | None:
        """Solution (B * 8,) of the damped system in tiles (N * 64,), None where it is not positive definite.

        ``run`` maps tasks on threads; the result does not depend on how many they are.
        """


class TileSystem:
    """The Cholesky factor in tiles (B * B * 64,)."""

    def __init__(self, num_blocks: int) -> None:
        self._num_blocks, self._inverse = num_blocks, aligned_zeros(num_blocks * 64)

    def solve(self, tiles: Array, rhs: Array, run: Callable[..., Any] = map) -> Array | None:
        """Solution (B * 8,), None where the system is not positive definite. Tiles and right-hand side are spoilt."""
        if not factorize_tiles(tiles, self._num_blocks, self._inverse):
            return None
        solve_tiles(tiles, self._num_blocks, self._inverse, rhs)
        return rhs


class LapackSystem:
    """LAPACK's dense Cholesky factor, without the rows that the blocks do not use. Its bytes are those of one thread:
    the caller sees to it that there is no more.

    Args of solve as of :class:`TileSystem`; keys (N,) a B + b and numbers (N,) say which tiles there are.
    """

    def __init__(self, block_dim: Ints, keys: Ints, numbers: Ints) -> None:
        self._pairs = np.stack([*np.divmod(keys, len(block_dim)), numbers], 1)
        self._first = np.cumsum(block_dim) - block_dim
        self._dim, self._used = block_dim, np.arange(8) < block_dim[:, None]
        size = int(block_dim.sum())
        self._matrix = np.zeros((size, size))

    def solve(self, tiles: Array, rhs: Array, run: Callable[..., Any] = map) -> Array | None:
        _gather_lower(tiles, self._pairs, self._first, self._dim, self._matrix)
        try:
            factor: Array = np.linalg.cholesky(self._matrix).astype(np.float64, copy=False)
        except np.linalg.LinAlgError:
            return None
        if not (factor.diagonal() ** 2 > _NO_PIVOT * self._matrix.diagonal()).all():
            return None
        found = rhs.reshape(-1, 8)[self._used]
        _substitute(factor, found)
        step = np.zeros((len(self._dim), 8))
        step[self._used] = found
        return step.ravel()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather_lower(tiles: Array, pairs: Ints, first: Ints, block_dim: Ints, matrix: Array) -> None:
    """Fill the lower triangle of matrix (N, N) from tiles; pairs (M, 3) are block a <= b and number of the tile."""
    matrix[:] = 0.0
    for n in range(pairs.shape[0]):
        a, b, tile = pairs[n]
        for j in range(block_dim[a]):
            for k in range(block_dim[b]):
                matrix[first[b] + k, first[a] + j] = tiles[tile * 64 + 8 * j + k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _substitute(factor: Array, x: Array) -> None:
    """Solve L L^T x = b in place: factor (N, N) is L, x (N,) comes as b."""
    for i in range(x.shape[0]):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(x.shape[0] - 1, -1, -1):
        x[i] /= factor[i, i]
        for k in range(i):
            x[k] -= factor[i, k] * x[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather_scaled(tiles: Array, pairs: Ints, places: Ints, root: Array, block_dim: Ints, out: Array) -> None:
    """Gather tiles, scaled by root (B, 8) on both sides, in the matrices of groups of blocks that lie in out.

    pairs (M, 3) are blocks a, b and number of the tile; places (M, 3) where its first number goes, the width of that
    matrix, and whether the tile is turned there.
    """
    out[:] = 0.0
    for n in range(pairs.shape[0]):
        a, b, tile = pairs[n]
        start, width, is_turned = places[n]
        for j in range(block_dim[a]):
            for k in range(block_dim[b]):
                value = tiles[tile * 64 + 8 * j + k] * root[a, j] * root[b, k]
                out[start + (k * width + j if is_turned else j * width + k)] = value
