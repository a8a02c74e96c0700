"""Contradictions between measured positions and a model: what no choice of wrong positions resolves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.errors import listed
from sfmapp.geometry import rigid3
from sfmapp.georeference.consensus import Rival
from sfmapp.georeference.fit import Similarity
from sfmapp.georeference.robust_fit import RobustFit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Where fewer positions agree, they and the model contradict each other, and nothing tells which of them is right.
MIN_AGREEING = 0.6
# Stated sigmas are refuted where residuals are so many times as large: nobody calls three sigmas noise. What receivers
# leave out (the lever arm to the camera, the shutter) may make as much of a survey by RTK, and is as wrong there.
REFUTED_FACTOR = 3.0
# A guess of some metres is refuted by what is worse than any receiver under open sky or between houses.
_NO_RECEIVER_FACTOR = 5.0
_ADVICE = "see Positions for those that are off; --set gps.source=none leaves all of them out"
_SUBJECT = "positions"


def find_disagreement(
    fit: RobustFit, is_stated: Mask, names: Sequence[str], of_model: str, refuted_factor: float = REFUTED_FACTOR
) -> Contradiction | None:
    """What positions that were fitted say against a model or against each other; None where they can all be right but
    for those that the fit leaves out.

    Args:
        is_stated: (2,) bool, as of :func:`~sfmapp.georeference.robust_fit.robust_fit`.
        names: n, of the photographs.
        of_model: which model it is, in words.
        refuted_factor: on stated sigmas that refutes them.
    """
    num, agreeing = len(fit.is_inlier), int(fit.is_inlier.sum())
    if agreeing < MIN_AGREEING * num:
        return Contradiction(
            _SUBJECT,
            f"only {agreeing} of {num} positions of photographs agree with {of_model}",
            f"wrong positions, or a wrong model; {_ADVICE}",
            {"num_positions": num, "num_agreeing": agreeing},
        )
    if fit.rival is not None:
        return _undecided(fit, fit.rival, names, of_model)
    for k, what in enumerate(("horizontally", "in height")):
        if fit.factor[k] > (refuted_factor if is_stated[k] else _NO_RECEIVER_FACTOR):
            return _too_small(fit, k, what, of_model, is_stated=bool(is_stated[k]))
    return None


def _too_small(fit: RobustFit, k: int, what: str, of_model: str, *, is_stated: bool) -> Contradiction:
    found = float(np.median(fit.sigma[fit.is_inlier, 2 * k]))
    stated = found / fit.factor[k]
    said = "are said to be good" if is_stated else "of a usual receiver are good"
    return Contradiction(
        _SUBJECT,
        f"positions of photographs that {said} to {stated:.2g} m {what} differ by {found:.3g} m from {of_model}",
        _ADVICE,
        {"stated_sigma_m": stated, "sigma_m": found, "factor": fit.factor[k]},
    )


def _undecided(fit: RobustFit, rival: Rival, names: Sequence[str], of_model: str) -> Contradiction:
    first, second = ([names[i] for i in np.flatnonzero(~used).tolist()] for used in (fit.is_inlier, rival.is_inlier))
    turn, scale, shift = _between(fit.similarity, rival.similarity)
    return Contradiction(
        _SUBJECT,
        f"positions of photographs do not all agree with {of_model}, and which are wrong is open: "
        f"{_listed(first)}, or {_listed(second)}",
        _ADVICE,
        {"wrong": first, "or_wrong": second, "log_odds": rival.log_odds, "shift_m": shift},
        rotation_sigma_deg=turn,
        scale_sigma=scale,
    )


def _between(a: Similarity, b: Similarity) -> tuple[float, float, float]:
    """Angle in degrees, logarithm of the scale and distance of the middles between two similarities."""
    turn = np.linalg.norm(rigid3.log_so3(a.rotation @ b.rotation.T))
    shift = np.linalg.norm(b.apply(a.origin[None])[0] - a.mean)
    return float(np.degrees(turn)), abs(float(np.log(a.scale / b.scale))), float(shift)


def _listed(names: Sequence[str]) -> str:
    if not names:
        return "none of them, and all are poor"
    return listed(names)
