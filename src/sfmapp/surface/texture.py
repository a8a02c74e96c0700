"""Photographs onto a mesh: a view for each triangle, charts of triangles with the same view, one texture of all."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.packages import require
from sfmapp.scene.mesh import Mesh, face_areas, flat_areas
from sfmapp.surface.child import run_child
from sfmapp.surface.options import SurfaceOptions
from sfmapp.surface.painting import fill_gaps, paint
from sfmapp.surface.report import TextureReport
from sfmapp.surface.seams import level_seams
from sfmapp.surface.view_choice import choose_views, neighbor_pairs

STAGE = "texture"
PADDING_TEXELS = 4
# the detail of what no view shows, which is that of vertex colours, against that of the photographs
UNSEEN_DETAIL = 0.5
# a little blur for the colours that seams are levelled by: not a single pixel's
BLUR_PX = 1.5


@dataclass(frozen=True)
class _Charts:
    """Triangles with a view in common, cut apart.

    Attributes:
        vertex_idx: (N,) int64 vertex of the mesh that each vertex of a chart is.
        faces: (F, 3) int32 corners, in vertices of charts.
        source: (F,) int32 view that each face is painted from; V to V + 5 for those that none shows.
        vertex_source: (N,) int32 the same of each vertex.
        chart: (F,) int32.
        pixels: (N, 2) float64 place in the photograph, or in a projection along an axis.
    """

    vertex_idx: NDArray[np.int64]
    faces: NDArray[np.int32]
    source: NDArray[np.int32]
    vertex_source: NDArray[np.int32]
    chart: NDArray[np.int32]
    pixels: NDArray[np.float64]


def texture_mesh(
    mesh: Mesh, scene: DenseScene, options: SurfaceOptions, *, events: Events | None = None
) -> tuple[Mesh, TextureReport]:
    """Unwrap a mesh and paint it with the photographs.

    Each chart is the part of a photograph that its triangles cover, moved to its place by xatlas: no pixel is sampled
    twice, where the texture is large enough for all of them. What no view shows has the colours of its vertices.

    Args:
        mesh: the surface.
        scene: the views.
        options: the largest side of the texture.
        events: progress and cancellation.

    Returns:
        The mesh with a texture, its vertices doubled at the borders of charts, and the report.

    Raises:
        NoReconstructionError: a child process ended without a result.
        InterruptedRunError: ``events`` was asked to stop.
        MissingPackageError: xatlas or open3d is not installed.
    """
    require("xatlas", "open3d", "libusb_package")
    events = events or Events()
    start = time.monotonic()
    events.started(STAGE, "texture", total=4)
    choice = choose_views(mesh, scene, events)
    events.advanced(STAGE, message="charts")
    charts = _cut_charts(mesh, scene, choice.view_idx)
    places, has_texels, size, num_charts, scale = _pack(charts, options.texture_px, events)
    events.advanced(STAGE, message="seams")
    color = _colors(mesh, scene, charts)
    offset = level_seams(color, charts.vertex_idx, charts.faces)
    events.advanced(STAGE, message="painting")
    texture = _paint(mesh, scene, charts, places, has_texels, offset, size)
    events.advanced(STAGE)
    area = face_areas(mesh.xyz, mesh.faces)
    idx = charts.vertex_idx
    report = TextureReport(
        num_charts=num_charts,
        scale=scale,
        width=int(size[0]),
        height=int(size[1]),
        seen=float(area[choice.view_idx >= 0].sum() / area.sum()),
        seam_before=_seam(color, idx),
        seam_after=_seam(color + offset, idx),
        wall_s=round(time.monotonic() - start, 3),
    )
    events.finished(STAGE, f"{num_charts} charts", **report)
    uv = (places / size).astype(np.float32)
    return Mesh(mesh.xyz[idx], charts.faces, mesh.normal[idx], mesh.rgb[idx], uv, texture), report


def _cut_charts(mesh: Mesh, scene: DenseScene, view_idx: NDArray[np.int32]) -> _Charts:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    num_views, num_faces = len(scene.views), len(mesh.faces)
    # of the vertices, which are smoother than those of the faces: fewer charts
    normal = mesh.normal[mesh.faces].sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (normal[np.arange(num_faces), axis] < 0.0)
    source = np.where(view_idx >= 0, view_idx, num_views + side).astype(np.int32)
    a, b = neighbor_pairs(mesh.faces)
    same = source[a] == source[b]
    graph = coo_array((np.ones(same.sum(), np.bool_), (a[same], b[same])), (num_faces, num_faces))
    chart = connected_components(graph, directed=False)[1].astype(np.int64)
    key, corners = np.unique(chart[:, None] * len(mesh.xyz) + mesh.faces, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int32)
    vertex_idx = key % len(mesh.xyz)
    vertex_source = np.empty(len(key), np.int32)
    vertex_source[faces] = source[:, None]
    pixels = np.zeros((len(key), 2))
    for m, view in enumerate(scene.views):
        mine = vertex_source == m
        pixels[mine], _ = view.project(mesh.xyz[vertex_idx[mine]])
    _project_unseen(mesh, faces, vertex_idx, vertex_source - num_views, pixels)
    return _Charts(vertex_idx, faces, source, vertex_source, chart.astype(np.int32), pixels)


def _project_unseen(
    mesh: Mesh,
    faces: NDArray[np.int32],
    vertex_idx: NDArray[np.int64],
    side: NDArray[np.int32],
    pixels: NDArray[np.float64],
) -> None:
    """Places (in place) of the vertices that no view shows: along the axis that their faces look along most."""
    covered = flat_areas(pixels, faces)
    seen = side[faces[:, 0]] < 0
    area = face_areas(mesh.xyz, mesh.faces)
    per_unit = np.sqrt(covered[seen].sum() / max(area[seen].sum(), 1e-300)) if seen.any() else 0.0
    if per_unit == 0.0:
        per_unit = 1.0 / np.sqrt(np.median(area))
    for number in range(6):
        mine = side == number
        xyz = mesh.xyz[vertex_idx[mine]] - mesh.xyz.mean(axis=0)
        first, second = (number // 2 + 1) % 3, (number // 2 + 2) % 3
        # as in a photograph, whose y runs down: clockwise
        flip = -1.0 if number % 2 == 0 else 1.0
        pixels[mine] = UNSEEN_DETAIL * per_unit * np.stack([flip * xyz[:, first], xyz[:, second]], axis=1)


def _pack(
    charts: _Charts, side: int, events: Events
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64], int, float]:
    """Places of the vertices in texels (N, 2), whether faces have any (F,), the texture's width and height (2,), the
    number of charts, and the texels for a pixel of the photographs, a side."""
    covered = flat_areas(charts.pixels, charts.faces).sum()
    arrays: dict[str, NDArray[Any]] = {
        "uv": charts.pixels.astype(np.float32),
        "faces": charts.faces.astype(np.uint32),
        "chart": charts.chart.astype(np.uint32),
        "area": np.array(covered),
    }
    module, advice = "sfmapp.surface.pack_child", "try a smaller surface.depth"
    found = run_child(module, "packing the texture", arrays, (side, PADDING_TEXELS), advice, events)
    if not np.array_equal(found["vertex_idx"][found["faces"]], charts.faces):
        raise NoReconstructionError("packing the texture: expected the same triangles back, found others", advice)
    places = np.empty((len(charts.pixels), 2))
    places[found["vertex_idx"]] = found["uv"] * found["size"]
    is_placed = np.empty(len(places), np.bool_)
    is_placed[found["vertex_idx"]] = found["is_placed"]
    _place_slivers(charts, places, is_placed)
    has_texels = np.asarray(is_placed[charts.faces].all(axis=1))
    return places, has_texels, found["size"], int(found["num_charts"]), float(found["scale"])


def _place_slivers(charts: _Charts, places: NDArray[np.float64], is_placed: NDArray[np.bool_]) -> None:
    """Places (in place) of vertices that only belong to triangles without area: that of a vertex of their chart, or,
    where it has none, of the same vertex of the mesh in another chart. They have no texels, only a colour."""
    order = np.argsort(is_placed, kind="stable")  # what is placed comes last, and stays
    of_chart = np.full(int(charts.chart.max()) + 1, -1, np.int64)
    vertex_chart = np.empty(len(places), np.int32)
    vertex_chart[charts.faces] = charts.chart[:, None]
    elsewhere = np.full(int(charts.vertex_idx.max()) + 1, -1, np.int64)
    elsewhere[charts.vertex_idx[is_placed]] = np.flatnonzero(is_placed)
    of_chart[vertex_chart[order]] = np.where(is_placed[order], order, elsewhere[charts.vertex_idx[order]])
    lost = np.flatnonzero(~is_placed)
    places[lost] = places[np.maximum(of_chart[vertex_chart[lost]], 0)]


def _colors(mesh: Mesh, scene: DenseScene, charts: _Charts) -> NDArray[np.float64]:
    """(N, 3) what its photograph shows at each vertex of a chart; its own colour where none shows it."""
    import cv2

    color = mesh.rgb[charts.vertex_idx].astype(np.float64)
    for m, view in enumerate(scene.views):
        mine = charts.vertex_source == m
        image = cv2.GaussianBlur(view.rgb, (0, 0), BLUR_PX)
        x, y = charts.pixels[mine].T
        col, row = x.astype(np.int64).clip(0, view.width - 1), y.astype(np.int64).clip(0, view.height - 1)
        color[mine] = image[row, col]
    return color


def _paint(
    mesh: Mesh,
    scene: DenseScene,
    charts: _Charts,
    places: NDArray[np.float64],
    has_texels: NDArray[np.bool_],
    offset: NDArray[np.float32],
    size: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """(height, width, 3) the texture."""
    texture = np.zeros((int(size[1]), int(size[0]), 3), np.uint8)
    painted = np.zeros(texture.shape[:2], np.uint8)
    nothing = np.zeros((1, 1, 3), np.uint8)
    own = mesh.rgb[charts.vertex_idx] + offset
    for m in range(len(scene.views) + 1):
        is_seen = m < len(scene.views)
        face_idx = np.flatnonzero(has_texels & (charts.source == m if is_seen else charts.source >= m))
        image, added = (scene.views[m].rgb, offset) if is_seen else (nothing, own)
        paint(face_idx, charts.faces, places, charts.pixels, added, image, texture, painted)
    fill_gaps(texture, painted)
    return texture


def _seam(color: NDArray[np.floating], vertex_idx: NDArray[np.int64]) -> float:
    """Root mean square difference of colours (N, 3) between vertices of charts that are the same of the mesh."""
    order = np.argsort(vertex_idx, kind="stable")
    same = np.flatnonzero(vertex_idx[order[1:]] == vertex_idx[order[:-1]])
    difference = color[order[same]] - color[order[same + 1]]
    return float(np.sqrt(np.mean(difference**2))) if len(same) else 0.0
