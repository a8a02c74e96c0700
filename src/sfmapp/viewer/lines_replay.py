"""What a recording of a calibration from lines is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class LinesReplay(HandedOver):
    """What is drawn.

    Attributes:
        title: shown in the viewer.
        names: of V photographs. paths: of these.
        size, focal, center: (2,) each, of the camera, pixels.
        ptr: (V + 1) lines of photograph v are ``ptr[v]:ptr[v + 1]``.
        points: (N, K, 2) pixels along each line. member: (N,) its direction, -1 for none.
        rays: (N, 2, 3) unit rays of its two ends in the camera's frame; with the camera's centre they are the
            projection plane.
        direction_ptr: (V + 1) into directions (D, 3), unit vectors in the camera's frame.
    """

    title: str
    names: list[str]
    paths: list[str]
    size: Array
    focal: Array
    center: Array
    ptr: Ints
    points: Array
    member: Ints
    rays: Array
    direction_ptr: Ints
    directions: Array
