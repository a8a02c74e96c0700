"""What a recording of a calibration is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationReplay(HandedOver):
    """What is drawn.

    Attributes:
        title: shown in the viewer.
        names: of V views.
        size, focal, center: (2,) each, of the camera, pixels.
        ptr: (V + 1) int64, residuals of view v are ``ptr[v]:ptr[v + 1]``.
        xy, residuals: (N, 2) pixels. is_used: (N,) bool.
        corners: (V, 4, 3) outline of each board in the camera's frame.
        paths: of the photographs, empty for none.
    """

    title: str
    names: list[str]
    size: Array
    focal: Array
    center: Array
    ptr: NDArray[np.int64]
    xy: Array
    residuals: Array
    is_used: NDArray[np.bool_]
    corners: Array
    paths: list[str]
