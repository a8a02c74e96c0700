"""Measured places of cameras as gtsam factors, for the adjustment of a model that lies in the frame already."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from sfmapp.georeference.fit import UNKNOWN_M, LevelOfImage

Array = NDArray[np.float64]

# Huber's loss bends here, in standard deviations, where it costs nothing. What is grossly wrong was left out before.
_HUBER_SIGMAS = 3.0


def position_graph(image_idx: NDArray[np.int64], places: Array, sigma: Array, level: LevelOfImage | None = None) -> Any:
    """A gtsam.NonlinearFactorGraph that holds the centres of images (n,) at places (n, 3).

    Args:
        sigma: (n, 3) metres; infinite where a height is unknown, which is then held to 0, loosely.
        level: more about the vertical.
    """
    graph = gtsam.NonlinearFactorGraph()
    known = np.isfinite(sigma)
    for i, place, one in zip(
        image_idx.tolist(), np.where(known, places, 0.0), np.where(known, sigma, UNKNOWN_M), strict=True
    ):
        noise = gtsam.noiseModel.Diagonal.Sigmas(one)
        huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_SIGMAS)
        graph.push_back(gtsam.GPSFactor(X(i), place, gtsam.noiseModel.Robust.Create(huber, noise)))
    if level is not None:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, level.level.sigma_rad)
        graph.push_back(
            gtsam.AttitudeFactorPose3(
                X(level.image_idx), gtsam.Unit3(0.0, 0.0, 1.0), noise, gtsam.Unit3(level.level.up)
            )
        )
    return graph
