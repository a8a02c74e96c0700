"""Holes in silhouettes, by what all others show: a strict hull loses a tunnel to each.

What one silhouette alone takes away of the hull of all others is thin, slivers along its outline, as every outline is
tangent to the object. Behind a hole in a mask it is as thick as the object, and no other silhouette shows it empty.
Two things tell that it is a hole:

- Others lack it. The hull of silhouettes that are right covers each of them, gaps included; where it leaves a part of
  several silhouettes uncovered, and what one other takes away alone would cover it, that one is wrong (the coherence of
  silhouettes of Hernandez, Schmitt and Cipolla, "Silhouette Coherence for Camera Calibration under Circular Motion",
  2007). It tells holes through thin parts, which they cut.
- It is far thicker than what others take away alone, most of which are taken to be right, and all of a gap that is
  closed around: of one that is there others mostly see a part, and an outline that others do not contradict is right
  more often than not. It tells holes in the middle of what is thick, where nothing lacks them but a little of the
  surface at both ends. A gap that is there and that one photograph alone looks through is the same thing to
  silhouettes: it is filled, and the photograph named.

A hole that is told may be all that speaks against another silhouette, whose gap is there: the worst are told first, and
the others asked again without them.

Where there is a hole the silhouette is said not to know. What its outline cuts off is cut off as before; what spills
over an outline is carved by the others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from sfmapp.camera import lens
from sfmapp.carve.hull import hull_of
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.outlines import Silhouette
from sfmapp.carve.space_carving import carve_hull
from sfmapp.carve.views import View, project_points
from sfmapp.events import Events
from sfmapp.reporting import Report

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STAGE = "tolerance"
# Of the usual thickness (median over photographs) of what silhouettes take away alone: beyond the first it is a hole,
# beyond the second it belongs to one. On circles of 8 to 24 views none of six clean solids reached the first.
_HOLE, _RIM = 3.0, 1.5
# of the side of the cube, below which thickness alone tells no hole
_LEAST = 3.0 / 64.0
# cells, two along each side, below which nothing is told: where few photographs look a single one may seem thick
_FEWEST = 8
# Silhouettes that have to lack what another takes away; one may spill over there itself, and counts only where a whole
# gap is taken away that is thicker than the second of the above. And the least thickness, of the side of the cube, for
# what others lack: of 50 clean silhouettes of a model with many thin parts none took away more alone.
_LACKED_BY, _LEAST_LACKED = 2, 1.0 / 64.0
# A hole that thickness alone tells is a gap of which it takes so much; of two gaps that were there, and were taken for
# holes, it took 0.66 and 0.76, of holes 0.99 at least (benchmarks/carving_tolerance.py, a jug).
_WHOLE = 0.9
# silhouettes that are lacked by this share of the number of the worst are told with it, and rounds of that at most
_AS_BAD, _ROUNDS = 0.75, 8
# pixels inside an outline where it has to be lacking: outlines and cameras are told to one
_MARGIN_PX = 1.5
# cells around the middle of one that is kept, which it covers, half of its diagonal; and how far outside an outline
# the middle of a cell may be that a thin part passes through
_COVERS, _PASSES = 0.87, 0.5
# places, at least, by which it is told how large cells are in a picture
_SAMPLES = 4096
# pixels by which what is not known is widened: outlines around holes are not to be trusted either
_WIDER_PX = 3
# along the side of the cube: a hole of a twentieth of an object is a tenth of it wide
_CELLS = 128


class DoubtedSilhouette(Report):
    """A silhouette with holes.

    Attributes:
        thickness: of what it alone takes away, units of the world.
        lacked_by: silhouettes that show something where it alone leaves nothing, of the hole that most speak against;
            with none of them a gap that is there would look the same.
        share: of its picture that is not known now.
    """

    name: str
    thickness: float
    lacked_by: int
    share: float


class ToleranceReport(Report):
    """What was found to be missing in silhouettes.

    Attributes:
        usual_thickness: median over photographs of what each takes away alone, units of the world.
        doubted: those with holes.
    """

    usual_thickness: float
    doubted: Sequence[DoubtedSilhouette]


def doubt_holes(
    views: Sequence[View],
    silhouettes: Sequence[Silhouette],
    low: ArrayLike,
    side: float,
    events: Events | None = None,
) -> tuple[list[Silhouette], ToleranceReport]:
    """Silhouettes whose holes are not known, to be carved with strictly.

    Args:
        views, silhouettes, low, side: as for :func:`sfmapp.carve.space_carving.carve`.

    Raises:
        InputError, NoReconstructionError: as there.
    """
    events = events or Events()
    result, told = list(silhouettes), dict[int, DoubtedSilhouette]()
    for _ in range(_ROUNDS):
        events.raise_if_cancelled()
        usual, found = _doubted(views, result, low, side)
        worst = max((one.lacked_by for one, _ in found.values()), default=0)
        for i, (one, hole) in found.items():
            if one.lacked_by < _AS_BAD * worst:
                continue
            known = result[i].known
            result[i] = dataclasses.replace(result[i], known=~hole if known is None else known & ~hole)
            told[i] = one if i not in told else dataclasses.replace(told[i], share=told[i].share + one.share)
        if not worst:
            break
    doubted = [told[i] for i in sorted(told)]
    if doubted:
        events.warned(STAGE, f"nothing is carved through holes of masks: {'; '.join(map(_in_words, doubted))}")
    return result, ToleranceReport(usual_thickness=usual, doubted=doubted)


def _doubted(
    views: Sequence[View], silhouettes: Sequence[Silhouette], low: ArrayLike, side: float
) -> tuple[float, dict[int, tuple[DoubtedSilhouette, Mask]]]:
    """The usual thickness, and silhouettes with holes: what is said of them, and where (H, W) these are."""
    hull = hull_of(views, silhouettes, misses=1)
    names = [view.name for view in views]
    tree, _ = carve_hull(hull, names, low, side, CarveOptions(cells=_CELLS, misses=1), Events())
    points = tree.centers(np.concatenate([tree.finest_full(), tree.surface]))
    told = hull.nearest(points)
    least, depth = told.distance.T
    # places that no more than one leaves out, and that one
    whose = np.where(least > -_PASSES * tree.cell, len(views), hull.order[told.view[:, 0]])
    held = depth > -_PASSES * tree.cell
    # taken away by one alone, by more than its outline may be wrong
    alone = (depth > 0.0) & (least <= -tree.cell) & (told.num_views >= hull.min_views)
    lacked = _lacked(views, silhouettes, _Held(points[held], whose[held], alone[held]), tree.cell)
    points, whose, depth = points[alone], whose[alone], np.minimum(depth[alone], side)
    thickness = np.zeros(len(views))
    np.maximum.at(thickness, whose, depth)
    usual = float(np.median(thickness))
    limit = _HOLE * max(usual, _LEAST * side / _HOLE)
    found = {}
    for i in np.unique(whose[(depth > limit) | lacked.any(axis=1)]).tolist():
        mine = whose == i
        taken = _Taken(points[mine], depth[mine], lacked[mine])
        hole, lacked_by = _holes(views[i], silhouettes[i], taken, limit, _LEAST_LACKED * side, tree.cell)
        if hole.any():
            one = DoubtedSilhouette(
                name=views[i].name, thickness=float(thickness[i]), lacked_by=lacked_by, share=float(hole.mean())
            )
            found[i] = one, hole
    return usual, found


def _in_words(one: DoubtedSilhouette) -> str:
    if one.lacked_by:
        return f"{one.name}, where {one.lacked_by} others lack what it leaves out"
    return f"{one.name}, which alone looks through there; a narrow gap would look the same"


@dataclasses.dataclass(frozen=True)
class _Taken:
    """Middles of cells (N, 3) that one silhouette alone takes away, how deep they lie in the hull of the others (N,),
    and which of these (N, V) lack them."""

    points: Array
    depth: Array
    lacked: Mask


@dataclasses.dataclass(frozen=True)
class _Held:
    """Middles of cells (N, 3) that no more than one silhouette leaves out, which one (N,), beyond the last for none,
    and (N,) which it takes away alone."""

    points: Array
    whose: NDArray[np.int64]
    alone: Mask


def _lacked(views: Sequence[View], silhouettes: Sequence[Silhouette], held: _Held, cell: float) -> Mask:
    """(M, V) for each place that one silhouette takes away alone which others show something there, and have nothing
    else on that ray left."""
    points, whose = held.points[held.alone], held.whose[held.alone]
    result = np.zeros((len(points), len(views)), bool)
    for i, (view, silhouette) in enumerate(zip(views, silhouettes, strict=True)):
        radius = float(_radius(view, held.points[:: max(1, len(held.points) // _SAMPLES)], cell).max(initial=0.0))
        # a grid on which a cell covers a few points
        step = max(1, int(radius) // 2)
        distance = silhouette.distance[step // 2 :: step, step // 2 :: step]
        covered = np.zeros(distance.shape, np.uint8)
        _cover(view.row, held.points, held.whose, (i, len(views)), np.array([view.height, view.width, step]), covered)
        covered = cv2.dilate(covered, _disk(max(1, int(np.ceil(radius / step)))))
        lacks = (distance > _MARGIN_PX + 0.5 * (step - 1)) & (covered == 0)
        if silhouette.known is not None:
            lacks &= silhouette.known[step // 2 :: step, step // 2 :: step]
        rows, columns = (
            np.minimum(at // step, n - 1) for at, n in zip(_pixels(view, points), distance.shape, strict=True)
        )
        result[:, i] = lacks[rows, columns] & (whose != i)
    return result


@numba.njit(cache=True, nogil=True)
def _cover(
    row: Array, points: Array, whose: NDArray[np.int64], of: tuple[int, int], size: NDArray[np.int64],
    covered: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Mark the pictures of points (N, 3) of either of two, on a grid of every so many pixels; ``size``: height, width
    and step. What is beyond the picture is at its edge."""
    optics = row[12:]
    for n in range(points.shape[0]):
        if whose[n] != of[0] and whose[n] != of[1]:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a = row[0] * x + row[1] * y + row[2] * z + row[3]
        b = row[4] * x + row[5] * y + row[6] * z + row[7]
        c = row[8] * x + row[9] * y + row[10] * z + row[11]
        u, v = lens.project(optics, a, b, c)
        line = int(min(max(v, 0.0), size[0] - 1.0)) if v == v else 0
        col = int(min(max(u, 0.0), size[1] - 1.0)) if u == u else 0
        covered[min(line // size[2], covered.shape[0] - 1), min(col // size[2], covered.shape[1] - 1)] = 1


def _pixels(view: View, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (N,) of points (N, 3), of those beyond the picture at its edge."""
    shown = np.empty((len(points), 3))
    project_points(view.row, points, shown)
    shown = np.nan_to_num(shown, nan=-1.0)
    rows, columns = np.clip(shown[:, 1], 0, view.height - 1), np.clip(shown[:, 0], 0, view.width - 1)
    return rows.astype(np.int64), columns.astype(np.int64)


def _radius(view: View, points: Array, cell: float) -> Array:
    """Pixels (N,) that a cell covers around the picture of its middle (N, 3); 0 where the camera does not look."""
    shown, aside = np.empty((len(points), 3)), np.empty((len(points), 3))
    project_points(view.row, points, shown)
    project_points(view.row, points + _COVERS * cell * _sideways(view), aside)
    radius = np.nan_to_num(np.linalg.norm(aside[:, :2] - shown[:, :2], axis=1))
    return np.asarray(np.where(shown[:, 2] > 0.0, np.minimum(radius, view.width), 0.0))


def _holes(
    view: View, silhouette: Silhouette, taken: _Taken, limit: float, thin: float, cell: float
) -> tuple[Mask, int]:
    """(H, W) pixels of holes of a silhouette, and how many others lack what the worst one takes away.

    Holes are parts of the picture of what the silhouette alone takes away where that is thicker than a limit and all of
    a gap, or lacked by others and not ``thin``.
    """
    is_told = (taken.depth > limit) | taken.lacked.any(axis=1)
    rim = _RIM / _HOLE * min(limit, float(taken.depth[is_told].max()))
    chosen = is_told | (taken.depth > rim)
    rows, columns = _pixels(view, taken.points[chosen])
    covered = np.zeros((view.height, view.width), np.uint8)
    for v, u, r in zip(rows, columns, np.ceil(_radius(view, taken.points[chosen], cell)), strict=True):
        cv2.circle(covered, (int(u), int(v)), int(r), 1, -1)
    outside = ~silhouette.inside
    parts, num = label((covered > 0) & outside)
    part_of, lacked = parts[rows, columns], taken.lacked[chosen]
    lacked_by = np.zeros(num + 1, np.int64)
    for i in np.flatnonzero(lacked.any(axis=0)):
        lacked_by[np.unique(part_of[lacked[:, i]])] += 1
    deepest = np.zeros(num + 1)
    np.maximum.at(deepest, part_of, taken.depth[chosen])
    thick = (deepest > limit) | (lacked_by > 0) & (deepest > _RIM / _HOLE * limit)
    is_hole = thick & _are_gaps(parts, num, outside) | (lacked_by >= _LACKED_BY) & (deepest > thin)
    is_hole &= np.bincount(part_of[is_told[chosen]], minlength=num + 1) >= _FEWEST
    is_hole[0] = False
    hole = cv2.dilate(is_hole[parts].astype(np.uint8), _disk(_WIDER_PX))
    return np.asarray(hole > 0), int(lacked_by[is_hole].max(initial=0))


def _are_gaps(parts: NDArray[np.int32], num: int, outside: Mask) -> Mask:
    """(num + 1,) which parts (H, W) of what is outside are closed gaps, nearly all of which is parts."""
    gaps, _ = label(outside)
    sizes = np.bincount(gaps.ravel())
    is_gap = np.bincount(gaps[parts > 0], minlength=len(sizes)) >= _WHOLE * sizes
    is_gap[np.concatenate([gaps[0], gaps[-1], gaps[:, 0], gaps[:, -1]])] = False
    result = np.zeros(num + 1, bool)
    result[parts[parts > 0]] = is_gap[gaps[parts > 0]]
    return result


def _disk(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _sideways(view: View) -> Array:
    """(3,) a unit direction of the world that a camera sees from the side."""
    axis = view.axis
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return np.asarray(across / np.linalg.norm(across))
