"""Space carving: the octree of what all silhouettes let stand (Martin and Aggarwal, 1983; Szeliski, 1993).

A cell is empty as soon as a view shows all of it outside, full once all views that see it show all of it inside, and
split otherwise. Each child inherits the views that have not decided its parent. The upper levels are done as a whole,
what is left of them subtree by subtree on all threads; memory is that of the result and of one subtree a thread.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.carve.carving_kernels import Cells, split
from sfmapp.carve.hull import Hull, hull_of, outline_error
from sfmapp.carve.octree import Codes, Octree, codes_of
from sfmapp.carve.options import MOST_CELLS, CarveOptions
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.errors import InputError, NoReconstructionError, listed
from sfmapp.events import Events
from sfmapp.reporting import Report

STAGE = "carve"
# level of the subtrees that threads take: up to 512, enough for many threads and few enough to cost nothing
_SUBTREES = 3
# side of the grid of points on which it is found out why nothing is left
_COARSE = 48
Counts = NDArray[np.int64]


class LevelCounts(Report):
    """What became of the cells of a level that were looked at.

    Attributes:
        side: of a cell, units of the world.
        looked_at: children of all that were split a level above.
        full, carved: shown inside by all, outside by more than may miss.
        unseen: taken away as too few photographs see them.
        split: neither; at the finest level these are the surface.
    """

    level: int
    side: float
    looked_at: int
    full: int
    carved: int
    unseen: int
    split: int


class CarvingReport(Report):
    """How a volume was carved.

    Attributes:
        cells: finest cells along the side of the cube.
        levels: from the whole cube to the finest.
        num_questions: how often a view was asked about a cell.
        share_of_dense: cells looked at for one of a dense grid as fine.
        volume_low, volume_high: without and with the cells at the surface, cubic units of the world.
        touches_box: the result reaches the faces of the cube, which cut it off.
        unseen_share: of the cube, what was left empty as too few photographs see it.
        min_views, misses: what was asked for.
    """

    cells: int
    num_views: int
    levels: Sequence[LevelCounts]
    num_questions: int
    share_of_dense: float
    volume_low: float
    volume_high: float
    touches_box: bool
    unseen_share: float
    min_views: int
    misses: int


def carve(
    views: Sequence[View],
    silhouettes: Sequence[Silhouette],
    low: ArrayLike,
    side: float,
    options: CarveOptions | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> tuple[Octree, CarvingReport]:
    """The visual hull of silhouettes in a cube.

    Args:
        views, silhouettes: one of each for a photograph. What is beyond a picture, behind a camera, or not known in a
            silhouette is not carved by it.
        low: (3,) corner of the cube where all coordinates are least, world.
        side: of the cube, units of the world.
        options: by default :class:`CarveOptions`.
        threads: how many; by default one a processor. The result is the same bytes for any.

    Raises:
        InputError: silhouettes do not fit their views, or the cube has no size.
        NoReconstructionError: nothing is left; it says which photographs are to blame.
    """
    options = options or CarveOptions()
    if options.cells is None:
        options = replace(options, cells=told_cells(outline_error(views, silhouettes, np.add(low, 0.5 * side)), side))
    hull = hull_of(views, silhouettes, min_views=options.min_views, misses=options.misses)
    return carve_hull(hull, [view.name for view in views], low, side, options, events or Events(), threads)


def told_cells(error: float, side: float) -> int:
    """How many cells along the side of a cube outlines tell apart, a power of two: each as large as what the hull's
    surface may be off, units of the world, so that what is smooth is no farther outside than one; 256 at most."""
    return int(2 ** np.clip(np.floor(np.log2(side / max(error, 1e-9 * side))), 1, np.log2(MOST_CELLS)))


def carve_hull(
    hull: Hull,
    names: Sequence[str],
    low: ArrayLike,
    side: float,
    options: CarveOptions,
    events: Events,
    threads: int | None = None,
) -> tuple[Octree, CarvingReport]:
    """:func:`carve` of a hull that is there already; ``names`` are those of its photographs, as they were given."""
    corner = np.array(low, np.float64)
    if corner.shape != (3,) or not np.isfinite(corner).all() or not 0.0 < side < np.inf:
        raise InputError(f"expected a cube of a corner and a positive side, found {low!r} and {side}")
    depth = options.depth
    counts = np.zeros((depth + 1, 5), np.int64)
    full: list[list[Codes]] = [[] for _ in range(depth + 1)]
    num = len(hull)
    cells = Cells(
        np.zeros(1, np.uint64),
        np.array([num]),
        np.arange(num, dtype=np.uint16),
        np.zeros(1, np.uint16),
        np.zeros(1, np.uint16),
    )
    counts[0, 0] = 1
    top = min(_SUBTREES, depth)
    for level in range(1, top + 1):
        cells, inside = _split(hull, corner, side / 2.0**level, cells, counts[level])
        full[level].append(inside)
    surface = _carve_subtrees(hull, corner, side, _apart(cells), full, counts, events, threads)
    codes = tuple(np.concatenate([np.empty(0, np.uint64), *parts]) for parts in full)
    tree = Octree(corner, float(side), depth, codes, surface)
    if not any(len(level) for level in codes) and not (hull.distance(tree.centers(surface)) > 0.0).any():
        raise NoReconstructionError(*_blame(hull, names, corner, side))
    return tree, _report(tree, counts, hull)


def _split(hull: Hull, low: NDArray[np.float64], side: float, cells: Cells, counts: Counts) -> tuple[Cells, Codes]:
    return split(hull.fields, low, side, cells, hull.min_views, hull.misses, counts)


def _apart(cells: Cells) -> list[Cells]:
    """Cells one by one."""
    begins = np.concatenate([[0], cells.ends[:-1]])
    return [
        Cells(
            cells.codes[i : i + 1],
            np.array([cells.ends[i] - begins[i]]),
            cells.views[begins[i] : cells.ends[i]],
            cells.seen[i : i + 1],
            cells.missed[i : i + 1],
        )
        for i in range(len(cells.codes))
    ]


def _carve_subtrees(
    hull: Hull,
    low: NDArray[np.float64],
    side: float,
    roots: list[Cells],
    full: list[list[Codes]],
    counts: Counts,
    events: Events,
    threads: int | None,
) -> Codes:
    """Carve below cells of the level of subtrees, and add full cells and counts in order; the codes of the surface."""
    depth = len(full) - 1
    top = min(_SUBTREES, depth)

    def run(cells: Cells) -> tuple[Codes, list[Codes], Counts]:
        inside: list[Codes] = []
        own = np.zeros_like(counts)
        for level in range(top + 1, depth + 1):
            if events.is_cancelled:
                break
            cells, found = _split(hull, low, side / 2.0**level, cells, own[level])
            inside.append(found)
        return cells.codes, inside, own

    surface = [np.empty(0, np.uint64)]
    events.started(STAGE, f"{2**depth} cells along the side", total=len(roots))
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        for codes, inside, own in pool.map(run, roots):
            surface.append(codes)
            for level, found in enumerate(inside, top + 1):
                full[level].append(found)
            counts += own
            events.advanced(STAGE)
    return np.concatenate(surface)


def _report(tree: Octree, counts: Counts, hull: Hull) -> CarvingReport:
    levels = []
    for level, (looked_at, full, carved, unseen, _) in enumerate(counts.tolist()):
        levels.append(
            LevelCounts(
                level=level,
                side=tree.side / 2.0**level,
                looked_at=looked_at,
                full=full,
                carved=carved,
                unseen=unseen,
                split=looked_at - full - carved - unseen,
            )
        )
    low, high = tree.volume_bounds()
    return CarvingReport(
        cells=2**tree.depth,
        num_views=len(hull),
        levels=levels,
        num_questions=int(counts[:, 4].sum()),
        share_of_dense=float(counts[:, 0].sum()) / 8.0**tree.depth,
        volume_low=low,
        volume_high=high,
        touches_box=touches_box(tree, hull),
        unseen_share=float((counts[:, 3] / 8.0 ** np.arange(tree.depth + 1)).sum()),
        min_views=hull.min_views,
        misses=hull.misses,
    )


def touches_box(tree: Octree, hull: Hull) -> bool:
    """Whether what is inside comes as near to a face of the cube as a finest cell."""
    if any(bool(at_faces(codes, level).any()) for level, codes in enumerate(tree.full)):
        return True
    return bool((hull.distance(tree.centers(tree.surface[at_faces(tree.surface, tree.depth)])) > 0.0).any())


def at_faces(codes: Codes, level: int) -> NDArray[np.bool_]:
    """(N,) cells of a level that lie at the faces of the cube: all bits of a coordinate are nought, or all are one."""
    result = np.zeros(len(codes), bool)
    ones = (1 << level) - 1
    for axis in range(3):
        mask = codes_of(np.eye(3, dtype=np.int64)[axis : axis + 1] * ones)[0]
        part = codes & mask
        result |= (part == 0) | (part == mask)
    return result


def _blame(hull: Hull, names: Sequence[str], low: NDArray[np.float64], side: float) -> tuple[str, str]:
    """Why nothing is left, and what to do: which silhouettes take away what all others let stand."""
    grid = np.stack(np.meshgrid(*[np.arange(_COARSE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = hull.distance_by_view(low + side * (grid + 0.5) / _COARSE)
    outside, num_seen = distance <= 0.0, np.isfinite(distance).sum(axis=1)
    if num_seen.max() < hull.min_views:
        return (
            f"no place in the volume is seen by {hull.min_views} photographs",
            "the volume misses the object, or the cameras look elsewhere: give another box",
        )
    is_shown = (distance > 0.0).sum(axis=0) > 0
    empty = [name for name, shows in zip(names, is_shown.tolist(), strict=True) if not shows]
    if empty:
        return (
            f"nothing is left: {listed(empty, 5)} show no object in the volume",
            "look at their masks (empty, or inverted?), or give another box",
        )
    spared = outside.sum(axis=1)
    spared[num_seen < hull.min_views] = len(names)
    least = int(spared.min())
    culprits = outside[spared == least].sum(axis=0)
    worst = [names[i] for i in np.argsort(-culprits, kind="stable")[:least]] if least else list(names)
    return (
        f"nothing is left: each place is outside {max(least, 1)} silhouettes or more, most often those of "
        f"{listed(worst, 5)}",
        "look at their masks and cameras; leave them out, or let some silhouettes miss",
    )
