"""Views of a scene at one level of the pyramid, as the kernels want them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.arrays import Images
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.geometry import rigid3
from sfmapp.simd.bilinear import pack_quads

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """Where the kernels' world lies: ``x_kernel = (x_world - origin) * scale``.

    Attributes:
        origin: (3,) float64.
        scale: kernel units per world unit.
    """

    origin: Array
    scale: float


def frame_of(scene: DenseScene) -> Frame:
    """Origin and scale that leave float32 its digits: the middle of cameras and points, their spread as the unit."""
    places = np.concatenate([scene.centers, scene.point_xyz])
    origin = np.median(places, axis=0)
    spread = float(np.median(np.linalg.norm(places - origin, axis=1)))
    return Frame(origin, 1.0 / spread if spread > 0.0 else 1.0)


def halve(gray: Gray) -> Gray:
    """Half the size, each pixel the mean of those it covers; sides are rounded down."""
    import cv2

    height, width = gray.shape
    half_size: Gray = cv2.resize(gray, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    return half_size


def gray_pyramids(views: Sequence[DenseView], num_levels: int, threads: int) -> list[list[Gray]]:
    """For each level, from full working resolution downwards, the grey images of all views."""
    import cv2

    def build(view: DenseView) -> list[Gray]:
        cv2.setNumThreads(1)
        levels = [cv2.cvtColor(np.ascontiguousarray(view.rgb), cv2.COLOR_RGB2GRAY)]
        for _ in range(num_levels - 1):
            levels.append(halve(levels[-1]))
        return levels

    with ThreadPoolExecutor(threads) as pool:
        per_view = list(pool.map(build, views))
    return [list(level) for level in zip(*per_view, strict=True)]


def noise_deviation(gray: Gray) -> float:
    """Standard deviation of the noise of an image, in grey, from its Laplacian (Immerkaer, CVIU 1996).

    The median in place of the mean, over the pixels that are not in saturation, keeps texture out of it.
    """
    g = gray.astype(np.float32)
    # the mask that is blind to planes: 1 -2 1 on both axes; of white noise it makes six times the deviation
    rows = g[:-2] - 2.0 * g[1:-1] + g[2:]
    response = np.abs(rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:])
    inner = gray[1:-1, 1:-1]
    usable = (inner > 4) & (inner < 251)
    if usable.sum() < 100:
        return 0.5
    # 0.6745: quartile of the normal distribution
    return float(max(np.quantile(response[usable], 0.25) / (6.0 * 0.3186), 0.3))


def make_images(scene: DenseScene, grays: Sequence[Gray], frame: Frame, cell_px: int) -> Images:
    """The arrays of one level.

    Args:
        scene: the views.
        grays: their grey images at this level, V of (H, W) uint8.
        frame: of the kernels' world.
        cell_px: side of a cell in pixels of this level.
    """
    num_views = len(grays)
    width = np.array([g.shape[1] for g in grays], np.int32)
    height = np.array([g.shape[0] for g in grays], np.int32)
    shrink = np.array([[g.shape[1] / v.width, g.shape[0] / v.height] for g, v in zip(grays, scene.views, strict=True)])
    k = np.array([view.k for view in scene.views]) * np.concatenate([shrink, shrink], axis=1)
    k[:, 2:] -= 0.5
    pose = scene.cam_from_world
    rotation = rigid3.rotation_matrix(pose)
    translation = (pose[:, 4:] + np.einsum("vij,j->vi", rotation, frame.origin)) * frame.scale
    center = -np.einsum("vji,vj->vi", rotation, translation)
    slot = np.full((num_views, num_views), -1, np.int8)
    for m, row in enumerate(scene.neighbors):
        for j, s in enumerate(row):
            if s >= 0:
                slot[m, s] = j
    a, b = _pair_warps(scene.neighbors, k, rotation, translation)
    columns, rows = width // cell_px, height // cell_px
    return Images(
        quads=np.concatenate([pack_quads(g).ravel() for g in grays]),
        start=_starts(width.astype(np.int64) * height),
        width=width, height=height, k=k, rotation=rotation, translation=translation, center=center,
        neighbors=np.ascontiguousarray(scene.neighbors, np.int32), slot=slot, a=a, b=b,
        cell_px=np.array([cell_px], np.int32), cell_start=_starts(columns.astype(np.int64) * rows),
        columns=columns, rows=rows, closed=_closed_cells(scene.views, columns, rows, cell_px, width, height),
        noise=np.array([noise_deviation(g) for g in grays], np.float32),
    )  # fmt: skip


def _starts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(counts)])[:-1].astype(np.int64)


def _pair_warps(
    neighbors: NDArray[np.int32], k: Array, rotation: Array, translation: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A = Ks R Kr^-1 and b = Ks t of each view and each of its neighbours."""
    matrix = np.zeros((len(k), 3, 3))
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2] = k[:, 0], k[:, 1], 1.0
    matrix[:, 0, 2], matrix[:, 1, 2] = k[:, 2], k[:, 3]
    a = np.zeros((*neighbors.shape, 9), np.float32)
    b = np.zeros((*neighbors.shape, 3), np.float32)
    for m, row in enumerate(neighbors):
        inverse = np.linalg.inv(matrix[m])
        for j, s in enumerate(row):
            if s >= 0:
                turn = rotation[s] @ rotation[m].T
                a[m, j] = (matrix[s] @ turn @ inverse).ravel()
                b[m, j] = matrix[s] @ (translation[s] - turn @ translation[m])
    return a, b


def _closed_cells(
    views: Sequence[DenseView],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    cell_px: int,
    width: NDArray[np.int32],
    height: NDArray[np.int32],
) -> NDArray[np.uint8]:
    """(G,) uint8, 1 where the mask of the view is closed at the middle of the cell."""
    parts = []
    for m, view in enumerate(views):
        if view.mask is None:
            parts.append(np.zeros(int(columns[m]) * int(rows[m]), bool))
            continue
        x = ((np.arange(columns[m]) + 0.5) * cell_px * view.width / width[m]).astype(np.int64).clip(0, view.width - 1)
        y = ((np.arange(rows[m]) + 0.5) * cell_px * view.height / height[m]).astype(np.int64).clip(0, view.height - 1)
        parts.append(~view.mask[np.ix_(y, x)].ravel())
    return np.concatenate(parts).astype(np.uint8)
