"""A result beside pycolmap's, and against the ground truth: what ``sfmapp validate`` says, and its tables."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field

from sfmapp.evaluation.clouds import DISTANCE_FACTORS
from sfmapp.evaluation.poses import AUC_THRESHOLDS_DEG
from sfmapp.evaluation.report import CloudScoreSummary, PoseErrorSummary
from sfmapp.reporting import Plain, Report, Usage

NOT_RECORDED = "not recorded"


class Side(Report):
    """One of two results on the same photographs.

    Attributes:
        reprojection_error_px: mean over the observations, by the same code for both; None without a model.
        wall_s, cpu_s, peak_memory_mb: None where they were not recorded.
        ground_truth: its errors; absent without a ground truth.
    """

    registered: int
    images: int
    points: int
    track_length: float | None
    reprojection_error_px: float | None
    wall_s: float | None
    cpu_s: float | None
    peak_memory_mb: float | None
    ground_truth: PoseErrorSummary | None = None


class PycolmapSide(Side):
    """pycolmap's; ``phases``: what each part of its work took."""

    phases: Mapping[str, Usage]
    version: str
    options: Mapping[str, Plain]


class Validation(Report, kw_only=False):
    """Two results on the same photographs, side by side.

    Attributes:
        pycolmap: None if it failed.
        agreement: of the poses after a robust similarity fit, pycolmap being the reference; None without two models.
        ground_truth: name of the ground truth, None without.
        notes: what a reader of the table has to know.
    """

    ours: Side
    pycolmap: PycolmapSide | None
    agreement: PoseErrorSummary | None
    ground_truth: str | None
    notes: Sequence[str] = field(default_factory=list)

    def table(self) -> str:
        """The comparison as plain text, 100 columns wide unless a path is longer; no newline at its end."""
        return "\n".join(_table_lines(self))


class CloudValidation(Report, kw_only=False):
    """Scores of a cloud and of a mesh.

    Attributes:
        ground_truth: name of the true cloud.
        distance: the distance D in units of the ground truth.
        scores: by file, at 1, 2 and 5 D.
        recording: the coloured clouds, None if rerun failed.
        notes: what a reader of the table has to know.
    """

    ground_truth: str
    distance: float
    scores: Mapping[str, CloudScoreSummary]
    recording: str | None
    notes: Sequence[str] = field(default_factory=list)

    def table(self) -> str:
        """The scores as plain text; no newline at its end."""
        head = f"{'':<28}" + "".join(f"{f'{factor:g} x D':>12}" for factor in DISTANCE_FACTORS)
        lines = [f"against {self.ground_truth}, D = {self.distance:.6g}", head]
        for name, summary in self.scores.items():
            lines.append(f"{name}: {summary.num_points} points, {summary.num_ground_truth} true points")
            for title, values in (
                ("accuracy", [score.accuracy for score in summary.scores]),
                ("completeness", [score.completeness for score in summary.scores]),
                ("F-score", [score.f_score for score in summary.scores]),
            ):
                lines.append(f"  {title:<26}" + "".join(f"{100 * value:>10.2f} %" for value in values))
        lines += [f"note: {note}" for note in self.notes]
        if self.recording:
            lines.append(f"coloured by error: {self.recording}")
        return "\n".join(lines)


