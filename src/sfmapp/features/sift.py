"""SIFT (Lowe, IJCV 2004) by OpenCV, with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# COLMAP's peak threshold: 0.02 over three layers of grey levels in [0, 1]
CONTRAST_THRESHOLD = 0.02
# a quarter of a grey level at the finest layer: below this an extremum is the rounding of the pixels
MIN_CONTRAST_THRESHOLD = 0.02 / 9


def extract_sift(
    gray: NDArray[np.uint8],
    usable: NDArray[np.bool_] | None,
    *,
    max_num_features: int,
    max_num_orientations: int,
    contrast_threshold: float,
    edge_threshold: float,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], float]:
    """Detect and describe.

    Args:
        gray: (H, W) uint8.
        usable: (H, W) bool, False where nothing may be detected; None for everywhere.
        max_num_features: the strongest so many are kept.
        max_num_orientations: descriptors at one place, at most.
        contrast_threshold: of the difference of Gaussians over an octave, for grey levels in [0, 1].
        edge_threshold: largest ratio of the principal curvatures.

    Returns:
        (N, 4) float32 x, y in house pixels, scale in pixels, orientation in radians (clockwise, as y points down),
        largest scale first; (N, 128) uint8 descriptors as COLMAP stores them; the contrast threshold in use.
    """
    import cv2

    threshold = contrast_threshold
    while True:
        sift = cv2.SIFT_create(0, 3, threshold, edge_threshold, 1.6, enable_precise_upscale=True)
        found = sift.detect(gray, None)
        rows = np.array([(*k.pt, k.size / 2, k.angle, k.response) for k in found], np.float32).reshape(-1, 5)
        keep = _select(rows, usable, max_num_features, max_num_orientations)
        if len(keep) >= max_num_features // 2 or threshold <= MIN_CONTRAST_THRESHOLD:
            break
        threshold /= 3.0
    if len(keep) == 0:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8), threshold
    _, descriptors = sift.compute(gray, [found[i] for i in keep])
    keypoints = rows[keep, :4].copy()
    keypoints[:, :2] += 0.5
    keypoints[:, 3] = np.deg2rad(keypoints[:, 3])
    return keypoints, root_sift(descriptors), threshold


def _select(
    rows: NDArray[np.float32], usable: NDArray[np.bool_] | None, max_num_features: int, max_num_orientations: int
) -> NDArray[np.int64]:
    """Positions of the rows (x, y, scale, angle, response) to keep, largest scale first, ties by x, y and angle."""
    keep = np.arange(len(rows))
    if usable is not None:
        height, width = usable.shape
        x = np.clip(np.rint(rows[:, 0]).astype(int), 0, width - 1)
        y = np.clip(np.rint(rows[:, 1]).astype(int), 0, height - 1)
        keep = keep[usable[y, x]]
    order = np.lexsort((*rows[keep, 3::-1].T[:3], -rows[keep, 4]))
    keep = keep[order][:max_num_features]
    keep = keep[np.lexsort((rows[keep, 3], rows[keep, 1], rows[keep, 0], -rows[keep, 2]))]
    place = rows[keep, :3]
    is_new = np.ones(len(keep), bool)
    is_new[1:] = np.any(place[1:] != place[:-1], axis=1)
    first = np.maximum.accumulate(np.where(is_new, np.arange(len(keep)), 0))
    return keep[np.arange(len(keep)) - first < max_num_orientations]


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(N, 128) uint8: 512 times the root of the L1-normalised descriptors, rounded and clipped as COLMAP does."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return np.clip(np.rint(512.0 * np.sqrt(descriptors / total)), 0, 255).astype(np.uint8)
