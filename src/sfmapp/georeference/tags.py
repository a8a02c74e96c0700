"""Positions of photographs as arrays in a local frame, and what is wrong with them before any model is looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.coordinate_systems import HeightReference
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.report import Finding
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.position import Position

Array = NDArray[np.float64]

# What a phone under open sky reaches, along one axis; between houses it is two and three times that, which the
# residuals tell. A height is half as good: satellites are above only.
DEFAULT_SIGMA_M, UP_OVER_HORIZONTAL = 5.0, 2.0
# A height of exactly zero among others that lie so far from the sea, in metres, is none.
_FAR_FROM_SEA_M = 20.0


@dataclass(frozen=True)
class Tags:
    """Positions of n photographs.

    Attributes:
        image_idx: (n,) positions in the image set.
        geodetic: (n, 3) latitude, longitude in degrees, height in metres, NaN where unknown.
        places: (n, 3) in the frame, metres; heights NaN where unknown.
        sigma: (n, 3) metres; infinite for heights that are unknown.
        source: n, of each measurement.
        is_stated: (2,) bool: whether sigmas are more than weights, horizontally and vertically.
        first: (n,) the first of the tags that are the same to the last digit: a receiver that had no new fix, or that
            stood still, wrote the others, which are no measurements of their own.
        pitch_deg: (n,) of the optical axis above the horizon, as a gimbal says; NaN where none does.
        frame: about the middle of them.
        heights: what heights are above.
    """

    image_idx: NDArray[np.int64]
    geodetic: Array
    places: Array
    sigma: Array
    source: list[str]
    is_stated: NDArray[np.bool_]
    first: NDArray[np.int64]
    pitch_deg: Array
    frame: LocalFrame
    heights: HeightReference


def tags_of(records: Sequence[ImageRecord], options: GpsOptions) -> tuple[Tags | None, list[Finding]]:
    """The positions of photographs, and what is wrong with them; None where they say nothing of where cameras were."""
    known = [(i, record.position) for i, record in enumerate(records) if record.position is not None]
    if not known:
        return None, []
    positions = [position for _, position in known]
    geodetic = np.array([[p.latitude_deg, p.longitude_deg, _or_nan(p.height_m)] for p in positions])
    findings: list[Finding] = []
    if len(known) > 1 and (np.ptp(geodetic[:, :2], axis=0) < 1e-9).all():
        findings.append(
            Finding(images=[], message=f"all {len(known)} photographs carry the same position, which is left aside")
        )
        return None, findings
    names = [records[i].name for i, _ in known]
    first = _first_of_same(geodetic)
    repeated = [name for name, n, k in zip(names, first, range(len(first)), strict=True) if n != k]
    if repeated:
        text = "the same position as an earlier photograph, to the last digit: no new measurement, and left aside"
        findings.append(Finding(images=repeated, message=text))
    findings += _without_false_heights(geodetic, names)
    sigma = np.array([[_or_nan(p.sigma_m), _or_nan(p.sigma_up_m)] for p in positions])
    is_stated = np.array([all(p.is_stated for p in positions)] * 2)
    for k, given in enumerate((options.sigma_m, options.sigma_up_m)):
        if given is not None:
            sigma[:, k], is_stated[k] = given, True
    sigma[np.isnan(sigma[:, 0]), 0] = DEFAULT_SIGMA_M
    missing = np.isnan(sigma[:, 1])
    sigma[missing, 1] = UP_OVER_HORIZONTAL * sigma[missing, 0]
    is_stated &= [True, not missing.any()]
    sigma[np.isnan(geodetic[:, 2]), 1] = np.inf
    with_height = geodetic[np.isfinite(geodetic[:, 2]), 2]
    middle = np.median(geodetic[:, :2], axis=0).round(7)
    height = float(np.median(with_height).round(3)) if len(with_height) else 0.0
    frame = LocalFrame(float(middle[0]), float(middle[1]), height)
    filled = np.where(np.isnan(geodetic), height, geodetic)
    places = frame.enu_from_geodetic(filled)
    places[np.isnan(geodetic[:, 2]), 2] = np.nan
    kinds = {p.heights for p in positions if p.height_m is not None}
    heights: HeightReference = kinds.pop() if len(kinds) == 1 else "unknown"
    index = np.array([i for i, _ in known], np.int64)
    sources = [p.source for p in positions]
    pitch = np.array([_gimbal_pitch(records[i].orientation, p) for i, p in known])
    return Tags(
        index, geodetic, places, sigma[:, [0, 0, 1]], sources, is_stated, first, pitch, frame, heights
    ), findings


def _first_of_same(geodetic: Array) -> NDArray[np.int64]:
    """(n,) for each position the first that is equal to it."""
    _, first, number = np.unique(np.nan_to_num(geodetic, nan=-1e9), axis=0, return_index=True, return_inverse=True)
    return first[number.ravel()].astype(np.int64)


def _gimbal_pitch(orientation: int, position: Position) -> float:
    """Of XMP alone, where it means the same with every maker; NaN for what is rolled or turned."""
    attitude = position.attitude_deg
    if position.source != "XMP" or attitude is None or orientation != 1:
        return np.nan
    return attitude[1] if abs(attitude[2]) < 10.0 and abs(attitude[1]) <= 90.0 else np.nan


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _without_false_heights(geodetic: Array, names: list[str]) -> list[Finding]:
    """Take out heights that are none, in place, and say so."""
    height = geodetic[:, 2]
    given = np.isfinite(height)
    if not given.any():
        return [Finding(images=[], message="no position has a height: how high the model lies is unknown")]
    is_zero = given & (height == 0.0)
    others = np.abs(height[given & ~is_zero])
    if is_zero.sum() > 1 and not len(others):
        geodetic[:, 2] = np.nan
        return [
            Finding(images=[], message="all heights are zero, which is what is written for none: they are left aside")
        ]
    if is_zero.any() and len(others) and np.median(others) > _FAR_FROM_SEA_M:
        geodetic[is_zero, 2] = np.nan
        who = [name for name, zero in zip(names, is_zero, strict=True) if zero]
        return [Finding(images=who, message="a height of zero among others far from it is none, and left aside")]
    if given.sum() > 2 and np.ptp(height[given]) == 0.0:
        text = f"all heights are {height[given][0]:g} m: a receiver that knows them seldom gives the same one twice"
        return [Finding(images=[], message=text)]
    return []
