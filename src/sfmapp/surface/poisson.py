"""From oriented points to a closed surface: screened Poisson on a hierarchy of sparse grids.

The indicator of the solid has the points' normals for a gradient (Kazhdan, Bolitho and Hoppe, SGP 2006), and the
surface is to pass through the points (Kazhdan and Hoppe, TOG 2013). Levels are solved from coarse to fine, each within
its own grid, with the coarser one for its border. In place of a term in the system for the points, after each level
what the indicator is at them is taken away from it, averaged as a quadratic B-spline has it over those around. So there
is no matrix, and the operator is that of six neighbours, for which the normals are splatted such that the indicator of
a plane, smoothed, solves it exactly, however the plane lies to the grid.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.evaluation.measured import high_water_mark_mb
from sfmapp.events import Events
from sfmapp.reporting import Usage
from sfmapp.surface import poisson_kernels as kernels
from sfmapp.surface.bricks import (
    COARSEST_DEPTH,
    Codes,
    Level,
    Members,
    Points,
    bricks_around,
    in_parts,
    make_levels,
    members,
    order_samples,
    positions_of,
)
from sfmapp.surface.dual_surface import dual_surface
from sfmapp.surface.trim import pieces, rim

FEWEST_POINTS = 50
SHALLOWEST, DEEPEST = 6, 12
# the grid's box is so much larger than the points'
BOX_SCALE = 1.1
ADVICE = "try a smaller surface.depth or fewer patches (a coarser dense.level)"
# a level answers where there are so many points in the square of its cell's side: as many as Kazhdan and Hoppe have for
# each node
SAMPLES_PER_CELL = 1.5
# it does so for so many of its cells around each point: nodes for a surface that passes through the cell beside it
REACH = 1.5
# The surface passes beside the points of a place as if one more had told that it is right without them. Of 0.05, 0.3,
# 0.5, 1 and 3 this had the best F on a rendered hall.
DOUBT = 1.0
# Sweeps and over-relaxation. Beside the surface a grid is some ten nodes thick, for which 2 / (1 + sin(pi / 10)) is
# optimal and leaves half of an error after a sweep; the coarsest has 32 cells a side and begins with nothing.
SWEEPS, OMEGA = 8, 1.5
COARSEST_SWEEPS, COARSEST_OMEGA = 200, 1.9


@dataclass(frozen=True)
class ClosedSurface:
    """What Poisson makes, hallucinated parts and all, without any rim.

    Attributes:
        xyz: (N, 3) float64, world.
        faces: (F, 3) int32.
        usage: what it took.
    """

    xyz: NDArray[np.float64]
    faces: NDArray[np.int32]
    usage: Usage


@dataclass(frozen=True)
class _Samples:
    """Points along Morton's curve.

    Attributes:
        points: (N, 3) float32, in finest cells from the box's lowest corner on.
        cells: (N,) codes of their finest cells, ascending.
        flux: (N, 3) float32 normals, outward, as long as the area that each stands for, in squares of finest cells.
        level_of: (N,) int8 the finest level that is dense enough about each.
    """

    points: NDArray[np.float32]
    cells: NDArray[np.int64]
    flux: NDArray[np.float32]
    level_of: NDArray[np.int8]

    @classmethod
    def of_size(cls, num: int) -> _Samples:
        """Room for so many."""
        return cls(
            np.empty((num, 3), np.float32), np.empty(num, np.int64), np.empty((num, 3), np.float32),
            np.empty(num, np.int8),
        )  # fmt: skip

    @property
    def arrays(self) -> tuple[Points, Codes, Points, NDArray[np.int8]]:
        """The same, in this order."""
        return self.points, self.cells, self.flux, self.level_of


def depth_for(xyz: NDArray[np.float64], spacing: float) -> int:
    """The depth at which the finest cells, 2^depth a side of the box, measure two spacings or less, 6 to 12.

    Finer cells would only model noise: a surface is sampled by points of some spacing up to a wavelength of two.
    """
    side = BOX_SCALE * float(np.ptp(xyz, axis=0).max())
    return int(np.clip(np.ceil(np.log2(max(side / (2.0 * spacing), 1.0))), SHALLOWEST, DEEPEST))


def poisson(
    xyz: NDArray[np.float64],
    normal: NDArray[np.float32],
    depth: int,
    events: Events | None = None,
    *,
    threads: int = 1,
    stage: str | None = None,
) -> ClosedSurface:
    """Reconstruct the surface, the same in whichever order the points come, and with any number of threads.

    Args:
        xyz: (N, 3) points, world.
        normal: (N, 3) outward unit normals.
        depth: the finest cells are 2^depth a side of the box.
        events: progress and cancellation.
        threads: that share the bricks.
        stage: which is told of each level; None: nobody is told.

    Raises:
        NoReconstructionError: fewer than 50 points, or no surface.
        InterruptedRunError: ``events`` was asked to stop.
    """
    wall, cpu, events = time.monotonic(), time.process_time(), events or Events()
    if len(xyz) < FEWEST_POINTS:
        raise NoReconstructionError(
            f"Poisson reconstruction: expected at least {FEWEST_POINTS} oriented points, found {len(xyz)}"
        )
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    center, scale = (low + high) / 2.0, float((high - low).max())
    if not (np.isfinite(scale) and scale > 0.0):
        raise NoReconstructionError("Poisson reconstruction: expected finite points that are not all the same")
    cell, middle = BOX_SCALE * scale / 2**depth, 2.0 ** (depth - 1)
    samples = _samples(((xyz - center) / cell + middle).astype(np.float32), normal, depth, threads)
    levels = make_levels(samples.points, samples.level_of, samples.cells, depth, REACH, events)
    values = _solve(samples, levels, events, threads, stage)
    del samples
    vertices, faces = dual_surface(levels, values, events, threads)
    del levels, values
    if len(faces) == 0:
        raise NoReconstructionError("Poisson reconstruction: found no surface", ADVICE)
    vertices, faces = _with_lids(vertices, faces, depth)
    vertices -= middle
    vertices *= cell
    vertices += center
    usage = Usage(
        wall_s=round(time.monotonic() - wall, 3),
        cpu_s=round(time.process_time() - cpu, 3),
        peak_memory_mb=round(high_water_mark_mb(), 1),
    )
    return ClosedSurface(vertices, faces, usage)


def _samples(points: NDArray[np.float32], normal: NDArray[np.float32], depth: int, threads: int) -> _Samples:
    """Order points (N, 3), find how dense they are, and so what level and area is that of each."""
    order, cells = order_samples(points, depth)
    points, flux = points[order], normal[order].astype(np.float32)
    coarsest = max(depth - COARSEST_DEPTH, 0)
    level_of, density = np.full(len(points), coarsest, np.int8), np.zeros(len(points), np.float32)
    is_open = np.ones(len(points), np.bool_)
    # density is asked for in cells of the next coarser level: what is in a fourth of their squares is little but chance
    for level in range(coarsest + 1):
        wide = members(cells, level + 1)
        counts = np.zeros((len(wide.codes), 64), np.float32)
        kernels.count_samples(points, wide.first, wide.level, counts)
        around = bricks_around(wide.codes)
        find = partial(
            kernels.find_densities, points, is_open, wide.codes, wide.first, wide.level, around, counts, density
        )
        in_parts(find, len(wide.codes), threads)
        found = is_open & ((density >= 4.0 * SAMPLES_PER_CELL) | (level == coarsest))
        level_of[found] = level
        flux[found] *= (4.0 ** (level + 1) / density[found])[:, None]
        is_open &= ~found
        if not is_open.any():
            break
    return _Samples(points, cells, flux, level_of)


def _merged(samples: _Samples, level: int) -> _Samples:
    """Samples for a level from the second coarser on: one for those in a sixteenth of a square of its cell's side."""
    shift = 3 * (level - 2)
    found = _Samples.of_size(kernels.merge_samples(*samples.arrays, level, shift, *_Samples.of_size(0).arrays))
    kernels.merge_samples(*samples.arrays, level, shift, *found.arrays)
    return found


