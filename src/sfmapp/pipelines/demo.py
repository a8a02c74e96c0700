"""The bundled sample: a result on it against the cameras that rendered it."""

from __future__ import annotations

from pathlib import Path

from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.evaluation.report import PoseErrorSummary
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import read_ground_truth


def compare_with_ground_truth(output: Path, sample: Path) -> PoseErrorSummary:
    """Errors of ``output/sparse/0`` in metres and degrees; see :meth:`PoseErrors.summary`."""
    model, _ = read_model(output / "sparse" / "0")
    ground_truth = read_ground_truth(sample / "cameras.json")
    return evaluate_poses(
        model.image_names, model.cam_from_world, ground_truth.names, ground_truth.cam_from_world
    ).summary()
