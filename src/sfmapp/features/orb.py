"""ORB (Rublee, Rabaud, Konolige and Bradski, ICCV 2011) by OpenCV: a tenth of SIFT's time, less exact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_PATCH_PX = 31
# radius of the patch over the sigma of a blob that fills it: makes the scales comparable to SIFT's
_PATCH_PER_SIGMA = 12.0


def extract_orb(
    gray: NDArray[np.uint8], usable: NDArray[np.bool_] | None, *, max_num_features: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Detect and describe.

    Args:
        gray: (H, W) uint8.
        usable: (H, W) bool, False where nothing may be detected; None for everywhere.
        max_num_features: the strongest so many are kept.

    Returns:
        (N, 4) float32 x, y in COLMAP's pixels, scale in pixels, orientation in radians, largest scale first;
        (N, 32) uint8 of packed bits.
    """
    import cv2

    orb = cv2.ORB_create(max_num_features, patchSize=_PATCH_PX, fastThreshold=7)
    mask = None if usable is None else usable.astype(np.uint8)
    found, descriptors = orb.detectAndCompute(gray, mask)
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 32), np.uint8)
    keypoints = np.array([(*k.pt, k.size / _PATCH_PER_SIGMA, k.angle) for k in found], np.float32)
    keypoints[:, :2] += 0.5
    keypoints[:, 3] = np.deg2rad(keypoints[:, 3])
    order = np.lexsort((keypoints[:, 3], keypoints[:, 1], keypoints[:, 0], -keypoints[:, 2]))
    return keypoints[order], descriptors[order]
