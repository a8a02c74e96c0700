"""Photographs whose rotations are known: what the stage that finds them hands to that which draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class TurnedPhotographs:
    """Photographs from one place.

    Attributes:
        image_idx: (K,) positions in the image set, ascending.
        cameras: those of the set, refined, and behind them one for each further zoom.
        camera_idx: (K,) positions in ``cameras``.
        rotations: (K, 3, 3) cam_from_world; in the world y is down, and z looks at the middle of the panorama.
        sigma_deg: (K, 3) about the axes of each camera.
        other_groups: positions of photographs that were turned as well, each group from a place of its own, or without
            overlap with these; the largest first.
    """

    image_idx: Ints
    cameras: list[Camera]
    camera_idx: Ints
    rotations: Array
    sigma_deg: Array
    other_groups: Sequence[Ints]
