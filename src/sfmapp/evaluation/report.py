"""Errors against the ground truth, and against another result, in numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.reporting import Report


class Statistics(Report):
    """Of errors, in their unit."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


class PoseStatistics(Report):
    """Of the finite ones of errors, in their unit."""

    mean: float
    median: float
    rmse: float
    max: float


class PoseErrorSummary(Report):
    """Estimated against reference cameras; see :mod:`sfmapp.evaluation.poses` for the definitions.

    Attributes:
        num_common: reference images that the estimate has a pose for.
        num_outliers: of them, those that the similarity was not fitted to.
        scene_size: in the unit of the reference.
        center_error, center_error_share: in that unit, and as shares of the size; None where there is nothing to
            measure.
        auc: area under the curve of the errors of pairs, by the threshold in degrees.
    """

    num_reference_images: int
    num_common: int
    num_outliers: int
    scene_size: float
    center_error: PoseStatistics | None
    center_error_share: PoseStatistics | None
    rotation_error_deg: PoseStatistics | None
    auc: Mapping[str, float]


class ScoreAt(Report):
    """Shares of points within a distance."""

    distance: float
    accuracy: float
    completeness: float
    f_score: float


class CloudScoreSummary(Report):
    """Scores of a cloud; see :mod:`sfmapp.evaluation.clouds`.

    Attributes:
        num_points, num_ground_truth: points that were scored, of the result and of the ground truth.
        median_error: distance of the points that are near a true one; None without any.
        scores: by ascending distance.
    """

    num_points: int
    num_points_left_out: int
    num_ground_truth: int
    num_ground_truth_left_out: int
    median_error: float | None
    scores: Sequence[ScoreAt]
