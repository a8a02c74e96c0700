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


class ScaleBarRow(Report):
    """A known length.

    Attributes:
        metres, sigma_m: as it was measured.
        model_m: in the model, by the scale that came of all.
        left_out_m: by the others alone minus as it was measured; left_out_sigma_m: standard deviation of that; absent
            where there are no others.
        is_used: False if all others refute it.
    """

    name: str
    metres: float
    sigma_m: float
    model_m: float
    is_used: bool
    left_out_m: float | None = None
    left_out_sigma_m: float | None = None


class ScaledModel(Report):
    """How long the unit of a model was, by known lengths.

    Attributes:
        reason: why they have not told; empty if they have.
        metres_per_unit, sigma_share: of the unit that photographs alone gave, and its standard deviation as a share.
        spread: by how much sigmas of bars were multiplied, one at least.
        bars: those that could be measured.
        findings: what is wrong, a sentence each.
    """

    model: int
    reason: str
    metres_per_unit: float | None = None
    sigma_share: float | None = None
    spread: float | None = None
    bars: Sequence[ScaleBarRow]
    findings: Sequence[str]


class LeveledModel(Report):
    """Which way is up in a model that was turned for it.

    Attributes:
        source: what told it: ``photographs``, ``plane`` or ``markers``; reason: why nothing did, empty if something.
        sigma_deg: standard deviation about each horizontal axis; absent where nothing told it.
        from_photographs_deg: angle to what the roll of the photographs says.
    """

    model: int
    source: str
    reason: str
    sigma_deg: float | None = None
    from_photographs_deg: float | None = None


class UnitsReport(Report):
    """What known lengths and a vertical made of models that nothing else places."""

    scales: Sequence[ScaledModel]
    levels: Sequence[LeveledModel]
