"""Makes the picture of two volumes of which fourteen photographs are the same, for the page on volumes.

python docs/make_two_scenes.py

A painted block with a plain trough is photographed as cells, exactly, and what voxel colouring finds in the photographs
is photographed again: the same bytes of another shape.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.carve.cell_grid import CellGrid
from sfmapp.carve.octree import Octree
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, view_of_camera
from sfmapp.carve.voxel_coloring import VoxelOptions, carve_by_color, shown_cells
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

PICTURE = Path(__file__).resolve().parent / "pictures" / "two-volumes.png"
CELLS, VIEWS, SHOWN = 64, 14, 0
DISTANCE, ELEVATION = 5.0, np.radians(35.0)
PLAIN, SKY = (120, 90, 60), (255, 255, 255)
SIZE = 320


def main() -> None:
    """Photograph, carve, photograph again, draw."""
    places = np.stack(np.meshgrid(*[np.arange(CELLS)] * 3, indexing="ij"), axis=-1)
    xyz = -1.0 + (places + 0.5) * 2.0 / CELLS
    block = (np.abs(xyz) < [0.7, 0.7, 0.5]).all(axis=-1)
    trough = (np.abs(xyz[..., :2]) < 0.35).all(axis=-1) & (xyz[..., 2] > -0.2)
    colors = np.empty((*block.shape, 3), np.uint8)
    phase = np.array([[6.0, 1.0, 2.0], [-1.0, 7.0, 3.0], [2.0, -2.0, 6.5]])
    colors[:] = 127.5 + 107.0 * np.sin(xyz @ phase + [0.0, 1.0, 2.0])
    colors[(np.abs(xyz[..., :2]) < 0.5).all(axis=-1)] = PLAIN
    scene, flat = grid_of_cells(block & ~trough), colors.reshape(-1, 3)
    views = [view(n) for n in range(VIEWS)]
    silhouettes, photographs = [], []
    for one in views:
        seen = shown_cells(scene, one)
        silhouettes.append(Silhouette(np.where(seen >= 0, np.float32(0.5), np.float32(-0.5))))
        photographs.append(np.where((seen >= 0)[..., None], flat[seen], np.uint8(255)).astype(np.uint8))
    exact = VoxelOptions(apart=1e-3, mixing=0.0, min_views=1, clear_px=0.0)
    found, _ = carve_by_color(grid_of_cells(np.ones_like(block)), views, silhouettes, photographs, exact)
    for one, photograph in zip(views, photographs, strict=True):
        if (found.photograph(one, SKY) != photograph).any():
            raise RuntimeError(f"{one.name}: the two volumes do not show the same")
    again = found.photograph(views[SHOWN], SKY)
    row = [photographs[SHOWN], cut(scene), again, cut(found.grid)]
    tiles = [cv2.resize(tile, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST) for tile in row]
    cv2.imwrite(str(PICTURE), np.hstack(tiles)[..., ::-1])


def grid_of_cells(filled: NDArray[np.bool_]) -> CellGrid:
    """Cells of a cube about the origin."""
    empty = np.empty(0, np.uint64)
    depth = CELLS.bit_length() - 1
    tree = Octree(np.full(3, -1.0), 2.0, depth, (empty,) * (depth + 1), empty)
    return CellGrid(tree, np.zeros(3, np.int64), filled.astype(np.uint8))


def view(n: int) -> View:
    """A camera that looks at the origin from above."""
    azimuth = 2.0 * np.pi * (n + 0.3) / VIEWS
    out = np.array([np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)])
    right = np.cross(-out, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.concatenate([rigid3.quaternion(np.stack([right, np.cross(-out, right), -out])), [0.0, 0.0, DISTANCE]])
    return view_of_camera(f"view {n}", simple_camera(CameraModel.PINHOLE, SIZE, SIZE, 2.0 * SIZE), pose)


def cut(grid: CellGrid) -> Pixels:
    """The middle slice from the side, upward, what is filled in grey."""
    slab = grid.filled[:, CELLS // 2].T[::-1]
    return np.where(slab[..., None] > 0, np.uint8(90), np.uint8(255)).repeat(3, axis=2)


if __name__ == "__main__":
    main()
