"""Measured positions of photographs beside known poses: compared, and not used.

Known poses bring a frame of their own, in a unit that nobody states. Positions could say no more in it than how the
model is bent, after a similarity of its own; and what they tell of that is mostly far less than poses do. So they are
held against the model: how many agree, what the unit is by them, and whether that can be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.georeference.disagreement import MIN_AGREEING, find_disagreement
from sfmapp.georeference.drift import estimate_drift, similarity_slope
from sfmapp.georeference.faults import name_faults
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.poses.report import PosedModel, PosesReport, PositionsBeside
from sfmapp.georeference.poses.stage import STAGE
from sfmapp.georeference.robust_fit import RobustFit, robust_fit
from sfmapp.georeference.stage import MAX_SCALE_SIGMA
from sfmapp.georeference.tags import Tags, tags_of
from sfmapp.images.image_set import ImageSet
from sfmapp.scene.reconstruction import Reconstruction

# A unit nearer to a metre than this factor was meant to be one; feet, millimetres and arbitrary units are farther off.
_NEARLY_METRES = 1.25
# Standard deviations by which it may miss: one right one in a thousand is beyond.
_MAX_SIGMAS = 3.29
# Residuals have the errors of known poses too, and what sigmas of receivers leave out: three or five sigmas, not ten.
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
        found, fit = _compared(models[row.model], tags)
        events.decided(STAGE, f"model {row.model}: {found.sentence}", **found)
        for name, reason in zip(found.disagreeing, found.faults, strict=True):
            events.warned(STAGE, f"position of {name}: {reason}")
        contradiction = None if fit is None else _contradiction(row, found, fit, models[row.model], tags)
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


def _compared(model: Reconstruction, tags: Tags) -> tuple[PositionsBeside, RobustFit | None]:
    n = _tags_of_model(model, tags)
    image_idx = tags.image_idx[n]
    centers = model.centers[image_idx]
    fit = robust_fit(centers, tags.places[n], tags.sigma[n], tags.is_stated)
    if fit is None:
        few = f"{len(n)} of its photographs have one, three are needed"
        reason = few if len(n) < 3 else "they are all within their own errors of each other"
        return PositionsBeside(num_positions=len(n), reason=reason), None
    used, scale, stated = fit.is_inlier, fit.similarity.scale, float(np.median(tags.sigma[n, 0]))
    placed = fit.similarity.apply(centers)
    drift = estimate_drift(
        fit.residual, fit.sigma, similarity_slope(placed - fit.similarity.mean), used, image_idx.astype(np.float64)
    )
    heights = fit.residual[used, 2][np.isfinite(fit.residual[used, 2])]
    share = float(np.sqrt(fit.similarity.covariance[3, 3]) * drift.spread[3])
    names = [model.image_names[i] for i in image_idx]
    faults = name_faults(tags, n, placed, fit.sigma, used, names)
    found = PositionsBeside(
        num_positions=len(n),
        num_agreeing=int(used.sum()),
        disagreeing=[name for name, fault in zip(names, faults, strict=True) if fault],
        faults=[fault for fault in faults if fault],
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
    return found, fit


def _tags_of_model(model: Reconstruction, tags: Tags) -> NDArray[np.int64]:
    """(m,) the tags of registered photographs, without those that are the same as an earlier one."""
    return np.flatnonzero(model.is_registered[tags.image_idx] & (tags.first == np.arange(len(tags.first))))


def _contradiction(
    row: PosedModel, found: PositionsBeside, fit: RobustFit, model: Reconstruction, tags: Tags
) -> Contradiction | None:
    """Positions and known poses that cannot both be right; None where they can."""
    names = [model.image_names[i] for i in tags.image_idx[_tags_of_model(model, tags)]]
    of_model = f"model {row.model} in the frame of known poses"
    against = find_disagreement(fit, tags.is_stated, names, of_model, _REFUTED_FACTOR)
    if against is not None:
        return against
    assert found.unit_m is not None
    assert found.unit_sigma_m is not None
    off = abs(float(np.log(found.unit_m)))
    sigma = float(np.hypot(found.unit_sigma_m / found.unit_m, _scale_sigma(row, model)))
    if off > np.log(_NEARLY_METRES) or off <= _MAX_SIGMAS * sigma or found.reason:
        return None
    return Contradiction(
        "positions and known poses",
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
