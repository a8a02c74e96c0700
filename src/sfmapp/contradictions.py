"""Evidence in hand that a result does not agree with: said in words, in numbers, and in every sigma that hangs on it.

The rule: a contradiction is resolved, or it is red in the report, named in the terminal, and widens the
stated uncertainty. Stages find contradictions; reports and the command line only show them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field

import numpy as np
from numpy.typing import NDArray

from sfmapp.reporting import Plain, Report

Array = NDArray[np.float64]


class Contradiction(Report, kw_only=False):
    """One piece of evidence that stands against a result and could not be resolved.

    Attributes:
        subject: what it contradicts, a few words, such as ``given calibration``.
        message: one sentence with the numbers: what says what, against what.
        advice: what the user can do about it; may be empty.
        evidence: the numbers and their limits, JSON-able and finite.
        rotation_sigma_deg: standard deviation, about each axis, that it adds to every pose.
        position_sigma_share: standard deviation, along each axis, that it adds to every position, as a share of the
            rms distance of the poses from their middle.
        scale_sigma: relative standard deviation that it adds to a unit of length in metres.
    """

    subject: str
    message: str
    advice: str = ""
    evidence: Mapping[str, Plain] = field(default_factory=dict)
    rotation_sigma_deg: float = 0.0
    position_sigma_share: float = 0.0
    scale_sigma: float = 0.0


def widened(covariance: Array, spread: float, contradictions: Sequence[Contradiction]) -> Array:
    """Covariances with what contradictions add to them, which are taken to be independent of each other.

    Args:
        covariance: (K, 6, 6) over rotation (radians) and translation of ``x_cam <- exp(w) x_cam + v``.
        spread: rms distance of the poses from their middle, in the unit of the translations.
        contradictions: that nothing has resolved.

    Returns:
        (K, 6, 6), NaN where the given ones are.
    """
    rotation = sum(np.radians(c.rotation_sigma_deg) ** 2 for c in contradictions)
    position = sum((c.position_sigma_share * spread) ** 2 for c in contradictions)
    return covariance + np.diag([rotation] * 3 + [position] * 3)


def widened_scale_sigma(scale_sigma: float | None, contradictions: Sequence[Contradiction]) -> float | None:
    """The relative standard deviation of a unit of length with what contradictions add to it; None stays None."""
    if scale_sigma is None:
        return None
    return float(np.sqrt(scale_sigma**2 + sum(c.scale_sigma**2 for c in contradictions)))
