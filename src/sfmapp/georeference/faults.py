"""What is wrong with positions that do not fit the model: named, so that it can be put right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.georeference.robust_fit import MAX_CHI2
from sfmapp.georeference.tags import Tags

Array = NDArray[np.float64]

# A tag that is farther off than this is in another place, whatever the sigma, in metres.
_ELSEWHERE_M = 1000.0


def name_faults(
    tags: Tags, n: NDArray[np.int64], adjusted: Array, sigma: Array, is_inlier: NDArray[np.bool_], names: Sequence[str]
) -> list[str]:
    """For each of some tags what is wrong with it, empty for those that fit.

    Args:
        n: (m,) positions in the tags; names: of their photographs.
        adjusted: (m, 3) where the photographs place the cameras, in the frame.
        sigma: (m, 3) of the tags.
        is_inlier: (m,) bool.
    """
    reasons = [""] * len(n)
    wrong = np.flatnonzero(~is_inlier)
    swapped = _swapped(tags.places[n], adjusted, sigma, wrong)
    for k in wrong.tolist():
        if k in swapped:
            reasons[k] = f"its position and that of {names[swapped[k]]} are exchanged"
        else:
            reasons[k] = _reason(tags, int(n[k]), adjusted[k], sigma[k])
    return reasons


def _fits(places: Array, adjusted: Array, sigma: Array) -> NDArray[np.bool_]:
    squares = np.nansum(((places - adjusted) / sigma) ** 2, axis=-1)
    fits: NDArray[np.bool_] = squares <= MAX_CHI2
    return fits


def _swapped(places: Array, adjusted: Array, sigma: Array, wrong: NDArray[np.int64]) -> dict[int, int]:
    """Pairs of wrong tags that fit once they are exchanged."""
    pairs: dict[int, int] = {}
    for k in wrong.tolist():
        for m in wrong.tolist():
            if k >= m or k in pairs or m in pairs:
                continue
            both = [k, m]
            if _fits(places[both[::-1]], adjusted[both], sigma[both]).all():
                pairs |= {k: m, m: k}
    return pairs


def _reason(tags: Tags, n: int, adjusted: Array, sigma: Array) -> str:
    latitude, longitude, height = tags.geodetic[n]
    filled = tags.frame.height_m if np.isnan(height) else height
    others = {
        "its latitude has lost its hemisphere": (-latitude, longitude),
        "its longitude has lost its hemisphere": (latitude, -longitude),
        "its latitude and longitude have lost their hemispheres": (-latitude, -longitude),
        "its latitude and longitude are exchanged": (longitude, latitude),
    }
    for reason, (north, east) in others.items():
        place = tags.frame.enu_from_geodetic([[north, east, filled]])
        if abs(north) <= 90 and _fits(place, adjusted[None], sigma[None])[0]:
            return reason
    off = tags.places[n] - adjusted
    flat, up = float(np.hypot(*off[:2])), float(np.nan_to_num(off[2]))
    if flat > _ELSEWHERE_M:
        return f"it lies in another place, {flat / 1000:.1f} km from where the photographs put it"
    if (off[:2] ** 2 / sigma[:2] ** 2).sum() <= MAX_CHI2:
        return f"its height is {abs(up):.1f} m too {'high' if up > 0 else 'low'}, {abs(up) / sigma[2]:.0f} sigma"
    share = np.sqrt(np.nansum((off / sigma) ** 2))
    return f"it lies {np.hypot(flat, up):.1f} m from where the photographs put it, {share:.0f} sigma"
