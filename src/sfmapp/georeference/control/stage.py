"""Models to ground control: marks checked, a similarity, the adjustment, and a table of points left out in turn.

Control decides where a model lies, also where positions of photographs have placed it before. These go on holding its
shape, as well as they are: those of a phone hardly, those of RTK better than a few points do. What they are off
together, as RTK is by its base, is a variable of the adjustment; so one or two points suffice beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.problem import free_params
from sfmapp.events import Events
from sfmapp.formats.control_points import ControlPoints
from sfmapp.geometry import similarity
from sfmapp.georeference.control.adjustment import Adjusting, ControlSolution, adjust_to_control
from sfmapp.georeference.control.landmarks import Positions
from sfmapp.georeference.control.marks import MarkedPoints, check_marks
from sfmapp.georeference.control.points import (
    Alignment,
    LeftOut,
    Survey,
    align_to_survey,
    similarity_covariance,
    survey_in_frame,
)
from sfmapp.georeference.control.report import ControlledModel, ControlPointRow, ControlReport, LeftOutSummary, Role
from sfmapp.georeference.report import GeoreferenceReport
from sfmapp.georeference.world_frame import Georeference, ModelPlace
from sfmapp.mapping.mapper import Mapper

Array = NDArray[np.float64]

STAGE = "control"
# 95 % of lengths of two dimensions, and of one, in standard deviations.
_HORIZONTAL_95, _VERTICAL_95 = 2.448, 1.960
# Positions and survey may name one datum and mean two, and a base may be put down anywhere: in metres.
_LEAST_COMMON_M = 10.0


@dataclass(frozen=True)
class Controlled:
    """What came of ground control.

    Attributes:
        georeference: None where no model lies in the world, as with local coordinates.
        report: of the stage.
    """

    georeference: Georeference | None
    report: ControlReport


def control_models(
    mappers: Sequence[Mapper],
    control: ControlPoints,
    before: Georeference | None,
    positions: GeoreferenceReport | None,
    events: Events,
) -> Controlled:
    """Bring finished models to ground control points, in place, where three of these or more tell how.

    Args:
        mappers: of the models.
        control: whose images are those of the models.
        before: where positions of photographs have placed models; its frame is kept. positions: what was said of them.
        events: told of slips, refuted points and decisions.
    """
    survey = survey_in_frame(control, before.frame if before is not None else None)
    places = {place.model: place for place in before.models} if before is not None else {}
    models: list[ControlledModel] = []
    for number, mapper in enumerate(mappers):
        known = _positions_of(number, mapper, positions) if survey.frame is not None else None
        row, place = _control_model(number, mapper, control, survey, (places.get(number), known), events)
        for finding in row.findings:
            events.warned(STAGE, finding)
        models.append(row)
        if place is not None:
            places[number] = place
    report = ControlReport(path=str(control.path), crs=control.crs, num_points=control.num_points, models=models)
    if survey.frame is None:  # models that were moved have left the frame of the world for that of the site
        is_moved = any(not row.reason for row in models)
        return Controlled(None if is_moved else before, report)
    heights = before.heights if before is not None else survey.heights
    placed = [places[number] for number in sorted(places)]
    return Controlled(Georeference.about(survey.frame, heights, placed) if placed else None, report)


def positions_after(
    report: GeoreferenceReport, control: ControlReport, mappers: Sequence[Mapper]
) -> GeoreferenceReport:
    """What positions of photographs come to beside cameras that control has moved, their common error included."""
    moved = {row.model for row in control.models if not row.reason}
    rows = []
    for row in report.images:
        if row.model in moved and row.adjusted_m is not None:
            mapper = mappers[row.model]
            center = mapper.reconstruction.centers[mapper.reconstruction.image_names.index(row.name)]
            east, north, up = center - row.measured_m
            row = replace(
                row, adjusted_m=_three(center), residual_sigma_m=None, ellipse=None,
                residual_m=(float(east), float(north), None if row.height_m is None else float(up)),
            )  # fmt: skip
        rows.append(row)
    return replace(report, images=rows)


def _control_model(
    number: int,
    mapper: Mapper,
    control: ControlPoints,
    survey: Survey,
    known: tuple[ModelPlace | None, Positions | None],
    events: Events,
) -> tuple[ControlledModel, ModelPlace | None]:
    """A row of the report, and how the model lies now; None where control does not tell.

    Args:
        known: how positions of its photographs have placed the model, and these.
    """
    model, (before, positions) = mapper.reconstruction, known
    marked = check_marks(model, control)
    alignment = align_to_survey(marked.place, survey.place)
    if alignment.world_from_model is None and positions is not None and marked.is_placed.any():
        alignment = Alignment(similarity.IDENTITY, marked.is_placed, "")  # it lies in the frame already
    if alignment.world_from_model is None:
        events.decided(STAGE, f"model {number} is not georeferenced by its ground control: {alignment.problem}")
        return _unmoved(number, control, marked, survey, alignment.problem), None
    first = model.copy()
    moved = alignment.world_from_model
    model.cam_from_world[:] = similarity.transform_poses(moved, model.cam_from_world)
    model.point_xyz[:] = similarity.apply(moved, model.point_xyz)
    solution = adjust_to_control(model, control, marked, survey, alignment.is_inlier, adjusting_of(mapper, positions))
    if not solution.is_used.any():
        model.cam_from_world[:], model.point_xyz[:], model.cameras[:] = (
            first.cam_from_world, first.point_xyz, first.cameras,
        )  # fmt: skip
        problem = "no control points agree with each other"
        return _unmoved(number, control, marked, survey, problem), None
    row = _row(number, control, marked, survey, solution)
    _tell(row, events)
    return row, _model_place(number, survey, moved, solution, before)


def _positions_of(number: int, mapper: Mapper, report: GeoreferenceReport | None) -> Positions | None:
    """Positions of photographs that hold the shape of a model; None where they do not."""
    rows = {row.model: row for row in report.models} if report is not None else {}
    row = rows.get(number)
    if report is None or row is None or not row.is_adjusted or row.sigma_m is None or row.common_offset_m is None:
        return None
    images = {name: i for i, name in enumerate(mapper.reconstruction.image_names)}
    used = [image for image in report.images if image.model == number and image.is_used and image.height_m is not None]
    if len(used) < 3:
        return None
    (flat, up), (common, common_up) = row.sigma_m, row.common_offset_m
    return Positions(
        np.array([images[image.name] for image in used], np.int64),
        np.array([image.measured_m for image in used]),
        np.array([flat, flat, up]),
        np.maximum([common, common, common_up], _LEAST_COMMON_M),
    )


def adjusting_of(mapper: Mapper, positions: Positions | None = None) -> Adjusting:
    """How a finished map is adjusted with control, and with positions: as it was in the end without."""
    options, varying, noise = mapper.closing_options()
    free = [
        free_params(
            camera, options.refine_focal, options.refine_distortion,
            options.refine_principal_point and varying.centers is not None and bool(varying.centers[c]),
        )
        for c, camera in enumerate(mapper.reconstruction.cameras)
    ]  # fmt: skip

    def graph(is_robust: bool) -> FactorGraph:
        chosen = mapper.robust(options) if is_robust else options
        unit = noise.sigma_px if chosen.loss == "trivial" else noise.robust_px
        made = FactorGraph(
            mapper.reconstruction, chosen, varying=varying, prior_cameras=mapper.prior_cameras, noise_px=unit,
            threads=mapper.threads,
        )  # fmt: skip
        if positions is not None:
            positions.add_to(made)
        return made

    return Adjusting(lambda: graph(True), lambda: graph(False), free)


def _model_place(
    number: int, survey: Survey, moved: Array, solution: ControlSolution, before: ModelPlace | None
) -> ModelPlace | None:
    """How the model lies: what has brought it there, and how sure its points make that."""
    used = solution.is_used
    if survey.frame is None:
        return None
    covariance = similarity_covariance(solution.place[used], survey.covariance[used])
    if covariance is None:
        # too few points to tell more than a shift: scale and turn are those of the positions
        assert before is not None
        at = np.sqrt(np.diagonal(survey.covariance[used], axis1=1, axis2=2).mean(0) / used.sum())
        deviations = np.array([*np.radians(before.rotation_sigma_deg), before.scale_sigma_share, *at])
    else:
        deviations = solution.survey_spread * np.sqrt(np.diag(covariance))
    if before is not None:
        earlier = np.array([*before.rotation, *before.translation_m, before.scale])
        moved = similarity.compose(moved, earlier)
    return ModelPlace(
        model=number,
        source="control points",
        scale=float(moved[7]),
        rotation=(float(moved[0]), float(moved[1]), float(moved[2]), float(moved[3])),
        translation_m=_three(moved[4:7]),
        scale_sigma_share=float(deviations[3]),
        rotation_sigma_deg=_three(np.degrees(deviations[:3])),
        position_sigma_m=_three(deviations[4:]),
        common_offset_sigma_m=(0.0, 0.0, 0.0),
    )


# ------------------------------------------------------------------------------------------------------- what is said


def _unmoved(
    number: int, control: ControlPoints, marked: MarkedPoints, survey: Survey, problem: str
) -> ControlledModel:
    rows = [
        _point_row(control, marked, survey, p, "unplaced", marked.unplaced.get(p, problem))
        for p in range(control.num_points)
    ]
    row = ControlledModel(
        model=number, reason=problem, mark_spread=marked.spread, points=rows, slips=marked.slips, findings=[]
    )
    return replace(row, findings=_findings(row, str(control.path)))


def _point_row(
    control: ControlPoints, marked: MarkedPoints, survey: Survey, point: int, role: Role, reason: str
) -> ControlPointRow:
    return ControlPointRow(
        name=control.names[point],
        role=role,
        reason=reason,
        num_marks=int(marked.is_used[control.observations_of(point)].sum()),
        xyz_m=_three(survey.place[point]),
    )


def _row(
    number: int, control: ControlPoints, marked: MarkedPoints, survey: Survey, solution: ControlSolution
) -> ControlledModel:
    rows = []
    for p in range(control.num_points):
        if p in marked.unplaced:
            rows.append(_point_row(control, marked, survey, p, "unplaced", marked.unplaced[p]))
            continue
        role: Role = "control" if solution.is_used[p] else "refuted"
        reason = "" if solution.is_used[p] else "the other points put it elsewhere"
        point = _point_row(control, marked, survey, p, role, reason)
        point = replace(point, residual_m=_three(solution.place[p] - survey.place[p]))
        rows.append(_with_left_out(point, solution.left_out[p]))
    judged = [one for p, one in enumerate(solution.left_out) if one is not None and solution.is_used[p]]
    row = ControlledModel(
        model=number,
        reason="",
        mark_spread=marked.spread,
        survey_spread=solution.survey_spread,
        points=rows,
        slips=marked.slips,
        findings=[],
        summary=_summary(judged) if judged else None,
    )
    return replace(row, findings=_findings(row, str(control.path)))


def _with_left_out(row: ControlPointRow, found: LeftOut | None) -> ControlPointRow:
    if found is None:
        return row
    return replace(
        row,
        left_out_m=_three(found.residual),
        left_out_sigma_m=_three(np.sqrt(np.diag(found.covariance))),
        normalized_horizontal=found.normalized_horizontal,
        normalized_vertical=found.normalized_vertical,
    )


def _summary(judged: Sequence[LeftOut]) -> LeftOutSummary:
    residual = np.array([one.residual for one in judged])
    variance = np.array([np.diag(one.covariance) for one in judged])
    flat, up = (residual[:, :2] ** 2).sum(1), residual[:, 2] ** 2
    return LeftOutSummary(
        num_points=len(judged),
        horizontal_rms_m=float(np.sqrt(flat.mean())),
        vertical_rms_m=float(np.sqrt(up.mean())),
        expected_horizontal_m=float(np.sqrt(variance[:, :2].sum(1).mean())),
        expected_vertical_m=float(np.sqrt(variance[:, 2].mean())),
        share_within_95_horizontal=float(np.mean([one.normalized_horizontal <= _HORIZONTAL_95 for one in judged])),
        share_within_95_vertical=float(np.mean([one.normalized_vertical <= _VERTICAL_95 for one in judged])),
    )


def _findings(row: ControlledModel, path: str) -> list[str]:
    """Slips of the hand, points that the others refute, and a survey that is poorer than it says."""
    found = [
        f"{path}, line {slip.line}: point {slip.point} is marked in {slip.image} {slip.distance_px:.1f} px off "
        f"({slip.expected_px[0]:.1f}, {slip.expected_px[1]:.1f}), where {slip.num_agreeing} other marks put it; the "
        "mark is left aside"
        for slip in row.slips
    ]
    for point in row.points:
        if point.role == "refuted" and point.left_out_m is not None and point.left_out_sigma_m is not None:
            east, north, up = point.left_out_m
            found.append(
                f"control point {point.name} lies ({east:+.2f}, {north:+.2f}, {up:+.2f}) m east, north and up of its "
                f"survey by all others, who tell its place within {max(point.left_out_sigma_m):.2g} m; it is left "
                "aside: check its coordinates, and that its marks are of this point"
            )
    if row.survey_spread is not None and row.survey_spread > 1.0:
        found.append(
            f"control points differ from each other by {row.survey_spread:.1f} times what their sigmas let expect, and "
            "none of them is clearly the wrong one; their sigmas were widened: check coordinates, their system and "
            "sigmas"
        )
    return found


def _tell(row: ControlledModel, events: Events) -> None:
    used = [point for point in row.points if point.role == "control"]
    text = f"model {row.model} lies on {len(used)} of {len(row.points)} control points"
    if row.summary is not None:
        one = row.summary
        text += (
            f"; left out in turn they are off by {one.horizontal_rms_m:.3f} m horizontally and "
            f"{one.vertical_rms_m:.3f} m in height, expected {one.expected_horizontal_m:.3f} and "
            f"{one.expected_vertical_m:.3f}"
        )
    events.decided(STAGE, text, **row)


def _three(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
