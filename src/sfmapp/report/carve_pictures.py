"""Pictures of a volume: slices with their cells, and the result as its photographs see it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.octree import Octree, places_of
from sfmapp.carve.rendering import Shown, show_mesh
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.scene.mesh import Mesh

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# side of a slice's picture, and the side of a cell in it from which its border is drawn
_SLICE_PX, _BORDER_PX = 768, 5
_PAPER, _SURFACE = (255, 255, 255), (30, 34, 40)
_BACKGROUND = (250, 250, 250)
# what the silhouette alone covers, and what the result alone does
UNDER, OVER = (40, 110, 255), (235, 60, 40)
# what no photograph sees, what is told by neither outlines nor patches, by outlines alone, and by patches
TINTS = ((200, 120, 200), (255, 170, 80), (130, 180, 255), (255, 255, 255))


def slice_picture(octree: Octree, axis: int, at: float, ends: tuple[Array, Array]) -> Pixels:
    """(S, S, 3) cells that a plane across an axis cuts: full ones coloured by their level, those of the surface dark,
    empty ones white. The next axis runs to the right, the one after it up.

    Args:
        at: the plane's coordinate, world.
        ends: corners (3,) of the box that is shown, in a square with something around it.
    """
    pixels = np.full((_SLICE_PX, _SLICE_PX, 3), _PAPER, np.uint8)
    shown = np.array([(axis + 1) % 3, (axis + 2) % 3])
    middle = 0.5 * (ends[0] + ends[1])[shown]
    per_unit = _SLICE_PX / (1.1 * float(max((ends[1] - ends[0]).max(), octree.cell)))
    for level, codes in enumerate([*octree.full, octree.surface]):
        of_surface = level > octree.depth
        number = 2 ** min(level, octree.depth)
        side = octree.side / number
        places = places_of(codes)
        places = places[places[:, axis] == min(max(int((at - octree.low[axis]) / side), 0), number - 1)]
        color = _SURFACE if of_surface else _color_of(level, octree.depth)
        first = (octree.low[shown] + side * places[:, shown] - middle) * per_unit + 0.5 * _SLICE_PX
        for x, y in first.tolist():
            left, right = max(round(x), 0), max(round(x + side * per_unit), round(x) + 1)
            bottom = _SLICE_PX - max(round(y), 0)
            top = max(min(_SLICE_PX - round(y + side * per_unit), bottom - 1), 0)
            pixels[top:bottom, left:right] = color
            if side * per_unit >= _BORDER_PX:
                pixels[top : top + 1, left:right] = _PAPER
                pixels[top:bottom, left : left + 1] = _PAPER
    return pixels


def _color_of(level: int, depth: int) -> tuple[int, ...]:
    ramp = np.full((1, 1), round(235.0 - 190.0 * level / max(depth, 1)), np.uint8)
    return tuple(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)[0, 0, ::-1].tolist())


def overlap_picture(photograph: Pixels, shown: Shown, silhouette: Silhouette) -> Pixels:
    """A photograph with its silhouette's outline, and in colour where the result and the silhouette differ."""
    mesh, inside = np.isfinite(shown.depth), silhouette.inside
    if silhouette.known is not None:
        mesh, inside = mesh & silhouette.known, inside & silhouette.known
    out = photograph.copy()
    out[~inside] = (0.35 * out[~inside] + 0.65 * 255).astype(np.uint8)
    for where, color in ((mesh & ~inside, OVER), (inside & ~mesh, UNDER)):
        out[where] = color
    return out


def result_pictures(view: View, mesh: Mesh, kind: NDArray[np.int8] | None = None) -> tuple[Shown, Pixels, Pixels]:
    """What a view shows of the result, that in colours, and its shape lit from the camera, tinted by what is known
    (F,) of its triangles, see :class:`sfmapp.carve.limits.Known`, if that is given."""
    shown = show_mesh(view, mesh.xyz, mesh.faces)
    there = shown.face >= 0
    corners = mesh.faces[shown.face[there]]
    colors = np.full((*there.shape, 3), _BACKGROUND, np.uint8)
    colors[there] = mesh.rgb[corners].mean(axis=1)
    shape = np.full((*there.shape, 3), _BACKGROUND, np.uint8)
    toward = view.center - mesh.xyz[corners].mean(axis=1)
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    lit = np.einsum("nc,nc->n", mesh.normal[corners].mean(axis=1), toward)
    tint = np.ones((len(lit), 3)) if kind is None else np.array(TINTS)[kind[shown.face[there]]] / 255.0
    shape[there] = np.clip((60.0 + 180.0 * np.abs(lit))[:, None] * tint, 0.0, 255.0).astype(np.uint8)
    return shown, colors, shape


def cropped(pictures: list[Pixels], shown: Shown, silhouette: Silhouette) -> list[Pixels]:
    """Pictures cut to what is seen of the object, with something around it."""
    there = np.isfinite(shown.depth) | silhouette.inside
    if not there.any():
        return pictures
    rows, cols = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    around = max(4, int(0.06 * max(np.ptp(rows), np.ptp(cols))))
    top, bottom = max(rows[0] - around, 0), rows[-1] + around + 1
    left, right = max(cols[0] - around, 0), cols[-1] + around + 1
    return [np.ascontiguousarray(picture[top:bottom, left:right]) for picture in pictures]
