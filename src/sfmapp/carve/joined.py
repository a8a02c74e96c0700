"""One closed surface out of silhouettes and patches: each tells what the other cannot.

Silhouettes bound the object from outside, to a fraction of a pixel, with or without texture, and know nothing of what
lies within their cones. Patches lie in concavities, and leave open what has no texture or was not seen. Here a patch
also says that its line of sight is free, and that behind it is something.

The solid is where u > 0, of the u between -1 and 1 in the hull that minimises

    area of the surface + trust / band * volume integral of the sum over sights of |u - what the sight says|,

which is convex (Zach, Pock and Bischof, "A globally optimal algorithm for robust TV-L1 range image integration", ICCV
2007, with votes in bins as Zach, "Fast and high quality fusion of depth maps", 3DPVT 2008, has them). Without votes the
surface that is least wins, as under a statue; but what is left has to fill every silhouette (Kolev and Cremers,
"Integration of multiview stereo and silhouettes via convex functionals on convex domains", ECCV 2008): where it does
not, the hull is put back along the rays, unless patches are seen through it. In the end outlines close by are told by
silhouettes alone.

The lattice is that of an octree's corners, from coarse to fine, and at each level only nodes near a surface are there.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.carve.hull import Hull
from sfmapp.carve.joined_kernels import BINS, EMPTY, FULL, find_flow, find_value, mark_behind, paint, vote
from sfmapp.carve.octree import Codes, Octree, codes_of, merged, places_of
from sfmapp.carve.parts import in_parts
from sfmapp.carve.sight import Sight
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.option_checks import Range, check_options, positive
from sfmapp.reporting import Report

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ids = NDArray[np.int32]

STAGE = "join"
# level that is there as a whole
_WHOLE = 5
# Patches are known to a pixel or two; a band narrower than two cells would fall between the nodes.
_BAND_PX, _BAND_CELLS = 2.0, 2.0
# steps of Chambolle and Pock (2011): their product times the squared norm of the slope, 12 at most, stays below 1
_STEP = 0.28
# iterations by level: a coarse level has the large areas to move, a fine one only what a cell of the coarser one is
_ITERATIONS, _FEWEST_ITERATIONS = 320, 40
# How often what is left is held to the silhouettes at each level: what is put back may lay bare what lies behind. Each
# level starts anew: coarse ones lose thin parts, and put back more for them than silhouettes need.
_ROUNDS = 3
# a pixel is uncovered so far inside its outline, in pixels beside the width of a cell
_MARGIN_PX = 1.0
# what is put back along uncovered rays counts as so many sights
_FILL_VOTES = 4.0
# a photograph sees a surface that is turned this much towards it
_LEAST_COSINE = 0.1
_RANGES = {"trust": positive(100.0), "keep": Range(0.0, 100.0), "back": Range(1.0, 100.0)}


@dataclass(frozen=True)
class JoinOptions:
    """Options of joining silhouettes with patches.

    Attributes:
        trust: how much surface a sight of the band's width is worth; less is smoother and closes more.
        keep: the hull counts as so many sights where a photograph sees it. With 0 the least surface closes what nothing
            tells; the more it is, the more of the hull stays there.
        back: behind what a sight sees it is full for so many bands. With 1 nothing is said beyond the band in which the
            surface lies: how thick a part is, no sight tells, and the back of a thin one that nobody sees would come
            out too far away.
    """

    trust: float = 1.5
    keep: float = 0.0
    back: float = 1.0

    def __post_init__(self) -> None:
        check_options(STAGE, self, _RANGES)


class JoinReport(Report):
    """How silhouettes and patches were joined.

    Attributes:
        cells: finest ones along the side of the cube. num_nodes: of its lattice that were there at each level, from
            the coarsest.
        num_sights: photographs that see patches.
        band: within which distances to patches are averaged, units of the world.
        hull_volume, volume: of the hull and of what is left of it, cubic units of the world.
        filled_share: of the nodes in the hull near the surface, those that were put back for silhouettes at the finest
            level.
    """

    cells: int
    num_nodes: Sequence[int]
    num_sights: int
    band: float
    hull_volume: float
    volume: float
    filled_share: float


def _find(codes: Codes, places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Positions (M,) of places (M, 3) among ascending codes, -1 where they are not."""
    wanted = codes_of(places)
    at = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
    return np.where((codes[at] == wanted) & (places >= 0).all(axis=1), at, -1)


