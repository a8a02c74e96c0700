"""What the recording of a model without a calibration is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import load_fields, save_fields

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CloudsReplay:
    """What is drawn.

    Attributes:
        title: shown in the viewer.
        found, mapped: (N, 3) the projective model, and its image under a map of space. metric: (N, 3), or (0, 3).
        rgb: (N, 3) uint8. centers: (V, 3) metric cameras.
    """

    title: str
    found: Array
    mapped: Array
    metric: Array
    rgb: NDArray[np.uint8]
    centers: Array

    def save(self, folder: Path) -> None:
        """Write it to a folder, for the process that draws."""
        save_fields(folder, "clouds", self)

    @classmethod
    def load(cls, folder: Path) -> CloudsReplay:
        """What :meth:`save` wrote."""
        return cls(**load_fields(folder, "clouds"))
