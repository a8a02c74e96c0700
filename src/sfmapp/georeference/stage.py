"""Models to their places in the world: which positions to believe, the similarity, the adjustment, and what is said.

For each model: a robust similarity to the measured places of its cameras; where positions leave the vertical open, what
else tells it; the adjustment with positions as factors; and positions judged anew by what came of it. A model that
positions do not determine, or that contradicts them, is left as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction, widened_scale_sigma
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.adjustment import Adjusted, Measured, adjust_with_positions, finished
from sfmapp.georeference.clock import settle_clock
from sfmapp.georeference.disagreement import MIN_AGREEING, find_disagreement
from sfmapp.georeference.drift import Drift, estimate_drift, similarity_slope
from sfmapp.georeference.faults import name_faults
from sfmapp.georeference.fit import Level, LevelOfImage, Similarity, closed_form
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.report import Ellipse, Finding, GeoreferenceReport, PlacedModel, PositionedImage
from sfmapp.georeference.robust_fit import RobustFit, robust_fit, turn_between
from sfmapp.georeference.tags import Tags, tags_of
from sfmapp.georeference.vertical import LEVEL_ENOUGH_RAD, known_level, upside_down
from sfmapp.georeference.world_frame import Georeference, ModelPlace
from sfmapp.images.image_set import ImageSet
from sfmapp.mapping.mapper import Mapper
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

STAGE = "georeference"
# A scale that is four sigmas from nothing is known; a heading to fifteen degrees is north up on any map.
MAX_SCALE_SIGMA, MAX_ROTATION_SIGMA_DEG = 0.25, 15.0
# What the errors of a receiver have in common over some minutes, if nobody says better, as those of phones have.
_COMMON_M = (3.0, 6.0)


@dataclass(frozen=True)
class Placed:
    """What came of georeferencing.

    Attributes:
        georeference: None where no model lies in the world.
        report: of the stage.
    """

    georeference: Georeference | None
    report: GeoreferenceReport


@dataclass(frozen=True)
class _Model:
    """A model in the frame, its tags, and what was found of both.

    Attributes:
        image_idx: (m,) images of it that have tags; n: (m,) the tags.
        fit: of its cameras to the tags, as they lie at last; drift: of errors of neighbours.
        first: the similarity that brought it there.
        contradictions: that nothing has resolved.
    """

    number: int
    image_idx: NDArray[np.int64]
    n: NDArray[np.int64]
    fit: RobustFit
    first: Similarity
    leveled_by: str
    drift: Drift
    is_adjusted: bool
    moved_m: float
    center_covariance: dict[int, Array]
    contradictions: list[Contradiction]


def georeference_models(mappers: Sequence[Mapper], image_set: ImageSet, options: GpsOptions, events: Events) -> Placed:
    """Bring finished models into one local frame in metres, z up, by the positions of their photographs.

    Args:
        mappers: of the models, which are moved and adjusted in place where positions determine them.
        image_set: whose records have the positions, in the order of the models' images.
        options: how far to believe them.
        events: told of findings and decisions.
    """
    image_set, clock = settle_clock(mappers, image_set, options, events)
    tags, findings = tags_of(image_set.images, options)
    for finding in findings:
        events.warned(STAGE, f"positions: {finding.sentence}", names=list(finding.images))
    placed: list[_Model] = []
    reports: list[PlacedModel] = []
    for number, mapper in enumerate(mappers if tags is not None else ()):
        assert tags is not None
        outcome = _place(number, mapper, tags, events)
        if isinstance(outcome, PlacedModel):
            events.decided(STAGE, f"model {number} stays in arbitrary units: {outcome.reason}")
            reports.append(outcome)
        else:
            placed.append(outcome)
            reports.append(_report_of(outcome, tags))
            _tell(outcome, reports[-1], events)
    for row in reports:
        for contradiction in row.contradictions:
            events.warned(STAGE, contradiction.message)
    images = _images(tags, placed, mappers, image_set.names) if tags is not None else []
    rejections = _rejections(images)
    findings += rejections
    for finding in rejections:
        events.warned(STAGE, f"positions: {finding.sentence}; it is left aside")
    num = sum(record.position is not None for record in image_set.images)
    report = GeoreferenceReport(
        source=options.source, num_positions=num, findings=findings, models=reports, images=images, clock=clock
    )
    if not placed:
        return Placed(None, report)
    assert tags is not None
    places = [_model_place(model, row) for model, row in zip(placed, (r for r in reports if not r.reason), strict=True)]
    return Placed(Georeference.about(tags.frame, tags.heights, places), report)


# ------------------------------------------------------------------------------------------------------------ a model


def _place(number: int, mapper: Mapper, tags: Tags, events: Events) -> _Model | PlacedModel:
    """A model brought into the frame, or why it is not."""
    model = mapper.reconstruction
    n = np.flatnonzero(model.is_registered[tags.image_idx] & (tags.first == np.arange(len(tags.first))))
    image_idx = tags.image_idx[n]
    fit, leveled, reason = _first_fit(model.cam_from_world, image_idx, tags, n)
    of_model, names = f"model {number}", [model.image_names[i] for i in image_idx]
    if fit is None or reason:
        refuted = fit is not None and fit.is_inlier.mean() < MIN_AGREEING
        found = find_disagreement(fit, tags.is_stated, names, of_model) if fit is not None and refuted else None
        against = [] if found is None else [found]
        return PlacedModel(model=number, reason=reason, num_positions=len(n), num_used=0, contradictions=against)
    level = _level_of(model.cam_from_world, image_idx, leveled)
    first = fit.similarity
    _move(model.cam_from_world, model.point_xyz, first.world_from_model)
    rigid = model.copy()
    slope = similarity_slope(model.centers[image_idx] - first.mean)
    drift = estimate_drift(fit.residual, fit.sigma, slope, fit.is_inlier, image_idx.astype(np.float64))
    measured = Measured(image_idx, tags.places[n], tags.sigma[n], tags.is_stated)
    adjusted = adjust_with_positions(mapper, measured, fit, level, drift)
    is_adjusted = adjusted is not None
    if adjusted is None:
        _restore(mapper, rigid)
        adjusted = Adjusted(finished(fit, model, measured, level, drift), {})
    fit, covariance = adjusted.fit, adjusted.covariance
    contradictions = _contradictions(fit, tags, names, of_model, is_adjusted=is_adjusted)
    moved = _bent(model.centers, rigid.centers)
    by = leveled.source if leveled is not None else ""
    return _Model(number, image_idx, n, fit, first, by, drift, is_adjusted, moved, covariance, contradictions)


def _contradictions(
    fit: RobustFit, tags: Tags, names: Sequence[str], of_model: str, *, is_adjusted: bool
) -> list[Contradiction]:
    """Between positions and the photographs of a model that lies in the frame."""
    found = find_disagreement(fit, tags.is_stated, names, of_model)
    if found is None and not is_adjusted:
        flat, up = fit.factor
        found = Contradiction(
            "positions",
            f"photographs and positions disagree about the shape of {of_model}; it was moved as a whole, and its shape "
            "left as the photographs have it",
            "wrong positions, or a model that is bent: --set gps.source=none leaves positions out",
            {"sigma_factor": flat, "sigma_factor_up": up},
        )
    return [] if found is None else [found]


def _first_fit(
    cam_from_world: Array, image_idx: NDArray[np.int64], tags: Tags, n: NDArray[np.int64]
) -> tuple[RobustFit | None, Level | None, str]:
    """The similarity of a model to its tags, and what levelled it where tags do not; and why it is not to be used."""
    if len(n) < 3:
        return None, None, f"{len(n)} of its photographs have a position, three are needed"
    poses = cam_from_world[image_idx]
    given = rigid3.center(poses), tags.places[n], tags.sigma[n], tags.is_stated
    fit, leveled = robust_fit(*given), None
    tilt = np.inf if fit is None else _largest_sigma(fit.similarity.covariance[:2, :2])
    if tilt > LEVEL_ENOUGH_RAD:
        level = known_level(cam_from_world, image_idx, tags.pitch_deg[n])
        again = robust_fit(*given, level)
        # a vertical that contradicts what positions do tell is none
        if again is not None and (fit is None or turn_between(fit, again) < 3.0 * np.hypot(tilt, level.sigma_rad)):
            fit, leveled = again, level
    reason = "they are all within their own errors of each other" if fit is None else _fault(fit, poses, len(n))
    return fit, leveled, f"its positions do not determine it: {reason}" if reason else ""


def _fault(fit: RobustFit, poses: Array, num: int) -> str:
    """Why a similarity to positions is not to be used; empty if it is."""
    scale_sigma = float(np.sqrt(fit.similarity.covariance[3, 3]))
    turn = float(np.degrees(_largest_sigma(fit.similarity.covariance[:3, :3])))
    if fit.is_inlier.mean() < MIN_AGREEING:
        return f"only {fit.is_inlier.sum()} of {num} agree with the photographs: wrong positions, or a wrong model"
    if scale_sigma > MAX_SCALE_SIGMA:
        return f"they tell the scale within {100 * scale_sigma:.0f} % only: cameras are too near to each other"
    if turn > MAX_ROTATION_SIGMA_DEG:
        return f"they leave its rotation open by {turn:.0f} degrees: they lie on a line, or too near to each other"
    if upside_down(poses, fit.similarity.rotation):
        return "they turn it upside down, as a mirror image does: has the hemisphere been lost in all of them?"
    return ""


def _largest_sigma(covariance: Array) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _bent(centers: Array, before: Array) -> float:
    """Root mean square distance (metres) between cameras and what they were, but for a motion of the whole."""
    both = np.isfinite(centers[:, 0]) & np.isfinite(before[:, 0])
    if both.sum() < 3:
        return 0.0
    rotation, scale, shift = (part[0] for part in closed_form(before[None, both], centers[None, both]))
    return float(np.sqrt(((scale * before[both] @ rotation.T + shift - centers[both]) ** 2).sum(1).mean()))


def _level_of(cam_from_model: Array, image_idx: NDArray[np.int64], level: Level | None) -> LevelOfImage | None:
    """The vertical as seen by one image, for a factor on it; None without."""
    if level is None:
        return None
    i = int(image_idx[0])
    return LevelOfImage(i, replace(level, up=rigid3.rotation_matrix(cam_from_model[i]) @ level.up))


def _move(cam_from_world: Array, point_xyz: Array, world_from_model: Array) -> None:
    known = ~np.isnan(cam_from_world[:, 0])
    cam_from_world[known] = similarity.transform_poses(world_from_model, cam_from_world[known])
    point_xyz[:] = similarity.apply(world_from_model, point_xyz)


def _restore(mapper: Mapper, saved: Reconstruction) -> None:
    for name in ("cam_from_world", "point_xyz", "obs_is_inlier"):
        getattr(mapper.reconstruction, name)[:] = getattr(saved, name)
    mapper.reconstruction.cameras[:] = saved.cameras


# ------------------------------------------------------------------------------------------------------- what is said


def _report_of(model: _Model, tags: Tags) -> PlacedModel:
    fit, covariance = model.fit, model.fit.similarity.covariance
    used = fit.is_inlier
    sigma = np.sqrt(np.diag(covariance))
    flat = float(np.sqrt((fit.residual[used, :2] ** 2).sum(1).mean()))
    heights = fit.residual[used, 2][np.isfinite(fit.residual[used, 2])]
    return PlacedModel(
        model=model.number,
        reason="",
        num_positions=len(model.n),
        num_used=int(used.sum()),
        scale_sigma_share=float(sigma[3]),
        rotation_sigma_deg=_three(np.degrees(sigma[:3])),
        position_sigma_m=_three(sigma[4:]),
        sigma_m=(
            model.drift.inflation * float(np.median(fit.sigma[used, 0])),
            model.drift.inflation * float(np.median(fit.sigma[used, 2])),
        ),
        sigma_factor=fit.factor,
        rms_residual_m=(flat, float(np.sqrt((heights**2).mean())) if len(heights) else None),
        correlation=model.drift.correlation,
        common_offset_m=_common_offset(tags),
        leveled_by=model.leveled_by,
        is_adjusted=model.is_adjusted,
        moved_m=model.moved_m,
        contradictions=model.contradictions,
    )


def _common_offset(tags: Tags) -> tuple[float, float]:
    """What positions may be off together: as much as they say that one of them is, or what receivers usually are."""
    stated = np.median(tags.sigma[:, 0]), np.median(tags.sigma[:, 2])
    flat, up = (float(s) if known else usual for s, known, usual in zip(stated, tags.is_stated, _COMMON_M, strict=True))
    return flat, up


def _model_place(model: _Model, row: PlacedModel) -> ModelPlace:
    first = model.first.world_from_model
    assert row.scale_sigma_share is not None
    assert row.rotation_sigma_deg is not None
    assert row.position_sigma_m is not None
    assert row.common_offset_m is not None
    flat, up = row.common_offset_m
    scale_sigma = widened_scale_sigma(row.scale_sigma_share, row.contradictions)
    assert scale_sigma is not None
    turned = sum(found.rotation_sigma_deg**2 for found in row.contradictions)
    return ModelPlace(
        model=model.number,
        source="gps",
        scale=float(first[7]),
        rotation=(float(first[0]), float(first[1]), float(first[2]), float(first[3])),
        translation_m=_three(first[4:7]),
        scale_sigma_share=scale_sigma,
        rotation_sigma_deg=_three(np.hypot(row.rotation_sigma_deg, np.sqrt(turned))),
        position_sigma_m=row.position_sigma_m,
        common_offset_sigma_m=(flat, flat, up),
    )


def _images(
    tags: Tags, placed: Sequence[_Model], mappers: Sequence[Mapper], names: Sequence[str]
) -> list[PositionedImage]:
    """A row for each photograph that has a position."""
    numbers = np.full(len(names), -1)
    for number, mapper in reversed(list(enumerate(mappers))):
        numbers[mapper.reconstruction.is_registered] = number
    rows = {int(i): _unplaced(tags, n, int(i), names, int(numbers[i])) for n, i in enumerate(tags.image_idx)}
    for model in placed:
        fit, centers = model.fit, mappers[model.number].reconstruction.centers[model.image_idx]
        who = [names[i] for i in model.image_idx]
        reasons = name_faults(tags, model.n, centers, fit.sigma, fit.is_inlier, who)
        # a position that had no part in the fit differs by its own error and by that of the fit
        share = np.sqrt(np.where(fit.is_inlier[:, None], fit.similarity.redundancy, 1.0).clip(1e-6))
        expected = fit.sigma * share
        for k, i in enumerate(model.image_idx.tolist()):
            covariance = model.center_covariance.get(i)
            rows[i] = replace(
                rows[i],
                model=model.number,
                adjusted_m=_three(centers[k]),
                residual_m=_three_or_less(fit.residual[k]),
                residual_sigma_m=_three_or_less(np.where(np.isfinite(expected[k]), expected[k], np.nan)),
                ellipse=None if covariance is None else _ellipse(covariance),
                is_used=bool(fit.is_inlier[k]),
                reason=reasons[k],
            )
        for n in np.flatnonzero(tags.first != np.arange(len(tags.first))).tolist():
            i, earlier = int(tags.image_idx[n]), names[tags.image_idx[tags.first[n]]]
            if numbers[i] == model.number:
                at = mappers[model.number].reconstruction.centers[i]
                reason = f"the same position as {earlier}, to the last digit: no new measurement"
                rows[i] = replace(rows[i], adjusted_m=_three(at), reason=reason)
    return [rows[i] for i in sorted(rows)]


def _unplaced(tags: Tags, n: int, image: int, names: Sequence[str], model: int) -> PositionedImage:
    latitude, longitude, height = tags.geodetic[n].tolist()
    reason = "no model holds the photograph" if model < 0 else "its model does not lie in the world"
    return PositionedImage(
        name=names[image],
        model=None if model < 0 else model,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=None if np.isnan(height) else height,
        source=tags.source[n],
        measured_m=_three(np.nan_to_num(tags.places[n])),
        is_used=False,
        reason=reason,
    )


def _ellipse(covariance: Array) -> Ellipse:
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    east, north = vectors[:, 1]
    return Ellipse(
        major_m=float(np.sqrt(values[1])),
        minor_m=float(np.sqrt(max(values[0], 0.0))),
        azimuth_deg=float(np.degrees(np.arctan2(east, north)) % 180.0),
        up_m=float(np.sqrt(covariance[2, 2])),
    )


def _three(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _three_or_less(values: Array) -> tuple[float, float, float | None]:
    return float(values[0]), float(values[1]), None if np.isnan(values[2]) else float(values[2])


def _rejections(images: Sequence[PositionedImage]) -> list[Finding]:
    """Positions that photographs refute, each by name."""
    return [Finding(images=[row.name], message=row.reason) for row in images if row.residual_m and not row.is_used]


def _tell(model: _Model, row: PlacedModel, events: Events) -> None:
    assert row.rms_residual_m is not None
    assert row.scale_sigma_share is not None
    assert row.rotation_sigma_deg is not None
    flat, up = row.rms_residual_m
    text = (
        f"model {row.model} lies in the world: {row.num_used} of {row.num_positions} positions agree, within "
        f"{flat:.2f} m horizontally{'' if up is None else f' and {up:.2f} m in height'}; scale to "
        f"{100 * row.scale_sigma_share:.2g} %, north to {row.rotation_sigma_deg[2]:.2g} degrees"
    )
    events.decided(STAGE, text, **row)
