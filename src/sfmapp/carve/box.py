"""The box that an object lies in, by its silhouettes alone: where the cones over all of them meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.octree import Codes, Octree
from sfmapp.carve.outlines import Silhouette
from sfmapp.carve.views import View
from sfmapp.errors import InputError, listed
from sfmapp.events import Events

Array = NDArray[np.float64]

STAGE = "box"
# planes that a cone is bounded by, a multiple of four; at 24 they lie outside a circle by 0.9 % of its radius at most
_NUM_PLANES = 24
# pixels added around a silhouette: its outline is told to half of one, and its cells are not to touch the box
_MARGIN_PX = 1.0
# a side of the box that a single view holds back by no more than this share of its extent is let go to where the other
# views hold it: one camera that is turned cuts nothing off then, and six views at right angles keep their box
_HELD_BY_ONE = 0.25
# free space around the box, as a share of its longest side: the surface closes inside the cube
_AROUND = 0.02
# of the spread of the cameras: cones that miss each other by less meet, but for rounding
_TOUCH = 1e-9
_FAR = 1e3
_NAMES_SHOWN = 4


@dataclass(frozen=True)
class Box:
    """Where the object is.

    Attributes:
        low, high: (3,) corners, world.
        told_by: ``silhouettes``, ``points`` or ``user``.
        apart: names of views whose silhouettes do not meet with those of the others anywhere.
    """

    low: Array
    high: Array
    told_by: str
    apart: tuple[str, ...] = ()

    @property
    def extent(self) -> float:
        """Its longest side."""
        return float((self.high - self.low).max())

    def cube(self) -> tuple[Array, float]:
        """Low corner (3,) and side of a cube around it with a little free space on all sides."""
        side = (1.0 + 2.0 * _AROUND) * self.extent
        return 0.5 * (self.low + self.high) - 0.5 * side, side

    def distance(self, xyz: Array) -> Array:
        """(N,) signed distances of points (N, 3) to its faces, positive inside: exact there, a lower bound outside."""
        return np.asarray(np.minimum(xyz - self.low, self.high - xyz).min(axis=1))

    def holds(self, xyz: Array) -> NDArray[np.bool_]:
        """(N,) bool of points (N, 3)."""
        return np.asarray(((xyz >= self.low) & (xyz <= self.high)).all(axis=1))


def user_box(low: Sequence[float], high: Sequence[float]) -> Box:
    """The box that a user gives. Raises InputError if its corners are none."""
    corners = np.array([low, high], np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise InputError(
            f"box: expected a lower and an upper corner, found {corners.ravel().tolist()}",
            "give six numbers, the lower x, y, z and the upper ones",
        )
    return Box(corners[0], corners[1], "user")


def find_box(
    views: Sequence[View], silhouettes: Sequence[Silhouette], points: Array | None = None, events: Events | None = None
) -> Box:
    """The smallest box, along the axes of the world, around the space where the convex cones over all silhouettes meet.

    Each cone is bounded by planes through the camera's centre. Where a silhouette touches the border of its picture,
    the object goes on beyond, and that side of the picture bounds nothing. The corners are linear programs.

    Args:
        views: V of them, in pixels of the silhouettes.
        points: (N, 3) of a reconstruction, which stand in where the silhouettes leave the box open.
        events: told which views meet with no others.

    Raises:
        InputError: no silhouette with an object in it, cones that do not meet, or that leave the box open.
    """
    cones = [_planes(view, silhouette) for view, silhouette in zip(views, silhouettes, strict=True)]
    used = [i for i, cone in enumerate(cones) if len(cone)]
    if len(used) < 2:
        raise InputError(f"expected an object in two silhouettes or more, found it in {len(used)} of {len(views)}")
    centers = np.array([view.center for view in views])
    frame = _Frame.of(centers[used])
    apart = _apart(cones, frame.inner(centers), [view.name for view in views])
    if apart and events is not None:
        names = listed([views[i].name for i in apart], _NAMES_SHOWN)
        events.warned(STAGE, f"{names}: no place that the other silhouettes hold is in its own: a wrong camera or mask")
    owner = np.concatenate([np.full(len(cones[i]), i) for i in used if i not in apart])
    planes = np.concatenate([cones[i] for i in used if i not in apart])
    limits = np.einsum("kc,kc->k", planes, frame.inner(centers)[owner])
    ends = np.array([_end(planes, limits, owner, sign, axis) for sign in (-1.0, 1.0) for axis in range(3)])
    low, high = frame.outer(ends[:3]), frame.outer(ends[3:])
    if not np.isfinite(ends).all() or np.abs(ends).max() >= _FAR:
        return _by_points(points)
    extent = (high - low).max()
    return Box(np.minimum(low, high - 1e-6 * extent), high, "silhouettes", tuple(views[i].name for i in apart))


def cameras_inside(box: Box, views: Sequence[View]) -> list[str]:
    """Names of views whose cameras stand inside the box."""
    is_inside = box.holds(np.array([view.center for view in views]))
    return [view.name for view, inside in zip(views, is_inside, strict=True) if inside]


def clip_octree(octree: Octree, box: Box) -> Octree:
    """The part of a volume in a box: cells that a face cuts are split down to the finest, which are of the surface."""
    full: list[Codes] = []
    pending: Codes = np.zeros(0, np.uint64)
    for level, codes in enumerate(octree.full):
        candidates = np.concatenate([codes, pending])
        is_inside, is_cut = _against(octree, candidates, level, box)
        full.append(np.sort(candidates[is_inside]))
        if level < octree.depth:
            children = (candidates[is_cut] << np.uint64(3))[:, None] + np.arange(8, dtype=np.uint64)
            pending = np.asarray(children.ravel(), np.uint64)
        else:
            pending = candidates[is_cut]
    is_inside, is_cut = _against(octree, octree.surface, octree.depth, box)
    surface = np.sort(np.concatenate([octree.surface[is_inside | is_cut], pending]))
    return Octree(octree.low, octree.side, octree.depth, tuple(full), surface)


def _against(octree: Octree, codes: Codes, level: int, box: Box) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells of a level are wholly in a box, and which its faces cut."""
    half = 0.5 * octree.side / 2.0**level
    centers = octree.centers(codes, level)
    is_inside = np.asarray(((centers - half >= box.low) & (centers + half <= box.high)).all(axis=1))
    is_outside = np.asarray(((centers + half <= box.low) | (centers - half >= box.high)).any(axis=1))
    return is_inside, ~is_inside & ~is_outside


