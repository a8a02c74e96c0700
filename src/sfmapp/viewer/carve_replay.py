"""What the recording of a carved volume is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Float32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class CarveReplay(HandedOver):
    """What is drawn. Places are world, less ``middle``.

    Attributes:
        title: shown in the viewer. story: in words, Markdown.
        up: (3,) direction. middle: (3,) of the cube, world.
        levels: numbers of those that are drawn. level_texts: what became of the cells of each.
        corner_ptr, face_ptr: (L + 1,) int64, those of level l are ``corners[corner_ptr[l]:corner_ptr[l + 1]]`` (N, 3)
            and ``faces[face_ptr[l]:face_ptr[l + 1]]`` (F, 3), which count from its own first corner.
        corner_rgb: (N, 3), cells wholly inside in one colour and cells that are split in another.
        mesh_xyz, mesh_normal, mesh_rgb, mesh_faces: the surface.
        frusta: (V, 5, 3) centre and corners of each camera's frustum. camera_names: V of them.
        photos: (P, H, W, 3) some photographs with their silhouettes. photo_names: P of them.
    """

    title: str
    story: str
    up: NDArray[np.float64]
    middle: NDArray[np.float64]
    levels: list[int]
    level_texts: list[str]
    corner_ptr: NDArray[np.int64]
    face_ptr: NDArray[np.int64]
    corners: Float32
    corner_rgb: Pixels
    faces: NDArray[np.int32]
    mesh_xyz: Float32
    mesh_normal: Float32
    mesh_rgb: Pixels
    mesh_faces: NDArray[np.int32]
    frusta: Float32
    camera_names: list[str]
    photos: Pixels
    photo_names: list[str]
