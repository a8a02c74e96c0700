"""One of two photographs: its name, what is known of its camera, its features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.scene.features import Features

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """One of the two photographs."""

    name: str
    camera: Camera
    features: Features

    @property
    def xy(self) -> Array:
        """(N, 2) keypoints."""
        return self.features.keypoints[:, :2].astype(np.float64)
