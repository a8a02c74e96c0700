"""From a carved volume to ``recording.rrd``: how it was carved away, level by level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.octree import Codes, Octree, codes_of, places_of
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, up_of_views
from sfmapp.scene.mesh import Mesh
from sfmapp.viewer.carve_replay import CarveReplay, Pixels
from sfmapp.viewer.recording import RecordingReport, record_in_child

Array = NDArray[np.float64]

# the finest level that is drawn as cells: finer ones look like the surface, and there are too many
_FINEST = 7
_FULL, _SPLIT = (92, 158, 116), (222, 190, 120)
_NUM_PHOTOS, _PHOTO_PX = 6, 480
# sides along x, y and z differ in brightness, or edges between them would not be seen
_SHADES = (0.78, 0.9, 1.0)
# corners of the six faces of a cell by the bits of x, y, z, anticlockwise from outside
_SIDES = (
    ((-1, 0, 0), (0, 4, 6, 2)), ((1, 0, 0), (1, 3, 7, 5)), ((0, -1, 0), (0, 1, 5, 4)),
    ((0, 1, 0), (2, 6, 7, 3)), ((0, 0, -1), (0, 2, 3, 1)), ((0, 0, 1), (4, 5, 7, 6)),
)  # fmt: skip


def record_carving(
    path: Path, story: str, views: Sequence[View], silhouettes: Sequence[Silhouette], octree: Octree, mesh: Mesh,
    level_texts: Sequence[str], read: Callable[[int], Pixels],
) -> RecordingReport:  # fmt: skip
    """Write a recording in a child process; never raises for what happens there.

    Args:
        story: in words, Markdown. level_texts: a line for each level of the octree. read: the photograph of a view.
    """

    def make(_: Path) -> CarveReplay:
        return _replay(story, views, silhouettes, octree, mesh, level_texts, read)

    return record_in_child(path, "carve", make, timeout_s=180.0)


def _replay(
    story: str, views: Sequence[View], silhouettes: Sequence[Silhouette], octree: Octree, mesh: Mesh,
    level_texts: Sequence[str], read: Callable[[int], Pixels],
) -> CarveReplay:  # fmt: skip
    middle = octree.low + 0.5 * octree.side
    levels = list(range(min(octree.depth, _FINEST) + 1))
    drawn = [faces_of_level(octree, level) for level in levels]
    chosen = np.unique(np.linspace(0, len(views) - 1, _NUM_PHOTOS).round().astype(int)).tolist()
    away = float(np.median([np.linalg.norm(view.center - middle) for view in views]))
    return CarveReplay(
        title=f"A volume of {len(views)} photographs", story=story, up=up_of_views(views),
        middle=middle, levels=levels, level_texts=[level_texts[level] for level in levels],
        corner_ptr=np.cumsum([0, *(len(corners) for corners, _, _ in drawn)]),
        face_ptr=np.cumsum([0, *(len(faces) for _, _, faces in drawn)]),
        corners=np.concatenate([corners for corners, _, _ in drawn]),
        corner_rgb=np.concatenate([rgb for _, rgb, _ in drawn]), faces=np.concatenate([f for _, _, f in drawn]),
        mesh_xyz=(mesh.xyz - middle).astype(np.float32), mesh_normal=mesh.normal, mesh_rgb=mesh.rgb,
        mesh_faces=mesh.faces, frusta=np.array([_frustum(view, 0.1 * away) - middle for view in views], np.float32),
        camera_names=[view.name for view in views],
        photos=np.array([_outlined(read(v), silhouettes[v]) for v in chosen]),
        photo_names=[views[v].name for v in chosen],
    )  # fmt: skip


def _standing(octree: Octree, level: int) -> tuple[Codes, Codes]:
    """Cells of a level that stand when it is done: those wholly inside, as large as they are found, cut to its size;
    and those that are split or at the surface."""
    full = [np.zeros(0, np.uint64)]
    for at, codes in enumerate(octree.full[: level + 1]):
        inside = np.arange(8 ** (level - at), dtype=np.uint64)
        full.append(((codes << np.uint64(3 * (level - at)))[:, None] + inside).ravel())
    deeper = [octree.surface >> np.uint64(3 * (octree.depth - level))]
    deeper += [codes >> np.uint64(3 * (at - level)) for at, codes in enumerate(octree.full[level + 1 :], level + 1)]
    return np.unique(np.concatenate(full)), np.unique(np.concatenate(deeper))


def faces_of_level(octree: Octree, level: int) -> tuple[NDArray[np.float32], Pixels, NDArray[np.int32]]:
    """The outer faces of the cells that stand after a level: corners (N, 3) less the cube's middle, their colours and
    triangles (F, 3)."""
    full, split = _standing(octree, level)
    codes = np.concatenate([full, split])
    places = places_of(codes)
    color = np.repeat(np.array([_FULL, _SPLIT], np.uint8), [len(full), len(split)], axis=0)
    known, number = np.sort(codes), 2**level
    corners, colors = [], []
    for step, quad in _SIDES:
        beside = places + np.array(step)
        is_within = ((beside >= 0) & (beside < number)).all(axis=1)
        is_open = ~is_within
        within = codes_of(beside[is_within])
        at = np.minimum(np.searchsorted(known, within), len(known) - 1)
        is_open[is_within] = known[at] != within
        offsets = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in quad])
        corners.append((places[is_open, None] + offsets).reshape(-1, 3))
        shade = _SHADES[int(np.flatnonzero(step)[0])]
        colors.append(np.repeat((shade * color[is_open]).astype(np.uint8), 4, axis=0))
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads) // 4, dtype=np.int32)[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2], np.int32), first + np.array([0, 2, 3], np.int32)])
    xyz = octree.side * (quads / number - 0.5)
    return xyz.astype(np.float32), np.concatenate(colors), faces


def _frustum(view: View, length: float) -> Array:
    """(5, 3) the centre, and where the corners of the picture are at a distance from it."""
    corners = np.array([[0.0, 0.0], [view.width, 0.0], [view.width, view.height], [0.0, view.height]])
    rays = np.nan_to_num(view.rays(corners))
    return np.concatenate([view.center[None], view.center + length * rays])


def _outlined(photograph: Pixels, silhouette: Silhouette) -> Pixels:
    """A square picture of what a photograph shows of the object, dimmed outside its silhouette."""
    inside = silhouette.inside
    dimmed = photograph.copy()
    dimmed[~inside] //= 3
    rows, cols = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows, cols = np.arange(inside.shape[0]), np.arange(inside.shape[1])
    half = 0.55 * max(np.ptp(rows) + 1, np.ptp(cols) + 1)
    scale = 0.5 * _PHOTO_PX / half
    shift = 0.5 * _PHOTO_PX - scale * (0.5 * np.array([cols[0] + cols[-1], rows[0] + rows[-1]]))
    move = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    return np.asarray(cv2.warpAffine(dimmed, move, (_PHOTO_PX, _PHOTO_PX), flags=cv2.INTER_AREA), np.uint8)
