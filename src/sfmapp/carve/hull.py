"""The visual hull as a function of space: how far inside all silhouettes a point is."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera import lens
from sfmapp.camera.camera import pixels_to_rays
from sfmapp.carve.carving_kernels import STEPS, Fields
from sfmapp.carve.hull_kernels import cone_slopes, hull_distances, view_distances
from sfmapp.carve.octree import codes_in_box
from sfmapp.carve.parts import in_parts
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, project_points
from sfmapp.errors import InputError

Array = NDArray[np.float64]

# samples along the longer side of a picture from which a lens's largest slope is taken, and what is added to it for
# slopes between the samples: a lens of which it is more changes its focal length by a tenth within a 64th of a picture
_SAMPLES, _BETWEEN = 64, 1.1
# outlines are believed within so many of their standard deviations
_SIGMAS = 3.0
# points for a thread at a time: few enough that neighbours are read together
_CHUNK = 1 << 13
# points that are asked about together, and bits of their places along each axis by which they are put together
_TOGETHER, _BITS = 64, 10


class Nearest(NamedTuple):
    """Of points (N): the least signed distances (N, K) to cones of silhouettes, ascending, units of the world, positive
    inside, inf where there are no more; whose they are, in the order of ``Hull.fields``, -1 for none; and how many
    views tell of each."""

    distance: Array
    view: NDArray[np.int32]
    num_views: NDArray[np.int32]


class HeldSilhouettes(Sequence[Silhouette]):
    """Silhouettes (V) out of the distances that kernels read, to 1 / 64 pixel and 512 pixels at most, each made when it
    is asked for: two bytes a pixel in place of six.
    """

    def __init__(self, fields: Fields, order: NDArray[np.int64], silhouettes: Sequence[Silhouette]) -> None:
        self._fields, self._place = fields, np.argsort(order)
        self._rest = [(each.known, each.outline_sigma_px, each.source) for each in silhouettes]

    def __len__(self) -> int:
        return len(self._rest)

    @overload
    def __getitem__(self, index: int) -> Silhouette: ...
    @overload
    def __getitem__(self, index: slice) -> list[Silhouette]: ...
    def __getitem__(self, index: int | slice) -> Silhouette | list[Silhouette]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        at, fields = self._place[index], self._fields
        start, (height, width) = fields.starts[at], fields.sizes[at]
        steps = fields.distance[start : start + height * width].reshape(height, width)
        return Silhouette(steps.astype(np.float32) / np.float32(STEPS), *self._rest[index])


@dataclass(frozen=True)
class Hull:
    """Silhouettes and their cameras, ready for kernels.

    Attributes:
        fields: what the kernels read, view by view in ``order``.
        order: (N,) positions of the views as they were given; each is as far in direction from those before it as can
            be, so that a cell that is outside is soon told to be.
        min_views: views that have to show a point inside for it to be in the hull.
        misses: views that may show it outside.
        silhouettes: V that it is made of, in the order in which they were given.
    """

    fields: Fields
    order: NDArray[np.int64]
    min_views: int
    misses: int
    silhouettes: HeldSilhouettes

    def __len__(self) -> int:
        return len(self.order)

    def distance(self, xyz: ArrayLike, threads: int | None = None) -> Array:
        """Signed distances (N,) of points (N, 3) to the hull, positive inside, units of the world.

        That of a view is its silhouette's distance in pixels by what a pixel is at the point's depth, and the hull's
        is the least of all views' that see the point: exact in sign, near the surface a close bound in size. Infinite
        where nothing but ``misses`` limits it, -inf where fewer than ``min_views`` see the point.
        """
        return self._limits(self.nearest(xyz, threads))

    def _limits(self, nearest: Nearest) -> Array:
        return np.where(nearest.num_views < self.min_views, -np.inf, nearest.distance[:, -1])

    def normals(self, xyz: ArrayLike, step: float, threads: int | None = None) -> NDArray[np.float32]:
        """Outward unit normals (N, 3) of the hull at points (N, 3) on it: of the cone that bounds it there, by central
        differences over a step in units of the world; zero where a silhouette is flat."""
        points = np.ascontiguousarray(xyz, np.float64)
        owners = self.nearest(points, threads).view[:, -1].copy()
        out = np.empty((len(points), 3), np.float32)

        def run(a: int, b: int) -> None:
            cone_slopes(self.fields, points[a:b], owners[a:b], step, out[a:b])

        _in_parts(run, len(points), threads)
        return out

    def distance_by_view(self, xyz: ArrayLike, threads: int | None = None) -> NDArray[np.float32]:
        """Signed distances (N, V) of points (N, 3) to the cone of each silhouette, in the order in which views were
        given, positive inside, units of the world; NaN where a view does not tell."""
        points = np.ascontiguousarray(xyz, np.float64)
        out = np.empty((len(points), len(self)), np.float32)
        _in_parts(lambda a, b: view_distances(self.fields, points[a:b], out[a:b]), len(points), threads)
        result = np.empty_like(out)
        result[:, self.order] = out
        return result

    def nearest(self, xyz: ArrayLike, threads: int | None = None) -> Nearest:
        """The silhouettes that points (N, 3) are least inside, one more of them than may miss."""
        points = np.ascontiguousarray(xyz, np.float64)
        shape = len(points), self.misses + 1
        found = Nearest(np.empty(shape), np.empty(shape, np.int32), np.empty(len(points), np.int32))
        order = _near_together(points)
        _in_parts(lambda a, b: hull_distances(self.fields, points, order[a:b], _TOGETHER, *found), len(points), threads)
        return found


def _near_together(points: Array) -> NDArray[np.int64]:
    """The order (N,) of points (N, 3) in which those that follow each other are near."""
    if not len(points):
        return np.empty(0, np.int64)
    codes = np.empty(len(points), np.uint64)
    codes_in_box(points, _BITS, codes)
    return np.argsort(codes, kind="stable")


def _in_parts(run: Callable[[int, int], None], num: int, threads: int | None) -> None:
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        in_parts(run, num, pool, _CHUNK)


def hull_of(
    views: Sequence[View], silhouettes: Sequence[Silhouette], *, min_views: int | None = None, misses: int = 0
) -> Hull:
    """The hull of silhouettes.

    Args:
        views, silhouettes: one of each for a photograph.
        min_views: see :class:`Hull`; None: half of the views that know anything, and two at least if there are two.
            Where few look, as beyond the pictures of most, the cones of these few would be left standing.
        misses: see :class:`Hull`.

    Raises:
        InputError: their numbers or sizes differ, there is no view, or a distance is no number.
    """
    from scipy.ndimage import distance_transform_edt  # 0.2 s, which every command would pay for carving's options

    if len(views) != len(silhouettes) or not views:
        raise InputError(f"expected a silhouette for each view, found {len(silhouettes)} for {len(views)} views")
    for view, silhouette in zip(views, silhouettes, strict=True):
        if silhouette.distance.shape != (view.height, view.width):
            height, width = silhouette.distance.shape
            raise InputError(
                f"{view.name}: its silhouette has {width} x {height} pixels, its camera {view.width} x {view.height}",
                "masks have to be as large as the photographs of their cameras",
            )
        if np.isnan(silhouette.distance).any():
            raise InputError(f"{view.name}: distances to its outline that are no numbers")
    order = _far_apart(views)
    chosen = [(views[i], silhouettes[i]) for i in order]
    sizes = np.array([[view.height, view.width] for view, _ in chosen], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))]).astype(np.int64)
    distance = np.empty(starts[-1], np.int16)
    unknown = [(k, s.known) for k, (_, s) in enumerate(chosen) if s.known is not None and not s.known.all()]
    known_starts = np.full(len(views), -1, np.int64)
    known = np.empty(sum(mask.size for _, mask in unknown), np.int16)
    for k, (_, silhouette) in enumerate(chosen):
        distance[starts[k] : starts[k + 1]] = _steps(silhouette.distance).ravel()
    begin = 0
    for k, mask in unknown:
        # where nothing at all is known there is no border to be away from
        signed = (
            distance_transform_edt(mask) - distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, -np.inf)
        )
        known_starts[k] = begin
        known[begin : begin + mask.size] = _steps(signed - 0.5 * np.sign(signed)).ravel()
        begin += mask.size
    fields = Fields(
        np.stack([view.row for view, _ in chosen]),
        np.stack([_lens_bounds(view) for view, _ in chosen]),
        sizes,
        starts[:-1].copy(),
        distance,
        known_starts,
        known,
    )
    num_telling = sum(s.known is None or bool(s.known.any()) for s in silhouettes)
    least = max(2, (num_telling + 1) // 2) if min_views is None else min_views
    held = HeldSilhouettes(fields, np.array(order), silhouettes)
    return Hull(fields, np.array(order), min(least, len(views)), misses, held)


def outline_error(views: Sequence[View], silhouettes: Sequence[Silhouette], at: Array) -> float:
    """How far the hull's surface may be off beside a place (3,) by what outlines may be, three of their standard
    deviations in the typical view, units of the world."""
    errors = []
    for view, silhouette in zip(views, silhouettes, strict=True):
        # a step across the axis by a small share of the depth
        across = np.linalg.svd(view.axis[None])[2][1]
        depth, here = float(np.linalg.norm(at - view.center)), np.empty((2, 3))
        project_points(view.row, np.stack([at, at + 1e-3 * depth * across]), here)
        px = float(np.linalg.norm(here[1, :2] - here[0, :2]))
        errors.append(_SIGMAS * silhouette.outline_sigma_px * 1e-3 * depth / px)
    return float(np.nanmedian(errors)) if np.isfinite(errors).any() else 0.0


def _steps(distance: ArrayLike) -> NDArray[np.int16]:
    """Distances in whole steps; what is not zero stays on its side of it."""
    scaled = np.clip(np.asarray(distance, np.float32) * np.float32(STEPS), -32767.0, 32767.0)
    return np.asarray(np.where(scaled > 0.0, np.maximum(np.rint(scaled), 1.0), np.rint(scaled)), np.int16)


def _far_apart(views: Sequence[View]) -> list[int]:
    """Positions of views, each the one whose axis is farthest from all before it, up to its sign: two photographs from
    opposite sides show nearly the same outline."""
    axes = np.stack([view.axis for view in views])
    order, nearest = [0], np.abs(axes @ axes[0])
    while len(order) < len(views):
        nearest[order[-1]] = np.inf
        order.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, np.abs(axes @ axes[order[-1]]))
    return order


def _lens_bounds(view: View) -> Array:
    """(5,) what bounds the picture of a cell: most pixels to a radian (0 of lenses that change nothing, whose pictures
    of cells are exact), the axis (3,) of a cone in the lens's frame that holds all that is seen, and its half angle."""
    if view.lens_row[lens.FAMILY] == lens.BROWN and not view.lens_row[4 : lens.FAMILY].any():
        return np.zeros(5)
    if view.camera is None:
        raise InputError(f"{view.name}: a lens that distorts without a camera")
    step = max(view.width, view.height) / _SAMPLES
    u = np.linspace(0.0, view.width, int(np.ceil(view.width / step)) + 1)
    v = np.linspace(0.0, view.height, int(np.ceil(view.height / step)) + 1)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    rays = pixels_to_rays(view.camera, pixels.reshape(-1, 2)).reshape(*pixels.shape[:2], 3)
    most = 0.0
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]), (np.s_[:-1, :-1], np.s_[1:, 1:])):
        apart = np.linalg.norm(pixels[first] - pixels[second], axis=-1)
        turned = 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(rays[first] - rays[second], axis=-1), 0.0, 1.0))
        ratio = apart / np.where(turned > 0.0, turned, np.nan)
        if np.isfinite(ratio).any():
            most = max(most, float(np.nanmax(ratio)))
    seen = rays[np.isfinite(rays).all(axis=-1)]
    if not len(seen) or most == 0.0:
        raise InputError(f"{view.name}: its lens has no rays for its pixels")
    axis = seen.mean(axis=0)
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 0.0 else np.array([0.0, 0.0, 1.0])
    half = float(np.arccos(np.clip((seen @ axis).min(), -1.0, 1.0)))
    return np.array([most * _BETWEEN, *axis, half * _BETWEEN])