def tightened(box: Box, octree: Octree) -> Box:
    """The part of a box that a coarse volume fills, with a cell of it around."""
    low, high = box.high.copy(), box.low.copy()
    for level, codes in enumerate([*octree.full, octree.surface]):
        if len(codes):
            at = min(level, octree.depth)
            half = 0.5 * octree.side / 2.0**at
            centers = octree.centers(codes, at)
            low = np.minimum(low, centers.min(axis=0) - half)
            high = np.maximum(high, centers.max(axis=0) + half)
    return replace(box, low=np.maximum(low - octree.cell, box.low), high=np.minimum(high + octree.cell, box.high))


@dataclass(frozen=True)
class _Frame:
    """The world moved and scaled so that cameras are about 1 away from the origin, for the linear programs."""

    middle: Array
    size: float

    @classmethod
    def of(cls, centers: Array) -> _Frame:
        size = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
        if size == 0.0:
            raise InputError(
                "all photographs were taken from one place: their silhouettes bound nothing along their rays",
                "photograph the object from all sides",
            )
        return cls(centers.mean(axis=0), size)

    def inner(self, xyz: Array) -> Array:
        return np.asarray((xyz - self.middle) / self.size)

    def outer(self, xyz: Array) -> Array:
        return np.asarray(xyz * self.size + self.middle)


