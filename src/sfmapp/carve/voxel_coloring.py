"""Voxel colouring: the largest volume whose cells look alike in all photographs that show them.

Seitz and Dyer, "Photorealistic scene reconstruction by voxel coloring", IJCV 1999, take layers away from the cameras so
that whatever may hide a cell is judged before it. Here the cell that each pixel shows is known exactly at any time, as
in generalised voxel colouring (Culbertson, Malzbender and Slabaugh, 1999), so cameras may stand anywhere and no layers
are needed. As cells go, those behind them are shown by more pixels and never by fewer, so what does not look alike once
never will: what is left is the photo hull (Kutulakos and Seitz, "A theory of shape by space carving", IJCV 2000), which
holds every volume that shows these photographs. There may be many, and nothing in the photographs tells which it was.

A cell looks alike if the deviation of its colours is at most tau_1 + tau_2 sigma, with sigma the mean deviation within
single photographs, where the cell's pixels mix what lies about an edge (Slabaugh, Culbertson, Malzbender, Stevens and
Schafer, "Methods for volumetric reconstruction of visual scenes", IJCV 2004). Surfaces are taken to look the same from
everywhere (Lambert): highlights carve what is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.cell_grid import CellGrid
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.carve.voxel_kernels import STALE, Shown, first_cells
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.option_checks import Range, check_options, positive
from sfmapp.reporting import Report

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

STAGE = "colouring"
# of cells that no photograph shows
_GREY = 192


@dataclass(frozen=True)
class VoxelOptions:
    """Options of voxel colouring.

    Attributes:
        apart: tau_1, grey levels that colours of one place deviate by: noise, exposure, highlights. All hangs on it,
            and it is another one for each object: with 25 a rendered toy of shiny bricks was taken away.
        mixing: tau_2, for what a cell's colours deviate by within a photograph.
        min_views: fewer photographs take nothing away.
        clear_px: pixels so near to an outline show the object and what is behind it, and say nothing.
    """

    apart: float
    mixing: float = 1.0
    min_views: int = 3
    clear_px: float = 1.0

    def __post_init__(self) -> None:
        ranges = {"apart": positive(), "mixing": Range(0.0), "min_views": Range(1), "clear_px": Range(0.0)}
        check_options(STAGE, self, ranges)


class VoxelReport(Report):
    """What colours took away.

    Attributes:
        rounds: in which cells were taken away.
        num_before, num_after: cells.
    """

    rounds: int
    num_before: int
    num_after: int


@dataclass(frozen=True)
class ColoredCells:
    """Full cells in colours.

    Attributes:
        grid: the cells.
        shown: (N,) numbers of those that photographs show, ascending, in the order of ``grid.filled.ravel()``.
        rgb: (N, 3) uint8 their colours, the mean of the photographs.
    """

    grid: CellGrid
    shown: NDArray[np.int64]
    rgb: Pixels

    def photograph(self, view: View, background: tuple[int, int, int]) -> Pixels:
        """(H, W, 3) what a view shows of the cells at the centre of each pixel; grey where no photograph did."""
        seen = shown_cells(self.grid, view)
        picture = np.full((*seen.shape, 3), background, np.uint8)
        at = np.minimum(np.searchsorted(self.shown, seen), len(self.shown) - 1)
        picture[seen >= 0] = _GREY
        known = (seen >= 0) & (self.shown[at] == seen)
        picture[known] = self.rgb[at[known]]
        return picture


def shown_cells(grid: CellGrid, view: View, before: Shown | None = None) -> Shown:
    """(H, W) numbers of the cells that the centres of a view's pixels show, -1 for none; ``before``: what they showed
    when more cells were full, which is brought up to date in place."""
    shown = np.full((view.height, view.width), STALE, np.int64) if before is None else before
    turn = np.linalg.inv(view.outer[:, :3]).astype(np.float64)
    first_cells(grid.filled, grid.low, grid.tree.cell, (view.row, turn, view.center), shown)
    return shown


def carve_by_color(
    grid: CellGrid, views: Sequence[View], silhouettes: Sequence[Silhouette], photographs: Sequence[Pixels],
    options: VoxelOptions, events: Events | None = None, *, threads: int = 1,
) -> tuple[ColoredCells, VoxelReport]:  # fmt: skip
    """Take away cells that do not look alike in the photographs that show them, until all do.

    Args:
        grid: a volume that holds the object, such as the hull's; it is left as it is.
        views, silhouettes, photographs: V of each, pictures (H, W, 3) RGB.
        options: what looks alike.
        events: progress and cancellation.
        threads: views at a time; the result does not depend on it.

    Raises:
        InputError: a photograph has another size than its camera says.
        NoReconstructionError: nothing is left.
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    for view, photograph in zip(views, photographs, strict=True):
        if photograph.shape != (view.height, view.width, 3):
            raise InputError(
                f"{view.name}: expected a photograph of {view.width}x{view.height} pixels in colours, found an array "
                f"of shape {photograph.shape}"
            )
    left = CellGrid(grid.tree, grid.first, grid.filled.copy())
    flat, rounds = left.filled.reshape(-1), 0
    num_before = int(np.count_nonzero(flat))
    shown = [np.full((view.height, view.width), STALE, np.int64) for view in views]
    events.started(STAGE, f"{num_before} cells")
    with ThreadPoolExecutor(threads) as pool:
        while True:
            events.raise_if_cancelled()
            list(pool.map(lambda view, before: shown_cells(left, view, before), views, shown))
            looks = _Looks(shown, silhouettes, photographs, options, pool)
            gone = looks.unlike(options)
            events.advanced(STAGE, message=f"{len(gone)} cells taken away")
            if not len(gone):
                break
            flat[gone] = 0
            rounds += 1
            if not flat.any():
                raise NoReconstructionError(
                    "no cell looks alike in the photographs that show it: colours take all of the volume away",
                    "are cameras those of the photographs, and these exposed alike? If so allow more: apart",
                )
    report = VoxelReport(rounds=rounds, num_before=num_before, num_after=int(np.count_nonzero(flat)))
    events.finished(STAGE, f"{report.num_after} of {num_before} cells left", **report)
    return ColoredCells(left, looks.cells, np.rint(looks.mean).astype(np.uint8)), report


