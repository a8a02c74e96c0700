"""A first focal length from fundamental matrices, where neither the user nor EXIF knows one.

For the right focal, E = K^T F K has two equal singular values. Their relative difference, summed robustly over many
pairs, is searched along one dimension (Mendonca and Cipolla, "A simple technique for self-calibration", CVPR 1999).
One pair says little, and nothing where the optical axes meet; hundreds together with a wide prior are a good start
for the adjustment, which does the rest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.scene.camera import Camera
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig

# Multiples of max(width, height): 130 to 11 degrees of view across the longer side.
FOCAL_RATIOS = np.geomspace(0.25, 5.0, 121)
# Log-normal prior around the default 1.2 max(w, h): one sigma reaches from 0.66 to 2.2, phone wide to short tele.
PRIOR_RATIO, PRIOR_LOG_SIGMA = 1.2, 0.6
# Relative difference of the singular values that noise alone makes, and where a pair counts as an outlier.
NOISE, OUTLIER = 0.05, 3.0


def essential_asymmetry(fundamental: NDArray[np.float64], ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, K) relative differences (s1 - s2) / s1 of the singular values of E = K^T F K.

    Args:
        fundamental: (P, 3, 3) float64, for pixels with the origin at the principal point, in units of the longer side.
        ratios: (K,) focal lengths in the same unit.
    """
    diagonal = np.stack([ratios, ratios, np.ones_like(ratios)], -1)
    essential = diagonal[None, :, :, None] * fundamental[:, None] * diagonal[None, :, None, :]
    singular = np.linalg.svd(essential, compute_uv=False)
    return (singular[..., 0] - singular[..., 1]) / np.maximum(singular[..., 0], 1e-300)


def estimate_focal_ratio(
    cameras: list[Camera], image_camera_idx: NDArray[np.int32], correspondences: Correspondences
) -> tuple[float | None, dict[str, Any]]:
    """The focal length as a multiple of max(width, height) that the pairs of default cameras agree on.

    Args:
        cameras, image_camera_idx: of the images; only cameras whose focal_source is ``default`` take part.
        correspondences: verified pairs with fundamental matrices.

    Returns:
        The ratio, or None where the pairs do not prefer one clearly to the default, and the decision's numbers.
    """
    unknown = np.array([c.focal_source == "default" and not c.is_fixed for c in cameras], bool)
    pairs = np.flatnonzero(
        unknown[image_camera_idx[correspondences.pair_image_idx]].all(axis=1)
        & (correspondences.config == TwoViewConfig.UNCALIBRATED)
        & np.isfinite(correspondences.fundamental[:, 0, 0])
    )
    # the best supported pairs are enough, and bound the time on large sets
    pairs = pairs[np.argsort(-correspondences.num_inliers[pairs], kind="stable")][:500]
    if len(pairs) == 0:
        return None, {"num_pairs": 0}
    centred = np.empty((len(pairs), 3, 3))
    for n, p in enumerate(pairs):
        first, second = (cameras[image_camera_idx[i]] for i in correspondences.pair_image_idx[p])
        centred[n] = _pixels_from_ratio(second).T @ correspondences.fundamental[p] @ _pixels_from_ratio(first)
    asymmetry = essential_asymmetry(centred, FOCAL_RATIOS)
    cost = np.minimum(asymmetry / NOISE, OUTLIER) ** 2
    # more matches make a better F; the square root keeps one strong pair from drowning the rest
    weight = np.sqrt(correspondences.num_inliers[pairs])
    total = (weight / weight.mean()) @ cost + (np.log(FOCAL_RATIOS / PRIOR_RATIO) / PRIOR_LOG_SIGMA) ** 2
    best = int(np.argmin(total))
    at_default = float(np.interp(PRIOR_RATIO, FOCAL_RATIOS, total))
    data = {
        "num_pairs": len(pairs), "ratio": float(FOCAL_RATIOS[best]), "cost": float(total[best]),
        "cost_at_default": at_default,
    }  # fmt: skip
    # half the cost is a log-likelihood: 9 less is three standard deviations away from the default
    return (float(FOCAL_RATIOS[best]) if at_default - total[best] > 9.0 else None), data


def _pixels_from_ratio(camera: Camera) -> NDArray[np.float64]:
    """(3, 3) matrix from coordinates centred and scaled by the longer side to pixels."""
    size = float(max(camera.width, camera.height))
    return np.array([[size, 0.0, camera.canonical[2]], [0.0, size, camera.canonical[3]], [0.0, 0.0, 1.0]])
