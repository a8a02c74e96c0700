"""A volume as an octree: cells that are wholly inside, and finest cells that its surface passes through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.morton import gather_bits, spread_bits

Array = NDArray[np.float64]
Codes = NDArray[np.uint64]


@dataclass(frozen=True)
class Octree:
    """A solid in a cube. What is in neither list is empty.

    A cell of level l is one of 2**l along each side; its code interleaves the bits of its place, x in bit 0, y in bit
    1, z in bit 2 (Morton, 1966), so that the code of its parent is its own shifted right by three.

    Attributes:
        low: (3,) corner of the cube where all coordinates are least, world.
        side: of the cube, units of the world.
        depth: level of the finest cells.
        full: for each level 0 to ``depth`` the codes (N,) uint64, ascending, of cells wholly inside whose parents are
            not.
        surface: (N,) uint64 ascending codes of finest cells that are neither wholly inside nor wholly outside.
    """

    low: Array
    side: float
    depth: int
    full: tuple[Codes, ...]
    surface: Codes

    @property
    def cell(self) -> float:
        """Side of a finest cell, units of the world."""
        return self.side / 2.0**self.depth

    def volume_bounds(self) -> tuple[float, float]:
        """Volume without and with the cells at the surface, cubic units of the world."""
        inner = sum(len(codes) * (self.side / 2.0**level) ** 3 for level, codes in enumerate(self.full))
        return float(inner), float(inner + len(self.surface) * self.cell**3)

    def finest_full(self) -> Codes:
        """Codes of finest cells that are in full ones: many, where the octree is deep."""
        parts = []
        for level, codes in enumerate(self.full):
            num = 8 ** (self.depth - level)
            parts.append((codes[:, None] * np.uint64(num) + np.arange(num, dtype=np.uint64)).ravel())
        return np.concatenate(parts).astype(np.uint64)

    def centers(self, codes: Codes, level: int | None = None) -> Array:
        """(N, 3) world places of the middles of cells of a level, by default the finest."""
        level = self.depth if level is None else level
        return np.asarray(self.low + (places_of(codes) + 0.5) * (self.side / 2.0**level))


@numba.njit(cache=True, nogil=True)
def _codes(places: NDArray[np.int64], out: Codes) -> None:
    for i in range(places.shape[0]):
        x, y, z = np.uint64(places[i, 0]), np.uint64(places[i, 1]), np.uint64(places[i, 2])
        out[i] = spread_bits(x) | (spread_bits(y) << np.uint64(1)) | (spread_bits(z) << np.uint64(2))


@numba.njit(cache=True, nogil=True)
def _places(codes: Codes, out: NDArray[np.int64]) -> None:
    for i in range(codes.shape[0]):
        for axis in range(3):
            out[i, axis] = np.int64(gather_bits(codes[i] >> np.uint64(axis)))


@numba.njit(cache=True, nogil=True)
def codes_in_box(xyz: Array, bits: int, out: Codes) -> None:
    """Codes (N,) of points (N, 3) in cells of the cube around them, 2**bits along its side; points that are no numbers
    are in the first."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(xyz.shape[0]):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], xyz[i, axis]), max(high[axis], xyz[i, axis])
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    scale = ((1 << bits) - 1) / side if 0.0 < side < np.inf else 0.0
    for i in range(xyz.shape[0]):
        code = np.uint64(0)
        for axis in range(3):
            at = (xyz[i, axis] - low[axis]) * scale
            if at > 0.0:
                code |= spread_bits(np.uint64(at)) << np.uint64(axis)
        out[i] = code


def codes_of(places: NDArray[np.integer]) -> Codes:
    """Codes (N,) of cells at places (N, 3), counted from 0 along each axis."""
    out = np.empty(len(places), np.uint64)
    _codes(np.ascontiguousarray(places, np.int64), out)
    return out


def places_of(codes: Codes) -> NDArray[np.int64]:
    """Places (N, 3) of cells with codes (N,)."""
    out = np.empty((len(codes), 3), np.int64)
    _places(np.ascontiguousarray(codes, np.uint64), out)
    return out


def merged(levels: Sequence[Codes]) -> tuple[Codes, ...]:
    """Codes (N,) of cells of each level from the root on, each in one level alone, as :attr:`Octree.full` has them:
    ascending, and the parent in place of eight that make it up."""
    full = [np.sort(codes) for codes in levels]
    for level in range(len(full) - 1, 0, -1):
        parents, counts = np.unique(full[level] >> np.uint64(3), return_counts=True)
        whole = parents[counts == 8]
        full[level] = full[level][~np.isin(full[level] >> np.uint64(3), whole)]
        full[level - 1] = np.sort(np.concatenate([full[level - 1], whole]))
    return tuple(full)