class _Looks:
    """How cells look in photographs.

    Attributes:
        cells: (N,) their numbers. num: (N,) photographs that show each. mean: (N, 3) colours, of the photographs' own
            means; total: (N,) variance of colours about it, grey levels squared; within: (N,) mean deviation in single
            photographs. beyond: numbers of cells that are shown where there is background.
    """

    def __init__(
        self, shown: Sequence[Shown], silhouettes: Sequence[Silhouette], photographs: Sequence[Pixels],
        options: VoxelOptions, pool: ThreadPoolExecutor,
    ) -> None:  # fmt: skip
        pairs, beyond = [], []
        for seen, silhouette, photograph in zip(shown, silhouettes, photographs, strict=True):
            told = seen >= 0 if silhouette.known is None else (seen >= 0) & silhouette.known
            clear = told & (silhouette.distance > options.clear_px)
            pairs.append((seen[clear], photograph[clear].astype(np.float64)))
            beyond.append(seen[told & (silhouette.distance < -options.clear_px)])
        self.beyond = np.unique(np.concatenate(beyond))
        self.cells = np.unique(np.concatenate([np.unique(cells) for cells, _ in pairs]))
        size = len(self.cells)
        self.num, first, second, inner = np.zeros(size), np.zeros((size, 3)), np.zeros(size), np.zeros(size)
        for count, sums, squares in pool.map(lambda pair: self._in_photograph(*pair), pairs):
            is_seen = count > 0.0
            per = np.where(is_seen, count, 1.0)
            mean = sums / per[:, None]
            self.num += is_seen
            first += mean
            second += squares / per
            inner += np.sqrt(np.maximum(squares / per - (mean**2).sum(axis=1), 0.0) / 3.0)
        num = np.maximum(self.num, 1.0)
        self.mean = first / num[:, None]
        self.total = np.maximum(second / num - (self.mean**2).sum(axis=1), 0.0) / 3.0
        self.within = inner / num

    def _in_photograph(self, cells: Shown, rgb: Array) -> tuple[Array, Array, Array]:
        """Of each cell in one photograph: pixels, sums of colours (N, 3), sums of their squares."""
        at, size = np.searchsorted(self.cells, cells), len(self.cells)
        sums = np.empty((size, 3))
        for channel in range(3):
            sums[:, channel] = np.bincount(at, rgb[:, channel], size)
        squares = np.bincount(at, (rgb**2).sum(axis=1), size).astype(np.float64)
        return np.bincount(at, minlength=size).astype(np.float64), sums, squares

    def unlike(self, options: VoxelOptions) -> NDArray[np.int64]:
        """Numbers of cells that cannot be there."""
        limit = options.apart + options.mixing * self.within
        is_unlike = (np.sqrt(self.total) > limit) & (self.num >= options.min_views)
        return np.union1d(self.cells[is_unlike], self.beyond)
