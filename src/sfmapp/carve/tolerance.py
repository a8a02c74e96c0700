"""Holes in silhouettes, by what all others show: a strict hull loses a tunnel to each.

What one silhouette alone takes away of the hull of all others is thin, slivers along its outline, as every outline is
tangent to the object. Behind a hole in a mask it is as thick as the object, and no other silhouette shows it empty. So
the thickness of what each takes away alone is compared between photographs, most of which are taken to be right, and
only where it stands out the silhouette is said not to know. What its outline cuts off is cut off as before; what spills
over an outline is carved by the others.

A gap that is there and that one photograph alone looks through is the same thing to silhouettes: it is filled, and the
photograph named.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from sfmapp.carve.hull import hull_of
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.space_carving import CarveOptions, carve_hull
from sfmapp.carve.views import View, project_points
from sfmapp.events import Events
from sfmapp.reporting import Report

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STAGE = "tolerance"
# Of the usual thickness (median over photographs) of what silhouettes take away alone: beyond the first it is a hole,
# beyond the second it belongs to one. On circles of 8 to 24 views none of six clean solids reached the first.
_HOLE, _RIM = 3.0, 1.5
# in coarse cells, below which thickness is not told from the size of these
_LEAST = 3.0
# pixels by which what is not known is widened: outlines around holes are not to be trusted either
_WIDER_PX = 3
# along the side of the cube: a hole of a twentieth of an object is a tenth of it wide
_CELLS = 64


class DoubtedSilhouette(Report):
    """A silhouette with holes.

    Attributes:
        thickness: of what it alone takes away, units of the world.
        share: of its picture that is not known now.
    """

    name: str
    thickness: float
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
    hull = hull_of(views, silhouettes, misses=1)
    names = [view.name for view in views]
    tree, _ = carve_hull(hull, names, low, side, CarveOptions(cells=_CELLS, misses=1), Events())
    points = tree.centers(np.concatenate([tree.finest_full(), tree.surface]))
    depth, by_view = hull.distance(points), hull.distance_by_view(points)
    # taken away by one alone, by more than its outline may be wrong
    alone = (depth > 0.0) & (np.nanmin(by_view, axis=1, initial=np.inf) <= -tree.cell)
    points, depth, missed = points[alone], np.minimum(depth[alone], side), by_view[alone] <= 0.0
    thickness = np.where(missed, depth[:, None], 0.0).max(axis=0, initial=0.0)
    usual = max(float(np.median(thickness)), _LEAST * tree.cell / _HOLE)
    result, doubted = list(silhouettes), []
    for i in np.flatnonzero(thickness > _HOLE * usual).tolist():
        thin = missed[:, i] & (depth > _RIM * usual)
        hole = _holes(views[i], silhouettes[i], points[thin], depth[thin] > _HOLE * usual, tree.cell)
        known = silhouettes[i].known
        told = ~hole if known is None else known & ~hole
        result[i] = dataclasses.replace(silhouettes[i], known=told)
        doubted.append(DoubtedSilhouette(name=views[i].name, thickness=float(thickness[i]), share=float(hole.mean())))
    if doubted:
        events.warned(
            STAGE, "holes that other silhouettes do not show, not carved: " + ", ".join(one.name for one in doubted)
        )
    return result, ToleranceReport(usual_thickness=usual, doubted=doubted)


def _holes(view: View, silhouette: Silhouette, points: Array, is_deep: Mask, cell: float) -> Mask:
    """(H, W) pixels of holes: outside the silhouette, on the picture of cells (N, 3) that it alone takes away, in parts
    with one that is deep."""
    shown = np.empty((len(points), 3))
    project_points(view.row, points, shown)
    aside = np.empty((len(points), 3))
    project_points(view.row, points + cell * _sideways(view), aside)
    # half the diagonal of a cell: the pictures of neighbours meet
    radius = np.ceil(0.87 * np.linalg.norm(aside[:, :2] - shown[:, :2], axis=1)).astype(int)
    covered, deep = (np.zeros((view.height, view.width), np.uint8) for _ in range(2))
    for (u, v, _), r, is_seed in zip(shown, radius, is_deep, strict=True):
        cv2.circle(covered, (int(u), int(v)), int(r), 1, -1)
        if is_seed:
            deep[min(max(int(v), 0), view.height - 1), min(max(int(u), 0), view.width - 1)] = 1
    parts, _ = label((covered > 0) & ~silhouette.inside)
    of_deep = np.unique(parts[deep > 0])
    hole = np.isin(parts, of_deep[of_deep > 0])
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _WIDER_PX + 1, 2 * _WIDER_PX + 1))
    return np.asarray(cv2.dilate(hole.astype(np.uint8), disk) > 0)


def _sideways(view: View) -> Array:
    """(3,) a unit direction of the world that a camera sees from the side."""
    axis = view.axis
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return np.asarray(across / np.linalg.norm(across))
