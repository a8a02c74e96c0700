"""A volume as a dense window of finest cells, for what has to look along rays through all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from sfmapp.carve.octree import Octree, codes_of, merged, places_of

Array = NDArray[np.float64]
Cells = NDArray[np.uint8]


@dataclass(frozen=True)
class CellGrid:
    """The part of an octree's finest level that is not empty.

    Attributes:
        tree: the octree that it was made of.
        first: (3,) int64 place, among all finest cells, of the window's cell 0, 0, 0.
        filled: (X, Y, Z) uint8, 1 where the cell belongs to the volume, wholly or in part.
    """

    tree: Octree
    first: NDArray[np.int64]
    filled: Cells

    @property
    def volume(self) -> float:
        """Of all filled cells, cubic units of the world."""
        return float(np.count_nonzero(self.filled)) * self.tree.cell**3

    @property
    def low(self) -> Array:
        """(3,) world corner of the window."""
        return np.asarray(self.tree.low + self.first * self.tree.cell)

    @property
    def middle(self) -> Array:
        """(3,) world middle of the window."""
        return np.asarray(self.low + 0.5 * self.tree.cell * np.array(self.filled.shape))

    def holds(self, xyz: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) are in filled cells."""
        at = np.floor((xyz - self.low) / self.tree.cell).astype(np.int64)
        is_there = np.asarray(((at >= 0) & (at < self.filled.shape)).all(axis=1))
        filled = np.zeros(len(xyz), np.bool_)
        filled[is_there] = self.filled[tuple(at[is_there].T)] == 1
        return filled


def grid_of(tree: Octree) -> CellGrid:
    """The window that holds all of an octree; one empty cell if there is nothing in it."""
    parts = [places_of(codes) << (tree.depth - level) for level, codes in enumerate(tree.full)]
    lows = [*parts, places_of(tree.surface)]
    highs = [at + (1 << (tree.depth - level)) for level, at in enumerate(parts)] + [lows[-1] + 1]
    if not any(len(at) for at in lows):
        return CellGrid(tree, np.zeros(3, np.int64), np.zeros((1, 1, 1), np.uint8))
    first = np.concatenate(lows).min(axis=0)
    filled = np.zeros(np.concatenate(highs).max(axis=0) - first, np.uint8)
    for level, at in enumerate(parts):
        side = 1 << (tree.depth - level)
        for x, y, z in at - first:
            filled[x : x + side, y : y + side, z : z + side] = 1
    filled[tuple((lows[-1] - first).T)] = 1
    return CellGrid(tree, first, filled)


def coarsened(grid: CellGrid, level: int) -> CellGrid:
    """A volume in the cells of a level, no finer than its own, that have something of it."""
    by = 1 << (grid.tree.depth - level)
    first = grid.first // by
    before = grid.first - first * by
    after = -(before + grid.filled.shape) % by
    padded = np.pad(grid.filled, list(zip(before, after, strict=True)))
    x, y, z = (n // by for n in padded.shape)
    filled = padded.reshape(x, by, y, by, z, by).max(axis=(1, 3, 5))
    return CellGrid(replace(grid.tree, depth=level), first, filled)


def intersect(grid: CellGrid, coarse: CellGrid) -> None:
    """Take away from a volume what is empty in one that :func:`coarsened` made of it."""
    by = 1 << (grid.tree.depth - coarse.tree.depth)
    at = [
        (first + np.arange(n)) // by - low
        for first, n, low in zip(grid.first, grid.filled.shape, coarse.first, strict=True)
    ]
    grid.filled[coarse.filled[np.ix_(*at)] == 0] = 0


def depth_under(before: CellGrid, after: CellGrid) -> Callable[[Array], Array]:
    """How far points (N, 3) inside a volume are from what was taken away of it, world units, (N,), negative there.

    The steps of cells are smoothed by one cell.
    """
    left = np.zeros(before.filled.shape, np.uint8)
    at = after.first - before.first
    left[tuple(slice(a, a + n) for a, n in zip(at, after.filled.shape, strict=True))] = after.filled
    taken = (before.filled == 1) & (left == 0)
    cells = distance_transform_edt(~taken) - distance_transform_edt(taken)
    smooth = gaussian_filter((cells - 0.5 * np.sign(cells)).astype(np.float32), 1.0)

    def depth(xyz: Array) -> Array:
        place = (xyz - before.low) / before.tree.cell - 0.5
        return np.asarray(before.tree.cell * map_coordinates(smooth, place.T, order=1, mode="nearest"), np.float64)

    return depth


def octree_of(grid: CellGrid) -> Octree:
    """The octree of what is left in a window: cells beside one that was taken away are at the surface now."""
    tree = grid.tree
    padded = np.pad(grid.filled, 1)
    inner = padded[1:-1, 1:-1, 1:-1].astype(bool)
    for axis in range(3):
        inner &= np.roll(padded, 1, axis)[1:-1, 1:-1, 1:-1] & np.roll(padded, -1, axis)[1:-1, 1:-1, 1:-1] == 1
    kept = np.sort(codes_of(np.argwhere(grid.filled) + grid.first))
    whole = np.sort(codes_of(np.argwhere(inner) + grid.first))
    whole = np.setdiff1d(whole, tree.surface, assume_unique=True)
    return Octree(
        tree.low,
        tree.side,
        tree.depth,
        merged([*[np.empty(0, np.uint64)] * tree.depth, whole]),
        np.setdiff1d(kept, whole, True),
    )
