"""What extraction yields for one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Features:
    """Keypoints of one image, largest scale first (ties by x, then y), so that a prefix is the coarse subset.

    Attributes:
        keypoints: (N, 4) float32: x, y in COLMAP's pixels of the oriented, full-size image (top-left pixel centre at
            0.5, 0.5); scale in pixels (COLMAP's sigma); orientation in radians.
        descriptors: (N, 128) uint8 RootSIFT times 512 as COLMAP stores it, or (N, 32) uint8 packed bits for ORB.
        rgb: (N, 3) uint8 colour of the pixel under each keypoint.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    rgb: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.keypoints)