@dataclass
class _Level:
    """Nodes (N) of the lattice of a level: places, their sorted codes, and what is known of them."""

    places: NDArray[np.int64]
    codes: Codes
    xyz: Array
    hull: Array
    votes: NDArray[np.uint8]
    extra: Floats
    value: Floats
    after: Ids
    prior: Ids
    flagged: NDArray[np.bool_]

    def find(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Positions (M,) of nodes at places (M, 3), -1 where none is."""
        return _find(self.codes, places)

    def nodes(self, band: float, *, is_finest: bool) -> Nodes:
        """Distances, cut off at a band."""
        distance = np.where(self.hull > 0.0, np.minimum(self.value * band, self.hull), self.hull)
        if not is_finest:
            distance = np.where(distance > 0.0, band, -band)
        return Nodes(self.codes, np.clip(distance, -band, band).astype(np.float32))


class _Cube(NamedTuple):
    low: Array
    side: float


class Nodes(NamedTuple):
    """Nodes of a lattice: ascending codes (N,) uint64 of their places, and signed distances (N,) float32 there, units
    of the world, positive inside; of a lattice that is not the finest, the sign alone."""

    codes: Codes
    distance: Floats


@dataclass(frozen=True)
class Joined:
    """What came of it.

    Attributes:
        tree: the solid.
        nodes: of the lattice of corners at each level, coarse to fine, the last of them of the octree's finest cells.
        band: what is no nearer to the surface has this distance to it, units of the world.
    """

    tree: Octree
    nodes: tuple[Nodes, ...]
    band: float

    def distance(self, xyz: ArrayLike) -> Array:
        """Signed distances (N,) at corners (N, 3) of the finest cells, positive inside, units of the world; not beyond
        the band."""
        places = np.rint((np.asarray(xyz) - self.tree.low) / self.tree.cell).astype(np.int64)
        out = np.full(len(places), -self.band)
        left = np.arange(len(places))
        for up, nodes in enumerate(reversed(self.nodes)):
            at = _find(nodes.codes, (places[left] + (1 << up >> 1)) >> up)
            known = at >= 0
            out[left[known]] = nodes.distance[at[known]]
            left = left[~known]
        return out


@dataclass(frozen=True)
class Evidence:
    """What photographs say of an object.

    Attributes:
        views, silhouettes: one of each for a photograph.
        hull: of these, :func:`sfmapp.carve.hull.hull_of`.
        sights: what photographs see of patches, see :mod:`sfmapp.carve.sight`.
    """

    views: Sequence[View]
    silhouettes: Sequence[Silhouette]
    hull: Hull
    sights: Sequence[Sight]


def join(
    evidence: Evidence, low: ArrayLike, side: float, cells: int = 256, options: JoinOptions | None = None, *,
    events: Events | None = None, threads: int | None = None,
) -> tuple[Joined, JoinReport]:  # fmt: skip
    """The solid in a cube that silhouettes and patches leave.

    Args:
        evidence: silhouettes and sights.
        low: (3,) corner of the cube where all coordinates are least, world.
        side: of the cube, units of the world.
        cells: finest ones along its side, rounded up to a power of two, 32 or more.
        options: by default :class:`JoinOptions`.
        events: progress and cancellation.
        threads: how many; by default one a processor. The result is the same bytes for any.

    Raises:
        InputError: there are no sights.
        NoReconstructionError: nothing is left.
        InterruptedRunError: ``events`` was asked to stop.
    """
    options, events, sights = options or JoinOptions(), events or Events(), evidence.sights
    if not sights:
        raise InputError("expected photographs that see patches, found none")
    depth = max(_WHOLE, int(cells - 1).bit_length())
    cube = _Cube(np.array(low, np.float64), float(side))
    band = max(
        _BAND_PX * float(np.median([sight.pixel for sight in sights])), _BAND_CELLS * side / 2.0**depth
    )  # fmt: skip
    levels: list[_Level] = []
    events.started(STAGE, f"{len(sights)} photographs that see patches", total=depth - _WHOLE + 1)
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        for number in range(_WHOLE, depth + 1):
            level = _begin(number, levels[-1] if levels else None, cube, evidence.hull, pool)
            cell = side / 2.0**number
            width = max(band, _BAND_CELLS * cell)
            level.votes = _votes(level.xyz, sights, width, options.back, pool)
            _hold_outside(level, width)
            if options.keep > 0.0:
                _keep(level, evidence, options.keep, cell, pool)
            weight, iterations = options.trust * cell / band, _iterations(number)
            _solve(level, weight, iterations, events, pool)
            for _ in range(_ROUNDS):
                if not _fill(level, evidence, cell, pool):
                    break
                _solve(level, weight, iterations, events, pool)
            if number == depth:
                _hold_to_outlines(level, band, cell)
            level.flagged = _near_surface(level, cell)
            levels.append(level)
            events.advanced(STAGE, message=f"{2**number} cells a side, {len(level.codes)} nodes")
    tree = _tree(levels, cube, depth)
    last = levels[-1]
    if not len(tree.surface):
        raise NoReconstructionError(
            "nothing is left of the hull: patches are seen through all of it",
            "look at the patches: are they of these photographs and this model?",
        )
    report = JoinReport(
        cells=2**depth, num_nodes=[len(level.codes) for level in levels], num_sights=len(sights), band=band,
        hull_volume=_hull_volume(levels, side), volume=float(np.mean(tree.volume_bounds())),
        filled_share=float((last.extra >= _FILL_VOTES).sum() / max(1, (last.hull > 0.0).sum())),
    )  # fmt: skip
    events.finished(STAGE, f"{100 * report.volume / report.hull_volume:.0f} % of the hull is left", **report)
    nodes = [level.nodes(band, is_finest=level is last) for level in levels]
    return Joined(tree, tuple(nodes), band), report


def _iterations(number: int) -> int:
    return max(_FEWEST_ITERATIONS, _ITERATIONS >> max(0, number - _WHOLE - 1))


def _begin(number: int, above: _Level | None, cube: _Cube, hull: Hull, pool: ThreadPoolExecutor) -> _Level:
    """Nodes of a level, without votes: all of them, or those around the nodes near a surface of the level above."""
    size = 2**number
    if above is None:
        side = np.arange(size + 1)
        places = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
        codes = np.sort(codes_of(places))
    else:
        flagged = above.places[above.flagged]
        parts = []
        for x in (-1, 0, 1):
            for y in (-1, 0, 1):
                for z in (-1, 0, 1):
                    moved = 2 * flagged + (x, y, z)
                    parts.append(codes_of(moved[((moved >= 0) & (moved <= size)).all(axis=1)]))
        codes = np.unique(np.concatenate(parts))
    places = places_of(codes)
    num = len(codes)
    xyz = cube.low + (cube.side / size) * places
    distance = np.empty(num)

    def measure(first: int, last: int) -> None:
        distance[first:last] = hull.distance(xyz[first:last], 1)

    in_parts(measure, num, pool)
    level = _Level(
        places, codes, xyz, distance, np.empty((0, BINS), np.uint8), np.zeros(num, np.float32),
        np.ones(num, np.float32), np.empty((num, 3), np.int32), np.empty((num, 3), np.int32), np.zeros(num, np.bool_),
    )  # fmt: skip
    if above is not None:
        at = above.find(places >> 1)
        other = above.find((places + 1) >> 1)
        at, other = np.where(at >= 0, at, other), np.where(other >= 0, other, at)
        level.value = 0.5 * (above.value[at] + above.value[other])
    beyond = np.where(level.value > 0.0, FULL, EMPTY)
    for axis in range(3):
        step = np.eye(3, dtype=np.int64)[axis]
        for sign, column in ((1, level.after), (-1, level.prior)):
            found = level.find(places + sign * step)
            is_outside = (places[:, axis] + sign < 0) | (places[:, axis] + sign > size)
            column[:, axis] = np.where(found >= 0, found, np.where(is_outside, EMPTY, beyond))
    return level


def cast_votes(xyz: Array, sights: Sequence[Sight], band: float, back: float, votes: NDArray[np.uint8]) -> None:
    """Add what each sight says of points (N, 3) to their votes (N, BINS), see :func:`~.joined_kernels.vote`."""
    for sight in sights:
        vote(xyz, rigid3.to_matrix(sight.cam_from_world), sight.k, sight.depth, sight.normal, band, back, votes)


def _votes(
    xyz: Array, sights: Sequence[Sight], band: float, back: float, pool: ThreadPoolExecutor
) -> NDArray[np.uint8]:  # fmt: skip
    votes = np.zeros((len(xyz), BINS), np.uint8)
    in_parts(lambda first, last: cast_votes(xyz[first:last], sights, band, back, votes[first:last]), len(xyz), pool)
    return votes


def _hold_outside(level: _Level, band: float) -> None:
    """Empty what is outside of the hull.

    Beside patches the values go over smoothly, so that the surface stays where both tell it to a fraction of a cell.
    Elsewhere they jump: the hull's surface has to cost as much as any other, or what is hidden would stay full.
    """
    is_outside, is_told = level.hull <= 0.0, (level.votes[:, 1 : BINS - 1] > 0).any(axis=1)
    level.value[is_outside] = np.where(is_told, np.maximum(level.hull / band, -1.0), -1.0)[is_outside]


def _keep(level: _Level, evidence: Evidence, keep: float, cell: float, pool: ThreadPoolExecutor) -> None:
    """Votes for what is full in the hull, where its surface is turned towards a photograph.

    Under an object that stands on a table the hull goes on as far as rays that pass by its rim, which nothing shows.
    """
    centers = np.array([view.center for view in evidence.views])
    idx = np.flatnonzero(level.hull > 0.0)

    def run(first: int, last: int) -> None:
        part = idx[first:last]
        xyz = level.xyz[part]
        normal = evidence.hull.normals(xyz, cell, 1)
        is_seen = np.zeros(len(part), np.bool_)
        for center in centers:
            way = center - xyz
            is_seen |= (normal * way).sum(axis=1) > _LEAST_COSINE * np.linalg.norm(way, axis=1)
        seen = part[is_seen]
        level.extra[seen] = np.maximum(level.extra[seen], np.float32(keep))

    in_parts(run, len(idx), pool)


def _solve(level: _Level, weight: float, iterations: int, events: Events, pool: ThreadPoolExecutor) -> None:
    """Move the values of a level towards the least of the energy (Chambolle and Pock, 2011, algorithm 1)."""
    num = len(level.codes)
    is_fixed = level.hull <= 0.0
    value, before, flow = level.value, level.value.copy(), np.zeros((num, 3), np.float32)
    for _ in range(iterations):
        events.raise_if_cancelled()
        in_parts(lambda a, b: find_flow(a, b, value, before, level.after, _STEP, flow), num, pool)
        in_parts(
            lambda a, b: find_value(
                a, b, flow, level.prior, level.votes, level.extra, is_fixed, weight, _STEP, value, before
            ),
            num, pool,
        )  # fmt: skip


def _fill(level: _Level, evidence: Evidence, cell: float, pool: ThreadPoolExecutor) -> bool:
    """Put the hull back along rays inside silhouettes that meet nothing; whether there was any to put back."""
    solid = level.xyz[level.value > 0.0]
    is_open = (level.hull > 0.0) & (level.votes[:, 0] <= level.votes[:, 1:].sum(axis=1))
    idx = np.flatnonzero(is_open)
    xyz = level.xyz[idx]

    def look(v: int) -> NDArray[np.bool_]:
        view, silhouette = evidence.views[v], evidence.silhouettes[v]
        covered = np.zeros(silhouette.distance.shape, np.bool_)
        paint(view.row, solid, 0.87 * cell, covered)
        missing = ~covered & (silhouette.distance > _MARGIN_PX)
        if silhouette.known is not None:
            missing &= silhouette.known
        marked = np.zeros(len(idx), np.bool_)
        if missing.any():
            mark_behind(view.row, xyz, missing, marked)
        return marked

    marked = np.zeros(len(idx), np.bool_)
    for part in pool.map(look, range(len(evidence.views))):
        marked |= part
    is_new = marked & (level.extra[idx] < _FILL_VOTES)
    level.extra[idx[is_new]] = _FILL_VOTES
    return bool(is_new.any())


def _hold_to_outlines(level: _Level, band: float, cell: float) -> None:
    """Bring the solid out to outlines that are within a cell of it.

    Where a photograph has its outline within a cell, that tells the surface to a fraction of a pixel. What sights tell
    is spread over the band, and rims and thin parts, which they see from the side, come out too small by it.
    """
    is_inside = level.hull > 0.0
    room = np.maximum(cell - level.hull[is_inside], 0.0) / band
    level.value[is_inside] = np.minimum(level.value[is_inside] + room, 1.0)


def _near_surface(level: _Level, cell: float) -> NDArray[np.bool_]:
    """Nodes around which a finer level has to look: near a patch, the hull's surface, or a change of sign."""
    near = (level.votes[:, 2 : BINS - 2] > 0).any(axis=1) & (level.hull > -cell)
    near |= np.abs(level.hull) < 1.75 * cell
    inside = level.value > 0.0
    near |= (np.abs(level.value) < 0.9) & (level.hull > 0.0)
    for column in (level.after, level.prior):
        for axis in range(3):
            at = column[:, axis]
            other = np.where(at >= 0, inside[at], at == FULL)
            near |= other != inside
    return near


def _tree(levels: Sequence[_Level], cube: _Cube, depth: int) -> Octree:
    """The octree of the solid, from the cells of the coarsest level down."""
    first = depth - len(levels) + 1
    full: list[list[Codes]] = [[] for _ in range(depth + 1)]
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    cells = places_of(np.arange(8**first, dtype=np.uint64))
    surface = np.empty(0, np.uint64)
    for number, level in zip(range(first, depth + 1), levels, strict=True):
        at = level.find((cells[:, None] + corners).reshape(-1, 3)).reshape(-1, 8)
        inside = (level.value[at] > 0.0) & (level.hull[at] > 0.0)
        if number == depth:
            full[number].append(codes_of(cells[inside.all(axis=1)]))
            surface = np.sort(codes_of(cells[inside.any(axis=1) & ~inside.all(axis=1)]))
            break
        is_split = level.flagged[at]
        whole = ~is_split.any(axis=1)
        full[number].append(codes_of(cells[whole & inside[:, 0]]))
        # of a cell that is split, the child at a corner is there below if that corner is near a surface
        children = (2 * cells[:, None] + corners)[~whole]
        below, is_full = is_split[~whole], inside[~whole]
        full[number + 1].append(codes_of(children[~below & is_full]))
        cells = children[below]
    return Octree(
        cube.low, cube.side, depth, merged([np.concatenate([np.empty(0, np.uint64), *part]) for part in full]), surface
    )


def _hull_volume(levels: Sequence[_Level], side: float) -> float:
    """Of the hull, by nodes: each stands for the cell about it at the finest level that has it."""
    total, first = 0.0, round(np.log2(levels[0].places.max()))
    for k, level in enumerate(levels):
        counted = level.hull > 0.0
        if k + 1 < len(levels):
            counted &= ~level.flagged
        total += float(counted.sum()) * (side / 2.0 ** (first + k)) ** 3
    return total