def _planes(view: View, silhouette: Silhouette) -> Array:
    """(K, 3) outward unit normals of planes through the camera's centre that bound the cone over a silhouette; none
    where there is no object."""
    shown = silhouette.inside if silhouette.known is None else silhouette.inside | ~silhouette.known
    rows = np.flatnonzero(shown.any(axis=1))
    if not len(rows) or not silhouette.inside.any():
        return np.zeros((0, 3))
    width = shown.shape[1]
    left, right = shown[rows].argmax(axis=1), width - shown[rows, ::-1].argmax(axis=1)
    touches = np.array([right.max() == width, rows[-1] == len(shown) - 1, left.min() == 0, rows[0] == 0])
    if touches.all():
        return np.zeros((0, 3))
    ends = np.stack([np.r_[left - _MARGIN_PX, right + _MARGIN_PX], np.r_[rows, rows] + 0.5], axis=1)
    edge = np.array([0.0, 0.5 + _MARGIN_PX])
    rays = view.rays(np.concatenate([ends - edge, ends + edge]))
    rays = rays[np.isfinite(rays).all(axis=1)]
    ahead = rays.mean(axis=0)
    ahead /= np.linalg.norm(ahead)
    middle = np.array([[0.5 * (left.min() + right.max()), 0.5 * (rows[0] + rows[-1]) + 0.5]])
    at, beside = view.rays(np.concatenate([middle, middle + np.array([1.0, 0.0])]))
    across = beside - at
    across -= (across @ ahead) * ahead
    across /= np.linalg.norm(across)
    down = np.cross(ahead, across)
    depth = rays @ ahead
    if (depth <= 0.0).any():  # wider than half a sphere: no cone
        return np.zeros((0, 3))
    flat = np.stack([rays @ across, rays @ down], axis=1) / depth[:, None]
    angle = 2.0 * np.pi * np.arange(_NUM_PLANES) / _NUM_PLANES
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if touches.any():  # what goes on beyond a border may be anywhere there: the other sides of the rectangle remain
        along = along[:: _NUM_PLANES // 4][~touches]
    reach = (flat @ along.T).max(axis=0)
    normals = along @ np.stack([across, down]) - reach[:, None] * ahead
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _apart(cones: Sequence[Array], centers: Array, names: Sequence[str]) -> list[int]:
    """Views to be left out so that the other cones meet. Raises InputError if these are too many."""
    from scipy.optimize import linprog

    used = [i for i, cone in enumerate(cones) if len(cone)]
    planes = np.concatenate([cones[i] for i in used])
    view = np.concatenate([np.full(len(cones[i]), k) for k, i in enumerate(used)])
    limits = np.einsum("kc,kc->k", planes, centers[np.array(used)][view])
    # how far each cone has to be moved, in sum as little as possible: few are moved, and these are the odd ones
    slack = np.zeros((len(planes), len(used)))
    slack[np.arange(len(planes)), view] = -1.0
    bounds = [(-_FAR, _FAR)] * 3 + [(0.0, None)] * len(used)
    cost = np.r_[np.zeros(3), np.ones(len(used))]
    found = linprog(cost, np.hstack([planes, slack]), limits, bounds=bounds)
    moved = found.x[3:] if found.status == 0 else np.zeros(len(used))
    odd = [used[k] for k in np.flatnonzero(moved > _TOUCH)]
    if len(odd) > max(1, len(used) // 10) or len(used) - len(odd) < 2:
        raise InputError(
            f"the silhouettes have no place in common: those of {listed([names[i] for i in odd], _NAMES_SHOWN)} are "
            "apart from the others",
            "check that cameras belong to these photographs, and that masks show the object and not the background",
        )
    return odd


def _end(planes: Array, limits: Array, owner: NDArray[np.int64], sign: float, axis: int) -> float:
    """The coordinate at which the cones' common space ends; infinite where it does not."""
    end, holding = _solve(planes, limits, sign, axis)
    if not np.isfinite(end):
        return end
    other, _ = _solve(planes, limits, -sign, axis)
    extent = abs(end - other) if np.isfinite(other) else 0.0
    farthest = end
    for view in np.unique(owner[holding]):
        kept = owner != view
        without, _ = _solve(planes[kept], limits[kept], sign, axis)
        if np.isfinite(without) and abs(without - end) <= _HELD_BY_ONE * extent:
            farthest = max(farthest, without) if sign > 0.0 else min(farthest, without)
    return farthest


def _solve(planes: Array, limits: Array, sign: float, axis: int) -> tuple[float, NDArray[np.bool_]]:
    """The least (sign -1) or greatest coordinate within planes, and which of them hold it."""
    from scipy.optimize import linprog

    cost = np.zeros(3)
    cost[axis] = -sign
    found = linprog(cost, planes, limits, bounds=[(-_FAR, _FAR)] * 3)
    if found.status != 0:
        return sign * np.inf, np.zeros(len(planes), np.bool_)
    return float(found.x[axis]), np.asarray(found.ineqlin.marginals < 0.0)


def _by_points(points: Array | None) -> Box:
    if points is None or len(points) < 8:
        raise InputError(
            "the silhouettes leave open how far the object reaches: it goes beyond the pictures, or all were taken "
            "from one side",
            "give its box: --box X Y Z X Y Z",
        )
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    around = 0.1 * float((high - low).max())
    return Box(low - around, high + around, "points")
