"""What the clock of photographs is off that of a track, by the way that cameras moved.

Photographs tell where cameras were but for a similarity; a track tells where the receiver was at every time. The offset
is that by which the one fits the other best. A way that is straight and steady looks the same at any time and tells
nothing; turns, stops and loops tell it. A constant error of heights does not show beside a track: the model follows it.
With control points it does, and is a variable of that adjustment (:mod:`sfmapp.georeference.control.stage`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.drift import estimate_drift, similarity_slope
from sfmapp.georeference.fit import closed_form, fit_similarity
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.report import ClockReport
from sfmapp.georeference.robust_fit import RobustFit, robust_fit
from sfmapp.georeference.sources import places_along, read_positions, with_positions
from sfmapp.images.image_set import ImageSet
from sfmapp.mapping.mapper import Mapper

Array = NDArray[np.float64]

STAGE = "georeference"
# Offsets are looked for within this many seconds of what was given, in steps of the second: beyond it a camera is in
# another time zone, which the user is told to say. A receiver writes a fix a second.
_RANGE_S, _STEP_S = 90.0, 0.5
# An offset is believed from so many of its standard deviations on.
_CLEAR_SIGMAS = 3.0
# Seven unknowns of a similarity and the offset; of each photograph three numbers.
_LEAST = 10
# Photographs that must lie on the track at an offset for it to be tried, as a share of those that do as given.
_ON_TRACK = 0.9
# Twice the log likelihood that another place on the grid has to gain: four standard deviations.
_CLEAR_GAIN = 16.0
# Turns tell the offset if they are so many times what noise makes of a straight way.
_OVER_NOISE = 4.0
# Fixes on either side that a smoothed track may lean on, within so many seconds; share of the fixes that is asked.
_REACHES, _LONGEST_FIT_S, _TRIMMED = (2, 4, 8, 12), 15.0, 0.9
_LONGEST_STEP_S, _MAX_ROUNDS = 1.0, 24


def settle_clock(
    mappers: Sequence[Mapper], image_set: ImageSet, options: GpsOptions, events: Events
) -> tuple[ImageSet, ClockReport | None]:
    """Photographs with positions along their track at the offset that the largest model tells; as they were, where it
    tells none or positions are of no track."""
    if options.source in ("exif", "none") or not mappers:
        return image_set, None
    track = np.array(read_positions(Path(options.source)).track)
    if not len(track):
        return image_set, None
    model = mappers[0].reconstruction
    known = [i for i, record in enumerate(image_set.images) if model.is_registered[i] and record.position is not None]
    times = np.array([image_set.images[i].timestamp for i in known], np.float64) + options.time_offset_s
    found = find_offset(_in_metres(track), times, model.centers[known])
    report = replace(found, given_s=options.time_offset_s)
    if not found.is_applied or found.offset_s is None:
        events.decided(STAGE, f"the clock of the photographs is left as it is: {found.reason}", **report)
        return image_set, report
    text = f"the clock of the photographs is {found.offset_s:+.2f} s (+- {found.sigma_s:.2g}) off that of the track"
    events.warned(STAGE, f"{text}: they were moved along it")
    shifted = replace(options, time_offset_s=options.time_offset_s + found.offset_s)
    return with_positions(image_set, shifted), report


def find_offset(track: Array, times: Array, centers: Array) -> ClockReport:
    """What is to be added to times of photographs to get those of a track.

    Args:
        track: (T, 4) seconds, metres east, north, up (NaN where unknown), ascending; times: (n,) seconds.
        centers: (n, 3) of the cameras in a model.
    """
    on_track = np.isfinite(places_along(track[:, :2], times)[:, 0])
    times, centers = times[on_track], centers[on_track]
    if len(times) < _LEAST:
        return _untold(f"{len(times)} of its photographs lie on the track, {_LEAST} are needed")
    way = _smoothed(track)
    found = _refined(way, times, centers, _nearest(way, times, centers))
    if found is None:
        return _untold("the way of the cameras does not tell")
    offset, sigma = found
    if abs(offset) <= _CLEAR_SIGMAS * sigma:
        return ClockReport(
            given_s=0.0, offset_s=offset, sigma_s=sigma, is_applied=False,
            reason=f"it is right within {sigma:.2g} s, which is what the way of the cameras tells",
        )  # fmt: skip
    if abs(offset) > _RANGE_S:
        return _untold(f"nothing within {_RANGE_S:.0f} s fits better")
    return ClockReport(given_s=0.0, offset_s=offset, sigma_s=sigma, is_applied=True, reason="")


def _untold(reason: str) -> ClockReport:
    return ClockReport(given_s=0.0, is_applied=False, reason=reason)


def _in_metres(track: Array) -> Array:
    """(T, 4) of fixes (T, 4) with latitude, longitude, height."""
    known = np.isfinite(track[:, 3])
    height = float(np.median(track[known, 3])) if known.any() else 0.0
    middle = np.median(track[:, 1:3], axis=0)
    frame = LocalFrame(float(middle[0]), float(middle[1]), height)
    places = frame.enu_from_geodetic(np.column_stack([track[:, 1:3], np.where(known, track[:, 3], height)]))
    return np.column_stack([track[:, 0], places])


@dataclass(frozen=True)
class _Way:
    """A track, smoothed: (T, 7) seconds, place, velocity; ``velocity_sigma`` (3,) of the latter, metres a second."""

    table: Array
    velocity_sigma: Array

    def at(self, times: Array) -> tuple[Array, Array]:
        """Places (n, 3) and velocities (n, 3); NaN off the track."""
        found = places_along(self.table, times)
        return found[:, :3], found[:, 3:]


def _smoothed(track: Array) -> _Way:
    """Parabolas fitted to the fixes around each, to as many as foretell best a fix that was left out
    (cross-validation); a tenth, which may be wrong, has no say."""
    best, kept = np.inf, None
    numbers = np.arange(len(track))
    for reach in _REACHES:
        window = numbers[:, None] + np.arange(-reach, reach + 1)
        index = np.clip(window, 0, len(track) - 1)
        seconds = track[index, 0] - track[:, :1]
        is_near = (np.abs(seconds) <= _LONGEST_FIT_S) & (index == window)
        told, _, _ = _parabolas(seconds, track[index, 1:], is_near & (index != numbers[:, None]))
        squares = np.sort((told - track[:, 1:]) ** 2, axis=0)
        error = np.sqrt(squares[: max(1, int(_TRIMMED * len(squares)))].mean(0))
        if float((error**2).sum()) < best:
            best = float((error**2).sum())
            place, velocity, factor = _parabolas(seconds, track[index, 1:], is_near)
            kept = _Way(np.column_stack([track[:, 0], place, velocity]), error * float(np.median(factor)))
    assert kept is not None
    return kept


def _parabolas(seconds: Array, places: Array, is_used: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Parabolas through places (T, W, 3) at seconds (T, W): at 0 (T, 3), slopes there (T, 3), and what multiplies the
    sigma of a place to give that of a slope (T,)."""
    powers = np.stack([np.ones_like(seconds), seconds, seconds**2], -1) * is_used[:, :, None]
    information = np.einsum("twi,twj->tij", powers, powers)
    # too few fixes for a parabola make a line, or a place: the smaller the power the better held
    information += np.diag([1e-12, 1e-9, 1e-6])
    inverse = np.linalg.inv(information)
    found = inverse @ np.einsum("twi,twk->tik", powers, places)
    return found[:, 0], found[:, 1], np.sqrt(inverse[:, 1, 1])


