"""A trajectory against the ground truth: what ``sfmapp evaluate`` says, and its table."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from sfmapp.evaluation.report import Statistics
from sfmapp.reporting import Report

FORMAT_NAMES = {"tum": "TUM", "kitti": "KITTI", "euroc": "EuRoC"}
_COLUMNS = ("rmse", "mean", "median", "max")


class TrajectoryReport(Report):
    """A file of poses as it was read."""

    path: str
    format: str
    num_poses: int


class PoseErrors(Report):
    """Errors of positions in metres (the unit of the ground truth) and of rotations in degrees."""

    translation_m: Statistics
    rotation_deg: Statistics


class RelativePoseErrors(PoseErrors):
    """Errors of relative motions over ``delta`` frames, seconds or metres of path; ``num`` of them."""

    delta: float
    unit: str
    num: int


class KittiDrift(Report):
    """KITTI's errors: means over ``num`` stretches of 100 to 800 m."""

    t_rel_percent: float
    r_rel_deg_per_m: float
    r_rel_deg_per_100m: float
    num: int


class DriftAtLength(Report):
    """Drift over ``num`` stretches of one length."""

    length_m: float
    num: int
    t_percent: float
    r_deg_per_m: float


class MeanDrift(Report):
    """Drift over all stretches; ``is_by_share``: these are shares of a path that is too short for KITTI's."""

    t_percent: float
    r_deg_per_m: float
    is_by_share: bool


class AlignmentReport(Report):
    """All errors after one alignment.

    Attributes:
        ground_truth_from_estimate: (8,) similarity.
        ate, rpe: absolute error, and relative error for each delta.
        kitti: None for a path that is too short.
        drift: None where no stretch is followed by another pose.
    """

    ground_truth_from_estimate: Sequence[float]
    scale: float
    ate: PoseErrors
    rpe: Sequence[RelativePoseErrors]
    kitti: KittiDrift | None
    drift: MeanDrift | None
    drift_by_length: Sequence[DriftAtLength]


class EvaluationReport(Report):
    """An estimate against the ground truth: metres (the ground truth's unit), degrees, seconds.

    Attributes:
        coverage: share of the ground truth that has a pose of the estimate.
        duration_s: of the pairs; None without timestamps.
        path_m: of the true path.
        alignments: by the manner of alignment.
        notes: what a reader of the numbers has to know.
    """

    estimate: TrajectoryReport
    ground_truth: TrajectoryReport
    num_pairs: int
    num_gaps: int
    coverage: float
    duration_s: float | None
    path_m: float
    alignments: Mapping[str, AlignmentReport]
    notes: Sequence[str]

    def table(self) -> str:
        """The errors as plain text, a block for each alignment; no newline at its end."""
        return "\n".join(_table_lines(self))


def metres(length: float) -> str:
    """A length in words."""
    return f"{length:.0f} m" if length >= 1000 else f"{length:.4g} m"


def _table_lines(report: EvaluationReport) -> list[str]:
    duration = "" if report.duration_s is None else f" in {report.duration_s:.4g} s"
    ours, theirs = report.estimate, report.ground_truth
    lines = [
        f"{ours.path} ({FORMAT_NAMES.get(ours.format, ours.format)})",
        f"against {theirs.path} ({FORMAT_NAMES.get(theirs.format, theirs.format)})",
        f"{report.num_pairs} pairs of {ours.num_poses} estimated and {theirs.num_poses} true poses, "
        f"{metres(report.path_m)}{duration}, coverage {100 * report.coverage:.1f} %, "
        f"{report.num_gaps or 'no'} gap{'' if report.num_gaps == 1 else 's'}",
        "",
    ]
    for how, errors in report.alignments.items():
        title = f"{how}, scale {errors.scale:.6f}"
        lines.append(f"{title:<36}" + "".join(f"{key:>14}" for key in _COLUMNS))
        lines += [f"{name:<36}" + "".join(f"{cell:>14}" for cell in cells) for name, cells in _rows(errors)]
        lines.append("")
    for note in report.notes:
        lines += textwrap.wrap(f"note: {note}", 100, subsequent_indent="  ", break_long_words=False)
    return lines


def _rows(errors: AlignmentReport) -> list[tuple[str, list[str]]]:
    rows: list[tuple[str, list[str]]] = []

    def add(name: str, found: PoseErrors) -> None:
        for what, numbers in (("translation (m)", found.translation_m), ("rotation (deg)", found.rotation_deg)):
            rows.append((f"{name} {what}", [f"{numbers[key]:.6f}" for key in _COLUMNS]))

    add("ATE", errors.ate)
    for error in errors.rpe:
        unit = "frame" if (error.delta, error.unit) == (1, "frames") else error.unit
        add(f"RPE {error.delta:g} {unit}", error)
    if (drift := errors.drift) is not None:
        names = ("drift (%)", "drift (deg/100 m)") if drift.is_by_share else ("t_rel (%)", "r_rel (deg/100 m)")
        for name, value in zip(names, (drift.t_percent, 100 * drift.r_deg_per_m), strict=True):
            rows.append((name, ["", f"{value:.6f}"]))
    return rows
