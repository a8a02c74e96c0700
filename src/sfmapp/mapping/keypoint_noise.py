"""How sure keypoints are, by the residuals that a map leaves, whatever their distribution is and however short tracks
are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import make_engine
from sfmapp.scene.reconstruction import Reconstruction


class KeypointNoise(NamedTuple):
    """Standard deviations of a pixel coordinate.

    Attributes:
        sigma_px: of squares that tell as much as the observations do under the loss: what covariances follow from.
        robust_px: what observations have to be weighed by, under the loss, beside factors of other kinds.
    """

    sigma_px: float
    robust_px: float


def keypoint_noise(
    reconstruction: Reconstruction, options: AdjustOptions, varying: Varying, at_least: float
) -> KeypointNoise:
    """The noise of the keypoints of a map that was adjusted with a loss.

    An M-estimate with the score psi has the covariance ``E[psi^2] / E[psi']^2 (J^T J)^-1``, and its normal equations
    are ``E[psi'] J^T J``; as many residuals as were fitted say nothing of it, and the others are drawn in by the fit
    (Huber 1981, section 7.6, with its factor K). Squares make of this the sum of squares by its degrees of freedom.

    Args:
        options: its loss, and which intrinsics are free. varying: what else is.
        at_least: standard deviations are not believed to be smaller.
    """
    redundancy = make_engine(reconstruction, options, varying).degrees_of_freedom
    residuals = reconstruction.residuals_px()[reconstruction.obs_is_inlier]
    squares = (residuals[np.isfinite(residuals).all(1)] ** 2).sum(1)
    if redundancy <= 0 or not len(squares):
        return KeypointNoise(at_least, at_least)
    bend = options.loss_scale_px**2
    # weight of a residual, and half the divergence of the score, which is the mean slope along the two coordinates
    if options.loss == "cauchy":
        weight = 1.0 / (1.0 + squares / bend)
        slope = weight**2
    elif options.loss == "huber":
        weight = np.sqrt(bend / np.maximum(squares, bend))
        slope = np.where(squares <= bend, 1.0, 0.5 * weight)
    else:
        weight = slope = np.ones(len(squares))
    mean_slope, fitted_share = float(slope.mean()), 1.0 - redundancy / (2 * len(squares))
    drawn_in = 1.0 + fitted_share * float(slope.var()) / mean_slope**2
    sigma = drawn_in * float(np.sqrt((weight**2 * squares).sum() / redundancy)) / mean_slope
    return KeypointNoise(max(sigma, at_least), max(sigma * float(np.sqrt(mean_slope)), at_least))
