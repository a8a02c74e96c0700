"""What a recording of a calibration is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import load_fields, save_fields

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationReplay:
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

    def save(self, folder: Path) -> None:
        """Write it to a folder, for the process that draws."""
        save_fields(folder, "calibration", self)

    @classmethod
    def load(cls, folder: Path) -> CalibrationReplay:
        """What :meth:`save` wrote."""
        return cls(**load_fields(folder, "calibration"))