def _solve(
    samples: _Samples, levels: list[Level], events: Events, threads: int, stage: str | None
) -> list[NDArray[np.float32]]:  # fmt: skip
    """Values (B, 64) of the nodes of each level: the indicator, negative within, nought at the surface."""
    coarsest = len(levels) - 1
    values: list[NDArray[np.float32]] = []
    of_level = [samples, samples]
    while len(of_level) <= coarsest:
        of_level.append(_merged(of_level[-1], len(of_level)))
    for n in range(coarsest, -1, -1):
        samples, level = of_level.pop() if n > 0 else of_level[0], levels[n]
        here, num = members(samples.cells, n), len(level.codes)
        if stage is not None:
            events.advanced(stage, 0, f"Poisson, grid {coarsest - n + 1} of {coarsest + 1}: {num} bricks")
        at = positions_of(level.codes, here.codes)
        mine, divergence = np.zeros((num, 64), np.float32), np.zeros((num, 64), np.float32)
        if n < coarsest:
            kernels.prolong(level.codes, level.parent, levels[n + 1].around, values[0], mine)
        add = partial(
            kernels.add_divergence, samples.points, samples.flux, samples.level_of, here.codes, here.first, n, at,
            level.around, divergence,
        )  # fmt: skip
        in_parts(add, num, threads)
        is_whole = np.bool_(n == coarsest)
        sweeps, omega = (COARSEST_SWEEPS, COARSEST_OMEGA) if is_whole else (SWEEPS, OMEGA)
        for sweep in range(2 * sweeps):
            events.raise_if_cancelled()
            relax = partial(
                kernels.relax, level.codes, level.is_leaf, is_whole, level.around, level.num, sweep & 1, omega,
                divergence, mine,
            )  # fmt: skip
            in_parts(relax, num, threads)
        del divergence, add, relax
        _pass_through_points(samples, here, at, level, mine, threads, is_whole=bool(is_whole))
        values.insert(0, mine)
    return values