def _nearest(way: _Way, times: Array, centers: Array) -> float:
    """The offset of a grid at which a similarity leaves the least share of the variance of the places (not the least of
    the residuals: where a receiver stands still there are none), if it is clearly less than as given; else 0."""
    shares: dict[float, float] = {}
    for offset in np.arange(-_RANGE_S, _RANGE_S + _STEP_S, _STEP_S).tolist():
        places, _ = way.at(times + offset)
        known = np.isfinite(places[:, 0])
        if known.sum() < max(_LEAST, _ON_TRACK * len(times)):
            continue
        rotation, scale, shift = (part[0] for part in closed_form(centers[None, known], places[None, known]))
        rest = scale * centers[known] @ rotation.T + shift - places[known]
        around = places[known] - places[known].mean(0)
        shares[offset] = float((rest**2).sum() / max((around**2).sum(), 1e-300))
    best = min(shares, key=lambda offset: shares[offset])
    gain = (3 * len(times) - 8) * float(np.log(shares[0.0] / max(shares[best], 1e-300)))
    return best if gain > _CLEAR_GAIN else 0.0


def _refined(way: _Way, times: Array, centers: Array, start: float) -> tuple[float, float] | None:
    """Offset and its standard deviation by Gauss-Newton steps over a similarity and the offset; None where they are not
    determined."""
    offset = start
    fit: RobustFit | None = None
    for n in range(_MAX_ROUNDS):
        places, velocity = way.at(times + offset)
        known = np.isfinite(places[:, 0])
        if known.sum() < _LEAST:
            return None
        if n % 4 == 0 or fit is None or len(fit.sigma) != known.sum():
            guess = np.tile([1.0, 1.0, 2.0], (int(known.sum()), 1))
            fit = robust_fit(centers[known], places[known], guess, np.zeros(2, bool))
        else:
            found = fit_similarity(centers[known], places[known], fit.sigma, fit.is_inlier, fit.similarity)
            fit = fit if found is None else replace(fit, similarity=found)
        if fit is None:
            return None
        residual = fit.similarity.apply(centers[known]) - places[known]
        step, sigma = _step(fit, centers[known], velocity[known], residual, way.velocity_sigma)
        if not np.isfinite(sigma):
            return None
        offset += float(np.clip(step, -_LONGEST_STEP_S, _LONGEST_STEP_S))
        if abs(step) < 0.05 * sigma:
            order = np.argsort(np.argsort(times[known])).astype(np.float64)
            slope = _slope(fit, centers[known], velocity[known])
            drift = estimate_drift(residual, fit.sigma, slope, fit.is_inlier, order)
            return offset, sigma * float(drift.spread[7])
    return None


