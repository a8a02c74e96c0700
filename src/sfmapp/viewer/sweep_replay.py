"""What the recording of swept depth maps is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Float32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class SweepReplay(HandedOver):
    """V maps and the points that are drawn of them. Places are world, less ``origin``.

    Attributes:
        title: shown in the viewer. story: in words, Markdown. map_texts: of each map.
        up: (3,) direction. origin: (3,) float64.
        names: V photographs. cam_from_world: (V, 7), in the world that begins at ``origin``.
        k: (V, 4) and size: (V, 2) of the pictures.
        jpeg: (B,) uint8, files one after the other: of each map photograph, depth and sigma.
        jpeg_ptr: (3 V + 1,) their limits.
        xyz: (N, 3). rgb: (N, 3) of the photographs. sigma_rgb: (N, 3) colours of sigma as a share of the depth.
        radius: (N,) half of what a shown pixel measures there.
        map_ptr: (V + 1,) the points of map v are ``map_ptr[v]:map_ptr[v + 1]``.
        cell_xyz, cell_rgb: (M, 3) middles of the cells that hold a feature, the brighter the more photographs say so;
            no rows without a volume. cell: side of one. box: (2, 3) lower and upper corner of the volume.
    """

    title: str
    story: str
    map_texts: list[str]
    up: NDArray[np.float64]
    origin: NDArray[np.float64]
    names: list[str]
    cam_from_world: NDArray[np.float64]
    k: NDArray[np.float64]
    size: Ints
    jpeg: Pixels
    jpeg_ptr: Ints
    xyz: Float32
    rgb: Pixels
    sigma_rgb: Pixels
    radius: Float32
    map_ptr: Ints
    cell_xyz: Float32
    cell_rgb: Pixels
    cell: float
    box: Float32
