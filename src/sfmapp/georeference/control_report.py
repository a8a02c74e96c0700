"""What control points say of a model, and of each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from sfmapp.reporting import Report

Role = Literal["control", "refuted", "unplaced"]


class MarkSlip(Report):
    """A mark that the others of its point refute; pixels have the centre of the first at (0.5, 0.5).

    Attributes:
        line: of the file.
        expected_px: where the others put the point; ``distance_px`` from the mark.
        num_agreeing: marks of the point that agree with each other.
    """

    point: str
    image: str
    line: int
    marked_px: tuple[float, float]
    expected_px: tuple[float, float]
    distance_px: float
    num_agreeing: int


class ControlPointRow(Report):
    """A control point: how far the adjustment without it puts it from where the survey does, and how far it may.

    Attributes:
        role: ``control`` took part; ``refuted`` did not, as the others speak against it; ``unplaced`` has no place in
            the model.
        reason: why it took no part; empty if it did.
        num_marks: that took part.
        xyz_m: (3,) by the survey, in the world frame.
        residual_m: (3,) adjusted minus surveyed, of the adjustment that knew all control.
        left_out_m: (3,) adjusted without its coordinates minus surveyed; left_out_sigma_m: (3,) of that, the survey's
            own included. Absent where the others do not hold the model.
        normalized_horizontal, normalized_vertical: of the same over what is expected; 95 % are below 2.45 and 1.96.
    """

    name: str
    role: Role
    reason: str
    num_marks: int
    xyz_m: tuple[float, float, float]
    residual_m: tuple[float, float, float] | None = None
    left_out_m: tuple[float, float, float] | None = None
    left_out_sigma_m: tuple[float, float, float] | None = None
    normalized_horizontal: float | None = None
    normalized_vertical: float | None = None


class LeftOutSummary(Report):
    """Root mean squares over control points that were left out in turn, and what was expected of them."""

    num_points: int
    horizontal_rms_m: float
    vertical_rms_m: float
    expected_horizontal_m: float
    expected_vertical_m: float
    share_within_95_horizontal: float
    share_within_95_vertical: float


class ControlledModel(Report):
    """How a model lies on ground control, or why it does not.

    Attributes:
        reason: why control points have not moved it; empty if they have.
        mark_spread: how many of their sigmas the marks scatter, one at least; survey_spread: the same of the survey.
        points: a row for each control point.
        slips: marks that others refute.
        findings: what is wrong, a sentence each.
        summary: of points left out in turn; absent where none could be.
    """

    model: int
    reason: str
    mark_spread: float
    survey_spread: float | None = None
    points: Sequence[ControlPointRow]
    slips: Sequence[MarkSlip]
    findings: Sequence[str]
    summary: LeftOutSummary | None = None


class ControlReport(Report):
    """What the stage ``control`` did.

    Attributes:
        path: of the file; crs: of its coordinates.
        num_points: in the file.
        models: as in the report, the largest first.
    """

    path: str
    crs: str
    num_points: int
    models: Sequence[ControlledModel]