def _slope(fit: RobustFit, centers: Array, velocity: Array) -> Array:
    """(n, 3, 8) how residuals of places move with a similarity, and with the offset."""
    arm = fit.similarity.apply(centers) - fit.similarity.mean
    return np.concatenate([similarity_slope(arm), -velocity[:, :, None]], 2)


def _step(
    fit: RobustFit, centers: Array, velocity: Array, residual: Array, velocity_sigma: Array
) -> tuple[float, float]:
    """What a linear fit adds to the offset, and the standard deviation of that; infinite where nothing tells but the
    noise of the velocity, which looks like turns."""
    slope = _slope(fit, centers, velocity) / fit.sigma[:, :, None]
    rows, rest = slope[fit.is_inlier].reshape(-1, 8), (residual / fit.sigma)[fit.is_inlier].ravel()
    own, others = rows[:, 7], rows[:, :7]
    root = np.sqrt(np.maximum((others**2).sum(0), 1e-300))
    # what is left of velocities that no similarity follows
    alone = own - others / root @ np.linalg.lstsq(others / root, own, rcond=1e-9)[0]
    noise = float(((velocity_sigma / fit.sigma[fit.is_inlier]) ** 2).sum())
    told = float(alone @ alone)
    if told < _OVER_NOISE * noise or told <= 1e-12 * float(own @ own):
        return 0.0, np.inf
    return -float(alone @ rest) / (told - noise), 1.0 / float(np.sqrt(told - noise))
