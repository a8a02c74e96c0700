"""Colours of a carved surface, from the photographs that show each place best."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.parts import in_parts
from sfmapp.carve.rendering import Shown, overlap, show_mesh
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.events import Events
from sfmapp.reporting import Report
from sfmapp.scene.mesh import Mesh

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

STAGE = "colors"
# a view may see the surface this much from the side
_SMALLEST_COSINE = 0.1
# weights fall with this power of the cosine over the depth: the best view counts, its neighbours soften the borders
_SHARPNESS = 4
# pixels from the outline below which a colour may be mixed with the background
_CLEAR_PX = 2.0
# places that no view shows take the mean colour of so many that are near
_NEAREST = 4
_GREY = 192
# places of which photographs are held against each other, and by how many degrees these look from elsewhere
_COMPARED = 2000
_APART_DEG = (0.0, 15.0, 30.0, 60.0, 180.0)


class ViewFit(Report):
    """How well the result fits one silhouette.

    Attributes:
        iou: of the silhouette and the result as this view shows it.
        over_px, under_px: pixels that the result alone covers, and the silhouette alone.
        under_share: the latter, as a share of the silhouette.
        source: how the silhouette was found.
    """

    name: str
    iou: float
    over_px: int
    under_px: int
    under_share: float
    source: str


class Difference(Report):
    """How much photographs of one place differ that look at it from directions some degrees apart.

    Attributes:
        from_deg, to_deg: the angle between them.
        num: of pairs.
        levels: median difference of their colours, grey levels.
    """

    from_deg: float
    to_deg: float
    num: int
    levels: float


class ColoringReport(Report):
    """Where the colours are from.

    Attributes:
        differences: of the photograph that shows a place best to others, by the angle between them. What differs at
            small angles is noise and surface that is not where it is said to be; what grows with the angle is either
            the latter, or the object does not look the same from everywhere.
        seen_share: of the vertices, those that a photograph shows; the others have the colour of what is near.
        median_views: that show a vertex.
        views: how well the surface fits each silhouette.
    """

    seen_share: float
    median_views: float
    views: Sequence[ViewFit]
    differences: Sequence[Difference] = ()


def color_surface(
    mesh: Mesh, cell: float, views: Sequence[View], silhouettes: Sequence[Silhouette],
    read: Callable[[int], Pixels], events: Events | None = None, *, threads: int = 1,
    also: Callable[[int, NDArray[np.float32]], None] | None = None,
) -> tuple[Pixels, ColoringReport]:  # fmt: skip
    """The colour of each vertex of a mesh: the mean of the views in which it is not hidden, weighted by the fourth
    power of the cosine under which they see it over their distance.

    Args:
        mesh: closed, with normals outward.
        cell: side of the cells that it is made of, units of the world: what lies less deep is not hidden.
        views: V of them, with their silhouettes, in pixels of the photographs.
        read: gives the photograph (H, W, 3) of a view.
        events: progress and cancellation.
        threads: views at a time; the result does not depend on it.
        also: called with each view, one after another, and the depths (H, W) that it shows of the mesh.

    Returns:
        (N, 3) uint8, and the report, with the overlap of each silhouette and the mesh.
    """
    events = events or Events()
    events.started(STAGE, f"colours of {len(mesh.xyz)} vertices", total=len(views))
    xyz, normal = np.ascontiguousarray(mesh.xyz), np.ascontiguousarray(mesh.normal)
    sums, fits = _no_colors(len(xyz)), list[ViewFit]()
    compared = np.arange(0, len(xyz), max(1, len(xyz) // _COMPARED))
    samples = np.zeros((len(views), len(compared), 4), np.float32)

    def show(v: int) -> tuple[Shown, Pixels]:
        return show_mesh(views[v], xyz, mesh.faces), read(v)

    with ThreadPoolExecutor(threads) as pool:
        # so many at a time, as each holds an array of all vertices
        for first in range(0, len(views), threads):
            some = range(first, min(first + threads, len(views)))
            for v, (shown, rgb) in zip(some, pool.map(show, some), strict=True):
                view, silhouette = views[v], silhouettes[v]
                look = _Look(view.center, shown.corners, shown.depth, rgb, silhouette.distance)
                in_parts(partial(_add_colors, look, xyz, normal, cell, sums), len(xyz), pool)
                few, told = look._replace(corners=shown.corners[compared]), _no_colors(len(compared))
                _add_colors(few, xyz[compared], normal[compared], cell, told, 0, len(compared))
                samples[v, :, :3] = told.color / np.where(told.weight > 0.0, told.weight, 1.0)[:, None]
                samples[v, :, 3] = told.weight
                fits.append(_fit(view, silhouette, shown))
                if also is not None:
                    also(v, shown.depth)
                events.advanced(STAGE)
            events.raise_if_cancelled()
    is_seen = sums.weight > 0.0
    report = ColoringReport(
        seen_share=float(is_seen.mean()) if len(is_seen) else 0.0,
        median_views=float(np.median(sums.num_views)) if len(xyz) else 0.0, views=fits,
        differences=_differences(xyz[compared], np.array([view.center for view in views]), samples),
    )  # fmt: skip
    events.finished(STAGE, f"{report.seen_share:.1%} of the vertices seen")
    mixed = np.full((len(xyz), 3), float(_GREY))
    mixed[is_seen] = sums.color[is_seen] / sums.weight[is_seen, None]
    _fill(xyz, mixed, is_seen)
    return np.rint(mixed).astype(np.uint8), report


def _fit(view: View, silhouette: Silhouette, shown: Shown) -> ViewFit:
    iou, over, under = overlap(shown.depth, silhouette)
    return ViewFit(
        name=view.name, iou=iou, over_px=over, under_px=under,
        under_share=under / max(int(silhouette.inside.sum()), 1), source=silhouette.source,
    )  # fmt: skip


def _differences(xyz: Array, centers: Array, samples: NDArray[np.float32]) -> list[Difference]:
    """How colours and weights (V, N, 4) of places (N, 3) differ from those of the view with the most weight."""
    if not len(xyz):
        return []
    best, at = samples[..., 3].argmax(axis=0), np.arange(len(xyz))
    way = centers[:, None] - xyz
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((way * way[best, at]).sum(axis=2), -1.0, 1.0)))
    off = np.sqrt(((samples[..., :3] - samples[best, at, :3]) ** 2).mean(axis=2))
    is_pair = samples[..., 3] > 0.0
    is_pair[best, at] = False
    found = []
    for low, high in itertools.pairwise(_APART_DEG):
        chosen = off[is_pair & (angle >= low) & (angle < high)]
        if len(chosen):
            found.append(Difference(from_deg=low, to_deg=high, num=len(chosen), levels=float(np.median(chosen))))
    return found


def _fill(xyz: Array, rgb: Array, is_seen: NDArray[np.bool_]) -> None:
    """Give vertices that no view shows (in place) the mean colour of the nearest that one does."""
    from scipy.spatial import cKDTree

    if is_seen.all() or is_seen.sum() < _NEAREST:
        return
    _, nearest = cKDTree(xyz[is_seen]).query(xyz[~is_seen], k=_NEAREST)
    rgb[~is_seen] = rgb[is_seen][nearest].mean(axis=1)


class _Look(NamedTuple):
    """What a view shows: its place (3,), pixels and depths of vertices (N, 3), the depth in each pixel (H, W), its
    colour (H, W, 3), and how far that is inside the silhouette."""

    center: Array
    corners: Array
    depth: NDArray[np.float32]
    rgb: Pixels
    distance: NDArray[np.float32]


class _Sums(NamedTuple):
    """Of vertices (N): colours times weights (N, 3), weights, and how many views show each."""

    color: Array
    weight: Array
    num_views: NDArray[np.int32]


def _no_colors(num: int) -> _Sums:
    return _Sums(np.zeros((num, 3)), np.zeros(num), np.zeros(num, np.int32))


@numba.njit(cache=True, nogil=True, inline="always")
def _between(rgb: Pixels, line: int, col: int, channel: int, fu: float, fv: float) -> float:
    """A channel between the centres of four pixels."""
    above = (1.0 - fu) * rgb[line, col, channel] + fu * rgb[line, col + 1, channel]
    below = (1.0 - fu) * rgb[line + 1, col, channel] + fu * rgb[line + 1, col + 1, channel]
    return float((1.0 - fv) * above + fv * below)


@numba.njit(cache=True, nogil=True)
def _add_colors(
    look: _Look, xyz: Array, normal: NDArray[np.float32], cell: float, sums: _Sums, first: int, last: int
) -> None:
    """Add what a view shows of some of the vertices."""
    center, corners, depth, rgb, distance = look.center, look.corners, look.depth, look.rgb, look.distance
    color, weights, num_views = sums.color, sums.weight, sums.num_views
    height, width = depth.shape
    for n in range(first, last):
        dx, dy, dz = center[0] - xyz[n, 0], center[1] - xyz[n, 1], center[2] - xyz[n, 2]
        along = float(normal[n, 0]) * dx + float(normal[n, 1]) * dy + float(normal[n, 2]) * dz
        if along <= 0.0:
            continue
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = along / max(length, 1e-300)
        if cosine < _SMALLEST_COSINE:
            continue
        u, v, ahead = corners[n, 0], corners[n, 1], corners[n, 2]
        if not (ahead > 0.0 and 0.5 <= u <= width - 0.5 and 0.5 <= v <= height - 0.5):
            continue
        col, line = min(int(u - 0.5), width - 2), min(int(v - 0.5), height - 2)
        # the surface falls away behind a pixel's centre by what it is slanted
        slack = cell * (1.0 + 1.0 / cosine)
        if max(depth[line, col], depth[line, col + 1], depth[line + 1, col], depth[line + 1, col + 1]) < ahead - slack:
            continue
        fu, fv = u - 0.5 - col, v - 0.5 - line
        clear = (1.0 - fv) * ((1.0 - fu) * distance[line, col] + fu * distance[line, col + 1]) + fv * (
            (1.0 - fu) * distance[line + 1, col] + fu * distance[line + 1, col + 1]
        )
        share = min(max(clear / _CLEAR_PX, 0.01), 1.0) if clear == clear else 1.0
        weight = share * (cosine * cell / length) ** _SHARPNESS
        for channel in range(3):
            color[n, channel] += weight * _between(rgb, line, col, channel, fu, fv)
        weights[n] += weight
        num_views[n] += 1