def _table_lines(result: Validation) -> list[str]:
    """The comparison as lines of text: ours, pycolmap's and, where smaller is cheaper, their ratio."""
    ours, theirs = result.ours, result.pycolmap
    rows: list[tuple[str, str, str, str]] = [("", "sfmapp", "pycolmap" if theirs else "pycolmap failed", "")]

    def row(title: str, text: Callable[[Side], str], ratio: str = "") -> None:
        rows.append((title, text(ours), text(theirs) if theirs else "-", ratio))

    row("registered images", lambda side: f"{side.registered} of {side.images}")
    row("points", lambda side: str(side.points))
    row("track length, mean", lambda side: _number(side.track_length, ".2f"))
    row("reprojection error, mean", lambda side: _number(side.reprojection_error_px, ".3f", " px"))
    if theirs is not None:
        ratios = [_ratio(ours[key], theirs[key]) for key in ("wall_s", "cpu_s", "peak_memory_mb")]
    else:
        ratios = ["", "", ""]
    row("wall time", lambda side: _number(side.wall_s, ".1f", " s", NOT_RECORDED), ratios[0])
    row("CPU time", lambda side: _number(side.cpu_s, ".1f", " s", NOT_RECORDED), ratios[1])
    row("peak memory", lambda side: _number(side.peak_memory_mb, ".0f", " MB", NOT_RECORDED), ratios[2])
    lines = _columns(rows)
    if result.agreement is not None:
        lines += ["", *_agreement_lines(result.agreement)]
    if result.ground_truth is not None and ours.ground_truth is not None:
        errors = _ground_truth_rows(ours.ground_truth, theirs.ground_truth if theirs else None)
        lines += ["", f"against {result.ground_truth}", *_columns(errors)]
    lines.append("")
    for note in result.notes:
        first, *more = note.splitlines()  # what pycolmap said before it fell over keeps its lines
        lines += textwrap.wrap(f"note: {first}", 100, subsequent_indent="  ", break_long_words=False)
        lines += [f"  {line}" for line in more]
    return lines


def _agreement_lines(agreement: PoseErrorSummary) -> list[str]:
    common, outliers = agreement.num_common, agreement.num_outliers
    share, angle = agreement.center_error_share, agreement.rotation_error_deg
    if share is None or angle is None:
        return [f"pose agreement: {common} common images, too few to align"]
    return [
        f"pose agreement after a similarity fit, {common} common images"
        + (f", {outliers} of them left out of the fit as outliers" if outliers else ""),
        f"  rotation   median {angle.median:.4f} deg   worst {angle.max:.4f} deg",
        f"  centre     median {100 * share.median:.4f} %     worst {100 * share.max:.4f} %   of the scene size",
    ]


def _ground_truth_rows(ours: PoseErrorSummary, theirs: PoseErrorSummary | None) -> list[tuple[str, str, str, str]]:
    def pick(summary: PoseErrorSummary | None, group: str, key: str, form: str, scale: float = 1.0) -> str:
        values = summary and summary[group]
        return _number(values[key] * scale, form) if values else "-"

    rows = []
    for title, group, key, form, scale in (
        ("centre error, mean", "center_error", "mean", ".5g", 1.0),
        ("centre error, median", "center_error", "median", ".5g", 1.0),
        ("centre error, worst", "center_error", "max", ".5g", 1.0),
        ("centre error, mean, % of scene", "center_error_share", "mean", ".4f", 100.0),
        ("rotation error, mean, deg", "rotation_error_deg", "mean", ".4f", 1.0),
        ("rotation error, worst, deg", "rotation_error_deg", "max", ".4f", 1.0),
    ):
        rows.append((title, pick(ours, group, key, form, scale), pick(theirs, group, key, form, scale), ""))
    for threshold in AUC_THRESHOLDS_DEG:
        title, key = f"AUC at {threshold:g} deg, all pairs", f"{threshold:g}"
        rows.append((title, pick(ours, "auc", key, ".4f"), pick(theirs, "auc", key, ".4f"), ""))
    return rows


def _columns(rows: Sequence[tuple[str, str, str, str]]) -> list[str]:
    return [f"{title:<32}{ours:>16}{theirs:>16}   {ratio}".rstrip() for title, ours, theirs, ratio in rows]


def _number(value: float | None, form: str, unit: str = "", missing: str = "-") -> str:
    return missing if value is None else f"{value:{form}}{unit}"


def _ratio(ours: float | None, theirs: float | None) -> str:
    if not ours or not theirs:
        return ""
    return f"{theirs / ours:.2f} x less" if theirs >= ours else f"{ours / theirs:.2f} x more"
