"""What the recording of a model without a calibration is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CloudsReplay(HandedOver):
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