def _pass_through_points(
    samples: _Samples, here: Members, at: NDArray[np.int64], level: Level, values: NDArray[np.float32], threads: int, *,
    is_whole: bool,
) -> None:  # fmt: skip
    """Take from the values of a level what they are at the points."""
    found = np.zeros(len(samples.points), np.float32)
    chosen = samples.level_of <= here.level + 1
    told = (chosen, here.codes, here.first, here.level, at, level.around)
    in_parts(partial(kernels.evaluate, samples.points, *told, values, found), len(here.codes), threads)
    if is_whole:
        # which of the solutions it is that differ by a constant is not told by any normal
        area = np.linalg.norm(samples.flux, axis=1)
        mean = np.float32(np.average(found, weights=area))
        values -= mean
        found -= mean

    def take_away(low: int, high: int) -> None:
        total, count = np.zeros((high - low, 64), np.float32), np.zeros((high - low, 64), np.float32)
        kernels.add_samples(samples.points, found, *told, total, count, low, high)
        kernels.take_away(
            level.codes, level.is_leaf, np.bool_(is_whole), level.around, total, count, DOUBT, values, low, high
        )  # fmt: skip

    in_parts(take_away, len(level.codes), threads)


def _with_lids(
    xyz: NDArray[np.float64], faces: NDArray[np.int32], depth: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:  # fmt: skip
    """The surface, in finest cells, closed where it leaves the box: loops of its rim get a fan about their centre."""
    # it leaves the box through cells at its sides, and none is larger than the coarsest
    side, coarsest = float(1 << depth), float(1 << max(depth - COARSEST_DEPTH, 0))
    is_near = np.any((xyz <= coarsest) | (xyz >= side - coarsest), axis=1)
    edges = rim(faces[is_near[faces].any(axis=1)])
    edges = edges[is_near[edges].all(axis=1)]
    if not len(edges):
        return xyz, faces
    loop = pieces(edges, len(xyz))
    counts = np.bincount(loop)
    centers = np.stack([np.bincount(loop, xyz[edges[:, 0], axis]) / counts for axis in range(3)], axis=1)
    fans = np.column_stack([edges[:, ::-1], len(xyz) + loop])
    return np.concatenate([xyz, centers]), np.concatenate([faces, fans]).astype(np.int32)
