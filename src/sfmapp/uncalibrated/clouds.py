"""Point clouds of a model without a calibration, as page and recording show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Clouds:
    """What is drawn: (N, 3) points of the model as it was found, under a random map, and metric (None without); their
    colours (N, 3); (V, 3) metric camera centres."""

    found: Array
    mapped: Array
    metric: Array | None
    rgb: NDArray[np.uint8]
    centers: Array


def boxed(xyz: Array, others: Array) -> tuple[Array, Array]:
    """Points (N, 3) and others (K, 3) about their middle, nine in ten of the points within one unit; what is not finite
    or ten times as far goes to the origin."""
    finite = np.isfinite(xyz).all(1)
    middle = np.median(xyz[finite], axis=0) if finite.any() else np.zeros(3)
    lengths = np.linalg.norm(xyz - middle, axis=1)
    reach = float(np.percentile(lengths[finite], 90)) if finite.any() else 1.0
    scaled = (xyz - middle) / max(reach, 1e-300)
    scaled[~finite | (lengths > 10.0 * reach)] = 0.0
    return scaled, (others - middle) / max(reach, 1e-300)
