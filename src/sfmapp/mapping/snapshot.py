"""What mapping shows while it is under way: handed to the listeners as ``snapshot`` of its events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ModelSnapshot:
    """A model after a decision that changed it, with ``decided`` events of stage ``mapping``.

    Attributes:
        image_idx: images that the decision registered.
        num_registered, num_points, mean_error_px: of the model.
        cam_from_world: (I, 7), NaN where unregistered.
        point_xyz: (T, 3) float32, NaN where not triangulated; None where points are not shown.
    """

    image_idx: tuple[int, ...]
    num_registered: int
    num_points: int
    mean_error_px: float
    cam_from_world: NDArray[np.float64]
    point_xyz: NDArray[np.float32] | None = None
