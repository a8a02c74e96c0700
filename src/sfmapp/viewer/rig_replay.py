"""What a recording of a rig is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class RigReplay(HandedOver):
    """What is drawn.

    Attributes:
        title: shown in the viewer.
        names: of C cameras. sizes, focals, centers: (C, 2) each, pixels. cam_from_rig: (C, 7).
        camera, shot: (V,) of V boards in photographs, in the order of shots.
        corners: (V, 4, 3) outline of each board in the frame of the rig.
        ptr: (V + 1) int64, points of view v are ``ptr[v]:ptr[v + 1]``.
        xy, residuals: (N, 2) pixels. is_used: (N,) bool.
        paths: of the V photographs, empty for none.
        problems: why a photograph is not used with the others of its shot, empty for nothing.
    """

    title: str
    names: list[str]
    sizes: Array
    focals: Array
    centers: Array
    cam_from_rig: Array
    camera: Ints
    shot: Ints
    corners: Array
    ptr: Ints
    xy: Array
    residuals: Array
    is_used: NDArray[np.bool_]
    paths: list[str]
    problems: list[str]
