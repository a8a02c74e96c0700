"""How far the closing adjustments move a model, against how sure it is said to be.

Squares over observations that pass a threshold, and a loss that lets go of what is far off the noise, are two estimates
of one thing. Under the noise that sigmas are made of they differ by less than these (Hausman, Econometrica 46, 1978).
Where moving things, mismatches between weakly tied parts or a lens that no model describes decide which observations
hold, they differ by more, and so would the next estimate: standard deviations grow.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfmapp.adjust.covariance import pose_errors_in_gauge
from sfmapp.events import Events
from sfmapp.mapping.mapper import STAGE
from sfmapp.mapping.report import ImageSigmas, Uncertainty
from sfmapp.scene.reconstruction import Reconstruction

# Noise with heavy tails (a third of the keypoints off by 2 px where 0.3 is the rule), also in few and partly wrong ties
# of two halves, moves cameras by up to 2.6 of standard deviations that hold nevertheless, as they count all squares;
# noise without tails by 0.3, six sets of photographs by 1.0 to 2.8.
COVERED_SIGMAS = 2.5
_FAR_SIGMAS = 2.0 * COVERED_SIGMAS


class ClosingMove(NamedTuple):
    """What closing adjustments did to the cameras, but for a similarity of the whole.

    Attributes:
        turn_deg: by image name, the angle. shift_share: the way of the centre as a share of the model's size, the
            largest distance of a centre from their middle.
    """

    turn_deg: dict[str, float]
    shift_share: dict[str, float]

    def in_sigmas(self, uncertainty: Uncertainty) -> float | None:
        """Rms over the images against their standard deviations, of turns or of shifts, the larger one; None where
        these are not known."""
        sigmas = uncertainty.images or {}
        names = [name for name in self.turn_deg if name in sigmas]
        if not names:
            return None
        turns = [self.turn_deg[name] / sigmas[name].rotation_sigma_deg for name in names]
        shifts = [self.shift_share[name] / sigmas[name].center_sigma_share for name in names]
        # sigmas are along and about one axis each, of three
        return float(max(np.sqrt(np.mean(np.square(ratio)) / 3.0) for ratio in (turns, shifts)))

    def widening(self, uncertainty: Uncertainty) -> float:
        """The factor, one or more, by which standard deviations grow: by the variance of what they do not cover."""
        return float(np.sqrt(1.0 + max((self.in_sigmas(uncertainty) or 0.0) ** 2 - COVERED_SIGMAS**2, 0.0)))


def closing_move(before: Reconstruction, after: Reconstruction) -> ClosingMove:
    """The move of images that are registered in both, in the gauge of :mod:`sfmapp.adjust.covariance`."""
    images = np.flatnonzero(before.is_registered & after.is_registered)
    if len(images) < 3:
        return ClosingMove({}, {})
    moved = pose_errors_in_gauge(after, before, images, 7)
    centers = after.centers[images]
    size = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    turn, shift = (np.linalg.norm(moved[:, half], axis=1) for half in (slice(0, 3), slice(3, 6)))
    names = [after.image_names[i] for i in images.tolist()]
    return ClosingMove(
        dict(zip(names, np.degrees(turn).tolist(), strict=True)),
        dict(zip(names, (shift / max(size, 1e-12)).tolist(), strict=True)),
    )


def widened_by_move(uncertainty: Uncertainty, move: ClosingMove, events: Events) -> Uncertainty:
    """The uncertainty with what the move says of it, which is warned of where it is far."""
    ratio, factor = move.in_sigmas(uncertainty), move.widening(uncertainty)
    if ratio is None:
        return uncertainty
    if ratio > _FAR_SIGMAS:
        events.warned(
            STAGE,
            "the model hangs on which observations are believed: the closing adjustments moved its cameras by "
            f"{ratio:.1f} of their standard deviations, which were widened by a factor of {factor:.1f}",
        )

    def grown(sigma: float | None) -> float | None:
        return None if sigma is None else factor * sigma

    cameras = None
    if uncertainty.cameras is not None:
        cameras = [replace(c, sigma={k: factor * v for k, v in c.sigma.items()}) for c in uncertainty.cameras]
    images = {
        name: ImageSigmas(
            center_sigma_share=factor * entry.center_sigma_share, rotation_sigma_deg=factor * entry.rotation_sigma_deg
        )
        for name, entry in (uncertainty.images or {}).items()
    }
    return replace(
        uncertainty,
        closing_move_sigmas=ratio,
        cameras=cameras,
        median_center_sigma_share=grown(uncertainty.median_center_sigma_share),
        worst_center_sigma_share=grown(uncertainty.worst_center_sigma_share),
        median_rotation_sigma_deg=grown(uncertainty.median_rotation_sigma_deg),
        images=images,
    )
