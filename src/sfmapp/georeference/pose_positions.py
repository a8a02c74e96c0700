"""Measured positions of photographs beside known poses: compared, and not used.

Known poses bring a frame of their own, in a unit that nobody states. Positions could say no more in it than how the
model is bent, after a similarity of its own; and what they tell of that is mostly far less than poses do. So they are
held against the model: how many agree, what the unit is by them, and whether that can be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.georeference.drift import estimate_drift, similarity_slope
from sfmapp.georeference.fit import robust_fit
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.pose_report import PosedModel, PosesReport, PositionsBeside
from sfmapp.georeference.pose_stage import STAGE
from sfmapp.georeference.stage import MAX_SCALE_SIGMA, MIN_AGREEING
from sfmapp.georeference.tags import Tags, tags_of
from sfmapp.images.image_set import ImageSet
from sfmapp.scene.reconstruction import Reconstruction

# A unit nearer to a metre than this factor was meant to be one; feet, millimetres and arbitrary units are farther off.
_NEARLY_METRES = 1.25
# Standard deviations by which it may miss: one right one in a thousand is beyond.
_MAX_SIGMAS = 3.29
# What sigmas of receivers leave out (the lever arm to the camera, the shutter) makes three or five of them, not ten.
_REFUTED_FACTOR = 10.0
# Positions so many times as sure as the poses had better be used instead.
_MUCH_SURER = 3.0


def with_positions(
    report: PosesReport, models: Sequence[Reconstruction], image_set: ImageSet, options: GpsOptions, events: Events
) -> PosesReport:
    """What positions of photographs say of models in the frame of known poses, added to what poses have said.

    Args:
        models: as in the report, the largest first.
        image_set: whose records have the positions.
    """
    tags, _ = tags_of(image_set.images, options)
    if tags is None:
        return report
    rows, contradictions = [], list(report.contradictions)
    for row in report.models:
        if row.reason:
            rows.append(row)
            continue
        found = _compared(models[row.model], tags)
        events.decided(STAGE, f"model {row.model}: {found.sentence}", **found)
        contradiction = _contradiction(row, found, _scale_sigma(row, models[row.model]))
        if contradiction is not None:
            events.warned(STAGE, contradiction.message)
            contradictions.append(contradiction)
        if _are_better(row, found):
            events.warned(
                STAGE, f"model {row.model}: positions are good to {found.sigma_m:.2g} m, and much surer than the known "
                "poses: without --pose-priors they would be used",
            )  # fmt: skip
        rows.append(replace(row, positions=found))
    return replace(report, models=rows, contradictions=contradictions)


def _compared(model: Reconstruction, tags: Tags) -> PositionsBeside:
    n = np.flatnonzero(model.is_registered[tags.image_idx] & (tags.first == np.arange(len(tags.first))))
    image_idx = tags.image_idx[n]
    centers = model.centers[image_idx]
    fit = robust_fit(centers, tags.places[n], tags.sigma[n], tags.is_stated) if len(n) >= 3 else None
    if fit is None:
        few = f"{len(n)} of its photographs have one, three are needed"
        reason = few if len(n) < 3 else "they are all within their own errors of each other"
        return PositionsBeside(num_positions=len(n), reason=reason)
    used, scale, stated = fit.is_inlier, fit.similarity.scale, float(np.median(tags.sigma[n, 0]))
    slope = similarity_slope(fit.similarity.apply(centers) - fit.similarity.mean)
    drift = estimate_drift(fit.residual, fit.sigma, slope, used, image_idx.astype(np.float64))
    heights = fit.residual[used, 2][np.isfinite(fit.residual[used, 2])]
    share = float(np.sqrt(fit.similarity.covariance[3, 3]) * drift.spread[3])
    return PositionsBeside(
        num_positions=len(n),
        num_agreeing=int(used.sum()),
        reason=f"they tell the unit within {100 * share:.0f} % only" if share > MAX_SCALE_SIGMA else "",
        stated_sigma_m=stated if tags.is_stated[0] else None,
        unit_m=float(scale),
        unit_sigma_m=scale * share,
        rms_residual_m=(
            float(np.sqrt((fit.residual[used, :2] ** 2).sum(1).mean())),
            float(np.sqrt((heights**2).mean())) if len(heights) else None,
        ),
        sigma_m=float(np.median(fit.sigma[used, 0])),
    )


def _contradiction(row: PosedModel, found: PositionsBeside, own_sigma: float) -> Contradiction | None:
    """Positions and known poses that cannot both be right; None where they can.

    Args:
        own_sigma: standard deviation of the scale that known poses have given the model, as a share of it.
    """
    if found.unit_m is None or found.unit_sigma_m is None:
        return None
    subject = "positions and known poses"
    if found.num_agreeing < MIN_AGREEING * found.num_positions:
        return Contradiction(
            subject,
            f"only {found.num_agreeing} of {found.num_positions} positions of photographs agree with model "
            f"{row.model} in the frame of known poses",
            "positions or poses are of other photographs; --set gps.source=none leaves positions out",
            {"num_positions": found.num_positions, "num_agreeing": found.num_agreeing},
        )
    if found.stated_sigma_m and found.sigma_m and found.sigma_m > _REFUTED_FACTOR * found.stated_sigma_m:
        return Contradiction(
            subject,
            f"positions of photographs that are said to be good to {found.stated_sigma_m:.2g} m differ by "
            f"{found.sigma_m:.3g} m from model {row.model} in the frame of known poses",
            "positions or poses are of other photographs; --set gps.source=none leaves positions out",
            {"stated_sigma_m": found.stated_sigma_m, "sigma_m": found.sigma_m},
        )
    off = abs(float(np.log(found.unit_m)))
    sigma = float(np.hypot(found.unit_sigma_m / found.unit_m, own_sigma))
    if off > np.log(_NEARLY_METRES) or off <= _MAX_SIGMAS * sigma or found.reason:
        return None
    return Contradiction(
        subject,
        f"one unit of the known poses is {found.unit_m:.4g} +- {found.unit_sigma_m:.2g} m by {found.num_agreeing} "
        f"positions of photographs: {off / sigma:.1f} sigmas from a metre",
        "if the poses are in metres, their scale or the positions are wrong",
        {"unit_m": found.unit_m, "unit_sigma_m": found.unit_sigma_m, "num_agreeing": found.num_agreeing},
        scale_sigma=off,
    )


def _scale_sigma(row: PosedModel, model: Reconstruction) -> float:
    """Of the scale by known poses, as a share of it; where they are held, by how good they are."""
    if row.scale_sigma_share is not None:
        return row.scale_sigma_share
    spread = rigid3.spread(model.cam_from_world[model.is_registered])
    return (row.sigma or 0.0) / (spread * float(np.sqrt(max(row.num_used, 1))))


def _are_better(row: PosedModel, found: PositionsBeside) -> bool:
    if row.sigma is None or found.sigma_m is None or found.unit_m is None:
        return False
    agree = found.num_agreeing >= MIN_AGREEING * found.num_positions
    return agree and _MUCH_SURER * found.sigma_m < row.sigma * found.unit_m
